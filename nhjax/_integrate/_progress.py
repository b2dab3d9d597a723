"""The place that a run with events has come to."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

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


class Progress(eqx.Module):
    """The place that a run with events has come to.

    Derivatives pass through `offset` alone.

    - `node`, `offset`: the time is t_k + offset with k = `node`.
    - `row`: how many rows of output are filled. It is `node` until the run ends, and
        goes on after that.
    - `active`: how many iterations have led to a node or to an event.
    - `num`, `last`: how many events there were, and which the last one was.
    - `is_cut`: whether the next step is to be cut, since there is an event in it.
    - `far`: the conditions at the end of the whole step, if so.
    - `sides`: the sides of zero of the conditions.
    - `pending`: the conditions that the last reset has carried across zero.
    """

    node: Int[Array, ""]
    offset: FloatScalar
    row: Int[Array, ""]
    active: Int[Array, ""]
    num: Int[Array, ""]
    last: Int[Array, ""]
    is_cut: Bool[Array, ""]
    far: Float[Array, " e"]
    sides: Sides
    pending: Bool[Array, " e"]


class Known(NamedTuple):
    """What a step back knows of the iteration: its event, -1 if none, and its size."""

    which: Int[Array, ""]
    size: FloatScalar
