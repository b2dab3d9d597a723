"""Block tridiagonal matrices, and their factors by elimination without pivoting."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import BoolScalar
from ._contraction import AbstractLinearMap, inverse, small_einsum
from ._sparse import Pattern, SparseMatrix
from ._static_take import static_take


def couplings(
    left: SparseMatrix, right: SparseMatrix, weights: Float[Array, " n"]
) -> Float[Array, "r s c b l"]:
    """Compute the products L_i K R_jᵀ in compressed form, with K = diag(weights).

    They are block tridiagonal in the order of the pattern, so that a row has entries in
    at most one of the blocks whose numbers are equal modulo three: their columns can be
    added up. Entry [i, j, c, b, a] of the result is that of row a in the sum of the
    columns b of all blocks whose number is c modulo three.
    """
    pattern = left.pattern
    place = np.argsort(pattern.order)
    block, within = np.divmod(place, pattern.group)
    chosen = np.stack(
        [
            np.where((block % 3 == c) & (within == b), 1.0, 0.0)
            for c in range(3)
            for b in range(pattern.group)
        ]
    )
    seeds = jnp.asarray(chosen, left.values.dtype)
    pushed = weights[None, None] * SparseMatrix(right.values[:, None], pattern).rmatvec(
        seeds[None]
    )
    rows = SparseMatrix(left.values[:, None, None], pattern)
    found = rows.matvec(pushed[None])
    return found.reshape(*found.shape[:2], 3, pattern.group, -1)


class BlockTridiagonalInverse(AbstractLinearMap):
    """The inverse of a block tridiagonal matrix, by the factors of its elimination.

    The unknowns are q numbers for each row of the pattern, of shape (q, l) or in one
    vector, and so are the residuals. Blocks are eliminated from the first to the last:
    with D_k, L_k, U_k the blocks of row k, and

    P_k = D_k - L_k P_{k-1}⁻¹ U_{k-1},

    `inverses` are P_k⁻¹, `lower` is P_k⁻¹ L_k and `upper` is P_k⁻¹ U_k. No rows change
    places between blocks. That is stable where the matrix is close to a Kronecker
    product A ⊗ C of a small matrix with a definite one.
    """

    inverses: Float[Array, "N g g"]
    lower: Float[Array, "N g g"]
    upper: Float[Array, "N g g"]
    pattern: Pattern = eqx.field(static=True)

    def matvec(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Compute the solution for a residual."""
        pattern, count = self.pattern, self.inverses.shape[0]
        size, shape = pattern.shape[0], x.shape
        ordered = static_take(x.reshape(-1, size), pattern.order)
        q = ordered.shape[0]
        padded = jnp.pad(ordered, ((0, 0), (0, count * pattern.group - size)))
        blocks = jnp.moveaxis(padded.reshape(q, count, pattern.group), 0, 2)
        r = small_einsum("kab,kb->ka", self.inverses, blocks.reshape(count, -1))

        def forward(y, given):
            r, lower = given
            y = r - small_einsum("ab,b->a", lower, y)
            return y, y

        def backward(x, given):
            y, upper = given
            x = y - small_einsum("ab,b->a", upper, x)
            return x, x

        none = jnp.zeros_like(r[0])
        _, y = jax.lax.scan(forward, none, (r, self.lower))
        _, x = jax.lax.scan(backward, none, (y, self.upper), reverse=True)
        x = jnp.moveaxis(x.reshape(count, pattern.group, q), 2, 0).reshape(q, -1)
        return static_take(x[:, :size], np.argsort(pattern.order)).reshape(shape)

    def absolute(self) -> AbstractLinearMap:
        """Return a map that estimates what the absolute values of the inverse do."""
        return _Estimated(self)

    def exceeds(self, sizes: Float[Array, " l"], number: float) -> BoolScalar:
        """Tell if a pivot is smaller than the sizes of its rows by more than `number`.

        The matrix is singular to round-off if so.
        """
        count, group = self.inverses.shape[0], self.pattern.group
        ordered = static_take(sizes, self.pattern.order)
        padded = jnp.pad(ordered, (0, count * group - sizes.shape[0]))
        rows = jnp.max(padded.reshape(count, group), axis=1)
        pivots = jnp.max(jnp.abs(self.inverses), axis=(1, 2))
        return ~jnp.all(pivots * rows <= number)


class _Estimated(AbstractLinearMap):
    """An estimate of |C⁻¹|, by products with C⁻¹ alone.

    For x >= 0, |C⁻¹| x is, entry by entry, the largest |C⁻¹ y| of all y that differ
    from x in signs alone. Two choices of signs stand for all of them. They are exact
    for the matrices of springs or rods in a row, whose inverse has entries of one sign,
    or of two that alternate.
    """

    map: BlockTridiagonalInverse

    def matvec(self, x: Float[Array, " l"]) -> Float[Array, " l"]:
        """Estimate |C⁻¹| x for sizes x."""
        signs = (-1.0) ** np.argsort(self.map.pattern.order)
        other = self.map.matvec(x * jnp.asarray(signs, x.dtype))
        return jnp.maximum(jnp.abs(self.map.matvec(x)), jnp.abs(other))

    def absolute(self) -> AbstractLinearMap:
        """Return the map of absolute values, which is the map itself."""
        return self


def block_tridiagonal_inverse(
    products: Float[Array, "q p c b l"], pattern: Pattern
) -> BlockTridiagonalInverse:
    """Factorise the matrix of which `products` holds what `couplings` computes.

    The entry for equation i at row a and unknown j at column b of a block is that of
    `products[i, j]`, combined from several couplings.
    """
    q, size, g = products.shape[0], products.shape[-1], pattern.group
    count = -(-size // (3 * g)) * 3
    ordered = static_take(products, pattern.order)
    ordered = jnp.pad(ordered, (*[(0, 0)] * 4, (0, count * g - size)))
    # Axes: equation, unknown, sum, column, block of three, which of the three, row.
    split = ordered.reshape(q, q, 3, g, count // 3, 3, g)

    def diagonal(offset):
        parts = [split[:, :, (r + offset) % 3, :, :, r] for r in range(3)]
        blocks = jnp.stack(parts, axis=4).reshape(q, q, g, count, g)
        return jnp.transpose(blocks, (3, 4, 0, 2, 1)).reshape(count, g * q, g * q)

    lower, middle, upper = map(diagonal, (-1, 0, 1))
    # The rows that fill the last blocks have equations of their own.
    filled = np.repeat(np.arange(count * g) >= size, q).reshape(count, g * q)
    unit = filled[:, :, None] * np.eye(g * q)
    middle = middle + jnp.asarray(unit, middle.dtype)

    def eliminate(before, given):
        lower, middle, upper = given
        pivot = inverse(middle - small_einsum("ab,bc->ac", lower, before))
        above = small_einsum("ab,bc->ac", pivot, upper)
        return above, (pivot, above)

    none = jnp.zeros_like(middle[0])
    _, (inverses, above) = jax.lax.scan(eliminate, none, (lower, middle, upper))
    below = small_einsum("kab,kbc->kac", inverses, lower)
    return BlockTridiagonalInverse(inverses, below, above, pattern)
