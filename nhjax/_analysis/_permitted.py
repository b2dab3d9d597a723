"""Bases of the perturbations of a state that linear constraints permit."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import BoolScalar
from .._numerics import is_deficient


class Permitted(NamedTuple):
    """A basis Z of the perturbations that are permitted, and a W with W Z = 1.

    `determined` tells whether the constraints determine all others.
    """

    basis: Float[Array, "x d"]
    left: Float[Array, "d x"]
    determined: BoolScalar


def orthonormal_basis(rows: Array, orbit: Array) -> Permitted:
    """Compute an orthonormal basis of the kernel of `rows`, at right angles to `orbit`.

    What is picked from perturbations does not depend on how far they go along the
    vectors of `orbit`, which lie in the kernel themselves.

    The basis is defined up to a rotation, which no derivative of a singular value
    decomposition settles: the one that is found is held, and its derivative is that by
    which it stays in the kernel.
    """
    rows = jnp.concatenate([rows, orbit])
    count = rows.shape[0]
    _, _, right = jnp.linalg.svd(jax.lax.stop_gradient(rows), full_matrices=True)
    kernel = right[count:].T
    basis = kernel - _along(rows, kernel)
    beside = (kernel - _along(orbit, kernel)).T
    left = jnp.linalg.solve(beside @ basis, beside)
    return Permitted(basis, left, ~is_deficient(rows))


def _along(rows: Array, vectors: Array) -> Array:
    """Compute the parts of vectors, as columns, in the span of `rows`."""
    return rows.T @ jnp.linalg.solve(rows @ rows.T, rows @ vectors)


def independent_basis(
    on_velocities: Array,
    on_positions: Array,
    positions: tuple[int, ...],
    velocities: tuple[int, ...],
) -> Permitted:
    """Compute a basis of the permitted perturbations, one for each chosen coordinate.

    Each changes its own coordinate by one and no other chosen one; `left` takes the
    chosen coordinates from a perturbation.
    """
    dim, dtype = on_positions.shape[1], on_positions.dtype
    count, others = len(positions), len(velocities)
    unit = jnp.eye(dim, dtype=dtype)
    q_rows, u_rows = (
        unit[jnp.asarray(positions, int)],
        unit[jnp.asarray(velocities, int)],
    )
    # The smallest change of positions: those that no constraint ties stay as they are.
    wanted = jnp.concatenate(
        [jnp.eye(count, dtype=dtype), jnp.zeros((on_positions.shape[0], count), dtype)]
    )
    moved = jnp.concatenate([q_rows, on_positions])
    xi = moved.T @ jnp.linalg.solve(moved @ moved.T, wanted)
    xi = jnp.concatenate([xi, jnp.zeros((dim, others), dtype)], axis=1)
    kept = jnp.eye(count + others, dtype=dtype)[count:]
    right = jnp.concatenate([kept, -on_velocities[:, :dim] @ xi])
    following = jnp.concatenate([u_rows, on_velocities[:, dim:]])
    w = jnp.linalg.solve(following, right)
    zero = jnp.zeros_like
    left = jnp.block([[q_rows, zero(q_rows)], [zero(u_rows), u_rows]])
    regular = ~(is_deficient(moved) | is_deficient(following))
    return Permitted(jnp.concatenate([xi, w]), left, regular)
