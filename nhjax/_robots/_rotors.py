"""Wheels and rotors: bodies whose inertia does not change while their joint turns.

At the end of a branch, such a body needs no frame of its own. Its inertia is added to
the inertia of its parent, as if both were fixed together. With the twist ξ of the
parent, the joint rate s' then adds s' h·ξ + ½ I s'² to the kinetic energy. Here h is
the momentum of the body at s' = 1 and ξ = 0, and I is its moment of inertia about the
joint. The program of a robot on wheels is therefore as short as one written by hand.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from . import _scalars as entries
from ._joints import Joint, pose_of_joint


class Rotor(NamedTuple):
    """The part of the kinetic energy that depends on the rate of a rotor.

    - `joint`, `parent`: the indices of its joint and of the joint before it, or -1.
    - `momentum`, `inertia`: h and I in this energy; h is in the order (v, ω) of twists.
    """

    joint: int
    parent: int
    momentum: Float[np.ndarray, "6"]
    inertia: float


class Merged(NamedTuple):
    """Bodies after the rotors were fixed to their parents.

    `joints`, `inertia` and `moment` have one entry for each body.
    """

    joints: list[int]
    inertia: Float[np.ndarray, "b 4 4"]
    moment: Float[np.ndarray, "b 4"]
    rotors: list[Rotor]


# A body is a rotor if its inertia is the same at these angles of its joint: zero, and
# angles that are not simple fractions of a turn.
_ANGLES = (0.0, 1.1, 2.3, 4.1)


def merge_rotors(
    joints: Sequence[Joint],
    bodies: Sequence[int],
    inertia: Float[np.ndarray, "b 4 4"],
    moment: Float[np.ndarray, "b 4"],
    variable: set[int],
) -> Merged:
    """Fix the rotors at the ends of branches to their parents.

    **Arguments:**

    - `joints`: all joints.
    - `bodies`, `inertia`, `moment`: for each body, the joint, the pseudo-inertia, and
        the vector (Σ m x, Σ m) times the fraction of the weight that gravity
        compensation leaves.
    - `variable`: bodies whose inertia can change. They are not treated as rotors.
    """
    own, inertia, moment = list(bodies), inertia.copy(), moment.copy()
    rotors: list[Rotor] = []
    for number in reversed(range(len(joints))):
        joint = joints[number]
        on_it = [i for i, x in enumerate(own) if x == number]
        is_end = all(x.parent != number for x in joints)
        can_move = joint.shifts or variable.intersection(on_it)
        if joint.kind != "hinge" or not is_end or can_move:
            continue
        total = inertia[on_it].sum(axis=0)
        weight = moment[on_it].sum(axis=0)
        poses = [pose_of_joint(joint, angle) for angle in _ANGLES]
        carried = np.array([pose @ total @ pose.T for pose in poses])
        lifted = np.array([pose @ weight for pose in poses])
        sizes = np.abs(carried).max(initial=0.0), np.abs(lifted).max(initial=0.0)
        if np.any(np.ptp(carried, axis=0) > 1e-13 * sizes[0]):
            continue
        if np.any(np.ptp(lifted, axis=0) > 1e-13 * sizes[1]):
            continue
        pose = poses[0]
        axis = pose[:3, :3] @ joint.axis
        anchor = pose[:3, :3] @ joint.anchor + pose[:3, 3]
        twist = np.concatenate([np.cross(anchor, axis), axis])
        momentum = np.asarray(spatial_inertia(carried[0].tolist())) @ twist
        rotors.append(Rotor(number, joint.parent, momentum, float(twist @ momentum)))
        for i in on_it:
            own[i] = joint.parent
            inertia[i] = pose @ inertia[i] @ pose.T
            moment[i] = pose @ moment[i]
    return Merged(own, inertia, moment, rotors)


def spatial_inertia(inertia: entries.Matrix) -> entries.Matrix:
    """Return M of the kinetic energy ½ ξ·M ξ = ½ m v² + v·(ω × m c) + ½ ω·I ω.

    The twist is ξ = (v, ω). The pseudo-inertia gives the mass m, the product m c with
    the centre of mass c, and the inertia I about the origin.
    """
    mass, (x, y, z) = inertia[3][3], [row[3] for row in inertia[:3]]
    trace = entries.total(inertia[i][i] for i in range(3))

    def minus(entry):
        return entries.times(-1.0, entry)

    # This matrix maps ω to ω × m c.
    across = [[0.0, z, minus(y)], [minus(z), 0.0, x], [y, minus(x), 0.0]]
    rows = []
    for i, row in enumerate(across):
        rows.append([mass if i == j else 0.0 for j in range(3)] + row)
    for i, column in enumerate(entries.transposed(across)):
        about = [minus(inertia[i][j]) for j in range(3)]
        about[i] = entries.add(trace, about[i])
        rows.append(column + about)
    return rows


def moved_inertia(
    inertia: entries.Matrix, shift: entries.Vector, factor: entries.Entry
) -> entries.Matrix:
    """Return the pseudo-inertia of a body that is moved and has another mass.

    **Arguments:**

    - `inertia`: the pseudo-inertia.
    - `shift`: the vector by which all points of the body move.
    - `factor`: the factor by which mass and moments of inertia are multiplied.
    """
    to = [[float(i == j) for j in range(3)] + [shift[i]] for i in range(3)]
    to.append([0.0, 0.0, 0.0, 1.0])
    moved = entries.product(entries.product(to, inertia), entries.transposed(to))
    return [[entries.times(factor, x) for x in row] for row in moved]
