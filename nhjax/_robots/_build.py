"""The conversion of a compiled model of MuJoCo to the arrays that nhjax uses."""

import copy
import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import Args
from .._errors import is_traced
from ..rolling import AbstractContact, AbstractGround, Contacts, Ellipsoid, Plane, Wheel
from ._dynamics import (
    Actuators,
    BallSpring,
    Bodies,
    Connection,
    Coupling,
    frame_pose,
    KINDS,
    Loops,
    Mechanics,
    Parameters,
)
from ._joints import given_in, Joint, Shift
from ._read import (
    active_equalities,
    has_flag,
    is_fixed_tendon,
    label_of,
    mujoco,
    name_of,
)
from ._tree import Frame, homogeneous, Space


_KINDS = ("free", "ball", "slide", "hinge")


class Layout:
    """The joints of a model, and each body's frame relative to the joint before it.

    `source` is the `MjSpec` or `MjModel` that was read; films show its shapes. The
    positions of the bodies named in `moving` are parameters.

    Layouts are compared by identity, so that a layout can be a static field of a
    `Robot`.
    """

    def __init__(
        self,
        joints: Sequence[Joint],
        bodies: Sequence[Frame],
        source: Any = None,
        moving: Collection[str] = (),
    ):
        self.moving = tuple(moving)
        self.joints = tuple(joints)
        self.bodies = tuple(bodies)
        self.space = Space(self.joints)
        self.source = source

    def __getstate__(self) -> dict[str, Any]:
        # `source` is dropped, because an MjSpec cannot be pickled. Only films need it.
        return self.__dict__ | {"source": None}


def layout_of(model: Any, source: Any, moving: Collection[str]) -> Layout:
    """Read the kinematic tree.

    The positions of the bodies named in `moving` are parameters.
    """
    joints: list[Joint] = []
    bodies = [Frame(-1, np.eye(4))]
    for body in range(1, model.nbody):
        parent = bodies[model.body_parentid[body]]
        own = homogeneous(model.body_pos[body], model.body_quat[body])
        last, offset, shifts = parent.joint, parent.matrix @ own, parent.shifts
        name = name_of(model, "body", body)
        if name in moving:
            turn, place = parent.matrix[:3, :3], model.body_pos[body].copy()
            shifts = (*shifts, Shift(name, turn, place))
        first = model.body_jntadr[body]
        for number in range(first, first + model.body_jntnum[body]):
            kind = _KINDS[model.jnt_type[number]]
            place = model.jnt_qposadr[number]
            joints.append(
                Joint(
                    name_of(model, "joint", number),
                    kind,
                    last,
                    offset,
                    model.jnt_pos[number].copy(),
                    model.jnt_axis[number].copy(),
                    float(model.qpos0[place]) if kind in ("slide", "hinge") else 0.0,
                    shifts,
                )
            )
            last, offset, shifts = number, np.eye(4), ()
        bodies.append(Frame(last, offset, shifts))
    return Layout(joints, bodies, source, moving)


def fixed_to(layout: Layout, body: int, position: Any, quaternion: Any) -> Frame:
    """Return a frame that is fixed to a body, such as the frame of a geom or a site."""
    frame = layout.bodies[body]
    return frame._replace(matrix=frame.matrix @ homogeneous(position, quaternion))


def mechanics_of(
    model: Any, layout: Layout, ignore: Sequence[str], friction_smoothing: float
) -> Mechanics:
    """Read inertias, springs, damping, friction and tendons."""
    space = layout.space
    damping = np.concatenate(
        [model.dof_damping[None], np.reshape(model.dof_dampingpoly, (-1, 2)).T]
    )
    armature = model.dof_armature.copy()
    tendons, numbers = fixed_tendons(model, space, "tendons" in ignore)
    tendon_armature = model.tendon_armature[numbers].copy()
    tendon_damping = model.tendon_damping[numbers].copy()
    # Like MuJoCo, add the damping and armature of actuators to the damping and armature
    # of their joints and tendons.
    for i in range(model.nactuator):
        square = model.actuator_gear[model.actuator_outadr[i], 0] ** 2
        target, kind = model.actuator_trnid[i, 0], model.actuator_trntype[i]
        added = square * model.actuator_damping[i], square * model.actuator_armature[i]
        if not any(added):
            continue
        if kind == int(mujoco().mjtTrn.mjTRN_TENDON):
            tendon_damping[numbers.index(target)] += added[0]
            tendon_armature[numbers.index(target)] += added[1]
        else:
            damping[0, model.jnt_dofadr[target]] += added[0]
            armature[model.jnt_dofadr[target]] += added[1]
    if has_flag(model, "DAMPER"):
        damping, tendon_damping = 0 * damping, 0 * tendon_damping
    friction = model.dof_frictionloss.copy()
    without = "friction loss" in ignore
    if without or has_flag(model, "FRICTIONLOSS") or has_flag(model, "CONSTRAINT"):
        friction[:] = 0

    scalar = [j for j, joint in enumerate(layout.joints) if joint.kind in _KINDS[2:]]
    stiffness = np.concatenate(
        [model.jnt_stiffness[None], np.reshape(model.jnt_stiffnesspoly, (-1, 2)).T]
    )
    stiffness[:, (model.jnt_springyield > 0)] = 0
    if has_flag(model, "SPRING"):
        stiffness[:] = 0
    ball_springs = [
        BallSpring(
            j,
            float(stiffness[0, j]),
            model.qpos_spring[model.jnt_qposadr[j] :][:4].copy(),
        )
        for j, joint in enumerate(layout.joints)
        if joint.kind == "ball" and stiffness[0, j]
    ]
    tendon_stiffness = model.tendon_stiffness[numbers].copy()
    lengths = model.tendon_lengthspring[numbers]
    is_linear = (lengths[:, 0] == lengths[:, 1]) & (
        model.tendon_springyield[numbers] == 0
    )
    tendon_stiffness[~is_linear] = 0
    if has_flag(model, "SPRING"):
        tendon_stiffness[:] = 0
    gravity = 0 * model.opt.gravity if has_flag(model, "GRAVITY") else model.opt.gravity
    return Mechanics(
        layout.joints,
        space,
        _bodies(model, layout),
        np.array(gravity),
        armature,
        damping,
        friction,
        friction_smoothing,
        stiffness[:, scalar],
        model.qpos_spring[model.jnt_qposadr[scalar]].copy(),
        tuple(ball_springs),
        tendons,
        tendon_armature,
        tendon_damping,
        tendon_stiffness,
        lengths[:, 0].copy(),
    )


def _bodies(model: Any, layout: Layout) -> Bodies:
    names, joints, inertias, masses, weights, shifts = [], [], [], [], [], []
    for body in range(1, model.nbody):
        frame, mass = layout.bodies[body], float(model.body_mass[body])
        if frame.joint < 0 or (mass == 0 and not model.body_inertia[body].any()):
            continue
        own = homogeneous(model.body_ipos[body], model.body_iquat[body])
        place = frame.matrix @ own
        moments = model.body_inertia[body]
        inner = np.diag([*(0.5 * moments.sum() - moments), mass])
        names.append(name_of(model, "body", body))
        joints.append(frame.joint)
        inertias.append(place @ inner @ place.T)
        masses.append(mass)
        weights.append(1 - model.body_gravcomp[body])
        shifts.append(frame.shifts)
    return Bodies(
        tuple(names),
        tuple(joints),
        np.stack(inertias) if inertias else np.zeros((0, 4, 4)),
        np.asarray(masses, float),
        np.asarray(weights, float),
        tuple(shifts),
    )


def fixed_tendons(
    model: Any, space: Space, without: bool
) -> tuple[np.ndarray, list[int]]:
    """Return the lengths of the fixed tendons as rows, and the indices of the tendons.

    A row times the scalar coordinates is the length of a tendon.
    """
    numbers = [
        i for i in range(model.ntendon) if not without and is_fixed_tendon(model, i)
    ]
    rows = np.zeros((len(numbers), len(space.scalars)))
    place = {int(dof): i for i, dof in enumerate(space.scalars)}
    for row, tendon in zip(rows, numbers, strict=True):
        first = model.tendon_adr[tendon]
        for wrap in range(first, first + model.tendon_num[tendon]):
            dof = int(model.jnt_dofadr[model.wrap_objid[wrap]])
            row[place[dof]] += model.wrap_prm[wrap]
    return rows, numbers


def check_kinds(given: Any) -> Mapping[str, Sequence[str]]:
    """Return `parameters`; raise unless it maps `KINDS` to sequences of names."""
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise TypeError(
            "from_mujoco: `parameters` must be a dictionary such as "
            f'{{"mass": ["arm"], "damping": ["hinge"]}}, got {type(given).__name__}.'
        )
    for kind, names in given.items():
        if kind not in KINDS:
            raise ValueError(
                f"from_mujoco: `parameters` has the unknown kind {kind!r}; the kinds "
                f"are {', '.join(KINDS)}."
            )
        if isinstance(names, str):
            raise TypeError(
                f"from_mujoco: `parameters[{kind!r}]` must be a sequence of names, got "
                f"{names!r}; write [{names!r}]."
            )
    return given


def parameters_of(
    model: Any,
    mechanics: Mechanics,
    controls: tuple[str, ...] | None,
    geoms: Mapping[str, "RollingGeom"],
    given: Mapping[str, Sequence[str]],
) -> tuple[Parameters, dict[str, Any]]:
    """Return the parameters that `args` may replace, and their values."""
    places: dict[str, dict[str, tuple[int, ...]]] = {}
    values: dict[str, dict[str, np.ndarray]] = {}
    bodies = {name: (i,) for i, name in enumerate(mechanics.bodies.names)}
    scalars = [x.name for x in mechanics.joints if x.kind in _KINDS[2:]]
    velocities = {}
    for number, joint in enumerate(mechanics.joints):
        first = int(model.jnt_dofadr[number])
        size = {"free": 6, "ball": 3}.get(joint.kind, 1)
        velocities[joint.name] = tuple(range(first, first + size))
    of_scalars = {name: (i,) for i, name in enumerate(scalars)}
    everywhere = {
        name_of(model, "body", i): (i,)
        for i in range(1, model.nbody)
        if not _is_free(model, i)
    }
    known = {
        "mass": (bodies, mechanics.bodies.mass),
        "damping": (velocities, mechanics.damping[0]),
        "armature": (velocities, mechanics.armature),
        "friction": ({x: velocities[x] for x in scalars}, mechanics.friction),
        "stiffness": (of_scalars, mechanics.stiffness[0]),
        "position": (everywhere, model.body_pos),
        "radius": (
            {name: (x.geom,) for name, x in geoms.items() if x.has_radius(model)},
            model.geom_size[:, 0],
        ),
    }
    for kind, names in given.items():
        all_places, numbers = known[kind]
        for name in names:
            if name not in all_places:
                listed = ", ".join(all_places) or "none"
                raise ValueError(
                    f"from_mujoco: `parameters[{kind!r}]` has {name!r}, but the names "
                    f"are {listed}. {_ADVICE_ON_NAMES.get(kind, '')}".rstrip()
                )
        places[kind] = {name: all_places[name] for name in names}
        values[kind] = {
            name: np.array(numbers[all_places[name][0]], float) for name in names
        }
    for name, mass in values.get("mass", {}).items():
        if mass == 0:
            raise ValueError(
                f"from_mujoco: `parameters['mass']` has {name!r}, whose mass is zero "
                "in the file, so that its shape is unknown: give it a mass there."
            )
    return Parameters(places, controls), values


_FUSED = (
    "In a URDF file, MuJoCo merges links that are fixed to each other, unless it "
    'contains `<mujoco><compiler fusestatic="false"/></mujoco>`.'
)
_ADVICE_ON_NAMES = {
    "mass": _FUSED,
    "position": "The position of a body with a free joint is a coordinate. " + _FUSED,
    "radius": "They are those of `rolling`, but an ellipsoid has no radius.",
}


def _is_free(model: Any, body: int) -> bool:
    """Return whether a free joint moves this body."""
    first = model.body_jntadr[body]
    return bool(model.body_jntnum[body]) and _KINDS[model.jnt_type[first]] == "free"


def actuators_of(
    model: Any, space: Space, left_out: set[int], smoothing: float
) -> Actuators:
    """Read the actuators that are supported."""
    library = mujoco()
    disabled = model.opt.disableactuator
    numbers = [
        i
        for i in range(model.nactuator)
        if i not in left_out and not disabled >> int(model.actuator_group[i]) & 1
    ]
    if has_flag(model, "ACTUATION"):
        numbers = []
    moment = np.zeros((len(numbers), model.nv))
    gain, bias = np.zeros((2, len(numbers), 3))
    control_range = np.tile([-np.inf, np.inf], (len(numbers), 1))
    force_range, joint_range = (
        control_range.copy(),
        np.tile([-np.inf, np.inf], (model.nv, 1)),
    )
    tendons, tendon_numbers = fixed_tendons(model, space, False)
    for row, i in enumerate(numbers):
        gear = model.actuator_gear[model.actuator_outadr[i]]
        target = model.actuator_trnid[i, 0]
        if model.actuator_trntype[i] == int(library.mjtTrn.mjTRN_TENDON):
            moment[row, space.scalars] = gear[0] * tendons[tendon_numbers.index(target)]
        else:
            size = {0: 6, 1: 3}.get(int(model.jnt_type[target]), 1)
            first = model.jnt_dofadr[target]
            moment[row, first : first + size] = gear[:size]
        gain[row, 0] = model.actuator_gainprm[i, 0]
        if model.actuator_gaintype[i] == int(library.mjtGain.mjGAIN_AFFINE):
            gain[row] = model.actuator_gainprm[i, :3]
        if model.actuator_biastype[i] == int(library.mjtBias.mjBIAS_AFFINE):
            bias[row] = model.actuator_biasprm[i, :3]
        control = model.actuator_ctrladr[i]
        if model.actuator_ctrllimited[control] and not has_flag(model, "CLAMPCTRL"):
            control_range[row] = model.actuator_ctrlrange[control]
        if model.actuator_forcelimited[i]:
            force_range[row] = model.actuator_forcerange[i]
    for joint in np.flatnonzero(model.jnt_actfrclimited):
        if model.jnt_type[joint] >= 2:
            joint_range[model.jnt_dofadr[joint]] = model.jnt_actfrcrange[joint]
    return Actuators(
        tuple(name_of(model, "actuator", i) for i in numbers),
        moment,
        gain,
        bias,
        control_range,
        force_range,
        joint_range,
        smoothing,
    )


def loops_in(model: Any, layout: Layout, left_out: set[int]) -> Loops:
    """Read the equality constraints that are supported."""
    library = mujoco()
    kinds, site = library.mjtEq, int(library.mjtObj.mjOBJ_SITE)
    connections, welds, couplings = [], [], []
    space = layout.space
    place = {int(dof): i for i, dof in enumerate(space.scalars)}
    tendons, tendon_numbers = fixed_tendons(model, space, False)

    def joint_row(joint):
        row = np.zeros(len(space.scalars))
        row[place[int(model.jnt_dofadr[joint])]] = 1
        return row, float(model.qpos0[model.jnt_qposadr[joint]])

    def tendon_row(tendon):
        row = tendons[tendon_numbers.index(tendon)]
        return row, float(model.tendon_length0[tendon])

    for i in active_equalities(model):
        if i in left_out:
            continue
        kind, data, name = (
            int(model.eq_type[i]),
            model.eq_data[i],
            name_of(model, "equality", i),
        )
        ends = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if kind in (int(kinds.mjEQ_JOINT), int(kinds.mjEQ_TENDON)):
            row_of = joint_row if kind == int(kinds.mjEQ_JOINT) else tendon_row
            first, first_rest = row_of(ends[0])
            second, second_rest = np.zeros(len(space.scalars)), 0.0
            if ends[1] >= 0:
                second, second_rest = row_of(ends[1])
            couplings.append(
                Coupling(name, second, second_rest, first, first_rest, data[:5].copy())
            )
            continue
        none = np.array([1.0, 0, 0, 0])
        is_weld = kind == int(kinds.mjEQ_WELD)
        if model.eq_objtype[i] == site:
            frames = [
                fixed_to(
                    layout, model.site_bodyid[x], model.site_pos[x], model.site_quat[x]
                )
                for x in ends
            ]
        elif is_weld:
            # The anchor has the pose data[3:10] in the frame of the first body, and the
            # position data[:3] in the frame of the second body.
            frames = [
                fixed_to(layout, ends[0], data[3:6], data[6:10]),
                fixed_to(layout, ends[1], data[:3], none),
            ]
        else:
            frames = [
                fixed_to(layout, ends[0], data[:3], none),
                fixed_to(layout, ends[1], data[3:6], none),
            ]
        if is_weld and data[10] != 0:
            welds.append(Connection(name, *frames))
        else:
            connections.append(Connection(name, *frames))
    return Loops(tuple(connections), tuple(welds), tuple(couplings))


# --- Rolling --------------------------------------------------------------------------

_WORDS = {
    "no slip": ("along", "across"),
    "no lateral slip": ("across",),
    "no longitudinal slip": ("along",),
    "slides": (),
}


def rolling_options(rolling: Any) -> dict[str, tuple[Any, ...]]:
    """Convert `rolling` to the directions without slip of each geom."""
    if rolling is None:
        return {}
    if isinstance(rolling, str):
        raise TypeError(
            f"from_mujoco: `rolling` must be a sequence or a dictionary, got "
            f"{rolling!r}; write `rolling=({rolling!r},)`."
        )
    if not isinstance(rolling, Mapping):
        rolling = dict.fromkeys(rolling, "no slip")
    found = {}
    for name, option in rolling.items():
        if isinstance(option, str) and option in _WORDS:
            found[name] = _WORDS[option]
        elif isinstance(option, float | int):
            found[name] = (float(option),)
        elif isinstance(option, tuple):
            found[name] = option
        else:
            raise ValueError(
                f"from_mujoco: `rolling[{name!r}]` must be one of "
                f"{', '.join(map(repr, _WORDS))}, an angle in radians, or a tuple such "
                f"as `no_slip` of `nhjax.rolling.Wheel`, got {option!r}."
            )
    return found


class RollingGeom(NamedTuple):
    """A geom that rolls: its index, and the directions in which it does not slip.

    If `is_parameter`, its radius can be given in `args`.
    """

    geom: int
    no_slip: tuple[Any, ...]
    is_parameter: bool

    def has_radius(self, model: Any) -> bool:
        """Return whether the geom has a radius; ellipsoids have semi-axes instead."""
        ellipsoid = mujoco().mjtGeom.mjGEOM_ELLIPSOID
        return model.geom_type[self.geom] != int(ellipsoid)


def rolling_geoms(
    model: Any, options: Mapping[str, tuple[Any, ...]], radii: Collection[str]
) -> dict[str, RollingGeom]:
    """Return the geoms that roll, by name.

    The name of a body stands for its only round geom. The radii of the geoms named in
    `radii` are parameters.
    """
    geoms = {name_of(model, "geom", i): i for i in range(model.ngeom)}
    bodies = {name_of(model, "body", i): i for i in range(1, model.nbody)}
    round_kinds = [int(kind) for kind in _round_kinds()]
    found = {}
    for name, no_slip in options.items():
        own: list[int] = []
        if name in bodies:
            of_body = np.flatnonzero(model.geom_bodyid == bodies[name])
            own = [int(x) for x in of_body if model.geom_type[x] in round_kinds]
        if name not in geoms and len(own) != 1:
            listed = ", ".join(label_of(model, i) for i in range(model.ngeom))
            raise ValueError(
                f"from_mujoco: `rolling` has {name!r}, but the geoms are "
                f"{listed or 'none'}. Give the geom a name, in a URDF file by "
                f"`<collision name={name!r}>`, or pass the name of a body with one "
                "round geom."
            )
        geom = geoms[name] if name in geoms else own[0]
        found[name] = RollingGeom(geom, no_slip, name in radii)
    return found


def contacts_of(
    model: Any,
    layout: Layout,
    geoms: Mapping[str, RollingGeom],
    ground: Any,
    without_height: Sequence[str] = (),
) -> Contacts | None:
    """Build the contacts of the geoms that roll."""
    if not geoms:
        return None
    surface = _ground(model, layout, ground)
    contacts: dict[str, AbstractContact] = {}
    for name, geom in geoms.items():
        frame = _frame_of_geom(model, layout, geom.geom)
        if frame.joint < 0:
            raise ValueError(
                f"from_mujoco: `rolling` has {name!r}, which is fixed to the world and "
                'cannot roll. For a URDF file pass `root="free"` or `root="planar"`.'
            )
        contacts[name] = _contact(
            model,
            geom,
            frame_pose(layout.joints, layout.space, frame),
            name,
            layout.moving,
            no_slip=geom.no_slip,
            ground=surface,
            manifold=layout.space.manifold,
            touches=name not in without_height,
        )
    return Contacts(**contacts)


def _frame_of_geom(model: Any, layout: Layout, geom: int) -> Frame:
    place = model.geom_bodyid[geom], model.geom_pos[geom], model.geom_quat[geom]
    return fixed_to(layout, *place)


def _round_kinds() -> tuple[Any, ...]:
    kinds = mujoco().mjtGeom
    axial = kinds.mjGEOM_CYLINDER, kinds.mjGEOM_CAPSULE
    return (*axial, kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID)


def check_wheels(
    model: Any,
    layout: Layout,
    geoms: Mapping[str, RollingGeom],
    contacts: Contacts | None,
) -> None:
    """Raise for wheels that lie flat, and warn of geoms that cannot roll."""
    if contacts is None:
        return
    kinds, data = mujoco().mjtGeom, mujoco().MjData(model)
    mujoco().mj_kinematics(model, data)
    for contact, (name, (geom, no_slip, _)) in zip(
        contacts.contacts, geoms.items(), strict=True
    ):
        frame = _frame_of_geom(model, layout, geom)
        joint = layout.joints[frame.joint]
        kind = kinds(model.geom_type[geom])
        if kind in (kinds.mjGEOM_CYLINDER, kinds.mjGEOM_CAPSULE):
            ground, axis = contact.ground, data.geom_xmat[geom].reshape(3, 3)[:, 2]
            if joint.kind != "free" and isinstance(ground, Plane):
                normal = np.asarray(ground.unit_normal("float32"), float)
                if abs(axis @ normal) > 1 - 1e-6:
                    raise ValueError(
                        f"from_mujoco: the wheel {name!r} lies flat on the ground in "
                        "the pose of the file: its axis, the z axis of the geom, is "
                        "vertical. Turn it: in a URDF file, write "
                        '`rpy="1.5708 0 0"` into the `<origin>` of its `<collision>`.'
                    )
            # If the wheel does not slip along its track, it must turn about its axis.
            turns = any(x not in ("across", "spin") for x in no_slip)
            parallel = abs(frame.matrix[:3, 2] @ joint.axis) > 1 - 1e-6
            if turns and joint.kind in ("hinge", "slide") and not parallel:
                warnings.warn(
                    f"from_mujoco: the last joint before the geom {name!r}, "
                    f"{joint.name!r}, does not turn it about its axis, so that it "
                    "cannot roll. In a URDF file, `<axis>` of a joint is given in the "
                    "frame of the joint, and `rpy` of `<collision>` turns a cylinder, "
                    "whose axis is z.",
                    stacklevel=4,
                )
        elif no_slip and len(geoms) > 1 and joint.kind in ("free", "slide"):
            warnings.warn(
                f"from_mujoco: the geom {name!r} rolls without slipping, but is fixed "
                f"to the body that {joint.name!r} moves, together with other wheels, "
                "so that the robot can hardly move. For a caster write "
                f'`rolling={{..., {name!r}: "slides"}}`.',
                stacklevel=4,
            )


def _contact(
    model: Any,
    rolling: RollingGeom,
    pose: Any,
    name: str,
    moving: Sequence[str],
    **options: Any,
) -> AbstractContact:
    geom = rolling.geom
    kinds, size = mujoco().mjtGeom, model.geom_size[geom]
    kind = kinds(model.geom_type[geom])
    radius: Any = float(size[0])
    if kind not in _round_kinds():
        word = kind.name[7:].lower()
        raise ValueError(
            f"from_mujoco: the geom {name!r} is a {word}, but only a cylinder, a "
            "capsule, a sphere or an ellipsoid can roll. Add such a geom to its body, "
            'without mass and contacts (mass="0" contype="0" conaffinity="0").'
        )
    if options["touches"]:
        options["touches"] = _height_varies(
            model, geom, options["ground"], name, moving
        )
    if rolling.is_parameter:
        radius = _radius_in_args(name, radius)
    axle = (0.0, 0.0, 1.0)
    if kind == kinds.mjGEOM_CYLINDER:
        return Wheel(pose, radius, axle=axle, **options)
    if kind == kinds.mjGEOM_CAPSULE:
        return Wheel(pose, 0.0, tube_radius=radius, axle=axle, **options)
    is_sphere = kind == kinds.mjGEOM_SPHERE
    return Ellipsoid(pose, radius if is_sphere else size.copy(), **options)


def _radius_in_args(name: str, default: float) -> Callable[[Args], Any]:
    def radius(args):
        return given_in(args, "radius").get(name, default)

    return radius


def _ground(model: Any, layout: Layout, ground: Any) -> AbstractGround:
    """Return the ground: `ground` itself, a plane of the model, or z = 0."""
    if isinstance(ground, AbstractGround):
        return ground
    plane = int(mujoco().mjtGeom.mjGEOM_PLANE)
    planes = {
        name_of(model, "geom", i): i
        for i in np.flatnonzero(model.geom_type == plane).tolist()
        if layout.bodies[model.geom_bodyid[i]].joint < 0
    }
    if ground is None:
        if not planes:
            return Plane()
        if len(planes) > 1:
            raise ValueError(
                f"from_mujoco: the model has the planes {', '.join(planes)}: pass the "
                "name of the one that the wheels touch as `ground`."
            )
        (ground,) = planes
    if ground not in planes:
        raise ValueError(
            "from_mujoco: `ground` must be the name of a plane of the world "
            f"({', '.join(planes) or 'there is none'}) or a ground of `nhjax.rolling`, "
            f"got {ground!r}."
        )
    geom = planes[ground]
    frame = fixed_to(
        layout, model.geom_bodyid[geom], model.geom_pos[geom], model.geom_quat[geom]
    )
    if frame.shifts:
        raise ValueError(
            f"from_mujoco: the ground {ground!r} belongs to a body whose position is "
            "a parameter. Only positions of other bodies can be parameters."
        )
    normal = frame.matrix[:3, 2]
    # Remove round-off, so that the normal of a horizontal plane is exactly vertical.
    normal = np.where(np.abs(normal) < 1e-15, 0.0, normal)
    return Plane(normal, height=float(normal @ frame.matrix[:3, 3]))


def _height_varies(
    model: Any, geom: int, ground: AbstractGround, name: str, moving: Sequence[str]
) -> bool:
    """Return whether the height of a geom above the ground can change.

    The joints and the positions of the bodies named in `moving` can change it. Raise if
    the height is constant and not zero.
    """
    if not isinstance(ground, Plane):
        return True
    other, rng = copy.copy(model), np.random.default_rng(2)
    for body in range(model.nbody):
        if name_of(model, "body", body) in moving:
            other.body_pos[body, :] += 0.1 * rng.normal(size=3)
    heights = _heights(model, geom, ground)
    size = max(1.0, float(np.abs(model.geom_size[geom]).max()))
    if any(np.ptp(x) > 1e-9 * size for x in (heights, _heights(other, geom, ground))):
        return True
    if abs(heights[0]) > 1e-6 * size:
        place = "above" if heights[0] > 0 else "below"
        raise ValueError(
            f"from_mujoco: the geom {name!r} is {abs(heights[0]):.3g} m {place} the "
            "ground, and no joint changes its height: move it, or pass another ground."
        )
    return False


def _heights(model: Any, geom: int, ground: Plane) -> list[float]:
    """Compute the heights of a geom above the ground in random poses."""
    normal = np.asarray(ground.unit_normal("float32"), float)
    normal /= np.linalg.norm(normal)
    data, heights = mujoco().MjData(model), []
    rng = np.random.default_rng(0)
    for _ in range(4):
        data.qpos[:] = model.qpos0
        mujoco().mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 0.5)
        mujoco().mj_kinematics(model, data)
        turn = data.geom_xmat[geom].reshape(3, 3)
        size = model.geom_size[geom]
        kind = mujoco().mjtGeom(model.geom_type[geom])
        reach = float(size[0])
        if kind == mujoco().mjtGeom.mjGEOM_CYLINDER:
            reach *= np.sqrt(max(0.0, 1 - (turn[:, 2] @ normal) ** 2))
        elif kind == mujoco().mjtGeom.mjGEOM_ELLIPSOID:
            reach = float(np.linalg.norm(size * (turn.T @ normal)))
        height = float(np.asarray(ground.height))
        heights.append(data.geom_xpos[geom] @ normal - reach - height)
    return heights


# --- Dependent constraints ------------------------------------------------------------


class Kept(NamedTuple):
    """The rows of the constraints to enforce.

    - `slips`: for each contact, whether to keep each of its directions without slip.
    - `heights`: for each contact that touches, whether to keep its height.
    - `loops`: whether to keep each equation of the closed loops.
    - `is_independent`: whether these rows are independent near the pose at rest.
    - `left_out`: the rows that are not kept, or None if all rows are kept.
    """

    slips: list[list[bool]]
    heights: list[bool]
    loops: list[bool]
    is_independent: bool
    left_out: "LeftOut | None"


class _Rows:
    """All constraints of a robot: heights, equations of closed loops, and slips."""

    def __init__(
        self, space: Space, contacts: Contacts | None, loops: Loops, loop: Any
    ):
        named = {}
        if contacts is not None:
            named = dict(zip(contacts.names, contacts.contacts, strict=True))
        self.space, self.loop = space, loop
        self.contacts = list(named.values())
        self.heights = [x for x in self.contacts if x.touches]
        heights = [f"{name} normal" for name, x in named.items() if x.touches]
        slips = [f"{name} {x}" for name, one in named.items() for x in one.no_slip]
        self.names = (*heights, *(loops.names if loop is not None else ()), *slips)
        self.evaluate = jax.jit(self._evaluate)

    def __getstate__(self) -> dict[str, Any]:
        # `evaluate` is dropped, because a compiled function cannot be pickled.
        return {k: x for k, x in self.__dict__.items() if k != "evaluate"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.evaluate = jax.jit(self._evaluate)

    def _positions(self, q: PyTree[Array], args: Args) -> Array:
        # `independent_rows` leaves out rows that follow from earlier rows. Constraints
        # on positions come first, so that constraints on velocities are left out.
        rows = [x.height(0.0, q, args)[None] for x in self.heights]
        if self.loop is not None:
            rows.append(self.loop(0.0, q, args))
        return jnp.concatenate([jnp.zeros(0), *rows])

    def _evaluate(self, q: PyTree[Array], args: Args) -> tuple[Array, Array]:
        """Compute constraints on positions, and the Jacobian of rates and slips."""
        space = self.space

        def rates(v):
            moved = space.tangent(q, v)
            positions = jax.jvp(lambda q: self._positions(q, args), (q,), (moved,))[1]
            slips = [x.slip(0.0, q, v, args) for x in self.contacts if x.no_slip]
            return jnp.concatenate([positions, *slips])

        unit = jnp.eye(space.num_velocities, dtype=jnp.result_type(float))
        return self._positions(q, args), jax.vmap(rates)(unit).T


class LeftOut:
    """The constraints that are left out.

    They follow from the others if all lengths have the values of the file. Objects are
    compared by identity, so that a `LeftOut` can be a static field of a `Robot`.
    """

    def __init__(self, rows: _Rows, keep: np.ndarray):
        self.rows, self.keep = rows, keep

    def check(self, q: PyTree[Array], args: Args) -> None:
        """Raise unless the left-out constraints hold, and still follow from the others.

        The check is skipped while JAX traces q or the lengths in `args`.
        """
        lengths = {x: given_in(args, x) for x in ("position", "radius")}
        lengths = {x: given for x, given in lengths.items() if given} or None
        if is_traced(*jax.tree.leaves((q, lengths))):
            return
        positions, rows = map(np.asarray, self.rows.evaluate(q, lengths))
        names, rows = self.rows.names, _normalised(rows)
        rank = _rank(rows[self.keep])
        for place in np.flatnonzero(~self.keep).tolist():
            if _rank(np.concatenate([rows[self.keep], rows[place][None]])) > rank:
                raise ValueError(
                    f"Robot.initial_state: the constraint {names[place]!r} was left "
                    "out, because it follows from the others with the lengths of the "
                    "file. With the lengths in `args` it does not follow. Pass "
                    '`constraints="redundant"` to `from_mujoco` to keep it, or choose '
                    "another option of `rolling` for it."
                )
        errors = np.where(self.keep[: len(positions)], 0, positions)
        sizes = [np.abs(x).max(initial=0) for x in jax.tree.leaves(q)]
        eps = np.finfo(positions.dtype).eps
        if np.abs(errors).max(initial=0) > max(1e-6, 1e3 * eps * max(sizes)):
            place = int(np.argmax(np.abs(errors)))
            raise ValueError(
                f"Robot.initial_state: the constraint {names[place]!r} was left out, "
                "because it follows from the others, but is violated by "
                f"{errors[place]:.3g} where they hold. Correct the lengths, or remove "
                "it from `rolling` or from the equalities."
            )


def independent_rows(
    model: Any, space: Space, contacts: Contacts | None, loops: Loops, loop: Any
) -> Kept:
    """Find the constraints that follow from the others in every pose.

    These constraints are left out if the others are independent at the pose at rest and
    at random poses near it. Otherwise all constraints are kept, because constraints
    that depend on each other only in some poses are needed in other poses.
    """
    all_rows = _Rows(space, contacts, loops, loop)
    rng, found = np.random.default_rng(1), []
    for size in (0.3, 0.3, 0.0):
        qpos = model.qpos0.copy()
        mujoco().mj_integratePos(model, qpos, rng.normal(size=model.nv), size)
        q = space.from_qpos(jnp.asarray(qpos, jnp.result_type(float)))
        rows = np.asarray(all_rows.evaluate(q, None)[1], float)
        if np.isfinite(rows).all():
            found.append(_normalised(rows))
    count = len(found[0]) if found else 0
    kept: list[int] = []
    for row in range(count):
        if _rank(found[0][[*kept, row]]) > len(kept):
            kept.append(row)
    is_independent = all(
        _rank(x[kept]) == len(kept) and _rank(x) == len(kept) for x in found
    )
    keep = np.isin(np.arange(count), kept) | (not is_independent)
    sizes = [len(x.no_slip) for x in all_rows.contacts]
    first = count - sum(sizes)
    ends = first + np.cumsum([0, *sizes])
    num_heights = len(all_rows.heights)
    return Kept(
        [keep[a:b].tolist() for a, b in pairwise(ends.tolist())],
        keep[:num_heights].tolist(),
        keep[num_heights:first].tolist(),
        is_independent,
        None if keep.all() else LeftOut(all_rows, keep),
    )


def _normalised(rows: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return rows / np.where(lengths > 1e-8, lengths, np.inf)


def _rank(rows: np.ndarray) -> int:
    tolerance = 1e-8 if jnp.result_type(float) == jnp.float64 else 1e-4
    return int(np.linalg.matrix_rank(rows, tol=tolerance)) if len(rows) else 0
