"""Robots from MJCF and URDF, against MuJoCo and against systems of the gallery."""

import functools
import importlib
import math
import re
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import rolling
from nhjax._robots import _tree
from support.robot_models import CLOSED, OPEN


mujoco: Any = importlib.import_module("mujoco")

TWO_WHEELS = Path(__file__).parent / "support" / "two_wheels.urdf"
BODY = '<geom name="{}" type="{}" size="0.1 0.1 0.1" mass="1" contype="0"/>'


def _compiled(text):
    return mujoco.MjSpec.from_string(text).compile()


@functools.cache
def _robot(name):
    model = _compiled((OPEN | CLOSED)[name])
    return model, nhjax.from_mujoco(model)


def _random_states(model, count):
    """Positions, velocities and controls, with MuJoCo's own steps on groups."""
    rng = np.random.default_rng(5)
    found = []
    for _ in range(count):
        qpos = model.qpos0.copy()
        mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 1.0)
        velocity, controls = rng.normal(size=model.nv), rng.uniform(-1, 1, model.nu)
        found.append((qpos, velocity, controls))
    return [np.stack(x) for x in zip(*found, strict=True)]


def _accelerations(robot):
    """The accelerations and mass matrices of a robot without constraints."""
    system, space = robot.system, robot._space

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0, 0, None))
    def compute(qpos, qvel, controls, args):
        args = args | ({"controls": controls} if robot.controls else {})
        q, v = space.from_qpos(qpos), qvel
        p, rate = jax.jvp(
            lambda q: system.momentum(0.0, q, v, args), (q,), (space.tangent(q, v),)
        )
        force = system.free_force(0.0, q, v, jnp.zeros(0), args)
        force = force + system.manifold_of(q).ad_dual(v, p) - rate
        mass = system.metric(0.0, q, v, args)
        return jnp.linalg.solve(mass, force), mass

    return compute


@pytest.mark.parametrize("count", [20, pytest.param(200, marks=pytest.mark.long)])
@pytest.mark.parametrize("name", sorted(OPEN))
def test_acceleration_and_mass_matrix_on_random_states_equal_mujoco(name, count):
    model, robot = _robot(name)
    _assert_moves_as_in_mujoco(robot, model, count, {})


def _assert_moves_as_in_mujoco(robot, model, count, args):
    """Compare accelerations and mass matrices on random states."""
    states = _random_states(model, count)
    found, masses = _accelerations(robot)(*map(jnp.asarray, states), args)
    data, mass = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    for i, (qpos, qvel, controls) in enumerate(zip(*states, strict=True)):
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, controls
        mujoco.mj_forward(model, data)
        scale = max(1.0, np.abs(data.qacc).max())
        np.testing.assert_allclose(found[i], data.qacc, atol=1e-10 * scale, rtol=0)
        mujoco.mj_fullM(model, data, mass)
        np.testing.assert_allclose(masses[i], mass, atol=1e-10, rtol=0)


def _constraint_rows(model, data, qpos, qvel):
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_forward(model, data)
    return data.efc_J.reshape(-1, model.nv)[: data.ne].copy()


def _by_kkt(model, data, qpos, qvel):
    """The acceleration from the dense equations M a = f + Jᵀ λ, J a = -J' v."""

    def rates(time):
        moved = qpos.copy()
        mujoco.mj_integratePos(model, moved, qvel, time)
        return _constraint_rows(model, data, moved, qvel) @ qvel

    h = 1e-3
    slopes = [(rates(k * h) - rates(-k * h)) / (2 * k * h) for k in (1, 2, 4)]
    coarse = [(4 * slopes[i] - slopes[i + 1]) / 3 for i in range(2)]
    slope = (16 * coarse[0] - coarse[1]) / 15
    rows, mass = _constraint_rows(model, data, qpos, qvel), np.zeros((model.nv,) * 2)
    mujoco.mj_fullM(model, data, mass)
    zero = np.zeros((len(rows), len(rows)))
    matrix = np.block([[mass, -rows.T], [rows, zero]])
    right = np.concatenate([data.qfrc_smooth, -slope])
    return np.linalg.lstsq(matrix, right, rcond=1e-11)[0][: model.nv]


@pytest.mark.parametrize("name", sorted(CLOSED))
def test_equations_of_closed_loops_at_rest_restrict_the_motions_of_mujoco(name):
    model, robot = _robot(name)
    data, space = mujoco.MjData(model), robot._space
    model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    expected = _constraint_rows(model, data, model.qpos0, np.zeros(model.nv))
    q = space.from_qpos(jnp.asarray(model.qpos0))

    @jax.jit
    def rates(qvel):
        return robot.system.holonomic_rate(0.0, q, qvel)

    found = np.stack([rates(x) for x in jnp.eye(model.nv)], axis=1)
    rank = np.linalg.matrix_rank(expected, tol=1e-10)
    assert np.linalg.matrix_rank(found, tol=1e-10) == rank == len(robot.loops)
    both = np.concatenate([found, expected])
    assert np.linalg.matrix_rank(both, tol=1e-10) == rank


@pytest.mark.parametrize(
    ("name", "count"),
    [("four-bar", 20), *(pytest.param(x, 200, marks=pytest.mark.long) for x in CLOSED)],
)
def test_acceleration_of_closed_loops_equals_dense_equations(name, count):
    model, robot = _robot(name)
    model.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    rng = np.random.default_rng(2)
    starts = []
    for _ in range(count):
        qpos = model.qpos0.copy()
        mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 0.15)
        starts.append(qpos)
    velocities = rng.normal(size=(count, model.nv))

    @jax.jit
    @jax.vmap
    def compute(qpos, qvel):
        y = robot.initial_state(qpos, qvel, project=True)
        return y, nhjax.motion(robot.system, 0.0, y).acceleration

    y, found = compute(jnp.asarray(np.stack(starts)), jnp.asarray(velocities))
    data = mujoco.MjData(model)
    qpos, qvel = np.asarray(robot.qpos(y)), np.asarray(robot.qvel(y))
    for i in range(count):
        expected = _by_kkt(model, data, qpos[i], qvel[i])
        scale = max(1.0, np.abs(expected).max())
        np.testing.assert_allclose(found[i], expected, atol=1e-10 * scale, rtol=0)
        assert np.abs(data.efc_pos[: data.ne]).max() < 1e-10


def test_planar_loop_in_space_keeps_only_independent_equations():
    _, robot = _robot("four-bar")
    assert robot.loops == ("loop x", "loop z")
    assert robot.system.constraints == "independent"


# --- Rolling -------------------------------------------------------------------------


def _read_two_wheels(**options):
    return nhjax.from_mujoco(
        TWO_WHEELS,
        rolling=["right_tread", "left_tread"],
        root="planar",
        ground=rolling.Plane(height=-0.15),
        ignore=["contacts"],
        **options,
    )


@functools.cache
def _two_wheels():
    return _read_two_wheels()


def test_two_wheeled_robot_from_urdf_moves_like_that_of_the_gallery():
    robot = _two_wheels()
    hand_written = nhjax.systems.TwoWheeledRobot.rolling(1.0, 0.5)
    runs = []
    for system, y0 in (
        (robot.system, robot.initial_state(hand_written.q0, hand_written.v0)),
        (hand_written.system, hand_written.initial_state()),
    ):
        method, saveat = nhjax.LobattoIIIAB(2), nhjax.SaveAt(steps=40)
        runs.append(
            nhjax.integrate(system, method, y0, dt=0.05, num_steps=200, saveat=saveat)
        )
    sol, expected = runs
    np.testing.assert_allclose(robot.qpos(sol), expected.ys.q, atol=1e-10)
    np.testing.assert_allclose(robot.qvel(sol), expected.ys.v, atol=1e-10)


def test_wheel_on_shared_axle_leaves_out_its_lateral_direction():
    robot = _two_wheels()
    assert robot.contacts is not None
    assert robot.contacts.multiplier_names == (
        "right_tread along",
        "right_tread across",
        "left_tread along",
    )
    assert robot.system.constraints == "independent"
    assert robot.coordinates == ("root_TX", "root_TY", "root_RZ", "right", "left")


def test_free_robot_with_caster_stands_on_three_heights():
    text = OPEN["differential drive"].replace(
        '<body name="right"',
        '<geom name="caster" type="sphere" size="0.05" pos="0.3 0 -0.1"/>'
        '<body name="right"',
    )
    for side in ("right", "left"):
        text = text.replace(
            f'<joint name="{side}" axis="0 1 0"/>\n        <geom',
            f'<joint name="{side}" axis="0 1 0"/><geom name="{side}"',
        )
    options = {"right": "no slip", "left": "no slip", "caster": "slides"}
    robot = nhjax.from_mujoco(_compiled(text), rolling=options)
    assert robot.contacts is not None
    assert robot.contacts.multiplier_names == (
        "right along",
        "right across",
        "left along",
        "right normal",
        "left normal",
        "caster normal",
    )
    forces = robot.contacts.forces(0.0, robot.initial_state(), robot.args)
    weight = 9.81 * (5 + 3 * 0.7)
    assert float(sum(force[2] for force in forces.values())) == pytest.approx(weight)


def test_car_with_four_parallel_wheels_keeps_three_heights():
    wheels = "".join(
        f"""<body name="{x}{y}" pos="{x} {y} 0"><joint name="{x}{y}" axis="0 1 0"/>
        <geom name="w{x}{y}" type="cylinder" size="0.15 0.02" euler="90 0 0"
        contype="0"/></body>"""
        for x in (-1, 1)
        for y in (-1, 1)
    )
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><worldbody><body name="car" pos="0 0 0.15"><freejoint name="car"/>
        {BODY.format("trunk", "box")}{wheels}</body></worldbody></mujoco>"""
    )
    names = [f"w{x}{y}" for x in (-1, 1) for y in (-1, 1)]
    robot = nhjax.from_mujoco(spec, rolling=names, ignore=["contacts"])
    assert robot.system.constraints == "independent"
    assert robot.contacts is not None
    kept = [x.split()[1] for x in robot.contacts.multiplier_names]
    assert {x: kept.count(x) for x in kept} == {"along": 4, "across": 2, "normal": 3}
    every = nhjax.from_mujoco(
        spec, rolling=names, ignore=["contacts"], constraints="redundant"
    )
    assert every.contacts is not None
    assert len(every.contacts.multiplier_names) == 12


def test_ball_that_rolls_down_a_slope_accelerates_by_five_sevenths():
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><compiler angle="radian"/><worldbody>
        <geom name="slope" type="plane" size="1 1 1" axisangle="0 1 0 0.3"/>
        <body name="ball"><freejoint name="ball"/>
        {BODY.format("ball", "sphere")}</body></worldbody></mujoco>"""
    )
    robot = nhjax.from_mujoco(spec, rolling={"ball": "no slip"})
    normal = np.array([math.sin(0.3), 0.0, math.cos(0.3)])
    y = robot.initial_state({"ball": [*(0.1 * normal), 1.0, 0.0, 0.0, 0.0]})
    found = nhjax.motion(robot.system, 0.0, y).acceleration
    down = np.array([math.cos(0.3), 0.0, -math.sin(0.3)])
    size = 5 / 7 * 9.81 * math.sin(0.3)
    np.testing.assert_allclose(found[:3], size * down, atol=1e-12)


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("cylinder", rolling.Wheel),
        ("capsule", rolling.Wheel),
        ("sphere", rolling.Ellipsoid),
        ("ellipsoid", rolling.Ellipsoid),
    ],
)
def test_geom_that_rolls_touches_at_its_radius(kind, expected):
    spec = mujoco.MjSpec.from_string(
        f"""<mujoco><worldbody><body name="b"><freejoint name="b"/>
        {BODY.format("tread", kind)}</body></worldbody></mujoco>"""
    )
    robot = nhjax.from_mujoco(spec, rolling={"tread": "slides"})
    assert robot.contacts is not None
    contact = robot.contacts["tread"]
    assert type(contact) is expected
    half = math.sqrt(0.5)
    pose = jnp.array([0.3, 0.2, 0.25]), jnp.array([half, half, 0.0, 0.0])
    assert float(contact.height(0.0, pose)) == pytest.approx(0.15)
    assert contact.no_slip == ()


# --- MuJoCo's conventions ------------------------------------------------------------


def test_positions_and_velocities_of_free_and_ball_joints_come_back():
    for name in ("quadruped", "ball joint", "two trees"):
        model, robot = _robot(name)
        (qpos,), (qvel,), _ = _random_states(model, 1)
        q = robot._space.from_qpos(jnp.asarray(qpos))
        v = jnp.asarray(qvel)
        y = nhjax.State(q, v, v, jnp.zeros(0))
        np.testing.assert_allclose(robot.qpos(y), qpos, atol=1e-15)
        np.testing.assert_allclose(robot.qvel(y), qvel, atol=1e-14)
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for body in ("shank3", "arm", "third"):
            if body in robot.bodies:
                number = robot.bodies.index(body)
                position, rotation = robot.pose(body, q)
                np.testing.assert_allclose(position, data.xpos[number], atol=1e-14)
                expected = data.xmat[number].reshape(3, 3)
                np.testing.assert_allclose(rotation, expected, atol=1e-14)


@pytest.mark.parametrize("speed", [1.0, 20.0])
def test_body_that_flies_fast_turns_as_one_whose_centre_rests(speed):
    model = _compiled(
        """<mujoco><option gravity="0 0 0"/><worldbody><body name="b">
        <freejoint name="f"/>
        <inertial pos="0 0 0" mass="1" diaginertia="0.004 0.007 0.01"/></body>
        </worldbody></mujoco>"""
    )
    robot, ends = nhjax.from_mujoco(model), []
    for velocity in ([0.0, 0.0, 0.0], [0.6 * speed, 0.0, 0.8 * speed]):
        y0 = robot.initial_state(qvel={"f": [*velocity, 2.0, 3.0, -1.0]})
        sol = nhjax.integrate(
            robot.system, nhjax.LobattoIIIAB(3), y0, dt=0.01, num_steps=100
        )
        ends.append((robot.qpos(sol)[-1, 3:], robot.qvel(sol)[-1, 3:]))
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-12)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=1e-11)


def test_state_by_names_of_joints_has_the_rest_of_the_file():
    model, robot = _robot("cart and pole")
    y = robot.initial_state({"pole": 0.7}, {"cart": 2.0})
    np.testing.assert_allclose(robot.qpos(y), [model.qpos0[0], 0.7])
    np.testing.assert_allclose(robot.qvel(y), [2.0, 0.0])
    with pytest.raises(ValueError, match="`qpos` has 'wheel', but the joints are cart"):
        robot.initial_state({"wheel": 0.0})
    with pytest.raises(nhjax.ShapeError, match=r"must have shape \(2,\), got \(3,\)"):
        robot.initial_state(jnp.zeros(3))


def test_conversion_of_a_solution_without_states_raises():
    _, robot = _robot("cart and pole")
    with pytest.raises(TypeError, match="converts a State, or a Solution"):
        robot.qpos(jnp.zeros(3))


# --- Forces and parameters -----------------------------------------------------------


def _force(robot, *arguments):
    assert robot.system.force is not None
    return robot.system.force(*arguments)


def test_friction_loss_is_a_smooth_law_of_the_documented_scale():
    text = OPEN["cart and pole"].replace(
        'name="cart" type', 'name="cart" frictionloss="2" type'
    )
    robot = nhjax.from_mujoco(_compiled(text), friction_smoothing=0.1)
    force = _force(robot, 0.0, jnp.zeros(2), jnp.array([0.05, 1.0]), None)
    np.testing.assert_allclose(force, [-2 * math.tanh(0.5), 0.0], atol=1e-15)


@pytest.mark.parametrize(
    ("control", "force"), [(0.3, 0.9), (50.0, 15.0), (-50.0, -15.0)]
)
def test_control_beyond_its_range_is_limited_smoothly(control, force):
    _, robot = _robot("cart and pole")
    args = {"controls": jnp.array([control])}
    found = _force(robot, 0.0, jnp.zeros(2), jnp.zeros(2), args)
    np.testing.assert_allclose(found, [force, 0.0], atol=1e-14)


def test_feedback_receives_positions_and_velocities_of_mujoco():
    model, _ = _robot("differential drive")

    def controls(t, qpos, qvel, args):
        return jnp.stack([qpos[2], qvel[0], 0 * t])

    robot = nhjax.from_mujoco(model, controls=controls)
    half = math.sqrt(0.5)
    turn = jnp.array([half, 0.0, 0.0, half])
    q = jnp.array([0.0, 0.0, 0.4]), turn, jnp.zeros(2)
    v = jnp.array([3.0] + 7 * [0.0])
    force = _force(robot, 0.0, q, v, None)
    np.testing.assert_allclose(force[6:], [0.4, 3.0], atol=1e-14)


SMALL = {"mass": ["cart", "pole"], "damping": ["pole"], "stiffness": ["cart"]}
LARGE = {"mass": ["fore"], "damping": ["pitch"], "armature": ["yaw"]}
LENGTHS = {"mass": ["link0"], "position": ["link1", "link2"]}


@pytest.mark.parametrize(
    ("name", "chosen"),
    [
        ("cart and pole", SMALL),
        ("pendulum chain", LENGTHS),
        pytest.param("arm with springs and servos", LARGE, marks=pytest.mark.long),
    ],
)
def test_gradient_by_parameters_of_the_file_agrees_with_differences(name, chosen):
    model, _ = _robot(name)
    robot = nhjax.from_mujoco(model, parameters=chosen)
    assert float(robot.args["mass"][chosen["mass"][0]]) == pytest.approx(0.7)
    velocity = jnp.linspace(1.0, 0.3, model.nv)

    @jax.jit
    def end(args):
        y0 = robot.initial_state(qvel=velocity, args=args)
        sol = nhjax.integrate(
            robot.system, nhjax.LobattoIIIAB(2), y0, dt=0.02, num_steps=10, args=args
        )
        return robot.qpos(sol)[-1] @ jnp.arange(1.0, model.nv + 1)

    slopes, h = jax.jit(jax.grad(end))(robot.args), 1e-3
    leaves, structure = jax.tree.flatten(robot.args)
    for i, slope in enumerate(jax.tree.leaves(slopes)):
        # All entries of a parameter change at once.
        def at(x, i=i):
            moved = [leaf + x if j == i else leaf for j, leaf in enumerate(leaves)]
            return end(structure.unflatten(moved))

        near, far = [(at(k * h) - at(-k * h)) / (2 * k * h) for k in (1, 2)]
        expected = float((4 * near - far) / 3)
        assert float(slope.sum()) == pytest.approx(expected, abs=1e-8)
        assert abs(expected) > 1e-6


def test_mass_in_args_equals_a_model_with_this_mass():
    body = '<body name="b"><joint name="j"/>{}</body>'
    text = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    geom = '<geom type="box" size="0.1 0.2 0.3" pos="0.1 0.2 0" mass="{}"/>'
    robots = [
        nhjax.from_mujoco(
            _compiled(text.format(geom.format(mass))), parameters={"mass": ["b"]}
        )
        for mass in (2, 5)
    ]
    q, v = jnp.array([0.3]), jnp.array([0.7])
    first = robots[0].system.lagrangian(0.0, q, v, {"mass": {"b": 5.0}})
    second = robots[1].system.lagrangian(0.0, q, v, None)
    assert float(first) == pytest.approx(float(second), abs=1e-14)


MOVABLE = {
    "pendulum chain": ("link0", "link2", "link3"),
    "ball joint": ("top", "arm"),
    "arm with springs and servos": ("upper", "tool", "fore"),
    "differential drive": ("right", "left"),
}


@pytest.mark.parametrize("largest", [0, 40])
@pytest.mark.parametrize("name", sorted(MOVABLE))
def test_positions_in_args_equal_a_model_with_these_positions(
    name, largest, monkeypatch
):
    monkeypatch.setattr(_tree, "LARGEST_OF_SCALARS", largest)
    spec = mujoco.MjSpec.from_string(OPEN[name])
    rng, places = np.random.default_rng(8), {}
    for body in spec.bodies:
        if body.name in MOVABLE[name]:
            body.pos = np.asarray(body.pos) + 0.3 * rng.normal(size=3)
            places[body.name] = jnp.asarray(body.pos)
    model, args = spec.compile(), {"position": places}
    chosen = {"position": MOVABLE[name], "mass": MOVABLE[name][:1]}
    robot = nhjax.from_mujoco(_compiled(OPEN[name]), parameters=chosen)
    _assert_moves_as_in_mujoco(robot, model, 3, args)
    data = mujoco.MjData(model)
    data.qpos[:] = _random_states(model, 1)[0][0]
    mujoco.mj_kinematics(model, data)
    q = robot._space.from_qpos(jnp.asarray(data.qpos))
    for body in MOVABLE[name]:
        position, rotation = robot.pose(body, q, args)
        np.testing.assert_allclose(position, data.body(body).xpos, atol=1e-13)
        turn = data.body(body).xmat.reshape(3, 3)
        np.testing.assert_allclose(rotation, turn, atol=1e-13)


def test_positions_in_args_move_the_ends_of_a_closed_loop():
    bodies, text = ("coupler", "rocker"), CLOSED["four-bar"]
    robot = nhjax.from_mujoco(_compiled(text), parameters={"position": bodies})
    spec = mujoco.MjSpec.from_string(text)
    places = {"coupler": np.array([0.0, 0.0, 0.35]), "rocker": np.array([0.6, 0, 0.1])}
    for name, place in places.items():
        spec.body(name).pos = place
    model, anchors = spec.compile(), _compiled(text).eq_data[0]
    data = mujoco.MjData(model)
    data.qpos[:] = 0.2, -0.4, 0.1
    mujoco.mj_kinematics(model, data)
    ends = [
        data.body(name).xpos + data.body(name).xmat.reshape(3, 3) @ anchor
        for name, anchor in zip(bodies, (anchors[:3], anchors[3:6]), strict=True)
    ]
    args = {"position": jax.tree.map(jnp.asarray, places)}
    gap = jax.jit(robot.system.position_constraint)
    # The loop lies in the plane of x and z.
    expected = (ends[0] - ends[1])[[0, 2]]
    found = gap(0.0, jnp.asarray(data.qpos), args)
    np.testing.assert_allclose(found, expected, atol=1e-15)
    y0 = robot.initial_state(args=args, project=True)
    np.testing.assert_allclose(gap(0.0, y0.q, args), 0, atol=1e-15)


def test_radii_and_track_in_args_equal_a_robot_with_these_lengths():
    wheels, half_track, radius = ("right_wheel", "left_wheel"), 0.6, 0.2
    robot = _read_two_wheels(
        parameters={"position": wheels, "radius": ["right_tread", "left_tread"]}
    )
    args = {
        "position": {
            name: jnp.array([0.0, y, 0.0])
            for name, y in zip(wheels, (-half_track, half_track), strict=True)
        },
        "radius": dict.fromkeys(("right_tread", "left_tread"), jnp.asarray(radius)),
    }
    other = nhjax.systems.TwoWheeledRobot.rolling(
        1.0, 0.5, radius=radius, half_track=half_track
    )
    method, ends = nhjax.LobattoIIIAB(2), []
    for system, y0, own in (
        (robot.system, robot.initial_state(other.q0, other.v0, args=args), args),
        (other.system, other.initial_state(), None),
    ):
        sol = nhjax.integrate(system, method, y0, dt=0.05, num_steps=40, args=own)
        ends.append((sol.ys.q[-1], sol.ys.v[-1]))
    for found, expected in zip(*ends, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)


_HEAD_OF_CARTS = """<mujoco><compiler angle="radian"/>
<default><geom contype="0" conaffinity="0" mass="1"/></default>
<worldbody>{}</worldbody></mujoco>"""
PLANAR = """<body name="base" pos="0 0 0.1">
<joint name="x" type="slide" axis="1 0 0"/><joint name="y" type="slide" axis="0 1 0"/>
<joint name="heading" axis="0 0 1"/><geom type="box" size="0.2 0.1 0.04"/>{}{}</body>"""
WHEEL = """<body name="{0}" pos="0 {1} 0"><joint name="{0}" axis="0 1 0"/>
<geom name="{0}" type="cylinder" size="0.1 0.02" euler="1.5707963267948966 0 0"/></body>
"""


def test_wheel_that_positions_in_args_move_off_the_axle_is_named():
    wheels = WHEEL.format("right", -0.2), WHEEL.format("left", 0.2)
    model = _compiled(_HEAD_OF_CARTS.format(PLANAR.format(*wheels)))
    robot = nhjax.from_mujoco(
        model, rolling=["right", "left"], parameters={"position": ["right"]}
    )
    assert robot.contacts is not None
    assert "left across" not in robot.contacts.multiplier_names
    wider = {"position": {"right": jnp.array([0.0, -0.3, 0.0])}}
    robot.initial_state(args=wider)
    ahead = {"position": {"right": jnp.array([0.1, -0.2, 0.0])}}
    with pytest.raises(ValueError, match="'left across' was left out"):
        robot.initial_state(args=ahead)


def test_height_that_positions_in_args_change_is_named():
    body = """<body name="base" pos="0 0 0.1">
    <joint name="x" type="slide" axis="1 0 0"/><joint name="pitch" axis="0 1 0"/>
    <geom type="box" size="0.2 0.1 0.04"/>{}</body>"""
    model = _compiled(_HEAD_OF_CARTS.format(body.format(WHEEL.format("w", 0.2))))
    robot = nhjax.from_mujoco(
        model, rolling=["w"], parameters={"position": ["w"], "mass": ["w"]}
    )
    assert robot.contacts is not None
    assert robot.contacts.multiplier_names == ("w along",)
    robot.initial_state()
    with pytest.raises(ValueError, match="'w normal' was left out"):
        robot.initial_state(args={"position": {"w": jnp.array([0.15, 0.2, 0.0])}})


@pytest.mark.parametrize("offset", [0.02, -0.02])
def test_caster_that_cannot_touch_with_the_other_wheels_is_named(offset):
    body = f"""<body name="base" pos="0 0 0.1"><freejoint name="root"/>
    <geom type="box" size="0.3 0.1 0.02"/>
    <geom name="front" size="0.03" pos="0.3 0 -0.07"/>
    <geom name="rear" size="0.03" pos="-0.3 0 {offset - 0.07}"/>
    {WHEEL.format("right", -0.2)}{WHEEL.format("left", 0.2)}</body>"""
    rolling = {"left": "no slip", "right": "no slip"}
    rolling |= {"front": "slides", "rear": "slides"}
    robot = nhjax.from_mujoco(_compiled(_HEAD_OF_CARTS.format(body)), rolling=rolling)
    with pytest.raises(ValueError, match=f"'rear normal' .* violated by {offset:.3g}"):
        robot.initial_state(project=True)


def test_equality_that_contradicts_another_one_is_named():
    text = CLOSED["joint equality"]
    first = text[text.index('<joint name="gears') : text.index("</equality>")]
    second = first.replace("gears", "more").replace('"0.1 ', '"0.4 ')
    model = _compiled(text.replace(first, first + second))
    robot = nhjax.from_mujoco(model)
    assert robot.loops == ("gears",)
    with pytest.raises(ValueError, match=r"'more' was left out, .* is violated"):
        robot.initial_state(project=True)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ({"position": {"top": 1.0}}, r"\['top'\]` must have shape \(3,\), got shape"),
        ({"position": {"b": jnp.zeros(3)}}, "unknown name 'b'; the names are top"),
    ],
)
def test_wrong_position_in_args_raises(args, message):
    robot = nhjax.from_mujoco(
        _compiled(OPEN["ball joint"]), parameters={"position": ["top"]}
    )
    with pytest.raises(ValueError, match=message):
        robot.initial_state(args=args)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (3.0, "must be None or a dictionary"),
        ({"control": 1.0}, "unknown key 'control'"),
        ({"controls": np.zeros(3)}, r"must have shape \(1,\)"),
    ],
)
def test_wrong_args_of_a_robot_raise(args, message):
    _, robot = _robot("cart and pole")
    with pytest.raises((TypeError, ValueError), match=message):
        robot.system.lagrangian(0.0, jnp.zeros(2), jnp.zeros(2), args)


# --- What cannot be read -------------------------------------------------------------

JOINT = '<body name="b"><joint name="j" {}/><geom name="g" size="0.1" {}/></body>'
APART = 'contype="0" conaffinity="0"'


def _text(joint="", rest="", geom=APART, before=""):
    bodies = JOINT.format(joint, geom)
    return f"<mujoco>{before}<worldbody>{bodies}</worldbody>{rest}</mujoco>"


def _actuator(text):
    return _text(rest=f"<actuator>{text}</actuator>")


REFUSED = {
    "limit": (_text('range="-1 1" limited="true"'), "joint 'j': a limit", "limits"),
    "muscle": (
        _actuator('<muscle name="m" joint="j" lengthrange="0 1"/>'),
        "actuator 'm': a muscle",
        "actuators",
    ),
    "filter": (
        _actuator('<general name="m" joint="j" dyntype="filter" dynprm="0.1"/>'),
        "actuator 'm': internal dynamics",
        "actuators",
    ),
    "site": (
        _text(rest='<actuator><motor name="m" site="s"/></actuator>').replace(
            "</body>", '<site name="s"/></body>'
        ),
        "actuator 'm': the transmission site",
        "actuators",
    ),
    "plugin": (
        _actuator('<plugin name="m" joint="j" plugin="mujoco.pid"/>').replace(
            "<worldbody>",
            '<extension><plugin plugin="mujoco.pid"/></extension><worldbody>',
        ),
        "actuator 'm': a plugin",
        "actuators",
    ),
    "fluid": (_text(before='<option density="1.2"/>'), "forces of a fluid", "fluid"),
    "contacts": (
        _text(geom="").replace(
            "<worldbody>", '<worldbody><geom name="floor" size="1"/>'
        ),
        r"'floor' \(a sphere of the world\) and 'g' \(a sphere of the body 'b'\) can",
        "contacts",
    ),
    "friction": (
        _text('type="ball" frictionloss="1"'),
        "joint 'j': friction of a ball or free joint",
        "friction loss",
    ),
    "spring": (
        _text('stiffness="2" springyield="0.1"'),
        "joint 'j': a spring that yields",
        "springs",
    ),
    "tendon": (
        _text(
            rest='<tendon><spatial name="rope"><site site="s"/><site site="w"/>'
            "</spatial></tendon>"
        ).replace("</body>", '<site name="s"/></body><site name="w"/>'),
        "tendon 'rope': a spatial tendon",
        "tendons",
    ),
}


@pytest.mark.parametrize("name", sorted(REFUSED))
def test_unsupported_part_is_refused_by_name_unless_ignored(name):
    text, message, word = REFUSED[name]
    with pytest.raises(ValueError, match=message) as caught:
        nhjax.from_mujoco(_compiled(text))
    assert f"ignore=({word!r},)" in str(caught.value)
    assert nhjax.from_mujoco(_compiled(text), ignore=[word]).coordinates


CLOTH = (
    '<flexcomp name="cloth" type="grid" count="3 3 1" spacing="0.1 0.1 0.1" '
    f'radius="0.01" mass="1" rigid="true"><contact {APART}/></flexcomp></worldbody>'
)
COMPENSATED = _text('type="hinge" axis="0 1 0" actuatorgravcomp="true"').replace(
    '<body name="b"', '<body name="b" gravcomp="1"'
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody/></mujoco>", "nothing in the model can move"),
        (_text(geom=APART).replace("</worldbody>", CLOTH), "flexes .1.: deformable"),
        (COMPENSATED, "joint 'j': gravity compensation by actuators, without"),
    ],
)
def test_part_that_cannot_be_ignored_says_so(text, message):
    with pytest.raises(ValueError, match="cannot be ignored") as caught:
        nhjax.from_mujoco(_compiled(text))
    assert re.search(message, str(caught.value))


def test_gravity_compensation_by_actuators_acts_as_in_mujoco():
    motor = '<actuator><motor joint="j"/></actuator></mujoco>'
    text = COMPENSATED.replace("</mujoco>", motor)
    robot = nhjax.from_mujoco(_compiled(text))
    found = nhjax.motion(robot.system, 0.0, robot.initial_state(), robot.args)
    np.testing.assert_allclose(found.acceleration, 0.0, atol=1e-14)


WRONG = [
    ("no_such_file.xml", {}, "there is no file no_such_file.xml"),
    ("<mujoco/>", {}, "To read a string, pass `mujoco.MjSpec.from_string"),
    (3, {}, "must be the path of an MJCF or URDF file"),
    (TWO_WHEELS, {"root": "floating"}, "`root` must be one of 'free', 'planar'"),
    (TWO_WHEELS, {"rolling": ["left_tread"]}, 'Pass `root="free"`'),
    (_text(), {"ignore": ["walls"]}, "each word of `ignore` must be one of"),
    (_text(), {"ignore": "limits"}, r"write `ignore=\('limits',\)`"),
    (_text(), {"root": "free"}, "`root` is for URDF files only"),
    (_text(), {"rolling": ["h"]}, "`rolling` has 'h', but the geoms are 'g' .a sphere"),
    (_text(), {"motors": "x"}, r"write `motors=\('x',\)`"),
    (_text(), {"motors": ["x"]}, "`motors` has 'x', but the joints that can have"),
    (_text(), {"rolling": "g"}, r"write `rolling=\('g',\)`"),
    (_text(), {"rolling": {"g": "fast"}}, "must be one of 'no slip'"),
    (_text(), {"rolling": ["g"]}, "is 0.1 m below the ground"),
    (_text(), {"rolling": ["g"], "ground": "floor"}, "must be the name of a plane"),
    (_text(), {"parameters": {"weight": ["b"]}}, "unknown kind 'weight'"),
    (_text(), {"parameters": {"mass": ["c"]}}, "has 'c', but the names are b"),
    (_text(), {"parameters": {"mass": "b"}}, r"write \['b'\]"),
    (_text(), {"parameters": {"radius": ["g"]}}, "names are none. They are those of"),
    (
        OPEN["free body"],
        {"parameters": {"position": ["stone"]}},
        "names are none. The position of a body with a free joint is a coordinate",
    ),
    (
        _text(geom='type="box" size="1 1 1" contype="0"').replace('size="0.1"', ""),
        {"rolling": ["g"]},
        "is a box, but only a cylinder",
    ),
]


URDF = """<robot name="r"><link name="{}"/><link name="a"><inertial>
<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
</link><joint name="k" type="floating"><parent link="{}"/><child link="a"/></joint>
</robot>"""
PLANES = (
    f'<geom name="p" type="plane" size="1 1 1" {APART}/>'
    f'<geom name="r" type="plane" size="1 1 1" {APART}/></worldbody>'
)
MESH = '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'
WRONG += [
    (_text(), {"parameters": ["mass"]}, "must be a dictionary such as"),
    (
        _text().replace("</worldbody>", PLANES),
        {"rolling": ["g"]},
        "the model has the planes p, r",
    ),
    (
        _text(geom='type="mesh" mesh="m" contype="0"', before=MESH).replace(
            'size="0.1"', ""
        ),
        {"rolling": ["g"]},
        "the geom 'g' is a mesh",
    ),
    (_text(geom='mass="0" contype="0"'), {}, "Give this body a geom with a mass"),
    (
        _text().replace("<worldbody>", '<worldbody><body name="m" mocap="true"/>'),
        {},
        "body 'm': its pose is given by mocap data",
    ),
    (nhjax.example_robot_file("wheeled_quadruped"), {"root": "free"}, "an MJCF file"),
    (Path(__file__).parent, {}, "there is no file"),
]


@pytest.mark.parametrize("case", range(len(WRONG)))
def test_wrong_argument_is_named_with_advice(case):
    model, options, message = WRONG[case]
    if isinstance(model, str) and model.startswith("<mujoco><"):
        model = mujoco.MjSpec.from_string(model)
    with pytest.raises((TypeError, ValueError, FileNotFoundError), match=message):
        nhjax.from_mujoco(model, **options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco><worldbody>", "is not an XML file"),
        ("<mujoco><worldbody><wheel/></worldbody></mujoco>", "MuJoCo cannot read"),
        ('<robot name="r"><link name="a"/><link name="b"/></robot>', "2 root links"),
    ],
)
def test_broken_file_is_refused_with_its_path(text, message, tmp_path):
    path = tmp_path / "broken.xml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message) as caught:
        nhjax.from_mujoco(path)
    assert "broken.xml" in str(caught.value)


def test_urdf_with_a_link_named_world_refuses_root(tmp_path):
    path = tmp_path / "free.urdf"
    path.write_text(URDF.format("world", "world"), encoding="utf-8")
    with pytest.raises(ValueError, match="has a link named world"):
        nhjax.from_mujoco(path, root="free")


def test_urdf_link_without_inertia_is_named(tmp_path):
    path = tmp_path / "light.urdf"
    text = URDF.format("base", "base").replace("floating", "continuous")
    text = re.sub(r"<inertial>.*</inertial>", "", text, flags=re.DOTALL)
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match="Give this body a geom with a mass"):
        nhjax.from_mujoco(path)


def _urdf_with_mesh(folder, address):
    """Write a URDF file of one body, whose shape is a tetrahedron in a mesh file."""
    path = folder / "carrier_description" / "urdf" / "carrier.urdf"
    meshes = folder / "carrier_description" / "meshes"
    for made in (path.parent, meshes):
        made.mkdir(parents=True)
    corners = 0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    normal, last = np.zeros(3, "<f4").tobytes(), bytes(2)
    parts = [normal + corners[list(face)].tobytes() + last for face in faces]
    count = len(faces).to_bytes(4, "little")
    (meshes / "body.stl").write_bytes(bytes(80) + count + b"".join(parts))
    path.write_text(
        '<robot name="carrier"><link name="body"><collision><geometry>'
        f'<mesh filename="{address}"/></geometry></collision></link></robot>',
        encoding="utf-8",
    )
    return path


def test_mesh_of_a_ros_package_is_found_around_the_file(tmp_path):
    path = _urdf_with_mesh(tmp_path, "package://carrier_description/meshes/body.stl")
    robot = nhjax.from_mujoco(path, root="free", parameters={"mass": ["body"]})
    # The density is that of water.
    np.testing.assert_allclose(robot.args["mass"]["body"], 1000 * 0.1**3 / 6, rtol=1e-6)


@pytest.mark.parametrize("package", ["package://other/meshes/", "meshes/"])
def test_mesh_that_is_missing_is_named_with_advice(package, tmp_path):
    path = _urdf_with_mesh(tmp_path, f"{package}body.stl")
    with pytest.raises(
        ValueError, match=r"body\.stl.* package://NAME/\.\.\. in a folder NAME"
    ):
        nhjax.from_mujoco(path, root="free")


def test_file_that_is_no_xml_is_refused(tmp_path):
    path = tmp_path / "robot.py"
    path.write_text("x = 1", encoding="utf-8")
    with pytest.raises(ValueError, match=r"robot\.py is not an XML file"):
        nhjax.from_mujoco(path)


def test_wheel_above_the_ground_is_named_with_its_height():
    text = _text('type="free"', geom='contype="0"').replace('"b"', '"b" pos="0 0 1"')
    robot = nhjax.from_mujoco(_compiled(text), rolling={"g": "slides"})
    with pytest.raises(Exception, match="holonomic constraints violated") as caught:
        robot.initial_state()
    (note,) = [x for x in caught.value.__notes__ if "touch" in x]
    assert "'g' by 0.9 m" in note


@pytest.mark.parametrize(
    ("root", "count"), [("free", 8), ("planar", 5), ("fixed", 2), (None, 2)]
)
def test_root_of_urdf_moves_as_asked(root, count):
    robot = nhjax.from_mujoco(TWO_WHEELS, root=root, ignore=["contacts"])
    assert len(robot.coordinates) == count


def test_missing_mujoco_is_named_with_its_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=re.escape('pip install "nhjax[robots]"')):
        nhjax.from_mujoco("robot.xml")


# Wheels and motors of a URDF file

URDF_LINK = """<link name="{name}"><inertial><mass value="{mass}"/>
<inertia ixx="{j}" iyy="{j}" izz="{j}" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin rpy="{turned}"/><geometry>{shape}</geometry></collision></link>"""
URDF_JOINT = """<joint name="{side}_joint" type="continuous"><parent link="base"/>
<child link="{side}_wheel"/><origin xyz="0 {y} 0" rpy="-1.5707963267948966 0 0"/>
<axis xyz="{axis}"/></joint>"""
CASTER = """<link name="caster"><inertial><mass value="0.1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><sphere radius="0.03"/></geometry></collision></link>
<joint name="holder" type="fixed"><parent link="base"/><child link="caster"/>
<origin xyz="0.15 0 -0.04"/></joint>"""
WHEELS = ["left_wheel", "right_wheel"]


def _urdf_cart(folder, axis="0 0 1", turned="0 0 0", caster=False, **options):
    """A cart on two wheels whose cylinders have no names."""
    text = '<robot name="cart"><mujoco><compiler fusestatic="false"/></mujoco>'
    given = {"name": "base", "mass": 4, "j": 0.03, "turned": "0 0 0"}
    text += URDF_LINK.format(shape='<box size="0.4 0.2 0.05"/>', **given)
    wheel = '<cylinder radius="0.07" length="0.03"/>'
    for side, y in (("left", 0.15), ("right", -0.15)):
        given = {"name": f"{side}_wheel", "mass": 0.3, "j": 5e-4, "turned": turned}
        text += URDF_LINK.format(shape=wheel, **given)
        text += URDF_JOINT.format(side=side, y=y, axis=axis)
    path = folder / "cart.urdf"
    path.write_text(text + CASTER * caster + "</robot>")
    chosen = {
        "rolling": WHEELS,
        "root": "planar",
        "ground": rolling.Plane(height=-0.07),
        "motors": ["left_joint", "right_joint"],
        "ignore": ("contacts",),
    }
    return nhjax.from_mujoco(path, **(chosen | options))


def test_urdf_with_motors_drives_as_forces_on_its_joints(tmp_path):
    robot = _urdf_cart(tmp_path)
    assert robot.controls == ("left_joint", "right_joint")
    assert robot.contacts is not None
    assert robot.contacts.names == tuple(WHEELS)
    args = {"controls": jnp.array([0.02, 0.05])}
    y0 = robot.initial_state(args=args)
    found = nhjax.motion(robot.system, 0.0, y0, args).acceleration
    # Each wheel pushes with torque / radius; m_e and J_e include the turning wheels.
    left, right = args["controls"] / 0.07
    mass = 4.6 + 2 * 5e-4 / 0.07**2
    inertia = 0.031 + 0.6 * 0.15**2 + 2 * 5e-4 * (0.15 / 0.07) ** 2
    forward, turning = (left + right) / mass, 0.15 * (right - left) / inertia
    np.testing.assert_allclose(found[:3], [forward, 0.0, turning], atol=1e-12)


def test_robot_with_controls_of_user_takes_gains_of_any_structure(tmp_path):
    def controls(t, qpos, qvel, args):
        gains = args["controls"]
        return gains["torque"] - gains["damping"] * qvel[3:]

    robot = _urdf_cart(tmp_path, controls=controls)

    def distance(damping):
        args = {"controls": {"torque": jnp.full(2, 0.05), "damping": damping}}
        y0 = robot.initial_state(args=args)
        method = nhjax.LobattoIIIAB(2)
        sol = nhjax.integrate(
            robot.system, method, y0, dt=0.05, num_steps=10, args=args
        )
        return sol.ys.q[-1, 0]

    slope = jax.jit(jax.grad(distance))(0.01)
    run = jax.jit(distance)
    change = (run(0.0101) - run(0.0099)) / 2e-4
    np.testing.assert_allclose(slope, change, rtol=1e-5)
    assert slope < 0


@pytest.mark.parametrize("rounded", ["-1.5708", "-1.57"])
def test_rounded_quarter_turns_of_urdf_are_exact(tmp_path, rounded):
    exact = _urdf_cart(tmp_path).contacts
    text = (tmp_path / "cart.urdf").read_text().replace("-1.5707963267948966", rounded)
    (tmp_path / "rounded.urdf").write_text(text)
    found = nhjax.from_mujoco(
        tmp_path / "rounded.urdf",
        rolling=WHEELS,
        root="planar",
        ground=rolling.Plane(height=-0.07),
        ignore=("contacts",),
    )
    assert found.contacts is not None
    assert exact is not None
    assert found.contacts.multiplier_names == exact.multiplier_names
    q, v = jnp.arange(5.0), jnp.arange(5.0) + 1
    for name in WHEELS:
        slip = found.contacts[name].slip(0.0, q, v)
        np.testing.assert_array_equal(slip, exact[name].slip(0.0, q, v))


def test_wheel_that_cannot_turn_about_its_axis_warns(tmp_path):
    with pytest.warns(UserWarning, match="does not turn it about its axis"):
        _urdf_cart(tmp_path, axis="0 1 0")


def test_wheel_that_lies_flat_raises(tmp_path):
    with pytest.raises(ValueError, match="'left_wheel' lies flat on the ground"):
        _urdf_cart(tmp_path, turned="1.5707963267948966 0 0")


def test_fixed_sphere_without_slip_warns_and_sliding_one_carries_load(tmp_path):
    options = {"caster": True, "root": "free", "ground": None}
    rolls = [*WHEELS, "caster"]
    with pytest.warns(UserWarning, match=r"'caster': \"slides\"") as record:
        _urdf_cart(tmp_path, rolling=rolls, **options)
    assert len(record) == 1
    kinds = dict.fromkeys(WHEELS, "no slip") | {"caster": "slides"}
    robot = _urdf_cart(tmp_path, rolling=kinds, **options)
    y0 = robot.initial_state(project=True)
    assert robot.contacts is not None
    forces = robot.contacts.forces(0.0, y0, robot.args)
    # The caster is 0.15 m before the axle and carries its own weight only.
    upwards = [float(forces[name][2]) for name in rolls]
    np.testing.assert_allclose(upwards, [2.3 * 9.81, 2.3 * 9.81, 0.981], rtol=1e-10)


def test_motors_of_compiled_model_raise():
    model = _compiled(_text())
    with pytest.raises(ValueError, match="an MjModel cannot get `motors`"):
        nhjax.from_mujoco(model, motors=["x"])
