"""Matrices with few entries in each row, whose places are known at trace time."""

from collections.abc import Callable
from functools import reduce

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse
import scipy.sparse.csgraph
from jaxtyping import Array, Bool, Float

from ._contraction import AbstractLinearMap
from ._static_take import static_take


class Pattern:
    """The places of the entries of a matrix B, and what follows from them.

    - `columns`: entry e of row a is in column `columns[e, a]`, shape (w, l); where
        `present` is false there is none.
    - `rows`: entry e of column i is number `rows[e, i]` of the (w, l) entries.
    - `colours`: columns of one colour share no row, shape (n,).
    - `order`: rows in an order in which those that share columns are near each other,
        so that B K Bᵀ is block tridiagonal for a diagonal K, with `group` rows a block.
    """

    def __init__(self, entries: Bool[np.ndarray, "l n"]):
        self.key = entries.shape, np.packbits(entries).tobytes()
        self.shape = entries.shape
        self.columns, self.present = _listed(entries)
        where, self.holds = _listed(entries.T)
        # The number of an entry: its place among those of its row, and the row.
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
        return isinstance(other, Pattern) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


def _listed(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """List the columns of the entries of each row, of shape (w, l), and which exist."""
    counts = entries.sum(axis=1)
    width = max(int(counts.max()), 1)
    found = np.zeros((width, len(entries)), int)
    present = np.arange(width)[:, None] < counts[None]
    for a, row in enumerate(entries):
        found[: counts[a], a] = np.flatnonzero(row)
    return found, present


def _coloured(entries: np.ndarray) -> np.ndarray:
    """Give colours to columns, different ones to columns that share a row."""
    colours = np.full(entries.shape[1], -1)
    for i in range(entries.shape[1]):
        near = entries[entries[:, i]].any(axis=0)
        taken = set(colours[near]) - {-1}
        colours[i] = next(c for c in range(len(taken) + 1) if c not in taken)
    return colours


def _bandwidth(shared: scipy.sparse.csr_array, order: np.ndarray) -> int:
    place = np.argsort(order)
    first, second = shared.nonzero()
    return int(np.max(np.abs(place[first] - place[second]), initial=0))


def _raised(x: Array, other: Array) -> Array:
    """Give x as many axes as another array has, if it has fewer."""
    return jnp.expand_dims(x, range(max(other.ndim - x.ndim, 0)))


class SparseMatrix(AbstractLinearMap):
    """A matrix B, or several with the same places, by the entries of each row."""

    values: Float[Array, "... w l"]
    pattern: Pattern = eqx.field(static=True)

    def __getitem__(self, k: int | slice) -> "SparseMatrix":
        return SparseMatrix(self.values[k], self.pattern)

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


class WeightedTranspose(AbstractLinearMap):
    """The matrix diag(w) Bᵀ of a sparse matrix B, or several of them."""

    weights: Float[Array, " n"]
    matrix: SparseMatrix

    def __getitem__(self, k: int | slice) -> "WeightedTranspose":
        return WeightedTranspose(self.weights, self.matrix[k])

    def matvec(self, x: Float[Array, "... l"]) -> Float[Array, "... n"]:
        """Compute diag(w) Bᵀ x for vectors along the last axis."""
        product = self.matrix.rmatvec(x)
        return jnp.expand_dims(self.weights, range(product.ndim - 1)) * product

    def absolute(self) -> "WeightedTranspose":
        """Return the matrix of absolute values."""
        return WeightedTranspose(jnp.abs(self.weights), self.matrix.absolute())


def sparse_jacobian(
    function: Callable[[Array], Array], u: Float[Array, " n"], pattern: Pattern
) -> SparseMatrix:
    """Compute the Jacobian of a function whose dependences are those of `pattern`.

    One tangent serves for all columns of a colour (Curtis, Powell and Reid, 1974).
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
