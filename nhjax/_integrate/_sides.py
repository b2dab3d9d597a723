"""The side of zero on which the conditions of events are where a step starts."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import BoolScalar, FloatScalar


class Sides(eqx.Module):
    """The side of zero on which each condition is where a step starts.

    - `sign`: its sign there, 0 if it is not known.
    - `value`: its value, or its rate along the run where `at_zero`: there the condition
        is zero and takes the sign of its rate.
    """

    sign: Float[Array, " e"]
    value: Float[Array, " e"]
    at_zero: Bool[Array, " e"]

    def moved(self, at_node: BoolScalar, values: Float[Array, " e"]) -> "Sides":
        """Return the sides at the end of a whole step if it leads to a node."""
        sign = jnp.where(values == 0, self.sign, jnp.sign(values))
        return Sides(
            sign=jnp.where(at_node, sign, self.sign),
            value=jnp.where(at_node, values, self.value),
            at_zero=self.at_zero & ~at_node,
        )

    def scale(self, h: FloatScalar) -> Float[Array, " e"]:
        """Compute the size of each condition in a step of size h from here."""
        value = jnp.where(self.at_zero, self.value * h, self.value)
        return jax.lax.stop_gradient(jnp.abs(value))
