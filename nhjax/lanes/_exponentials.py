"""Exponentials, hyperbolic functions, logarithms, powers and the error function.

All formulas are for vectors of float64. With n the integer nearest to x / log(2),
exp(x) is 2^n exp(r) with r = x - n log(2) and |r| <= log(2) / 2. With x = 2^k m and m
from sqrt(1/2) to sqrt(2), log(x) is k log(2) + log(m), and log(m) is 2 artanh(s) with
s = (m - 1) / (m + 1). Polynomials approximate exp(r) and artanh(s).
"""

import math

from ._coefficients import CBRT, COSH, ERF, ERFC, EXP, LOG, LOG_LONG, SINH
from ._writer import (
    absolute,
    DoubleDouble,
    fast_two_sum,
    halves,
    leading_bits,
    nearest,
    ONE_BITS,
    polynomial,
    power_of_two,
    product,
    quotient,
    root,
    rounded_quotient,
    times_power_of_two,
    two_product,
    two_sum,
    Value,
    where,
    with_sign,
)


_PER_LN2 = 1.4426950408889634
# The high part of log(2) has 42 bits: its products with integers up to 2^11 are exact.
LN2_HIGH = 0.6931471805598903
LN2_LOW = 5.497923018708371e-14
_LN2 = 0.6931471805599453
# Outside of these bounds the exponential function is 0 or infinite.
LOWEST, HIGHEST = -746.0, 710.0


def clamp(x: Value, lower: float, upper: float) -> Value:
    """Clamp x to an interval; NaN stays NaN."""
    return where(x < lower, lower, where(x > upper, upper, x))


def reduce_by_log2(x: Value, low: Value | float = 0.0) -> tuple[Value, DoubleDouble]:
    """Return n, in the lowest bits of an integer, and r with x + low = n log(2) + r."""
    n, exponent = nearest(x * _PER_LN2)
    with x.writer.exact():
        high, small = x - n * LN2_HIGH, n * LN2_LOW
        if isinstance(low, Value):
            small = small - low
        r = high - small
        return exponent, (r, (high - r) - small)


def exp_of_pair(x: Value, low: Value) -> tuple[Value, Value]:
    """Return p, and n in the lowest bits of an integer, with exp(x + low) = p 2^n."""
    exponent, (r, rest) = reduce_by_log2(x, low)
    return 1.0 + (r + (r * r * polynomial(r, EXP) + rest)), exponent


def exp(x: Value) -> Value:
    """Return the exponential function of x."""
    x = clamp(x, LOWEST, HIGHEST)
    n, exponent = nearest(x * _PER_LN2)
    with x.writer.exact():
        r = (x - n * LN2_HIGH) - n * LN2_LOW
    return times_power_of_two(1.0 + (r + r * r * polynomial(r, EXP)), exponent)


def exp2(x: Value) -> Value:
    """Return 2 to the power of x."""
    x = clamp(x, -1080.0, 1025.0)
    n, exponent = nearest(x)
    r = (x - n) * _LN2
    return times_power_of_two(1.0 + (r + r * r * polynomial(r, EXP)), exponent)


def _expm1_parts(x: Value) -> tuple[Value, DoubleDouble, Value]:
    """Return n, m and 2^-n with exp(x) - 1 = 2^n m, for x >= -50.

    m is a double-double.
    """
    exponent, (r, rest) = reduce_by_log2(x)
    # For the largest x, 2^-n would be subnormal. It is replaced by 0 for x > 100, where
    # it does not change the result.
    unit = where(x > 100.0, 0.0, power_of_two(-exponent))
    high, low = fast_two_sum(1.0 - unit, r)
    tail = low + (r * r * polynomial(r, EXP) + rest)
    return exponent, fast_two_sum(high, tail), unit


def expm1(x: Value) -> Value:
    """Return exp(x) - 1."""
    exponent, (mantissa, _), _ = _expm1_parts(clamp(x, -50.0, HIGHEST))
    return with_sign(times_power_of_two(mantissa, exponent), x)


def tanh(x: Value) -> Value:
    """Return the hyperbolic tangent of x, as (exp(2x) - 1) / (exp(2x) + 1)."""
    double = absolute(x) * 2.0
    _, above, unit = _expm1_parts(where(double > 44.0, 44.0, double))
    # `above` is (exp(2x) - 1) / 2^n. Adding 2^(1 - n) gives (exp(2x) + 1) / 2^n.
    high, low = two_sum(above[0], unit * 2.0)
    return with_sign(rounded_quotient(above, (high, low + above[1])), x)


def logistic(x: Value) -> Value:
    """Return 1 / (1 + exp(-x))."""
    # With z = exp(-|x|) the result is 1 / (1 + z), or z / (1 + z) if x is negative.
    size = -absolute(x)
    size = where(size < LOWEST, LOWEST, size)
    exponent, (r, rest) = reduce_by_log2(size)
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

    With |x| = n log(2) + r, s = sinh(r), c = cosh(r) and u = 2^-2n, sinh(|x|) is
    2^(n - 1) ((1 - u) c + (1 + u) s). The formula of cosh(x) has -u in place of u.
    """
    x = absolute(x)
    exponent, (r, rest) = reduce_by_log2(where(x > 711.0, 711.0, x))
    u = where(x > 60.0, 0.0, power_of_two(-(exponent + exponent)))
    u = u if odd else -u
    z = r * r
    c, s = z * polynomial(z, COSH), r * z * polynomial(z, SINH) + rest
    high, low = fast_two_sum(1.0 - u, r)
    # `high` contains r without a factor, so that sinh(r) = r for small r.
    tail = u * r + (low + ((1.0 - u) * c + (1.0 + u) * s))
    return times_power_of_two(high + tail, exponent - 1)


def sinh(x: Value) -> Value:
    """Return the hyperbolic sine of x."""
    return with_sign(_hyperbolic(x, odd=True), x)


def cosh(x: Value) -> Value:
    """Return the hyperbolic cosine of x."""
    return _hyperbolic(x, odd=False)


_SMALLEST_NORMAL = 2.0**-1022
_ROOT_HALF_BITS = 0x3FE6A09E667F3BCD
_MANTISSA_BITS = 0x000FFFFFFFFFFFFF
_TWO_52_BITS = 0x4330000000000000


def exponent_and_mantissa(x: Value) -> tuple[Value, Value]:
    """Return k and m with x = 2^k m, m from sqrt(1/2) to sqrt(2), for finite x > 0."""
    is_small = x < _SMALLEST_NORMAL
    bits = where(is_small, x * 2.0**54, x).bits() + (ONE_BITS - _ROOT_HALF_BITS)
    m = ((bits & _MANTISSA_BITS) + _ROOT_HALF_BITS).number()
    # With the integer k + 1023 in its lowest bits, 2^52 becomes 2^52 + k + 1023.
    k = ((bits >> 52) | _TWO_52_BITS).number()
    return k - where(is_small, 2.0**52 + 1023 + 54, 2.0**52 + 1023), m


def _log_of(k: Value, f: Value, correction: Value | float) -> Value:
    """Return k log(2) + log(1 + f) + correction, with sqrt(1/2) < 1 + f < sqrt(2)."""
    s = f / (2.0 + f)
    z, half = s * s, 0.5 * f * f
    small = s * (half + z * polynomial(z, LOG)) + (k * LN2_LOW + correction)
    return k * LN2_HIGH - ((half - small) - f)


def log(x: Value) -> Value:
    """Return the logarithm of x."""
    k, m = exponent_and_mantissa(x)
    result = _log_of(k, m - 1.0, 0.0)
    result = where(x.equals(0.0), -math.inf, where(x < 0.0, math.nan, result))
    # NaN and infinity are returned unchanged.
    return where(x < math.inf, result, x)


def _log1p(x: Value, low: Value | float = 0.0, doublings: Value | float = 0.0) -> Value:
    """Return log(1 + x + low) + doublings log(2), for finite x + low > -1."""
    with x.writer.exact():
        high, rest = two_sum(x.writer.constant("double", 1.0), x)
        rest = rest + low
    k, m = exponent_and_mantissa(high)
    is_near = k.equals(0.0)
    # 1 + x loses the last digits of a small x, so x itself is used where k = 0.
    f = where(is_near, x, m - 1.0)
    lost = where(is_near, low, rest) / high
    return _log_of(k + doublings, f, lost)


def log1p(x: Value) -> Value:
    """Return log(1 + x)."""
    result = with_sign(_log1p(x), x)
    result = where(x > -1.0, result, where(x.equals(-1.0), -math.inf, math.nan))
    return where(x < math.inf, result, x)


def asinh(x: Value) -> Value:
    """Return the inverse hyperbolic sine of x.

    For x > 0 it is log(1 + (x + sqrt(1 + x^2) - 1)).
    """
    size = absolute(x)
    is_large = size > 2.0**100
    square, error = two_product(size, size)
    more, lost = two_sum(x.writer.constant("double", 1.0), square)
    length, rest = root(fast_two_sum(more, lost + error))
    length, error = two_sum(length, x.writer.constant("double", -1.0))
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
    less = two_sum(x, x.writer.constant("double", -1.0))
    more = two_sum(x, x.writer.constant("double", 1.0))
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
    below = two_sum(x.writer.constant("double", 1.0), -size)
    ratio, low = quotient((size * 2.0, size * 0.0), below)
    result = 0.5 * _log1p(ratio, low)
    result = where(size < 1.0, result, where(size.equals(1.0), math.inf, math.nan))
    return with_sign(result, x)


_THIRD = 1.0 / 3.0
_SIGN_BIT = -(2**63)


def _long_log(x: Value) -> DoubleDouble:
    """Return the logarithm of a positive x, to about 66 bits.

    The high part has 26 bits or fewer.
    """
    k, m = exponent_and_mantissa(x)
    f = m - 1.0
    d = 2.0 + f
    ratio = f / d
    with x.writer.exact():
        # s = f / d is a + rest / d; the products of the short number a are exact.
        a, (f1, f2) = leading_bits(ratio, 24), halves(f)
        rest = ((f - 2.0 * a) - a * f1) - a * f2
        # artanh(a) is a + a z (1/3 + z (...)); a third of z is c plus a remainder.
        z = a * a
        c = leading_bits(z * _THIRD, 24)
        left = (z - 3.0 * c) * _THIRD
        high, low = fast_two_sum(a, a * c)
    more = a * (left + z * z * polynomial(z, LOG_LONG))
    # artanh(s) - artanh(a) is artanh((s - a) / (1 - s a)), nearly its small argument.
    more = low + (more + rest / (d - d * (a * ratio)))
    total, lost = fast_two_sum(k * LN2_HIGH, high * 2.0)
    low = lost + (k * LN2_LOW + more * 2.0)
    with x.writer.exact():
        first = leading_bits(total + low, 26)
        return first, (total - first) + low


def _is_integer(x: Value) -> Value:
    """Return for which members x >= 0 is an integer; infinity counts as an integer."""
    with x.writer.exact():
        return (((x + 2.0**52) - 2.0**52).equals(x)) | (x >= 2.0**52)


def pow(x: Value, y: Value) -> Value:
    """Return x to the power of y: exp(y log|x|), with the sign of x^y."""
    size = absolute(x)
    high, low = _long_log(size)
    # Set the logarithms of 0, infinity and NaN, for which `_long_log` is not valid.
    is_finite, is_zero = size < math.inf, size.equals(0.0)
    high = where(is_zero, -math.inf, where(is_finite, high, size))
    low = where(is_finite & (size > 0.0), low, 0.0)
    power, y1 = y * high, leading_bits(y, 26)
    # If the result overflows, underflows or is NaN, y log|x| needs no low part.
    is_moderate = absolute(power) < 750.0
    power = where(is_moderate, y1 * high, power)
    rest = where(is_moderate, (y - y1) * high + y * low, 0.0)
    mantissa, exponent = exp_of_pair(clamp(power, LOWEST, HIGHEST), rest)
    result = times_power_of_two(mantissa, exponent)
    is_one = y.equals(0.0) | (size.equals(1.0) & absolute(y).equals(math.inf))
    result = where(is_one | x.equals(1.0), 1.0, result)
    is_whole = _is_integer(absolute(y))
    is_odd = is_whole & ~_is_integer(absolute(y) * 0.5)
    # The sign bit is used, so that odd powers of -0.0 are negative.
    flips = where(is_odd, x.bits() & _SIGN_BIT, 0)
    result = (result.bits() ^ flips).number()
    has_no_value = (x < 0.0) & is_finite & ~is_whole
    return where(has_no_value, math.nan, result)


def cbrt(x: Value) -> Value:
    """Return the cube root of x."""
    size = absolute(x)
    k, m = exponent_and_mantissa(size)
    # |x| = 2^(3q) w with w from 2^(-3/2) to 2^(3/2).
    q, exponent = nearest(k * (1.0 / 3.0))
    left = k - 3.0 * q
    w = where(left > 0.0, m * 2.0, where(left < 0.0, m * 0.5, m))
    factor = where(left > 0.0, 2.0 ** (1 / 3), where(left < 0.0, 2.0 ** (-1 / 3), 1.0))
    is_low = m < 1.0
    guess = polynomial(where(is_low, m * 2.0, m), CBRT)
    guess = guess * where(is_low, factor * 2.0 ** (-1 / 3), factor)
    # The cube of a number of 17 bits is exact, and so is its difference from w.
    guess = leading_bits(guess, 17)
    cube = guess * guess * guess
    d = (w - cube) / cube
    # The cube root of 1 + d, minus 1.
    more = d * (1 / 3 - d * (1 / 9 - d * (5 / 81)))
    root = times_power_of_two(guess + guess * more, exponent)
    return with_sign(where((size < math.inf) & (size > 0.0), root, size), x)


# For large arguments, the variable of the polynomial is 1 / (x + 2) - _CENTRE.
_CENTRE = 0.229
_TWO_OVER_ROOT_PI = 1.1283791670955126
_ITS_REST = 1.533545961316588e-17


def erf(x: Value) -> Value:
    """Return the error function of x."""
    size = absolute(x)
    z = size * size
    near = size * _TWO_OVER_ROOT_PI + size * (polynomial(z, ERF) + _ITS_REST)
    # For x >= 6, erf(x) is 1 to the last digit.
    size = where(size > 6.0, 6.0, size)
    beyond = polynomial(1.0 / (size + 2.0) - _CENTRE, ERFC) * exp(-(size * size))
    return with_sign(where(z < 1.0, near, 1.0 - beyond), x)
