"""Runs that keep functions which are conserved only where the constraints hold."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems
from support.helpers import central_difference, scalar
from support.long import exhaustive_but, long


def particle_at(y: float) -> systems.NonholonomicParticle:
    """The particle with a start at this y."""
    return systems.NonholonomicParticle(q0=(1.0, y, 0.2), v0=(0.4, 0.7, 0.4 * y))


def substituted_energy(t, q, v, args):
    """The energy of the particle, with y v_x in place of v_z."""
    kinetic = v[0] ** 2 + v[1] ** 2 + (q[1] * v[0]) ** 2
    return 0.5 * kinetic + 0.5 * (q[0] ** 2 + q[1] ** 2)


PARTICLE = systems.NonholonomicParticle()
EVERY = SaveAt(t0=True, steps=True)


@jax.jit
def particles(y0, dt):
    """Runs that keep the energy, and the same function after the substitution."""

    def run(invariants):
        system, method = PARTICLE.system, LobattoIIIAB(2)
        options = {"num_steps": 200, "saveat": EVERY, "invariants": invariants}
        return nhjax.integrate(system, method, y0, dt=dt, throw=False, **options)

    return run("energy"), run(substituted_energy)


@pytest.mark.parametrize("y", [0.0, 0.3, 1.0, 2.0, 3.0, 5.0, 8.0])
@pytest.mark.parametrize("dt", [0.05, 0.1])
def test_invariant_on_constraints_needs_as_many_sweeps_as_energy(dt, y):
    energy, found = particles(particle_at(y).initial_state(), dt)
    for sol in (energy, found):
        assert sol.result == nhjax.RESULTS.successful
        assert float(sol.stats["max_invariant_error"]) < 1e-15
        assert float(sol.stats["max_constraint_violation"]) < 1e-13
    sweeps = [float(x.stats["num_iterations"]) for x in (energy, found)]
    assert sweeps[1] < 1.3 * sweeps[0]
    # Without their parts along reactions the two derivatives are the same.
    np.testing.assert_allclose(found.ys.q, energy.ys.q, rtol=0, atol=3e-13)
    np.testing.assert_allclose(found.ys.v, energy.ys.v, rtol=0, atol=3e-13)


# Functions that differ from the energy by a multiple of the constraints.


def in_momenta(example):
    """The Hamiltonian form of an example whose mass matrix is the identity."""
    return nhjax.HamiltonianSystem(
        lambda t, q, p, args: p @ p - example.system.lagrangian(t, q, p, args),
        nonholonomic=lambda t, q, p, args: example.constraint(t, q, p, args),
    )


def curved():
    """A mass matrix that is not diagonal and a constraint that is quadratic in v."""
    matrix = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 1.5]])

    def lagrangian(t, q, v, args):
        mass = matrix + 0.2 * jnp.outer(jnp.cos(q), jnp.cos(q))
        return 0.5 * v @ mass @ v - 0.5 * q @ q

    def constraint(t, q, v, args):
        return (2 + jnp.sin(q[1])) * v[0] ** 2 + v[1] ** 2 - 3 * v[2] ** 2

    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=constraint)
    q, v = jnp.array([0.4, -0.3, 0.2]), jnp.array([0.8, 0.5, 0.8])
    return system, nhjax.initial_state(system, q, v=v, project=True)


def rod_with_more():
    """The rod with a redundant copy of its constraints."""
    rod = systems.RodSleigh()
    of_rod = rod.system.nonholonomic
    assert of_rod is not None

    def twice(t, q, v, args):
        value = jnp.atleast_1d(of_rod(t, q, v, args))
        return jnp.concatenate([value, 2 * value])

    system = nhjax.LagrangianSystem(
        rod.system.lagrangian,
        nonholonomic=twice,
        holonomic=rod.system.holonomic,
        constraints="redundant",
    )
    y = rod.initial_state()
    return system, nhjax.initial_state(system, y.q, v=y.v)


def to_run(name):
    if name == "Hamiltonian":
        system, y = in_momenta(PARTICLE), PARTICLE.initial_state()
        return system, nhjax.initial_state(system, y.q, p=y.p)
    if name == "mass and constraint not constant":
        return curved()
    if name == "redundant":
        return rod_with_more()
    example = {
        "group": systems.Veselova(),
        "holonomic": systems.SphericalPendulum(),
        "both kinds": systems.RodSleigh(),
        "sparse": systems.PendulumChain(6),
    }[name]
    return example.system, example.initial_state()


@cache
def energy_with_constraints(name):
    """E + f Φ with a factor f of each constraint that depends on the state."""
    system, _ = to_run(name)

    def function(t, q, u, args):
        nothing = jnp.zeros((0,), u.dtype)
        energy = system.energy(t, nhjax.State(q, u, u, nothing), args)
        values = system.constraint(t, q, u, args)
        factors = jnp.arange(1.0, values.shape[0] + 1) + u[0] + 0.2 * jnp.sin(u[-1])
        return energy + factors @ values

    return function


NAMES = [
    "Hamiltonian",
    "mass and constraint not constant",
    "group",
    "holonomic",
    "both kinds",
    "redundant",
    "sparse",
]


@pytest.mark.parametrize(
    "name", exhaustive_but(("Hamiltonian", "mass and constraint not constant"), NAMES)
)
def test_invariant_energy_with_multiples_of_constraints_changes_no_step(name):
    system, y0 = to_run(name)

    @jax.jit
    def run(y0):
        def keeping(invariants):
            options = {"num_steps": 30, "saveat": EVERY, "invariants": invariants}
            return nhjax.integrate(system, LobattoIIIAB(3), y0, dt=0.05, **options)

        return keeping("energy"), keeping(energy_with_constraints(name))

    energy, found = run(y0)
    assert float(energy.stats["max_invariant_error"]) < 3e-15
    assert float(found.stats["max_invariant_error"]) < 3e-15
    for field in ("q", "v", "multiplier"):
        pair = getattr(found.ys, field), getattr(energy.ys, field)
        scale = float(jnp.max(jnp.abs(pair[1])))
        np.testing.assert_allclose(*pair, rtol=0, atol=1e-12 * max(scale, 1.0))
    sweeps = [float(x.stats["num_iterations"]) for x in (energy, found)]
    assert sweeps[1] < 1.3 * sweeps[0]


# The impulses of single steps, by equations written in NumPy.


def test_invariant_impulses_exclude_directions_of_reactions():
    """p_{k+1} - p_k - h Σ b W = ε (ω_k + ω_{k+1}) with B M⁻¹ ω = 0 at both ends."""
    saveat = SaveAt(t0=True, steps=True, dense=True)
    system, y0 = PARTICLE.system, PARTICLE.initial_state()

    def passenger(t, q, v, args):
        # It is conserved like the energy, but its derivative has another direction.
        return 0.5 * (1 + q[1] ** 2) * v[0] ** 2 + 0.5 * q[0] ** 2

    options = {"num_steps": 10, "saveat": saveat, "invariants": passenger}
    sol = nhjax.integrate(system, LobattoIIIAB(2), y0, dt=0.2, **options)
    assert sol.interpolation is not None
    y = jax.tree.map(np.asarray, sol.ys)
    record = jax.tree.map(np.asarray, sol.interpolation.records)
    found = []
    for k in range(10):
        positions = np.stack([y.q[k], y.q[k + 1]])
        # Trapezoidal rule: the nodes of two stages are the ends of the step.
        reactions = np.stack([-positions[:, 1], np.zeros(2), np.ones(2)], axis=1)
        springs = -positions * np.array([1.0, 1.0, 0.0])
        W = springs + reactions * record.multiplier[k]
        miss = y.p[k + 1] - y.p[k] - 0.1 * (W[0] + W[1])
        slopes = np.zeros((2, 3))
        slopes[:, 0] = (1 + positions[:, 1] ** 2) * y.v[k : k + 2, 0]
        along = np.sum(slopes * reactions, axis=1) / np.sum(reactions**2, axis=1)
        omega = np.sum(slopes - along[:, None] * reactions, axis=0)
        epsilon = miss @ omega / (omega @ omega)
        np.testing.assert_allclose(miss, epsilon * omega, rtol=0, atol=1e-15)
        found.append(abs(epsilon))
    assert max(found) > 1e-5


# Symmetry, several functions, derivatives and ensembles.


@pytest.mark.parametrize("stages", exhaustive_but((2,), (2, 3)))
@pytest.mark.parametrize("closure", ["symmetric", "propagated"])
def test_invariant_steps_forwards_and_back_return_to_the_start(closure, stages):
    @jax.jit
    def run(y0, dt):
        options = {"num_steps": 40, "invariants": substituted_energy}
        method = LobattoIIIAB(stages, closure)
        return nhjax.integrate(PARTICLE.system, method, y0, dt=dt, **options).ys

    y0 = particle_at(2.0).initial_state()
    there = jax.tree.map(lambda x: x[0], run(y0, 0.1))
    assert float(jnp.max(jnp.abs(there.q - y0.q))) > 0.1
    back = jax.tree.map(lambda x: x[0], run(there, -0.1))
    for field in ("q", "v", "p"):
        pair = getattr(back, field), getattr(y0, field)
        np.testing.assert_allclose(*pair, rtol=0, atol=3e-14)


@pytest.mark.parametrize("closure", ["symmetric", "consistent", "propagated"])
def test_invariants_of_two_functions_on_constraints_stay_at_round_off(closure):
    def both(t, q, v, args):
        driver = 0.5 * v[1] ** 2 + 0.5 * q[1] ** 2
        passenger = 0.5 * (1 + q[1] ** 2) * v[0] ** 2 + 0.5 * q[0] ** 2
        return jnp.stack([driver, passenger])

    y0, method = particle_at(3.0).initial_state(), LobattoIIIAB(3, closure)
    options = {"num_steps": 200, "invariants": both, "saveat": EVERY}
    sol = nhjax.integrate(PARTICLE.system, method, y0, dt=0.05, **options)
    kept = jax.vmap(lambda y: both(0.0, y.q, y.v, None))(sol.ys)
    np.testing.assert_allclose(kept, jnp.broadcast_to(kept[0], kept.shape), rtol=1e-14)
    assert float(sol.stats["max_constraint_violation"]) < 1e-14
    assert float(sol.stats["num_iterations"]) < 10 * 200


ADJOINTS = {
    "direct": nhjax.DirectAdjoint(),
    "checkpoints": nhjax.RecursiveCheckpointAdjoint(),
    "reversible": nhjax.ReversibleAdjoint(),
}


@pytest.mark.parametrize("name", exhaustive_but(["direct"], ADJOINTS))
def test_invariant_gradients_on_constraints_match_finite_differences(name):
    y0 = particle_at(1.0).initial_state()

    def loss(x):
        """The variables are the step size, a factor of velocities and the place."""
        q = y0.q + x[2]
        v = x[1] * y0.v
        v = jnp.stack([v[0], v[1], q[1] * v[0]])
        start = nhjax.initial_state(PARTICLE.system, q, v)
        options = {"adjoint": ADJOINTS[name], "invariants": substituted_energy}
        method = LobattoIIIAB(2)
        sol = nhjax.integrate(
            PARTICLE.system, method, start, dt=x[0], num_steps=5, **options
        )
        return scalar(sol.ys)

    x, run = np.array([0.3, 1.0, 0.1]), jax.jit(loss)
    gradient = jax.jit(jax.grad(loss))(jnp.array(x))
    differences = [
        central_difference(lambda e, d=d: run(x + e * d), 3e-3) for d in np.eye(3)
    ]
    np.testing.assert_allclose(gradient, differences, rtol=1e-9)


@pytest.mark.parametrize("scale", [1e-8, long(1e8)])
def test_invariant_run_in_other_units_has_equal_sweeps_and_accuracy(scale):
    """Units of mass and of the constraint: the motion does not depend on them."""

    def run(mass, unit):
        system = nhjax.LagrangianSystem(
            lambda t, q, v, args: mass * PARTICLE.system.lagrangian(t, q, v, args),
            nonholonomic=lambda t, q, v, args: unit * (v[2] - q[1] * v[0]),
        )
        y = particle_at(3.0).initial_state()
        y0 = nhjax.initial_state(system, y.q, v=y.v)
        options = {"num_steps": 100, "saveat": EVERY}
        return nhjax.integrate(
            *(system, LobattoIIIAB(2), y0),
            **{"dt": 0.1, **options},
            invariants=lambda *given: mass * substituted_energy(*given),
        )

    plain, scaled = run(1.0, 1.0), run(scale, 1 / scale)
    np.testing.assert_allclose(scaled.ys.q, plain.ys.q, rtol=0, atol=1e-12)
    counts = [int(x.stats["num_iterations"]) for x in (plain, scaled)]
    assert abs(counts[1] - counts[0]) < 0.1 * counts[0]


def test_invariant_ensemble_members_take_the_steps_of_single_runs():
    starts = [particle_at(y).initial_state() for y in (0.5, 2.0, 6.0)]
    y0 = jax.tree.map(lambda *x: jnp.stack(x), *starts)

    def run(y):
        options = {"num_steps": 50, "invariants": substituted_energy}
        return nhjax.integrate(PARTICLE.system, LobattoIIIAB(2), y, dt=0.1, **options)

    found = jax.jit(jax.vmap(run))(y0)
    assert np.all(np.asarray(found.stats["max_invariant_error"]) < 1e-15)
    for k, y in enumerate(starts):
        one = run(y)
        np.testing.assert_allclose(found.ys.q[k], one.ys.q, rtol=0, atol=1e-13)
