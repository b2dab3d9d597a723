"""The rolling torus and disc against Newton and Euler, and in steady motion."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nhjax.systems import RollingTorus
from support.machines import (
    accelerations,
    assert_orders,
    drifts,
    runs_of_three_stages,
    stack,
)
from support.rolling_bodies import (
    assert_newton_and_euler,
    errors_of,
    matrix_of,
    pose_and_twist,
    random_states,
    RollingBody,
    torus,
)


TYRE: dict[str, Any] = {
    "mass": 1.7,
    "radius": 0.4,
    "tube_radius": 0.06,
    "diametral_inertia": 0.15,
    "axial_inertia": 0.28,
}
BODIES = {"disc": RollingTorus(), "torus": RollingTorus(**TYRE)}
STEADY = {
    "disc": RollingTorus.circling(1.1, 0.8),
    "disc with its centre at rest": RollingTorus.circling(0.4, 0.0),
    "torus": RollingTorus.circling(1.2, 0.6, **TYRE),
    "torus that leans out": RollingTorus.steady(1.9, -0.7, **TYRE),
}
DURATION, COUNTS = 1.0, (40, 80, 160)


def over(bodies):
    return pytest.mark.parametrize("body", bodies.values(), ids=bodies)


def newton_euler(body):
    return RollingBody(
        float(body.mass),
        np.asarray(body.inertia),
        float(body.gravity),
        torus(float(body.radius), float(body.tube_radius)),
    )


@pytest.fixture(scope="module")
def tumbling():
    body = BODIES["torus"].rolling((0.8, 0.6, 0.0, 0.0), (0.2, 0.5, 4.0))
    return body, runs_of_three_stages(body, COUNTS, DURATION)


@over(BODIES)
def test_accelerations_and_forces_equal_newton_euler(body):
    oracle = newton_euler(body)
    # Attitudes around a disc that stands on its rim.
    upright = Rotation.from_rotvec([0.5 * np.pi, 0, 0])
    states = []
    for quaternion, omega, contact in random_states(20, tilt=1.2):
        turned = Rotation.from_quat(np.roll(quaternion, -1)) * upright
        states.append((np.roll(turned.as_quat(), 1), omega, contact))
    assert_newton_and_euler(body, oracle, states, accelerations)


def steady_rates(body):
    """(θ, Ω, rate of roll ψ̇, ω₃) of a body that starts in steady motion."""
    _, omega_2, omega_3 = np.asarray(body.v0[3:])
    tilt = 2 * np.arctan2(body.q0[1], body.q0[0])
    rate = omega_2 / np.sin(tilt)
    return tilt, rate, omega_3 - rate * np.cos(tilt), omega_3


@over(STEADY)
def test_accelerations_in_steady_motion_vanish(body):
    _, _, roll, _ = steady_rates(body)
    slope, multiplier, _ = accelerations(body.system, body.q0[None], body.v0[None])
    # In the frame that does not roll with the body.
    turning, v = np.array([0.0, 0.0, roll]), np.asarray(body.v0)
    in_frame = np.concatenate(
        [
            slope[0, :3] + np.cross(turning, v[:3]),
            slope[0, 3:] + np.cross(turning, v[3:]),
        ]
    )
    np.testing.assert_allclose(in_frame, 0.0, rtol=0, atol=2e-13)
    assert multiplier[0, 2] == pytest.approx(float(body.weight), rel=1e-13)


def on_the_circle(body, t):
    """(attitude, position, v, ω) in steady motion: a turn, then a roll on the axle."""
    tilt, rate, roll, _ = steady_rates(body)
    turn = Rotation.from_rotvec(np.outer(rate * t, [0, 0, 1]))
    spin = Rotation.from_rotvec(np.outer(roll * t, [0, 0, 1]))
    attitude = turn * Rotation.from_rotvec([tilt, 0, 0]) * spin
    v0, x0 = np.array(body.v0), np.array(body.q0[4:])
    # The centre starts at right angles to its velocity, which is along the first axis.
    middle = x0 + v0[0] / rate * np.array([0, 1, 0])
    return (
        attitude.as_matrix(),
        middle + turn.apply(x0 - middle),
        spin.inv().apply(v0[:3]),
        spin.inv().apply(v0[3:]),
    )


def errors_on_the_circle(body):
    def errors_at(t, y, multiplier):
        attitude, position, v, omega = on_the_circle(body, t)
        found = Rotation.from_quat(np.roll(y.q[:, :4], -1, axis=1)).as_matrix()
        return {
            "attitude": found - attitude,
            "position": y.q[:, 4:] - position,
            "velocity": y.v - np.concatenate([v, omega], axis=1),
        }

    return errors_at


@over(STEADY)
def test_steady_motion_solves_the_equations_of_newton_and_euler(body):
    start = np.asarray(body.q0[:4]), np.asarray(body.v0[3:])
    contact = np.asarray(body.contact_point(body.q0)[:2])
    times = np.linspace(0.1, 1.0, 4)
    # Some motions are unstable, so that the round-off of the start grows.
    R, omega, contact, _ = newton_euler(body).trajectory(*start, contact, times)
    attitude, _, _, spin = on_the_circle(body, times)
    np.testing.assert_allclose(R, attitude, rtol=0, atol=1e-10)
    np.testing.assert_allclose(omega, spin, rtol=0, atol=1e-10)


@pytest.mark.long
@pytest.mark.parametrize("name", ["disc", "torus"])
def test_run_on_steady_circle_converges_with_method_order(name):
    found = runs_of_three_stages(STEADY[name], COUNTS, DURATION)
    assert_orders(found, 4, errors_on_the_circle(STEADY[name]), floor=1e-12)


@pytest.mark.long
def test_run_converges_with_method_order(tumbling):
    body, found = tumbling
    start = np.asarray(body.q0[:4]), np.asarray(body.v0[3:])
    errors_at = errors_of(newton_euler(body), start, DURATION, COUNTS[-1])
    assert_orders(found, 4, errors_at, floor=1e-11)


@pytest.mark.long
def test_constraints_hold_to_round_off_and_energy_is_conserved(tumbling):
    body, found = tumbling
    # Drifts of an energy of 12 J; the coarsest runs take four times the duration.
    largest = (2e-5, 1e-6, 5e-8)
    assert np.max(found.violation) < 1e-13
    drift = drifts(body, found)["energy"]
    assert np.all(drift < largest), drift


def test_disc_with_centre_at_rest_has_moffatts_rate():
    tilt, radius, gravity = 0.3, 0.04, 9.81
    disc = RollingTorus.circling(
        tilt,
        0.0,
        radius=radius,
        diametral_inertia=0.25 * radius**2,
        axial_inertia=0.5 * radius**2,
    )
    _, rate, _, spin = steady_rates(disc)
    # The angle of the disc to the plane is that of the axle to the vertical.
    assert rate**2 == pytest.approx(4 * gravity / (radius * np.sin(tilt)), rel=1e-14)
    assert spin == pytest.approx(0.0, abs=1e-13 * rate)
    np.testing.assert_allclose(disc.v0[:3], 0.0, rtol=0, atol=1e-14)


def test_torus_centre_moves_on_the_given_circle():
    body = STEADY["torus"]
    _, rate, _, _ = steady_rates(body)
    assert jnp.linalg.norm(body.v0[:3]) == pytest.approx(0.6 * abs(rate), rel=1e-14)
    # It leans to the left, and turns to the left.
    assert body.v0[0] * rate > 0


@pytest.mark.parametrize("spin", [2.0, 6.0])
def test_upright_disc_oscillates_at_rouths_frequency(spin):
    disc = BODIES["disc"]
    m, a, g = 1.0, 0.5, 9.81
    I, J = 0.0625, 0.125
    oracle, e = newton_euler(disc), 1e-5
    # (lean, ω) in the frame that does not roll.
    base = np.array([0.0, 0.0, 0.0, spin])
    states = [base + sign * e * np.eye(4)[k] for k in range(4) for sign in (1, -1)]
    poses = []
    for lean, *omega in states:
        angle = 0.5 * (0.5 * np.pi + lean)
        quaternion = np.array([np.cos(angle), np.sin(angle), 0, 0])
        poses.append(pose_and_twist(oracle, quaternion, np.array(omega), (0.0, 0.0)))
    slope, _, _ = accelerations(disc.system, *stack(poses))
    rates = []
    for (lean, *omega), omega_dot in zip(states, slope[:, 3:], strict=True):
        # The turn rate is ω₂/cos(lean), and its part along the axle is not part of the
        # roll.
        roll = omega[2] + omega[1] * np.tan(lean)
        rates.append([omega[0], *(omega_dot + np.cross([0, 0, roll], omega))])
    rates = np.array(rates)
    jacobian = (rates[::2] - rates[1::2]).T / (2 * e)
    squares = np.sort((np.linalg.eigvals(jacobian) ** 2).real)
    expected = (m * g * a * I - J * (J + m * a**2) * spin**2) / (I * (I + m * a**2))
    extreme = squares[0] if expected < 0 else squares[-1]
    assert extreme == pytest.approx(expected, rel=1e-7)
    # A thin disc is stable where ω² > g/(3a): here beyond 2.557 1/s.
    assert (expected < 0) == (spin**2 > g / (3 * a))


def test_torus_points_are_on_the_body_and_on_the_plane():
    body = BODIES["torus"].rolling((0.5, 0.6, 0.3, 0.2), (0.0, 0.0, 1.0), (0.3, -0.2))
    points = body.points(0.0, body.q0)
    assert set(points) == {"centre", "contact", "rim"}
    np.testing.assert_allclose(points["contact"], [0.3, -0.2, 0], rtol=0, atol=1e-16)
    spoke = points["rim"] - points["centre"]
    assert jnp.linalg.norm(spoke) == pytest.approx(0.4, rel=1e-14)
    axle = matrix_of(body.q0[:4])[:, 2]
    assert abs(float(axle @ np.asarray(spoke))) < 1e-15


def test_system_computes_in_precision_of_the_state():
    body = BODIES["torus"].rolling((0.8, 0.6, 0.0, 0.0), (0.2, 0.5, 4.0))
    y0 = body.initial_state(jnp.float32)
    assert y0.q.dtype == y0.v.dtype == y0.multiplier.dtype == jnp.float32
    wide = body.initial_state()
    np.testing.assert_allclose(y0.multiplier, wide.multiplier, rtol=1e-4, atol=1e-4)


def test_steady_motion_is_differentiable_in_its_tilt():
    def turn_rate(tilt):
        body = RollingTorus.circling(tilt, 0.0)
        return body.v0[4] / jnp.sin(tilt)

    # The slope of Ω = √(4g/(a sin θ)).
    slope = jax.grad(turn_rate)(0.7)
    rate = np.sqrt(4 * 9.81 / (0.5 * np.sin(0.7)))
    assert slope == pytest.approx(-0.5 * rate / np.tan(0.7), rel=1e-13)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: RollingTorus(mass=0.0), r"`mass` must be positive, got 0"),
        (lambda: RollingTorus(radius=-1.0), r"`radius` must be positive, got -1"),
        (lambda: RollingTorus(tube_radius=-0.1), r"`tube_radius` must not be negative"),
        (lambda: RollingTorus(axial_inertia=0.0), r"`axial_inertia` must be positive"),
        (lambda: RollingTorus.steady(0.0, 1.0), r"`tilt` must lie between 0 and π, "),
        (lambda: RollingTorus.steady(1.0, 0.0), r"`turn_rate` must be nonzero"),
        (lambda: RollingTorus.circling(1.6, 1.0), r"`tilt` .* between 0 and π/2, got"),
        (lambda: RollingTorus.circling(1.0, -1.0), r"`radius_of_path` must not be neg"),
        (lambda: RollingTorus(radius=0.6).initial_state(), "constraint"),
    ],
)
def test_rolling_torus_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
