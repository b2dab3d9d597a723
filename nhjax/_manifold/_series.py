"""Scalar functions of the rotation angle that are smooth at zero.

All of them are functions of a square, so that no square root is differentiated at zero.
"""

from functools import partial
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import FloatScalar


# Below this s the series is used. Above it the recursion is as accurate, because it
# divides its rounding errors by s.
_SWITCH = 2.0

# The first term of the series that is left out is at most 2e-18, for c_0 at the switch.
_NUM_TERMS = 11


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def stumpff(s: FloatScalar, n: int) -> Float[Array, " n"]:
    """Compute Stumpff's c_k(s) = Σ_j (-s)^j / (2j + k)! for k = 0, ..., n - 1.

    For s = θ² >= 0 these functions are c_0 = cos θ, c_1 = sin θ / θ,
    c_2 = (1 - cos θ)/θ² and c_3 = (θ - sin θ)/θ³. Their derivatives
    2 c_k' = k c_{k+2} - c_{k+1} are of the same family, so that no series and no
    quotient is ever differentiated: a derivative is as accurate as a value.
    """
    small = s < _SWITCH
    series = _horner(_coefficients(n, s.dtype), jnp.where(small, s, 0.0))
    return jnp.where(small, series, _recursion(jnp.where(small, _SWITCH, s), n))


@stumpff.defjvp
def _(n, primals, tangents):
    (s,), (ds,) = primals, tangents
    c = stumpff(s, n + 2)
    slope = 0.5 * (np.arange(n, dtype=s.dtype) * c[2:] - c[1:-1])
    return c[:n], slope * ds


def _coefficients(n, dtype):
    return [
        np.array([(-1) ** j / factorial(2 * j + k) for k in range(n)], dtype)
        for j in range(_NUM_TERMS)
    ]


def _recursion(s, n):
    """Compute c_0 and c_1 by cos and sin, the others by s c_k = 1/(k-2)! - c_{k-2}."""
    theta = jnp.sqrt(s)
    c = [jnp.cos(theta), jnp.sin(theta) / theta]
    for k in range(2, n):
        c.append((1 / factorial(k - 2) - c[k - 2]) / s)
    return jnp.stack(c[:n])


def _horner(coefficients, x):
    *lower, total = coefficients
    for c in reversed(lower):
        total = c + x * total
    return total


def arctan_ratio(x: FloatScalar) -> FloatScalar:
    """Compute arctan(√x)/√x for 0 <= x <= 1.

    Halving the angle twice leaves √x <= tan(π/16), where one short series serves for
    all x. So there is no branch, and derivatives of any order exist.
    """
    scale = 1.0
    for _ in range(2):
        half = 1 + jnp.sqrt(1 + x)
        scale = scale * 2 / half
        x = x / half**2
    return scale * _horner([(-1) ** j / (2 * j + 1) for j in range(15)], x)
