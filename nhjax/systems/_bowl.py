"""The surface on which the centre of a ball in a bowl moves."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._base import require_possible


Shape = Literal["paraboloid", "sphere"]
Vector3 = Float[Array, "3"]


class Bowl(eqx.Module):
    """A paraboloid or a sphere of revolution, with its lowest point at the origin.

    Φ = z - κ/2 (x² + y² + ε z²) with the curvature κ at the lowest point, and ε = 0 for
    the paraboloid, 1 for the sphere.
    """

    curvature: Array
    shape: Shape = eqx.field(static=True)

    def value(self, x: Vector3) -> Array:
        """Compute the function Φ that vanishes on the bowl, at a point."""
        round_part = x if self.shape == "sphere" else x[:2]
        return x[2] - 0.5 * self.curvature * (round_part @ round_part)

    def slope(self, x: Vector3) -> Vector3:
        """Compute the gradient ∇Φ at a point."""
        inward = -self.curvature * x
        if self.shape == "paraboloid":
            inward = inward.at[2].set(0.0)
        return inward.at[2].add(1.0)

    def normal(self, x: Vector3) -> Vector3:
        """Compute the normal ∇Φ/|∇Φ| at a point, which points into the bowl."""
        slope = self.slope(x)
        return slope / jnp.sqrt(slope @ slope)

    def height(self, square: Array) -> Array:
        """Compute z where Φ = 0 and x² + y² = `square`, in the lower half."""
        if self.shape == "paraboloid":
            return 0.5 * self.curvature * square
        root = 1 - self.curvature**2 * square
        require_possible(
            root > 0,
            "`position` must be nearer to the axis than the radius "
            f"{1 / self.curvature} of the sphere, got {jnp.sqrt(square)}.",
        )
        return self.curvature * square / (1 + jnp.sqrt(root))
