"""The kinematic tree of a robot: its joints, its configuration space and its poses.

Each joint is a node of the tree. In large trees, the recursions from the world to the
ends of the tree treat all nodes at the same depth together. The number of operations in
the program therefore grows with the depth, not with the number of joints: all legs of a
robot cost no more operations than one leg. The programs of small trees compute single
entries instead of arrays, because most entries of their frames are zero.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args
from .._manifold import AbstractLieGroup, Euclidean, ProductGroup, SO3
from . import _scalars as entries
from ._joints import given_in, Joint, motions, Shift, twists


# Trees with more nodes than this are computed as arrays, because the program then has
# fewer operations. For smaller trees scalars are better: the program has no products
# with zeros, and compiles in less time.
LARGEST_OF_SCALARS = 40


class Part(NamedTuple):
    """A part of the configuration space: one free or ball joint, or some scalars."""

    kind: str
    joints: tuple[int, ...]
    first_velocity: int

    @property
    def groups(self) -> tuple[AbstractLieGroup, ...]:
        """The part as Lie groups.

        A free joint has two groups, for its position and its rotation. On SE(3) both
        would share a chart, so that steps of a body that moves fast would be less
        accurate.
        """
        groups = {"free": (Euclidean(3), SO3()), "ball": (SO3(),)}
        return groups.get(self.kind) or (Euclidean(len(self.joints)),)


def parts_of(joints: Sequence[Joint]) -> tuple[Part, ...]:
    """Divide the joints, in the order of the file, into parts of the space."""
    parts: list[Part] = []
    velocity = 0
    for number, joint in enumerate(joints):
        is_scalar = joint.kind in ("slide", "hinge")
        kind = "scalars" if is_scalar else joint.kind
        if is_scalar and parts and parts[-1].kind == "scalars":
            last = parts.pop()
            parts.append(last._replace(joints=(*last.joints, number)))
        else:
            parts.append(Part(kind, (number,), velocity))
        velocity += {"free": 6, "ball": 3}.get(joint.kind, 1)
    return tuple(parts)


class Space:
    """The configuration space of a robot, and MuJoCo's coordinates of it.

    The velocities are MuJoCo's `qvel`: a free joint has the velocity of its origin in
    space, and the angular velocity in the frame of its body.
    """

    def __init__(self, joints: Sequence[Joint]):
        self.parts = parts_of(joints)
        groups = [group for part in self.parts for group in part.groups]
        self.is_flat = len(groups) == 1 and self.parts[0].kind == "scalars"
        self.is_product = len(groups) > 1
        self.manifold: AbstractLieGroup | None = None
        if not self.is_flat:
            self.manifold = ProductGroup(*groups) if self.is_product else groups[0]
        self.num_velocities = sum(group.dim for group in groups)
        # The places of the scalar coordinates in a vector of velocities.
        self.scalars = np.asarray(
            [
                part.first_velocity + i
                for part in self.parts
                if part.kind == "scalars"
                for i in range(len(part.joints))
            ],
            int,
        )
        # The place of the first velocity of each joint.
        self.velocity_of: dict[int, int] = {
            joint: part.first_velocity + i
            for part in self.parts
            for i, joint in enumerate(part.joints)
        }

    def split(self, q: PyTree[Array]) -> tuple[list[tuple[Array, ...]], Array]:
        """Split q into the elements of free and ball joints, and all scalars.

        The element of a free joint is a position and a quaternion; the element of a
        ball joint is a quaternion.
        """
        elements = iter(q if self.is_product else (q,))
        special, scalars = [], []
        for part in self.parts:
            own = tuple(next(elements) for _ in part.groups)
            if part.kind == "scalars":
                scalars += own
            else:
                special.append(own)
        if scalars:
            vector = scalars[0] if len(scalars) == 1 else jnp.concatenate(scalars)
        else:
            vector = jnp.zeros((0,), special[0][-1].dtype)
        return special, vector

    def tangent(self, q: PyTree[Array], v: Array) -> PyTree[Array]:
        """Compute the rate of q from the velocity."""
        return v if self.manifold is None else self.manifold.tangent(q, v)

    def from_qpos(self, qpos: Float[Array, " nq"]) -> PyTree[Array]:
        """Convert MuJoCo's coordinates to q."""
        elements, place = [], 0
        for part in self.parts:
            sizes = {"free": (3, 4), "ball": (4,)}.get(part.kind, (len(part.joints),))
            for size in sizes:
                elements.append(qpos[place : place + size])
                place += size
        return tuple(elements) if self.is_product else elements[0]

    def to_qpos(self, q: PyTree[Array]) -> Float[Array, "*batch nq"]:
        """Convert q, with any leading axes, to MuJoCo's coordinates."""
        return jnp.concatenate(q, axis=-1) if self.is_product else q


def displacement(shifts: Sequence[Shift], args: Args, dtype: Any) -> entries.Vector:
    """Compute by how much the parameters in `args` move the origin of a frame."""
    given = given_in(args, "position")
    found: entries.Vector = 3 * [0.0]
    for body, rotation, reference in shifts:
        if body in given:
            position = jnp.asarray(given[body], dtype)
            moved = [
                entries.add(jax.lax.index_in_dim(position, i, keepdims=False), -x)
                for i, x in enumerate(reference.tolist())
            ]
            found = entries.sums(found, entries.apply(entries.known(rotation), moved))
    return found


class Level(NamedTuple):
    """The nodes at one depth.

    - `nodes`: their places among the joints of the tree, where free and ball joints
        come first.
    - `parents`: for each node, the place of its parent in the level before. The parent
        of all nodes in the first level is the world.
    """

    nodes: np.ndarray
    parents: np.ndarray


class Tree:
    """The joints on the paths from the world to the joints `kept`, ordered by depth.

    `node` maps the number of a joint to its place in this order.
    """

    def __init__(self, joints: Sequence[Joint], space: Space, kept: Sequence[int]):
        self.space = space
        on_paths = set()
        for number in kept:
            while number >= 0 and number not in on_paths:
                on_paths.add(number)
                number = joints[number].parent
        special = _joints_of(space, ("free", "ball"))
        scalar = _joints_of(space, ("scalars",))
        self.special = [(i, joints[j]) for i, j in enumerate(special) if j in on_paths]
        self.special_velocities = [
            part.first_velocity
            for part in space.parts
            if part.kind != "scalars" and part.joints[0] in on_paths
        ]
        chosen = [(i, joints[j]) for i, j in enumerate(scalar) if j in on_paths]
        self.scalar = np.asarray([i for i, _ in chosen], int)
        self.shifts = [x.shifts for _, x in chosen]
        self.num_scalars = len(scalar)
        self.reference = np.asarray([x.reference for _, x in chosen], float)
        self.constants = motions([joint for _, joint in chosen])
        self.twists = twists([joint for _, joint in chosen])
        order = [j for j in (*special, *scalar) if j in on_paths]
        self.levels: list[Level] = []
        self.node: dict[int, int] = {}
        before, parents = [-1], {-1}
        while len(self.node) < len(order):
            own = [j for j in order if joints[j].parent in parents]
            self.levels.append(
                Level(
                    np.asarray([order.index(j) for j in own], int),
                    np.asarray([before.index(joints[j].parent) for j in own], int),
                )
            )
            self.node |= {j: len(self.node) + i for i, j in enumerate(own)}
            before, parents = own, set(own)

    @property
    def is_small(self) -> bool:
        """Whether the recursions are written in scalars."""
        return len(self.node) <= LARGEST_OF_SCALARS

    def poses_of_scalars(
        self, q: PyTree[Array], args: Args
    ) -> list[tuple[entries.Matrix, entries.Vector]]:
        """Compute the rotation and the position of each node, entry by entry."""
        own, poses, before = self._relative_scalars(q, args), [], []
        for level in self.levels:
            here = []
            for node, parent in zip(level.nodes, level.parents, strict=True):
                rotation, position = own[node]
                if before:
                    turn, place = before[parent]
                    position = entries.sums(place, entries.apply(turn, position))
                    rotation = entries.product(turn, rotation)
                here.append((rotation, position))
            poses, before = [*poses, *here], here
        return poses

    def motion_of_scalars(
        self,
        q: PyTree[Array],
        v: Array,
        gravity: Float[np.ndarray, "3"] | None,
        args: Args,
    ) -> list[tuple[entries.Vector, entries.Vector, entries.Entry]]:
        """Compute each node's twist and gravity like `motion`, but entry by entry."""
        own = self._relative_scalars(q, args)
        twists = self._own_twists_of_scalars(v, [rotation for rotation, _ in own])
        weight = entries.known(np.zeros(3) if gravity is None else gravity)
        found, before = [], []
        for level in self.levels:
            here = []
            for node, parent in zip(level.nodes, level.parents, strict=True):
                rotation, position = own[node]
                above = before[parent] if before else (6 * [0.0], weight, 0.0)
                moving, turning = above[0][:3], above[0][3:]
                moving = entries.sums(moving, entries.cross(turning, position))
                back = entries.transposed(rotation)
                carried = entries.apply(back, moving) + entries.apply(back, turning)
                depth = entries.add(above[2], entries.dot(above[1], position))
                twist = entries.sums(carried, twists[node])
                here.append((twist, entries.apply(back, above[1]), depth))
            found, before = [*found, *here], here
        return found

    def _relative_scalars(
        self, q: PyTree[Array], args: Args
    ) -> list[tuple[entries.Matrix, entries.Vector]]:
        special, scalars = self.space.split(q)
        found = []
        for place, joint in self.special:
            matrix = SO3().matrix(special[place][-1])
            rotation = [[matrix[i, j] for j in range(3)] for i in range(3)]
            if joint.kind == "free":
                position = [special[place][0][i] for i in range(3)]
            else:
                offset = entries.known(joint.offset[:3, :3])
                rotation = entries.product(offset, rotation)
                anchor = joint.anchor.tolist()
                start = joint.offset[:3, 3] + joint.offset[:3, :3] @ joint.anchor
                moved = entries.apply(rotation, [-x for x in anchor])
                position = entries.sums(start.tolist(), moved)
                shift = displacement(joint.shifts, args, matrix.dtype)
                position = entries.sums(position, shift)
            found.append((rotation, position))
        for number, i in enumerate(self.scalar.tolist()):
            s = jax.lax.index_in_dim(scalars, i, keepdims=False)
            reference = float(self.reference[number])
            s = entries.add(s, -reference)
            first, sine, versine, linear = self.constants[:, number]
            # In terms of cos s, instead of 1 - cos s, the entries for a joint along a
            # coordinate axis are single sines and cosines.
            parts: entries.Vector = [1.0, 0.0, 0.0, 0.0]
            if np.any(sine):
                parts[1:3] = [jnp.sin(s), jnp.cos(s)]
            if np.any(linear):
                parts[3] = s
            rows = entries.known(np.stack([first + versine, sine, -versine, linear]))
            values = [entries.dot(column, parts) for column in zip(*rows, strict=True)]
            rotation = [values[:3], values[3:6], values[6:9]]
            shift = displacement(self.shifts[number], args, scalars.dtype)
            found.append((rotation, entries.sums(values[9:], shift)))
        return found

    def _own_twists_of_scalars(
        self, v: Array, rotations: list[entries.Matrix]
    ) -> list[entries.Vector]:
        def component(i):
            return jax.lax.index_in_dim(v, int(i), keepdims=False)

        found = []
        for node, (first, (_, joint)) in enumerate(
            zip(self.special_velocities, self.special, strict=True)
        ):
            if joint.kind == "free":
                moving, turning = (
                    [component(first + i) for i in range(k, k + 3)] for k in (0, 3)
                )
                back = entries.transposed(rotations[node])
                found.append([*entries.apply(back, moving), *turning])
            else:
                turning = [component(first + i) for i in range(3)]
                moving = entries.cross(joint.anchor.tolist(), turning)
                found.append([*moving, *turning])
        for twist, i in zip(self.twists, self.scalar, strict=True):
            rate = component(self.space.scalars[i])
            found.append([entries.times(x, rate) for x in entries.known(twist)])
        return found

    def poses(self, q: PyTree[Array], args: Args) -> tuple[Array, Array]:
        """Compute the rotations and the positions of all nodes in space."""
        all_rotations, all_positions = self._relative(q, args)
        rotations, positions = [], []
        for level in self.levels:
            rotation = take(all_rotations, level.nodes)
            position = take(all_positions, level.nodes)
            if rotations:
                turn = take(rotations[-1], level.parents)
                moved = jnp.einsum("nij,nj->ni", turn, position)
                position = take(positions[-1], level.parents) + moved
                rotation = jnp.einsum("nij,njk->nik", turn, rotation)
            rotations.append(rotation)
            positions.append(position)
        return jnp.concatenate(rotations), jnp.concatenate(positions)

    def motion(
        self,
        q: PyTree[Array],
        v: Array,
        gravity: Float[np.ndarray, "3"] | None,
        args: Args,
    ) -> tuple[Array, Array | None, Array | None]:
        """Compute the body twist (v, ω) of each node, and gravity in its frame.

        The third result is the scalar product of each node's position with gravity.
        """
        all_rotations, all_positions = self._relative(q, args)
        all_twists = self._own_twists(v, all_rotations)
        twists: list[Array] = []
        falls: list[Array] = []
        depths: list[Array] = []
        for level in self.levels:
            rotation = take(all_rotations, level.nodes)
            position = take(all_positions, level.nodes)
            twist = take(all_twists, level.nodes)
            if twists:
                parent = take(twists[-1], level.parents)
                turning = parent[:, 3:]
                moving = parent[:, :3] + jnp.cross(turning, position)
                vectors = [moving, turning]
                if gravity is not None:
                    fall = take(falls[-1], level.parents)
                    vectors.append(fall)
                    depths.append(
                        take(depths[-1], level.parents)
                        + jnp.einsum("ni,ni->n", fall, position)
                    )
                turned = jnp.einsum(
                    "nij,nki->nkj", rotation, jnp.stack(vectors, axis=1)
                )
                twist = twist + turned[:, :2].reshape(-1, 6)
                if gravity is not None:
                    falls.append(turned[:, 2])
            elif gravity is not None:
                constant = jnp.asarray(gravity, v.dtype)
                falls.append(jnp.einsum("nij,i->nj", rotation, constant))
                depths.append(jnp.einsum("ni,i->n", position, constant))
            twists.append(twist)
        if gravity is None:
            return jnp.concatenate(twists), None, None
        joined = jnp.concatenate(twists)
        return joined, jnp.concatenate(falls), jnp.concatenate(depths)

    def _own_twists(self, v: Array, rotations: Array) -> Array:
        """Compute the twist of each node relative to its parent."""
        twists = []
        for node, (first, (_, joint)) in enumerate(
            zip(self.special_velocities, self.special, strict=True)
        ):
            if joint.kind == "free":
                moving = rotations[node].T @ v[first : first + 3]
                twist = jnp.concatenate([moving, v[first + 3 : first + 6]])
            else:
                turning = v[first : first + 3]
                moving = jnp.cross(jnp.asarray(joint.anchor, v.dtype), turning)
                twist = jnp.concatenate([moving, turning])
            twists.append(twist[None])
        if len(self.scalar):
            rates = take(v, self.space.scalars[self.scalar])
            twists.append(jnp.asarray(self.twists, v.dtype) * rates[:, None])
        return jnp.concatenate(twists)

    def _relative(self, q: PyTree[Array], args: Args) -> tuple[Array, Array]:
        """Compute the pose of each node relative to its parent."""
        elements, scalars = self.space.split(q)
        dtype = scalars.dtype
        rotations, positions = [], []
        for place, joint in self.special:
            rotation = SO3().matrix(elements[place][-1])
            if joint.kind == "free":
                position = elements[place][0]
            else:
                offset = jnp.asarray(joint.offset, dtype)
                anchor = jnp.asarray(joint.anchor, dtype)
                turn = offset[:3, :3] @ rotation
                position = offset[:3, 3] + offset[:3, :3] @ anchor - turn @ anchor
                shift = displacement(joint.shifts, args, dtype)
                position = position + entries.stacked(shift, dtype)
                rotation = turn
            rotations.append(rotation[None])
            positions.append(position[None])
        if len(self.scalar):
            s = take(scalars, self.scalar)
            s = s - jnp.asarray(self.reference, dtype)
            motion = jnp.stack([jnp.ones_like(s), jnp.sin(s), 1 - jnp.cos(s), s])
            both = jnp.einsum("knm,kn->nm", jnp.asarray(self.constants, dtype), motion)
            rotations.append(both[:, :9].reshape(-1, 3, 3))
            shifts = [displacement(x, args, dtype) for x in self.shifts]
            positions.append(both[:, 9:] + _rows_of(shifts, dtype))
        return jnp.concatenate(rotations), jnp.concatenate(positions)


def _rows_of(vectors: list[entries.Vector], dtype: Any) -> Array:
    """Convert vectors to rows of an array; a vector of Python floats must be zero."""
    rows = jnp.zeros((len(vectors), 3), dtype)
    for number, vector in enumerate(vectors):
        if not all(isinstance(x, float) for x in vector):
            rows = rows.at[number].set(entries.stacked(vector, dtype))
    return rows


def _joints_of(space: Space, kinds: tuple[str, ...]) -> list[int]:
    return [j for part in space.parts if part.kind in kinds for j in part.joints]


def take(x: Array, places: np.ndarray) -> Array:
    """Return rows of an array, by a slice where this is possible."""
    first, count = (int(places[0]) if len(places) else 0), len(places)
    if not np.array_equal(places, np.arange(first, first + count)):
        return x[places]
    return x if count == x.shape[0] else x[first : first + count]


class Frame(NamedTuple):
    """The frame of a body, a geom or a site, which is fixed to a node of the tree.

    `shifts` are the parameters that move its origin relative to the node.
    """

    joint: int
    matrix: Float[np.ndarray, "4 4"]
    shifts: tuple[Shift, ...] = ()


class FramePoses:
    """The poses of some frames in space; frames of the world are constant."""

    def __init__(self, joints: Sequence[Joint], space: Space, frames: Sequence[Frame]):
        self.tree = Tree(joints, space, [frame.joint for frame in frames])
        # The world comes after all nodes.
        node = self.tree.node | {-1: len(self.tree.node)}
        self.has_world = any(frame.joint < 0 for frame in frames)
        self.nodes = np.asarray([node[frame.joint] for frame in frames], int)
        self.turns = np.stack([frame.matrix[:3, :3] for frame in frames])
        self.places = np.stack([frame.matrix[:3, 3] for frame in frames])
        self.shifts = [frame.shifts for frame in frames]

    def __call__(self, q: PyTree[Any], args: Args) -> tuple[Array, Array]:
        """Compute positions and rotations of all frames in space."""
        dtype = self.tree.space.split(q)[1].dtype
        if self.tree.is_small:
            return self._of_scalars(q, args, dtype)
        rotations, positions = [], []
        if self.tree.levels:
            rotation, position = self.tree.poses(q, args)
            rotations, positions = [rotation], [position]
        if self.has_world:
            rotations.append(jnp.eye(3, dtype=dtype)[None])
            positions.append(jnp.zeros((1, 3), dtype))
        rotation = take(jnp.concatenate(rotations), self.nodes)
        position = take(jnp.concatenate(positions), self.nodes)
        shifts = [displacement(x, args, dtype) for x in self.shifts]
        places = jnp.asarray(self.places, dtype) + _rows_of(shifts, dtype)
        turns = jnp.asarray(self.turns, dtype)
        position = position + jnp.einsum("nij,nj->ni", rotation, places)
        return position, jnp.einsum("nij,njk->nik", rotation, turns)

    def _of_scalars(
        self, q: PyTree[Any], args: Args, dtype: Any
    ) -> tuple[Array, Array]:
        world = entries.known(np.eye(3)), 3 * [0.0]
        poses = [*self.tree.poses_of_scalars(q, args), world]
        positions, rotations = [], []
        for node, turn, place, shifts in zip(
            self.nodes, self.turns, self.places, self.shifts, strict=True
        ):
            rotation, position = poses[node]
            shift = displacement(shifts, args, dtype)
            place = entries.sums(entries.known(place), shift)
            moved = entries.apply(rotation, place)
            positions.append(entries.sums(position, moved))
            rotations.append(entries.product(rotation, entries.known(turn)))
        return entries.stacked(positions, dtype), entries.stacked(rotations, dtype)


def homogeneous(
    position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]
) -> Float[np.ndarray, "4 4"]:
    """Return the matrix of a pose that MuJoCo gives by a position and a quaternion."""
    w, x, y, z = np.asarray(quaternion) / np.linalg.norm(quaternion)
    found = np.eye(4)
    found[:3, :3] = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    found[:3, 3] = position
    return found
