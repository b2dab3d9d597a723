"""A robot on two wheels against its reduced equations."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import TwoWheeledRobot
from support.cars import Robot
from support.library_motion import library_motion
from support.long import long
from support.orders import Ladder


def some_robot(seed):
    random = np.random.default_rng(seed)
    default = TwoWheeledRobot()
    names = [name for name in TwoWheeledRobot.__dataclass_fields__ if name[1] != "0"]
    changed = {
        name: float(getattr(default, name)) * random.uniform(0.5, 2.0) for name in names
    }
    speed, turn, heading = random.uniform(-2.0, 2.0, 3)
    robot = TwoWheeledRobot.rolling(speed, turn, heading, **changed)
    return robot, speed, turn, random.uniform(-3.0, 3.0, 2)


@pytest.mark.parametrize("seed", range(4))
def test_accelerations_and_ground_forces_equal_reduced_equations(
    seed,
):
    robot, speed, turn, torques = some_robot(seed)
    expected, ground = Robot(robot).accelerations(
        np.asarray(robot.q0), speed, turn, *torques
    )
    args = tuple(map(jnp.asarray, torques))
    acceleration, multiplier = library_motion(robot, 0.0, robot.q0, robot.v0, args)
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(acceleration, expected, rtol=0, atol=1e-13 * scale)
    scale = np.max(np.abs(ground))
    np.testing.assert_allclose(multiplier, ground, rtol=0, atol=1e-13 * scale)


@pytest.mark.parametrize("seed", range(2))
def test_rolling_robot_does_not_slip(seed):
    robot, speed, turn, _ = some_robot(seed)
    slips = robot.constraint(0.0, robot.q0, robot.v0, None)
    np.testing.assert_allclose(slips, 0.0, rtol=0, atol=2e-15)
    expected = Robot(robot).velocity(np.asarray(robot.q0), speed, turn)
    np.testing.assert_allclose(robot.v0, expected, rtol=1e-14)


def test_robot_with_default_data_rolls_without_slip():
    default, rolling = TwoWheeledRobot(), TwoWheeledRobot.rolling()
    np.testing.assert_allclose(default.v0, rolling.v0, rtol=1e-15)
    np.testing.assert_array_equal(default.q0, rolling.q0)


TORQUES = (2.0, 0.5)
DURATION, FINEST = 2.0, 0.01
LADDERS = {
    2: Ladder((0.02, 0.01), 200, DURATION, FINEST),
    3: Ladder((0.08, 0.04), 50, DURATION, FINEST),
}


@cache
def runs(stages, free=False):
    """Times, states and continuous multipliers, with one lane for each step size."""
    robot = TwoWheeledRobot.rolling(0.8, 1.1, 0.3)
    args = tuple(jnp.asarray(0.0 if free else x) for x in TORQUES)
    y0 = nhjax.initial_state(robot.system, robot.q0, robot.v0, args=args)
    method = nhjax.LobattoIIIAB(stages)
    return LADDERS[stages].climb(robot.system, method, y0, args)


@cache
def reference():
    """(q, v, forces of the ground) at the nodes of all runs, by the oracle."""
    robot = TwoWheeledRobot.rolling(0.8, 1.1, 0.3)
    times = np.arange(201) * FINEST
    return Robot(robot).trajectory(np.asarray(robot.q0), 0.8, 1.1, times, TORQUES)


@pytest.mark.parametrize("stages", [long(2), 3])
@pytest.mark.parametrize("part", range(3), ids=["q", "v", "multiplier"])
def test_motion_converges_to_reduced_equations(stages, part):
    _, states, continuous = runs(stages)
    found = (states.q, states.v, continuous)[part]
    LADDERS[stages].assert_order(2 * stages - 2, found, reference()[part])


def test_energy_equals_the_work_of_the_motors():
    robot = TwoWheeledRobot.rolling(0.8, 1.1, 0.3)
    q, v, _ = reference()
    energy = [float(robot.energy(0.0, q[k], v[k])) for k in (0, -1)]
    work = np.array(TORQUES) @ (q[-1, 3:] - q[0, 3:])
    assert energy[1] - energy[0] == pytest.approx(work, rel=1e-12)
    _, states, _ = runs(3)
    end = states.q[1, -1], states.v[1, -1]
    gained = float(robot.energy(0.0, *end)) - energy[0]
    work = np.array(TORQUES) @ (end[0][3:] - q[0, 3:])
    assert gained == pytest.approx(work, rel=1e-6)


def test_run_without_torques_conserves_energy_and_does_not_slip():
    robot = TwoWheeledRobot.rolling(0.8, 1.1, 0.3)
    _, states, _ = runs(3, free=True)
    q, v = states.q[0], states.v[0]
    start = float(robot.invariants(0.0, robot.q0, robot.v0)["energy"])
    values = jax.jit(jax.vmap(robot.invariants, in_axes=(None, 0, 0)))(0.0, q, v)
    assert np.max(np.abs(np.asarray(values["energy"]) / start - 1)) < 1e-6
    check = jax.jit(jax.vmap(robot.constraint, in_axes=(None, 0, 0, None)))
    np.testing.assert_allclose(check(0.0, q, v, None), 0.0, rtol=0, atol=2e-14)


def test_robot_with_centre_above_axle_moves_on_a_circle():
    robot = TwoWheeledRobot.rolling(0.8, 1.1, offset=0.0)
    acceleration, multiplier = library_motion(robot, 0.0, robot.q0, robot.v0, None)
    np.testing.assert_allclose(acceleration[2:], 0.0, rtol=0, atol=1e-15)
    whole = float(robot.mass + 2 * robot.wheel_mass)
    np.testing.assert_allclose(
        multiplier, [whole * 0.8 * 1.1, 0.0, 0.0], rtol=1e-14, atol=1e-14
    )


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_system_computes_in_precision_of_the_state(dtype):
    robot = TwoWheeledRobot()
    t, q, v = jnp.zeros((), dtype), robot.q0.astype(dtype), robot.v0.astype(dtype)
    values = (
        robot.lagrangian(t, q, v, None),
        robot.constraint(t, q, v, None),
        robot.force(t, q, v, (1.0, 2.0)),
        *robot.points(t, q).values(),
    )
    assert {value.dtype for value in values} == {jnp.dtype(dtype)}


def test_robot_points_are_in_front_of_and_beside_the_axle():
    robot = TwoWheeledRobot()
    q = jnp.array([1.0, 2.0, np.pi / 2, 0.0, 0.0])
    expected = {
        "axle": (1.0, 2.0),
        "centre": (1.0, 2.3),
        "right_wheel": (1.75, 2.0),
        "left_wheel": (0.25, 2.0),
    }
    points = robot.points(0.0, q)
    assert points.keys() == expected.keys()
    for name, point in points.items():
        np.testing.assert_allclose(point, expected[name], rtol=0, atol=1e-15)


def test_gradients_in_every_parameter_are_not_zero():
    robot = TwoWheeledRobot()

    def value(robot):
        slips = robot.constraint(0.0, robot.q0, robot.v0 + 1.0, None)
        return robot.lagrangian(0.0, robot.q0, robot.v0, None) + jnp.sum(slips**2)

    gradient = jax.jit(jax.grad(value))(robot)
    names = [name for name in TwoWheeledRobot.__dataclass_fields__ if name[1] != "0"]
    for name in names:
        assert getattr(gradient, name) != 0, name


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"mass": 0.0}, r"`mass` must be positive, got 0"),
        ({"half_track": -1.0}, r"`half_track` must be positive, got -1"),
        ({"radius": 0.0}, r"`radius` must be positive"),
        ({"axle_inertia": 0.0}, r"`axle_inertia` must be positive"),
        ({"q0": (0.0, 0.0)}, r"`q0` must have shape \(5,\), got \(2,\)"),
    ],
)
def test_robot_parameter_out_of_range_raises(parameters, message):
    with pytest.raises(ValueError, match=message):
        TwoWheeledRobot(**parameters)
