"""The polynomials of the elementary functions, computed and judged by mpmath.

Most functions are a few exact terms plus a polynomial for the rest, called the tail. A
tail's share is the factor by which its error enters the function's relative error. The
polynomials interpolate at Chebyshev nodes; their error is within a small factor of the
smallest possible. `python tests/support/approximations.py` prints the module with the
coefficients.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import mpmath
from mpmath import mp, mpf


# Numbers of mpmath; before mpmath 1.4 their class is an attribute of a context.
Real = Any


class Approximation(NamedTuple):
    """A tail and its share as functions of the polynomial's argument, and its range."""

    tail: Callable[[Real], Real]
    share: Callable[[Real], Real]
    lower: float
    upper: float
    degree: int
    comment: str


def _log_ratio(z: Real) -> Real:
    """Return artanh(s) / s for s = sqrt(z)."""
    s = mpmath.sqrt(z)
    return mpmath.atanh(s) / s


HALF_LN2, QUARTER_PI = 0.34658, 0.78540
# log(1 + f) with f from sqrt(1/2) - 1 to sqrt(2) - 1 is 2 artanh(s), s = f / (2 + f).
S_SQUARED = 0.029438
# For the complementary error function, the argument is 1 / (x + 2) minus this.
ERFC_CENTRE = 0.229

APPROXIMATIONS = {
    "SIN": Approximation(
        lambda z: (mpmath.sin(mpmath.sqrt(z)) / mpmath.sqrt(z) - 1) / z,
        lambda z: z, 0, QUARTER_PI**2, 5,
        "(sin(x) / x - 1) / x**2 in x**2, for |x| up to pi / 4.",
    ),
    "COS": Approximation(
        lambda z: (mpmath.cos(mpmath.sqrt(z)) - 1 + z / 2) / z**2,
        lambda z: z**2, 0, QUARTER_PI**2, 5,
        "(cos(x) - 1 + x**2 / 2) / x**4 in x**2, for |x| up to pi / 4.",
    ),
    "EXP": Approximation(
        lambda r: (mpmath.expm1(r) - r) / r**2,
        lambda r: r**2 * mpmath.exp(-r), -HALF_LN2, HALF_LN2, 9,
        "(exp(x) - 1 - x) / x**2 in x, for |x| up to log(2) / 2.",
    ),
    "SINH": Approximation(
        lambda z: (mpmath.sinh(mpmath.sqrt(z)) / mpmath.sqrt(z) - 1) / z,
        lambda z: z, 0, HALF_LN2**2, 4,
        "(sinh(x) / x - 1) / x**2 in x**2, for |x| up to log(2) / 2.",
    ),
    "COSH": Approximation(
        lambda z: (mpmath.cosh(mpmath.sqrt(z)) - 1) / z,
        lambda z: z, 0, HALF_LN2**2, 5,
        "(cosh(x) - 1) / x**2 in x**2, for |x| up to log(2) / 2.",
    ),
    "LOG": Approximation(
        lambda z: (2 * _log_ratio(z) - 2) / z,
        lambda z: z / 2, 0, S_SQUARED, 6,
        "(2 artanh(s) / s - 2) / s**2 in s**2, for |s| up to tanh(log(2) / 4).",
    ),
    "LOG_LONG": Approximation(
        lambda z: (_log_ratio(z) - 1 - z / 3) / z**2,
        lambda z: z**2, 0, S_SQUARED, 8,
        "(artanh(s) / s - 1 - s**2 / 3) / s**4 in s**2, for the function `pow`.",
    ),
    "ATAN": Approximation(
        lambda z: (mpmath.atan(mpmath.sqrt(z)) / mpmath.sqrt(z) - 1) / z,
        lambda z: z, 0, 0.25, 13,
        "(arctan(x) / x - 1) / x**2 in x**2, for |x| up to 1 / 2.",
    ),
    "ASIN": Approximation(
        lambda z: (mpmath.asin(mpmath.sqrt(z)) / mpmath.sqrt(z) - 1) / z,
        lambda z: z, 0, 0.25, 12,
        "(arcsin(x) / x - 1) / x**2 in x**2, for |x| up to 1 / 2.",
    ),
    "CBRT": Approximation(
        mpmath.cbrt, lambda x: mpf(1), 1, 2, 5,
        "The cube root of x between 1 and 2, to 19 bits.",
    ),
    "ERF": Approximation(
        lambda z: mpmath.erf(mpmath.sqrt(z)) / mpmath.sqrt(z) - 2 / mpmath.sqrt(mp.pi),
        lambda z: mpmath.sqrt(mp.pi) / 2, 0, 1, 12,
        "erf(x) / x - 2 / sqrt(pi) in x**2, for |x| up to 1.",
    ),
    "ERFC": Approximation(
        lambda u: mpmath.erfc(_erfc_argument(u)) * mpmath.exp(_erfc_argument(u) ** 2),
        lambda u: mpf(mpmath.exp(-(_erfc_argument(u) ** 2))),
        1 / 8.2 - ERFC_CENTRE, 1 / 3 - ERFC_CENTRE, 17,
        f"erfc(x) exp(x**2) in 1 / (x + 2) - {ERFC_CENTRE}, for x from 1 to 6.2.",
    ),
}  # fmt: skip


def _erfc_argument(u: Real) -> Real:
    return mpf(1 / (u + mpf(ERFC_CENTRE)) - 2)


def coefficients(name: str) -> tuple[float, ...]:
    """Return the coefficients of the interpolating polynomial, lowest power first."""
    given = APPROXIMATIONS[name]
    size = given.degree + 1
    with mp.workdps(60):
        middle = (mpf(given.upper) + mpf(given.lower)) / 2
        radius = (mpf(given.upper) - mpf(given.lower)) / 2
        angles = [(2 * k + 1) * mp.pi / (2 * size) for k in range(size)]
        nodes = [middle + radius * mpmath.cos(angle) for angle in angles]
        powers = mp.matrix([[node**k for k in range(size)] for node in nodes])
        values = mp.matrix([given.tail(node) for node in nodes])
        return tuple(float(x) for x in mpmath.lu_solve(powers, values))


def worst_error(name: str, polynomial: tuple[float, ...], points: int = 401) -> float:
    """Return the largest relative error that a polynomial causes in its function."""
    given = APPROXIMATIONS[name]
    with mp.workdps(60):
        width = mpf(given.upper) - mpf(given.lower)
        worst = mpf(0)
        for k in range(points + 1):
            # Points lie closer together at the ends, where the error is largest; since
            # their number is even, none is in the middle, where the tail may be 0 / 0.
            angle = mp.pi * (k + 0.5) / (2 * points + 2)
            t = mpf(given.lower) + width * mpmath.sin(angle) ** 2
            value = sum(c * t**power for power, c in enumerate(polynomial))
            worst = max(worst, abs((value - given.tail(t)) * given.share(t)))
        return float(worst)


def module() -> str:
    """Return the text of the module with the coefficients of all polynomials."""
    lines = [
        '"""Coefficients of polynomials, lowest power first.',
        "",
        'A comment "f(x) in z" names the approximated function f and the variable z of',
        "the polynomial, which interpolates f at Chebyshev's nodes. `python",
        "tests/support/approximations.py` computes and prints the coefficients, and",
        "`tests/lanes` checks the errors of the polynomials.",
        '"""',
    ]
    for name, given in APPROXIMATIONS.items():
        lines += ["", f"# {given.comment}", f"{name} = ("]
        lines += [f"    {x!r}," for x in coefficients(name)]
        lines += [")"]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    print(module(), end="")
