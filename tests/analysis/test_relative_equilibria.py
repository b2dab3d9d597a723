"""Relative equilibria, found from states near them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import HeavyTop
from support.group_problems import both_forms


AXIS, SPACE = jnp.asarray([0.0, 0.0, 1.0]), nhjax.SO3()
# J₁ about the pivot, J₃ and m l of the top, and the angle of its axis to the vertical.
FIRST, THIRD, ARM, ANGLE = 0.55, 0.4, 0.5, 0.8
UPRIGHT = jnp.asarray([np.cos(ANGLE / 2), np.sin(ANGLE / 2), 0.0, 0.0])


def about_both(q):
    """The generators of rotations about the vertical and about the axis of the top."""
    return jnp.stack([SPACE.Ad(SPACE.inverse(q), AXIS), AXIS])


def precession(gravity, spin, guess):
    top = HeavyTop(gravity=gravity)
    v = guess * SPACE.Ad(SPACE.inverse(UPRIGHT), AXIS)
    y = nhjax.State(UPRIGHT, v.at[2].set(spin), v, AXIS[:0])
    y, rates = nhjax.steady_motion(
        top.system,
        0.0,
        y,
        symmetry=about_both,
        held_positions=(0, 1, 2),
        held_velocities=(2,),
    )
    return rates[0], (y, rates)


def test_steady_motion_of_a_top_has_slow_and_fast_precession():
    gravity, spin = 9.81, 30.0
    lean = FIRST * np.cos(ANGLE)
    slope = jax.value_and_grad(precession, argnums=(0, 1), has_aux=True)
    roots = np.roots([lean, -THIRD * spin, ARM * gravity])
    for guess, expected in zip((0.5, 20.0), sorted(roots), strict=True):
        # J₁ Ω² cos θ - J₃ ω₃ Ω + m g l = 0, and the spin is ω₃ - Ω cos θ.
        given = jnp.asarray(gravity), jnp.asarray(spin)
        (_, (y, rates)), found = slope(*given, guess)
        others = expected, spin - expected * np.cos(ANGLE)
        np.testing.assert_allclose(rates, others, rtol=1e-13)
        np.testing.assert_allclose(y.q, UPRIGHT, atol=1e-14)
        turning = expected * np.array([0.0, np.sin(ANGLE), np.cos(ANGLE)])
        turning[2] = spin
        np.testing.assert_allclose(y.v, turning, atol=1e-12)
        steep = 2 * lean * expected - THIRD * spin
        slopes = [-ARM / steep, THIRD * expected / steep]
        np.testing.assert_allclose(found, slopes, rtol=1e-11)


def turn(q):
    return jnp.stack([-q[1], q[0], 0 * q[2]])


@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_steady_motion_along_symmetry_at_given_height_is_the_cone(form):
    system = both_forms(
        lambda t, q: jnp.eye(3, dtype=q.dtype),
        lambda t, q: 9.81 * q[2],
        holonomic=lambda t, q, args: 0.5 * (q @ q - 1),
    )[form]
    q, u = jnp.asarray([0.6, 0.0, -0.8]), jnp.asarray([0.1, 3.0, 0.2])
    y, rates = nhjax.steady_motion(
        system,
        0.0,
        nhjax.State(q, u, u, AXIS[:1]),
        symmetry=turn,
        held_positions=(2,),
    )
    np.testing.assert_allclose(rates, [np.sqrt(9.81 / 0.8)], rtol=1e-13)
    np.testing.assert_allclose(np.hypot(*y.q[:2]), 0.6, rtol=1e-13)
    np.testing.assert_allclose(y.v, rates[0] * turn(y.q), atol=1e-13)
    np.testing.assert_allclose(y.multiplier, [-9.81 / 0.8], rtol=1e-13)


FREE = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * (v @ v))
TWICE = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * (v @ v),
    nonholonomic=lambda t, q, v, args: jnp.stack([v[1], 2 * v[1]]),
    constraints="redundant",
)
INDICES = {"positions": (0,), "velocities": (0,)}
ALONG = {"symmetry": lambda q: jnp.eye(2)[0]}


@pytest.mark.parametrize(
    ("chosen", "error", "message"),
    [
        (ALONG | INDICES, ValueError, "Pass either `symmetry`"),
        (ALONG | {"velocities": (0,)}, ValueError, "Pass either `symmetry`"),
        ({"velocities": (0,)}, ValueError, "`positions` is missing"),
        ({}, ValueError, "`positions` is missing: .* or pass `symmetry`"),
        ({"symmetry": jnp.ones(2)}, TypeError, "must be a function of q"),
        ({"symmetry": lambda q: jnp.ones(3)}, nhjax.ShapeError, r"got shape \(3,\)"),
        (ALONG | {"held_velocities": (1,)}, nhjax.NewtonError, "residual 0.5"),
        (
            {"symmetry": lambda q: jnp.stack([1 + (q[1] - 0.5) * q[0], 0 * q[0]])},
            ValueError,
            "Generator 0 .* not a symmetry of the system",
        ),
    ],
)
def test_steady_motion_along_invalid_symmetry_raises(chosen: Any, error, message):
    v = jnp.asarray([1.0, 0.5])
    y = nhjax.State(jnp.asarray([0.0, 0.5]), v, v, AXIS[:0])
    with pytest.raises(error, match=message):
        nhjax.steady_motion(FREE, 0.0, y, **chosen)


@pytest.mark.parametrize("function", [nhjax.steady_motion, nhjax.linear_stability])
def test_symmetry_with_redundant_constraints_raises(function):
    v = jnp.asarray([1.0, 0.0])
    y = nhjax.State(jnp.asarray([0.0, 0.5]), v, v, AXIS[:2])
    with pytest.raises(nhjax.DependentConstraintsError, match="cannot be checked"):
        function(TWICE, 0.0, y, **ALONG)
