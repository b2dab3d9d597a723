"""The rank of the derivatives of constraints, and which rows are dependent."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar


class Rank(NamedTuple):
    """The derivatives of constraints at some configuration, which must have full rank.

    They have k rows of DΓ, or m + k of D2Φ and DΓ. Where Newton's method starts they
    `count` only if it fails: it may leave the place.
    """

    jacobian: Float[Array, "l n"]
    q: PyTree[Array]
    counts: BoolScalar

    @property
    def deficient(self) -> BoolScalar:
        """Whether it counts and is not of full rank."""
        n, eps = self.jacobian.shape[1], jnp.finfo(self.jacobian.dtype).eps
        return self.counts & (conditioning(self.jacobian) <= 10 * n * eps)


def those_that_count(ranks: list[Rank]) -> list[Rank]:
    """At most one of each shape: of several, the one that counts.

    Singular values are what costs most here.
    """
    merged: dict[tuple[int, ...], Rank] = {}
    for rank in ranks:
        other = merged.setdefault(rank.jacobian.shape, rank)
        if other is not rank:
            merged[rank.jacobian.shape] = jax.tree.map(
                lambda x, y, counts=rank.counts: jnp.where(counts, x, y), rank, other
            )
    return list(merged.values())


def conditioning(matrix: Float[Array, "k l"]) -> FloatScalar:
    """Smallest over largest singular value, after scaling rows (and columns) to one.

    The scaling makes it blind to the units of single coordinates and constraints.
    """
    if matrix.shape[0] == 0:
        return jnp.ones((), matrix.dtype)
    rows = jnp.max(jnp.abs(matrix), axis=1)
    rows = jnp.where(rows > 0, rows, 1)
    if matrix.shape[0] == matrix.shape[1]:
        # Each root on its own: a product could overflow.
        roots = jnp.sqrt(rows)
        scaled = matrix / roots[:, None] / roots[None, :]
    else:
        scaled = matrix / rows[:, None]
    if matrix.shape[0] > matrix.shape[1]:
        return jnp.zeros((), matrix.dtype)
    singular = jnp.linalg.svd(scaled, compute_uv=False)
    # Not "> 0": what is not a number must not pass for singular.
    return jnp.where(singular[0] == 0, 0, singular[-1] / singular[0])


def dependent_rows(jacobian: np.ndarray) -> list[int]:
    """The rows that take part in a vanishing combination of rows."""
    rows = np.max(np.abs(jacobian), axis=1, keepdims=True)
    left, singular, _ = np.linalg.svd(jacobian / np.where(rows > 0, rows, 1))
    singular = np.append(singular, np.zeros(len(jacobian) - len(singular)))
    tolerance = np.sqrt(np.finfo(jacobian.dtype).eps)
    null = left[:, singular <= tolerance * np.max(singular)]
    return [a for a, row in enumerate(null) if np.any(np.abs(row) > tolerance)]
