"""The function `from_mujoco`, the robot that it returns, and example robots."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalarLike
from .._errors import check_choice, ShapeError
from .._initial import initial_state
from .._system import LagrangianSystem, State
from ..rolling import AbstractGround, Contacts, Plane
from ._build import (
    actuators_of,
    check_kinds,
    check_wheels,
    contacts_of,
    independent_rows,
    Kept,
    Layout,
    layout_of,
    LeftOut,
    loops_in,
    mechanics_of,
    parameters_of,
    rolling_geoms,
    rolling_options,
    RollingGeom,
)
from ._dynamics import force_of, frame_pose, lagrangian_of, loops_of
from ._read import check_supported, compile_model, is_fixed_urdf, name_of


class Robot(eqx.Module):
    """A robot that `from_mujoco` has read from a model.

    - `system`: the system, for `integrate`.
    - `args`: the values of the file for the `parameters` given to `from_mujoco`, as a
        dictionary by kind and name. Add the controls of the actuators as
        `args["controls"]`, of shape (nu,); they are zero by default.
    - `coordinates`: the names of the velocities, in the order of v, which is the order
        of MuJoCo's `qvel`. A free joint has six names, a ball joint three.
    - `controls`: the names of the actuators, in the order of the controls.
    - `contacts`: the `nhjax.rolling.Contacts` of the geoms that roll, or None.
    - `loops`: the names of the equations of closed loops. Their multipliers come last.
    - `bodies`: the names of all bodies.
    """

    system: LagrangianSystem
    args: dict[str, dict[str, Array]]
    coordinates: tuple[str, ...] = eqx.field(static=True)
    controls: tuple[str, ...] = eqx.field(static=True)
    contacts: Contacts | None
    loops: tuple[str, ...] = eqx.field(static=True)
    bodies: tuple[str, ...] = eqx.field(static=True)
    _layout: Layout = eqx.field(static=True)
    _rest: tuple[float, ...] = eqx.field(static=True)
    _left_out: LeftOut | None = eqx.field(static=True)

    def initial_state(
        self,
        qpos: Mapping[str, Any] | Float[Array, " nq"] | None = None,
        qvel: Mapping[str, Any] | Float[Array, " nv"] | None = None,
        *,
        t: FloatScalarLike = 0.0,
        args: Args = None,
        project: bool = False,
        keep_q: Any = None,
        keep_v: Any = None,
    ) -> State:
        """Create a consistent state, as `nhjax.initial_state` does.

        **Arguments:**

        - `qpos`, `qvel`: positions and velocities in MuJoCo's conventions, of shape
            (nq,) and (nv,), or dictionaries by the names of joints. The default is the
            pose of the file with zero velocity. Joints that a dictionary omits have
            the default values.
        - `t`: the time.
        - `args`: the parameters and controls. The default is `self.args`.
        - `project`: whether to project the state onto the constraints.
        - `keep_q`, `keep_v`: as for `nhjax.initial_state`. `self.coordinates` has the
            names that can be used.

        **Returns:** a `State`.

        **Raises:** as `nhjax.initial_state`; `ValueError` for unknown joints;
        `ValueError` if a constraint that `from_mujoco` left out is violated in this
        state, or does not follow from the others with the lengths in `args` (not
        checked while JAX traces the call); `ShapeError` for wrong shapes.
        """
        rest = jnp.asarray(self._rest, jnp.result_type(float))
        position = self._array("qpos", qpos, rest)
        velocity = self._array("qvel", qvel, jnp.zeros(self._space.num_velocities))
        q = self._space.from_qpos(position)
        given = self.args if args is None else args
        try:
            y = initial_state(
                self.system,
                q,
                velocity,
                t=t,
                args=given,
                project=project,
                keep_q=keep_q,
                keep_v=keep_v,
            )
        except Exception as error:
            self._add_note_on_heights(error, t, q, given)
            raise
        if self._left_out is not None:
            self._left_out.check(y.q, given)
        return y

    def _add_note_on_heights(self, error: Exception, t: Any, q: Any, args: Any) -> None:
        """Add a note to an error with the geoms that do not touch the ground.

        The note is omitted while JAX traces the heights.
        """
        if self.contacts is None:
            return
        pairs = zip(self.contacts.names, self.contacts.contacts, strict=True)
        found = {x: one.height(t, q, args) for x, one in pairs if one.touches}
        try:
            heights = {name: float(height) for name, height in found.items()}
        except jax.errors.ConcretizationTypeError:
            return
        apart = [
            f"{name!r} by {h:.3g} m" for name, h in heights.items() if abs(h) > 1e-6
        ]
        if apart:
            error.add_note(
                f"These geoms do not touch the ground: {', '.join(apart)} (negative "
                "below it). Choose `qpos` so that they touch, or pass `project=True`."
            )

    def qpos(self, sol: Any) -> Float[Array, "*times nq"]:
        """Return positions in MuJoCo's conventions.

        For a free joint, they are the position and then the quaternion.

        **Arguments:**

        - `sol`: a `Solution` with saved states, or a `State`.

        **Raises:** `TypeError` if there are no states.
        """
        return self._space.to_qpos(_states(sol).q)

    def qvel(self, sol: Any) -> Float[Array, "*times nv"]:
        """Return velocities in MuJoCo's conventions.

        For a free joint, they are the velocity of its origin in space and then the
        angular velocity in the frame of its body.

        **Arguments:**

        - `sol`: a `Solution` with saved states, or a `State`.

        **Raises:** `TypeError` if there are no states.
        """
        return _states(sol).v

    def pose(
        self, body: str, q: PyTree[Array], args: Args = None
    ) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
        """Compute the position [m] of a body, and the rotation from its frame to space.

        **Arguments:**

        - `body`: the name of the body.
        - `q`: the configuration of one state.
        - `args`: the parameters; missing parameters have the values of the file.

        **Raises:** `ValueError` if there is no such body.
        """
        if body not in self.bodies:
            raise ValueError(
                f"`body` must be one of {', '.join(self.bodies)}, got {body!r}."
            )
        frame = self._layout.bodies[self.bodies.index(body)]
        return frame_pose(self._layout.joints, self._space, frame)(0.0, q, args)

    @property
    def mujoco_model(self) -> Any:
        """The `mujoco.MjSpec` that was read, or the `mujoco.MjModel` that was given."""
        return self._layout.source

    @property
    def _space(self) -> Any:
        return self._layout.space

    def _array(self, name: str, given: Any, rest: Array) -> Array:
        """Convert a dictionary to an array, or check an array; default to `rest`."""
        if given is None:
            return rest
        if not isinstance(given, Mapping):
            array = jnp.asarray(given)
            if array.shape != rest.shape:
                raise ShapeError(
                    f"`{name}` must have shape {rest.shape}, got {array.shape}. For "
                    "many states use `jax.vmap`."
                )
            return array
        sizes = {"free": 7, "ball": 4} if name == "qpos" else {"free": 6, "ball": 3}
        places, start = {}, 0
        for joint in self._layout.joints:
            size = sizes.get(joint.kind, 1)
            places[joint.name] = slice(start, start + size)
            start += size
        for key, value in given.items():
            if key not in places:
                raise ValueError(
                    f"`{name}` has {key!r}, but the joints are {', '.join(places)}."
                )
            own = jnp.asarray(value, rest.dtype)
            size = places[key].stop - places[key].start
            if own.size != size:
                raise ShapeError(
                    f"`{name}[{key!r}]` must have {size} numbers, got shape "
                    f"{own.shape}."
                )
            rest = rest.at[places[key]].set(own.reshape(size))
        return rest


def _states(sol: Any) -> State:
    y = sol if isinstance(sol, State) else getattr(sol, "ys", None)
    if not isinstance(y, State):
        raise TypeError(
            "A robot converts a State, or a Solution that has saved states (without "
            f"`fn` in `SaveAt`), got {type(sol).__name__}."
        )
    return y


def from_mujoco(
    model: Any,
    *,
    rolling: Mapping[str, Any] | Sequence[str] | None = None,
    ground: str | AbstractGround | None = None,
    root: Literal["free", "planar", "fixed"] | None = None,
    motors: Sequence[str] = (),
    controls: Callable[..., Any] | None = None,
    parameters: Mapping[str, Sequence[str]] | None = None,
    ignore: Sequence[str] = (),
    constraints: Literal["independent", "redundant"] | None = None,
    friction_smoothing: float = 0.01,
    limit_smoothing: float = 0.01,
) -> Robot:
    """Read a robot from an MJCF or URDF file, with wheels that roll without slipping.

    MuJoCo's own compiler reads the model. The Lagrangian is the kinetic energy
    ½ Σ tr(Ṫ J Ṫᵀ) of all bodies with poses T and pseudo-inertias J, plus ½ a q̇² for
    each armature a, minus the potential energies of weight and springs. A free joint
    has coordinates in R³ x SO(3), and a ball joint in SO(3). All other joints have
    coordinates in R^n. The equality constraints connect, weld, joint and tendon
    become holonomic constraints. They hold exactly, unlike in MuJoCo, and `solref` and
    `solimp` have no effect. Source: Featherstone, *Rigid body dynamics algorithms*
    (2008); the MuJoCo documentation, chapter *Computation*.

    **Arguments:**

    - `model`: the path of a file, a `mujoco.MjSpec` or a `mujoco.MjModel`. Angles in
        `rpy` of a URDF file that differ by less than 1e-3 rad from quarter turns, such
        as 1.5708, are taken as quarter turns.
    - `rolling`: the names of the geoms that roll on the ground, or of bodies with one
        round geom. A dictionary maps these names to the kind of contact:
        `"no slip"`, `"no lateral slip"`, `"no longitudinal slip"`, `"slides"` (the geom
        keeps touching), an angle [rad] for the rollers of a mecanum wheel, or a tuple
        like `no_slip` of `nhjax.rolling.Wheel`. A cylinder is a wheel whose rim is in
        the middle of its length, and a capsule is a wheel with a round tread; a sphere
        and an ellipsoid roll in all directions. The geoms in `rolling` can never lift
        off.
    - `ground`: the name of a plane that is fixed to the world, or a ground of
        `nhjax.rolling`. The default is the only plane of the model, or z = 0 if the
        model has no plane.
    - `root`: for a URDF file, how the root link can move. `"free"` adds a free joint,
        and `"planar"` the coordinates x, y and heading. `"fixed"` leaves it fixed to
        the world, as MuJoCo does.
    - `motors`: the names of joints that get a motor, in addition to the actuators of
        the file. The control of a motor is its torque [N m] or force [N]. URDF files
        have no actuators; `<transmission>` is not read.
    - `controls`: a function of (t, qpos, qvel, args) that returns the controls of all
        actuators, for feedback. It can read gains from `args["controls"]`, which may
        then have any structure, such as a dictionary. Without a function,
        `args["controls"]` are the controls themselves.
    - `parameters`: a dictionary with names of bodies for `"mass"` and `"position"`, of
        joints for `"damping"`, `"stiffness"`, `"armature"` and `"friction"`, and with
        names in `rolling` for `"radius"`. `args` can then replace these values of the
        file. A body with another mass keeps its shape and its centre of mass. The
        position of a body is the vector [m] from the frame of its parent to its own
        frame, of shape (3,), such as the length of a link. Another vector moves the
        body and all bodies attached to it. A wheel with another radius keeps its mass
        and its inertia. Films show the lengths of the file, not of `args`.
    - `ignore`: unsupported parts to leave out: `"actuators"`, `"contacts"`,
        `"equalities"`, `"fluid"`, `"friction loss"`, `"limits"`, `"plugins"`,
        `"springs"`, `"tendons"`.
    - `constraints`: `"independent"` or `"redundant"`, as for `LagrangianSystem`; both
        keep all constraints. By default, constraints that follow from others in every
        pose are left out, such as `"across"` of the second of two wheels on one axle.
        If constraints depend on each other only in some poses near the pose of the
        file, the default keeps all constraints, and is the same as `"redundant"`.
    - `friction_smoothing`: v₀ [rad/s or m/s] in the friction loss f tanh(q̇ / v₀) of a
        joint.
    - `limit_smoothing`: the width of the smooth transition at the limits of controls
        and forces of actuators, as a fraction of their range, or of the limit if there
        is only one. Farther than 36 widths from the limits, values are not changed.

    **Returns:** a `Robot`.

    **Raises:** `ImportError` without MuJoCo (`pip install "nhjax[robots]"`);
    `FileNotFoundError`, `TypeError` and `ValueError` that name what cannot be read, and
    all parts of the model that are neither supported nor ignored.

    !!! example

        >>> import mujoco, nhjax
        >>> spec = mujoco.MjSpec.from_string('''<mujoco><worldbody><body pos="0 0 0.1">
        ...     <freejoint name="ball"/> <geom name="ball" size="0.1" mass="2"/>
        ...     </body></worldbody></mujoco>''')
        >>> robot = nhjax.from_mujoco(spec, rolling=["ball"])
        >>> y0 = robot.initial_state(qvel={"ball": [0.2, 0, 0, 0, 2, 0]})
        >>> sol = nhjax.integrate(robot.system, nhjax.LobattoIIIAB(2), y0, dt=0.02,
        ...     num_steps=50)
        >>> robot.qpos(sol)[-1, :3].round(4)
        Array([0.2, 0. , 0.1], dtype=float64)
    """
    options, chosen = rolling_options(rolling), check_kinds(parameters)
    source, compiled = compile_model(model, root, motors)
    if options and root is None and is_fixed_urdf(model):
        raise ValueError(
            "from_mujoco: MuJoCo fixes the root link of a URDF file to the world. "
            'Pass `root="free"` or `root="planar"` for a robot on wheels, or '
            '`root="fixed"`.'
        )
    geoms = rolling_geoms(compiled, options, chosen.get("radius", ()))
    left_out = check_supported(compiled, ignore, [x.geom for x in geoms.values()])
    layout = layout_of(compiled, source, chosen.get("position", ()))
    mechanics = mechanics_of(compiled, layout, ignore, friction_smoothing)
    actuators = actuators_of(
        compiled, layout.space, left_out["actuators"], limit_smoothing
    )
    own = actuators.names if controls is None else None
    known, values = parameters_of(compiled, mechanics, own, geoms, chosen)
    contacts = contacts_of(compiled, layout, geoms, ground)
    check_wheels(compiled, layout, geoms, contacts)
    loops = loops_in(compiled, layout, left_out["equalities"])
    loop = loops_of(layout.joints, layout.space, loops)
    names, left_out_rows = loops.names, None
    if constraints is None and (contacts is not None or loop is not None):
        kept = independent_rows(compiled, layout.space, contacts, loops, loop)
        left_out_rows = kept.left_out
        constraints = "independent" if kept.is_independent else "redundant"
        names = tuple(x for x, keep in zip(names, kept.loops, strict=True) if keep)
        loop = loops_of(layout.joints, layout.space, loops, kept.loops)
        if contacts is not None:
            contacts = _reduced(compiled, layout, contacts, kept, geoms, ground)
    if contacts is not None:
        contacts = contacts.followed_by(len(names))
    slips = None if contacts is None else contacts.nonholonomic
    heights = None if contacts is None else contacts.holonomic
    positions = _joined(heights, loop)
    coordinates = _coordinates(layout)
    system = LagrangianSystem(
        lagrangian_of(mechanics, known),
        nonholonomic=slips,
        holonomic=positions,
        force=force_of(mechanics, known, actuators, controls),
        manifold=layout.space.manifold,
        coordinates=coordinates,
        constraints=constraints or "independent",
    )
    bodies = tuple(name_of(compiled, "body", i) for i in range(compiled.nbody))
    return Robot(
        system,
        jax.tree.map(lambda x: jnp.asarray(x, jnp.result_type(float)), values),
        coordinates,
        actuators.names,
        contacts,
        names,
        bodies,
        layout,
        tuple(np.asarray(compiled.qpos0).tolist()),
        left_out_rows,
    )


def _reduced(
    model: Any,
    layout: Layout,
    contacts: Contacts,
    kept: Kept,
    geoms: Mapping[str, RollingGeom],
    ground: Any,
) -> Contacts | None:
    """Return the contacts without the constraints that follow from others."""
    pairs = list(zip(contacts.names, contacts.contacts, strict=True))
    reduced = {}
    for (name, contact), own in zip(pairs, kept.slips, strict=True):
        rows = zip(contact.no_slip, own, strict=True)
        no_slip = tuple(x for x, keep in rows if keep)
        reduced[name] = geoms[name]._replace(no_slip=no_slip)
    touching = [name for name, contact in pairs if contact.touches]
    dropped = [x for x, keep in zip(touching, kept.heights, strict=True) if not keep]
    return contacts_of(model, layout, reduced, ground, dropped)


def _coordinates(layout: Layout) -> tuple[str, ...]:
    names = []
    for joint in layout.joints:
        turns = [f"{joint.name}_r{x}" for x in "xyz"]
        own = {"free": [*(f"{joint.name}_{x}" for x in "xyz"), *turns], "ball": turns}
        names += own.get(joint.kind, [joint.name])
    return tuple(names)


def _joined(heights: Any, loop: Any) -> Any:
    """Return the contact heights and the loop constraints as one function, or None."""
    if heights is None or loop is None:
        return loop if heights is None else heights

    def holonomic(t, q, args):
        return jnp.concatenate([heights(t, q, args), loop(t, q, args)])

    return holonomic


# --- Robots that come with nhjax ------------------------------------------------------

_FOLDER = Path(__file__).parent / "models"

_LEFT_ROLLERS, _RIGHT_ROLLERS = -math.pi / 4, math.pi / 4
# The right front wheel of the car may slip sideways, because a steering trapezoid does
# not turn both front wheels exactly about one centre. The right wheels of the quadruped
# may slip sideways too: when all wheels are parallel, the right wheels would repeat the
# lateral constraints of the left wheels.
_OPTIONS: Mapping[str, tuple[str, dict[str, Any]]] = MappingProxyType(
    {
        "ackermann_car": (
            "ackermann_car.xml",
            {
                "rolling": {
                    "rear_left_tread": "no slip",
                    "rear_right_tread": "no longitudinal slip",
                    "front_left_tread": "no slip",
                    "front_right_tread": "no longitudinal slip",
                }
            },
        ),
        "balancing_robot": (
            "balancing_robot.xml",
            {"rolling": ("left_tread", "right_tread")},
        ),
        "differential_drive": (
            "differential_drive.urdf",
            {
                "rolling": ("left_tread", "right_tread", "caster_tread"),
                "root": "planar",
                "ground": -0.1,
                "ignore": ("contacts",),
            },
        ),
        "mecanum_platform": (
            "mecanum_platform.xml",
            {
                "rolling": {
                    "front_left_tread": _LEFT_ROLLERS,
                    "front_right_tread": _RIGHT_ROLLERS,
                    "rear_left_tread": _RIGHT_ROLLERS,
                    "rear_right_tread": _LEFT_ROLLERS,
                }
            },
        ),
        "wheeled_quadruped": (
            "wheeled_quadruped.xml",
            {
                "rolling": {
                    "front_left_tread": "no slip",
                    "front_right_tread": "no longitudinal slip",
                    "rear_left_tread": "no slip",
                    "rear_right_tread": "no longitudinal slip",
                }
            },
        ),
    }
)


def example_robot_file(name: str) -> Path:
    """Return the path of the model file of a robot that comes with nhjax.

    **Arguments:**

    - `name`: as for `example_robot`.

    **Raises:** `ValueError` if there is no such robot.

    !!! example

        >>> import nhjax
        >>> nhjax.example_robot_file("mecanum_platform").name
        'mecanum_platform.xml'
    """
    check_choice("example_robot: `name`", name, tuple(_OPTIONS))
    return _FOLDER / _OPTIONS[name][0]


def example_robot(name: str, **options: Any) -> Robot:
    """Read a robot that comes with nhjax.

    | name | the robot | velocities |
    | --- | --- | --- |
    | `"ackermann_car"` | a car, whose steering has a tie rod that closes a loop | 10 |
    | `"balancing_robot"` | a body on two wheels that falls without control | 6 |
    | `"differential_drive"` | two driven wheels and a caster; a URDF file | 7 |
    | `"mecanum_platform"` | a platform on four mecanum wheels | 7 |
    | `"wheeled_quadruped"` | four legs with springs and a wheel each | 20 |

    **Arguments:**

    - `name`: the name of the robot.
    - `options`: options of `from_mujoco`, such as `parameters` and `controls`. They
        replace the options that belong to the robot, such as `rolling`.

    **Returns:** a `Robot`.

    **Raises:** `ValueError` if there is no such robot; otherwise as `from_mujoco`.

    !!! example

        >>> import nhjax
        >>> robot = nhjax.example_robot("balancing_robot")
        >>> robot.coordinates
        ('x', 'y', 'heading', 'pitch', 'left', 'right')
    """
    path = example_robot_file(name)
    own: dict[str, Any] = dict(_OPTIONS[name][1])
    if "ground" in own:
        # Create the plane here, in the precision that JAX has at this call.
        own["ground"] = Plane(height=own["ground"])
    own |= options
    return from_mujoco(path, **own)
