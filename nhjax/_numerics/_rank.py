"""The rank of the derivatives of constraints, and which rows are dependent."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar


class Rank(NamedTuple):
    """The derivatives of constraints at some configuration, which must have full rank.

    The `jacobian` has k rows of DΓ, or m + k rows of D2Φ and DΓ, and `counts` tells
    whether its rank matters: where Newton's method starts it does so only if the method
    fails, since otherwise the method has left the place.
    """

    jacobian: Float[Array, "l n"]
    q: PyTree[Array]
    counts: BoolScalar

    @property
    def deficient(self) -> BoolScalar:
        """Tell whether the rank matters and is not full."""
        return self.counts & is_deficient(self.jacobian)


def those_that_count(ranks: list[Rank]) -> list[Rank]:
    """Keep at most one matrix of each shape, namely the one that counts.

    The fewer matrices there are, the fewer singular values must be computed, which cost
    more than anything else here.
    """
    merged: dict[tuple[int, ...], Rank] = {}
    for rank in ranks:
        other = merged.setdefault(rank.jacobian.shape, rank)
        if other is not rank:
            merged[rank.jacobian.shape] = jax.tree.map(
                lambda x, y, counts=rank.counts: jnp.where(counts, x, y), rank, other
            )
    return list(merged.values())


def reciprocal_condition(matrix: Float[Array, "k l"]) -> FloatScalar:
    """Compute the reciprocal condition number of the rows of a matrix, after scaling.

    Rows, and of square matrices the columns too, are scaled to size one, which makes
    the ratio independent of the units of single coordinates and constraints.
    """
    if matrix.shape[0] == 0:
        return jnp.ones((), matrix.dtype)
    rows = jnp.max(jnp.abs(matrix), axis=1)
    if matrix.shape[0] == 1:
        # There is one singular value. A library's call takes long to compile.
        return jnp.where(rows[0] == 0, 0, rows[0] / rows[0])
    rows = jnp.where(rows > 0, rows, 1)
    if matrix.shape[0] == matrix.shape[1]:
        # The matrix is divided by each root on its own: their product could overflow.
        roots = jnp.sqrt(rows)
        scaled = matrix / roots[:, None] / roots[None, :]
    else:
        scaled = matrix / rows[:, None]
    if matrix.shape[0] > matrix.shape[1]:
        return jnp.zeros((), matrix.dtype)
    singular = jnp.linalg.svd(scaled, compute_uv=False)
    # The test is "== 0" and not "> 0", so that NaN does not count as singular.
    return jnp.where(singular[0] == 0, 0, singular[-1] / singular[0])


def is_deficient(matrix: Float[Array, "k l"]) -> BoolScalar:
    """Tell whether the rows are dependent up to round-off; NaN does not count so."""
    eps = jnp.finfo(matrix.dtype).eps
    return reciprocal_condition(matrix) <= 10 * matrix.shape[1] * eps


def is_without_entries(matrix: Float[Array, "k l"]) -> BoolScalar:
    """Tell whether some row is zero."""
    return jnp.any(jnp.all(matrix == 0, axis=1))


def is_nearly_singular(
    matrix: Float[Array, "l l"], inverse: Float[Array, "l l"]
) -> BoolScalar:
    """Tell from what was computed as its inverse if a matrix is singular.

    The product of their largest entries, after rows and columns of the matrix are
    scaled as those of a Gram matrix, estimates the condition number. It takes no
    library of linear algebra, and can be a part of any program.
    """
    size = matrix.shape[0]
    if size < 2:
        return ~jnp.all(jnp.isfinite(inverse))
    diagonal = jnp.abs(jnp.sum(matrix * jnp.eye(size, dtype=matrix.dtype), axis=1))
    root = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
    scales = root[:, None] * root[None, :]
    number = jnp.max(jnp.abs(matrix / scales)) * jnp.max(jnp.abs(inverse * scales))
    return ~(10 * size * jnp.finfo(matrix.dtype).eps * number < 1)


def dependent_rows(jacobian: np.ndarray) -> list[int]:
    """Find the rows that take part in a vanishing linear combination of rows."""
    rows = np.max(np.abs(jacobian), axis=1, keepdims=True)
    left, singular, _ = np.linalg.svd(jacobian / np.where(rows > 0, rows, 1))
    singular = np.append(singular, np.zeros(len(jacobian) - len(singular)))
    tolerance = np.sqrt(np.finfo(jacobian.dtype).eps)
    null = left[:, singular <= tolerance * np.max(singular)]
    return [a for a, row in enumerate(null) if np.any(np.abs(row) > tolerance)]
