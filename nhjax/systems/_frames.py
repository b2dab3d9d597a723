"""Rigid motions of the bodies and wheels of a machine, and their rates, in space."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Frame(NamedTuple):
    """A rigid motion: a point c of the body is at `origin + rotation @ c` in space.

    The rate of a motion is a `Frame` too, with the time derivatives of both parts.
    """

    rotation: Float[Array, "3 3"]
    origin: Float[Array, "3"]

    def move(self, point: Float[Array, "3"]) -> Float[Array, "3"]:
        """Compute the place of a body point, or its velocity if the frame is a rate."""
        return self.origin + self.rotation @ point


def angular_velocity(
    frame: Frame, rate: Frame, spin: Float[Array, ""]
) -> Float[Array, "3"]:
    """Compute the angular velocity of a wheel on a moving frame, in the frame's axes.

    The wheel turns at the rate `spin` about the second axis of the frame. With a zero
    `spin`, the result is the angular velocity of the frame itself.
    """
    skew = frame.rotation.T @ rate.rotation
    return jnp.stack([skew[2, 1], skew[0, 2] + spin, skew[1, 0]])


def down(rotation: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Compute the direction from the hub of a wheel to its lowest point.

    The z axis points down, so that this point has the largest z. The axle of the wheel
    is the second axis of the frame with `rotation`.
    """
    axle = rotation[:, 1]
    below = jnp.asarray([0, 0, 1], axle.dtype) - axle[2] * axle
    return below / jnp.sqrt(below @ below)


def contact_point(
    hub: Float[Array, "3"], radius: Float[Array, ""], frame: Frame
) -> Float[Array, "3"]:
    """Compute the lowest point, with the largest z, of a wheel on a frame."""
    return frame.move(hub) + radius * down(frame.rotation)


def contact_velocity(
    hub: Float[Array, "3"],
    radius: Float[Array, ""],
    frame: Frame,
    rate: Frame,
    spin: Float[Array, ""],
) -> Float[Array, "3"]:
    """Compute the velocity of the material point of a wheel at its contact."""
    turning = frame.rotation @ angular_velocity(frame, rate, spin)
    return rate.move(hub) + jnp.cross(turning, radius * down(frame.rotation))


def about_x(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Compute the rotation by `angle` about the first axis."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def about_y(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Compute the rotation by `angle` about the second axis."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)


def about_z(angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Compute the rotation by `angle` about the third axis."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)


def about_axis(axis: Float[Array, "3"], angle: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Compute the rotation about a unit vector; exactly the identity for angle 0."""
    x, y, z = axis
    zero = jnp.zeros_like(x)
    skew = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    turn = jnp.sin(angle) * skew + (1 - jnp.cos(angle)) * (skew @ skew)
    return jnp.eye(3, dtype=axis.dtype) + turn
