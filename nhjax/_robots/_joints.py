"""The joints of a robot, and the coefficients of their twists and poses."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from .._custom_types import Args


class Shift(NamedTuple):
    """How a frame depends on the position of a body that is moved by `args`.

    `args["position"][body]` moves the origin of the frame by `rotation` times the
    difference of this position from `reference`, the position in the file.
    """

    body: str
    rotation: Float[np.ndarray, "3 3"]
    reference: Float[np.ndarray, "3"]


def given_in(args: Args, kind: str) -> dict[str, Any]:
    """Return the parameters of a kind in `args`, by name."""
    return args.get(kind, {}) if isinstance(args, dict) else {}


class Joint(NamedTuple):
    """A joint of the tree.

    - `name`, `kind`: the kind is "free", "ball", "slide" or "hinge".
    - `parent`: the number of the joint before it on the path from the world, or -1.
    - `offset`: the frame of its body at rest, relative to the frame that
        `parent` moves.
    - `anchor`, `axis`: the point and the direction of the joint in its own frame.
    - `reference`: the coordinate of a slide or a hinge at rest.
    - `shifts`: the parameters that move the origin of `offset`.
    """

    name: str
    kind: str
    parent: int
    offset: Float[np.ndarray, "4 4"]
    anchor: Float[np.ndarray, "3"]
    axis: Float[np.ndarray, "3"]
    reference: float
    shifts: tuple[Shift, ...] = ()


def twists(joints: Sequence[Joint]) -> Float[np.ndarray, "n 6"]:
    """Return the twists of slides and hinges at unit rate, in their own frames."""
    found = np.zeros((len(joints), 6))
    for row, joint in zip(found, joints, strict=True):
        if joint.kind == "slide":
            row[:3] = joint.axis
        else:
            row[:3], row[3:] = np.cross(joint.anchor, joint.axis), joint.axis
    return found


def motions(joints: Sequence[Joint]) -> Float[np.ndarray, "4 n 12"]:
    """Return the coefficients of 1, sin s, 1 - cos s and s in the pose of each joint.

    Here s is the angle or the displacement of the joint. The joints are slides and
    hinges. A hinge turns about its axis a by Rodrigues' formula
    I + sin s â + (1 - cos s) â² with â x = a × x, and its anchor stays in place. The 12
    numbers are the entries of the rotation matrix, then the position.
    """
    found = np.zeros((4, len(joints), 12))
    for number, joint in enumerate(joints):
        turn, shift = joint.offset[:3, :3], joint.offset[:3, 3]
        found[0, number] = [*turn.ravel(), *shift]
        if joint.kind == "slide":
            found[3, number, 9:] = turn @ joint.axis
            continue
        # The columns of `hat` are a × e_i, so that it maps x to a × x.
        hat = np.cross(joint.axis, np.eye(3)).T
        for row, matrix in ((1, hat), (2, hat @ hat)):
            turned = turn @ matrix
            found[row, number] = [*turned.ravel(), *(-turned @ joint.anchor)]
    return found


def pose_of_joint(joint: Joint, angle: float) -> Float[np.ndarray, "4 4"]:
    """Return a hinge's pose in the frame of its parent, at an angle from rest."""
    parts = np.array([1.0, np.sin(angle), 1 - np.cos(angle), angle])
    numbers = np.tensordot(parts, motions([joint])[:, 0], axes=1)
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = numbers[:9].reshape(3, 3), numbers[9:]
    return found
