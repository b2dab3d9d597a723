"""Forces that machines are given as `args`: of the right shape, or refused by name."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import (
    CarWithTrailers,
    FlyballGovernor,
    RollerRacer,
    Snakeboard,
    SteerTorque,
    TwoWheeledRobot,
    WhippleBicycle,
)


# A machine, what it takes, and the same in another form.
MACHINES = {
    "car": (CarWithTrailers(), (2.0, 0.3), jnp.asarray([2.0, 0.3])),
    "robot": (TwoWheeledRobot(), (0.2, 0.1), np.asarray([0.2, 0.1])),
    "governor": (FlyballGovernor(), 0.5, jnp.asarray(0.5)),
    "racer": (RollerRacer(gait=None), 0.5, np.float32(0.5)),
    "snakeboard": (
        Snakeboard(gait=None),
        [0.1, 0.2, 0.3],
        jnp.asarray([0.1, 0.2, 0.3]),
    ),
    "bicycle": (WhippleBicycle(steering=SteerTorque()), 1.5, np.asarray(1.5)),
}


@pytest.mark.parametrize(("example", "forces", "same"), MACHINES.values(), ids=MACHINES)
def test_force_args_of_right_shape_change_the_force(example, forces, same):
    def force(args):
        return example.force(0.0, example.q0, example.v0, args)

    found = np.asarray(force(forces))
    assert np.any(found != np.asarray(force(None)))
    np.testing.assert_array_equal(force(same), found)
    slope = jax.jacfwd(force)(jnp.asarray(forces))
    assert np.any(np.asarray(slope) != 0)
    shape = np.shape(forces)
    for wrong in (jnp.ones((4, *shape)), jnp.ones(5), {"torque": 1.0}):
        with pytest.raises(nhjax.ShapeError, match="`args` must be None or") as error:
            force(wrong)
        assert f"of shape {shape}" in str(error.value)


def test_initial_state_with_force_args_of_wrong_shape_raises():
    robot, _, _ = MACHINES["robot"]
    with pytest.raises(nhjax.ShapeError, match=r"torques of the motors .* \(2,\), got"):
        nhjax.initial_state(robot.system, robot.q0, robot.v0, args=jnp.ones((3, 2)))


def test_initial_state_of_example_with_args_computes_multiplier_for_its_forces():
    def steering(t, q, v, args):
        return args["gain"] * v[3]

    bicycle = WhippleBicycle(steering=steering)
    args = {"gain": jnp.asarray(10.0)}
    y0 = bicycle.initial_state(args=args)
    expected = nhjax.continuous_multiplier(bicycle.system, 0.0, y0, args)
    np.testing.assert_allclose(y0.multiplier, expected, rtol=1e-12, atol=1e-12)
    free = WhippleBicycle().initial_state()
    assert np.max(np.abs(y0.multiplier - free.multiplier)) > 1.0
    assert bicycle.system.coordinates is not None
    assert bicycle.system.coordinates[5] == "steer"
