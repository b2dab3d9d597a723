"""Films show each machine in the right place. Few of these tests need OpenGL."""

import importlib.util
import os
import subprocess
import sys
import time
import types
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import systems
from nhjax._films._gallery import _LOOKS, looks_of
from nhjax._films._render import _gl_context, view_of
from nhjax._films._sampling import configurations, frame_times
from nhjax._films._scene import round_length, Scene, visible_geoms
from nhjax._films._view import _capsule, Show
from nhjax.systems._base import AbstractExample
from support.pages import blocks, DOCS, page, run_page


mujoco: Any = importlib.import_module("mujoco")


def made_up(ts, q, v):
    """A solution with these saved states."""
    ts, v = jnp.asarray(ts, float), jnp.asarray(v)
    q = np.asarray(q) if isinstance(q, list) else q
    state = nhjax.State(jax.tree.map(jnp.asarray, q), v, v, v[:, :0])
    return nhjax.Solution(
        ts[0], ts[-1], ts, state, {}, nhjax.RESULTS.successful, interpolation=None
    )


def at_rest(machine, count=2):
    """A solution in which a machine stays at its start."""
    q = jax.tree.map(lambda x: jnp.stack([x] * count), machine.q0)
    return made_up(range(count), q, jnp.zeros((count, *machine.v0.shape)))


def rolling_disc(count=21):
    """A disc of radius one that rolls along x at 1.3 m/s for two seconds."""
    ts = np.linspace(0, 2, count)
    q = np.stack([1.3 * ts, 0 * ts, 1.3 * ts, 0 * ts], axis=1)
    return systems.VerticalRollingDisc(), made_up(
        ts, q, np.tile([1.3, 0, 1.3, 0], (count, 1))
    )


def test_frame_times_are_equally_spaced_and_include_both_ends():
    _, sol = rolling_disc()
    np.testing.assert_allclose(frame_times("f", sol, 0.5), [0, 0.5, 1, 1.5, 2])
    np.testing.assert_allclose(frame_times("f", sol, 0.8), [0, 0.8, 1.6])
    backwards = made_up([0, -1], np.zeros((2, 1)), np.zeros((2, 1)))
    np.testing.assert_allclose(frame_times("f", backwards, 0.5), [0, -0.5, -1])


def test_configurations_between_states_follow_the_cubic_of_positions_and_velocities():
    ts = np.linspace(0, 6, 13)
    sol = made_up(ts, np.sin(ts)[:, None], np.cos(ts)[:, None])
    times = np.linspace(0, 6, 101)
    q = configurations("f", sol, times, None)
    # The error of cubic Hermite interpolation is at most h⁴/384.
    np.testing.assert_allclose(q[:, 0], np.sin(times), atol=0.5**4 / 380)


def test_configurations_on_a_group_turn_with_the_body_velocity():
    ts, times = np.linspace(0, 2, 9), np.linspace(0, 2, 33)

    def quaternion(t):
        half = 0.9 * t[:, None]
        return np.concatenate([np.cos(half), np.sin(half) * [[0.0, 0.6, 0.8]]], axis=1)

    v = np.tile(1.8 * np.array([0, 0.6, 0.8]), (9, 1))
    q = configurations("f", made_up(ts, quaternion(ts), v), times, nhjax.SO3())
    np.testing.assert_allclose(q, quaternion(times), atol=2e-3)


def test_dense_output_is_evaluated():
    oscillator = systems.HarmonicOscillator()
    sol = nhjax.integrate(
        oscillator.system,
        nhjax.LobattoIIIAB(2),
        oscillator.initial_state(),
        dt=0.1,
        num_steps=4,
        saveat=nhjax.SaveAt(dense=True),
    )
    q = configurations("f", sol, frame_times("f", sol, 0.05), None)
    assert q.shape == (9, 1)
    np.testing.assert_allclose(q[3], sol.evaluate(0.15).q)


def test_every_system_of_the_gallery_has_looks():
    kinds = [x for x in vars(systems).values() if isinstance(x, type)]
    assert {x for x in kinds if issubclass(x, AbstractExample)} == {*_LOOKS}


def test_blade_of_transmission_points_along_the_motion_of_the_passenger():
    example = systems.ContinuouslyVariableTransmission(
        q0=(0.3, 0.7, -0.2), v0=(1.0, 0.4, -np.sin(0.7))
    )
    scene = Scene("f", example, at_rest(example), np.zeros(1), True)
    scene.place(0)
    blade = scene.data.body("passenger").xmat.reshape(3, 3)[:, 0]
    velocity = np.array([1.0, -np.sin(0.7), 0.0])
    np.testing.assert_allclose(np.cross(blade, velocity), 0, atol=1e-12)
    np.testing.assert_allclose(scene.data.body("passenger").xpos, [0.3, -0.2, 0])


@pytest.mark.parametrize("machine", _LOOKS, ids=lambda kind: kind.__name__)
def test_looks_of_machine_place_all_bodies(machine):
    example = machine()
    scene = Scene("f", example, at_rest(example), np.zeros(1), True)
    scene.place(0)
    assert np.all(np.isfinite(scene.data.geom_xpos))
    assert scene.trails.shape[1:] == (1, 3)
    looks = looks_of(example)
    assert looks is not None
    # All shapes are above the ground, except for the tilted rim of a wheel.
    lowest = scene.trails[..., 2] if scene.trails.size else 0.0
    if looks.ground == 0:
        np.testing.assert_allclose(lowest, 0, atol=1e-12)
    rotations = scene.data.xmat.reshape(-1, 3, 3)
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2),
        np.tile(np.eye(3), (len(rotations), 1, 1)),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("machine", "bodies"),
    [
        (systems.VerticalRollingDisc, ["disc"]),
        (systems.RollingDisc, ["disc"]),
        (systems.TwoWheeledRobot, ["right", "left"]),
        (systems.WhippleBicycle, ["rear wheel", "front wheel"]),
        (systems.RollingTorus, ["body"]),
        (systems.Rattleback, ["body"]),
        (systems.ChaplyginSphere, ["body"]),
        (systems.ChaplyginTop, ["body"]),
    ],
    ids=lambda x: getattr(x, "__name__", None),
)
def test_wheels_of_a_film_do_not_slip_where_they_touch(machine, bodies):
    example, step = machine(), 1e-5
    group = example.system.manifold_of(example.q0)
    after = group.act(example.q0, step * example.v0)
    q = jax.tree.map(lambda x, y: jnp.stack([x, y]), example.q0, after)
    sol = made_up([0, step], q, jnp.stack([example.v0] * 2))
    scene = Scene("f", example, sol, np.array([0, step]), True)
    for name, path in zip(bodies, scene.trails, strict=True):
        scene.place(0)
        body = scene.data.body(name)
        touching = body.xmat.reshape(3, 3).T @ (path[0] - body.xpos)
        scene.place(1)
        later = body.xpos + body.xmat.reshape(3, 3) @ touching
        # The contact itself moves by the step times the speed.
        assert np.linalg.norm(later - path[0]) < 1e-8
        assert np.linalg.norm(path[1] - path[0]) > 1e-8


def test_bicycle_wheels_touch_the_ground_in_a_leaned_pose():
    bicycle = systems.WhippleBicycle.running(5.0, lean=0.3, steer=0.2)
    scene = Scene("f", bicycle, at_rest(bicycle), np.zeros(1), True)
    scene.place(0)
    for name, radius in (("rear", 0.3), ("front", 0.35)):
        wheel = scene.data.body(f"{name} wheel")
        axle = wheel.xmat.reshape(3, 3)[:, 1]
        lowest = wheel.xpos[2] - radius * np.sqrt(1 - axle[2] ** 2)
        assert abs(lowest) < 1e-9
    # Lean and steer to the right: the axles fall to the right, the front one turns.
    assert scene.data.body("rear wheel").xmat[7] > 0.2
    assert scene.data.body("fork").xmat[3] < -0.1


CART = """
<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
  <body name="base" pos="0 0 0.1">
    <joint name="x" type="slide" axis="1 0 0"/>
    <geom type="box" size="0.2 0.1 0.03" mass="1"/>
    <camera name="front" pos="1 0 0.2" xyaxes="0 1 0 0 0 1"/>
    <body name="wheel"><joint name="turn" axis="0 1 0"/>
      <geom name="wheel" type="cylinder" size="0.1 0.02" euler="-90 0 0"/></body>
  </body></worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def cart():
    spec = mujoco.MjSpec.from_string(CART)
    return nhjax.from_mujoco(spec, rolling={"wheel": "no longitudinal slip"})


def test_robot_is_shown_with_ground_light_sky_and_marked_wheels(cart):
    sol = made_up([0, 1], [[0.0, 0.0], [0.5, 5.0]], [[0.5, 5.0], [0.5, 5.0]])
    scene = Scene("f", cart, sol, np.linspace(0, 1, 5), True)
    model = scene.model
    # Two bars on the wheel, and the ground.
    assert model.ngeom == 2 + 2 + 1
    assert (model.nlight, model.ntex) == (1, 2)
    scene.place(4)
    np.testing.assert_allclose(scene.data.body("wheel").xpos, [0.5, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(scene.trails[0][:, 0], 0.5 * scene.times, atol=1e-9)
    np.testing.assert_allclose(scene.trails[0][:, 2], 0, atol=1e-12)
    # The model that was read is not changed.
    assert len(cart.mujoco_model.geoms) == 2


def test_robot_of_a_compiled_model_is_shown_as_it_is():
    model = mujoco.MjSpec.from_string(CART).compile()
    width = model.vis.global_.offwidth
    robot = nhjax.from_mujoco(model, rolling={"wheel": "no longitudinal slip"})
    sol = made_up([0], [[0.2, 0.0]], [[0.0, 0.0]])
    scene = Scene("f", robot, sol, np.zeros(1), True)
    scene.place(0)
    assert scene.model.ngeom == 2
    np.testing.assert_allclose(scene.data.body("base").xpos, [0.2, 0, 0.1])
    scene.model.vis.global_.offwidth = width + 1
    assert model.vis.global_.offwidth == width


def test_ground_of_a_robot_is_where_its_wheels_touch():
    text = CART.replace('pos="0 0 0.1"', 'pos="0 0 0.4"')
    robot = nhjax.from_mujoco(
        mujoco.MjSpec.from_string(text),
        rolling={"wheel": "no longitudinal slip"},
        ground=nhjax.rolling.Plane(height=0.3),
    )
    sol = made_up([0], [[0.0, 0.0]], [[0.0, 0.0]])
    scene = Scene("f", robot, sol, np.zeros(1), True)
    assert scene.model.geom("nhjax ground").pos[2] == pytest.approx(0.3)


def test_scene_of_a_robot_does_not_inherit_defaults_of_its_geoms():
    colour = '<geom contype="0" conaffinity="0" rgba="0 0 1 1" group="4"/>'
    text = CART.replace('<geom contype="0" conaffinity="0"/>', colour)
    spec = mujoco.MjSpec.from_string(text)
    robot = nhjax.from_mujoco(spec, rolling={"wheel": "no longitudinal slip"})
    sol = made_up([0], [[0.0, 0.0]], [[0.0, 0.0]])
    model = Scene("f", robot, sol, np.zeros(1), True).model
    np.testing.assert_allclose(model.geom("nhjax ground").rgba, [0.5, 0.5, 0.5, 1])
    # The ground and two bars are drawn; the geoms of the model are not.
    assert len(visible_geoms(model)) == 3


def test_camera_follows_stays_or_is_one_of_the_model(cart):
    sol = made_up([0, 1], [[0.0, 0.0], [9.0, 90.0]], [[9.0, 90.0], [9.0, 90.0]])
    scene = Scene("f", cart, sol, np.linspace(0, 1, 41), False)
    follow = view_of(scene, "follow", (640, 480))
    assert np.ptp(follow.centres[:, 0]) == pytest.approx(9, abs=0.1)
    fixed = view_of(scene, "fixed", (640, 480))
    assert np.ptp(fixed.centres) == pytest.approx(4.5, abs=0.1)
    assert fixed.distance > follow.distance
    assert view_of(scene, "front", (640, 480)).name == "front"
    chosen = {"azimuth": 90, "distance": 3.0, "lookat": (1, 2, 3)}
    given = view_of(scene, chosen, (640, 480))
    assert (given.azimuth, given.elevation, given.distance) == (90, -20, 3)
    np.testing.assert_allclose(given.centres[7], [1, 2, 3])
    with pytest.raises(ValueError, match=r"`camera` .* 'follow', 'fixed', 'front', or"):
        view_of(scene, "back", (640, 480))
    with pytest.raises(ValueError, match="a key of `camera`"):
        view_of(scene, {"zoom": 2}, (640, 480))
    with pytest.raises(ValueError, match="'lookat'"):
        view_of(scene, {"lookat": (1, 2)}, (640, 480))


def test_own_looks_show_a_machine_of_the_user():
    ball = nhjax.Looks(
        "<mujoco><worldbody><body name='ball'><geom size='0.1'/></body>"
        "<geom type='box' size='1 1 0.1' pos='0 0 -0.5'/></worldbody></mujoco>",
        lambda t, q, args: {"ball": (q, jnp.eye(3))},
        ground=None,
    )
    sol = made_up([0, 1], [[0.0, 0, 0], [0, 0, 2]], [[0.0, 0, 2], [0, 0, 2]])
    scene = Scene("f", ball, sol, np.array([0.0, 0.5]), True)
    scene.place(1)
    np.testing.assert_allclose(scene.data.body("ball").xpos, [0, 0, 1], atol=1e-12)
    assert scene.trails.shape == (0, 2, 3)
    # The ground is below the box, which belongs to the machine.
    assert scene.model.geom("nhjax ground").pos[2] < -0.6


@pytest.mark.parametrize(
    ("size", "expected"), [(1.0, 1), (0.99, 0.5), (0.3, 0.2), (7, 5), (23, 20)]
)
def test_round_length_is_one_two_or_five_times_a_power_of_ten(size, expected):
    assert round_length(size) == pytest.approx(expected)


DISC, ROLLING = rolling_disc()


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"path": "film.avi"}, ValueError, r"`path` must end with one of \.mp4, \.gif"),
        ({"path": "no/film.gif"}, FileNotFoundError, "no folder no"),
        ({"fps": 0}, ValueError, "`fps` must be positive, got 0"),
        ({"speed": -1.0}, ValueError, "`speed` must be positive"),
        ({"size": (100, 75)}, ValueError, r"`size` must be even .* got \(100, 75\)"),
        ({"size": (8, 8)}, ValueError, "`size` must be at least 16"),
        ({"t": 1.0}, ValueError, "`t` .* use it with .png only"),
        ({"path": "a.png", "t": 7.0}, ValueError, "`t` must be between 0.0 and 2.0"),
        ({"sol": "run"}, TypeError, "`sol` must be a Solution .* got str"),
        (
            {"machine": systems.ChaoticSystem().system},
            TypeError,
            "LagrangianSystem, which has no",
        ),
        (
            {"machine": None},
            TypeError,
            "`machine` must be .* WhippleBicycle.* NoneType",
        ),
        (
            {"sol": jax.tree.map(lambda x: jnp.stack([x, x]), ROLLING)},
            ValueError,
            r"`sol` is a batch of shape \(2,\)\. Select one member",
        ),
        (
            {"sol": eqx.tree_at(lambda sol: (sol.ts, sol.ys), ROLLING, (None, None))},
            ValueError,
            r"`sol` has no saved states\. Pass .*dense=True",
        ),
        (
            {"sol": made_up([np.inf], np.zeros((1, 4)), np.zeros((1, 4)))},
            ValueError,
            "`sol` has no saved states: it is empty",
        ),
        (
            {"sol": made_up([0, 1], np.full((2, 4), np.nan), np.zeros((2, 4)))},
            ValueError,
            "configurations that are not finite",
        ),
        (
            {"sol": rolling_disc(2)[1], "machine": None},
            TypeError,
            "`machine` must be",
        ),
        (
            {"machine": nhjax.Looks("<mujoco>", lambda t, q, args: {})},
            ValueError,
            "MuJoCo cannot read the `mjcf`",
        ),
        (
            {
                "machine": nhjax.Looks(
                    "<mujoco><worldbody><body name='a'/></worldbody></mujoco>",
                    lambda t, q, args: {"b": (q[:3], jnp.eye(3))},
                )
            },
            ValueError,
            "bodies of the `mjcf` are a, but `poses` returns b",
        ),
    ],
)
def test_render_with_invalid_argument_raises(changes, error, message):
    given = {"machine": DISC, "sol": ROLLING, "path": "film.mp4", "fps": 10} | changes
    with pytest.raises(error, match=message):
        nhjax.render(**given)


def test_render_of_states_that_miss_turns_of_a_wheel_raises():
    # Between the states the wheel turns by 30 rad, which its angle does not show.
    ts = np.arange(4.0)
    turns = (30 - 2 * np.pi) * ts
    q = np.stack([30 * ts, 0 * ts, turns, 0 * ts], axis=1)
    sol = made_up(ts, q, np.tile([30.0, 0, 30, 0], (4, 1)))
    sol = made_up(ts, q * [1, 1, 0, 1], sol.ys.v)
    with pytest.raises(ValueError, match=r"too far apart: coordinate 2 .*dense=True"):
        nhjax.render(DISC, sol, "film.gif")


def test_tuple_configurations_need_the_manifold_of_the_looks():
    disc = systems.RollingDisc()
    sol = at_rest(disc)
    with pytest.raises(ValueError, match="Give the Looks their `manifold`"):
        configurations("f", sol, np.zeros(1), None)


def test_missing_opengl_raises_with_advice(monkeypatch):
    def fail(*size):
        raise RuntimeError("no display")

    monkeypatch.setenv("MUJOCO_GL", "egl")
    stub = types.SimpleNamespace(GLContext=fail)
    monkeypatch.setitem(sys.modules, "mujoco.egl", stub)
    with pytest.raises(
        RuntimeError, match=r"no OpenGL context .*'egl'.*no display.*osm"
    ):
        _gl_context((64, 48))


PICTURES = """
import sys
import numpy as np
from PIL import Image, ImageSequence
import nhjax
sys.path.insert(0, "tests")
from test_films import rolling_disc

disc, sol = rolling_disc()
folder = sys.argv[1]
try:
    nhjax.render(disc, sol, f"{folder}/a.png", size=(64, 48), fps=5, t=1.0)
except (ImportError, RuntimeError) as error:
    assert "nhjax.render" in str(error), error
    print("no picture:", error)
    sys.exit()
pixels = np.asarray(Image.open(f"{folder}/a.png")).astype(int)
assert pixels.shape == (48, 64, 3)
# The tyre is dark, its mark orange, the ground grey, and the sky bluish.
red, green, blue = np.moveaxis(pixels, 2, 0)
assert np.sum(np.max(pixels, axis=2) < 70) > 20, "no tyre"
assert np.sum((red > 150) & (blue < 90)) > 5, "no mark"
is_grey = (np.ptp(pixels, axis=2) < 16) & (red > 120) & (red < 240)
assert np.sum(is_grey) > 100, "no ground"
assert np.sum((blue > red + 8)[:8]) > 20, "no sky"
# The run ends at 2 s, which is not the time of a frame.
for end, options in (("default", {}), ("end", {"t": 2.0})):
    nhjax.render(
        disc, sol, f"{folder}/{end}.png", size=(64, 48), fps=5, speed=7.0, **options
    )
ends = [np.asarray(Image.open(f"{folder}/{x}.png")) for x in ("default", "end")]
assert np.array_equal(*ends), "the default is not the end of the run"
nhjax.render(disc, sol, f"{folder}/a.gif", size=(64, 48), fps=5, speed=2.0)
frames = list(ImageSequence.Iterator(Image.open(f"{folder}/a.gif")))
assert len(frames) == 6, len(frames)
try:
    nhjax.render(disc, sol, f"{folder}/a.mp4", size=(64, 48), fps=5)
    with open(f"{folder}/a.mp4", "rb") as film:
        assert film.read(12)[4:8] == b"ftyp"
except ImportError as error:
    assert 'pip install "nhjax[render]"' in str(error)
print("pictures")
"""


def test_render_writes_pictures_and_films_or_says_what_is_missing(tmp_path):
    # MuJoCo chooses the OpenGL library when it is imported.
    environment = os.environ | {"MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
    done = subprocess.run(
        [sys.executable, "-c", PICTURES, str(tmp_path)],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(("pictures", "no picture: nhjax.render"))


def test_import_loads_neither_robots_nor_films():
    code = (
        "import sys, nhjax; "
        "late = {'mujoco', 'viser', 'nhjax._robots', 'nhjax._films', 'nhjax.systems'}; "
        "sys.exit(' '.join(late & {*sys.modules}) or None)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


class Server:
    """A stand-in for viser's server, which keeps what was added to it."""

    def __init__(self, port=0, verbose=True):
        self.shapes, self.port, self.stopped = {}, port, False
        self.scene, self.gui, self.initial_camera = self, self, types.SimpleNamespace()

    def get_port(self):
        return self.port

    def set_up_direction(self, direction):
        self.up = direction

    def stop(self):
        self.stopped = True

    def atomic(self):
        import contextlib

        return contextlib.nullcontext()

    def add_slider(self, label, min, max, step, initial_value):
        slider = types.SimpleNamespace(min=min, max=max, step=step, value=initial_value)
        slider.on_update = lambda function: None
        return slider

    def add_checkbox(self, label, initial_value):
        box = types.SimpleNamespace(value=initial_value)
        box.on_update = lambda function: None
        return box

    def __getattr__(self, method):
        if not method.startswith("add_"):
            raise AttributeError(method)

        def add(name, *args, **options):
            self.shapes[name] = types.SimpleNamespace(kind=method[4:], **options)
            return self.shapes[name]

        return add


def test_view_moves_the_bodies_with_the_slider_and_plays():
    disc, sol = rolling_disc()
    server = Server(port=5)
    show = Show(server, Scene("view", disc, sol, np.linspace(0, 2, 41), True), 1.0)
    try:
        assert show.url == "http://localhost:5"
        assert "localhost:5" in repr(show)
        kinds = {shape.kind for shape in server.shapes.values()}
        assert kinds == {"frame", "cylinder", "box", "grid", "line_segments"}
        show._play.value = False
        time.sleep(0.1)
        show.show(1.0)
        body = server.shapes["/scene/bodies/1"]
        np.testing.assert_allclose(body.position, [1.3, 0, 1], atol=1e-9)
        half = np.array([np.cos(0.65), 0, np.sin(0.65), 0])
        np.testing.assert_allclose(body.wxyz, half, atol=1e-9)
        show._slider.value = 0.0
        show._play.value = True
        time.sleep(0.3)
        assert show._slider.value > 0
        assert body.position[0] < 1.3
        # The machine stays in the middle of the picture while it is followed.
        show._play.value = False
        time.sleep(0.1)
        show.show(1.0)
        ground = server.shapes["/scene"]
        moved = show._scene.centres[20] - show._scene.centres[0]
        assert moved[0] > 1.0
        np.testing.assert_allclose(ground.position, -moved, atol=1e-12)
        show._follow.value = False
        show.show(1.0)
        np.testing.assert_array_equal(ground.position, 0.0)
    finally:
        show.stop()
    assert server.stopped


def test_view_shows_meshes_ellipsoids_and_round_bars():
    server = Server()
    stone = systems.Rattleback()
    show = Show(server, Scene("view", stone, at_rest(stone), np.zeros(1), True), 1.0)
    show.stop()
    kinds = {shape.kind for shape in server.shapes.values()}
    assert {"mesh_simple", "icosphere", "box"} <= kinds
    vertices, faces = _capsule(0.1, 0.5)
    assert np.max(np.abs(vertices[:, 2])) == pytest.approx(0.6)
    assert faces.max() == len(vertices) - 1


def test_view_does_not_show_a_plane_that_is_transparent():
    hidden = nhjax.Looks(
        "<mujoco><worldbody><geom type='plane' size='1 1 1' rgba='0 0 0 0'/>"
        "<body name='ball'><geom size='0.1'/></body></worldbody></mujoco>",
        lambda t, q, args: {"ball": (q, jnp.eye(3, dtype=q.dtype))},
    )
    server = Server()
    sol = made_up([0], [[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]])
    Show(server, Scene("view", hidden, sol, np.zeros(1), True), 1.0).stop()
    assert "grid" not in {shape.kind for shape in server.shapes.values()}


def test_view_serves_a_page_or_says_what_is_missing():
    disc, sol = rolling_disc()
    if importlib.util.find_spec("viser") is None:
        with pytest.raises(ImportError, match=r'pip install "nhjax\[view\]"'):
            nhjax.view(disc, sol, block=False)
    else:
        show = nhjax.view(disc, sol, port=8099, block=False)
        show.show(1.0)
        show.stop()
    with pytest.raises(ValueError, match="`speed` must be positive"):
        nhjax.view(disc, sol, speed=0.0)


def test_films_page_runs_as_printed(tmp_path, monkeypatch):
    """Only the browser and the pictures, which need OpenGL, are left out."""
    import contextlib

    from nhjax._films import _render

    @contextlib.contextmanager
    def blank(scene, size):
        def draw(view, k):
            scene.place(k)
            return np.full((size[1], size[0], 3), 255, np.uint8)

        yield draw

    assert blocks(page("films"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(_render, "_renderer", blank)
    monkeypatch.setitem(sys.modules, "viser", types.SimpleNamespace(ViserServer=Server))
    run_page("films")
    assert {path.name for path in tmp_path.iterdir()} == {
        *("disc.gif", "disc.png", "coin.png")
    }


def test_films_of_the_pages_are_at_most_two_megabytes():
    films = list((DOCS / "films").glob("*.gif"))
    assert {path.stem for path in films} == {"bicycle", "mecanum", "rattleback"}
    for path in films:
        assert path.stat().st_size <= 2e6
        assert f"films/{path.name}" in page("films")
