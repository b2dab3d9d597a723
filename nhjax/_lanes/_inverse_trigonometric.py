"""The inverse trigonometric functions, for vectors of float64."""

import math
from typing import NamedTuple

from ._body import Value, where
from ._coefficients import ASIN, ATAN
from ._intrinsics import absolute, square_root, with_sign
from ._pairs import fast_two_sum, polynomial


_HALF_PI, _HALF_PI_LOW = math.pi / 2, 6.123233995736766e-17
# Multiples of pi / 4, each as what float64 makes of it and what that leaves.
_QUARTERS = {
    0: (0.0, 0.0),
    1: (math.pi / 4, _HALF_PI_LOW / 2),
    2: (_HALF_PI, _HALF_PI_LOW),
    3: (2.356194490192345, 9.184850993605148e-17),
    4: (math.pi, 2 * _HALF_PI_LOW),
}


class _Angle(NamedTuple):
    """The angle arctan(a / b), a multiple of pi / 4 and arctan(t), |t| <= 1/2."""

    is_low: Value
    is_high: Value
    t: Value
    # What arctan(t) is more than t.
    rest: Value

    def after(self, low: int, middle: int, high: int, sign: float) -> Value:
        """Return a multiple of pi / 4, chosen by that of the angle, +- arctan(t)."""
        multiples = zip(*(_QUARTERS[i] for i in (low, middle, high)), strict=True)
        first, second = (
            where(self.is_low, x, where(self.is_high, z, y)) for x, y, z in multiples
        )
        total, error = fast_two_sum(first, sign * self.t)
        return total + (error + (sign * self.rest + second))


def _angle(a: Value, b: Value) -> _Angle:
    """Return arctan(a / b) for a, b >= 0.

    From 1/2 to 2 the angle is pi / 4 + arctan((a - b) / (a + b)), and above that,
    pi / 2 - arctan(b / a).
    """
    is_low, is_high = a + a < b, b + b < a
    above = where(is_low, a, where(is_high, -b, a - b))
    below = where(is_low, b, where(is_high, a, a + b))
    t = above / below
    z = t * t
    return _Angle(is_low, is_high, t, t * z * polynomial(z, ATAN))


def atan(x: Value) -> Value:
    """Return the inverse tangent of x."""
    angle = _angle(absolute(x), x.body.constant("double", 1.0))
    return with_sign(angle.after(0, 1, 2, 1.0), x)


def atan2(y: Value, x: Value) -> Value:
    """Return the angle from the first axis of the point (x, y)."""
    a, b = absolute(y), absolute(x)
    # Of two infinities the angle is that of equals; that of zeros is 0 or pi.
    are_infinite = a.equals(math.inf) & b.equals(math.inf)
    a, b = where(are_infinite, 1.0, a), where(are_infinite, 1.0, b)
    scale = where((a > 2.0**1000) | (b > 2.0**1000), 0.25, 1.0)
    are_zero = a.equals(0.0) & b.equals(0.0)
    angle = _angle(a * scale, where(are_zero, 1.0, b * scale))
    right, left = angle.after(0, 1, 2, 1.0), angle.after(4, 3, 2, -1.0)
    # The sign bit tells -0.0 from 0.0.
    return with_sign(where(x.bits() < 0, left, right), y)


def _half_angle(x: Value) -> tuple[Value, Value, Value]:
    """Return whether |x| > 1/2, then t and arcsin(t) - t.

    There t = sqrt((1 - |x|) / 2), so that arcsin|x| = pi / 2 - 2 arcsin(t); else |x|.
    """
    size = absolute(x)
    is_large = size > 0.5
    z = where(is_large, (1.0 - size) * 0.5, size * size)
    t = where(is_large, square_root(z), size)
    return is_large, t, t * z * polynomial(z, ASIN)


def asin(x: Value) -> Value:
    """Return the inverse sine of x."""
    is_large, t, rest = _half_angle(x)
    high, low = fast_two_sum(_HALF_PI, t * -2.0)
    large = high + (low - (2.0 * rest - _HALF_PI_LOW))
    return with_sign(where(is_large, large, t + rest), x)


def acos(x: Value) -> Value:
    """Return the inverse cosine of x."""
    is_large, t, rest = _half_angle(x)
    is_negative = x < 0.0
    near = 2.0 * (t + rest)
    far = math.pi - (near - 2 * _HALF_PI_LOW)
    signed = with_sign(t, x), with_sign(rest, x)
    middle = _HALF_PI - (signed[0] + (signed[1] - _HALF_PI_LOW))
    return where(is_large, where(is_negative, far, near), middle)
