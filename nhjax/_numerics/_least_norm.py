"""Inverses and solutions of equations of which some follow from the others."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg
from jaxtyping import Array, Float, Int

from .._custom_types import FloatScalar


def _negligible(dtype: jnp.dtype) -> float:
    """Return the size of eigenvalues of a scaled matrix that count as zero.

    Round-off leaves a few units of itself in the place of an eigenvalue that is zero.
    Constraints that are so close to being dependent cannot be told from dependent ones.
    """
    return float(jnp.finfo(dtype).eps) ** 0.75


# Away from a solution, equations that follow from each other there do so up to the
# distance alone. Singular values below this part of the largest one are left out.
NEARLY_DEPENDENT = 1e-4


def _unit_diagonal(matrix: Float[Array, "l l"]) -> tuple[Array, Array]:
    """Scale rows and columns alike, so that the diagonal is one or zero."""
    root = _roots(matrix)
    return matrix / root[:, None] / root[None, :], root


def _roots(matrix: Float[Array, "l l"]) -> Float[Array, " l"]:
    diagonal = jnp.abs(jnp.diagonal(matrix))
    return jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1))


def least_norm_inverse(
    matrix: Float[Array, "l l"], negligible: float | None = None
) -> Float[Array, "l l"]:
    """Compute the inverse X of a symmetric C that solves C x = b in the least norm.

    Of all x with C x = b the one with the least Σ C_aa x_a² is X b, if there is any.
    With D = diag(C_aa)^(-1/2) it is X = D (D C D)⁺ D, where the eigenvalues of D C D
    that are round-off, or below the part `negligible` of the largest one, count as
    zero. If constraints are scaled, their multipliers are scaled and no others.
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
    """Compute a generalised inverse of C that solves the last equations first.

    As far as the `first` equations follow from the other ones, their unknowns are zero.
    For the rest, each of the two parts of x has the least norm of `least_norm_inverse`.
    Where equations of neither part follow from those of the other it is that inverse.
    """
    if first in (0, matrix.shape[0]):
        return least_norm_inverse(matrix)
    others = least_norm_inverse(matrix[first:, first:])
    onto = matrix[:first, first:] @ others
    # What follows from the other equations leaves round-off here: it is compared with a
    # one, the size of the diagonal before.
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
    """Compute the rank of a symmetric matrix as `least_norm_inverse` takes it."""
    if matrix.shape[0] == 0:
        return jnp.zeros((), int)
    return jnp.sum(_eigenvalues(matrix)[1])


def reciprocal_condition_of_range(matrix: Float[Array, "l l"]) -> FloatScalar:
    """Compute the ratio of the smallest eigenvalue that is not zero to the largest."""
    if matrix.shape[0] == 0:
        return jnp.ones((), matrix.dtype)
    values, is_kept = _eigenvalues(matrix)
    return jnp.min(jnp.where(is_kept, values, jnp.inf)) / jnp.max(values)


def _eigenvalues(matrix: Float[Array, "l l"]) -> tuple[Array, Array]:
    """Find the sizes of the eigenvalues after scaling, and which are not zero."""
    values = jnp.abs(jnp.linalg.eigvalsh(_unit_diagonal(matrix)[0]))
    return values, values > _negligible(matrix.dtype) * jnp.max(values)


def least_norm_solve(matrix: Float[Array, "l l"], b: Array) -> Array:
    """Solve nearly dependent equations, leaving out what is close to a dependence.

    Rows and columns are scaled to size one before. It serves Newton's method, whose
    equations depend on each other at the solution.
    """

    def sizes(x, axis):
        largest = jnp.max(jnp.abs(x), axis=axis, keepdims=True)
        return jnp.sqrt(jnp.where(largest > 0, largest, 1))

    rows, columns = sizes(matrix, 1), sizes(matrix, 0)
    scaled = matrix / rows / columns
    found = jnp.linalg.pinv(scaled, rtol=NEARLY_DEPENDENT) @ (b / rows[:, 0])
    return found / columns[0]
