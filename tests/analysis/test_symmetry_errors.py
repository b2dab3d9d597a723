"""Errors for generators that are not symmetries."""

import jax.numpy as jnp
import pytest

import nhjax
from nhjax.systems import HeavyTop, SphericalPendulum


AXIS = jnp.asarray([0.0, 0.0, 1.0])


def turn(q):
    return jnp.stack([-q[1], q[0], 0 * q[2]])


FREE = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * (v @ v))
PLANE = nhjax.State(
    jnp.asarray([0.0, 0.5]), jnp.asarray([1.0, 0.0]), jnp.asarray([1.0, 0.0]), AXIS[:0]
)


@pytest.mark.parametrize(
    ("symmetry", "message"),
    [
        (lambda q: jnp.eye(2)[1], "no combination .* the largest difference is 1 "),
        (lambda q: jnp.stack([jnp.eye(2)[0]] * 2), "are dependent at `y`"),
        (
            lambda q: jnp.stack([jnp.eye(2)[0], jnp.stack([-q[1], q[0]])]),
            "not closed: .* generator 1 leaves their span at the rate 1 ",
        ),
        (
            lambda q: jnp.stack([1 + (q[1] - 0.5) * q[0], 0 * q[0]]),
            "Generator 0 .* not a symmetry of the system: .* at the rate 2 ",
        ),
        (lambda q: jnp.ones(3), r"must return shape \(2,\) or \(k, 2\), .* \(3,\)"),
        (lambda q: "x", "got type str"),
        (jnp.ones(2), "must be a function of q"),
    ],
)
def test_symmetry_that_is_invalid_raises(symmetry, message):
    with pytest.raises((ValueError, TypeError), match=message):
        nhjax.linear_stability(FREE, 0.0, PLANE, symmetry=symmetry)


def test_symmetry_about_a_wrong_axis_of_the_body_raises():
    # All first derivatives equal those of a top with equal moments of inertia.
    top = HeavyTop(moments=(0.3, 0.31, 0.4))
    y = nhjax.initial_state(top.system, jnp.asarray([1.0, 0, 0, 0]), 4.0 * AXIS)
    with pytest.raises(ValueError, match=r"Generator 0 .* not a symmetry of the sys"):
        nhjax.linear_stability(top.system, 0.0, y, symmetry=lambda q: AXIS)


def test_symmetry_that_violates_constraints_raises():
    pendulum = SphericalPendulum(q0=(0.0, 0.0, -1.0), v0=(0.0, 0.0, 0.0))
    y = pendulum.initial_state()
    with pytest.raises(ValueError, match="violates them at the rate 2 "):
        nhjax.linear_stability(pendulum.system, 0.0, y, symmetry=lambda q: AXIS)


@pytest.mark.parametrize(
    "chosen", [{"positions": (0,), "velocities": (0, 1)}, {"must_be_steady": False}]
)
def test_symmetry_with_conflicting_arguments_raises(chosen):
    with pytest.raises(ValueError, match=r"Pass either `symmetry`|With `symmetry`"):
        nhjax.linear_stability(FREE, 0.0, PLANE, symmetry=turn, **chosen)
