"""Powers and the cube root, for vectors of float64."""

import math

from ._body import Value, where
from ._coefficients import CBRT, LOG_LONG
from ._exponentials import clamped, exp_of_pair, HIGHEST, LN2_HIGH, LN2_LOW, LOWEST
from ._intrinsics import absolute, with_sign
from ._logarithms import parts
from ._pairs import (
    fast_two_sum,
    halves,
    leading_bits,
    nearest,
    Pair,
    polynomial,
    times_power_of_two,
)


_THIRD = 1.0 / 3.0
_SIGN_BIT = -(2**63)


def _long_log(x: Value) -> Pair:
    """Return the logarithm of a positive x, to some 66 bits.

    The first part has 26 bits or less, and the second is what it leaves.
    """
    k, m = parts(x)
    f = m - 1.0
    d = 2.0 + f
    ratio = f / d
    with x.body.exact():
        # s = f / d is a + rest / d, where the products of the short a are exact.
        a, (f1, f2) = leading_bits(ratio, 24), halves(f)
        rest = ((f - 2.0 * a) - a * f1) - a * f2
        # artanh(a) is a + a z (1 / 3 + z (...)), of which a third of z is c and more.
        z = a * a
        c = leading_bits(z * _THIRD, 24)
        left = (z - 3.0 * c) * _THIRD
        high, low = fast_two_sum(a, a * c)
    more = a * (left + z * z * polynomial(z, LOG_LONG))
    # The difference of artanh(s) and artanh(a) is that of an argument.
    more = low + (more + rest / (d - d * (a * ratio)))
    total, lost = fast_two_sum(k * LN2_HIGH, high * 2.0)
    low = lost + (k * LN2_LOW + more * 2.0)
    with x.body.exact():
        first = leading_bits(total + low, 26)
        return first, (total - first) + low


def _is_integer(x: Value) -> Value:
    """Tell which x >= 0 are integers; infinity counts as one."""
    with x.body.exact():
        return (((x + 2.0**52) - 2.0**52).equals(x)) | (x >= 2.0**52)


def pow(x: Value, y: Value) -> Value:
    """Return x to the power of y, as exp(y log|x|) with the sign that x^y has."""
    size = absolute(x)
    high, low = _long_log(size)
    # Beyond are 0, infinity and NaN.
    is_finite, is_zero = size < math.inf, size.equals(0.0)
    high = where(is_zero, -math.inf, where(is_finite, high, size))
    low = where(is_finite & (size > 0.0), low, 0.0)
    power, y1 = y * high, leading_bits(y, 26)
    # What overflows has no second part, and neither has NaN.
    is_moderate = absolute(power) < 750.0
    power = where(is_moderate, y1 * high, power)
    rest = where(is_moderate, (y - y1) * high + y * low, 0.0)
    mantissa, exponent = exp_of_pair(clamped(power, LOWEST, HIGHEST), rest)
    result = times_power_of_two(mantissa, exponent)
    is_one = y.equals(0.0) | (size.equals(1.0) & absolute(y).equals(math.inf))
    result = where(is_one | x.equals(1.0), 1.0, result)
    is_whole = _is_integer(absolute(y))
    is_odd = is_whole & ~_is_integer(absolute(y) * 0.5)
    # The sign bit counts, so that odd powers of -0.0 are negative.
    flips = where(is_odd, x.bits() & _SIGN_BIT, 0)
    result = (result.bits() ^ flips).number()
    has_no_value = (x < 0.0) & is_finite & ~is_whole
    return where(has_no_value, math.nan, result)


def cbrt(x: Value) -> Value:
    """Return the cube root of x."""
    size = absolute(x)
    k, m = parts(size)
    # |x| = 2^(3q) w with w from 1 / 2 to 4.
    q, exponent = nearest(k * (1.0 / 3.0))
    left = k - 3.0 * q
    w = where(left > 0.0, m * 2.0, where(left < 0.0, m * 0.5, m))
    factor = where(left > 0.0, 2.0 ** (1 / 3), where(left < 0.0, 2.0 ** (-1 / 3), 1.0))
    is_low = m < 1.0
    guess = polynomial(where(is_low, m * 2.0, m), CBRT)
    guess = guess * where(is_low, factor * 2.0 ** (-1 / 3), factor)
    # The cube of 17 bits is exact, and so is its difference to w.
    guess = leading_bits(guess, 17)
    cube = guess * guess * guess
    d = (w - cube) / cube
    # The cube root of 1 + d, less 1.
    more = d * (1 / 3 - d * (1 / 9 - d * (5 / 81)))
    root = times_power_of_two(guess + guess * more, exponent)
    return with_sign(where((size < math.inf) & (size > 0.0), root, size), x)
