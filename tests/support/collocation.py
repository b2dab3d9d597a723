"""Collocation methods, node vectors and exact motions, in rationals or 50 digits.

Written from the definitions in `docs/closures.md`, without the library. Arrays hold
Python objects: fractions, or numbers of mpmath with 50 digits.
"""

import math
import random
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cached_property
from typing import Any

import mpmath
import numpy as np


MP = mpmath.MPContext()
MP.dps = 50
ROUND_OFF = MP.mpf(10) ** -40


def numbers(values: Any) -> np.ndarray:
    """An array of 50 digits, from numbers or from decimals in strings."""
    return np.vectorize(MP.mpf, otypes=[object])(np.asarray(values, dtype=object))


def solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution of a linear system, by elimination with row exchanges."""
    rows = np.concatenate([matrix, right.reshape(len(right), -1)], axis=1)
    n = len(rows)
    for k in range(n):
        pivot = k + int(np.argmax(np.abs(rows[k:, k])))
        rows[[k, pivot]] = rows[[pivot, k]]
        rows[k] = rows[k] / rows[k, k]
        for i in range(n):
            if i != k:
                rows[i] = rows[i] - rows[i, k] * rows[k]
    return rows[:, n:].reshape(right.shape)


def inverse(matrix: np.ndarray) -> np.ndarray:
    """The inverse of a matrix of 50 digits."""
    return np.array((MP.matrix(matrix.tolist()) ** -1).tolist(), dtype=object)


class Collocation:
    """The collocation method on nodes with c_1 = 0 and c_s = 1, and its conjugate."""

    def __init__(self, nodes: Sequence[Any]):
        c = self.c = np.array(nodes, dtype=object)
        s = self.stages = len(nodes)
        self.tolerance = 0 if isinstance(nodes[0], Fraction) else ROUND_OFF
        self.a = np.empty((s, s), dtype=object)
        for j in range(s):
            basis = np.array([c[0] * 0 + 1], dtype=object)  # from the constant upwards
            for i in range(s):
                if i != j:
                    factor = np.array([-c[i], 1], dtype=object) / (c[j] - c[i])
                    basis = np.convolve(basis, factor)
            degrees = range(1, s + 1)
            integral = [e / k for e, k in zip(basis, degrees, strict=True)]
            for i in range(s):
                self.a[i, j] = sum(
                    e * c[i] ** k for e, k in zip(integral, degrees, strict=True)
                )
        b = self.b = self.a[-1]
        self.a_hat = b * (1 - self.a.T / b[:, None])

    def vanishes(self, x: Any) -> bool:
        """Whether numbers are zero, exactly if the nodes are fractions."""
        return all(abs(e) <= self.tolerance for e in np.ravel(np.asarray(x)))

    @cached_property
    def p(self) -> int:
        """The order of the quadrature."""
        k = 1
        while self.vanishes(np.sum(self.b * self.c**k) - self.c[-1] / (k + 1)):
            k += 1
        return k

    @property
    def r(self) -> int:
        """The number r = p - s for which D(r) holds."""
        return self.p - self.stages

    @cached_property
    def kernel(self) -> np.ndarray:
        """The vector w with A w = 0 and w_1 = 1."""
        rest = solved(self.a[1:, 1:], -self.a[1:, 0])
        return np.concatenate([[self.c[-1]], rest])

    def moment(self, x: np.ndarray, k: int) -> Any:
        """Σ_j b_j c_j^k x_j."""
        return (self.b * self.c**k) @ x

    def conditions(self, m: int) -> range:
        """The degrees k of the moments that vanish in N_m."""
        return range(max(2 * self.r + 2 - m, 0))

    def contains(self, m: int, x: np.ndarray) -> bool:
        """Whether x is in N_m, for m > r."""
        return all(self.vanishes(self.moment(x, k)) for k in self.conditions(m))

    def member(self, m: int, seed: int) -> np.ndarray:
        """A random element of N_m: zero if m <= r."""
        draw, one = random.Random(seed), self.c[-1]
        x = np.array([one * draw.randint(-9, 9) / 7 for _ in self.c], dtype=object)
        if m <= self.r:
            return 0 * x
        n = len(self.conditions(m))
        if n:
            weights = np.stack([self.b * self.c**k for k in range(n)])
            x[:n] = solved(weights[:, :n], -(weights[:, n:] @ x[n:]))
        return x

    def preimage(self, g: np.ndarray, first: Any) -> np.ndarray:
        """The solution u of A u = g with a given first entry, for g_1 = 0."""
        rest = solved(self.a[1:, 1:], g[1:] - self.a[1:, 0] * first)
        return np.concatenate([[first], rest])

    def defect(self, m: int, conjugate: bool = False) -> np.ndarray:
        """Σ_j a_ij c_j^(m-1) - c_i^m / m, or the same with â."""
        a = self.a_hat if conjugate else self.a
        return a @ self.c ** (m - 1) - self.c**m / m


def lobatto(stages: int) -> Collocation:
    """Lobatto IIIA: the ends and the zeros of the derivative of P_{s-1}."""
    n, slope = stages - 1, [0] * (stages - 1)
    for k in range((n + 1) // 2):
        coefficient = (-1) ** k * math.comb(n, k) * math.comb(2 * n - 2 * k, n)
        slope[2 * k] = (n - 2 * k) * coefficient  # times 2^n, of x^(n - 2k - 1)
    inner = MP.polyroots(slope, maxsteps=200, extraprec=300) if n > 1 else []
    middle = sorted((MP.re(x) + 1) / 2 for x in inner)
    return Collocation([MP.mpf(0), *middle, MP.mpf(1)])


def rational(*nodes: str) -> Collocation:
    """Collocation on rational nodes, in exact arithmetic."""
    return Collocation([Fraction(x) for x in nodes])


def in_digits(method: Collocation) -> Collocation:
    """The same method in 50 digits."""
    if not isinstance(method.c[0], Fraction):
        return method
    return Collocation([MP.mpf(x.numerator) / x.denominator for x in method.c])


def newton(
    residual: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    inverse_jacobian: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Solve equations with a finite-difference Jacobian that is computed once."""
    at = residual(x)
    if inverse_jacobian is None:
        step, columns = MP.mpf(10) ** -20, []
        for j in range(len(x)):
            moved = x.copy()
            moved[j] += step
            columns.append((residual(moved) - at) / step)
        inverse_jacobian = inverse(np.stack(columns, axis=1))
    for _ in range(100):
        change = inverse_jacobian @ at
        x = x - change
        if max(abs(e) for e in change) < MP.mpf(10) ** -44:
            return x, inverse_jacobian
        at = residual(x)
    raise AssertionError("Newton's method has not converged")


def motion(
    field: Callable[[Any, np.ndarray], np.ndarray], t: Any, y: np.ndarray, duration: Any
) -> np.ndarray:
    """The solution of y' = field(t, y) by extrapolation of the midpoint rule."""
    if duration == 0:
        return y
    counts, rows, start = [2 * k for k in range(1, 15)], [], field(t, y)
    for k, count in enumerate(counts):
        h = duration / count
        last, here = y, y + h * start
        for j in range(1, count):
            last, here = here, last + 2 * h * field(t + j * h, here)
        row = [(here + last + h * field(t + duration, here)) / 2]
        for j in range(1, k + 1):
            factor = (MP.mpf(count) / counts[k - j]) ** 2 - 1
            row.append(row[-1] + (row[-1] - rows[-1][j - 1]) / factor)
        rows.append(row)
    error = max(abs(e) for e in rows[-1][-1] - rows[-1][-2])
    assert error < MP.mpf(10) ** -30, f"the reference is not exact: {error}"
    return rows[-1][-1]


def largest(x: Any) -> Any:
    """The largest absolute value."""
    return max(abs(e) for e in np.ravel(np.asarray(x, dtype=object)))


def slope(coarse: Any, fine: Any) -> float:
    """The power of h that fits values at h and at h / 2."""
    return float(MP.log(coarse / fine, 2))
