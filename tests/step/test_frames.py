"""Steps with the frames of poses have the same equations as steps without frames."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax._compile import as_cpu_kernel
from nhjax._manifold import unframed
from nhjax._step._equations import end_position, StageEquations
from nhjax._step._step import (
    equations_of_step,
    first_step_state,
    starting_values,
    StepArguments,
)
from support.group_problems import RETRACTIONS
from support.long import exhaustive, long


# A body in the plane, and a wheel on its axle.
INERTIA = jnp.array([[1.3, 0.1, 0.2, 0.0], [0.1, 1.1, 0.3, 0.1], [0.2, 0.3, 0.8, 0.2],
                     [0.0, 0.1, 0.2, 0.5]])  # fmt: skip


def potential(q):
    (x, y, angle), (wheel,) = q
    return x * jnp.cos(angle) + 0.5 * y**2 + jnp.sin(angle - wheel)


def metric(q):
    return INERTIA + 0.1 * jnp.cos(q[0][2]) * jnp.eye(4)


def lagrangian(t, q, v, args):
    return 0.5 * v @ metric(q) @ v - potential(q)


def hamiltonian(t, q, p, args):
    return 0.5 * p @ jnp.linalg.inv(metric(q)) @ p + potential(q)


def height(t, q, args):
    return q[0][1] + 0.3 * jnp.sin(q[0][2])


def blade(t, q, u, args):
    return u[0] * jnp.cos(q[1][0]) - u[3] + 0.2 * jnp.sin(q[0][2])


def push(t, q, v, args):
    return jnp.stack([jnp.sin(q[0][2]), q[0][0], -v[2], 0.3 * q[1][0]])


def body(form, retraction):
    group = nhjax.ProductGroup(nhjax.SE2(RETRACTIONS[retraction]), nhjax.Euclidean(1))
    if form == "lagrangian":
        system = nhjax.LagrangianSystem(
            lagrangian,
            manifold=group,
            holonomic=height,
            nonholonomic=blade,
            force=push,
        )
    else:
        system = nhjax.HamiltonianSystem(
            hamiltonian, manifold=group, holonomic=height, nonholonomic=blade
        )
    q = (jnp.array([0.5, 0.2, 0.8]), jnp.array([0.3]))
    u = jnp.array([0.4, 0.1, 0.6, 0.3])
    if form == "lagrangian":
        return system, nhjax.initial_state(system, q, v=u, project=True)
    return system, nhjax.initial_state(system, q, p=u, project=True)


@pytest.mark.parametrize(
    ("form", "retraction", "chart"),
    [
        ("lagrangian", "exponential", "start"),
        exhaustive("lagrangian", "cayley", "middle"),
        long("hamiltonian", "exponential", "start"),
        long("hamiltonian", "cayley", "middle"),
    ],
)
def test_group_step_equations_with_frames_equal_plain_positions(
    form, retraction, chart
):
    system, y0 = body(form, retraction)
    method, t = nhjax.LobattoIIIAB(3, chart=chart), jnp.asarray(0.0)
    given = first_step_state(system, method, t, y0, None)
    arguments = StepArguments(system, t, jnp.asarray(0.1), given, None)
    stages = equations_of_step(arguments, method)
    plain = replace(stages, system=system, q=unframed(stages.q))
    assert isinstance(plain, StageEquations)
    x = starting_values(stages, system.fibre_coordinate(y0), given.lin)
    key = jax.random.key(0)
    x = jax.tree.map(lambda z: z + 0.1 * jax.random.normal(key, z.shape), x)
    residual, _ = as_cpu_kernel(nhjax.stage_residual, stages, x)
    expected, _ = as_cpu_kernel(nhjax.stage_residual, plain, x)
    assert np.max(np.abs(expected)) > 0.1
    np.testing.assert_allclose(residual, expected, rtol=0, atol=2e-14)
    end, same = unframed(end_position(stages, x)), end_position(plain, x)
    for ours, theirs in zip(end, same, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-15)


class TurnsByHand(nhjax.SE2):
    """A user's group, whose methods accept only elements of three numbers."""

    def act(self, g, xi):
        return self.compose(g, self.retract(xi))

    def tangent(self, g, eta):
        cos, sin = jnp.cos(g[2]), jnp.sin(g[2])
        return jnp.stack(
            [cos * eta[0] - sin * eta[1], sin * eta[0] + cos * eta[1], eta[2]]
        )


class WithAMomentum(nhjax.LagrangianSystem):
    """A user's system, with a method that reads a position."""

    def momentum(self, t, q, u, args=None):
        return u * (1 + 0 * q[2])


@pytest.mark.parametrize("own", ["group", "system"])
def test_group_subclass_functions_with_frames_receive_plain_positions(own):
    kind = WithAMomentum if own == "system" else nhjax.LagrangianSystem

    def run(kind, group):
        system = kind(
            lambda t, q, v, args: 0.5 * v @ v - q[0] * jnp.sin(q[2]), manifold=group
        )
        start = jnp.array([0.3, 0.2, 0.5]), jnp.array([0.1, 0.4, 1.0])
        y0 = nhjax.initial_state(system, *start)
        method = nhjax.LobattoIIIAB(3)
        return nhjax.integrate(system, method, y0, dt=0.1, num_steps=5).ys.q

    found = run(kind, TurnsByHand() if own == "group" else nhjax.SE2())
    expected = run(nhjax.LagrangianSystem, nhjax.SE2())
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
