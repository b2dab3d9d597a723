"""Chaplygin's sphere against Newton and Euler, and against his reduced equations."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax.systems import ChaplyginSphere
from support.flow import flow
from support.machines import accelerations, assert_orders, drifts, runs_of_three_stages
from support.rolling_bodies import (
    assert_newton_and_euler,
    errors_of,
    matrix_of,
    random_states,
    RollingBody,
    sphere,
)


SPHERES = {
    "default": ChaplyginSphere(),
    "small": ChaplyginSphere(1.6, 0.3, (0.05, 0.03, 0.07), 3.0),
}
DURATION, COUNTS = 2.0, (20, 40, 80)


def newton_euler(ball):
    radius, moments = float(ball.radius), np.asarray(ball.moments)
    shape = sphere(radius, np.zeros(3))
    return RollingBody(float(ball.mass), np.diag(moments), float(ball.gravity), shape)


def chaplygin(ball):
    """The field of (K, γ) in body axes, and ω as a function of these.

    K' = K × ω and γ' = γ × ω, where K = I ω + D (ω - (ω·γ) γ), D = m r², is solved for
    ω = A (K + z γ) with A = (I + D)⁻¹ and z = D (γ·A K)/(1 - D γ·A γ).
    """
    D = float(ball.mass * ball.radius**2)
    A = np.diag(1 / (np.asarray(ball.moments) + D))

    def velocity(K, up):
        return A @ (K + D * (up @ A @ K) / (1 - D * (up @ A @ up)) * up)

    def field(_, y):
        K, up = np.split(y, 2)
        omega = velocity(K, up)
        return np.concatenate([np.cross(K, omega), np.cross(up, omega)])

    return field, velocity


@pytest.fixture(scope="module")
def found():
    return runs_of_three_stages(SPHERES["default"], COUNTS, DURATION)


@pytest.mark.parametrize("ball", SPHERES.values(), ids=SPHERES)
def test_accelerations_and_forces_equal_newton_euler(ball):
    states = list(random_states(20, tilt=3.0))
    assert_newton_and_euler(ball, newton_euler(ball), states, accelerations)


@pytest.mark.long
def test_run_converges_with_method_order(found):
    ball = SPHERES["default"]
    start = np.asarray(ball.q0[:4]), np.asarray(ball.v0[3:])
    errors_at = errors_of(newton_euler(ball), start, DURATION, COUNTS[-1])
    assert_orders(found, 4, errors_at, floor=1e-11)


@pytest.mark.long
def test_run_converges_to_chaplygins_equations_with_method_order(found):
    ball = SPHERES["default"]
    field, velocity = chaplygin(ball)
    q0, v0 = ball.q0, ball.v0
    K0, up0 = ball.contact_momentum(q0, v0), matrix_of(q0[:4])[2]
    np.testing.assert_allclose(velocity(np.asarray(K0), up0), v0[3:], rtol=1e-14)

    def errors_at(t, y, _):
        K, up = np.split(flow(field, [*K0, *up0], t, start=0.0), 2, axis=1)
        omega = [velocity(*pair) for pair in zip(K, up, strict=True)]
        found = [matrix_of(quaternion)[2] for quaternion in y.q[:, :4]]
        return {"omega": y.v[:, 3:] - np.array(omega), "up": np.array(found) - up}

    assert_orders(found, 4, errors_at, floor=1e-11)


@pytest.mark.long
def test_constraints_hold_to_round_off_and_invariants_are_conserved(found):
    # Drifts of invariants of 2 to 14 SI units; the coarsest runs take four times the
    # duration.
    largest = (1e-5, 5e-7, 3e-8)
    assert np.max(found.violation) < 1e-13
    for name, drift in drifts(SPHERES["default"], found).items():
        assert np.all(drift < largest), (name, drift)


def test_invariants_are_constant_by_independent_equations():
    ball = SPHERES["small"].rolling((0.7, -0.3, 0.5, 0.4), (1.0, -2.0, 3.0))
    start = np.asarray(ball.q0[:4]), np.asarray(ball.v0[3:])
    first = ball.invariants(0.0, ball.q0, ball.v0)
    assert set(first) == {"energy", *(f"contact_momentum_{axis}" for axis in "xyz")}
    R, omega, _, _ = newton_euler(ball).trajectory(*start, (0, 0), [1.0, 3.0])
    m, r, moments = 1.6, 0.3, np.array([0.05, 0.03, 0.07])
    for rotation, w in zip(R, omega, strict=True):
        spin = rotation @ (moments * w)
        velocity = r * np.cross(rotation @ w, [0, 0, 1])
        momentum = spin + m * r * np.cross([0, 0, 1], velocity)
        energy = 0.5 * m * velocity @ velocity + 0.5 * moments @ w**2 + m * 3.0 * r
        assert energy == pytest.approx(float(first["energy"]), rel=1e-12)
        for axis, value in zip("xyz", momentum, strict=True):
            expected = float(first[f"contact_momentum_{axis}"])
            assert value == pytest.approx(expected, abs=1e-12)


def test_chaplygin_sphere_points_are_on_the_sphere_and_plane():
    ball = SPHERES["small"].rolling((0.7, -0.3, 0.5, 0.4), (1.0, 0.0, 0.0), (0.5, 0.2))
    points = ball.points(0.0, ball.q0)
    assert set(points) == {"centre", "contact", "pole_1", "pole_2", "pole_3"}
    np.testing.assert_allclose(points["contact"], [0.5, 0.2, 0], rtol=0, atol=1e-16)
    poles = np.stack(
        [points[f"pole_{k}"] - points["centre"] for k in (1, 2, 3)], axis=1
    )
    np.testing.assert_allclose(poles / 0.3, matrix_of(ball.q0[:4]), atol=1e-15)


def test_system_computes_in_precision_of_the_state():
    ball = SPHERES["default"]
    y0 = ball.initial_state(jnp.float32)
    assert y0.q.dtype == y0.v.dtype == y0.multiplier.dtype == jnp.float32
    for value in ball.invariants(jnp.float32(0.0), y0.q, y0.v).values():
        assert value.dtype == jnp.float32


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ChaplyginSphere(mass=0.0), r"`mass` must be positive, got 0"),
        (lambda: ChaplyginSphere(radius=-1.0), r"`radius` must be positive, got -1"),
        (lambda: ChaplyginSphere(moments=(1.0,)), r"`moments` must have shape \(3,\)"),
        (lambda: ChaplyginSphere(moments=(1.0, 0.0, 1.0)), r"`moments` must be pos"),
        (lambda: ChaplyginSphere(gravity=0.0), r"`gravity` must be positive, got 0"),
        (
            lambda: replace(ChaplyginSphere(), v0=jnp.ones(6)).initial_state(),
            "constraint",
        ),
    ],
)
def test_chaplygin_sphere_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
