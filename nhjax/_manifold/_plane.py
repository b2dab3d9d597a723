import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


# 2π is math.tau plus this, to 32 digits.
_TAU_REST = 2.4492935982947064e-16


def turn(v: Float[Array, "2 ..."]) -> Float[Array, "2 ..."]:
    """Compute J v, a vector of the plane (or the columns of a matrix) turned by π/2."""
    return jnp.concatenate([-v[1:], v[:1]])


def rotate(angle: Float[Array, ""], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """Turn a vector v of the plane by an angle."""
    return jnp.cos(angle) * v + jnp.sin(angle) * turn(v)


def wrapped_angle(
    angle: Float[Array, "1"], compensation: Float[Array, "1"]
) -> Float[Array, "1"]:
    """Compute angle + compensation - 2πk for the whole k that brings it near zero.

    It is accurate to the round-off of one turn for as many turns as half of the bits of
    a number can count: 2πk is subtracted in parts so short that k times them is exact
    (Cody and Waite, *Software Manual for the Elementary Functions*, 1980).
    """
    dtype = np.dtype(angle.dtype)
    bits = jnp.finfo(dtype).nmant + 1
    turns = jnp.round(angle * (1 / math.tau))
    for part in _parts_of_a_turn(bits - bits // 2):
        angle = angle - turns * jnp.asarray(part, dtype)
    return angle + compensation


def _parts_of_a_turn(bits: int) -> tuple[float, float, float]:
    """Split 2π into two numbers of so many bits and the rest."""
    rest, parts = math.tau, []
    for _ in range(2):
        mantissa, exponent = math.frexp(rest)
        parts.append(math.ldexp(round(math.ldexp(mantissa, bits)), exponent - bits))
        rest -= parts[-1]
    return parts[0], parts[1], rest + _TAU_REST
