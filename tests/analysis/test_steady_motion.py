"""Steady motions against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import SphericalPendulum
from oracles.polar_pendulum import GRAVITY, polar_pendulum


def test_cone_of_a_pendulum_of_given_rate():
    system = polar_pendulum()["lagrangian"]

    def angle(rate):
        y = nhjax.initial_state(
            system, jnp.asarray([0.8, 0.2]), jnp.stack([0 * rate + 0.1, rate])
        )
        y = nhjax.steady_motion(
            system, 0.0, y, positions=(0,), velocities=(0, 1), held_velocities=(1,)
        )
        return y.q[0], y

    rate = jnp.asarray(4.0)
    (found, y), slope = jax.value_and_grad(angle, has_aux=True)(rate)
    expected = np.arccos(GRAVITY / 16)
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    # cos θ = g / ω²
    expected_slope = 2 * GRAVITY / 4.0**3 / np.sin(expected)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-13)
    np.testing.assert_allclose(y.v, [0, 4.0], rtol=0, atol=1e-14)
    np.testing.assert_allclose(y.q[1], 0.2, rtol=1e-15)


def test_cone_of_given_angle_and_of_given_momentum():
    forms = polar_pendulum()
    q = jnp.asarray([0.7, 0.0])
    rate = np.sqrt(GRAVITY / np.cos(0.7))
    y = nhjax.initial_state(forms["lagrangian"], q, jnp.asarray([0.0, 3.0]))
    found = nhjax.steady_motion(
        forms["lagrangian"],
        0.0,
        y,
        positions=(0,),
        velocities=(0, 1),
        held_positions=(0,),
    )
    np.testing.assert_allclose(found.v, [0, rate], rtol=0, atol=1e-14)
    momentum = np.sin(0.7) ** 2 * rate
    y = nhjax.initial_state(
        forms["hamiltonian"], jnp.asarray([0.6, 0.0]), p=jnp.asarray([0.1, momentum])
    )
    found = nhjax.steady_motion(
        forms["hamiltonian"],
        0.0,
        y,
        positions=(0,),
        velocities=(0, 1),
        held_velocities=(1,),
    )
    np.testing.assert_allclose(found.q, [0.7, 0], rtol=0, atol=1e-14)


def test_steady_motion_is_steady():
    system = polar_pendulum()["lagrangian"]
    y = nhjax.initial_state(system, jnp.asarray([0.5, 0.2]), jnp.asarray([0.1, 4.0]))
    y = nhjax.steady_motion(system, 0.0, y, positions=(0,), velocities=(0, 1))
    run = nhjax.integrate(system, nhjax.LobattoIIIAB(3), y, dt=0.05, num_steps=100)
    np.testing.assert_allclose(run.ys.q[0, 0], y.q[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(run.ys.v[0], y.v, rtol=0, atol=1e-12)


def test_equilibrium_on_a_constraint_and_on_a_group():
    pendulum = SphericalPendulum.swinging(0.4)
    y = nhjax.steady_motion(
        pendulum.system,
        0.0,
        pendulum.initial_state(),
        positions=(0, 1),
        velocities=(0, 1),
    )
    np.testing.assert_allclose(y.q, [0, 0, -1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(y.multiplier, [-0.5], rtol=0, atol=1e-13)
    top = nhjax.systems.HeavyTop()
    vertical = nhjax.steady_motion(
        top.system,
        0.0,
        nhjax.initial_state(top.system, top.q0, jnp.asarray([0.0, 0.0, 2.0])),
        positions=(0, 1),
        velocities=(0, 1),
        held_velocities=(2,),
    )
    axis = nhjax.SO3().matrix(vertical.q)[:, 2]
    np.testing.assert_allclose(jnp.abs(axis), [0, 0, 1], rtol=0, atol=1e-13)
    np.testing.assert_allclose(vertical.v, [0, 0, 2.0], rtol=0, atol=1e-13)


def test_a_search_that_fails_says_where_it_stopped():
    # A pendulum that turns slowly has no cone.
    system = polar_pendulum()["lagrangian"]
    y = nhjax.initial_state(system, jnp.asarray([0.5, 0.0]), jnp.asarray([0.0, 1.0]))
    with pytest.raises(nhjax.NewtonError, match=r"residual 4\.28"):
        nhjax.steady_motion(
            system,
            0.0,
            y,
            positions=(0,),
            velocities=(0,),
            held_positions=(0,),
            held_velocities=(1,),
        )


def test_wrong_arguments_are_named():
    system = polar_pendulum()["lagrangian"]
    y = nhjax.initial_state(system, jnp.asarray([0.5, 0.0]), jnp.asarray([0.0, 1.0]))
    with pytest.raises(ValueError, match="`held_velocities` has the index 2"):
        nhjax.steady_motion(
            system, 0.0, y, positions=(0,), velocities=(0,), held_velocities=(2,)
        )
    with pytest.raises(TypeError, match=r"`y` must be an nhjax\.State"):
        nhjax.steady_motion(system, 0.0, y.q, positions=(0,), velocities=(0,))  # pyright: ignore[reportArgumentType]
