"""Classical tableaux, and defects of order conditions in exact rational arithmetic.

They are defects of the float64 coefficients, whose rounding is their only error.
"""

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np

from nhjax._method import PartitionedRungeKutta
from nhjax._method._tableau import Tableau


STAGES = range(2, 9)
TWO_ULP = Fraction(2, 2**52)
CLOSURES = ("propagated", "consistent", "symmetric")

RK4 = PartitionedRungeKutta(
    [[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1, 0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
)
IMPLICIT_EULER = PartitionedRungeKutta([[1.0]], [1.0])
EXPLICIT_EULER = PartitionedRungeKutta([[0.0]], [1.0])
RADAU_IIA = PartitionedRungeKutta([[5 / 12, -1 / 12], [0.75, 0.25]], [0.75, 0.25])


def exact(array: np.ndarray) -> list:
    """The entries of a float64 array as fractions, nested as the array is."""
    return [
        exact(entry) if isinstance(entry, np.ndarray) else Fraction(float(entry))
        for entry in array
    ]


def matmul(x: list, y: list) -> list:
    columns = list(zip(*y, strict=True))
    return [[sum(p * q for p, q in zip(r, c, strict=True)) for c in columns] for r in x]


def b_defect(b: list, c: list, k: int) -> Fraction:
    return abs(
        sum(w * x ** (k - 1) for w, x in zip(b, c, strict=True)) - Fraction(1, k)
    )


def c_defect(a: list, c: list, k: int) -> Fraction:
    powers = [[x ** (k - 1)] for x in c]
    return max(
        abs(left[0] - x**k / k) for left, x in zip(matmul(a, powers), c, strict=True)
    )


def d_defect(a: list, b: list, c: list, k: int) -> Fraction:
    weighted = [[w * x ** (k - 1) for w, x in zip(b, c, strict=True)]]
    (sums,) = matmul(weighted, a)
    return max(
        abs(left - w * (1 - x**k) / k) for left, w, x in zip(sums, b, c, strict=True)
    )


def mixed_defect(a: list, a_hat: list, c: list, k: int) -> Fraction:
    powers = [[x ** (k - 2)] for x in c]
    sums = matmul(a, matmul(a_hat, powers))
    return max(
        abs(left[0] - x**k / (k * (k - 1))) for left, x in zip(sums, c, strict=True)
    )


def assert_holds_exactly_up_to(
    defect: Callable[[int], Fraction], order: int, first: int = 1
) -> None:
    for k in range(first, order + 1):
        assert defect(k) <= TWO_ULP, k
    assert defect(order + 1) > 2**10 * TWO_ULP


def is_symplectic_pair(t: Tableau, a_hat: Any) -> bool:
    """Whether b_i â_ij + b_j a_ji = b_i b_j (Hairer, Lubich, Wanner, VI.4.1).

    `a_hat` is the mp matrix of the other method, whose weights are those of `t`.
    """
    s, a, b = t.stages, t.mp_a, t.mp_b
    return all(
        abs(b[i] * a_hat[i, j] + b[j] * a[j, i] - b[i] * b[j]) <= t.tolerance
        for i in range(s)
        for j in range(s)
    )
