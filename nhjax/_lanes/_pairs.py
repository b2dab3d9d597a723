"""Formulas that the elementary functions share: polynomials, and pairs of numbers.

A pair is a number of about 106 bits, given as a sum of two of which the second is at
most of the size of the first's round-off. What computes a round-off is `exact` in the
sense of `Body.exact`: it relies on the rounding of each operation by itself.
"""

from collections.abc import Sequence

from ._body import Value
from ._intrinsics import square_root


Pair = tuple[Value, Value]

# Adding this rounds to an integer, which is then in the lowest bits.
_TO_INTEGER = 1.5 * 2.0**52
# The bits of 1.0.
ONE_BITS = 0x3FF0000000000000
# Half of the last of the leading 26 bits.
_HALF_UNIT = 1 << 26


def polynomial(x: Value, coefficients: Sequence[float]) -> Value:
    """Evaluate a polynomial, given its coefficients by rising powers.

    The even and the odd powers are evaluated apart, each in the same way, much as in
    Estrin's scheme: fewer products wait for one another than in Horner's.
    """
    powers = [x]
    while 2 ** len(powers) < len(coefficients):
        powers.append(powers[-1] * powers[-1])

    def part(terms: Sequence[float], level: int) -> Value | float:
        if len(terms) == 1:
            return terms[0]
        even = part(terms[::2], level + 1)
        return part(terms[1::2], level + 1) * powers[level] + even

    result = part(coefficients, 0)
    assert isinstance(result, Value)
    return result


def nearest(x: Value) -> tuple[Value, Value]:
    """Return the integer nearest to x, and bits of which the lowest are that integer.

    For |x| < 2^51, with 51 bits for the integer and its sign.
    """
    with x.body.exact():
        shifted = x + _TO_INTEGER
        return shifted - _TO_INTEGER, shifted.bits()


def times_power_of_two(x: Value, exponent: Value) -> Value:
    """Return x 2^n, rounded once, where n is in the 13 lowest bits.

    For |n| of at most 2000: half of the power is multiplied first, so that neither
    factor overflows, and a result that is subnormal is rounded only at last.
    """
    half = exponent >> 1
    first = ((half << 52) + ONE_BITS).number()
    second = (((exponent - half) << 52) + ONE_BITS).number()
    return x * first * second


def power_of_two(exponent: Value) -> Value:
    """Return 2^n for n from -1022 to 1023 in the 12 lowest bits of an integer."""
    return ((exponent << 52) + ONE_BITS).number()


def fast_two_sum(a: Value | float, b: Value) -> Pair:
    """Return a + b without error, where a is 0 or |a| is at least |b|."""
    with b.body.exact():
        high = a + b
        return high, b - (high - a)


def two_sum(a: Value, b: Value) -> Pair:
    """Return a + b without error."""
    with a.body.exact():
        high = a + b
        other = high - a
        return high, (a - (high - other)) + (b - other)


def leading_bits(x: Value, count: int) -> Value:
    """Return a number of that many binary digits, which is x without the others."""
    return (x.bits() & -(1 << (53 - count))).number()


def halves(x: Value) -> Pair:
    """Split x into two numbers of 26 bits, such that products of these are exact."""
    with x.body.exact():
        upper = leading_bits((x.bits() + _HALF_UNIT).number(), 26)
        return upper, x - upper


def two_product(a: Value, b: Value) -> Pair:
    """Return a b without error, if there is no underflow."""
    with a.body.exact():
        high = a * b
        (a1, a2), (b1, b2) = halves(a), halves(b)
        return high, (((a1 * b1 - high) + a1 * b2) + a2 * b1) + a2 * b2


def product(a: Pair, b: Pair) -> Pair:
    """Return the product of two pairs."""
    high, low = two_product(a[0], b[0])
    return fast_two_sum(high, low + (a[0] * b[1] + a[1] * b[0]))


def quotient(a: Pair, b: Pair) -> Pair:
    """Return the quotient of two pairs."""
    high = a[0] / b[0]
    back, error = two_product(high, b[0])
    with high.body.exact():
        rest = (a[0] - back) - error
    return fast_two_sum(high, (rest + (a[1] - high * b[1])) / b[0])


def rounded_quotient(a: Pair, b: Pair) -> Value:
    """Return the quotient of two pairs to little more than half an ulp.

    The quotient of the first numbers is rounded, and only the effect of the second
    numbers is added.
    """
    first = a[0] / b[0]
    return first + (a[1] - first * b[1]) / b[0]


def root(a: Pair) -> Pair:
    """Return the square root of a pair that is positive."""
    high = square_root(a[0])
    back, error = two_product(high, high)
    with high.body.exact():
        rest = ((a[0] - back) - error) + a[1]
    return fast_two_sum(high, rest / (high + high))
