"""Sine, cosine and tangent, for vectors of float64.

With n the integer nearest to x / (pi / 2), x = n pi / 2 + r and |r| <= pi / 4. Sine and
cosine are made in one function: each needs both polynomials anyhow, as the lanes differ
in n, and LLVM merges two calls with the same argument.
"""

import math

from ._body import Value, where
from ._coefficients import COS, SIN
from ._intrinsics import absolute
from ._large_arguments import FUNCTION, NAME
from ._pairs import fast_two_sum, nearest, Pair, polynomial, rounded_quotient, two_sum


_PER_HALF_PI = 0.6366197723675814
# pi / 2 in three parts, the first two of 38 bits: their products with integers of up
# to 2^15 are exact, which is how large n is for the largest argument here.
_PARTS = (1.5707963267923333, 2.5633441515839558e-12, 1.0562999066987428e-23)
_MOST = 51471.0


def _reduced(x: Value) -> tuple[Value, Pair]:
    """Return n, in the lowest bits of an integer, and r as a pair."""
    n, bits = nearest(x * _PER_HALF_PI)
    with x.body.exact():
        first, second = x - n * _PARTS[0], n * _PARTS[1]
        difference, error = two_sum(first, -second)
        small = n * _PARTS[2] - error
        high = difference - small
        low = (difference - high) - small
    size = absolute(x)
    # Infinity and NaN give NaN here already.
    is_large = (size > _MOST) & (size < math.inf)

    def otherwise() -> tuple[Value, ...]:
        x.body.needed[NAME] = FUNCTION
        return x.body.lane_by_lane(f"@{NAME}", ("i64", "double", "double"), x)

    n, high, low = x.body.with_rare_case(is_large, (bits, high, low), otherwise)
    return n, (high, low)


def _sine_and_cosine(r: Pair) -> tuple[Pair, Pair]:
    """Return sin(r) and cos(r) for |r| <= pi / 4, each as a large part and the rest."""
    high, low = r
    z = high * high
    half = 0.5 * z
    one, error = fast_two_sum(1.0, -half)
    sine = high * z * polynomial(z, SIN) + low * one
    cosine = error + (z * z * polynomial(z, COS) - high * low)
    return (high, sine), (one, cosine)


def sine_and_cosine(x: Value) -> tuple[Value, Value]:
    """Return the sine and the cosine of x."""
    n, r = _reduced(x)
    (s, s_rest), (c, c_rest) = _sine_and_cosine(r)
    s, c = s + s_rest, c + c_rest
    is_odd = (n & 1).equals(1)
    sine = where(is_odd, c, s).bits() ^ ((n & 2) << 62)
    cosine = where(is_odd, s, c).bits() ^ (((n + 1) & 2) << 62)
    # The reduction loses the sign of -0.0.
    return where(x.equals(0.0), x, sine.number()), cosine.number()


def tan(x: Value) -> Value:
    """Return the tangent of x."""
    n, r = _reduced(x)
    s, c = (fast_two_sum(*pair) for pair in _sine_and_cosine(r))
    is_odd = (n & 1).equals(1)
    above = [where(is_odd, b, a) for a, b in zip(s, c, strict=True)]
    below = [where(is_odd, a, b) for a, b in zip(s, c, strict=True)]
    ratio = rounded_quotient((above[0], above[1]), (below[0], below[1]))
    signed = (ratio.bits() ^ ((n & 1) << 63)).number()
    return where(x.equals(0.0), x, signed)
