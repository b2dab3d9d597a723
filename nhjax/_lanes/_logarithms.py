"""The logarithm and what is made of it, for vectors of float64.

With x = 2^k m and m from sqrt(1/2) to sqrt(2), log(x) is k log(2) + log(m), and log(m)
is 2 artanh(s) with s = (m - 1) / (m + 1).
"""

import math

from ._body import Value, where
from ._coefficients import LOG
from ._exponentials import LN2_HIGH, LN2_LOW
from ._intrinsics import absolute, with_sign
from ._pairs import (
    fast_two_sum,
    ONE_BITS,
    polynomial,
    product,
    quotient,
    root,
    two_product,
    two_sum,
)


_SMALLEST_NORMAL = 2.0**-1022
_ROOT_HALF_BITS = 0x3FE6A09E667F3BCD
_MANTISSA_BITS = 0x000FFFFFFFFFFFFF
_TWO_52_BITS = 0x4330000000000000


def parts(x: Value) -> tuple[Value, Value]:
    """Return k and m with x = 2^k m, for positive and finite x."""
    is_small = x < _SMALLEST_NORMAL
    bits = where(is_small, x * 2.0**54, x).bits() + (ONE_BITS - _ROOT_HALF_BITS)
    m = ((bits & _MANTISSA_BITS) + _ROOT_HALF_BITS).number()
    # The integer k + 1023, put into the lowest bits of 2^52, is added to it.
    k = ((bits >> 52) | _TWO_52_BITS).number()
    return k - where(is_small, 2.0**52 + 1023 + 54, 2.0**52 + 1023), m


def _sum(k: Value, f: Value, correction: Value | float) -> Value:
    """Return k log(2) + log(1 + f) + correction, where 1 + f is m."""
    s = f / (2.0 + f)
    z, half = s * s, 0.5 * f * f
    small = s * (half + z * polynomial(z, LOG)) + (k * LN2_LOW + correction)
    return k * LN2_HIGH - ((half - small) - f)


def log(x: Value) -> Value:
    """Return the logarithm of x."""
    k, m = parts(x)
    result = _sum(k, m - 1.0, 0.0)
    result = where(x.equals(0.0), -math.inf, where(x < 0.0, math.nan, result))
    # This leaves NaN and infinity.
    return where(x < math.inf, result, x)


def _log1p(x: Value, low: Value | float = 0.0, doublings: Value | float = 0.0) -> Value:
    """Return log(1 + x + low) + doublings log(2), for finite x + low > -1."""
    with x.body.exact():
        high, rest = two_sum(x.body.constant("double", 1.0), x)
        rest = rest + low
    k, m = parts(high)
    is_near = k.equals(0.0)
    # In 1 + x the last digits of a small x are lost.
    f = where(is_near, x, m - 1.0)
    lost = where(is_near, low, rest) / high
    return _sum(k + doublings, f, lost)


def log1p(x: Value) -> Value:
    """Return log(1 + x)."""
    result = with_sign(_log1p(x), x)
    result = where(x > -1.0, result, where(x.equals(-1.0), -math.inf, math.nan))
    return where(x < math.inf, result, x)


def asinh(x: Value) -> Value:
    """Return the inverse hyperbolic sine, log(1 + (x + sqrt(1 + x^2) - 1)), x > 0."""
    size = absolute(x)
    is_large = size > 2.0**100
    square, error = two_product(size, size)
    more, lost = two_sum(x.body.constant("double", 1.0), square)
    length, rest = root(fast_two_sum(more, lost + error))
    length, error = two_sum(length, x.body.constant("double", -1.0))
    total, lost = two_sum(size, length)
    result = _log1p(
        where(is_large, size, total),
        where(is_large, 0.0, lost + (error + rest)),
        where(is_large, 1.0, 0.0),
    )
    return with_sign(where(size < math.inf, result, x), x)


def acosh(x: Value) -> Value:
    """Return the inverse hyperbolic cosine, log(1 + (x - 1 + sqrt(x^2 - 1)))."""
    is_large = x > 2.0**100
    less = two_sum(x, x.body.constant("double", -1.0))
    more = two_sum(x, x.body.constant("double", 1.0))
    length, rest = root(product(less, more))
    total, lost = two_sum(less[0], length)
    result = _log1p(
        where(is_large, x, total),
        where(is_large, 0.0, lost + (less[1] + rest)),
        where(is_large, 1.0, 0.0),
    )
    result = where(x > 1.0, result, where(x.equals(1.0), 0.0, math.nan))
    return where(x < math.inf, result, x)


def atanh(x: Value) -> Value:
    """Return the inverse hyperbolic tangent, log(1 + 2x / (1 - x)) / 2 for x > 0."""
    size = absolute(x)
    below = two_sum(x.body.constant("double", 1.0), -size)
    ratio, low = quotient((size * 2.0, size * 0.0), below)
    result = 0.5 * _log1p(ratio, low)
    result = where(size < 1.0, result, where(size.equals(1.0), math.inf, math.nan))
    return with_sign(result, x)
