"""Sine, cosine and tangent, and their inverses, for vectors of float64.

With n the integer nearest to x / (pi / 2), x = n pi / 2 + r and |r| <= pi / 4. Sine and
cosine are computed by one function. Each needs both polynomials anyway, because n
differs between the members of a vector. LLVM merges two calls with the same argument.

Large arguments are reduced by the method of Payne and Hanek. The number x = m 2^e, with
an integer m of 53 bits, is multiplied by 2 / pi. The binary digits of 2 / pi that add
multiples of 4 to the product are left out, and the next 192 digits are used. With 192
digits, r is accurate even for the float64 that is nearest to a multiple of pi / 2.
"""

import math
from typing import NamedTuple

from ._coefficients import ASIN, ATAN, COS, SIN
from ._writer import (
    absolute,
    DoubleDouble,
    fast_two_sum,
    nearest,
    polynomial,
    rounded_quotient,
    square_root,
    two_sum,
    Value,
    where,
    with_sign,
    Writer,
)


# The binary digits of 2 / pi after the point, 64 in a word, after a word of zeros.
_WORDS = """
    0000000000000000 a2f9836e4e441529 fc2757d1f534ddc0 db6295993c439041
    fe5163abdebbc561 b7246e3a424dd2e0 06492eea09d1921c fe1deb1cb129a73e
    e88235f52ebb4484 e99c7026b45f7e41 3991d639835339f4 9c845f8bbdf9283b
    1ff897ffde05980f ef2f118b5a0a6d1f 6d367ecf27cb09b7 4f463f669e5fea2d
    7527bac7ebe5f17b 3d0739f78a5292ea 6bfb5fb11f8d5d08 56033046fc7b6bab
""".split()  # noqa: SIM905
_DIGITS = "nhjax.two_over_pi"
# pi / 2 in units of 2^-63.
_HALF_PI_BITS = 14488038916154245684
_LOWEST_BITS = (1 << 11) - 1
_REDUCED_LARGE = "nhjax.reduced_large"


def _window(exponent: Value) -> list[Value]:
    """Load the 192 digits of 2 / pi that matter for an x with this biased exponent."""
    writer = exponent.writer
    # With e = exponent - 1075, digit i adds a multiple of 2^(e - i) to the product of x
    # and 2 / pi. The product matters only modulo 4, so the digits with 2^(e - i) >= 4
    # are left out.
    skipped = where(exponent < 1013, 0, exponent - 1013)
    word, shift = skipped >> 6, skipped & 63
    words = []
    for k in range(4):
        index = (word + k).name
        array = f"[{len(_WORDS)} x i64]"
        address = writer.compute(
            "ptr", f"getelementptr {array}, ptr @{_DIGITS}, i64 0, i64 {index}"
        )
        words.append(writer.compute("i64", f"load i64, ptr {address.name}"))
    return [
        writer.call("@llvm.fshl.i64", ("i64",), words[k], words[k + 1], shift)[0]
        for k in range(3)
    ]


def _reduction_of_large() -> str:
    """Return the definition of a function of x that returns n and the double-double r.

    x equals n pi / 2 + r up to a multiple of 2 pi.
    """
    writer = Writer(1)
    bits = Value(writer, "double", "%x").bits()
    mantissa = (bits & ((1 << 52) - 1)) | (1 << 52)
    digits = _window((bits >> 52) & 0x7FF)
    long = mantissa.cast("zext", "i128")
    # The product modulo 4, in units of 2^-126.
    total = (mantissa * digits[0]).cast("zext", "i128") << 64
    total = total + long * digits[1].cast("zext", "i128")
    total = total + ((long * digits[2].cast("zext", "i128")) >> 64)
    n = (total + (1 << 125)) >> 126
    rest = total - (n << 126)
    is_negative = rest < 0
    size = where(is_negative, -rest, rest)
    text = f"call i128 @llvm.ctlz.i128(i128 {size.name}, i1 false)"
    zeros = writer.compute("i128", text).cast("trunc", "i64")
    # The first 64 bits of the fraction, times pi / 2, in units of 2^-(125 + zeros).
    leading = (size << zeros.cast("zext", "i128")) >> 64
    angle = leading * _HALF_PI_BITS
    upper, lower = (angle >> 64).cast("trunc", "i64"), angle.cast("trunc", "i64")
    scale = ((1023 - 125 + 64 - zeros) << 52).number()
    high = (upper & ~_LOWEST_BITS).cast("uitofp", "double") * scale
    low = ((upper & _LOWEST_BITS) << 53) | (lower >> 11)
    low = low.cast("uitofp", "double") * 2.0**-53 * scale
    # The sign of the remainder is the product of two signs: the sign of x, and a minus
    # if |n| pi / 2 is larger than |x|.
    is_left = bits < 0
    sign = where(is_negative, -(2**63), 0) ^ (bits & -(2**63))
    quadrant = n.cast("trunc", "i64")
    writer.result(
        where(is_left, -quadrant, quadrant),
        (high.bits() ^ sign).number(),
        (low.bits() ^ sign).number(),
    )
    words = ", ".join(f"i64 u0x{word}" for word in _WORDS)
    table = f"@{_DIGITS} = private constant [{len(_WORDS)} x i64] [{words}]\n"
    head = (
        f"define internal {{ i64, double, double }} @{_REDUCED_LARGE}(double %x) "
        "cold noinline nounwind willreturn memory(none)"
    )
    return f"{table}{writer.definition(head)}\n"


_REDUCED_LARGE_DEFINITION = _reduction_of_large()


_PER_HALF_PI = 0.6366197723675814
# pi / 2 in three parts. The first two have 38 bits: their products with integers up to
# 2^15 are exact, and |n| <= 2^15 up to the argument _LARGEST_DIRECT.
_HALF_PI_PARTS = (1.5707963267923333, 2.5633441515839558e-12, 1.0562999066987428e-23)
_LARGEST_DIRECT = 51471.0


def _reduce(x: Value) -> tuple[Value, DoubleDouble]:
    """Return n, in the lowest bits of an integer, and r as a double-double."""
    n, bits = nearest(x * _PER_HALF_PI)
    with x.writer.exact():
        first, second = x - n * _HALF_PI_PARTS[0], n * _HALF_PI_PARTS[1]
        difference, error = two_sum(first, -second)
        small = n * _HALF_PI_PARTS[2] - error
        high = difference - small
        low = (difference - high) - small
    size = absolute(x)
    # For infinite x and NaN, the formulas above already give NaN.
    is_large = (size > _LARGEST_DIRECT) & (size < math.inf)

    def otherwise() -> tuple[Value, ...]:
        x.writer.helpers[_REDUCED_LARGE] = _REDUCED_LARGE_DEFINITION
        return x.writer.call_for_each_member(
            f"@{_REDUCED_LARGE}", ("i64", "double", "double"), x
        )

    n, high, low = x.writer.with_rare_case(is_large, (bits, high, low), otherwise)
    return n, (high, low)


def _sine_and_cosine(r: DoubleDouble) -> tuple[DoubleDouble, DoubleDouble]:
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
    n, r = _reduce(x)
    (s, s_rest), (c, c_rest) = _sine_and_cosine(r)
    s, c = s + s_rest, c + c_rest
    is_odd = (n & 1).equals(1)
    sine = where(is_odd, c, s).bits() ^ ((n & 2) << 62)
    cosine = where(is_odd, s, c).bits() ^ (((n + 1) & 2) << 62)
    # The reduction loses the sign of -0.0, so the sine of a zero is the zero itself.
    return where(x.equals(0.0), x, sine.number()), cosine.number()


def tan(x: Value) -> Value:
    """Return the tangent of x."""
    n, r = _reduce(x)
    s, c = (fast_two_sum(*pair) for pair in _sine_and_cosine(r))
    is_odd = (n & 1).equals(1)
    above = [where(is_odd, b, a) for a, b in zip(s, c, strict=True)]
    below = [where(is_odd, a, b) for a, b in zip(s, c, strict=True)]
    ratio = rounded_quotient((above[0], above[1]), (below[0], below[1]))
    signed = (ratio.bits() ^ ((n & 1) << 63)).number()
    return where(x.equals(0.0), x, signed)


_HALF_PI, _HALF_PI_LOW = math.pi / 2, 6.123233995736766e-17
# Multiples of pi / 4: the nearest float64, and the remainder.
_QUARTERS = {
    0: (0.0, 0.0),
    1: (math.pi / 4, _HALF_PI_LOW / 2),
    2: (_HALF_PI, _HALF_PI_LOW),
    3: (2.356194490192345, 9.184850993605148e-17),
    4: (math.pi, 2 * _HALF_PI_LOW),
}


class _Angle(NamedTuple):
    """The angle arctan(a / b): a multiple of pi / 4 plus arctan(t), |t| <= 1/2."""

    is_low: Value
    is_high: Value
    t: Value
    # arctan(t) - t.
    rest: Value

    def after(self, low: int, middle: int, high: int, sign: float) -> Value:
        """Return k pi / 4 +- arctan(t), with k selected by the range of the angle."""
        multiples = zip(*(_QUARTERS[i] for i in (low, middle, high)), strict=True)
        first, second = (
            where(self.is_low, x, where(self.is_high, z, y)) for x, y, z in multiples
        )
        total, error = fast_two_sum(first, sign * self.t)
        return total + (error + (sign * self.rest + second))


def _angle(a: Value, b: Value) -> _Angle:
    """Return arctan(a / b) for a, b >= 0.

    For a / b from 1/2 to 2 the angle is pi / 4 + arctan((a - b) / (a + b)). For larger
    a / b it is pi / 2 - arctan(b / a).
    """
    is_low, is_high = a + a < b, b + b < a
    above = where(is_low, a, where(is_high, -b, a - b))
    below = where(is_low, b, where(is_high, a, a + b))
    t = above / below
    z = t * t
    return _Angle(is_low, is_high, t, t * z * polynomial(z, ATAN))


def atan(x: Value) -> Value:
    """Return the inverse tangent of x."""
    angle = _angle(absolute(x), x.writer.constant("double", 1.0))
    return with_sign(angle.after(0, 1, 2, 1.0), x)


def atan2(y: Value, x: Value) -> Value:
    """Return the angle between the first axis and the direction to the point (x, y)."""
    a, b = absolute(y), absolute(x)
    # If both a and b are infinite, they are replaced by 1. If both are 0, b is replaced
    # by 1, so that the angle is 0 or pi.
    are_infinite = a.equals(math.inf) & b.equals(math.inf)
    a, b = where(are_infinite, 1.0, a), where(are_infinite, 1.0, b)
    scale = where((a > 2.0**1000) | (b > 2.0**1000), 0.25, 1.0)
    are_zero = a.equals(0.0) & b.equals(0.0)
    angle = _angle(a * scale, where(are_zero, 1.0, b * scale))
    right, left = angle.after(0, 1, 2, 1.0), angle.after(4, 3, 2, -1.0)
    # The sign bit distinguishes -0.0 from 0.0.
    return with_sign(where(x.bits() < 0, left, right), y)


def _half_angle(x: Value) -> tuple[Value, Value, Value]:
    """Return whether |x| > 1/2, t, and arcsin(t) - t.

    If |x| > 1/2, t = sqrt((1 - |x|) / 2), so that arcsin|x| = pi / 2 - 2 arcsin(t).
    Otherwise t = |x|.
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
