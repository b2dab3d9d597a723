"""The sizes of arrays: their largest number, and relative to another size."""

from functools import reduce

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._custom_types import FloatScalar, FloatScalarLike


def max_norm(*arrays: Array) -> FloatScalar:
    """max |x| over one or more arrays; NaN if any number is, 0 if all are empty.

    Numbers that are not negative are ordered as their bit patterns are, with NaN above
    infinity. A maximum of floats that hands on NaN is five instructions that wait for
    each other, one of integers is two: as floats, sizes took a third of the time of an
    iteration on the stages.
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
    """What sizes are measured in: the scale, or one where it is zero."""
    return jnp.where(scale > 0, scale, 1)


def relative(size: FloatScalar, scale: FloatScalarLike) -> FloatScalar:
    """A size over what it is measured in."""
    return size / unit(scale)
