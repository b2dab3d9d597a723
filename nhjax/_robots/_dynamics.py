"""The Lagrangian, the forces and the closed loops of a robot, as functions of JAX."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalarLike
from .._errors import ShapeError
from .._manifold import Exponential, SO3
from . import _scalars as entries
from ._joints import given_in, Joint, Shift
from ._rotors import merge_rotors, moved_inertia, spatial_inertia
from ._tree import displacement, Frame, FramePoses, Space, Tree


class Bodies(NamedTuple):
    """The bodies that can move, as arrays with one row for each body.

    - `names`, `joints`: the name of each body, and the number of the last joint on the
        path from the world to the body.
    - `inertia`: the pseudo-inertia [[Σ m x xᵀ, Σ m x], [Σ m xᵀ, Σ m]] in the frame
        after that joint.
    - `mass`: the masses [kg].
    - `weight`: the fraction of the weight that gravity compensation leaves.
    - `shifts`: the parameters that move each body relative to the frame after its
        joint.
    """

    names: tuple[str, ...]
    joints: tuple[int, ...]
    inertia: Float[np.ndarray, "b 4 4"]
    mass: Float[np.ndarray, " b"]
    weight: Float[np.ndarray, " b"]
    shifts: tuple[tuple[Shift, ...], ...]


class BallSpring(NamedTuple):
    """A spring of a ball joint, whose torque is proportional to the rotation vector."""

    joint: int
    stiffness: float
    reference: Float[np.ndarray, "4"]


class Mechanics(NamedTuple):
    """All numbers of a robot that its Lagrangian and its force use.

    Arrays with one entry for each velocity are in MuJoCo's order, which is also the
    order of the velocities of the system. Arrays for tendons have one entry for each
    fixed tendon.
    """

    joints: tuple[Joint, ...]
    space: Space
    bodies: Bodies
    gravity: Float[np.ndarray, "3"]
    armature: Float[np.ndarray, " n"]
    damping: Float[np.ndarray, "3 n"]
    friction: Float[np.ndarray, " n"]
    friction_smoothing: float
    # For the slides and hinges: the coefficients of x, x² and x³ in the force of the
    # spring, and the position at rest.
    stiffness: Float[np.ndarray, "3 s"]
    rest: Float[np.ndarray, " s"]
    ball_springs: tuple[BallSpring, ...]
    # The length of a tendon is a row of `tendons` times the scalar coordinates.
    tendons: Float[np.ndarray, "k s"]
    tendon_armature: Float[np.ndarray, " k"]
    tendon_damping: Float[np.ndarray, " k"]
    tendon_stiffness: Float[np.ndarray, " k"]
    tendon_rest: Float[np.ndarray, " k"]


# --- Parameters -----------------------------------------------------------------------

KINDS = (
    "mass",
    "damping",
    "stiffness",
    "armature",
    "friction",
    "position",
    "radius",
)


class Parameters(eqx.Module):
    """The numbers of a robot that `args` may replace.

    - `names`: for each of the `KINDS` in use, a dictionary from the names of bodies,
        joints or geoms to their places in the arrays. For positions and radii these are
        places in MuJoCo's model, and are not used here.
    - `controls`: the names of the actuators, or None if a function that the user passed
        computes the controls. With None, `args["controls"]` may have any structure.
    """

    names: dict[str, dict[str, tuple[int, ...]]] = eqx.field(static=True)
    controls: tuple[str, ...] | None = eqx.field(static=True)

    def replaced(self, kind: str, values: np.ndarray, args: Args, dtype: Any) -> Any:
        """Return `values`, with entries replaced by the values given in `args`."""
        given = given_in(args, kind)
        if not given:
            return jnp.asarray(values, dtype)
        result = jnp.asarray(values, dtype)
        for name, value in given.items():
            places = np.asarray(self.names[kind][name], int)
            result = result.at[places].set(jnp.asarray(value, dtype))
        return result

    def check(self, args: Args) -> None:
        """Raise unless `args` is None or a dictionary with known names."""
        if args is None:
            return
        known = ("controls", *self.names)
        if not isinstance(args, dict):
            raise TypeError(
                "`args` of a robot must be None or a dictionary with some of the keys "
                f"{', '.join(known)}, got {type(args).__name__}."
            )
        for key, given in args.items():
            if key not in known:
                raise ValueError(
                    f"`args` of the robot has the unknown key {key!r}; its keys can be "
                    f"{', '.join(known)}. Parameters must be named in "
                    "`from_mujoco(..., parameters=...)`. Put the gains of a function "
                    "`controls` into `args['controls']`."
                )
            if key == "controls":
                if self.controls is None:
                    continue
                shape = jnp.asarray(given).shape
                if shape != (len(self.controls),):
                    raise ShapeError(
                        f"`args['controls']` must have shape ({len(self.controls)},), "
                        f"one number for each of {', '.join(self.controls)}, got shape "
                        f"{shape}. For many runs use `jax.vmap`."
                    )
                continue
            if not isinstance(given, dict):
                raise TypeError(
                    f"`args[{key!r}]` must be a dictionary by name, such as "
                    f"`robot.args[{key!r}]`, got {type(given).__name__}."
                )
            for name, value in given.items():
                if name not in self.names[key]:
                    raise ValueError(
                        f"`args[{key!r}]` has the unknown name {name!r}; the names are "
                        f"{', '.join(self.names[key])}."
                    )
                shape = (3,) if key == "position" else ()
                if jnp.shape(value) != shape:
                    expected = f"have shape {shape}" if shape else "be one number"
                    raise ShapeError(
                        f"`args[{key!r}][{name!r}]` must {expected}, got shape "
                        f"{jnp.shape(value)}. For many runs use `jax.vmap`."
                    )


# --- The Lagrangian -------------------------------------------------------------------


def lagrangian_of(mechanics: Mechanics, parameters: Parameters) -> Any:
    """Return the Lagrangian L(t, q, v, args) of a robot.

    Bodies without a joint between them move as one. Their kinetic energy is ½ ξ·M ξ,
    with the body twist ξ = (v, ω) of their frame and their spatial inertia M, which
    depends only on parameters.
    """
    space, bodies = mechanics.space, mechanics.bodies
    changing = parameters.names.get("mass", {})
    changing_mass = {places[0]: name for name, places in changing.items()}
    variable = {i for i, shifts in enumerate(bodies.shifts) if shifts}
    variable.update(changing_mass)
    merged = merge_rotors(
        mechanics.joints,
        bodies.joints,
        bodies.inertia,
        bodies.weight[:, None] * bodies.inertia[:, 3],
        variable,
    )
    turned = {rotor.joint for rotor in merged.rotors}
    kept_joints = [j for j in range(len(mechanics.joints)) if j not in turned]
    tree = Tree(mechanics.joints, space, kept_joints)
    # Bodies that are fixed to the world are omitted: they have no kinetic energy, and
    # their potential energy is constant.
    moving = [i for i, joint in enumerate(merged.joints) if joint >= 0]
    changed = sorted(variable.intersection(moving))
    total, total_moment = (
        np.zeros((len(tree.node), 6, 6)),
        np.zeros((len(tree.node), 4)),
    )
    for i in moving:
        if i not in variable:
            node = tree.node[merged.joints[i]]
            total[node] += np.asarray(spatial_inertia(merged.inertia[i].tolist()))
            total_moment[node] += merged.moment[i]
    velocity_of = space.velocity_of
    has_tendons = np.any(mechanics.tendon_armature) or np.any(
        mechanics.tendon_stiffness
    )
    gravity = mechanics.gravity if np.any(mechanics.gravity) else None

    def inertias(args, dtype):
        """Compute M and (m c, m) of each node, as lists.

        M is the spatial inertia, m the mass without the part that gravity compensation
        carries, and c the centre of m.
        """
        inertia, moment = total.tolist(), total_moment.tolist()
        masses = args.get("mass", {})
        for i in changed:
            # If the mass of a body changes, its shape and its centre of mass stay the
            # same, and its inertia is multiplied by the same factor as its mass.
            factor, name = 1.0, changing_mass.get(i)
            if name in masses:
                factor = entries.times(masses[name], float(1 / bodies.mass[i]))
            shift = displacement(bodies.shifts[i], args, dtype)
            own = moved_inertia(merged.inertia[i].tolist(), shift, factor)
            weight, node = float(bodies.weight[i]), tree.node[merged.joints[i]]
            for row, added in zip(inertia[node], spatial_inertia(own), strict=True):
                row[:] = entries.sums(row, added)
            lifted = [entries.times(weight, row[3]) for row in own]
            moment[node] = entries.sums(moment[node], lifted)
        return inertia, moment

    def lagrangian(t, q, v, args):
        parameters.check(args)
        numbers = {k: x for k, x in (args or {}).items() if k != "controls"}
        numbers = jax.tree.map(lambda x: jnp.asarray(x, v.dtype), numbers)
        return value(q, v, numbers)

    def value(q, v, args):
        if not tree.node:
            energy, twists = jnp.zeros((), v.dtype), []
        elif tree.is_small:
            energy, twists = energy_of_scalars(q, v, args)
        else:
            energy, twists = energy_of_arrays(q, v, args)
        for joint, parent, momentum, inertia in merged.rotors:
            rate = v[velocity_of[joint]]
            energy = energy + 0.5 * inertia * rate * rate
            if parent >= 0:
                twist = list(twists[tree.node[parent]])
                with_parent = entries.dot(entries.known(momentum), twist)
                energy = entries.add(energy, entries.times(with_parent, rate))
        return rest_of(q, v, args, jnp.asarray(energy, v.dtype))

    def energy_of_arrays(q, v, args):
        dtype = v.dtype
        own, own_moment = inertias(args, dtype)
        inertia, moment = jnp.asarray(total, dtype), jnp.asarray(total_moment, dtype)
        for node in sorted({tree.node[merged.joints[i]] for i in changed}):
            inertia = inertia.at[node].set(entries.stacked(own[node], dtype))
            moment = moment.at[node].set(entries.stacked(own_moment[node], dtype))
        twist, fall, depth = tree.motion(q, v, gravity, args)
        energy = 0.5 * jnp.sum(jnp.einsum("nij,nj->ni", inertia, twist) * twist)
        if fall is not None and depth is not None:
            energy = energy + jnp.sum(moment[:, :3] * fall)
            energy = energy + jnp.sum(moment[:, 3] * depth)
        return energy, twist

    def energy_of_scalars(q, v, args):
        energy: Any = 0.0
        motion = tree.motion_of_scalars(q, v, gravity, args)
        inertia, moment = inertias(args, v.dtype)
        for (twist, fall, depth), own, rest in zip(
            motion, inertia, moment, strict=True
        ):
            for i in range(6):
                half = [entries.times(0.5, own[i][i]), *own[i][i + 1 :]]
                row = entries.dot(half, twist[i:])
                energy = entries.add(energy, entries.times(row, twist[i]))
            energy = entries.add(energy, entries.dot(rest, [*fall, depth]))
        return energy, [twist for twist, _, _ in motion]

    def rest_of(q, v, args, energy):
        """Add the terms of armatures, springs and tendons to the Lagrangian."""
        dtype = v.dtype
        if np.any(mechanics.armature) or "armature" in parameters.names:
            armature = parameters.replaced("armature", mechanics.armature, args, dtype)
            energy = energy + 0.5 * jnp.sum(armature * v * v)
        energy = energy - _spring_energy(mechanics, parameters, q, args, dtype)
        if has_tendons:
            matrix = jnp.asarray(mechanics.tendons, dtype)
            scalars = space.split(q)[1]
            rate = matrix @ v[space.scalars]
            stretch = matrix @ scalars - jnp.asarray(mechanics.tendon_rest, dtype)
            mass = jnp.asarray(mechanics.tendon_armature, dtype)
            stiffness = jnp.asarray(mechanics.tendon_stiffness, dtype)
            energy = energy + 0.5 * jnp.sum(mass * rate * rate)
            energy = energy - 0.5 * jnp.sum(stiffness * stretch * stretch)
        return energy

    return lagrangian


def _spring_energy(mechanics, parameters, q, args, dtype):
    """Compute the energy of the springs of joints."""
    elements, scalars = mechanics.space.split(q)
    energy = jnp.zeros((), dtype)
    if np.any(mechanics.stiffness) or "stiffness" in parameters.names:
        x = scalars - jnp.asarray(mechanics.rest, dtype)
        linear = parameters.replaced("stiffness", mechanics.stiffness[0], args, dtype)
        energy = energy + 0.5 * jnp.sum(linear * x * x)
        if np.any(mechanics.stiffness[1:]):
            second, third = jnp.asarray(mechanics.stiffness[1:], dtype)
            energy = energy + jnp.sum(second * x**3 / 3 + third * x**4 / 4)
    if mechanics.ball_springs:
        group = SO3(Exponential())
        special = [
            joint for joint in mechanics.joints if joint.kind in ("free", "ball")
        ]
        for spring in mechanics.ball_springs:
            place = special.index(mechanics.joints[spring.joint])
            back = group.inverse(jnp.asarray(spring.reference, dtype))
            vector = group.local(group.compose(back, elements[place][-1]))
            energy = energy + 0.5 * spring.stiffness * jnp.sum(vector * vector)
    return energy


# --- Forces ---------------------------------------------------------------------------


class Actuators(NamedTuple):
    """The actuators, with one row or entry for each actuator.

    The force of an actuator is (g₀ + g₁ l + g₂ l') u + b₀ + b₁ l + b₂ l', with its
    control u, gain g, bias b and length l = moment · q. If an actuator has no limit,
    the limit is infinite here.
    """

    names: tuple[str, ...]
    moment: Float[np.ndarray, "a n"]
    gain: Float[np.ndarray, "a 3"]
    bias: Float[np.ndarray, "a 3"]
    control_range: Float[np.ndarray, "a 2"]
    force_range: Float[np.ndarray, "a 2"]
    # The limits of the sum of all actuator forces on a scalar joint, with one row for
    # each velocity.
    joint_range: Float[np.ndarray, "n 2"]
    smoothing: float


def limited(x: Array, bounds: np.ndarray, smoothing: float) -> Array:
    """Limit signals smoothly: well inside the bounds, x changes only by round-off.

    The width of the transition is `smoothing` times the range, or times the magnitude
    of the bound if there is only one.
    """
    low, high = bounds[:, 0], bounds[:, 1]
    has = np.isfinite(bounds)
    if not has.any():
        return x
    both = has.all(axis=1)
    size = np.where(both, high - low, np.where(has[:, 0], np.abs(low), np.abs(high)))
    width = np.where(has.any(axis=1) & (size > 0), smoothing * size, 1.0)
    width = jnp.asarray(width, x.dtype)
    result = x
    for column, sign in ((0, -1.0), (1, 1.0)):
        bound = jnp.asarray(np.where(has[:, column], bounds[:, column], 0.0), x.dtype)
        excess = width * jax.nn.softplus(sign * (x - bound) / width)
        result = result - sign * jnp.where(has[:, column], excess, 0)
    return result


def force_of(
    mechanics: Mechanics,
    parameters: Parameters,
    actuators: Actuators,
    controls: Any,
) -> Any:
    """Return the force F(t, q, v, args) of damping, friction and actuators, or None."""
    space = mechanics.space
    has_damping = np.any(mechanics.damping) or "damping" in parameters.names
    has_friction = np.any(mechanics.friction) or "friction" in parameters.names
    has_tendons = bool(np.any(mechanics.tendon_damping))
    has_actuators = bool(actuators.names)
    if not (has_damping or has_friction or has_tendons or has_actuators):
        return None

    def force(t, q, v, args):
        parameters.check(args)
        dtype, total = v.dtype, jnp.zeros_like(v)
        if has_damping:
            linear = parameters.replaced("damping", mechanics.damping[0], args, dtype)
            total = total - linear * v
            if np.any(mechanics.damping[1:]):
                second, third = jnp.asarray(mechanics.damping[1:], dtype)
                total = total - (second * jnp.abs(v) + third * v * v) * v
        if has_friction:
            size = parameters.replaced("friction", mechanics.friction, args, dtype)
            total = total - size * jnp.tanh(v / mechanics.friction_smoothing)
        if has_tendons:
            matrix = jnp.asarray(mechanics.tendons, dtype)
            damping = jnp.asarray(mechanics.tendon_damping, dtype)
            pulls = matrix.T @ (damping * (matrix @ v[space.scalars]))
            total = total.at[space.scalars].add(-pulls)
        if has_actuators:
            total = total + of_actuators(t, q, v, args)
        return total

    def of_actuators(t, q, v, args):
        if controls is not None:
            u = jnp.asarray(controls(t, space.to_qpos(q), v, args))
            if u.shape != (len(actuators.names),):
                raise ShapeError(
                    f"`controls` must return shape ({len(actuators.names)},), one "
                    f"number for each of {', '.join(actuators.names)}, got {u.shape}."
                )
        elif args is None or "controls" not in args:
            u = jnp.zeros(len(actuators.names), v.dtype)
        else:
            u = jnp.asarray(args["controls"])
        u = limited(u.astype(v.dtype), actuators.control_range, actuators.smoothing)
        moment = jnp.asarray(actuators.moment, v.dtype)
        gain, bias = (jnp.asarray(x, v.dtype) for x in (actuators.gain, actuators.bias))
        strength = gain[:, 0] * u + bias[:, 0]
        if np.any(actuators.gain[:, 1:]) or np.any(actuators.bias[:, 1:]):
            length = moment[:, space.scalars] @ space.split(q)[1]
            rate = moment @ v
            strength = strength + (gain[:, 1] * u + bias[:, 1]) * length
            strength = strength + (gain[:, 2] * u + bias[:, 2]) * rate
        strength = limited(strength, actuators.force_range, actuators.smoothing)
        sum_of_all = moment.T @ strength
        return limited(sum_of_all, actuators.joint_range, actuators.smoothing)

    return force


# --- Closed loops ---------------------------------------------------------------------


class Connection(NamedTuple):
    """Two frames whose origins MuJoCo's equality `connect` or `weld` holds together."""

    name: str
    first: Frame
    second: Frame


class Coupling(NamedTuple):
    """A polynomial between two lengths: y - y₀ = Σ a_i (x - x₀)^i.

    Each length is a row of numbers times the scalar coordinates: the row `first` for y,
    and the row `second` for x.
    """

    name: str
    second: Float[np.ndarray, " s"]
    second_rest: float
    first: Float[np.ndarray, " s"]
    first_rest: float
    coefficients: Float[np.ndarray, "5"]


class Loops(NamedTuple):
    """The closed loops of a robot."""

    connections: tuple[Connection, ...]
    welds: tuple[Connection, ...]
    couplings: tuple[Coupling, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the constraint equations, in order."""
        points = [
            f"{loop.name} {x}"
            for loop in (*self.connections, *self.welds)
            for x in "xyz"
        ]
        turns = [f"{loop.name} r{x}" for loop in self.welds for x in "xyz"]
        return (*points, *turns, *(loop.name for loop in self.couplings))


def loops_of(
    joints: Sequence[Joint],
    space: Space,
    loops: Loops,
    kept: Sequence[bool] | None = None,
) -> Any:
    """Return the holonomic constraints Γ(t, q, args) of closed loops, or None.

    Only the equations that are `kept` are returned, by default all.
    """
    rows_kept = None if kept is None or all(kept) else np.flatnonzero(kept)
    pairs = (*loops.connections, *loops.welds)
    if not pairs and not loops.couplings:
        return None
    poses = None
    if pairs:
        first, second = [x.first for x in pairs], [x.second for x in pairs]
        poses = FramePoses(joints, space, [*first, *second])

    def constraint(t, q, args):
        rows = []
        if poses is not None:
            position, rotation = poses(q, args)
            a, b = jnp.split(position, 2)
            rows.append((a - b).ravel())
            if loops.welds:
                a, b = (x[len(loops.connections) :] for x in jnp.split(rotation, 2))
                relative = jnp.einsum("nji,njk->nik", b, a)
                # The antisymmetric part of a rotation matrix is the cross matrix of its
                # axis times the sine of its angle.
                part = relative - jnp.swapaxes(relative, 1, 2)
                turn = jnp.stack([part[:, 2, 1], part[:, 0, 2], part[:, 1, 0]], axis=1)
                rows.append(0.5 * turn.ravel())
        scalars = space.split(q)[1]
        for loop in loops.couplings:
            y = jnp.sum(jnp.asarray(loop.first, scalars.dtype) * scalars)
            x = jnp.sum(jnp.asarray(loop.second, scalars.dtype) * scalars)
            x, value = x - loop.second_rest, jnp.zeros((), scalars.dtype)
            for coefficient in loop.coefficients[::-1].tolist():
                value = coefficient + x * value
            rows.append((y - loop.first_rest - value)[None])
        found = jnp.concatenate(rows)
        return found if rows_kept is None else found[rows_kept]

    return constraint


def frame_pose(joints: Sequence[Joint], space: Space, frame: Frame) -> Any:
    """Return a function (t, q, args) -> position and rotation of one frame."""
    poses = FramePoses(joints, space, [frame])

    def pose(t: FloatScalarLike, q: PyTree[Array], args: Args) -> tuple[Array, Array]:
        position, rotation = poses(q, args)
        return position[0], rotation[0]

    return pose
