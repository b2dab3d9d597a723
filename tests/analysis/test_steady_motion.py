"""Steady motions compared with closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import SphericalPendulum
from support.polar_pendulum import GRAVITY, polar_pendulum


def test_steady_motion_of_a_pendulum_with_given_rate_is_its_cone():
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


def test_steady_motion_with_given_angle_or_momentum_is_the_cone():
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


def test_steady_motion_integrated_stays_steady():
    system = polar_pendulum()["lagrangian"]
    y = nhjax.initial_state(system, jnp.asarray([0.5, 0.2]), jnp.asarray([0.1, 4.0]))
    y = nhjax.steady_motion(system, 0.0, y, positions=(0,), velocities=(0, 1))
    run = nhjax.integrate(system, nhjax.LobattoIIIAB(3), y, dt=0.05, num_steps=100)
    np.testing.assert_allclose(run.ys.q[0, 0], y.q[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(run.ys.v[0], y.v, rtol=0, atol=1e-12)


def test_steady_motion_at_rest_on_a_constraint_or_group_is_found():
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


def test_steady_motion_at_rest_on_a_product_group_is_found():
    def lagrangian(t, q, v, args):
        return 0.5 * v @ v - jnp.sum(jnp.cosh(q[0] - 3.0)) - (q[1][0] + 2.0) ** 2

    system = nhjax.LagrangianSystem(
        lagrangian, manifold=nhjax.ProductGroup(nhjax.Euclidean(2), nhjax.Euclidean(1))
    )
    y0 = nhjax.initial_state(system, (jnp.array([2.5, 3.4]), -jnp.ones(1)), jnp.ones(3))
    y = nhjax.steady_motion(system, 0.0, y0, positions=(0, 1, 2), velocities=(0, 1, 2))
    np.testing.assert_allclose(jnp.concatenate(y.q), [3, 3, -2], rtol=0, atol=1e-13)
    np.testing.assert_allclose(y.v, 0, rtol=0, atol=1e-13)


def test_steady_motion_not_found_raises_with_the_last_state():
    # A pendulum that rotates slowly has no conical motion.
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


def test_steady_motion_with_wrong_arguments_raises_naming_them():
    system = polar_pendulum()["lagrangian"]
    y = nhjax.initial_state(system, jnp.asarray([0.5, 0.0]), jnp.asarray([0.0, 1.0]))
    with pytest.raises(ValueError, match="`held_velocities` has the index 2"):
        nhjax.steady_motion(
            system, 0.0, y, positions=(0,), velocities=(0,), held_velocities=(2,)
        )
    with pytest.raises(TypeError, match=r"`y` must be an nhjax\.State"):
        nhjax.steady_motion(system, 0.0, y.q, positions=(0,), velocities=(0,))  # pyright: ignore[reportArgumentType]


def force_of(q, args):
    return jnp.stack([args - q[0] ** 3, -q[1]])


FORCED = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * (v @ v), force=lambda t, q, v, args: force_of(q, args)
)


def test_steady_motion_second_derivatives_are_exact():
    def root(x):
        y = nhjax.initial_state(FORCED, jnp.ones(2), jnp.zeros(2), args=x)
        found = nhjax.steady_motion(
            FORCED, 0.0, y, x, positions=(0, 1), velocities=(0, 1)
        )
        return found.q[0]

    x = jnp.asarray(2.0)
    np.testing.assert_allclose(root(x), np.cbrt(2.0), rtol=1e-14)
    slope = np.cbrt(2.0) / 6
    np.testing.assert_allclose(jax.grad(root)(x), slope, rtol=1e-13)
    second = -np.cbrt(2.0) / 18
    np.testing.assert_allclose(jax.hessian(root)(x), second, rtol=1e-12)
    many = jax.jit(jax.vmap(root))(jnp.asarray([1.0, 2.0, 8.0]))
    np.testing.assert_allclose(many, [1.0, np.cbrt(2.0), 2.0], rtol=1e-13)


def test_steady_motion_started_at_rest_at_the_origin_is_found():
    def lagrangian(t, q, v, args):
        return 0.5 * (v @ v) - 1.5 * (q @ q) - 9.81 * q[0] - 0.1 * q[0] ** 4

    system = nhjax.LagrangianSystem(lagrangian)
    for dtype, tolerance in ((jnp.float64, 1e-13), (jnp.float32, 1e-5)):
        zero = jnp.zeros(2, dtype)
        y = nhjax.initial_state(system, zero, zero)
        found = nhjax.steady_motion(system, 0.0, y, positions=(0, 1), velocities=(0, 1))
        assert found.q.dtype == dtype
        force = jax.grad(lagrangian, argnums=1)(0.0, found.q, zero, None)
        np.testing.assert_allclose(force, 0, rtol=0, atol=10 * tolerance)


def test_steady_motion_without_equilibrium_raises():
    # The value of an ignorable coordinate must not affect the tolerance of a force.
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v),
        force=lambda t, q, v, args: jnp.stack([1.0 - q[0], 1.05 - q[0], 0 * q[0]]),
    )
    y = nhjax.initial_state(
        system,
        jnp.asarray([1.0, 0.0, 100.0], jnp.float32),
        jnp.zeros(3, jnp.float32),
    )
    with pytest.raises(nhjax.NewtonError, match=r"residual 0\.025"):
        nhjax.steady_motion(system, 0.0, y, positions=(0, 1), velocities=(0, 1))


@pytest.mark.parametrize("count", [0, 2.7, "x", True])
def test_steady_motion_with_invalid_max_iterations_raises(count):
    system = polar_pendulum()["lagrangian"]
    y = nhjax.initial_state(system, jnp.asarray([0.5, 0.0]), jnp.asarray([0.0, 1.0]))
    with pytest.raises(ValueError, match="`max_iterations` must be an int >= 1"):
        nhjax.steady_motion(
            system, 0.0, y, positions=(0,), velocities=(0,), max_iterations=count
        )


def test_steady_motion_with_a_state_of_another_system_raises():
    pendulum = SphericalPendulum().initial_state()
    many = jax.tree.map(lambda x: x[None], pendulum)
    system = polar_pendulum()["lagrangian"]
    with pytest.raises(nhjax.ShapeError, match=r"`y\.multiplier` has shape \(1,\)"):
        nhjax.motion(system, 0.0, pendulum)
    with pytest.raises(nhjax.ShapeError, match=r"use `jax\.vmap` over `t` and `y`"):
        nhjax.linear_stability(SphericalPendulum().system, 0.0, many)
