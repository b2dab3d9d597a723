"""Sums that carry their rounding errors along, as pairs of floating-point numbers."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics import two_sum


class Pair(NamedTuple):
    """An unevaluated sum `high + low`, with |low| at most half an ulp of `high`."""

    high: Float[Array, "*n"]
    low: Float[Array, "*n"]


def pair(x: Float[Array, "*n"]) -> Pair:
    """Make the pair of a number."""
    return Pair(x, jnp.zeros_like(x))


def plus(a: Pair, b: Pair) -> Pair:
    """Add two pairs, with a relative error of some 2^-104 in float64.

    Knuth's TwoSum of both parts (Hida, Li, Bailey, 2001, *Algorithms for
    quad-double precision floating point arithmetic*). Infinite numbers add as they do
    in IEEE arithmetic: their errors, which are not numbers, count as zero.
    """
    high, low = two_sum(a.high, b.high)
    tail, rest = two_sum(a.low, b.low)
    low = jnp.where(jnp.isfinite(low), low, jnp.zeros_like(low))
    high, low = _normalised(high, low + tail)
    return Pair(*_normalised(high, low + rest))


def _normalised(
    high: Float[Array, "*n"], low: Float[Array, "*n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    total = high + low
    error = low - (total - high)
    return total, jnp.where(jnp.isfinite(error), error, jnp.zeros_like(error))


def value(a: Pair) -> Float[Array, "*n"]:
    """Round a pair to one number."""
    return a.high + a.low
