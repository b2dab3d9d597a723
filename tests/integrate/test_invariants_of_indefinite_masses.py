"""Runs that keep the energy where the mass matrix is negative or indefinite."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems
from support.long import exhaustive_but, long
from support.orders import rms


PARTICLE = systems.NonholonomicParticle()
DURATION, MEMBERS = 5.0, 300


def saddle() -> nhjax.LagrangianSystem:
    """A system with an indefinite mass matrix and a nonholonomic constraint."""

    def lagrangian(t, q, v, args):
        return 0.5 * (v[0] ** 2 + v[1] ** 2 - v[2] ** 2) - 0.5 * q @ q

    return nhjax.LagrangianSystem(
        lagrangian, nonholonomic=lambda t, q, v, args: v[0] - 0.5 * q[1] * v[1]
    )


def saddle_rates(t: float, z: np.ndarray) -> np.ndarray:
    """The motion of `saddle` in plain NumPy: M a = -q + λ B with B a = v_2² / 2."""
    q, v = z[:3], z[3:]
    mass, slope = np.array([1.0, 1.0, -1.0]), np.array([1.0, -0.5 * q[1], 0.0])
    free = -q / mass
    multiplier = (0.5 * v[1] ** 2 - slope @ free) / (slope @ (slope / mass))
    return np.concatenate([v, free + multiplier * slope / mass])


@cache
def saddle_starts() -> np.ndarray:
    """States (q, v) on the constraint, with v_3 = 0.9."""
    q, v = np.random.default_rng(0).normal(size=(2, MEMBERS, 3))
    v[:, 2], v[:, 0] = 0.9, 0.5 * q[:, 1] * v[:, 1]
    return np.concatenate([q, v], axis=1)


def ends_by_scipy(rates: Any, starts: np.ndarray) -> np.ndarray:
    """The states after the duration, at tight tolerances."""
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    ends = [solve_ivp(rates, (0, DURATION), z, **options).y[:, -1] for z in starts]
    return np.array(ends)


def errors_of_members(
    system: Any, starts: np.ndarray, ends: np.ndarray, stages: int, num_steps: int, kept
) -> tuple[np.ndarray, np.ndarray]:
    """The relative error of each member, and the largest error of its energy."""
    n = starts.shape[1] // 2

    @jax.jit
    @jax.vmap
    def run(z):
        y0 = nhjax.initial_state(system, z[:n], v=z[n:])
        sol = nhjax.integrate(
            *(system, LobattoIIIAB(stages), y0),
            **{"dt": DURATION / num_steps, "num_steps": num_steps, "invariants": kept},
            saveat=SaveAt(t0=True, steps=True),
            throw=False,
        )
        energies = jax.vmap(system.energy)(sol.ts, sol.ys)
        off = jnp.max(jnp.abs(energies - energies[0]))
        return sol.ys.q[-1], sol.result == nhjax.RESULTS.successful, off

    q, successful, off = map(np.asarray, run(jnp.asarray(starts)))
    assert np.all(successful)
    misses = np.max(np.abs(q - ends[:, :n]), axis=1)
    return misses / np.max(np.abs(ends[:, :n]), axis=1), off


def null_coordinates(t, q, v, args):
    """Two oscillators whose energies have opposite signs, in q_1 ± q_2."""
    x, y = q[0] + q[1], q[0] - q[1]
    return v[0] * v[1] - q[0] * q[1] + 0.1 * jnp.sin(x) * jnp.cos(y)


NULL = nhjax.LagrangianSystem(null_coordinates)


def null_rates(t, z):
    x, y = z[0] + z[1], z[0] - z[1]
    # The derivatives of sin(x) cos(y) with respect to q_1 and q_2.
    first = np.cos(x) * np.cos(y) - np.sin(x) * np.sin(y)
    second = np.cos(x) * np.cos(y) + np.sin(x) * np.sin(y)
    return np.array([z[2], z[3], -z[0] + 0.1 * second, -z[1] + 0.1 * first])


@cache
def motions(name):
    """Many motions; for some of them v·Mv vanishes near a node of the run."""
    if name == "null coordinates":
        system, rates = NULL, null_rates
        starts = np.random.default_rng(0).normal(size=(MEMBERS, 4))
    else:
        system, rates, starts = saddle(), saddle_rates, saddle_starts()
    return system, starts, ends_by_scipy(rates, starts)


@cache
def errors_at_the_end(name, stages, num_steps, invariants):
    return errors_of_members(*motions(name), stages, num_steps, invariants)


@pytest.mark.parametrize("name", ["a saddle", long("null coordinates")])
def test_invariant_energy_where_kinetic_energy_changes_sign_stays_in_every_member(name):
    """Large impulses where v·Mv nearly vanishes would spoil some members."""
    plain, walk = errors_at_the_end(name, 3, 50, None)
    kept, off = errors_at_the_end(name, 3, 50, "energy")
    # Impulses cost members without such nodes a factor of ten, too.
    assert np.max(kept) < 10 * np.max(plain)
    # In the few steps without impulses, the energy changes as in the plain run.
    assert 1e-9 < np.max(off) < np.max(walk)
    assert np.mean(off < 1e-12) > 0.3


@pytest.mark.parametrize("stages", exhaustive_but((3,), (2, 3)))
def test_invariant_run_where_kinetic_energy_changes_sign_keeps_its_order(stages):
    counts = {2: (200, 400), 3: (50, 100)}[stages]
    found = [errors_at_the_end("a saddle", stages, n, "energy")[0] for n in counts]
    slope = np.log2(rms(found[0][:, None]) / rms(found[1][:, None]))
    assert abs(slope - (2 * stages - 2)) < 0.4


@pytest.mark.long
def test_invariants_of_two_functions_are_as_accurate_as_energy_alone():
    """The energy of q_3 is conserved separately."""

    def both(t, q, v, args):
        return jnp.stack(
            [
                0.5 * (v[0] ** 2 + v[1] ** 2 - v[2] ** 2) + 0.5 * q @ q,
                -0.5 * v[2] ** 2 + 0.5 * q[2] ** 2,
            ]
        )

    plain, _ = errors_at_the_end("a saddle", 3, 50, None)
    kept, _ = errors_at_the_end("a saddle", 3, 50, both)
    assert np.max(kept) < 20 * np.max(plain)


def test_invariant_norm_of_a_geodesic_around_a_black_hole_is_conserved():
    """The mass matrix is indefinite, but v·Mv = -1 all along."""

    def schwarzschild(t, q, v, args):
        f = 1 - 2 / q[1]
        return 0.5 * (-f * v[0] ** 2 + v[1] ** 2 / f + (q[1] * v[2]) ** 2)

    system, r, turn = nhjax.LagrangianSystem(schwarzschild), 8.0, 0.06
    rate = np.sqrt((1 + (r * turn) ** 2) / (1 - 2 / r))
    q, v = jnp.array([0.0, r, 0.0]), jnp.array([rate, 0.0, turn])
    y0 = nhjax.initial_state(system, q, v=v)
    given = system, LobattoIIIAB(2), y0
    options = {"dt": 1.0, "num_steps": 1000, "saveat": SaveAt(steps=True)}
    sol = nhjax.integrate(*given, **options, invariants="energy")
    norms = 2 * jax.vmap(lambda y: schwarzschild(0.0, y.q, y.v, None))(sol.ys)
    assert float(jnp.ptp(sol.ys.q[:, 1])) > 1
    np.testing.assert_allclose(norms, -1.0, rtol=0, atol=3e-15)


def test_invariant_steps_with_negative_mass_matrix_equal_the_positive_ones():
    system, y0 = PARTICLE.system, PARTICLE.initial_state()
    negative = nhjax.LagrangianSystem(
        lambda *given: -system.lagrangian(*given), nonholonomic=system.nonholonomic
    )
    z0 = nhjax.initial_state(negative, y0.q, v=y0.v)

    def run(system, y0, dt):
        given = system, LobattoIIIAB(2), y0
        options = {"dt": dt, "num_steps": 100, "invariants": "energy"}
        return nhjax.integrate(*given, **options, saveat=SaveAt(steps=True))

    for dt in (0.1, -0.1):
        plain, found = run(system, y0, dt), run(negative, z0, dt)
        np.testing.assert_allclose(found.ys.q, plain.ys.q, rtol=0, atol=1e-13)
        assert float(found.stats["max_invariant_error"]) < 1e-15


def test_invariant_energy_with_ill_conditioned_definite_mass_matrix_is_conserved():
    """The terms of v·Mv cancel to 1e-4 of their size, but M is still definite."""
    mass = np.array([[1e4, 1e4], [1e4, 1e4 + 1]])

    def stiff(t, q, v, args):
        total = q[0] + q[1]
        return 0.5 * v @ mass @ v - 5e3 * total**2 + jnp.cos(q[1])

    system = nhjax.LagrangianSystem(stiff)
    q, v = jnp.array([0.3, -0.3]), jnp.array([-0.99, 1.0])
    y0 = nhjax.initial_state(system, q, v=v)
    given = system, LobattoIIIAB(3), y0
    options = {"dt": 0.05, "num_steps": 400, "saveat": SaveAt(t0=True, steps=True)}
    sol = nhjax.integrate(*given, **options, invariants="energy")
    energies = jax.vmap(lambda y: system.energy(0.0, y))(sol.ys)
    assert float(sol.stats["max_invariant_error"]) < 1e-14
    np.testing.assert_allclose(energies, energies[0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("mass", [0.01, 1.0, 100.0])
def test_invariant_steps_in_the_hamiltonian_form_equal_the_lagrangian_ones(mass):
    """Which steps keep the energy must not depend on the form or the unit of mass."""
    masses = mass * jnp.array([1.0, -2.0])

    def potential(q):
        return 0.5 * masses @ q**2 + mass * (0.3 * q[0] ** 4 + 0.1 * (q[0] * q[1]) ** 2)

    forms = (
        nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * masses @ v**2 - potential(q)
        ),
        nhjax.HamiltonianSystem(
            lambda t, q, p, args: 0.5 * (1 / masses) @ p**2 + potential(q)
        ),
    )
    q, errors = [], []
    for system in forms:
        y0 = nhjax.initial_state(system, jnp.array([1.0, 0.3]), jnp.array([0.2, 0.9]))
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(2),
            y0,
            dt=0.1,
            num_steps=200,
            invariants="energy",
            saveat=nhjax.SaveAt(steps=1),
        )
        q.append(sol.ys.q)
        errors.append(float(sol.stats["max_invariant_error"]))
    # In some steps no impulses keep the energy.
    assert errors[0] > 1e-5
    np.testing.assert_allclose(q[1], q[0], rtol=0, atol=1e-10)
    np.testing.assert_allclose(errors[1], errors[0], rtol=1e-8)
