"""The nodes of Gauss and of Lobatto quadrature on [-1, 1], to 60 digits."""

import math
from collections.abc import Callable

from ._precision import CONTEXT, Number


def legendre(degree: int, x: Number) -> list[Number]:
    """Evaluate the Legendre polynomials P_0(x), ..., P_degree(x) by their recurrence.

    **Arguments:**

    - `degree`: the highest degree.
    - `x`: an mp number (any type with exact integer multiples will do).

    **Returns:**

    A list of `degree + 1` values.
    """
    values = [x * 0 + 1, x]
    for n in range(1, degree):
        values.append(((2 * n + 1) * x * values[n] - n * values[n - 1]) / (n + 1))
    return values[: degree + 1]


def lobatto_points(stages: int) -> list[Number]:
    """Compute the Lobatto points on [-1, 1]: -1, the zeros of P'_{s-1}, and 1.

    They are exactly symmetric about 0, and in increasing order.

    **Arguments:**

    - `stages`: s >= 2.

    **Returns:**

    A list of s mp numbers.
    """
    n = stages - 1

    def derivative(x: Number) -> tuple[Number, Number]:
        p = legendre(n, x)
        # (1 - x²) P_n' = n (P_{n-1} - x P_n) and Legendre's equation for P_n''.
        first = n * (p[n - 1] - x * p[n]) / (1 - x * x)
        return first, (2 * x * first - n * (n + 1) * p[n]) / (1 - x * x)

    guesses = [math.cos(math.pi * k / n) for k in range(1, stages // 2)]
    inner = [_newton(derivative, g) for g in guesses]
    return _mirrored([CONTEXT.mpf(1), *inner], stages)


def gauss_points(stages: int) -> list[Number]:
    """Compute the Gauss points on [-1, 1], the zeros of P_s.

    They are exactly symmetric about 0, and in increasing order.

    **Arguments:**

    - `stages`: s >= 1.

    **Returns:**

    A list of s mp numbers.
    """

    def polynomial(x: Number) -> tuple[Number, Number]:
        p = legendre(stages, x)
        slope = stages * (p[stages - 1] - x * p[stages]) / (1 - x * x)
        return p[stages], slope

    guesses = [
        math.cos(math.pi * (k - 0.25) / (stages + 0.5))
        for k in range(1, stages // 2 + 1)
    ]
    return _mirrored([_newton(polynomial, g) for g in guesses], stages)


def _newton(f: Callable[[Number], tuple[Number, Number]], guess: float) -> Number:
    """Find the root of `f` near `guess`; `f` returns its value and derivative."""
    x = CONTEXT.mpf(guess)
    for _ in range(100):
        value, slope = f(x)
        step = value / slope
        x = x - step
        # Newton doubles the digits: a step this small leaves an error far below 1e-60.
        if abs(step) < CONTEXT.mpf("1e-40"):
            return x
    raise RuntimeError("Newton's iteration for the nodes of a tableau did not converge")


def _mirrored(right: list[Number], count: int) -> list[Number]:
    """Make all points, exactly symmetric and in increasing order, from those > 0."""
    centre = [CONTEXT.mpf(0)] if count % 2 else []
    return [-x for x in right] + centre + right[::-1]
