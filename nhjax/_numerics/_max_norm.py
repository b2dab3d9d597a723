"""The sizes of arrays, which are measured by their largest number."""

from functools import reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import FloatScalar, FloatScalarLike


def max_norm(*arrays: Array) -> FloatScalar:
    """Compute max |x| over one or more arrays; NaN if a number is, 0 if all are empty.

    The maximum is taken over the bit patterns, since numbers that are not negative are
    ordered as their bit patterns are, with NaN above infinity. A maximum of floats that
    propagates NaN takes five instructions that wait for each other, one of integers
    takes two: with maxima of floats, the sizes took a third of the time of an iteration
    on the stages.
    """
    dtype = jnp.result_type(*arrays)
    bits = {2: jnp.int16, 4: jnp.int32, 8: jnp.int64}[dtype.itemsize]

    def pattern(x):
        pattern = jax.lax.bitcast_convert_type(jnp.abs(x.astype(dtype)), bits)
        return jnp.max(pattern, initial=0)

    return jax.lax.bitcast_convert_type(
        reduce(jnp.maximum, map(pattern, arrays)), dtype
    )


def unit(scale: FloatScalarLike) -> FloatScalar:
    """Return the unit in which sizes are measured: the scale, or one if it is zero."""
    return jnp.where(scale > 0, scale, 1)


def relative(size: FloatScalar, scale: FloatScalarLike) -> FloatScalar:
    """Divide a size by the scale that it is measured in, or by one if that is zero."""
    return size / unit(scale)
