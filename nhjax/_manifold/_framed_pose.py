"""Poses of the plane together with the sine and cosine of their angle."""

import equinox as eqx
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from ._plane import turn


class FramedPose(eqx.Module):
    """A pose (x, y, θ) with cos θ and sin θ, which tell the frame of the body.

    In the place of a pose it saves trigonometric functions: from the frame at one pose
    that at another follows by products, since the retraction gives the sine and cosine
    of the angle between them.
    """

    pose: Float[Array, "3"]
    cos: FloatScalar
    sin: FloatScalar

    def rotate(self, v: Float[Array, "2"]) -> Float[Array, "2"]:
        """Turn a vector from the frame of the body to that of the plane."""
        return self.cos * v + self.sin * turn(v)
