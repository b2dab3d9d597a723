"""The scene of a film: a model of MuJoCo with ground, light and sky, and its poses."""

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._integrate import Solution
from .._manifold import AbstractLieGroup
from .._robots import mujoco_of, Robot
from .._system import State
from ._gallery import looks_of, names
from ._looks import Looks
from ._sampling import configurations


class Subject(NamedTuple):
    """A machine that a film can show.

    - `spec`: the shapes, as an `MjSpec` or as the robot's own `MjModel`.
    - `robot`, `looks`: the machine is one of these two, and the other is None.
    """

    spec: Any
    robot: Robot | None
    looks: Looks | None
    manifold: AbstractLieGroup | None


def subject_of(who: str, machine: Any) -> Subject:
    """Return the shapes of a robot, a machine of the gallery or a `Looks`."""
    mujoco = mujoco_of(f"nhjax.{who}", "robots")
    if isinstance(machine, Robot):
        return Subject(machine.mujoco_model, machine, None, machine.system.manifold)
    looks = machine if isinstance(machine, Looks) else looks_of(machine)
    if looks is None:
        raise TypeError(
            f"{who}: `machine` must be a robot of nhjax.from_mujoco, an nhjax.Looks, "
            f"or one of these machines of nhjax.systems: {', '.join(names())}. Got "
            f"{type(machine).__name__}, which has no shape: describe one with "
            "nhjax.Looks."
        )
    try:
        spec = mujoco.MjSpec.from_string(looks.mjcf)
    except ValueError as error:
        raise ValueError(f"{who}: MuJoCo cannot read the `mjcf`: {error}") from error
    for body in spec.worldbody.bodies:
        # The function `poses` places the bodies, without dynamics.
        body.mocap = True
    system = getattr(machine, "system", None)
    own = getattr(system, "manifold", None)
    return Subject(spec, None, looks, looks.manifold or own)


class Scene:
    """A model with the poses of a machine at some times.

    - `times`: the times, of shape (k,).
    - `centres`: the points at which the camera of a film looks, of shape (k, 3).
    - `reach(centres)`: the radius at which the balls about the given centres (one for
        each time) contain the machine.
    - `trails`: the paths to draw, of shape (paths, k, 3).
    """

    def __init__(
        self, who: str, machine: Any, sol: Solution, times: np.ndarray, trail: bool
    ):
        subject = subject_of(who, machine)
        self._mujoco = mujoco_of(f"nhjax.{who}", "robots")
        q = configurations(who, sol, times, subject.manifold)
        self.times, self.looks = times, subject.looks
        self._qpos, self._mocap, bare = self._places(who, subject, q)
        self._measure(bare)
        self.trails = self._paths(subject, q) if trail else np.zeros((0, len(times), 3))
        self.model, self._light = self._furnished(subject)
        self.data = self._mujoco.MjData(self.model)

    def _places(self, who: str, subject: Subject, q: Any) -> tuple[Any, Any, Any]:
        """Return qpos, the poses of the bodies, and the model without added ground.

        For a robot, the poses are None; for a `Looks`, qpos is None.
        """
        mujoco, spec = self._mujoco, subject.spec
        if subject.robot is not None:
            is_spec = isinstance(spec, mujoco.MjSpec)
            model = spec.copy().compile() if is_spec else spec
            nothing = jnp.zeros((len(self.times), 0))
            y = State(q, nothing, nothing, nothing)
            return np.asarray(subject.robot.qpos(y)), None, model
        assert subject.looks is not None
        poses = subject.looks.poses
        ts = jnp.asarray(self.times, jax.tree.leaves(q)[0].dtype)
        placed = jax.jit(jax.vmap(lambda t, q: poses(t, q, None)))(ts, q)
        model = spec.copy().compile()
        given = [model.body(i).name for i in range(1, model.nbody)]
        if {*placed} != {*given}:
            raise ValueError(
                f"{who}: the bodies of the `mjcf` are {', '.join(given)}, but `poses` "
                f"returns {', '.join(placed)}."
            )
        positions = np.stack([np.asarray(placed[name][0]) for name in given], axis=1)
        rotations = np.stack([np.asarray(placed[name][1]) for name in given], axis=1)
        count = len(self.times)
        if positions.shape[2:] != (3,) or rotations.shape[2:] != (3, 3):
            raise ValueError(
                f"{who}: `poses` must return positions of shape (3,) and rotations of "
                f"shape (3, 3), got {positions.shape[2:]} and {rotations.shape[2:]}."
            )
        quaternions = np.zeros((count, len(given), 4))
        for k in range(count):
            for i in range(len(given)):
                mujoco.mju_mat2Quat(quaternions[k, i], rotations[k, i].ravel())
        return None, (positions, quaternions), model

    def _paths(self, subject: Subject, q: Any) -> np.ndarray:
        """Compute the paths of a robot's contacts, or the `trails` of the looks."""
        ts = jnp.asarray(self.times, jax.tree.leaves(q)[0].dtype)
        if subject.robot is not None:
            contacts = subject.robot.contacts
            if contacts is None:
                return np.zeros((0, len(self.times), 3))
            args = subject.robot.args
            points = jax.jit(jax.vmap(lambda t, q: contacts.points(t, q, args)))(ts, q)
            return np.stack([np.asarray(x) for x in points.values()])
        assert subject.looks is not None
        if subject.looks.trails is None:
            return np.zeros((0, len(self.times), 3))
        trails = subject.looks.trails
        points = jax.jit(jax.vmap(lambda t, q: trails(t, q, None)))(ts, q)
        return np.swapaxes(np.asarray(points), 0, 1)

    def _measure(self, model: Any) -> None:
        """Compute the positions and the size of the machine, and its lowest point."""
        mujoco, data = self._mujoco, self._mujoco.MjData(model)
        solid = model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE
        # The fixed geoms of a `Looks` belong to the machine. The fixed geoms of a robot
        # are its world, which can be large and is left out.
        moving = solid & ((model.geom_bodyid > 0) | (self.looks is not None))
        moving = moving if np.any(moving) else solid
        mass = model.body_mass[1:]
        mass = mass if np.sum(mass) > 0 else np.ones_like(mass)
        radii = model.geom_rbound[moving]
        positions, centres, lows = [], [], []
        for k in range(len(self.times)):
            self._move(model, data, k)
            positions.append(data.geom_xpos[moving])
            centres.append(
                mass @ data.xipos[1:] / np.sum(mass) if mass.size else [0] * 3
            )
            lows.append(data.geom_xpos[moving] @ [0, 0, 1.0] - radii)
        places, middles = np.asarray(positions), np.asarray(centres)
        span = np.ptp(middles, axis=0)
        size = float(np.max(np.linalg.norm(places - middles[:, None], axis=2) + radii))
        self.low = float(np.min(lows)) if len(radii) else 0.0
        low, high = (places - radii[:, None]), (places + radii[:, None])
        box = (np.min(low, axis=(0, 1)), np.max(high, axis=(0, 1)))
        self.whole = (box[0] + box[1]) / 2
        # If a machine moves little, a camera that follows it would only shake.
        steady = np.where(span < size, np.mean(middles, axis=0), middles)
        self.centres = _smoothed(steady, self.times)
        self.places, self.radii = places, radii

    def reach(self, centres: np.ndarray) -> float:
        """Compute the radius of balls about these centres that contain the machine."""
        away = np.linalg.norm(self.places - centres[:, None], axis=2)
        return float(np.max(away + self.radii, initial=0.0)) or 1.0

    def _furnished(self, subject: Subject) -> tuple[Any, int | None]:
        """Return the compiled model, and the index of its added light or None.

        Ground, light and sky are added to an `MjSpec` that lacks them.
        """
        mujoco = self._mujoco
        if not isinstance(subject.spec, mujoco.MjSpec):
            # Return a copy, because the renderer writes the size of its pictures into
            # the model.
            return copy.copy(subject.spec), None
        spec, size = subject.spec.copy(), self.reach(self.centres)
        if subject.robot is not None:
            _mark_wheels(mujoco, spec, subject.robot)
        spec.stat.extent = size
        spec.stat.center = self.centres[0]
        spec.visual.quality.shadowsize = 2048
        spec.visual.quality.offsamples = 4
        spec.visual.quality.numslices = 48
        spec.visual.quality.numstacks = 24
        spec.visual.map.shadowclip = 7.0
        spec.visual.map.znear = 0.02
        spec.visual.map.zfar = 30.0
        spec.visual.map.haze = 0.35
        spec.visual.rgba.haze = [0.93, 0.95, 0.97, 1]
        spec.visual.headlight.ambient = [0.38, 0.38, 0.38]
        spec.visual.headlight.diffuse = [0.32, 0.32, 0.32]
        spec.visual.headlight.specular = [0.05, 0.05, 0.05]
        textures = [x.type for x in spec.textures]
        if mujoco.mjtTexture.mjTEXTURE_SKYBOX not in textures:
            spec.add_texture(
                name="nhjax sky",
                type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
                builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
                rgb1=[0.62, 0.74, 0.88],
                rgb2=[0.97, 0.98, 1.0],
                width=64,
                height=384,
            )
        grounds = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
        if not any(x.type in grounds for x in spec.geoms):
            _add_ground(mujoco, spec, self._ground(subject.robot, size), size)
        if not spec.lights:
            spec.worldbody.add_light(
                name="nhjax light",
                type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
                dir=LIGHT.tolist(),
                diffuse=[0.55, 0.55, 0.53],
                specular=[0.2, 0.2, 0.2],
                castshadow=True,
            )
        model = spec.compile()
        names = [model.light(i).name for i in range(model.nlight)]
        return model, names.index("nhjax light") if "nhjax light" in names else None

    def _ground(self, robot: Robot | None, size: float) -> float:
        """Return the height of the ground that is added."""
        below = self.low - 0.02 * size
        if self.looks is not None:
            return below if self.looks.ground is None else self.looks.ground
        if robot is None or robot.contacts is None:
            return min(0.0, below)
        return float(getattr(robot.contacts.contacts[0].ground, "height", 0.0))

    def place(self, k: int) -> None:
        """Put the bodies and the light where they are at the k-th time."""
        if self._light is not None:
            # A directional light casts shadows only up to some distance from its
            # position. Therefore it moves with the machine.
            distance = 5 * self.model.stat.extent
            self.model.light_pos[self._light] = self.centres[k] - distance * LIGHT
        self._move(self.model, self.data, k)

    def _move(self, model: Any, data: Any, k: int) -> None:
        if self._qpos is not None:
            data.qpos[:] = self._qpos[k]
        else:
            data.mocap_pos[:], data.mocap_quat[:] = (x[k] for x in self._mocap)
        mujoco = self._mujoco
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if model.ntendon:
            mujoco.mj_tendon(model, data)


# The direction of the light: from the left, from behind the camera, and from above.
LIGHT = np.array([0.35, 0.45, -0.82]) / np.linalg.norm([0.35, 0.45, -0.82])
# MuJoCo's colour for geoms that specify none. A geom of this colour shows the colour of
# its material, if it has a material.
PLAIN = [0.5, 0.5, 0.5, 1]


def _add_ground(mujoco: Any, spec: Any, height: float, size: float) -> None:
    spec.add_texture(
        name="nhjax ground",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.80, 0.82, 0.84],
        rgb2=[0.73, 0.755, 0.78],
        width=256,
        height=256,
    )
    # The texture is two cells wide. The width of a cell is a round length, at most the
    # size of the machine.
    cell = round_length(size)
    names = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    names[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "nhjax ground"
    spec.add_material(
        name="nhjax ground",
        textures=names,
        texuniform=True,
        texrepeat=[0.5 / cell, 0.5 / cell],
        specular=0.0,
        reflectance=0.0,
    )
    spec.worldbody.add_geom(
        name="nhjax ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, cell],
        pos=[0, 0, height],
        material="nhjax ground",
        # Colour and group are set, because the defaults of the model may have another
        # colour, or a group that is not drawn.
        rgba=PLAIN,
        group=0,
    )


def round_length(size: float) -> float:
    """Return the largest number <= `size` that is 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(size))
    return float(power * max(x for x in (1, 2, 5) if x * power <= 1.000001 * size))


def _mark_wheels(mujoco: Any, spec: Any, robot: Robot) -> None:
    """Draw bars on the wheels of a robot, so that their rolling is visible.

    Geoms without a colour become blue, and wheels without a colour become dark.
    """
    model = spec.copy().compile()
    rolling = () if robot.contacts is None else robot.contacts.names
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            continue
        is_wheel = geom.name in rolling and bool(geom.name)
        if not geom.material and np.allclose(geom.rgba, PLAIN):
            geom.rgba = [0.13, 0.13, 0.15, 1] if is_wheel else [0.16, 0.42, 0.68, 1]
    for name in rolling:
        geom = model.geom(name)
        if geom.type[0] != mujoco.mjtGeom.mjGEOM_CYLINDER:
            continue
        radius, half = geom.size[:2]
        body = spec.geom(name).parent
        for long, wide, share in ((0.72, 0.09, 1.03), (0.09, 0.72, 1.02)):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[long * radius, wide * radius, share * half],
                pos=geom.pos,
                quat=geom.quat,
                rgba=[0.98, 0.58, 0.10, 1],
                group=0,
                mass=0.0,
                contype=0,
                conaffinity=0,
            )


def _smoothed(centres: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Average a path over a tenth of its frames, so that the camera moves calmly."""
    width = max(1, len(times) // 20)
    if len(times) < 3:
        return centres
    # Before the first and after the last time, the path continues with its first and
    # its last velocity.
    before = centres[0] + np.arange(-width, 0)[:, None] * (centres[1] - centres[0])
    after = centres[-1] + np.arange(1, width + 1)[:, None] * (centres[-1] - centres[-2])
    path = np.concatenate([before, centres, after])
    weights = np.ones(2 * width + 1) / (2 * width + 1)
    columns = [np.convolve(x, weights, mode="valid") for x in path.T]
    return np.stack(columns, axis=1)


def visible_geoms(model: Any) -> Sequence[int]:
    """Return the indices of geoms in the groups that MuJoCo shows by default."""
    return [i for i in range(model.ngeom) if model.geom_group[i] < 3]
