"""The ball in a turning bowl against Newton and Euler in space."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nhjax.systems import BallInBowl, TurntableBall
from support.bowl import Bowl, UP
from support.machines import (
    accelerations,
    assert_orders,
    drifts,
    runs_of_three_stages,
    stack,
)
from support.rolling_bodies import matrix_of


TILTED = (0.7, -0.3, 0.5, np.sqrt(0.17))
BALLS = {
    "paraboloid": BallInBowl(),
    "sphere": BallInBowl.rolling(
        (0.2, -0.4),
        (0.7, 0.5),
        1.1,
        shape="sphere",
        mass=1.7,
        radius=0.15,
        inertia_ratio=2 / 3,
        curvature=1.2,
        rate=-2.0,
        gravity=3.0,
    ),
    "flat": BallInBowl.rolling((0.1, 0.2), (0.3, 0.4), curvature=0.0, rate=2.0),
}
DURATION, COUNTS = 1.0, (40, 80, 160)


def over(balls):
    return pytest.mark.parametrize("ball", balls.values(), ids=balls)


def newton_euler(ball):
    mass, radius = float(ball.mass), float(ball.radius)
    return Bowl(
        mass,
        radius,
        float(ball.inertia_ratio) * mass * radius**2,
        float(ball.curvature),
        float(ball.rate),
        float(ball.gravity),
        1.0 if ball.shape == "sphere" else 0.0,
    )


def start_of(ball):
    """(x, w, R) of the oracle at the initial data."""
    R = matrix_of(ball.q0[0])
    return np.asarray(ball.q0[1]), R @ np.asarray(ball.v0[:3]), R


@pytest.fixture(scope="module")
def found():
    return runs_of_three_stages(BALLS["paraboloid"], COUNTS, DURATION)


def random_balls(ball, number):
    """`ball` at random places, with random attitudes, velocities and spins."""
    rng = np.random.default_rng(5)
    numbers = (
        ball.mass,
        ball.radius,
        ball.inertia_ratio,
        ball.curvature,
        ball.rate,
        ball.gravity,
    )
    names = ("mass", "radius", "inertia_ratio", "curvature", "rate", "gravity")
    for _ in range(number):
        quaternion = rng.standard_normal(4)
        yield BallInBowl.rolling(
            jnp.asarray(rng.uniform(-0.5, 0.5, 2)),
            jnp.asarray(rng.standard_normal(2)),
            3 * rng.standard_normal(),
            shape=ball.shape,
            q0=(quaternion / np.linalg.norm(quaternion), np.zeros(3)),
            **dict(zip(names, numbers, strict=True)),
        )


@over(BALLS)
def test_accelerations_and_forces_equal_newton_euler(ball):
    oracle, balls = newton_euler(ball), list(random_balls(ball, 10))
    q, v = stack([(ball.q0, ball.v0) for ball in balls])
    slope, multiplier, violation = accelerations(ball.system, q, v)
    np.testing.assert_allclose(violation, 0.0, rtol=0, atol=1e-14)
    for k, one in enumerate(balls):
        x, w, R = start_of(one)
        np.testing.assert_allclose(one.v0[3:], oracle.velocity(x, w), atol=1e-14)
        x_ddot, w_dot, force = oracle.accelerations(x, w)
        # The body angular velocity changes as the one in space, seen in the body.
        expected = np.concatenate([R.T @ w_dot, x_ddot])
        scale = np.max(np.abs(expected))
        np.testing.assert_allclose(slope[k] / scale, expected / scale, atol=1e-11)
        wanted = oracle.multipliers(x, force)
        scale = np.max(np.abs(wanted))
        np.testing.assert_allclose(multiplier[k] / scale, wanted / scale, atol=1e-11)


@pytest.mark.long
def test_run_converges_with_method_order(found):
    ball = BALLS["paraboloid"]
    oracle = newton_euler(ball)
    times = DURATION * np.arange(1, COUNTS[-1] + 1) / COUNTS[-1]
    x, w, R = oracle.trajectory(*start_of(ball), times)
    states = list(zip(x, w, strict=True))
    velocity = np.array([oracle.velocity(*state) for state in states])
    forces = [oracle.accelerations(*state)[2] for state in states]
    multipliers = [oracle.multipliers(*pair) for pair in zip(x, forces, strict=True)]

    def errors_at(t, y, multiplier):
        nodes = slice(COUNTS[-1] // len(t) - 1, None, COUNTS[-1] // len(t))
        found = Rotation.from_quat(np.roll(y.q[0], -1, axis=1))
        return {
            "attitude": found.as_matrix() - R[nodes],
            "position": y.q[1] - x[nodes],
            "velocity": y.v[:, 3:] - velocity[nodes],
            "angular velocity": found.apply(y.v[:, :3].copy()) - w[nodes],
            "multiplier": multiplier - np.array(multipliers)[nodes],
        }

    assert_orders(found, 4, errors_at, floor=1e-11)


@pytest.mark.long
def test_constraints_hold_to_round_off_and_moving_energy_is_conserved(found):
    ball = BALLS["paraboloid"]
    # Drifts of an energy of 2 J; the coarsest runs take four times the duration.
    largest = (2e-6, 1e-7, 6e-9)
    assert np.max(found.violation) < 1e-13
    drift = drifts(ball, found)["moving_energy"]
    assert np.all(drift < largest), drift


@over(BALLS)
def test_invariants_are_constant_by_independent_equations(ball):
    moving = BallInBowl.rolling(
        (0.4, -0.2),
        (0.7, 0.9),
        2.0,
        **{
            name: getattr(ball, name)
            for name in ("mass", "radius", "curvature", "rate", "gravity", "shape")
        },
    )
    oracle, start = newton_euler(moving), start_of(moving)
    first = moving.invariants(0.0, moving.q0, moving.v0)
    assert len(first) == (3 if ball.shape == "sphere" else 1)
    x, w, R = oracle.trajectory(*start, [0.7, 2.0])
    energies = [float(moving.energy(0.0, moving.q0, moving.v0))]
    for centre, omega, attitude in zip(x, w, R, strict=True):
        quaternion = np.roll(Rotation.from_matrix(attitude).as_quat(), 1)
        q = (jnp.asarray(quaternion), jnp.asarray(centre))
        velocity = oracle.velocity(centre, omega)
        v = jnp.asarray(np.concatenate([attitude.T @ omega, velocity]))
        for name, value in moving.invariants(0.0, q, v).items():
            assert value == pytest.approx(float(first[name]), rel=1e-11), name
        energies.append(float(moving.energy(0.0, q, v)))
    assert np.ptp(energies) > 1e-3, "the bowl does no work"


def test_ball_in_flat_bowl_equals_ball_on_turntable():
    table = TurntableBall.rolling((0.4, -0.2), (0.7, 0.9), 2.0, radius=0.1, rate=1.3)
    ball = BallInBowl.rolling((0.4, -0.2), (0.7, 0.9), 2.0, curvature=0.0, rate=1.3)
    x, w, R = newton_euler(ball).trajectory(*start_of(ball), [1.5])
    (quaternion, position), v, _ = table.exact(1.5)
    np.testing.assert_allclose(x[0], [*position, 0.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(R[0], matrix_of(quaternion), rtol=0, atol=1e-11)
    np.testing.assert_allclose(R[0].T @ w[0], v[:3], rtol=0, atol=1e-10)
    np.testing.assert_allclose(ball.v0, jnp.insert(table.v0, 5, 0.0), atol=1e-15)


CIRCLING = {
    "paraboloid": BallInBowl.circling(0.4, 3.5),
    "sphere": BallInBowl.circling(
        0.4, -1.5, shape="sphere", rate=3.0, q0=(TILTED, (0.0, 0.0, 0.0))
    ),
}


@over(CIRCLING)
def test_accelerations_on_steady_circle_are_exact(ball):
    rate = float(ball.v0[4] / ball.q0[1][0])
    q, v = stack([(ball.q0, ball.v0)])
    slope, _, _ = accelerations(ball.system, q, v)
    # Everything turns about the vertical; ω is seen from the body.
    spinning = np.cross(rate * UP, start_of(ball)[1])
    expected = start_of(ball)[2].T @ spinning
    moving = np.cross(rate * UP, ball.v0[3:])
    np.testing.assert_allclose(slope[0, :3], expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(slope[0, 3:], moving, rtol=0, atol=1e-13)


@pytest.mark.long
def test_run_on_steady_circle_converges_with_method_order():
    ball = CIRCLING["paraboloid"]

    def errors_at(t, y, _):
        angle = 3.5 * t
        path = [0.4 * np.cos(angle), 0.4 * np.sin(angle), np.full_like(t, 0.12)]
        return {"position": y.q[1] - np.stack(path, axis=1)}

    found = runs_of_three_stages(ball, COUNTS, DURATION)
    assert_orders(found, 4, errors_at, floor=1e-12)


@pytest.mark.parametrize("shape", ["paraboloid", "sphere"])
def test_ball_on_small_circle_has_frequency_of_oscillations(shape):
    k, a, kappa, rate, g = 0.4, 0.1, 1.5, 1.0, 9.81
    frequency = 2.1
    ball = BallInBowl.circling(1e-5, frequency, shape=shape)
    spin = start_of(ball)[1][2]
    # From (1 + k) ζ'' - i k (Ω (1 + κ a) - κ a w₃) ζ' + g κ ζ = 0 for ζ = x + iy.
    terms = [1 + k, -k * (rate * (1 + kappa * a) - kappa * a * spin), -g * kappa]
    size = (1 + k) * frequency**2
    assert np.polyval(terms, frequency) == pytest.approx(0.0, abs=1e-8 * size)


def test_bowl_points_are_on_the_ball_and_on_the_bowl():
    ball = BALLS["paraboloid"]
    points = ball.points(0.0, ball.q0)
    assert set(points) == {"centre", "contact", "pole"}
    # The bowl has the slope 3/4 there.
    np.testing.assert_allclose(points["contact"], [0.56, 0, 0.1075], atol=1e-16)
    np.testing.assert_allclose(points["pole"], [0.5, 0, 0.2875], atol=1e-16)


def test_system_computes_in_precision_of_the_state():
    for ball in BALLS.values():
        y0 = ball.initial_state(jnp.float32)
        leaves = jax.tree.leaves((y0.q, y0.v, y0.multiplier))
        assert {leaf.dtype for leaf in leaves} == {jnp.dtype(jnp.float32)}
        for value in ball.invariants(jnp.float32(0.0), y0.q, y0.v).values():
            assert value.dtype == jnp.float32


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: BallInBowl(mass=0.0), r"`mass` must be positive, got 0"),
        (lambda: BallInBowl(radius=-1.0), r"`radius` must be positive, got -1"),
        (lambda: BallInBowl(inertia_ratio=0.0), r"`inertia_ratio` must be positive"),
        (lambda: BallInBowl(curvature=-1.0), r"`curvature` must not be negative"),
        (
            lambda: BallInBowl(shape="cone"),  # pyright: ignore[reportArgumentType]
            r"`shape` must be .* got 'cone'",
        ),
        (
            lambda: BallInBowl.rolling((0.7, 0.0), (0.0, 0.0), shape="sphere"),
            r"`position` must be nearer to the axis than the radius 0\.66",
        ),
        (lambda: BallInBowl.circling(0.0, 1.0), r"`radius_of_path` must be positive"),
        (lambda: BallInBowl.circling(0.1, 0.0), r"`path_rate` must be nonzero"),
        (
            lambda: BallInBowl.circling(0.1, 1.0, curvature=0.0),
            r"`curvature` must be nonzero",
        ),
        (lambda: BallInBowl(curvature=1.0).initial_state(), "constraint"),
        (
            lambda: replace(BallInBowl(), v0=jnp.ones(6)).initial_state(),
            "constraint",
        ),
    ],
)
def test_ball_in_bowl_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
