"""Products and inverses of small matrices, written in elementary operations.

For matrices of a few rows, calling a library of linear algebra is too expensive. Inside
a time loop the calls cost more than the arithmetic. The calls cannot be compiled into
one kernel with the operations around them, and a batch of calls runs one by one. Up to
a limit of size, `small_einsum` and `inverse` consist of elementary operations.
`with_small_products` replaces the products in the functions of a user by
`small_einsum`.
"""

import math
import string
from collections.abc import Callable
from functools import reduce
from typing import Any

import jax
import jax.extend
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree, Shaped

from .._compile import LONGEST_SUM, small_product
from ..lanes import LARGEST_REDUCTION


# A library computes products with more terms than this, so that the program stays
# short. It also computes products with more than `LARGEST_REDUCTION` terms if each sum
# is longer than `LONGEST_SUM`. From about 10⁵ terms on the library was faster
# (measured).
LARGEST_PRODUCT = 2**15
# Matrices with more rows than this are inverted by a library.
LARGEST = 50


def small_einsum(subscripts: str, a: Array, b: Array) -> Array:
    """Compute `jnp.einsum(subscripts, a, b)`; small products are elementary operations.

    Each index that is summed must be in both operands.
    """
    operands, result = subscripts.split("->")
    first, second = operands.split(",")
    params = _small_product(first, second, result, a.shape, b.shape)
    if params is None:
        return jnp.einsum(subscripts, a, b)
    both = isinstance(a, jax.Array) and isinstance(b, jax.Array)
    if not both or a.dtype != b.dtype:
        dtype = jnp.result_type(a, b)
        a, b = jnp.asarray(a, dtype), jnp.asarray(b, dtype)
    return small_product.bind(a, b, **params)


def _small_product(
    first: str, second: str, result: str, a: tuple[int, ...], b: tuple[int, ...]
) -> dict[str, Any] | None:
    """Return the parameters for `small_product`, or None if the product is large."""
    lengths = dict(zip(first, a, strict=True))
    for index, length in zip(second, b, strict=True):
        if lengths.setdefault(index, length) != length:
            raise ValueError(f"Shapes {a} and {b} do not fit {first},{second}.")
    size = math.prod(lengths.values())
    summed = math.prod(n for index, n in lengths.items() if index not in result)
    by_terms = size > LARGEST_REDUCTION
    if by_terms and (summed > LONGEST_SUM or size > LARGEST_PRODUCT):
        return None
    return {"first": first, "second": second, "result": result, "by_terms": by_terms}


def _contract_axes(dimension_numbers, a: Array, b: Array) -> Array:
    """Compute `jax.lax.dot_general` with these dimension numbers by `small_einsum`."""
    (summed_a, summed_b), (batch_a, batch_b) = dimension_numbers
    letters = iter(string.ascii_letters)
    first = [next(letters) for _ in a.shape]
    second = [next(letters) for _ in b.shape]
    for i, j in zip((*batch_a, *summed_a), (*batch_b, *summed_b), strict=True):
        second[j] = first[i]
    batch = [first[i] for i in batch_a]
    free = [first[i] for i in range(a.ndim) if i not in (*batch_a, *summed_a)]
    free += [second[j] for j in range(b.ndim) if j not in (*batch_b, *summed_b)]
    subscripts = f"{''.join(first)},{''.join(second)}->{''.join(batch + free)}"
    return small_einsum(subscripts, a, b)


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

    Because of its name, `nhjax.lanes` compiles this function once for all matrices of
    the same size.
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
    # A kernel must not sum more numbers than `LARGEST_REDUCTION` at once.
    most = max(LARGEST_REDUCTION // rows.shape[1], 1)
    parts = [rows[k : k + most] for k in range(0, rows.shape[0], most)]
    return reduce(jnp.add, [jnp.sum(part, axis=0) for part in parts])


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
    blocks dominate. It is also stable if the matrix is close to a Kronecker product
    A ⊗ C with n rows in C, and eliminating A without row exchanges is stable. The
    elimination is a loop over blocks, so that the program is short and the matrix may
    be larger than for `inverse`.
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
    This function is slower than a library from about 100 rows on. Like `mapped`, it has
    no derivative in reverse mode.
    """
    size = matrix.shape[0]
    numbers = jnp.arange(size, dtype=jnp.int32)
    table = mapped(
        lambda i: jnp.concatenate([_taken(matrix, i), _taken(rights, i)]), numbers
    )

    def entry(table, i, k):
        return jax.lax.dynamic_slice(table, (i, k), (1, 1))[0, 0]

    def eliminate(k, table):
        def compare(i, found):
            best, largest = found
            value = jnp.abs(entry(table, i, k))
            is_larger = (i >= k) & (value > largest)
            return jnp.where(is_larger, i, best), jnp.where(is_larger, value, largest)

        none = -jnp.ones((), table.dtype)
        best, _ = repeated(size, compare, (k, none))
        pivot_row, row = _taken(table, best), _taken(table, k)
        table = _put(_put(table, row, best), pivot_row / entry(table, best, k), k)
        scaled = _taken(table, k)

        def reduce_row(offset, table):
            i = k + 1 + offset
            factor = entry(table, i, k)
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


def _put(x: Array, row: Array, k: Array) -> Array:
    return jax.lax.dynamic_update_index_in_dim(x, row, k, 0)


def with_small_products(program: Any) -> Callable[..., list[Any]]:
    """Return the function of a jaxpr, with small matrix products written out."""

    def run(*args):
        return _evaluated(program.jaxpr, program.consts, args)

    return run


def _evaluated(program, consts, args):
    values = dict(zip(program.constvars, consts, strict=True))
    values |= zip(program.invars, args, strict=True)

    def read(variable):
        is_literal = isinstance(variable, jax.extend.core.Literal)
        return variable.val if is_literal else values[variable]

    for equation in program.eqns:
        name, params = equation.primitive.name, equation.params
        inputs = [read(variable) for variable in equation.invars]
        if name == "dot_general" and _is_plain(equation):
            out = [
                _contract_axes(params["dimension_numbers"], *map(jnp.asarray, inputs))
            ]
        elif name == "jit":
            inner = params["jaxpr"]
            out = _evaluated(inner.jaxpr, inner.consts, inputs)
        else:
            primitive = equation.primitive
            bound = primitive.get_bind_params(params)
            # Earlier releases of JAX return functions separately from the other
            # parameters.
            functions, params = bound if isinstance(bound, tuple) else ((), bound)
            out = primitive.bind(*functions, *inputs, **params)
            out = out if primitive.multiple_results else [out]
        values |= zip(equation.outvars, out, strict=True)
    return [read(variable) for variable in program.outvars]


def _is_plain(equation) -> bool:
    """Return whether a product and its factors have the same floating dtype."""
    types = {variable.aval.dtype for variable in (*equation.invars, *equation.outvars)}
    return len(types) == 1 and jnp.issubdtype(types.pop(), jnp.inexact)
