"""The robots that come with nhjax, against dense equations with MuJoCo's matrices."""

import functools
import importlib
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import nhjax


mujoco: Any = importlib.import_module("mujoco")

# The number of velocities, and a motion to start from, which is projected.
ROBOTS = {
    "ackermann_car": (10, {"x": 2.0, "left_steer": 0.2, "heading": 0.1}),
    "balancing_robot": (6, {"x": 0.4, "heading": 0.5, "pitch": 0.3}),
    "differential_drive": (7, {"root_TX": 0.5, "root_RZ": 0.4, "swivel": 0.3}),
    "mecanum_platform": (7, {"x": 0.3, "y": -0.5, "heading": 0.4}),
    "wheeled_quadruped": (20, {"trunk": [0.6, 0.0, 0.1, 0.1, 0.2, 0.1]}),
}
QUICK = "mecanum_platform"
CASES = [
    name if name == QUICK else pytest.param(name, marks=pytest.mark.long)
    for name in ROBOTS
]


@functools.cache
def _robot(name):
    return nhjax.example_robot(name)


def _model(name):
    """Return MuJoCo's model. A URDF file gets the planar root that `root` adds."""
    path = nhjax.example_robot_file(name)
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".urdf":
        root = (
            '<link name="world"/><joint name="root" type="planar">'
            '<parent link="world"/><child link="chassis"/><axis xyz="0 0 1"/></joint>'
        )
        text = text.replace("</robot>", f"{root}</robot>")
    return mujoco.MjSpec.from_string(text).compile()


def _geom(model, name):
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)


def _rows(robot, model, data, qpos, qvel):
    """The rows of all constraints at a state, from MuJoCo's Jacobians of points."""
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    rows = [data.efc_J.reshape(-1, model.nv)[: data.ne].copy()]
    for name, contact in zip(
        robot.contacts.names, robot.contacts.contacts, strict=True
    ):
        geom = _geom(model, name)
        axle = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        along = np.cross(axle, [0.0, 0.0, 1.0])
        along /= np.linalg.norm(along)
        across = np.cross([0.0, 0.0, 1.0], along)
        down = np.cross(axle, along)
        point = data.geom_xpos[geom] + model.geom_size[geom, 0] * down
        jacobian = np.zeros((3, model.nv))
        body = model.geom_bodyid[geom]
        mujoco.mj_jac(model, data, jacobian, None, point, body)
        weights = np.asarray(contact.weights("float64"))
        rows.append(weights @ np.stack([along, across]) @ jacobian)
        if contact.touches:
            rows.append(jacobian[2:])
    return np.concatenate(rows)


def _dense_acceleration(robot, model, data, qpos, qvel):
    """Solve M a = f + Jᵀ λ, J a = -J̇ v, with differences along the motion for J̇ v."""

    def rates(time):
        moved = qpos.copy()
        mujoco.mj_integratePos(model, moved, qvel, time)
        return _rows(robot, model, data, moved, qvel) @ qvel

    h = 1e-3
    slopes = [(rates(k * h) - rates(-k * h)) / (2 * k * h) for k in (1, 2, 4)]
    coarse = [(4 * slopes[i] - slopes[i + 1]) / 3 for i in range(2)]
    slope = (16 * coarse[0] - coarse[1]) / 15
    rows, mass = _rows(robot, model, data, qpos, qvel), np.zeros((model.nv,) * 2)
    mujoco.mj_fullM(model, data, mass)
    zero = np.zeros((len(rows),) * 2)
    matrix = np.block([[mass, -rows.T], [rows, zero]])
    right = np.concatenate([data.qfrc_smooth, -slope])
    return np.linalg.lstsq(matrix, right, rcond=1e-11)[0][: model.nv]


def _energies(model, states):
    """MuJoCo's energy of some states."""
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    data, found = mujoco.MjData(model), []
    for qpos, qvel in states:
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        found.append(data.energy.sum())
    return np.array(found)


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_example_robot_stands_on_its_wheels(name):
    robot = _robot(name)
    assert len(robot.coordinates) == ROBOTS[name][0]
    assert robot.system.constraints == "independent"
    assert robot.contacts is not None
    q = robot._space.from_qpos(jnp.asarray(robot._rest))
    heights = [float(x.height(0.0, q)) for x in robot.contacts.contacts]
    np.testing.assert_allclose(heights, 0.0, atol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_example_robot_accelerates_by_dense_equations(name):
    robot, model = _robot(name), _model(name)
    y = robot.initial_state(qvel=ROBOTS[name][1], project=True)
    found = np.asarray(nhjax.motion(robot.system, 0.0, y).acceleration)
    states = np.asarray(robot.qpos(y)), np.asarray(robot.qvel(y))
    expected = _dense_acceleration(robot, model, mujoco.MjData(model), *states)
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(found, expected, atol=1e-9 * scale, rtol=0)


# The quadruped, the last one, takes a minute to compile.
@pytest.mark.parametrize("name", CASES[:-1])
def test_example_robot_rolls_without_slip_and_keeps_its_energy(name):
    robot, model = _robot(name), _model(name)
    y0 = robot.initial_state(qvel=ROBOTS[name][1], project=True)
    errors = []
    for steps in (40, 80):
        saveat = nhjax.SaveAt(t0=True, steps=steps // 20)
        method = nhjax.LobattoIIIAB(2)
        sol = nhjax.integrate(
            robot.system, method, y0, dt=0.4 / steps, num_steps=steps, saveat=saveat
        )
        assert float(sol.stats["max_constraint_violation"]) < 1e-11
        states = zip(
            np.asarray(robot.qpos(sol)), np.asarray(robot.qvel(sol)), strict=True
        )
        energy = _energies(model, states)
        errors.append(np.abs(energy - energy[0]).max())
        size = np.abs(energy).max()
    assert errors[0] < 1e-3 * size
    assert errors[1] < max(errors[0] / 3, 1e-11 * size)


def test_every_model_file_belongs_to_a_robot():
    files = {nhjax.example_robot_file(name) for name in ROBOTS}
    folder = Path(next(iter(files))).parent
    assert set(folder.iterdir()) == files


def test_unknown_example_robot_raises():
    with pytest.raises(ValueError, match="must be one of 'ackermann_car'"):
        nhjax.example_robot("unicycle")


def test_options_of_an_example_robot_are_those_of_the_user():
    robot = nhjax.example_robot(QUICK, rolling=None, parameters={"mass": ["platform"]})
    assert robot.contacts is None
    assert float(robot.args["mass"]["platform"]) == pytest.approx(18.0)


def test_contact_forces_of_a_robot_with_a_closed_loop_are_its_first_multipliers():
    robot = _robot("ackermann_car")
    assert robot.loops
    assert robot.contacts is not None
    y = robot.initial_state(qvel=ROBOTS["ackermann_car"][1], project=True)
    names = robot.contacts.multiplier_names
    assert len(y.multiplier) == len(names) + len(robot.loops)
    forces = robot.contacts.forces(0.0, y, frame="contact")
    for name, direction in (
        ("rear_left_tread", "across"),
        ("front_left_tread", "along"),
    ):
        place = names.index(f"{name} {direction}")
        found = forces[name][("along", "across").index(direction)]
        assert float(found) == float(y.multiplier[place])
