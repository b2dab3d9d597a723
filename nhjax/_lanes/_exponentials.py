"""The exponential function and what is made of it, for vectors of float64.

With n the integer nearest to x / log(2), exp(x) is 2^n exp(r), |r| <= log(2) / 2.
"""

from ._body import Value, where
from ._coefficients import COSH, EXP, SINH
from ._intrinsics import absolute, with_sign
from ._pairs import (
    fast_two_sum,
    nearest,
    Pair,
    polynomial,
    power_of_two,
    rounded_quotient,
    times_power_of_two,
    two_sum,
)


_PER_LN2 = 1.4426950408889634
# The first part of log(2) has 42 bits: its products with integers up to 2^11 are exact.
LN2_HIGH = 0.6931471805598903
LN2_LOW = 5.497923018708371e-14
_LN2 = 0.6931471805599453
# Beyond these bounds the exponential function is 0 and infinite.
LOWEST, HIGHEST = -746.0, 710.0


def clamped(x: Value, lower: float, upper: float) -> Value:
    """Restrict x to an interval, but leave NaN."""
    return where(x < lower, lower, where(x > upper, upper, x))


def reduced(x: Value, low: Value | float = 0.0) -> tuple[Value, Pair]:
    """Return n, in the lowest bits of an integer, and r with x + low = n log(2) + r."""
    n, exponent = nearest(x * _PER_LN2)
    with x.body.exact():
        high, small = x - n * LN2_HIGH, n * LN2_LOW
        if isinstance(low, Value):
            small = small - low
        r = high - small
        return exponent, (r, (high - r) - small)


def exp_of_pair(x: Value, low: Value) -> tuple[Value, Value]:
    """Return p and n, in the lowest bits of an integer, with exp(x + low) = p 2^n."""
    exponent, (r, rest) = reduced(x, low)
    return 1.0 + (r + (r * r * polynomial(r, EXP) + rest)), exponent


def exp(x: Value) -> Value:
    """Return the exponential function of x."""
    x = clamped(x, LOWEST, HIGHEST)
    n, exponent = nearest(x * _PER_LN2)
    with x.body.exact():
        r = (x - n * LN2_HIGH) - n * LN2_LOW
    return times_power_of_two(1.0 + (r + r * r * polynomial(r, EXP)), exponent)


def exp2(x: Value) -> Value:
    """Return 2 to the power of x."""
    x = clamped(x, -1080.0, 1025.0)
    n, exponent = nearest(x)
    r = (x - n) * _LN2
    return times_power_of_two(1.0 + (r + r * r * polynomial(r, EXP)), exponent)


def _expm1_parts(x: Value) -> tuple[Value, Pair, Value]:
    """Return n, a pair m with exp(x) - 1 = 2^n m, and 2^-n, for x from -50."""
    exponent, (r, rest) = reduced(x)
    # 2^-n would be subnormal for the largest x, where it does not count.
    unit = where(x > 100.0, 0.0, power_of_two(-exponent))
    high, low = fast_two_sum(1.0 - unit, r)
    tail = low + (r * r * polynomial(r, EXP) + rest)
    return exponent, fast_two_sum(high, tail), unit


def expm1(x: Value) -> Value:
    """Return exp(x) - 1."""
    exponent, (mantissa, _), _ = _expm1_parts(clamped(x, -50.0, HIGHEST))
    return with_sign(times_power_of_two(mantissa, exponent), x)


def tanh(x: Value) -> Value:
    """Return the hyperbolic tangent of x, as (exp(2x) - 1) / (exp(2x) + 1)."""
    double = absolute(x) * 2.0
    _, above, unit = _expm1_parts(where(double > 44.0, 44.0, double))
    # exp(2x) - 1 was divided by 2^n, and so is the 2 by which exp(2x) + 1 is more.
    high, low = two_sum(above[0], unit * 2.0)
    return with_sign(rounded_quotient(above, (high, low + above[1])), x)


def logistic(x: Value) -> Value:
    """Return 1 / (1 + exp(-x))."""
    # With z = exp(-|x|) it is 1 / (1 + z) or z / (1 + z), for negative x.
    size = -absolute(x)
    size = where(size < LOWEST, LOWEST, size)
    exponent, (r, rest) = reduced(size)
    high, low = fast_two_sum(1.0, r)
    p = fast_two_sum(high, low + (r * r * polynomial(r, EXP) + rest))
    scale = where(size < -700.0, 0.0, power_of_two(exponent))
    below, error = fast_two_sum(1.0, p[0] * scale)
    is_negative = x < 0.0
    above = where(is_negative, p[0], 1.0), where(is_negative, p[1], 0.0)
    ratio = rounded_quotient(above, (below, error + p[1] * scale))
    return times_power_of_two(ratio, where(is_negative, exponent, 0))


def _hyperbolic(x: Value, odd: bool) -> Value:
    """Return sinh(|x|) or cosh(x).

    With s = sinh(r), c = cosh(r) and u = 2^-2n, sinh(|x|) is
    2^(n - 1) ((1 - u) c + (1 + u) s), and cosh(x) the same with -u for u.
    """
    x = absolute(x)
    exponent, (r, rest) = reduced(where(x > 711.0, 711.0, x))
    u = where(x > 60.0, 0.0, power_of_two(-(exponent + exponent)))
    u = u if odd else -u
    z = r * r
    c, s = z * polynomial(z, COSH), r * z * polynomial(z, SINH) + rest
    high, low = fast_two_sum(1.0 - u, r)
    # What r is multiplied by besides 1 stands alone, so that sinh(r) = r for small r.
    tail = u * r + (low + ((1.0 - u) * c + (1.0 + u) * s))
    return times_power_of_two(high + tail, exponent - 1)


def sinh(x: Value) -> Value:
    """Return the hyperbolic sine of x."""
    return with_sign(_hyperbolic(x, odd=True), x)


def cosh(x: Value) -> Value:
    """Return the hyperbolic cosine of x."""
    return _hyperbolic(x, odd=False)
