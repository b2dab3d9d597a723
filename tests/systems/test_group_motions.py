"""Systems of the gallery that move alike, or as the paper or a closed form says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from nhjax._manifold import SO3
from nhjax.systems import (
    ChaplyginSleigh,
    DoublePendulum,
    FreeRigidBody,
    HeavyTop,
    HeavyTopSE3,
    RodSleigh,
    RollingDisc,
    SphericalPendulum,
    Suslov,
    TurntableBall,
    Unicycle,
    UnicycleInCoordinates,
    Veselova,
)
from support.group_gallery import (
    assert_close,
    GALLERY,
    SOLVED,
    TILTED,
)
from support.group_oracle import (
    acceleration_and_multiplier,
    oracle,
    rotated,
)


def test_unicycle_on_the_group_equals_unicycle_in_coordinates():
    unicycle = Unicycle(1.3, 0.4, 2.0, q0=(0.3, -1.0, 2.0), v0=(-0.7, 0.0, 0.6))
    planar = unicycle.in_coordinates()
    assert_close(planar.on_group(), unicycle, rtol=0, atol=1e-15)
    q, v, multiplier = planar.exact(2.0)
    group_q, _, group_multiplier = unicycle.exact(2.0)
    np.testing.assert_allclose(q, group_q, rtol=0, atol=1e-14)
    np.testing.assert_allclose(multiplier, group_multiplier, rtol=0, atol=1e-14)
    values = planar.invariants(0.0, jnp.asarray(q), jnp.asarray(v))
    for name, value in unicycle.invariants(0.0, unicycle.q0, unicycle.v0).items():
        assert values[name] == pytest.approx(float(value), abs=1e-14)


def test_rolling_disc_on_the_group_equals_vertical_rolling_disc():
    disc = SOLVED["rolling disc wide"]
    q, v, multiplier = disc.in_coordinates().exact(1.7)
    (pose, roll), _, body_multiplier = disc.exact(1.7)
    np.testing.assert_allclose(q, [*pose[:2], *roll, pose[2]], rtol=0, atol=1e-15)
    np.testing.assert_allclose(np.hypot(v[0], v[1]), 1.8, rtol=1e-15)
    pull = np.hypot(*multiplier) * np.sign(disc.v0[0] * disc.v0[2])
    np.testing.assert_allclose(body_multiplier, [0.0, pull], rtol=0, atol=1e-14)


def test_ball_circling_the_origin_turns_in_closed_form():
    # For a circle about the origin R = exp(κt ê₃) exp(t (ω₀ - κ e₃)^) R₀.
    rate, moment, t = 1.2, 0.4, 2.3
    kappa = moment * rate / (1 + moment)
    ball = TurntableBall.rolling(
        (0.5, 0.3), (-0.3 * kappa, 0.5 * kappa), 0.7, rate=rate, q0=(TILTED, (0.0, 0.0))
    )
    omega = np.asarray(ball.rolling_velocity(ball.q0, ball.v0))
    axis = np.array([0.0, 0.0, kappa])
    turns = Rotation.from_rotvec(t * axis) * Rotation.from_rotvec(t * (omega - axis))
    expected = turns * Rotation.from_quat(np.roll(TILTED, -1))
    (quaternion, _), _, _ = ball.exact(t)
    matrix = SO3().matrix(jnp.asarray(quaternion))
    np.testing.assert_allclose(matrix, expected.as_matrix(), rtol=0, atol=1e-14)


@pytest.mark.parametrize("frame", ["space", "body"])
def test_homogeneous_ball_conserves_first_integrals_of_the_paper(frame):
    ball = TurntableBall.rolling((0.7, 0.1), (-0.3, 0.5), 0.4, frame=frame)
    a, r, rate = 0.4, 0.5, 1.2
    start = ball.first_integrals(ball.q0, ball.v0)
    q, v, _ = jax.tree.map(jnp.asarray, ball.exact(5.0))
    np.testing.assert_allclose(ball.first_integrals(q, v), start, rtol=0, atol=1e-14)
    x, y = q[1]
    xi, eta, zeta = ball.rolling_velocity(q, v)
    spin = 0.5 * a * r**2 * (xi**2 + eta**2 + zeta**2)
    papers = 0.5 * (v[3:] @ v[3:]) + spin + r * rate * (x * xi + y * eta)
    papers = papers - rate**2 * (x**2 + y**2)
    ours = ball.invariants(0.0, q, v)["moving_energy"]
    assert ours == pytest.approx(float(papers), abs=1e-14)


def test_contact_momentum_equals_first_integrals_of_the_paper():
    ball = SOLVED["ball tilted"]
    a, r = 0.4, 0.8
    spin, east, north = ball.first_integrals(ball.q0, ball.v0)
    values = ball.invariants(0.0, ball.q0, ball.v0)
    expected = [r * (1 + a) * east, r * (1 + a) * north, r**2 * a * spin]
    for axis, value in zip("xyz", expected, strict=True):
        name = f"contact_momentum_{axis}"
        assert values[name] == pytest.approx(float(value), abs=1e-14)


def test_ball_in_space_and_body_frame_differs_if_moments_differ():
    def end(moments, frame):
        ball = TurntableBall.rolling(
            (0.5, -0.2), (0.4, 0.3), 0.7, moments=moments, frame=frame
        )
        return oracle(ball, 2.0)[0][1]

    even, uneven = (0.4, 0.4, 0.4), (0.3, 0.4, 0.5)
    np.testing.assert_allclose(end(even, "space"), end(even, "body"), atol=1e-11)
    assert np.max(np.abs(end(uneven, "space") - end(uneven, "body"))) > 1e-2


def test_heavy_top_on_se3_moves_as_on_so3():
    on_so3, on_se3 = GALLERY["heavy top skew"], GALLERY["heavy top skew on SE(3)"]
    quaternion, omega, _, _ = oracle(on_so3, 2.0)
    pose, velocity, pivot_force, _ = oracle(on_se3, 2.0)
    np.testing.assert_allclose(pose[:4], quaternion, rtol=0, atol=1e-11)
    np.testing.assert_allclose(velocity[3:], omega, rtol=0, atol=1e-11)
    start, other = (top.invariants(0.0, top.q0, top.v0) for top in (on_so3, on_se3))
    for name, value in start.items():
        assert other[name] == pytest.approx(float(value), abs=1e-14)
    # Newton's law for the centre of mass: the pivot carries what gravity does not.
    q, v = pose, jnp.asarray(velocity)
    slope, _ = acceleration_and_multiplier(on_se3.system, q, v)
    acceleration = rotated(q[:4], slope[:3] + jnp.cross(v[3:], v[:3]))
    weight = jnp.array([0.0, 0.0, 1.3 * 2.0])
    np.testing.assert_allclose(
        pivot_force, 1.3 * acceleration + weight, rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("top", [HeavyTop(), HeavyTopSE3()])
def test_lagranges_top_conserves_its_axis_momentum(top):
    _, v, _, _ = oracle(top, 3.0)
    assert top.axis_momentum(v) == pytest.approx(float(top.axis_momentum(top.v0)))
    assert top.v0[-1] == pytest.approx(v[-1], abs=1e-11)


def test_heavy_top_defaults_on_so3_and_se3_agree():
    assert_close(HeavyTop().on_se3(), HeavyTopSE3(), rtol=0, atol=1e-16)


def test_double_pendulum_on_the_group_moves_as_in_angles():
    (m1, m2), (l1, l2), g = (1.0, 0.4), (0.8, 1.3), 2.0
    pendulum = GALLERY["double pendulum uneven"]

    def field(_, y):
        # Landau and Lifshitz, section 5, problem 1.
        (a, b), (da, db) = np.split(y, 2)
        c, s = np.cos(a - b), np.sin(a - b)
        mass = [[(m1 + m2) * l1, m2 * l2 * c], [l1 * c, l2]]
        force = [
            -m2 * l2 * s * db**2 - (m1 + m2) * g * np.sin(a),
            l1 * s * da**2 - g * np.sin(b),
        ]
        return np.concatenate([[da, db], np.linalg.solve(mass, force)])

    start = [1.0, -0.5, 0.3, 0.8]
    y = solve_ivp(field, (0, 2), start, method="DOP853", rtol=1e-13, atol=1e-13).y
    expected = DoublePendulum.swinging(
        y[:2, -1], y[2:, -1], masses=(m1, m2), lengths=(l1, l2), gravity=g
    )
    q, v, _, _ = oracle(pendulum, 2.0)
    np.testing.assert_allclose(q, expected.q0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(v, expected.v0, rtol=0, atol=1e-11)


def test_rod_sleigh_with_straight_blade_equals_chaplygin_sleigh():
    rod = SOLVED["rod sleigh straight blade"]
    sleigh = ChaplyginSleigh(1.5, 1.0 * 0.5 / 1.5, 0.5 / 1.5)
    q, v, multiplier = rod.exact(3.0)
    sleigh_q, sleigh_v, sleigh_multiplier = sleigh.exact(3.0)
    np.testing.assert_allclose(q[:2], sleigh_q[:2], rtol=0, atol=1e-15)
    np.testing.assert_allclose(v[:2], sleigh_v[:2], rtol=0, atol=1e-15)
    np.testing.assert_allclose(multiplier[0], sleigh_multiplier[0], rtol=1e-14)


def rod_sleigh_in_reduced_coordinates(sleigh, t):
    """(x₁, y₁, rod angle, speed along the blade, turn rate) of a `RodSleigh` at `t`."""
    m1, m2 = float(sleigh.mass1), float(sleigh.mass2)
    length, beta = float(sleigh.length), float(sleigh.angle)
    # The second mass in the frame of the blade.
    a, b = length * np.cos(beta), -length * np.sin(beta)
    mass = np.array(
        [[m1 + m2, -m2 * b], [-m2 * b, m2 * length**2]],
    )

    def field(_, y):
        heading, u, omega = y[2] + beta, y[3], y[4]
        force = [m2 * a * omega**2, -m2 * a * u * omega]
        rates = [u * np.cos(heading), u * np.sin(heading), omega]
        return np.concatenate([rates, np.linalg.solve(mass, force)])

    q0, v0 = np.asarray(sleigh.q0), np.asarray(sleigh.v0)
    rod = q0[2:] - q0[:2]
    angle = np.arctan2(rod[1], rod[0])
    along = np.array([np.cos(angle + beta), np.sin(angle + beta)])
    swing = v0[2:] - v0[:2]
    turn_rate = (rod[0] * swing[1] - rod[1] * swing[0]) / length**2
    start = [*q0[:2], angle, v0[:2] @ along, turn_rate]
    return solve_ivp(field, (0.0, t), start, method="DOP853", rtol=3e-14, atol=1e-14).y[
        :, -1
    ]


@pytest.mark.parametrize(
    "name", ["rod sleigh", "rod sleigh straight blade", "rod sleigh backwards"]
)
def test_rod_sleigh_moves_as_in_reduced_coordinates(name):
    sleigh = SOLVED[name]
    x, y, angle, speed, turn_rate = rod_sleigh_in_reduced_coordinates(sleigh, 3.0)
    expected = RodSleigh.sliding(
        speed,
        turn_rate,
        (x, y),
        angle,
        mass1=sleigh.mass1,
        mass2=sleigh.mass2,
        length=sleigh.length,
        angle=sleigh.angle,
    )
    q, v, _ = sleigh.exact(3.0)
    np.testing.assert_allclose(q, expected.q0, rtol=0, atol=1e-11)
    np.testing.assert_allclose(v, expected.v0, rtol=0, atol=1e-11)


def test_suslov_ends_in_a_steady_rotation():
    suslov = Suslov()
    _, v, multiplier = suslov.exact(100.0)
    assert suslov.energy(0.0, suslov.q0, jnp.asarray(v)) == pytest.approx(
        float(suslov.energy(0.0, suslov.q0, suslov.v0)), rel=1e-14
    )
    # The momentum along e₃ vanishes there, so that nothing turns ω.
    assert 0.3 * v[0] - 0.2 * v[1] == pytest.approx(0.0, abs=1e-14)
    assert multiplier[0] == pytest.approx(-(1.0 - 1.5) * v[0] * v[1], rel=1e-13)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Unicycle(spring=0.0), r"`spring` must be positive, got 0"),
        (lambda: UnicycleInCoordinates(mass=-1.0), r"`mass` must be positive"),
        (lambda: TurntableBall(radius=0.0), r"`radius` must be positive, got 0"),
        (
            lambda: TurntableBall(moments=(0.4, 0.4)),
            r"`moments` must have shape \(3,\)",
        ),
        (
            lambda: TurntableBall(frame="lab"),  # pyright: ignore[reportArgumentType]
            r"`frame` must be .* got 'lab'",
        ),
        (lambda: Veselova(inertia=(1.0, 2.0, 3.0)), r"`inertia` must have shape"),
        (lambda: Veselova(-jnp.eye(3)), r"`inertia` must be symmetric and positive"),
        (lambda: Suslov(moments=(1.0, 0.0, 1.0)), r"`moments` must be positive"),
        (lambda: Suslov(products=(2.0, 0.0)), r"`products` are too large"),
        (lambda: RollingDisc(radius=0.0), r"`radius` must be positive, got 0"),
        (lambda: FreeRigidBody((1.0, 2.0)), r"`moments` must have shape \(3,\)"),
        (lambda: HeavyTop(centre=(0.0,)), r"`centre` must have shape \(3,\)"),
        (lambda: HeavyTopSE3(mass=0.0), r"`mass` must be positive, got 0"),
        (lambda: SphericalPendulum(length=-1.0), r"`length` must be positive, got -1"),
        (lambda: DoublePendulum(masses=(1.0,)), r"`masses` must have shape \(2,\)"),
        (lambda: RodSleigh(mass2=0.0), r"`mass2` must be positive, got 0"),
    ],
)
def test_group_system_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()


@pytest.mark.parametrize(
    ("example", "message"),
    [
        (Unicycle(v0=(0.5, 0.1, 0.8)), r"`v0` violates the constraint"),
        (UnicycleInCoordinates(v0=(0.5, 0.9, 0.8)), r"`v0` violates the constraint"),
        (TurntableBall(moments=(0.3, 0.4, 0.4)), r"`moments` must be equal"),
        (TurntableBall.rolling((0, 0), (1, 0), rate=0.0), r"`rate` must be nonzero"),
        (Suslov(products=(0.0, 0.0)), r"`products` must not both be 0"),
        (RollingDisc(v0=(1.3, 0.0, 0.0, 1.3)), r"`v0\[2\]` must be nonzero"),
        (SphericalPendulum(q0=(0.6, 0.0, -0.9)), r"`q0` violates the constraint"),
        (SphericalPendulum(v0=(0.6, 0.0, -0.9)), r"`v0` violates the constraint"),
        (RodSleigh(length=1.1), r"`q0` violates the constraint"),
        (RodSleigh.sliding(1.0, 0.0), r"`v0` must turn the rod"),
        (RodSleigh.sliding(1.0, 1.0, angle=np.pi / 2), r"`angle` must not be a right"),
    ],
)
def test_exact_solution_of_unsupported_data_raises(example, message):
    with pytest.raises(ValueError, match=message):
        example.exact(1.0)
