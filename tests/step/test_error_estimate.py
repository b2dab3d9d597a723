"""The estimated error of a step, and the warning of steps that are too large."""

import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import Gauss, LobattoIIIAB
from nhjax._numerics import max_norm


def particle(potential):
    return nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - potential(q))


# A pendulum in wind, far from rest, so that a step has no symmetry.
PENDULUM = particle(lambda q: -jnp.cos(q[0]) + 0.3 * q[0])
KNIFE = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * (v[0] ** 2 + v[1] ** 2) + 0.3 * v[2] ** 2 - 2.0 * q[0],
    nonholonomic=lambda t, q, v, args: (v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]))[
        None
    ],
)
BODY = nhjax.LagrangianSystem(
    lambda t, q, v, args: (
        0.5 * v @ (jnp.array([1.0, 1.7, 2.5]) * v) - 3 * nhjax.SO3().matrix(q)[2, 2]
    ),
    manifold=nhjax.SO3(),
)
HAMILTONIAN = nhjax.HamiltonianSystem(
    lambda t, q, p, args: 0.5 * p @ p / 3.0 - jnp.cos(q[0]) + 0.3 * q[0]
)
STARTS = {
    "pendulum": (PENDULUM, jnp.array([0.4]), jnp.array([0.9])),
    "knife": (KNIFE, jnp.array([0.1, 0.0, 0.5]), jnp.array([0.8, 0.0, 1.1])),
    "body": (BODY, jnp.array([0.9, 0.1, -0.3, 0.3]), jnp.array([0.9, 0.4, -1.2])),
}


def start_of(name):
    system, q, v = STARTS[name]
    return system, nhjax.initial_state(system, q, v, project=True)


@functools.cache
def states_of(name):
    """Return states along a motion, as a batch."""
    system, y0 = start_of(name)
    saveat = nhjax.SaveAt(steps=True)
    return nhjax.integrate(
        system, LobattoIIIAB(5), y0, dt=0.25, num_steps=24, saveat=saveat
    ).ys


def estimated_and_true(name, method, h):
    """Return the estimated and the true relative error of a step from each state.

    The change of a state is the larger of the changes of momentum and of q / h.
    """
    system, flat = STARTS[name][0], STARTS[name][0].manifold is None

    def one(y):
        sol = nhjax.integrate(system, method, y, dt=h, num_steps=1, throw=False)
        fine = nhjax.integrate(
            system, LobattoIIIAB(6), y, dt=h / 8, num_steps=8, throw=False
        )
        parts = [(sol.ys.p[0], fine.ys.p[0], y.p)]
        if flat:
            parts.append((sol.ys.q[0] / h, fine.ys.q[0] / h, y.q / h))
        error = max_norm(*[a - b for a, b, _ in parts])
        return sol.stats["max_error_estimate"], error / max_norm(
            *[b - c for _, b, c in parts]
        )

    return jax.jit(jax.vmap(one))(states_of(name))


@pytest.mark.parametrize("name", ["pendulum", "knife", "body"])
@pytest.mark.parametrize("stages", [2, 3, 4])
def test_error_estimate_of_step_is_near_true_error_and_of_its_order(name, stages):
    sizes, largest = (0.1, 0.2), []
    for h in sizes:
        estimate, error = estimated_and_true(name, LobattoIIIAB(stages), h)
        assert 0.1 < float(jnp.median(estimate / error)) < 30
        largest.append(float(jnp.max(estimate)))
    # Near turning points, a step with an odd number of stages is less accurate.
    lost = 1.5 if (name, stages) == ("pendulum", 3) else 0.3
    order = np.log2(largest[1] / largest[0])
    assert 2 * stages - 2 - lost < order < 2 * stages - 2 + 0.3


def test_error_estimate_of_gauss_method_is_near_true_error_and_of_its_order():
    largest = []
    for h in (0.1, 0.2):
        estimate, error = estimated_and_true("body", Gauss(3), h)
        assert 0.1 < float(jnp.median(estimate / error)) < 30
        largest.append(float(jnp.max(estimate)))
    assert abs(np.log2(largest[1] / largest[0]) - 6) < 0.3


def test_error_estimate_of_hamiltonian_system_equals_lagrangian_one():
    lagrangian = nhjax.LagrangianSystem(
        lambda t, q, v, args: 1.5 * v @ v + jnp.cos(q[0]) - 0.3 * q[0]
    )
    q, v = jnp.array([0.4]), jnp.array([0.9])
    estimates = []
    starts = (
        (lagrangian, nhjax.initial_state(lagrangian, q, v=v)),
        (HAMILTONIAN, nhjax.initial_state(HAMILTONIAN, q, p=3 * v)),
    )
    for system, y0 in starts:
        sol = nhjax.integrate(system, LobattoIIIAB(3), y0, dt=0.3, num_steps=1)
        estimates.append(float(sol.stats["max_error_estimate"]))
    # One estimate uses velocities and the other momenta, with a mass of 3.
    assert 0.1 < estimates[0] / estimates[1] < 10


def test_error_estimate_in_other_units_is_the_same():
    estimates = []
    for length, time in ((1.0, 1.0), (1e3, 1e-3), (1e-6, 60.0)):
        system = particle(
            lambda q, length=length, time=time: (
                (length / time) ** 2 * (1 - jnp.cos(q[0] / length))
            )
        )
        y0 = nhjax.initial_state(
            system, length * jnp.array([0.4]), length / time * jnp.array([0.9])
        )
        sol = nhjax.integrate(system, LobattoIIIAB(3), y0, dt=0.2 * time, num_steps=9)
        estimates.append(float(sol.stats["max_error_estimate"]))
    np.testing.assert_allclose(estimates, estimates[0], rtol=1e-6)


def test_error_estimate_of_method_with_one_node_is_missing():
    system, y0 = start_of("pendulum")
    sol = nhjax.integrate(system, Gauss(1), y0, dt=0.1, num_steps=2)
    assert "max_error_estimate" not in sol.stats


@pytest.mark.parametrize("stages", [2, 3, 4, 5, 6])
def test_error_estimate_of_step_of_five_periods_warns(stages):
    system = particle(lambda q: 0.5 * q @ q)
    y0 = nhjax.initial_state(system, jnp.ones(1), jnp.zeros(1))

    def run(**options):
        method, newton = LobattoIIIAB(stages), nhjax.Newton()
        options = {"num_steps": 40, "stage_solver": newton} | options
        return nhjax.integrate(system, method, y0, dt=30.0, **options)

    with pytest.warns(UserWarning, match=r"`dt` = 30 is too large.*Try `dt` = 7.5"):
        sol = run()
    assert float(sol.stats["max_error_estimate"]) > 0.9
    # Under `jit` there is no warning, and the figure is the same.
    compiled = jax.jit(lambda: run().stats["max_error_estimate"])()
    np.testing.assert_allclose(compiled, sol.stats["max_error_estimate"], rtol=1e-6)


@pytest.mark.parametrize("stages", [2, 3, 4])
@pytest.mark.parametrize(
    ("force", "v"),
    [
        (-9.81, 4.905),  # thrown up, it comes back to where it was
        (-9.81, 0.0),
        (0.0, 1.0),
        (0.0, 0.0),
    ],
)
def test_error_estimate_of_resolved_motion_does_not_warn(stages, force, v):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v + force * q[0],
        nonholonomic=lambda t, q, v, args: v[1][None],
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([v, 0.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sol = nhjax.integrate(system, LobattoIIIAB(stages), y0, dt=1.0, num_steps=1)
    assert float(sol.stats["max_error_estimate"]) < 1e-12


def test_error_estimate_of_machine_at_rest_under_its_weight_does_not_warn():
    bicycle = nhjax.systems.WhippleBicycle()
    y0 = bicycle.initial_state()
    y0 = nhjax.initial_state(bicycle.system, y0.q, 0 * y0.v, project=True)
    sol = nhjax.integrate(bicycle.system, LobattoIIIAB(2), y0, dt=0.02, num_steps=3)
    assert float(sol.stats["max_error_estimate"]) < 0.1
