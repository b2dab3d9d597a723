"""The order of a partitioned pair, by the order conditions of its bicoloured trees.

A pair (a, â) with common weights b solves q' = f(q, p), p' = g(q, p). Its conditions
belong to rooted trees whose edges have two colours, since a stage takes q from a and p
from â: with φ_i(τ) = Π_k Σ_j a^(k)_ij φ_j(τ_k) over the subtrees τ_k at the root of τ,
and a^(k) the matrix of the colour of the edge,

    Σ_i b_i φ_i(τ) = 1 / γ(τ),    γ(τ) = |τ| Π_k γ(τ_k),

for all trees with up to p vertices is order p (Hairer, Lubich, Wanner, "Geometric
Numerical Integration", III.2.2).
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np


class _Branch(NamedTuple):
    """A tree below an edge: its number of vertices, its γ, and Σ_j a_ij φ_j."""

    size: int
    gamma: int
    values: np.ndarray


def partitioned_order(
    matrices: Sequence[np.ndarray], b: np.ndarray, tolerance: Any, most: int
) -> int:
    """Find the order of a partitioned pair, up to `most`.

    **Arguments:**

    - `matrices`: a and â, of floats, or of exact numbers in arrays of objects.
    - `b`: the weights of both.
    - `tolerance`: the defect of a condition that counts as round-off.
    - `most`: the largest order that is looked for; of order 8 there are 9498 trees
        with eight vertices.

    **Returns:** the largest order up to `most` whose conditions hold, 0 if none does.
    """
    branches: list[_Branch] = []
    for size in range(1, most + 1):
        trees = list(_products(branches, size - 1, len(branches), b * 0 + 1))
        for gamma, values in trees:
            if abs(np.dot(b, values) * gamma * size - 1) > tolerance * gamma * size:
                return size - 1
        branches += [
            _Branch(size, gamma * size, np.dot(a, values))
            for gamma, values in trees
            for a in matrices
        ]
    return most


def _products(
    branches: list[_Branch], size: int, end: int, values: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """Make all roots with `size` vertices above them, of branches before `end`.

    Each comes as the product of the γ of its branches, and its φ.
    """
    if size == 0:
        yield 1, values
        return
    for index in range(end):
        branch = branches[index]
        if branch.size > size:
            # They are sorted by size.
            return
        rest = size - branch.size
        for gamma, product in _products(
            branches, rest, index + 1, values * branch.values
        ):
            yield gamma * branch.gamma, product
