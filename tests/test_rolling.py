"""Rolling contacts from parts, against constraints that are written by hand."""

from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.optimize

import nhjax
from nhjax import rolling
from nhjax.systems import _whipple_bicycle as bicycle_parts
from nhjax.systems._frames import about_y, about_z


RNG = np.random.default_rng(3)
SE3, SO3 = nhjax.SE3(), nhjax.SO3()


def _free_body(t, q, args):
    """The pose of a body on SE(3), whose element is a quaternion and a position."""
    return q[4:], SO3.matrix(q[:4])


def _assert_same_motion(hand_written, from_parts, q, v):
    """Both systems accept a state and give it the same acceleration."""
    found = []
    for system in (hand_written, from_parts):
        y = nhjax.initial_state(system, q, v)
        found.append(nhjax.motion(system, 0.0, y).acceleration)
    scale = np.abs(found[0]).max()
    np.testing.assert_allclose(found[1], found[0], atol=1e-12 * max(scale, 1.0))


def _replaced(system, contacts, **others):
    return nhjax.LagrangianSystem(
        system.lagrangian,
        nonholonomic=contacts.nonholonomic,
        holonomic=contacts.holonomic,
        force=system.force,
        manifold=system.manifold,
        **others,
    )


# --- The gallery from parts ----------------------------------------------------------


@pytest.mark.parametrize("tube_radius", [0.0, 0.1])
def test_torus_from_parts_moves_like_that_of_the_gallery(tube_radius):
    torus = nhjax.systems.RollingTorus.circling(
        tilt=1.1, radius_of_path=0.4, radius=0.3, tube_radius=tube_radius
    )
    wheel = rolling.Wheel(
        _free_body, 0.3, tube_radius=tube_radius, axle=(0, 0, 1), manifold=SE3
    )
    contacts = rolling.Contacts(torus=wheel)
    system = _replaced(torus.system, contacts)
    _assert_same_motion(torus.system, system, torus.q0, torus.v0)
    y, by_hand = nhjax.initial_state(system, torus.q0, torus.v0), torus.initial_state()
    np.testing.assert_allclose(
        contacts.forces(0.0, y)["torus"], by_hand.multiplier, atol=1e-11
    )
    np.testing.assert_allclose(
        contacts.points(0.0, torus.q0)["torus"],
        torus.points(0.0, torus.q0)["contact"],
        atol=1e-15,
    )


def test_rattleback_from_parts_moves_like_that_of_the_gallery():
    stone = nhjax.systems.Rattleback.spinning(5.0, (0.3, -0.2))

    def pose(t, q, args):
        rotation = SO3.matrix(q[:4])
        return q[4:] + stone.depth * rotation[:, 2], rotation

    contacts = rolling.Contacts(
        stone=rolling.Ellipsoid(pose, stone.semiaxes, manifold=SE3)
    )
    system = _replaced(stone.system, contacts)
    _assert_same_motion(stone.system, system, stone.q0, stone.v0)
    y = nhjax.initial_state(system, stone.q0, stone.v0)
    # Both use the directions x and y of the plane, so that the multipliers agree.
    expected = stone.initial_state().multiplier
    np.testing.assert_allclose(y.multiplier, expected, atol=1e-11)
    np.testing.assert_allclose(contacts.forces(0.0, y)["stone"], expected, atol=1e-11)


def test_ball_on_turntable_from_parts_moves_like_that_of_the_gallery():
    ball = nhjax.systems.TurntableBall(moments=(0.3, 0.4, 0.5))

    def pose(t, q, args):
        return jnp.append(q[1], ball.radius), SO3.matrix(q[0])

    table = rolling.Plane(
        velocity=lambda t, x, args: ball.rate * jnp.stack([-x[1], x[0], 0.0 * x[2]])
    )
    contact = rolling.Ellipsoid(
        pose, ball.radius, touches=False, ground=table, manifold=ball.manifold
    )
    contacts = rolling.Contacts(ball=contact)
    assert contacts.holonomic is None
    y0 = ball.initial_state()
    _assert_same_motion(ball.system, _replaced(ball.system, contacts), y0.q, y0.v)


def test_robot_from_parts_moves_like_that_of_the_gallery():
    robot = nhjax.systems.TwoWheeledRobot.rolling(speed=1.0, turn_rate=0.7)

    def wheel(number, side, no_slip):
        def pose(t, q, args):
            turned = about_z(q[2])
            hub = jnp.append(q[:2], robot.radius)
            hub = hub + robot.half_track * side * turned[:, 1]
            return hub, turned @ about_y(q[number])

        return rolling.Wheel(pose, robot.radius, no_slip=no_slip, touches=False)

    contacts = rolling.Contacts(
        right=wheel(3, -1.0, ("across", "along")), left=wheel(4, 1.0, ("along",))
    )
    system = _replaced(robot.system, contacts)
    _assert_same_motion(robot.system, system, robot.q0, robot.v0)
    y = nhjax.initial_state(system, robot.q0, robot.v0)
    expected = robot.initial_state().multiplier
    np.testing.assert_allclose(y.multiplier, expected, atol=1e-12)


def test_bicycle_from_parts_moves_like_that_of_the_gallery():
    bicycle = nhjax.systems.WhippleBicycle.running(5.0, 0.4, 0.2, lean=0.1, steer=0.05)

    def wheel(number, touches):
        def pose(t, q, args):
            frame = bicycle_parts._frames(bicycle, q)[number]
            hub = bicycle_parts._wheels(bicycle, q)[number].hub
            return frame.move(hub), frame.rotation @ about_y(q[6 + number])

        radius = (bicycle.rear_radius, bicycle.front_radius)[number]
        ground = rolling.Plane((0.0, 0.0, -1.0))  # The third axis points down.
        return rolling.Wheel(pose, radius, ground=ground, touches=touches)

    # The coordinates put the rear wheel on the ground.
    contacts = rolling.Contacts(rear=wheel(0, False), front=wheel(1, True))
    system = _replaced(bicycle.system, contacts)
    _assert_same_motion(bicycle.system, system, bicycle.q0, bicycle.v0)


def test_sleigh_with_a_blade_keeps_the_closed_form():
    def pose(t, q, args):
        return jnp.append(q[:2], 0.0), about_z(q[2])

    contacts = rolling.Contacts(blade=rolling.Blade(pose, touches=False))
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v, nonholonomic=contacts.nonholonomic
    )
    y0 = nhjax.initial_state(system, jnp.zeros(3), jnp.array([2.0, 0.0, 1.5]))
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(4), y0, dt=0.02, num_steps=50)
    # The blade goes round a circle at constant rates; λ = m u w.
    exact = np.array([2 * np.sin(1.5) / 1.5, 2 * (1 - np.cos(1.5)) / 1.5, 1.5])
    np.testing.assert_allclose(sol.ys.q[-1], exact, atol=1e-11)
    np.testing.assert_allclose(sol.ys.multiplier[-1], [3.0], atol=1e-9)


# --- Curved ground -----------------------------------------------------------------


def _gallery_bowl():
    ball = nhjax.systems.BallInBowl.rolling((0.5, 0.1), (0.2, 1.2), 2.0, shape="sphere")
    centre = 1 / float(ball.curvature)
    radius = centre + float(ball.radius)

    def elevation(x, args):
        return centre - jnp.sqrt(radius**2 - x @ x)

    def turning(t, x, args):
        return ball.rate * jnp.stack([-x[1], x[0], 0.0 * x[2]])

    return ball, elevation, turning


def _ball_on(ball, ground):
    def pose(t, q, args):
        return q[1], SO3.matrix(q[0])

    contact = rolling.Ellipsoid(
        pose, ball.radius, ground=ground, manifold=ball.manifold
    )
    return rolling.Contacts(ball=contact)


def test_ball_in_a_bowl_from_parts_moves_like_that_of_the_gallery():
    ball, elevation, turning = _gallery_bowl()
    contacts = _ball_on(ball, rolling.Surface(elevation, velocity=turning))
    system = _replaced(ball.system, contacts)
    _assert_same_motion(ball.system, system, ball.q0, ball.v0)
    y, by_hand = nhjax.initial_state(system, ball.q0, ball.v0), ball.initial_state()
    slope = ball.bowl.slope(ball.q0[1])
    multipliers = by_hand.multiplier
    force = jnp.append(multipliers[:2], 0.0) + multipliers[2] * slope
    np.testing.assert_allclose(contacts.forces(0.0, y)["ball"], force, atol=1e-11)


@pytest.mark.parametrize("s", [2, 3])
def test_run_on_a_curved_ground_has_the_order_of_the_method(s):
    ball, elevation, turning = _gallery_bowl()
    ground = rolling.Surface(elevation, velocity=turning)
    system = _replaced(ball.system, _ball_on(ball, ground))
    exact = nhjax.integrate(
        ball.system,
        nhjax.LobattoIIIAB(5),
        ball.initial_state(),
        dt=0.0125,
        num_steps=32,
    )
    errors = []
    for num_steps in (16, 32):
        y0 = nhjax.initial_state(system, ball.q0, ball.v0)
        method = nhjax.LobattoIIIAB(s)
        dt = 0.4 / num_steps
        sol = nhjax.integrate(system, method, y0, dt=dt, num_steps=num_steps)
        assert sol.stats["max_constraint_violation"] < 1e-13
        moved = sol.ys.q[1][-1] - exact.ys.q[1][-1]
        errors.append(np.abs(moved).max())
    np.testing.assert_allclose(np.log2(errors[0] / errors[1]), method.order, atol=0.3)


def test_height_of_an_ellipsoid_over_a_hill_equals_the_smallest_distance():
    semi_axes = np.array([0.3, 0.2, 0.1])

    def elevation(x, args):
        return args * jnp.sin(1.5 * x[0]) * jnp.cos(x[1])

    egg = rolling.Ellipsoid(
        _free_body, semi_axes, ground=rolling.Surface(elevation), manifold=SE3
    )
    for _ in range(3):
        q = jnp.concatenate([SO3.identity(), jnp.asarray(RNG.uniform(-1, 1, 3))])
        q = SE3.act(q, jnp.asarray(RNG.normal(size=6)))
        q = q.at[6].set(1.2)

        @jax.jit
        @jax.value_and_grad
        def distance(z, q=q):
            a, b = z[:2]
            direction = [jnp.cos(a) * jnp.cos(b), jnp.sin(a) * jnp.cos(b), jnp.sin(b)]
            place = q[4:] + SO3.matrix(q[:4]) @ (semi_axes * jnp.stack(direction))
            return jnp.sum((place - jnp.append(z[2:], elevation(z[2:], 0.3))) ** 2)

        found = min(
            scipy.optimize.minimize(
                distance, [a, -0.5, q[4], q[5]], jac=True, tol=1e-12
            ).fun
            for a in (0.0, 2.0, 4.0)
        )
        height = float(egg.height(0.0, q, 0.3))
        np.testing.assert_allclose(height, np.sqrt(found), rtol=1e-7)


def test_ball_of_rubber_moves_as_in_the_reduced_equations():
    radius, mass, moments = 0.3, 1.3, np.array([0.02, 0.03, 0.045])
    ball = rolling.Ellipsoid(
        _free_body, radius, no_slip=("along", "across", "spin"), manifold=SE3
    )
    contacts = rolling.Contacts(ball=ball)
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (mass * v[:3] @ v[:3] + v[3:] @ (moments * v[3:])),
        nonholonomic=contacts.nonholonomic,
        holonomic=contacts.holonomic,
        manifold=SE3,
    )
    attitude = jnp.array([0.8, 0.1, -0.5, np.sqrt(0.1)])
    up = np.asarray(SO3.matrix(attitude))[2]
    omega = np.cross(up, [1.0, -0.4, 2.0])
    q0 = jnp.concatenate([attitude, jnp.array([0.0, 0.0, radius])])
    velocity = radius * np.cross(omega, up)
    y0 = nhjax.initial_state(system, q0, jnp.concatenate([velocity, omega]))
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(5), y0, dt=0.02, num_steps=100)

    # With D = m a², I = J + D and ω·γ = 0 they are I ω' = I ω × ω + μ γ, γ' = γ × ω:
    # Borisov and Mamaev, The rolling of a rubber ball (2007).
    inertia = moments + mass * radius**2

    def rates(t, y):
        omega, up = y[:3], y[3:]
        torque = np.cross(inertia * omega, omega)
        mu = -(up @ (torque / inertia)) / (up @ (up / inertia))
        return np.append((torque + mu * up) / inertia, np.cross(up, omega))

    exact = scipy.integrate.solve_ivp(
        rates, (0, 2), np.append(omega, up), "DOP853", rtol=1e-13, atol=1e-13
    )
    np.testing.assert_allclose(sol.ys.v[-1, 3:], exact.y[:3, -1], atol=1e-10)
    end = SO3.matrix(sol.ys.q[-1, :4])[2]
    np.testing.assert_allclose(end, exact.y[3:, -1], atol=1e-10)
    assert contacts.multiplier_names[2] == "ball spin"
    # The torque of the ground about the normal.
    w, n = exact.y[:3, -1], exact.y[3:, -1]
    torque = np.cross(inertia * w, w)
    mu = -(n @ (torque / inertia)) / (n @ (n / inertia))
    np.testing.assert_allclose(sol.ys.multiplier[-1, 2], mu, atol=1e-9)


def test_ball_that_does_not_spin_turns_with_its_turntable():
    rate = 2.5
    ground = rolling.Plane(
        velocity=lambda t, x, args: rate * jnp.stack([-x[1], x[0], 0.0 * x[2]])
    )
    ball = rolling.Ellipsoid(
        _free_body, 0.3, no_slip=("spin",), ground=ground, manifold=SE3
    )
    q = jnp.array([1.0, 0.0, 0.0, 0.0, 0.7, 0.2, 0.3])
    v = jnp.array([0.0, 0.0, 0.0, 0.4, 0.1, 3.0])
    assert float(ball.slip(0.0, q, v)[0]) == pytest.approx(3.0 - rate, abs=1e-15)


def test_heightfield_passes_through_its_heights_with_continuous_curvature():
    heights = RNG.normal(size=(7, 5))
    ground = rolling.Heightfield(heights, 0.5, (-1.0, 2.0))
    for i in range(7):
        for j in range(5):
            x = jnp.array([-1.0 + 0.5 * i, 2.0 + 0.5 * j])
            np.testing.assert_allclose(ground(x), heights[i, j], atol=1e-12)
    curvature = jax.hessian(ground)
    for point in ([0.0, 2.7], [-0.2, 3.0]):
        x, e = jnp.array(point), 1e-9
        np.testing.assert_allclose(curvature(x - e), curvature(x + e), atol=1e-5)


@pytest.mark.parametrize("shape", [(4, 4), (20, 7)])
def test_heightfield_of_an_inclined_plane_is_a_plane(shape):
    i, j = np.indices(shape)
    field = rolling.Heightfield(0.3 * i + 0.2 * j, 1.0)
    for x in ((0.5, 0.5), (1.7, 2.9), (0.0, 0.0), (-0.7, 1.2)):
        height, slope = jax.value_and_grad(field)(jnp.asarray(x))
        assert float(height) == pytest.approx(0.3 * x[0] + 0.2 * x[1], abs=1e-13)
        np.testing.assert_allclose(slope, [0.3, 0.2], atol=1e-13)


def test_ball_on_a_heightfield_moves_like_on_the_surface_that_it_samples():
    ball, elevation, _ = _gallery_bowl()
    x = np.linspace(-0.64, 0.64, 129)
    places = jnp.asarray(np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1))
    heights = jax.vmap(jax.vmap(lambda x: elevation(0.8 * x, None)))(places)
    sampled = rolling.Heightfield(heights, x[1] - x[0], (x[0], x[0]))
    found = []
    for function in (sampled, lambda x, args: elevation(0.8 * x, None)):
        contacts = _ball_on(ball, rolling.Surface(function))
        system = _replaced(ball.system, contacts)
        q = (ball.q0[0], jnp.array([0.3, 0.1, 0.3]))
        y = nhjax.initial_state(system, q, ball.v0, project=True)
        found.append(nhjax.motion(system, 0.0, y).acceleration)
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)
    assert np.abs(found[1]).max() > 1


# --- New machines ------------------------------------------------------------------


@pytest.mark.parametrize("s", [2, 3])
def test_ball_on_an_incline_rolls_as_in_the_closed_form(s):
    slope, r, g = 0.3, 0.2, 9.81
    normal = np.array([np.sin(slope), 0.0, np.cos(slope)])
    downhill = np.array([np.cos(slope), 0.0, -np.sin(slope)])
    ball = rolling.Ellipsoid(
        _free_body, r, ground=rolling.Plane(normal, height=0.7), manifold=SE3
    )
    contacts = rolling.Contacts(ball=ball)

    def lagrangian(t, q, v, args):
        return 0.5 * v[:3] @ v[:3] + 0.2 * r**2 * v[3:] @ v[3:] - g * q[6]

    system = nhjax.LagrangianSystem(
        lagrangian,
        nonholonomic=contacts.nonholonomic,
        holonomic=contacts.holonomic,
        manifold=SE3,
    )
    # It starts with a spin about the normal, which it keeps.
    start = jnp.concatenate([SO3.identity(), (0.7 + r) * normal])
    v0 = jnp.concatenate([jnp.zeros(3), 2.0 * normal])
    y0 = nhjax.initial_state(system, start, v0)
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(s), y0, dt=0.01, num_steps=50)
    y = jax.tree.map(lambda x: x[-1], sol.ys)
    acceleration = 5 / 7 * g * np.sin(slope)
    moved = 0.5 * acceleration * 0.5**2 * downhill
    np.testing.assert_allclose(
        y.q[4:] - start[4:], moved, atol=1e-4 if s == 2 else 1e-7
    )
    assert sol.stats["max_constraint_violation"] < 1e-14
    force = contacts.forces(0.5, y)["ball"]
    expected = g * np.cos(slope) * normal - 2 / 7 * g * np.sin(slope) * downhill
    np.testing.assert_allclose(force, expected, atol=1e-3 if s == 2 else 1e-6)


def _mecanum(radius=0.05, length=0.2, width=0.15):
    """Four mecanum wheels on a platform, q = (x, y, heading, four turns)."""

    def wheel(number, ahead, left, angle):
        def pose(t, q, args):
            turned = about_z(q[2])
            place = jnp.asarray([ahead, left, radius], q.dtype)
            return jnp.append(q[:2], 0.0) + turned @ place, turned @ about_y(q[number])

        return rolling.Wheel(pose, radius, no_slip=(angle,), touches=False)

    corners = [(1, 1, -1), (1, -1, 1), (-1, 1, 1), (-1, -1, -1)]
    contacts = rolling.Contacts(
        **{
            f"wheel_{k}": wheel(3 + k, a * length, b * width, c * np.pi / 4)
            for k, (a, b, c) in enumerate(corners)
        }
    )
    masses = jnp.array([10.0, 10.0, 0.4, 0.01, 0.01, 0.01, 0.01])

    def torque(t, q, v, args):
        # Each wheel is driven towards the rate that it has in a sideways motion.
        rates = args * jnp.array([-1.0, 1.0, 1.0, -1.0])
        return jnp.concatenate([jnp.zeros(3, v.dtype), 2.0 * (rates - v[3:])])

    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * masses @ v**2,
        nonholonomic=contacts.nonholonomic,
        force=torque,
    )
    return system, contacts


def test_mecanum_robot_commanded_sideways_does_not_turn():
    system, contacts = _mecanum()
    q0 = jnp.array([0.0, 0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    y0 = nhjax.initial_state(system, q0, jnp.zeros(7), args=8.0)
    sol = nhjax.integrate(
        system, nhjax.LobattoIIIAB(3), y0, dt=0.01, num_steps=300, args=8.0
    )
    y = jax.tree.map(lambda x: x[-1], sol.ys)
    assert sol.stats["max_constraint_violation"] < 1e-14
    assert abs(y.q[2] - 0.3) < 1e-13
    # Wheels of 5 cm at 8 rad/s move the robot at 0.4 m/s, to its left.
    speed = 0.4 * np.array([-np.sin(0.3), np.cos(0.3)])
    np.testing.assert_allclose(y.v[:2], speed, rtol=1e-6)
    forces = contacts.forces(3.0, y)
    assert max(np.abs(force).max() for force in forces.values()) < 1e-4


def test_omni_wheel_is_free_across_its_rolling_direction():
    def pose(t, q, args):
        return q, jnp.eye(3)

    wheel = rolling.Wheel(pose, 0.1, no_slip=("along",), touches=False)
    assert wheel.slip(0.0, jnp.zeros(3), jnp.array([0.0, 5.0, 0.0])) == 0.0
    assert wheel.slip(0.0, jnp.zeros(3), jnp.array([3.0, 5.0, 0.0])) == 3.0


def test_radius_of_a_wheel_is_differentiated_through_a_run():
    torus = nhjax.systems.RollingTorus.circling(tilt=1.1, radius_of_path=0.4)

    @jax.jit
    def end(radius):
        wheel = rolling.Wheel(_free_body, radius, axle=(0, 0, 1), manifold=SE3)
        system = _replaced(torus.system, rolling.Contacts(wheel=wheel))
        y0 = nhjax.initial_state(system, torus.q0, torus.v0, project=True)
        sol = nhjax.integrate(system, nhjax.LobattoIIIAB(2), y0, dt=0.02, num_steps=10)
        return sol.ys.q[-1, 4]

    difference = (end(0.5 + 1e-5) - end(0.5 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.grad(end)(0.5), difference, rtol=1e-6)


def test_lengths_of_a_contact_as_functions_of_args_equal_numbers():
    y = nhjax.systems.RollingTorus.steady(1.0, 2.0, tube_radius=0.1).initial_state()
    args = {"radius": 0.3, "tube": jnp.asarray(0.1), "axes": jnp.array([0.1, 0.2, 0.3])}
    pairs = (
        (
            rolling.Wheel(_free_body, 0.3, tube_radius=0.1, manifold=SE3),
            rolling.Wheel(
                _free_body,
                lambda args: args["radius"],
                tube_radius=lambda args: args["tube"],
                manifold=SE3,
            ),
        ),
        (
            rolling.Ellipsoid(_free_body, [0.1, 0.2, 0.3], manifold=SE3),
            rolling.Ellipsoid(_free_body, lambda args: args["axes"], manifold=SE3),
        ),
    )
    for numbers, functions in pairs:
        for a, b in (
            (numbers.height(0.0, y.q), functions.height(0.0, y.q, args)),
            (numbers.slip(0.0, y.q, y.v), functions.slip(0.0, y.q, y.v, args)),
        ):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("tilt", [1e-2, 1e-4, 1e-6])
def test_height_of_a_disc_that_lies_flat_keeps_all_digits(tilt):
    def pose(t, q, args):
        return jnp.zeros(3), about_y(q[0])

    wheel = rolling.Wheel(pose, 0.5, axle=(0, 0, 1))
    q = jnp.array([tilt])
    height, slope = jax.value_and_grad(lambda q: wheel.height(0.0, q))(q)
    np.testing.assert_allclose(height, -0.5 * np.sin(tilt), rtol=1e-15)
    np.testing.assert_allclose(slope[0], -0.5 * np.cos(tilt), rtol=1e-14)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_contacts_keep_the_precision_of_the_state(dtype):
    torus = nhjax.systems.RollingTorus()
    wheel = rolling.Wheel(
        _free_body, np.float64(0.5), axle=np.array([0.0, 0.0, 1.0]), manifold=SE3
    )
    contacts = rolling.Contacts(wheel=wheel)
    q, v = torus.q0.astype(dtype), torus.v0.astype(dtype)
    assert contacts.nonholonomic is not None
    assert contacts.nonholonomic(0.0, q, v).dtype == dtype
    assert contacts.holonomic is not None
    assert contacts.holonomic(0.0, q, None).dtype == dtype


# --- Mistakes ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: rolling.Wheel(cast(Any, 1.0), 0.3), TypeError, "`pose` must be a"),
        (
            lambda: rolling.Wheel(_free_body, 0.3, no_slip=cast(Any, "along")),
            ValueError,
            "`no_slip` must be a tuple",
        ),
        (
            lambda: rolling.Wheel(_free_body, 0.3, no_slip=cast(Any, ("sideways",))),
            ValueError,
            "`no_slip` must be a tuple",
        ),
        (
            lambda: rolling.Wheel(_free_body, 0.3, no_slip=("along", "along")),
            ValueError,
            "`no_slip` must name at most two directions",
        ),
        (
            lambda: rolling.Wheel(_free_body, 0.3, no_slip=(0.3, 0.3 + np.pi)),
            ValueError,
            "that are not parallel",
        ),
        (
            lambda: rolling.Wheel(_free_body, 0.3, no_slip=("along", "across", 0.8)),
            ValueError,
            "at most two directions",
        ),
        (
            lambda: rolling.Wheel(_free_body, 0.3, no_slip=("spin", "spin")),
            ValueError,
            "at most two directions",
        ),
        (lambda: rolling.Plane((0.0, 1.0)), nhjax.ShapeError, r"shape \(3,\)"),
        (
            lambda: rolling.Ellipsoid(_free_body, [1.0, 2.0]),
            nhjax.ShapeError,
            r"`semi_axes` must have shape \(3,\) or \(\), got \(2,\)",
        ),
        (
            lambda: rolling.Wheel(_free_body, lambda q, args: 0.3),
            TypeError,
            r"`radius` must take \(args\)",
        ),
        (
            lambda: rolling.Ellipsoid(_free_body, lambda args: jnp.ones(2)).height(
                0.0, jnp.array([1.0, 0, 0, 0, 0, 0, 1])
            ),
            nhjax.ShapeError,
            "`semi_axes` must have shape",
        ),
        (
            lambda: rolling.Wheel(_free_body, lambda args: jnp.ones(3)).height(
                0.0, jnp.array([0.8, 0.6, 0, 0, 0, 0, 1])
            ),
            nhjax.ShapeError,
            r"`radius` must have shape \(\), got \(3,\)",
        ),
        (
            lambda: rolling.Blade(_free_body, ground=cast(Any, (0, 0, 1))),
            TypeError,
            "`ground` must be an nhjax.AbstractGround",
        ),
        (
            lambda: rolling.Contacts(wheel=cast(Any, _free_body)),
            TypeError,
            "`wheel` must be an nhjax.AbstractContact",
        ),
    ],
)
def test_contact_with_wrong_argument_is_refused_by_name(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_contact_without_the_manifold_of_its_system_is_refused():
    wheel = rolling.Wheel(_free_body, 0.3)
    with pytest.raises(ValueError, match=r"Wheel\(\.\.\., manifold="):
        nhjax.LagrangianSystem(
            lambda t, q, v, args: 0.5 * v @ v,
            nonholonomic=rolling.Contacts(wheel=wheel).nonholonomic,
            manifold=SE3,
        )


def test_heights_of_wrong_shape_are_refused_by_name():
    with pytest.raises(nhjax.ShapeError, match="`heights` must have the shape"):
        rolling.Heightfield(np.zeros((3, 8)), 0.1)


def test_forces_in_the_frame_of_the_contact_are_those_in_space_turned():
    torus = nhjax.systems.RollingTorus.circling(tilt=1.1, radius_of_path=0.4)
    wheel = rolling.Wheel(_free_body, 0.5, axle=(0, 0, 1), manifold=SE3)
    contacts = rolling.Contacts(wheel=wheel)
    assert contacts.multiplier_names == ("wheel along", "wheel across", "wheel normal")
    system = _replaced(torus.system, contacts)
    y = nhjax.initial_state(system, torus.q0, torus.v0, project=True)
    in_frame = contacts.forces(0.0, y, frame="contact")["wheel"]
    np.testing.assert_allclose(in_frame, y.multiplier, atol=1e-12)
    frame = wheel.frame(0.0, torus.q0)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(
        frame.T @ in_frame, contacts.forces(0.0, y)["wheel"], atol=1e-12
    )


def test_pose_of_wrong_shape_is_refused_by_name():
    wheel = rolling.Wheel(lambda t, q, args: (q[:2], jnp.eye(3)), 0.3)
    with pytest.raises(nhjax.ShapeError, match="`pose` must return a position"):
        wheel.point(0.0, jnp.zeros(3))


def test_forces_of_another_number_of_multipliers_are_refused():
    torus = nhjax.systems.RollingTorus()
    blade = rolling.Blade(_free_body, manifold=SE3)
    with pytest.raises(nhjax.ShapeError, match="have 2 multipliers"):
        rolling.Contacts(blade=blade).forces(0.0, torus.initial_state())
