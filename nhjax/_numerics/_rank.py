"""The rank of small matrices, and inverses of matrices without full rank.

Constraints are independent if the rows of their Jacobian B are independent. A
`RankCondition` is a Jacobian whose rank must be full, `reciprocal_condition` measures
how close the rows are to being dependent, and `dependent_rows` lists the dependent rows
for an error message. Where redundant constraints are allowed, `least_norm_inverse`
replaces the inverse of C = B K⁻¹ Bᵀ, in which K is the mass matrix or its inverse. It
gives the solution x of C x = b with the least norm.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import BoolScalar, FloatScalar


# The rank of Jacobians.


class RankCondition(NamedTuple):
    """The derivatives of constraints at a configuration, which must have full rank.

    For k constraints Γ on positions and m constraints Φ on velocities, the `jacobian`
    has the k rows of DΓ, or the m + k rows of D2Φ and DΓ. Its rank matters only if
    `is_active` is true. A condition at the starting values of Newton's method is active
    only if the method fails; otherwise the method has moved to another configuration.
    """

    jacobian: Float[Array, "l n"]
    q: PyTree[Array]
    is_active: BoolScalar

    @property
    def deficient(self) -> BoolScalar:
        """Return whether the rank matters and is not full."""
        return self.is_active & is_deficient(self.jacobian)


def active_ranks(ranks: list[RankCondition]) -> list[RankCondition]:
    """Return one condition for each shape of Jacobian, an active one if there is one.

    Singular values are more expensive than all other operations here, so that they are
    computed for as few matrices as possible.
    """
    merged: dict[tuple[int, ...], RankCondition] = {}
    for rank in ranks:
        other = merged.setdefault(rank.jacobian.shape, rank)
        if other is not rank:
            merged[rank.jacobian.shape] = jax.tree.map(
                lambda x, y, active=rank.is_active: jnp.where(active, x, y), rank, other
            )
    return list(merged.values())


def reciprocal_condition(matrix: Float[Array, "k l"]) -> FloatScalar:
    """Compute the reciprocal condition number of the rows of a matrix, after scaling.

    In a square matrix, row k and column k are both divided by the square root of the
    largest entry of row k. In other matrices, each row is divided by its largest entry.
    This scaling makes the result independent of the units of the quantities that belong
    to the rows: the constraints, or the coordinates in a mass matrix.
    """
    if matrix.shape[0] == 0:
        return jnp.ones((), matrix.dtype)
    rows = jnp.max(jnp.abs(matrix), axis=1)
    if matrix.shape[0] == 1:
        # There is only one singular value. No library is called, because the call would
        # take long to compile.
        return jnp.where(rows[0] == 0, 0, rows[0] / rows[0])
    rows = jnp.where(rows > 0, rows, 1)
    if matrix.shape[0] == matrix.shape[1]:
        # The matrix is divided by one root after the other, because the product of two
        # roots can overflow.
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
    """Return whether the rows are dependent to round-off, False for rows with NaN."""
    eps = jnp.finfo(matrix.dtype).eps
    return reciprocal_condition(matrix) <= 10 * matrix.shape[1] * eps


def has_zero_row(matrix: Float[Array, "k l"]) -> BoolScalar:
    """Return whether some row is zero."""
    return jnp.any(jnp.all(matrix == 0, axis=1))


def dependent_rows(jacobian: np.ndarray) -> list[int]:
    """Find the rows that take part in a vanishing linear combination of rows."""
    rows = np.max(np.abs(jacobian), axis=1, keepdims=True)
    left, singular, _ = np.linalg.svd(jacobian / np.where(rows > 0, rows, 1))
    singular = np.append(singular, np.zeros(len(jacobian) - len(singular)))
    tolerance = np.sqrt(np.finfo(jacobian.dtype).eps)
    null = left[:, singular <= tolerance * np.max(singular)]
    return [a for a, row in enumerate(null) if np.any(np.abs(row) > tolerance)]


def is_nearly_singular(
    matrix: Float[Array, "l l"], inverse: Float[Array, "l l"]
) -> BoolScalar:
    """Return whether a matrix is singular to round-off, given its computed inverse.

    Rows and columns are divided by the square roots of the diagonal entries. The
    product of the largest entries of the scaled matrix and of its inverse then
    estimates the condition number. No library of linear algebra is called, so that the
    estimate can be part of any kernel.
    """
    size = matrix.shape[0]
    if size < 2:
        return ~jnp.all(jnp.isfinite(inverse))
    diagonal = jnp.abs(jnp.sum(matrix * jnp.eye(size, dtype=matrix.dtype), axis=1))
    root = jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))
    scales = root[:, None] * root[None, :]
    number = jnp.max(jnp.abs(matrix / scales)) * jnp.max(jnp.abs(inverse * scales))
    return ~(10 * size * jnp.finfo(matrix.dtype).eps * number < 1)


# Symmetric matrices C without full rank.


def _negligible(dtype: jnp.dtype) -> float:
    """Return the relative size of eigenvalues of a scaled matrix that count as zero.

    The computed value of a zero eigenvalue is a few units of round-off. Constraints
    whose matrix has such a small eigenvalue cannot be distinguished from dependent
    constraints.
    """
    return float(jnp.finfo(dtype).eps) ** 0.75


# Equations that are dependent at a solution are only nearly dependent at other points.
# At such points, singular values below this fraction of the largest singular value
# count as zero.
NEARLY_DEPENDENT = 1e-4


def least_norm_inverse(
    matrix: Float[Array, "l l"], negligible: float | None = None
) -> Float[Array, "l l"]:
    """Compute the generalised inverse X of a symmetric C for least-norm solutions.

    If C x = b has solutions, X b is the solution x with the least Σ C_aa x_a². The
    result is X = D (D C D)⁺ D with D = diag(C_aa)^(-1/2). Eigenvalues of D C D count
    as zero if they are at most `negligible` times the largest eigenvalue. The default
    is close to round-off. If some constraints are scaled, only their multipliers
    change.
    """
    if matrix.shape[0] == 0:
        return matrix
    scaled, root = _unit_diagonal(matrix)
    if negligible is None:
        negligible = _negligible(matrix.dtype)
    found = jnp.linalg.pinv(scaled, rtol=negligible, hermitian=True)
    return found / root[:, None] / root[None, :]


def least_norm_inverse_by_blocks(
    matrix: Float[Array, "l l"], first: int
) -> Float[Array, "l l"]:
    """Compute a generalised inverse of C; the last equations have priority.

    The equations C x = b have two parts, and `first` is the number of equations in the
    first part. If an equation of the first part follows from the second part, its
    unknown is zero. Otherwise, each of the two parts of x has the least norm, as in
    `least_norm_inverse`. If no equation of one part follows from the other part, the
    result is equal to the result of `least_norm_inverse`.
    """
    if first in (0, matrix.shape[0]):
        return least_norm_inverse(matrix)
    others = least_norm_inverse(matrix[first:, first:])
    onto = matrix[:first, first:] @ others
    # If an equation of the first part follows from the second part, its entries of the
    # Schur complement are round-off. The additional block of size one makes `pinv`
    # compare this round-off with one, the size of the scaled diagonal before the
    # elimination.
    left = matrix[:first, :first] - onto @ matrix[first:, :first]
    root = _roots(matrix[:first, :first])
    scaled = jax.scipy.linalg.block_diag(
        left / root[:, None] / root[None, :], jnp.ones((1, 1), matrix.dtype)
    )
    found = jnp.linalg.pinv(scaled, rtol=_negligible(matrix.dtype), hermitian=True)
    found = found[:first, :first] / root[:, None] / root[None, :]
    coupled = found @ onto
    return jnp.block([[found, -coupled], [-coupled.T, others + onto.T @ coupled]])


def rank_of_gram(matrix: Float[Array, "l l"]) -> Int[Array, ""]:
    """Return the rank: the number of eigenvalues that are not negligible."""
    if matrix.shape[0] == 0:
        return jnp.zeros((), int)
    return jnp.sum(_eigenvalues(matrix)[1])


def reciprocal_condition_of_range(matrix: Float[Array, "l l"]) -> FloatScalar:
    """Divide the smallest nonzero |eigenvalue| by the largest one, after scaling."""
    if matrix.shape[0] == 0:
        return jnp.ones((), matrix.dtype)
    values, is_kept = _eigenvalues(matrix)
    return jnp.min(jnp.where(is_kept, values, jnp.inf)) / jnp.max(values)


def _eigenvalues(matrix: Float[Array, "l l"]) -> tuple[Array, Array]:
    """Compute |eigenvalues| of the scaled matrix, and which of them are not zero."""
    values = jnp.abs(jnp.linalg.eigvalsh(_unit_diagonal(matrix)[0]))
    return values, values > _negligible(matrix.dtype) * jnp.max(values)


def _unit_diagonal(matrix: Float[Array, "l l"]) -> tuple[Array, Array]:
    """Scale rows and columns so that the diagonal is ±1 or 0; also return `_roots`."""
    root = _roots(matrix)
    return matrix / root[:, None] / root[None, :], root


def _roots(matrix: Float[Array, "l l"]) -> Float[Array, " l"]:
    diagonal = jnp.abs(jnp.diagonal(matrix))
    return jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))


def least_norm_solve(matrix: Float[Array, "l l"], b: Array) -> Array:
    """Solve nearly dependent symmetric equations, ignoring small singular values.

    Rows and columns are first scaled so that their largest entries are about one.
    Newton's method uses this function if the equations are dependent at the solution.
    """
    largest = jnp.max(jnp.abs(matrix), axis=1)
    size = jnp.sqrt(jnp.where(largest > 0, largest, 1))
    scaled = matrix / size[:, None] / size[None, :]
    inverse = jnp.linalg.pinv(scaled, rtol=NEARLY_DEPENDENT, hermitian=True)
    return inverse @ (b / size) / size
