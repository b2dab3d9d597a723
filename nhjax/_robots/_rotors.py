"""Wheels and rotors: bodies whose inertia does not change while their joint turns.

Such a body at the end of a branch needs no frame of its own. Its parent carries the
body as if it were fixed, and the rate s' of the joint adds s' h·ξ + ½ I s'² to the
kinetic energy, with the twist ξ of the parent. This makes the program of a robot on
wheels as short as one that is written by hand.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._joints import Joint, pose_of_joint


class Rotor(NamedTuple):
    """The part of the kinetic energy that depends on the rate of a rotor.

    - `joint`, `parent`: the numbers of its joint and of the joint before it, or -1.
    - `momentum`, `inertia`: h of shape (6,) for a twist (v, ω), and I.
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


# Angles that are no simple fractions of a turn.
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
    - `bodies`, `inertia`, `moment`: the joint of each body, its pseudo-inertia, and the
        part of it that has weight.
    - `variable`: bodies whose mass can change, which stay as they are.
    """
    own, inertia, moment = list(bodies), inertia.copy(), moment.copy()
    rotors: list[Rotor] = []
    for number in reversed(range(len(joints))):
        joint = joints[number]
        on_it = [i for i, x in enumerate(own) if x == number]
        is_end = all(x.parent != number for x in joints)
        if joint.kind != "hinge" or not is_end or variable.intersection(on_it):
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
        momentum = spatial_inertia(carried[0]) @ twist
        rotors.append(Rotor(number, joint.parent, momentum, float(twist @ momentum)))
        for i in on_it:
            own[i] = joint.parent
            inertia[i] = pose @ inertia[i] @ pose.T
            moment[i] = pose @ moment[i]
    return Merged(own, inertia, moment, rotors)


def spatial_inertia(
    inertia: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "6 6"]:
    """Return the matrix M of ½ ξ·M ξ = ½ m v² + v·(ω × m c) + ½ ω·I ω.

    The pseudo-inertia gives the mass m, the moment m c and the inertia I about the
    origin.
    """
    second, moment, mass = inertia[:3, :3], inertia[:3, 3], inertia[3, 3]
    # This matrix maps ω to ω × m c.
    across = -np.cross(moment, np.eye(3)).T
    about = np.trace(second) * np.eye(3) - second
    return np.block([[mass * np.eye(3), across], [across.T, about]])
