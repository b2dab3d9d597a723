"""Gradients of runs in all arguments against finite differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems
from support import helpers
from support.driven import Driven
from support.gradients import assert_gradient, split, STEPS
from support.helpers import (
    scalar,
)
from support.long import long


# What is given, and what is saved -----------------------------------------------------


GIVEN = {
    "q": jnp.array([0.5, -0.3, 0.2]),
    "v": jnp.array([0.4, 0.6, 1.0]),
    "t0": jnp.asarray(0.2),
    "dt": jnp.asarray(0.05),
    "args": {"friction": jnp.asarray(0.1)},
    "leaf": jnp.asarray([1.0, 1.5, 0.7]),
    "closed over": jnp.asarray(0.4),
    "ts": jnp.array([0.2531, 0.2563, 3.31, 8.222]),
    "fn": jnp.asarray(1.3),
}


def driven(given, closure, saveat):
    """A run that depends on all arguments and on arrays in closures."""
    scale, args = given["fn"], given["args"]
    # The masses are leaves of the system; the functions close over all the rest.
    leaves = Driven(given["leaf"], given["closed over"])
    beta = given["closed over"]

    def force(t, q, v, args):
        return leaves.friction(t, q, v, args) + beta * jnp.cos(t) * q

    def constraint(t, q, v, args):
        return leaves.constraint(t, q, v, args) - beta * q[1] * v[0]

    def fn(t, y, args):
        return scale * jnp.sin(t) * y.q, y, args["friction"] * y.p

    system = nhjax.LagrangianSystem(
        leaves.lagrangian, nonholonomic=constraint, force=force
    )
    t0 = given["t0"]
    y0 = nhjax.initial_state(
        system, given["q"], given["v"], t=t0, args=args, project=True
    )
    return nhjax.integrate(
        system,
        LobattoIIIAB(2, closure),
        y0,
        dt=given["dt"],
        num_steps=STEPS,
        t0=t0,
        args=args,
        saveat=saveat(given["ts"], fn),
    )


def samples(given):
    """Samples: two in one step, and both ends."""
    sol = driven(
        given, "symmetric", lambda ts, fn: SaveAt(t0=True, ts=ts, t1=True, fn=fn)
    )
    return scalar((sol.ts, sol.ys))


def thinned_nodes(given):
    """Every 67th state and the last one."""
    sol = driven(given, "consistent", lambda ts, fn: SaveAt(steps=67, t1=True, fn=fn))
    return scalar((sol.ts, sol.ys))


def dense_output(given):
    """Dense output in the middle of two steps, and at the end."""
    sol = driven(given, "symmetric", lambda ts, fn: SaveAt(t1=True, dense=True, fn=fn))
    between = jax.vmap(sol.evaluate)(given["ts"][1:])
    return scalar((sol.ys, between, sol.evaluate(sol.t1)))


@pytest.mark.parametrize("loss", [long(samples), thinned_nodes, long(dense_output)])
def test_gradient_in_all_arguments_matches_finite_differences(loss):
    assert_gradient(loss, GIVEN, epsilon=3e-5)


def momenta(matrix, q):
    """A kinetic energy of the momenta that depends on the position."""
    return matrix + 0.2 * jnp.outer(jnp.sin(q), jnp.sin(q))


def test_gradient_of_hamiltonian_system_from_velocities_matches_finite_differences():
    metric = jnp.eye(3) + 0.1 * jnp.cos(np.add.outer(np.arange(3.0), np.arange(3.0)))
    given = {
        "q": jnp.array([0.5, -0.3, 0.2]),
        "v": jnp.array([0.4, 0.6, 1.0]),
        "metric": metric,
        "dt": jnp.asarray(0.05),
        "slope": jnp.asarray(0.8),
    }

    def loss(given):
        matrix = 0.5 * (given["metric"] + given["metric"].T)

        def hamiltonian(t, q, p, args):
            return 0.5 * p @ momenta(matrix, q) @ p + 0.25 * jnp.sum(q**4)

        def constraint(t, q, p, args):
            v = momenta(matrix, q) @ p
            return v[2] - given["slope"] * q[1] * v[0]

        system = nhjax.HamiltonianSystem(hamiltonian, nonholonomic=constraint)
        y0 = nhjax.initial_state(system, given["q"], v=given["v"], project=True)
        method = LobattoIIIAB(2, "propagated")
        ys = nhjax.integrate(system, method, y0, dt=given["dt"], num_steps=STEPS).ys
        return scalar(ys)

    assert_gradient(loss, given)


def test_gradient_of_hamiltonian_system_on_a_group_matches_finite_differences():
    suslov = systems.Suslov()
    given = {
        "inverse": jnp.linalg.inv(
            jnp.array([[1, 0, 0.3], [0, 1.5, -0.2], [0.3, -0.2, 2]])
        ),
        "xi": jnp.zeros(3),
        "p": jnp.array([0.6, 0.9, 0.1]),
    }

    def loss(given):
        matrix = 0.5 * (given["inverse"] + given["inverse"].T)
        system = nhjax.HamiltonianSystem(
            lambda t, g, p, args: 0.5 * p @ matrix @ p + g[0] * g[3],
            nonholonomic=lambda t, g, p, args: matrix[2] @ p,
            manifold=suslov.manifold,
        )
        q = suslov.manifold.act(suslov.q0, given["xi"])
        y0 = nhjax.initial_state(system, q, p=given["p"], project=True)
        ys = nhjax.integrate(system, LobattoIIIAB(2), y0, dt=0.05, num_steps=STEPS).ys
        return scalar(ys)

    assert_gradient(loss, given)


# Initial states -----------------------------------------------------------------------


def test_gradient_of_initial_state_from_momenta_matches_finite_differences():
    sleigh = systems.ChaplyginSleigh()
    given, joined = split(sleigh)
    given["p"] = jnp.array([0.2, 0.5, 0.4])

    def loss(given):
        sleigh = joined(given)
        return scalar(
            nhjax.initial_state(sleigh.system, sleigh.q0, p=given["p"], project=True)
        )

    assert_gradient(loss, given, epsilon=3e-4, rtol=1e-10)


@pytest.mark.parametrize(
    "example", [systems.Appell(), systems.RodSleigh()], ids=["nonlinear", "holonomic"]
)
def test_gradient_of_projected_initial_state_matches_finite_differences(example):
    # Far from the constraints, so that the projection has something to do.
    example = eqx.tree_at(
        lambda e: (e.q0, e.v0), example, (1.1 * example.q0 + 0.05, example.v0 + 0.1)
    )
    given, joined = split(example)

    def loss(given):
        example = joined(given)
        return scalar(
            nhjax.initial_state(example.system, example.q0, example.v0, project=True)
        )

    assert_gradient(loss, given, epsilon=3e-4, rtol=1e-10)


def test_gradient_of_state_from_explicit_parts_matches_finite_differences():
    # The parts of y0 vary independently, as if from an earlier solution.
    system, y0, args = helpers.problem("driven")
    method = LobattoIIIAB(2, "propagated")

    def loss(y0):
        return scalar(
            nhjax.integrate(system, method, y0, dt=0.05, num_steps=STEPS, args=args).ys
        )

    # A start that violates the constraints by more than this is refused.
    assert_gradient(loss, y0, epsilon=3e-5)


# float32 ------------------------------------------------------------------------------


def test_gradient_in_single_precision_is_accurate():
    particle = systems.NonholonomicParticle()

    def loss(dt, dtype):
        y0 = particle.initial_state(dtype)
        sol = nhjax.integrate(particle.system, LobattoIIIAB(2), y0, dt=dt, num_steps=50)
        return jnp.sum(jnp.sin(sol.ys.q))

    single = jax.jit(jax.grad(loss), static_argnums=1)(jnp.float32(0.05), jnp.float32)
    double = jax.jit(jax.grad(loss), static_argnums=1)(0.05, jnp.float64)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, double, rtol=1e-4)


# Loops of runs ------------------------------------------------------------------------


@pytest.mark.parametrize("loop", ["scan", "fori_loop"])
def test_second_derivative_by_step_size_in_a_loop_of_runs_equals_two_forward_ones(loop):
    particle = systems.NonholonomicParticle()
    y0 = particle.initial_state()

    def after(h):
        def run(y):
            sol = nhjax.integrate(
                particle.system, LobattoIIIAB(2), y, dt=h, num_steps=2
            )
            return jax.tree.map(lambda x: x[-1], sol.ys)

        if loop == "scan":
            y, _ = jax.lax.scan(lambda y, _: (run(y), None), y0, None, length=2)
        else:
            y = jax.lax.fori_loop(0, 2, lambda _, y: run(y), y0)
        return jnp.sum(y.q**2)

    # The checks of a run raise through a callback, which has no derivative.
    found = jax.hessian(after)(0.1)
    np.testing.assert_allclose(found, jax.jacfwd(jax.jacfwd(after))(0.1), rtol=1e-12)
    assert abs(found) > 1e-3
