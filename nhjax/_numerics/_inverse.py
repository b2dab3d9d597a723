"""Inverses of small matrices, and loops over their rows, in elementary operations.

For matrices of a few rows, calling a library of linear algebra inside a time loop is
too expensive, as it is for products (`_contraction`). All functions here therefore
consist of elementary operations; only `inverse` calls a library, for matrices with more
than `LARGEST` rows. Loops keep the program short: its length does not grow with the
number of blocks of a matrix, and in most functions not with the number of rows.
"""

from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import batching, mlir
from jaxtyping import Array, Float, PyTree, Shaped

from ..lanes import LARGEST_REDUCTION, never_high, SMALL_INVERSE
from ._contraction import LARGEST_PRODUCT, small_einsum


# Matrices with more rows than this are inverted by a library.
LARGEST = 50
# In `nhjax.lanes`, matrices with at least this many rows are inverted row by row. For
# 36 rows the program then compiles 17 times as fast as with operations on the whole
# matrix, and runs 3 times as fast. Below this limit, both run equally fast.
_BY_ROWS_FROM = 8


@jax.custom_jvp
def inverse(matrix: Float[Array, "n *n"]) -> Float[Array, "n *n"]:
    """Invert a small matrix; the result is not finite if there is no inverse.

    An array with one axis is the diagonal of a diagonal matrix. Then the result is the
    diagonal of the inverse.
    """
    size = matrix.shape[0]
    # Systems with one constraint are the most common. Their matrix has size 1.
    if matrix.ndim == 1 or size == 1:
        return 1 / matrix
    if size == 0:
        return matrix
    if size > LARGEST:
        return jnp.linalg.inv(matrix)
    if size >= _BY_ROWS_FROM:
        program = jax.make_jaxpr(compiled_once_inverse)(matrix)
        return _small_inverse.bind(matrix, program=program)
    return compiled_once_inverse(matrix)


@inverse.defjvp
def _inverse_jvp(primals, tangents):
    (matrix,), (rate,) = primals, tangents
    x = inverse(matrix)
    if matrix.ndim == 1:
        return x, -x * rate * x
    return x, -small_einsum("ij,jk->ik", small_einsum("ij,jk->ik", x, rate), x)


@jax.jit
def compiled_once_inverse(matrix: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Invert a matrix by Gauss-Jordan elimination in place, with row pivoting.

    `nhjax.lanes` recognises this function by its name, and compiles it once for all
    matrices of the same size if they have fewer than `_BY_ROWS_FROM` rows.
    """
    rows = jnp.arange(matrix.shape[0])

    def at(x, k):
        return jax.lax.dynamic_index_in_dim(x, k, keepdims=False)

    def eliminate(k, carry):
        table, order = carry
        column, row = at(table.T, k), at(table, k)
        best = jnp.argmax(jnp.where(rows >= k, jnp.abs(column), -1))
        # Rows are selected by masks: an index that differs between the members of a
        # batch would need gather and scatter operations.
        is_k, is_pivot = rows == k, rows == best
        pivot_row = _sum_of_rows(jnp.where(is_pivot[:, None], table, 0))
        pivot = at(pivot_row, k)
        scaled = jnp.where(is_k, 1 / pivot, pivot_row / pivot)
        # Exchange the rows k and `best`.
        column = jnp.where(is_pivot, at(column, k), column)
        table = jnp.where(is_pivot[:, None], row[None], table)
        place = jnp.sum(jnp.where(is_pivot, order, 0))
        order = jnp.where(is_pivot, at(order, k), order)
        # Replace column k by the column of the inverse.
        table = jnp.where(is_k[None], 0, table) - column[:, None] * scaled[None]
        table = jnp.where(is_k[:, None], scaled[None], table)
        return table, jnp.where(is_k, place, order)

    table, order = jax.lax.fori_loop(0, len(rows), eliminate, (matrix, rows))
    places = (order[:, None] == rows[None]).astype(matrix.dtype)
    if matrix.size * len(rows) <= LARGEST_PRODUCT:
        return small_einsum("ij,jk->ik", table, places)

    def put_column(k, out):
        return out + at(table.T, k)[:, None] * at(places, k)[None]

    return jax.lax.fori_loop(0, len(rows), put_column, jnp.zeros_like(matrix))


def _sum_of_rows(rows: Float[Array, "k n"]) -> Float[Array, " n"]:
    # `nhjax.lanes` must not sum more numbers than `LARGEST_REDUCTION` at once.
    most = max(LARGEST_REDUCTION // rows.shape[1], 1)
    parts = [rows[k : k + most] for k in range(0, rows.shape[0], most)]
    return reduce(jnp.add, [jnp.sum(part, axis=0) for part in parts])


# An inverse with at least `_BY_ROWS_FROM` rows is one operation until it is lowered. In
# XLA, each operation in a loop is expensive. XLA therefore runs the parameter
# `program`, which consists of operations on the whole matrix. `nhjax.lanes` replaces
# the operation by its traced implementation, which loops over rows.
_small_inverse = jax.extend.core.Primitive(SMALL_INVERSE)
_small_inverse.is_high = never_high


@_small_inverse.def_impl
def _implementation(matrix: Array, *, program: Any) -> Array:
    if isinstance(matrix, jax.core.Tracer):
        return _inverse_by_rows(matrix)
    return _by_program(matrix, program=program)


def _by_program(matrix: Array, *, program: Any) -> Array:
    return jax.extend.core.jaxpr_as_fun(program)(matrix)[0]


def _inverse_by_rows(matrix: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Compute the same inverse as `compiled_once_inverse`, in loops over single rows.

    `nhjax.lanes` cannot compile this function as a separate function, whose arguments
    would be single numbers, because this function keeps its matrices in memory.
    """
    size = matrix.shape[0]
    numbers = jnp.arange(size, dtype=jnp.int32)

    def eliminate(k, carry):
        table, order = carry

        def compare(offset, found):
            _, _, largest, _ = found
            i = k + offset
            value = _entry(table, i, k)
            # As in `argmax`, NaN counts as the largest magnitude.
            is_larger = ~(jnp.abs(value) <= largest) & ~jnp.isnan(largest)
            new = i, value, jnp.abs(value), _taken(table, i)
            return jax.tree.map(lambda x, y: jnp.where(is_larger, x, y), new, found)

        row = _taken(table, k)
        none = -jnp.ones((), table.dtype)
        found = k, none, none, jnp.zeros_like(row)
        best, pivot, _, pivot_row = repeated(size - k, compare, found)
        is_k, is_pivot = numbers == k, numbers == best
        scaled = jnp.where(is_k, 1 / pivot, pivot_row / pivot)
        place = jnp.sum(jnp.where(is_pivot, order, 0), dtype=order.dtype)
        order = jnp.where(is_pivot, _taken(order, k), order)
        order = jnp.where(is_k, place, order)
        first = _entry(table, k, k)

        def reduce_row(i, table):
            # Exchange the rows k and `best`.
            factor = jnp.where(i == best, first, _entry(table, i, k))
            rest = jnp.where(i == best, row, _taken(table, i))
            # Replace column k by the column of the inverse.
            reduced = jnp.where(is_k, 0, rest) - factor * scaled
            return _put(table, jnp.where(i == k, scaled, reduced), i)

        return repeated(size, reduce_row, table), order

    table, order = repeated(size, eliminate, (matrix, numbers))

    def in_place(i):
        def add(k, row):
            is_place = _taken(order, k) == numbers
            return row + jnp.where(is_place, _entry(table, i, k), 0)

        return repeated(size, add, jnp.zeros_like(table[0]))

    return mapped(in_place, numbers)


@_small_inverse.def_abstract_eval
def _shape(matrix: Any, *, program: Any) -> Any:
    return program.out_avals[0]


def _batched(operands: Any, axes: Any, *, program: Any) -> tuple[Array, int]:
    del program
    return jax.vmap(compiled_once_inverse, axes)(*operands), 0


batching.primitive_batchers[_small_inverse] = _batched
mlir.register_lowering(
    _small_inverse, mlir.lower_fun(_by_program, multiple_results=False)
)


def mapped(
    function: Callable[[Array], PyTree[Array]], rows: Shaped[Array, "k *n"]
) -> PyTree[Array]:
    """Apply a function to each row, in a loop that is never unrolled.

    Unlike `jax.lax.map`, this function has no derivative in reverse mode.
    """
    shapes = jax.eval_shape(function, rows[0])
    empty = jax.tree.map(
        lambda one: jnp.zeros((rows.shape[0], *one.shape), one.dtype), shapes
    )

    def put_row(k, found):
        row = function(_taken(rows, k))
        return jax.tree.map(lambda all_rows, x: _put(all_rows, x, k), found, row)

    return repeated(rows.shape[0], put_row, empty)


def inverses(matrices: Float[Array, "k n n"]) -> Float[Array, "k n n"]:
    """Invert a stack of small matrices, one after the other."""
    return mapped(inverse, matrices)


def inverse_by_blocks(matrix: Float[Array, "s n s n"]) -> Float[Array, "s n s n"]:
    """Invert a matrix of s x s blocks by Gauss-Jordan elimination of blocks.

    Rows are exchanged only within a block. The elimination is stable if the diagonal
    blocks dominate. It is also stable if the matrix is close to a Kronecker product A ⊗
    C, where C has n rows and A can be eliminated stably without row exchanges. The
    elimination is a loop over blocks, so that the program is short even if the matrix
    has more than `LARGEST` rows.
    """
    s = matrix.shape[0]

    def eliminate(k, table):
        row = _taken(table, k)
        is_k = (jnp.arange(s, dtype=k.dtype) == k)[None, :, None]
        pivot = inverse(jax.lax.dynamic_index_in_dim(row, k, 1, keepdims=False))
        scaled = small_einsum("ab,bjc->ajc", pivot, row)
        scaled = jnp.where(is_k, pivot[:, None, :], scaled)

        def reduce_row(i, table):
            row = _taken(table, i)
            factor = jax.lax.dynamic_index_in_dim(row, k, 1, keepdims=False)
            reduced = small_einsum("ab,bjc->ajc", factor, scaled)
            reduced = jnp.where(is_k, 0, row) - reduced
            return _put(table, jnp.where(i == k, scaled, reduced), i)

        return repeated(s, reduce_row, table)

    return repeated(s, eliminate, matrix)


def solve_by_rows(
    matrix: Float[Array, "k k"], rights: Float[Array, "k r"]
) -> Float[Array, "k r"]:
    """Solve linear equations by Gaussian elimination with partial pivoting.

    All loops go over single rows, so that the program is short and calls no library.
    From about 100 rows on, a library is faster. Like `mapped`, this function has no
    derivative in reverse mode.
    """
    size = matrix.shape[0]
    numbers = jnp.arange(size, dtype=jnp.int32)
    table = mapped(
        lambda i: jnp.concatenate([_taken(matrix, i), _taken(rights, i)]), numbers
    )

    def eliminate(k, table):
        def compare(i, found):
            best, largest = found
            value = jnp.abs(_entry(table, i, k))
            is_larger = (i >= k) & (value > largest)
            return jnp.where(is_larger, i, best), jnp.where(is_larger, value, largest)

        none = -jnp.ones((), table.dtype)
        best, _ = repeated(size, compare, (k, none))
        pivot_row, row = _taken(table, best), _taken(table, k)
        table = _put(_put(table, row, best), pivot_row / _entry(table, best, k), k)
        scaled = _taken(table, k)

        def reduce_row(offset, table):
            i = k + 1 + offset
            factor = _entry(table, i, k)
            return _put(table, _taken(table, i) - factor * scaled, i)

        return repeated(size - 1 - k, reduce_row, table)

    table = repeated(size, eliminate, table)

    def substitute(offset, x):
        i = size - 1 - offset
        row = _taken(table, i)
        # The rows of x that are not computed yet are zero.
        known = small_einsum("j,jr->r", row[:size], x)
        return _put(x, row[size:] - known, i)

    return repeated(size, substitute, jnp.zeros_like(rights))


def repeated(count: int | Array, body: Callable[[Array, Any], Any], carry: Any) -> Any:
    # Unlike a `fori_loop`, this loop has no derivative in reverse mode, and
    # `nhjax.lanes` never unrolls it.
    def step(given):
        k, carry = given
        return k + 1, body(k, carry)

    start = jnp.zeros((), jnp.int32), carry
    return jax.lax.while_loop(lambda given: given[0] < count, step, start)[1]


def _taken(x: Array, k: Array) -> Array:
    return jax.lax.dynamic_index_in_dim(x, k, keepdims=False)


def _entry(x: Array, i: Array, k: Array) -> Array:
    return jax.lax.dynamic_slice(x, (i, k), (1, 1))[0, 0]


def _put(x: Array, row: Array, k: Array) -> Array:
    return jax.lax.dynamic_update_index_in_dim(x, row, k, 0)
