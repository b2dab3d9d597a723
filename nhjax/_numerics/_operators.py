"""The matrices of a step as operators: dense, diagonal, sparse or block tridiagonal.

A step multiplies vectors by four kinds of matrices. Let u be the velocity or the
momentum p, N = ∂p/∂u, K the fibre Hessian (the mass matrix or its inverse), and B the
Jacobian of the constraints. Then the four matrices are N⁻¹, B, K⁻¹ Bᵀ and
(B K⁻¹ Bᵀ)⁻¹. Each of them is an `AbstractOperator`. The subclasses differ in how they
store the entries:

- `DenseMatrix` stores all entries, `DiagonalMatrix` only the diagonal.
- `SparseMatrix` stores the entries of a Jacobian B whose rows have few entries, in
  places that are known when the program is traced. `WeightedTranspose` is diag(w) Bᵀ.
- `BlockTridiagonalInverse` is the inverse of a block tridiagonal matrix such as B K⁻¹
  Bᵀ, stored as its factors.

Code outside this file does not check the class of an operator. It only calls methods.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import reduce
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._compile import vmapped
from .._custom_types import BoolScalar, FloatScalar
from ._contraction import small_einsum
from ._floating_point import max_norm
from ._inverse import inverse
from ._rank import is_nearly_singular
from ._sparsity import jacobian_sparsity


class AbstractOperator(eqx.Module):
    """A matrix, or a stack of matrices of the same shape."""

    @abstractmethod
    def matvec(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Multiply the vectors along the last axis of x by the matrix."""

    @abstractmethod
    def absolute(self) -> "AbstractOperator":
        """Return the matrix of absolute values, or an operator that estimates it."""

    @abstractmethod
    def as_matrix(self) -> Float[Array, "..."]:
        """Return all entries as an array, including zeros."""


class DenseMatrix(AbstractOperator):
    """A matrix, or a stack of matrices, stored with all entries."""

    entries: Float[Array, "... k n"]

    @property
    def pattern(self) -> None:
        """Return None, because only sparse matrices have a sparsity pattern."""
        return None

    @property
    def is_diagonal(self) -> bool:
        """Return whether only the diagonal is stored: False."""
        return False

    def __getitem__(self, k: int | slice) -> "DenseMatrix":
        """Return one matrix of a stack, or part of the stack."""
        return DenseMatrix(self.entries[k])

    def matvec(self, x: Float[Array, "... n"]) -> Float[Array, "... k"]:
        """Multiply the vectors along the last axis of x, which has at most four axes.

        In a stack of matrices, matrix j multiplies row j of x.
        """
        if self.entries.ndim == 3:
            return small_einsum("jkn,jn->jk", self.entries, x)
        rows = "abc"[: x.ndim - 1]
        return small_einsum(f"kn,{rows}n->{rows}k", self.entries, x)

    def rmatvec(self, y: Float[Array, " k"]) -> Float[Array, " n"]:
        """Multiply a vector by the transpose of the matrix."""
        return small_einsum("kn,k->n", self.entries, y)

    def absolute(self) -> "DenseMatrix":
        """Return the matrix of absolute values."""
        return DenseMatrix(jnp.abs(self.entries))

    def as_matrix(self) -> Float[Array, "... k n"]:
        """Return all entries as an array."""
        return self.entries

    def inverse(self) -> "DenseMatrix":
        """Invert a square matrix; the result is not finite if it has no inverse."""
        return DenseMatrix(inverse(self.entries))

    def is_definite(self) -> BoolScalar:
        """Return whether a symmetric matrix is positive or negative definite.

        The matrix is definite if all pivots of the elimination without row exchanges
        have the same sign.
        """
        rows = jnp.arange(self.entries.shape[0])

        def eliminate(k, carry):
            table, pivots = carry
            column = jax.lax.dynamic_index_in_dim(table, k, keepdims=False)
            pivot = jax.lax.dynamic_index_in_dim(column, k, keepdims=False)
            table = table - column[:, None] * (column / pivot)[None]
            return table, jnp.where(rows == k, pivot, pivots)

        given = self.entries, jnp.zeros_like(self.entries[0])
        _, pivots = jax.lax.fori_loop(0, len(rows), eliminate, given)
        return jnp.all(pivots > 0) | jnp.all(pivots < 0)

    def is_nearly_singular(
        self, left: AbstractOperator, right: AbstractOperator
    ) -> BoolScalar:
        """Return whether left @ right is singular up to round-off.

        `self` must be the computed inverse of this product.
        """
        factors = left.as_matrix(), right.as_matrix()
        return is_nearly_singular(small_einsum("kn,nl->kl", *factors), self.entries)

    def first_columns(self, count: int) -> "DenseMatrix":
        """Return the matrix of the first `count` columns."""
        return DenseMatrix(self.entries[..., :count])

    def weighted_transpose(self, weights: AbstractOperator) -> "DenseMatrix":
        """Compute W Bᵀ for symmetric weights W and each matrix B of this stack."""
        return DenseMatrix(jnp.swapaxes(weights.matvec(self.entries), -1, -2))

    def inverse_of_product(self, right: AbstractOperator) -> "DenseMatrix":
        """Compute the inverse of self @ right."""
        product = small_einsum("kn,nl->kl", self.entries, right.as_matrix())
        return DenseMatrix(inverse(product))

    def absolute_row_sums(self) -> Float[Array, " k"]:
        """Compute Σ_j |a_ij| for each row i."""
        return jnp.sum(jnp.abs(self.entries), axis=1)

    def largest_entry_bound(self) -> FloatScalar:
        """Return a bound of |a_ij|, here the largest |a_ij| itself."""
        return max_norm(self.entries)

    def max_norm_equivalent(self) -> "DenseMatrix":
        """Return a matrix A so that A x and self x have the same max norm for all x.

        If `self` has one column, A is a matrix of one entry, max |a_ij|.
        """
        if self.entries.shape[1] != 1:
            return self
        return DenseMatrix(max_norm(self.entries).reshape(1, 1))


class DiagonalMatrix(AbstractOperator):
    """A diagonal matrix, stored by its diagonal."""

    diagonal: Float[Array, " n"]

    @property
    def is_diagonal(self) -> bool:
        """Return whether only the diagonal is stored: True."""
        return True

    def matvec(self, x: Float[Array, "... n"]) -> Float[Array, "... n"]:
        """Multiply the vectors along the last axis of x by the matrix."""
        return jnp.expand_dims(self.diagonal, range(x.ndim - 1)) * x

    def absolute(self) -> "DiagonalMatrix":
        """Return the matrix of absolute values."""
        return DiagonalMatrix(jnp.abs(self.diagonal))

    def as_matrix(self) -> Float[Array, "n n"]:
        """Return all entries as an array, including zeros."""
        return jnp.diag(self.diagonal)

    def inverse(self) -> "DiagonalMatrix":
        """Invert the matrix; the result is not finite if there is no inverse."""
        return DiagonalMatrix(inverse(self.diagonal))

    def is_definite(self) -> BoolScalar:
        """Return whether the matrix is positive or negative definite."""
        return jnp.all(self.diagonal > 0) | jnp.all(self.diagonal < 0)

    def absolute_row_sums(self) -> Float[Array, " n"]:
        """Compute Σ_j |a_ij| for each row i."""
        return jnp.abs(self.diagonal)

    def largest_entry_bound(self) -> FloatScalar:
        """Return a bound of |a_ij|, here the largest |a_ij| itself."""
        return max_norm(self.diagonal)


class SparseMatrix(AbstractOperator):
    """A matrix B, or a stack of matrices with entries in the same places.

    Entry e of row a has the value `values[..., e, a]`.
    """

    values: Float[Array, "... w l"]
    pattern: "SparsityPattern" = eqx.field(static=True)

    def __getitem__(
        self, k: int | slice | tuple[slice | None, ...] | None
    ) -> "SparseMatrix":
        """Return one matrix of a stack, part of the stack, or a stack of one."""
        return SparseMatrix(self.values[k], self.pattern)

    def stacked_after(self, first: AbstractOperator) -> "SparseMatrix":
        """Return a stack of another matrix followed by the matrices of this stack."""
        assert isinstance(first, SparseMatrix)
        values = jnp.concatenate([first.values[None], self.values])
        return SparseMatrix(values, self.pattern)

    def matvec(self, x: Float[Array, "... n"]) -> Float[Array, "... l"]:
        """Compute B x for vectors along the last axis."""
        taken = [static_take(x, columns) for columns in self.pattern.columns]
        rows = [self.values[..., e, :] for e in range(len(taken))]
        return reduce(
            jnp.add,
            [_raised(row, x) * x for row, x in zip(rows, taken, strict=True)],
        )

    def rmatvec(self, y: Float[Array, "... l"]) -> Float[Array, "... n"]:
        """Compute Bᵀ y for vectors along the last axis."""
        y = y[..., None, :]
        products = _raised(self.values, y) * _raised(y, self.values)
        flat = products.reshape(*products.shape[:-2], -1)
        parts = []
        for index, holds in zip(self.pattern.rows, self.pattern.holds, strict=True):
            entries = static_take(flat, index)
            holds = np.expand_dims(holds, tuple(range(entries.ndim - 1)))
            parts.append(jnp.where(holds, entries, jnp.zeros_like(entries)))
        return reduce(jnp.add, parts)

    def absolute(self) -> "SparseMatrix":
        """Return the matrix of absolute values."""
        return SparseMatrix(jnp.abs(self.values), self.pattern)

    def as_matrix(self) -> Float[Array, "l n"]:
        """Return all entries as an array, including zeros; not defined for a stack."""
        return self.rmatvec(jnp.eye(self.pattern.shape[0], dtype=self.values.dtype))

    def weighted_transpose(self, weights: AbstractOperator) -> "WeightedTranspose":
        """Compute diag(w) Bᵀ for a diagonal matrix of weights."""
        assert isinstance(weights, DiagonalMatrix)
        return WeightedTranspose(weights.diagonal, self)

    def inverse_of_product(self, right: AbstractOperator) -> "BlockTridiagonalInverse":
        """Compute the inverse of B diag(w) Bᵀ, given diag(w) Bᵀ."""
        assert isinstance(right, WeightedTranspose)
        stack = right[None]
        products = compressed_products(stack.matrix, stack)
        return block_tridiagonal_inverse(products, self.pattern)

    def absolute_row_sums(self) -> Float[Array, " l"]:
        """Compute Σ_j |b_aj| for each row a."""
        return jnp.sum(jnp.abs(self.values), axis=0)


class WeightedTranspose(AbstractOperator):
    """The matrix diag(w) Bᵀ of a sparse matrix B, or of each matrix B of a stack."""

    weights: Float[Array, " n"]
    matrix: SparseMatrix

    def __getitem__(
        self, k: int | slice | tuple[slice | None, ...] | None
    ) -> "WeightedTranspose":
        """Return one matrix of a stack, part of the stack, or a stack of one."""
        return WeightedTranspose(self.weights, self.matrix[k])

    def matvec(self, x: Float[Array, "... l"]) -> Float[Array, "... n"]:
        """Compute diag(w) Bᵀ x for vectors along the last axis."""
        product = self.matrix.rmatvec(x)
        return jnp.expand_dims(self.weights, range(product.ndim - 1)) * product

    def absolute(self) -> "WeightedTranspose":
        """Return the matrix of absolute values."""
        return WeightedTranspose(jnp.abs(self.weights), self.matrix.absolute())

    def as_matrix(self) -> Float[Array, "n l"]:
        """Return all entries as an array, including zeros; not defined for a stack."""
        return self.weights[:, None] * self.matrix.as_matrix().T

    def first_columns(self, count: int) -> "WeightedTranspose":
        """Return self; `count` must be the number of all columns."""
        assert count == self.matrix.pattern.shape[0]
        return self

    def largest_entry_bound(self) -> FloatScalar:
        """Return a bound of the absolute values of the entries."""
        return max_norm(self.weights) * max_norm(self.matrix.values)

    def max_norm_equivalent(self) -> "WeightedTranspose":
        """Return self, as a matrix whose products have the same max norm."""
        return self


class BlockTridiagonalInverse(AbstractOperator):
    """The inverse of a block tridiagonal matrix, stored as factors of an elimination.

    There are q unknowns and q residuals for each of the l rows of the `pattern`, the
    `SparsityPattern` of B. Unknowns and residuals are arrays of shape (q, l), or
    vectors of length q l. The N blocks have g = q `pattern.group` unknowns each, and
    are eliminated from the first to the last. With the diagonal, lower and upper blocks
    D_k, L_k and U_k of block row k, and

    P_k = D_k - L_k P_{k-1}⁻¹ U_{k-1},

    `inverses` are P_k⁻¹, `lower` is P_k⁻¹ L_k and `upper` is P_k⁻¹ U_k. Rows are not
    exchanged between blocks. This elimination is stable if the matrix is close to a
    Kronecker product A ⊗ C of a small matrix A and a definite matrix C.
    """

    inverses: Float[Array, "N g g"]
    lower: Float[Array, "N g g"]
    upper: Float[Array, "N g g"]
    pattern: "SparsityPattern" = eqx.field(static=True)

    def matvec(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Multiply a residual x by the inverse matrix."""
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

    def absolute(self) -> AbstractOperator:
        """Return an operator that estimates products with the absolute values."""
        return _EstimatedAbsolute(self)

    def as_matrix(self) -> Float[Array, "c c"]:
        """Return all entries as an array, including zeros."""
        q = self.inverses.shape[1] // self.pattern.group
        unit_vectors = jnp.eye(q * self.pattern.shape[0], dtype=self.inverses.dtype)
        return jax.vmap(self.matvec, out_axes=1)(unit_vectors)

    def is_nearly_singular(
        self, left: AbstractOperator, right: AbstractOperator
    ) -> BoolScalar:
        """Return whether left @ right, whose inverse is `self`, is singular.

        The product counts as singular if a pivot is as small as the round-off of the
        diagonal entries of its rows. The two factors are B and diag(w) Bᵀ.
        """
        assert isinstance(left, SparseMatrix)
        assert isinstance(right, WeightedTranspose)
        squares = SparseMatrix(left.values**2, left.pattern)
        diagonal = jnp.abs(squares.matvec(right.weights))
        number = 1 / (10 * diagonal.shape[0] * float(jnp.finfo(diagonal.dtype).eps))
        count, group = self.inverses.shape[0], self.pattern.group
        ordered = static_take(diagonal, self.pattern.order)
        padded = jnp.pad(ordered, (0, count * group - diagonal.shape[0]))
        rows = jnp.max(padded.reshape(count, group), axis=1)
        pivots = jnp.max(jnp.abs(self.inverses), axis=(1, 2))
        return ~jnp.all(pivots * rows <= number)


class _EstimatedAbsolute(AbstractOperator):
    """An estimate of |C⁻¹|, the absolute values of an inverse, by products with C⁻¹.

    C⁻¹ is the field `map`. For x >= 0, entry i of |C⁻¹| x is the maximum of entry i of
    |C⁻¹ y| over all y that differ from x only in the signs of entries. The estimate
    uses two choices of signs. It is exact for the matrices of a chain of springs or
    rods: the entries of their inverses have the same sign, or signs that alternate.
    """

    map: BlockTridiagonalInverse

    def matvec(self, x: Float[Array, " l"]) -> Float[Array, " l"]:
        """Estimate |C⁻¹| x for x >= 0."""
        signs = (-1.0) ** np.argsort(self.map.pattern.order)
        other = self.map.matvec(x * jnp.asarray(signs, x.dtype))
        return jnp.maximum(jnp.abs(self.map.matvec(x)), jnp.abs(other))

    def absolute(self) -> AbstractOperator:
        """Return self, because products with x >= 0 are never negative."""
        return self

    def as_matrix(self) -> Float[Array, "l l"]:
        """Return the exact |C⁻¹| as an array."""
        return jnp.abs(self.map.as_matrix())


# A mass matrix, or its inverse.
SquareMatrix: TypeAlias = DenseMatrix | DiagonalMatrix
# The Jacobian B of constraints, the matrix K⁻¹ Bᵀ, and (B K⁻¹ Bᵀ)⁻¹.
JacobianMatrix: TypeAlias = DenseMatrix | SparseMatrix
ReactionMatrix: TypeAlias = DenseMatrix | WeightedTranspose
InverseMatrix: TypeAlias = DenseMatrix | BlockTridiagonalInverse


# Jacobians.


def square_jacobian(
    function: Callable[[Array], Array], u: Float[Array, " n"]
) -> SquareMatrix:
    """Compute ∂f_i/∂u_j as a diagonal matrix if each f_i depends on u_i alone.

    The mass matrices of most Lagrangians are diagonal, so that their products with
    vectors cost n instead of n² operations. Whether the Jacobian is diagonal is decided
    from the operations of the traced function and not from values. If the sparsity of
    an operation is not known, the Jacobian counts as dense.
    """

    def push(du):
        return jax.jvp(function, (u,), (du,))[1]

    found = jacobian_sparsity(function, u)
    if found.shape == (u.shape[0],) * 2 and not np.any(
        found & ~np.eye(len(u), dtype=bool)
    ):
        return DiagonalMatrix(push(jnp.ones_like(u)))
    return DenseMatrix(full_jacobian(function, u))


def full_jacobian(
    function: Callable[[Array], PyTree[Array]], u: Float[Array, " n"]
) -> PyTree[Array]:
    """Compute the derivatives of all results with respect to u, on their last axis."""

    def push(du):
        return jax.jvp(function, (u,), (du,))[1]

    return vmapped(push, _unit_vectors(u), out_axis=-1)


def jacobian_by_rows(
    function: Callable[[Array], Float[Array, " m"]], u: Float[Array, " n"]
) -> Float[Array, "m n"]:
    """Compute the Jacobian of a function by reverse differentiation."""
    values, pull = jax.vjp(function, u)
    return vmapped(
        lambda row: pull(row)[0], jnp.eye(values.shape[0], dtype=values.dtype)
    )


def _unit_vectors(u: Float[Array, " n"]) -> Float[Array, "n n"]:
    # The rows are made by padding, which saves time: `nhjax.lanes` omits products with
    # zeros that pad an array, even if the other factor may be infinite. It must keep
    # products with the zeros of `jnp.eye`.
    n, one, zero = u.shape[0], jnp.ones((1,), u.dtype), jnp.zeros((), u.dtype)
    rows = [jax.lax.pad(one, zero, [(k, n - 1 - k, 0)]) for k in range(n)]
    return jnp.stack(rows)


def sparse_jacobian(
    function: Callable[[Array], Array],
    u: Float[Array, " n"],
    pattern: "SparsityPattern",
) -> SparseMatrix:
    """Compute the Jacobian of a function with the sparsity pattern `pattern`.

    One tangent gives all columns of the same colour, because these columns have no row
    in common (Curtis, Powell and Reid, 1974).
    """
    number = int(pattern.colours.max()) + 1
    chosen = pattern.colours[None, :] == np.arange(number)[:, None]
    slopes = jax.vmap(lambda du: jax.jvp(function, (u,), (du,))[1])(
        jnp.asarray(chosen, u.dtype)
    )
    entries = []
    for columns, present in zip(pattern.columns, pattern.present, strict=True):
        colours, entry = pattern.colours[columns], jnp.zeros_like(slopes[0])
        for c in np.unique(colours[present]):
            entry = jnp.where(present & (colours == c), slopes[c], entry)
        entries.append(entry)
    return SparseMatrix(jnp.stack(entries), pattern)


# Patterns of sparse matrices.


class SparsityPattern:
    """The places of the entries of a sparse matrix B, and derived quantities.

    - `columns`: entry e of row a is in column `columns[e, a]`, shape (w, l), where w is
        the largest number of entries in a row; it exists where `present` is true.
    - `rows`: entry e of column i has the index `rows[e, i]` in the flattened array of
        (w, l) entries; it exists where `holds` is true.
    - `colours`: the colour of each column, shape (n,). Columns of the same colour have
        no row in common.
    - `order`: an order of the rows in which rows that share columns are near each
        other. In this order B diag(w) Bᵀ is block tridiagonal for any weights w, with
        `group` rows in each block.
    """

    def __init__(self, entries: Bool[np.ndarray, "l n"]):
        self.key = entries.shape, np.packbits(entries).tobytes()
        self.shape = entries.shape
        self.columns, self.present = _listed(entries)
        where, self.holds = _listed(entries.T)
        # The index of entry e of row a in the flattened array is e l + a.
        rank = np.cumsum(entries, axis=1) - 1
        columns = np.broadcast_to(np.arange(self.shape[1]), where.shape)
        self.rows = np.where(self.holds, rank[where, columns], 0) * len(entries) + where
        self.colours = _coloured(entries)
        shared = scipy.sparse.csr_array(
            (entries.astype(int) @ entries.T.astype(int)) > 0
        )
        natural = np.arange(len(entries))
        found = scipy.sparse.csgraph.reverse_cuthill_mckee(shared, symmetric_mode=True)
        orders = [natural, np.asarray(found, int)]
        self.group, best = min(
            (_bandwidth(shared, order), k) for k, order in enumerate(orders)
        )
        self.group = max(self.group, 1)
        self.order = orders[best]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SparsityPattern) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def _listed(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the columns of the entries of each row, and which entries exist.

    Both results have the shape (w, l).
    """
    counts = entries.sum(axis=1)
    width = max(int(counts.max()), 1)
    found = np.zeros((width, len(entries)), int)
    present = np.arange(width)[:, None] < counts[None]
    for a, row in enumerate(entries):
        found[: counts[a], a] = np.flatnonzero(row)
    return found, present


def _coloured(entries: np.ndarray) -> np.ndarray:
    """Colour the columns so that columns that share a row have different colours."""
    colours = np.full(entries.shape[1], -1)
    for i in range(entries.shape[1]):
        near = entries[entries[:, i]].any(axis=0)
        taken = set(colours[near]) - {-1}
        colours[i] = next(c for c in range(len(taken) + 1) if c not in taken)
    return colours


def _bandwidth(shared: "scipy.sparse.csr_array", order: np.ndarray) -> int:
    place = np.argsort(order)
    first, second = shared.nonzero()
    return int(np.max(np.abs(place[first] - place[second]), initial=0))


def _raised(x: Array, other: Array) -> Array:
    """Add leading axes to x, until it has as many axes as another array."""
    return jnp.expand_dims(x, range(max(other.ndim - x.ndim, 0)))


# Products of sparse matrices, which are block tridiagonal.


def compressed_products(
    left: SparseMatrix, right: WeightedTranspose
) -> Float[Array, "r s c b l"]:
    """Compute all products L_i diag(w) R_jᵀ of two stacks in compressed form.

    The products are block tridiagonal in the order of the pattern. Among all blocks
    of columns whose numbers are equal modulo three, each row therefore has entries in
    at most one block, so that the columns of these blocks can be added. Entry
    [i, j, c, b, a] of the result is the entry of product (i, j) in row a and in column
    b of the block whose number is c modulo three.
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
    pushed = right[:, None].matvec(seeds[None])
    found = left[:, None, None].matvec(pushed[None])
    return found.reshape(*found.shape[:2], 3, pattern.group, -1)


def block_tridiagonal_inverse(
    products: Float[Array, "q q c b l"], pattern: SparsityPattern
) -> BlockTridiagonalInverse:
    """Factorise a matrix in the compressed form of `compressed_products`.

    The matrix has q equations and q unknowns for each row of the pattern. The entries
    for equation i and unknown j are in `products[i, j]`, which may be a linear
    combination of several products.
    """
    q, size, g = products.shape[0], products.shape[-1], pattern.group
    count = -(-size // (3 * g)) * 3
    ordered = static_take(products, pattern.order)
    ordered = jnp.pad(ordered, (*[(0, 0)] * 4, (0, count * g - size)))
    # The axes of `split`: equation, unknown; for the column, its block number modulo
    # three and its place in the block; for the row, its group of three blocks, its
    # block inside the group, and its place in the block.
    split = ordered.reshape(q, q, 3, g, count // 3, 3, g)

    def diagonal(offset):
        parts = [split[:, :, (r + offset) % 3, :, :, r] for r in range(3)]
        blocks = jnp.stack(parts, axis=4).reshape(q, q, g, count, g)
        return jnp.transpose(blocks, (3, 4, 0, 2, 1)).reshape(count, g * q, g * q)

    lower, middle, upper = map(diagonal, (-1, 0, 1))
    # The rows that fill up the last blocks get the equation x = 0.
    filled = np.repeat(np.arange(count * g) >= size, q).reshape(count, g * q)
    ones = filled[:, :, None] * np.eye(g * q)
    middle = middle + jnp.asarray(ones, middle.dtype)

    def eliminate(before, given):
        lower, middle, upper = given
        pivot = inverse(middle - small_einsum("ab,bc->ac", lower, before))
        above = small_einsum("ab,bc->ac", pivot, upper)
        return above, (pivot, above)

    none = jnp.zeros_like(middle[0])
    _, (inverses, above) = jax.lax.scan(eliminate, none, (lower, middle, upper))
    below = small_einsum("kab,kbc->kac", inverses, lower)
    return BlockTridiagonalInverse(inverses, below, above, pattern)


# Elements of an array at places that are known when the program is traced.

# An array is composed of at most this many slices, to keep the program short.
_MOST_PIECES = 16
_PERIODS = (1, 2, 3, 4, 6)


def static_take(x: Array, index: Int[np.ndarray, " k"]) -> Array:
    """Compute `x[..., index]` for known indices, by slices if a few slices are enough.

    The indices of regular structures are arithmetic sequences, or a few interleaved
    arithmetic sequences. A slice can be part of a kernel; an indexed read cannot.
    """
    if np.array_equal(index, np.arange(x.shape[-1])):
        return x
    best: tuple[int, list[list[np.ndarray]]] | None = None
    for period in _PERIODS:
        if len(index) % period:
            continue
        turns = [_runs(index[r::period]) for r in range(period)]
        count = sum(map(len, turns))
        if best is None or count < best[0]:
            best = count, turns
    if best is None or best[0] > _MOST_PIECES:
        return x[..., jnp.asarray(index)]
    parts = [
        jnp.concatenate([_piece(x, run) for run in runs], axis=-1) for runs in best[1]
    ]
    if len(parts) == 1:
        return parts[0]
    return jnp.stack(parts, axis=-1).reshape(*x.shape[:-1], len(index))


def _runs(index: Sequence[int] | np.ndarray) -> list[np.ndarray]:
    """Cut a sequence of indices into arithmetic sequences."""
    runs, start = [], 0
    while start < len(index):
        end = start + 1
        while end < len(index) and (
            end == start + 1
            or index[end] - index[end - 1] == index[start + 1] - index[start]
        ):
            end += 1
        # Slices only go forward: if the indices decrease, the run ends after one index.
        if end > start + 1 and index[start + 1] < index[start]:
            end = start + 1
        runs.append(np.asarray(index[start:end]))
        start = end
    return runs


def _piece(x: Array, run: np.ndarray) -> Array:
    first, count = int(run[0]), len(run)
    step = int(run[1] - run[0]) if count > 1 else 1
    if step == 0:
        return jnp.broadcast_to(x[..., first : first + 1], (*x.shape[:-1], count))
    last = first + (count - 1) * step + 1
    return jax.lax.slice_in_dim(x, first, last, step, axis=x.ndim - 1)
