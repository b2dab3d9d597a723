"""Gradients of whole runs against differences: the gallery, and all that is given."""

from typing import Any

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference, direction, dot, moved, scalar

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems


pytestmark = pytest.mark.usefixtures("quick_compilation")

STEPS = 200


def assert_gradient(loss, given, epsilon=1e-4, rtol=1e-8):
    """The gradient along one direction in all that is given, against differences."""
    program, along = jax.jit(jax.value_and_grad(loss)), direction(given)
    _, gradient = program(given)
    expected = central_difference(
        lambda eps: program(moved(given, along, eps))[0], epsilon
    )
    assert abs(expected) > 1e-3
    np.testing.assert_allclose(dot(gradient, along), expected, rtol=rtol)


def split(example):
    """What an example is differentiated with respect to, and the way back.

    Its configuration moves in the chart around that of the example.
    """
    rest = eqx.tree_at(lambda e: e.q0, example, None)
    parameters, fixed = eqx.partition(rest, eqx.is_inexact_array)
    manifold = example.system.manifold_of(example.q0)
    given = {"parameters": parameters, "xi": jnp.zeros(manifold.dim)}

    def joined(given):
        q0 = manifold.act(example.q0, given["xi"])
        moved = eqx.combine(given["parameters"], fixed)
        return eqx.tree_at(lambda e: e.q0, moved, q0, is_leaf=lambda x: x is None)

    return given, joined


class Beside(eqx.Module):
    """Systems that do not know of one another, in one program."""

    examples: tuple

    def split(self, v):
        """What of the last axis belongs to each example."""
        ends = np.cumsum([example.v0.size for example in self.examples])
        return jnp.split(v, ends[:-1], axis=-1)

    def lagrangian(self, t, q, v, args):
        """The sum of the Lagrangians."""
        parts = zip(self.examples, q, self.split(v), strict=True)
        return sum(example.lagrangian(t, x, y, args) for example, x, y in parts)

    def constraint(self, t, q, v, args):
        """The constraints one after another."""
        parts = zip(self.examples, q, self.split(v), strict=True)
        return jnp.concatenate(
            [
                jnp.atleast_1d(example.constraint(t, x, y, args))
                for example, x, y in parts
                if example.system.nonholonomic is not None
            ]
        )

    @property
    def system(self):
        """The system of all."""
        manifolds = [
            example.system.manifold_of(example.q0) for example in self.examples
        ]
        return nhjax.LagrangianSystem(
            self.lagrangian,
            nonholonomic=self.constraint,
            manifold=nhjax.ProductGroup(*manifolds),
        )


def test_the_gradient_of_every_system_on_a_vector_space():
    examples = [*helpers.GALLERY.values(), systems.UnicycleInCoordinates()]
    given, joined = zip(*map(split, examples), strict=True)

    def losses(given):
        pairs = zip(joined, given, strict=True)
        beside = Beside(tuple(join(part) for join, part in pairs))
        q0 = tuple(example.q0 for example in beside.examples)
        v0 = jnp.concatenate([example.v0 for example in beside.examples])
        system = beside.system
        y0 = nhjax.initial_state(system, q0, v0, project=True)
        ys = nhjax.integrate(system, LobattoIIIAB(3), y0, dt=0.05, num_steps=STEPS).ys
        parts = zip(ys.q, beside.split(ys.v), beside.split(ys.p), strict=True)
        each = jnp.stack([scalar(part) for part in parts])
        return jnp.sum(each), each

    program = jax.jit(jax.value_and_grad(losses, has_aux=True))
    along = direction(given)
    _, gradient = program(given)
    expected = central_difference(
        lambda eps: program(moved(given, along, eps))[0][1], 1e-4
    )
    assert np.all(np.abs(expected) > 1e-2)
    got = [dot(g, d) for g, d in zip(gradient, along, strict=True)]
    np.testing.assert_allclose(got, expected, rtol=1e-8)


ELSEWHERE = {
    "unicycle": (systems.Unicycle(), LobattoIIIAB(2)),
    "ball": (systems.TurntableBall(), LobattoIIIAB(2, "propagated")),
    "Suslov": (systems.Suslov(), LobattoIIIAB(2, "consistent")),
    "rod sleigh": (systems.RodSleigh(), LobattoIIIAB(2)),
}


@pytest.mark.parametrize("name", ELSEWHERE)
def test_the_gradient_of_systems_elsewhere(name):
    example, method = ELSEWHERE[name]
    given, joined = split(example)
    given |= {"dt": jnp.asarray(0.05), "friction": jnp.asarray(0.05)}

    def loss(given):
        example = joined(given)
        system = eqx.tree_at(
            lambda system: system.force,
            example.system,
            lambda t, q, v, args: -args * v,
            is_leaf=lambda x: x is None,
        )
        args = given["friction"]
        y0 = nhjax.initial_state(
            system, example.q0, example.v0, args=args, project=True
        )
        sol = nhjax.integrate(
            system, method, y0, dt=given["dt"], num_steps=STEPS, args=args
        )
        return scalar((sol.ys, sol.t1))

    assert_gradient(loss, given)


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


class Inertia(eqx.Module):
    """A Lagrangian with an array for a leaf."""

    masses: Any

    def __call__(self, t, q, v, args):
        mu = 1.0 + 0.3 * jnp.sin(t)
        return 0.5 * mu * (v @ (self.masses * v)) - 0.5 * (q @ q)


def driven(given, closure, saveat):
    """A run in which everything plays a part, not all of it in plain sight."""
    beta, scale, args = given["closed over"], given["fn"], given["args"]

    def force(t, q, v, args):
        return -args["friction"] * v + beta * jnp.cos(t) * q

    def constraint(t, q, v, args):
        return v[2] - (1 + beta) * q[1] * v[0] - beta * jnp.cos(t)

    def fn(t, y, args):
        return scale * jnp.sin(t) * y.q, y, args["friction"] * y.p

    system = nhjax.LagrangianSystem(
        Inertia(given["leaf"]), nonholonomic=constraint, force=force
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
    """Two in one step, and the ends."""
    sol = driven(
        given, "symmetric", lambda ts, fn: SaveAt(t0=True, ts=ts, t1=True, fn=fn)
    )
    return scalar((sol.ts, sol.ys))


def thinned_nodes(given):
    """Each 67th and the last."""
    sol = driven(given, "consistent", lambda ts, fn: SaveAt(steps=67, t1=True, fn=fn))
    return scalar((sol.ts, sol.ys))


@pytest.mark.parametrize("loss", [samples, thinned_nodes])
def test_the_gradient_in_all_that_is_given(loss):
    assert_gradient(loss, GIVEN, epsilon=3e-5)


def momenta(matrix, q):
    """A metric on momenta that varies."""
    return matrix + 0.2 * jnp.outer(jnp.sin(q), jnp.sin(q))


def test_the_gradient_of_a_hamiltonian_system_given_velocities():
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


def test_the_gradient_of_a_hamiltonian_system_on_a_group():
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


def test_the_gradient_of_an_initial_state_given_momenta():
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
def test_the_gradient_of_a_projected_initial_state(example):
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


def test_the_gradient_of_a_consistent_state_of_explicit_parts():
    # y0 by its parts, as they come from an earlier solution.
    system, y0, args = helpers.problem("driven")
    method = LobattoIIIAB(2, "propagated")

    def loss(y0):
        return scalar(
            nhjax.integrate(system, method, y0, dt=0.05, num_steps=STEPS, args=args).ys
        )

    assert_gradient(loss, y0, epsilon=1e-5)


# float32 ------------------------------------------------------------------------------


def test_single_precision():
    particle = systems.NonholonomicParticle()

    def loss(dt, dtype):
        y0 = particle.initial_state(dtype)
        sol = nhjax.integrate(particle.system, LobattoIIIAB(2), y0, dt=dt, num_steps=50)
        return jnp.sum(jnp.sin(sol.ys.q))

    single = jax.jit(jax.grad(loss), static_argnums=1)(jnp.float32(0.05), jnp.float32)
    double = jax.jit(jax.grad(loss), static_argnums=1)(0.05, jnp.float64)
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, double, rtol=1e-4)
