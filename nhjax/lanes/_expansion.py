"""Operations that are replaced by programs of simpler operations before compilation.

Factorisations of small matrices are written out, since XLA calls a library for them.
Under `vmap`, a loop can have a condition for each member. Such a loop is replaced by a
loop with a single condition. Operations of other libraries, such as equinox's
operations for loops, are replaced by the program of their implementation. JAX runs this
implementation if such an operation is called outside of transformations.
"""

import math
from collections.abc import Callable, Container
from functools import lru_cache, partial
from typing import Any

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jax.extend.core.primitives import closed_call_p


# Matrices with more rows than this are left to XLA, which calls LAPACK.
MOST_ROWS = 32
# With more rows, LAPACK computes singular values in less time than the written-out
# program, and compiling a call of LAPACK takes less time too.
_MOST_ROWS_OF_SINGULAR_VALUES = 12
# Stacks of more matrices than this are left to XLA too, because the written-out program
# would be long.
_MOST_MEMBERS = 16
# Operations with this name have a method `to_lojax`, by which JAX expands them.
_EXPANDED_BY_JAX = "call_hi_primitive"


def expanded(program: Any, known: Container[str]) -> Any:
    """Replace operations of a closed jaxpr, and of its inner programs, where possible.

    The program is returned unchanged if no operation is replaced.

    **Arguments:**

    - `program`: the closed jaxpr.
    - `known`: the names of the operations that the compiler knows.
    """
    return _Expander(known).program(program)


class _Expander:
    """Replaces operations; a program that occurs several times is expanded once.

    `stays` are the names of operations that are not replaced by their implementations.
    """

    def __init__(self, stays: Container[str]):
        self._stays = stays
        # Programs are found by their `id`. The original program is stored too: if it
        # were freed, another object could get its `id`.
        self._known: dict[int, tuple[Any, Any]] = {}

    def program(self, program: Any) -> Any:
        """Expand an open or closed jaxpr."""
        if id(program) not in self._known:
            whole = self._expanded(program)
            self._known[id(program)] = program, whole
        return self._known[id(program)][1]

    def _expanded(self, program: Any) -> Any:
        jaxpr = getattr(program, "jaxpr", program)
        equations = list(map(self._equation, jaxpr.eqns))
        if all(a is b for a, b in zip(equations, jaxpr.eqns, strict=True)):
            return program
        jaxpr = jaxpr.replace(eqns=equations)
        return program.replace(jaxpr=jaxpr) if hasattr(program, "jaxpr") else jaxpr

    def _equation(self, equation: Any) -> Any:
        inner = self._program_of(equation)
        if inner is not None:
            params = {"call_jaxpr": self.program(inner)}
            return equation.replace(primitive=closed_call_p, params=params)
        params = {
            name: jax.tree.map(self._value, value) if _holds_programs(value) else value
            for name, value in equation.params.items()
        }
        if all(params[name] is equation.params[name] for name in params):
            return equation
        return equation.replace(params=params)

    def _program_of(self, equation: Any) -> Any:
        """Return a program that replaces an operation, or `None` if there is none."""
        primitive, params = equation.primitive, equation.params
        if primitive.name in _EXPANSIONS:
            applies, function = _EXPANSIONS[primitive.name]
            if applies(equation):
                return _expansion(function, equation)
        if primitive.name == _EXPANDED_BY_JAX:
            return _traced(partial(primitive.to_lojax, **params), equation)
        if primitive.name in self._stays or not is_foreign(primitive):
            return None
        program = _traced(partial(primitive.impl, **params), equation)
        if program is None or _contains(program.jaxpr, primitive):
            return None
        return program

    def _value(self, value: Any) -> Any:
        return self.program(value) if _is_program(value) else value


def _is_program(value: Any) -> bool:
    return hasattr(getattr(value, "jaxpr", value), "eqns")


def _holds_programs(value: Any) -> bool:
    return _is_program(value) or (
        isinstance(value, tuple) and any(map(_is_program, value))
    )


def is_foreign(primitive: Any) -> bool:
    """Return whether a library other than JAX has defined an operation.

    An operation of JAX is implemented by a function in a module of JAX, which compiles
    and runs the operation.
    """
    implementation = primitive.impl
    while isinstance(implementation, partial):
        implementation = implementation.func
    module = getattr(implementation, "__module__", None) or "jax"
    return module.partition(".")[0] != "jax"


def _expansion(function: Callable[..., Any], equation: Any) -> Any:
    """Trace `function(*operands, **params)`; return `None` if this fails."""
    params = equation.params
    if any(map(_holds_programs, params.values())):
        return _traced(partial(function, **params), equation)
    return _known_program(function, tuple(params.items()), *_kinds(equation))


@lru_cache(maxsize=1000)
def _known_program(
    function: Callable[..., Any], params: tuple[Any, ...], *kinds: Any
) -> Any:
    # Traced programs are cached, because tracing a factorisation takes longer than
    # tracing most functions that contain it.
    return _program(partial(function, **dict(params)), *kinds)


def _traced(function: Callable[..., Any], equation: Any) -> Any:
    """Trace `function` on the operands of an operation; return `None` if this fails."""
    return _program(function, *_kinds(equation))


def _kinds(equation: Any) -> tuple[Any, Any]:
    """Return the shapes and dtypes of the operands, and of the results."""
    operands, results = [x.aval for x in equation.invars], equation.outvars
    return (
        tuple((x.shape, x.dtype, x.weak_type) for x in operands),
        tuple((x.aval.shape, x.aval.dtype) for x in results),
    )


def _program(function: Callable[..., Any], operands: Any, results: Any) -> Any:
    args = [
        jax.ShapeDtypeStruct(shape, dtype, weak_type=weak_type)
        for shape, dtype, weak_type in operands
    ]
    try:
        program = jax.make_jaxpr(function)(*args)
    except Exception:
        # The code of another library may need concrete values, or call code that JAX
        # cannot trace. The factorisations of this file fail for matrices without rows.
        return None
    found = tuple((x.shape, x.dtype) for x in program.out_avals)
    return program if found == results else None


def _contains(jaxpr: Any, primitive: Any) -> bool:
    """Return whether a jaxpr or one of its inner programs contains `primitive`."""
    for equation in jaxpr.eqns:
        if equation.primitive is primitive:
            return True
        for value in jax.tree.leaves(list(equation.params.values())):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns") and _contains(inner, primitive):
                return True
    return False


def _for_each(function: Callable[..., Any], rank: int) -> Callable[..., Any]:
    """Return `function`, vectorised over the leading axes of its operands.

    `rank` is the number of the remaining axes of the first operand.
    """

    def run(*operands: Any, **params: Any) -> Any:
        one = partial(function, **params)
        for _ in range(operands[0].ndim - rank):
            one = jax.vmap(one)
        return one(*operands)

    return run


def _is_small_matrix(equation: Any) -> bool:
    """Return whether the first operand consists of a few small real matrices."""
    shape = equation.invars[0].aval.shape
    is_real = jnp.issubdtype(equation.invars[0].aval.dtype, jnp.floating)
    is_small = len(shape) >= 2 and max(shape[-2:]) <= MOST_ROWS
    return is_real and is_small and math.prod(shape[:-2]) <= _MOST_MEMBERS


def _is_symmetric_problem(equation: Any) -> bool:
    return _is_small_matrix(equation) and equation.params["subset_by_index"] is None


def _has_only_singular_values(equation: Any) -> bool:
    """Return whether an operation computes only singular values of small matrices."""
    params, shape = equation.params, equation.invars[0].aval.shape
    return (
        _is_small_matrix(equation)
        and min(shape[-2:]) <= _MOST_ROWS_OF_SINGULAR_VALUES
        and params["subset_by_index"] is None
        and not params["compute_uv"]
    )


def _lu(a: Any, **_: Any) -> tuple[Any, Any, Any]:
    """Factorise with row exchanges, like LAPACK's `getrf`.

    The results are both factors in one matrix, the exchanges and the permutation.
    """
    rows = list(a)
    order = [jnp.int32(k) for k in range(len(rows))]
    pivots = []
    for k in range(min(a.shape)):
        place, largest = jnp.int32(k), jnp.abs(rows[k][k])
        for i in range(k + 1, len(rows)):
            is_larger = jnp.abs(rows[i][k]) > largest
            place = jnp.where(is_larger, jnp.int32(i), place)
            largest = jnp.where(is_larger, jnp.abs(rows[i][k]), largest)
        first, first_order = rows[k], order[k]
        for i in range(k + 1, len(rows)):
            is_pivot = place == i
            rows[k] = jnp.where(is_pivot, rows[i], rows[k])
            order[k] = jnp.where(is_pivot, order[i], order[k])
            rows[i] = jnp.where(is_pivot, first, rows[i])
            order[i] = jnp.where(is_pivot, first_order, order[i])
        pivots.append(place)
        pivot = rows[k][k]
        divisor = jnp.where(pivot == 0, jnp.ones_like(pivot), pivot)
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / divisor
            rest = rows[i][k + 1 :] - factor * rows[k][k + 1 :]
            rows[i] = jnp.concatenate([rows[i][:k], factor[None], rest])
    return jnp.stack(rows), jnp.stack(pivots), jnp.stack(order)


# Jacobi's method converges quadratically: matrices of 32 rows take 7 or 8 sweeps.
_MOST_SWEEPS = 16


def _in_next_order(x: Any) -> Any:
    """Move the rows to form other pairs, as in a round-robin tournament."""
    if len(x) == 2:
        return x
    tops, bottoms = x[0::2], x[1::2]
    tops, bottoms = (
        jnp.concatenate([tops[:1], bottoms[:1], tops[1:-1]]),
        jnp.concatenate([bottoms[1:], tops[-1:]]),
    )
    return jnp.stack([tops, bottoms], axis=1).reshape(x.shape)


def _rotation(ratio: Any) -> Callable[[Any], Any]:
    """Return the function that rotates pairs of rows, and then forms other pairs.

    `ratio` is cot 2θ for the angle θ of each pair, with |θ| <= π/4; an infinite number
    stands for no rotation.
    """
    size = jnp.abs(ratio) + jnp.sqrt(1 + ratio * ratio)
    tangent = jnp.where(ratio < 0, -1 / size, 1 / size)
    cosine = 1 / jnp.sqrt(1 + tangent * tangent)
    cosine, sine = cosine[:, None], (tangent * cosine)[:, None]

    def turned(x: Any) -> Any:
        first, second = x[0::2], x[1::2]
        pair = [cosine * first - sine * second, sine * first + cosine * second]
        return _in_next_order(jnp.stack(pair, axis=1).reshape(x.shape))

    return turned


def _eigh(a: Any, *, lower: bool, sort_eigenvalues: bool, **_: Any) -> tuple[Any, Any]:
    """Diagonalise a symmetric matrix by Jacobi's method.

    Each round rotates disjoint pairs of rows and columns, and a sweep of rounds treats
    all pairs (Brent and Luk, SIAM J. Sci. Stat. Comput. 6, 1985). The results are the
    eigenvectors, as columns, and the eigenvalues in ascending order.
    """
    del sort_eigenvalues
    size = len(a)
    a = jnp.tril(a) + jnp.tril(a, -1).T if lower else jnp.triu(a) + jnp.triu(a, 1).T
    # If the number of rows is odd, a row and a column of zeros are added. No rotation
    # changes them.
    odd = size % 2
    a = jnp.pad(a, ((0, odd), (0, odd)))
    vectors = jnp.eye(len(a), dtype=a.dtype)
    off_diagonal = jnp.asarray(1 - np.eye(len(a)), a.dtype)

    def round_of_sweep(_: Any, carry: Any) -> Any:
        a, vectors = carry
        diagonal = jnp.diagonal(a)
        beside = jnp.diagonal(a, 1)[0::2]
        is_zero = beside == 0
        ratio = diagonal[1::2] - diagonal[0::2]
        ratio = ratio / (2 * jnp.where(is_zero, jnp.ones_like(beside), beside))
        turned = _rotation(jnp.where(is_zero, jnp.inf, ratio))
        return turned(turned(a).T), turned(vectors)

    def goes_on(carry: Any) -> Any:
        sweep, a, _ = carry
        rest = jnp.max(jnp.abs(a) * off_diagonal)
        small = float(jnp.finfo(a.dtype).eps) / 4 * jnp.max(jnp.abs(a))
        return (sweep < _MOST_SWEEPS) & (rest > small)

    def sweep(carry: Any) -> Any:
        number, *rest = carry
        rest = jax.lax.fori_loop(0, len(a) - 1, round_of_sweep, tuple(rest))
        return number + 1, *rest

    _, a, vectors = jax.lax.while_loop(goes_on, sweep, (jnp.int32(0), a, vectors))
    values, place = _sort(
        jnp.diagonal(a)[:size],
        jnp.arange(size),
        dimension=0,
        is_stable=True,
        num_keys=1,
    )
    is_finite = jnp.isfinite(jnp.sum(jnp.abs(a)))
    values, vectors = (jnp.where(is_finite, x, jnp.nan) for x in (values, vectors))
    chosen = (place[:, None] == jnp.arange(size)[None]).astype(a.dtype)
    return (chosen @ vectors[:size, :size]).T, values


def _singular_values(a: Any, **_: Any) -> list[Any]:
    """Compute singular values in descending order, by the one-sided Jacobi method.

    Each round rotates disjoint pairs of rows to be orthogonal. At the end the singular
    values are the lengths of the rows. Small singular values are as accurate as with
    LAPACK or better (Demmel and Veselić, SIAM J. Matrix Anal. Appl. 13, 1992), except
    that values can be zero if their square, relative to the square of the largest
    entry, underflows.
    """
    if a.shape[0] > a.shape[1]:
        a = a.T
    size, width = a.shape
    eps = float(jnp.finfo(a.dtype).eps)
    # Products of the entries do not overflow after the division by the largest entry.
    largest = jnp.max(jnp.abs(a))
    scale = jnp.where(largest > 0, largest, jnp.ones_like(largest))
    rows = jnp.pad(a / scale, ((0, size % 2), (0, 0)))

    def round_of_sweep(_: Any, carry: Any) -> Any:
        rows, cosines = carry
        first, second = rows[0::2], rows[1::2]
        pairs = (first, first), (second, second), (first, second)
        one, other, mixed = [jnp.sum(x * y, axis=1) for x, y in pairs]
        sizes = jnp.sqrt(one) * jnp.sqrt(other)
        cosine = jnp.abs(mixed) / jnp.where(sizes > 0, sizes, jnp.ones_like(sizes))
        is_done = cosine <= eps / 4
        ratio = (other - one) / (2 * jnp.where(is_done, jnp.ones_like(mixed), mixed))
        turned = _rotation(jnp.where(is_done, jnp.inf, ratio))
        return turned(rows), jnp.maximum(cosines, jnp.max(cosine))

    def sweep(carry: Any) -> Any:
        number, rows, _ = carry
        start = rows, jnp.zeros_like(largest)
        return number + 1, *jax.lax.fori_loop(0, len(rows) - 1, round_of_sweep, start)

    def goes_on(carry: Any) -> Any:
        number, _, cosines = carry
        # Rounding errors keep the cosines above zero, so a small bound ends the sweeps.
        return (number < _MOST_SWEEPS) & (cosines > width * eps)

    start = jnp.int32(0), rows, jnp.ones_like(largest)
    _, rows, _ = jax.lax.while_loop(goes_on, sweep, start)
    squares = jnp.sum(rows * rows, axis=1)
    values = jnp.where(jnp.isfinite(jnp.sum(squares)), jnp.sqrt(squares), jnp.nan)
    (ascending,) = _sort(values, dimension=0, is_stable=True, num_keys=1)
    return [scale * ascending[::-1][:size]]


def _permutation(pivots: Any, *, permutation_size: int, **_: Any) -> Any:
    """Return the order of rows after a sequence of exchanges."""
    order = [jnp.int32(k) for k in range(permutation_size)]
    for k in range(len(pivots)):
        first = order[k]
        for i in range(k + 1, permutation_size):
            is_pivot = pivots[k] == i
            order[k] = jnp.where(is_pivot, order[i], order[k])
            order[i] = jnp.where(is_pivot, first, order[i])
    return jnp.stack(order)


def _sort(*operands: Any, dimension: int, is_stable: bool, num_keys: int) -> list[Any]:
    """Sort the first operand, and reorder the other operands in the same way.

    Each number is moved to its rank, which is the number of elements that come before
    it. NaN comes last.
    """
    del dimension, is_stable, num_keys
    keys = operands[0]
    place, is_nan = jnp.arange(len(keys)), keys != keys
    before = (keys[:, None] > keys[None]) | (is_nan[:, None] & ~is_nan[None])
    is_tie = (keys[:, None] == keys[None]) | (is_nan[:, None] & is_nan[None])
    before = before | (is_tie & (place[:, None] > place[None]))
    ranks = jnp.sum(before, axis=1, dtype=jnp.int32)
    found = []
    for operand in operands:
        rows = []
        for k in range(len(keys)):
            value = operand[0]
            for i in range(1, len(keys)):
                value = jnp.where(ranks[i] == k, operand[i], value)
            rows.append(value)
        found.append(jnp.stack(rows))
    return found


def _is_sort_of_few(equation: Any) -> bool:
    """Return whether an operation sorts few real numbers along their last axis."""
    keys, params = equation.invars[0].aval, equation.params
    return (
        jnp.issubdtype(keys.dtype, jnp.number)
        and not jnp.issubdtype(keys.dtype, jnp.complexfloating)
        and params["num_keys"] == 1
        and params["dimension"] == keys.ndim - 1
        and keys.shape[-1] <= MOST_ROWS
        and math.prod(keys.shape[:-1]) <= _MOST_MEMBERS
    )


def _triangular_solve(
    a: Any,
    b: Any,
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
    **_: Any,
) -> Any:
    """Solve `a x = b`, or `x a = b`, by substitution."""
    if not left_side:
        a, b, lower = a.T, b.T, not lower
    if transpose_a:
        a, lower = a.T, not lower
    solved: dict[int, Any] = {}
    for i in range(len(a)) if lower else reversed(range(len(a))):
        rest = b[i]
        for j, x in solved.items():
            rest = rest - a[i, j] * x
        solved[i] = rest if unit_diagonal else rest / a[i, i]
    x = jnp.stack([solved[i] for i in range(len(a))])
    return x if left_side else x.T


def _nextafter(x: Any, y: Any, **_: Any) -> Any:
    """Return the number next to `x` in the direction of `y`."""
    bits = jnp.dtype(f"int{8 * x.dtype.itemsize}")
    number = jax.lax.bitcast_convert_type(x, bits)
    one = jnp.ones_like(number)
    # The bits, read as an integer, increase with the distance from zero.
    grows = (y > x) == (x > 0)
    next_bits = jnp.where(grows, number + one, number - one)
    after = jax.lax.bitcast_convert_type(next_bits, x.dtype)
    least = jax.lax.bitcast_convert_type(one, x.dtype)
    after = jnp.where(x == 0, jnp.where(y > 0, least, -least), after)
    after = jnp.where(x == y, y, after)
    return jnp.where((x != x) | (y != y), x + y, after)


def _log2(x: Any, **_: Any) -> Any:
    return jnp.log(x) * jnp.asarray(1 / math.log(2), x.dtype)


def _one_minus_square(x: Any) -> Any:
    """Compute 1 - x² as (1 + x) (1 - x), which is accurate for x close to one."""
    one = jnp.ones_like(x)
    return (one + x) * (one - x)


def _polynomial(x: Any, *coefficients: Any, **_: Any) -> Any:
    """Compute a polynomial; its coefficients begin with the constant term."""
    *others, value = coefficients
    for coefficient in reversed(others):
        value = value * x + coefficient
    return value


def _is_short(equation: Any) -> bool:
    shape = equation.outvars[0].aval.shape
    return shape[-1] <= MOST_ROWS and math.prod(shape[:-1]) <= _MOST_MEMBERS


def _has_members(equation: Any) -> bool:
    """Return whether a `while` loop has a condition for each of several members."""
    return equation.params["cond_jaxpr"].out_avals[0].shape != ()


def _while_any(
    *operands: Any,
    cond_jaxpr: Any,
    body_jaxpr: Any,
    cond_nconsts: int,
    body_nconsts: int,
) -> list[Any]:
    """Iterate while any member continues; values of finished members do not change."""
    test, body = map(jax.extend.core.jaxpr_as_fun, (cond_jaxpr, body_jaxpr))
    of_test, of_body = operands[:cond_nconsts], operands[cond_nconsts:][:body_nconsts]

    def step(carry: list[Any]) -> list[Any]:
        (goes_on,) = test(*of_test, *carry)
        return [
            jnp.where(
                goes_on.reshape(goes_on.shape + (1,) * (x.ndim - goes_on.ndim)), x, y
            )
            for x, y in zip(body(*of_body, *carry), carry, strict=True)
        ]

    start = list(operands[cond_nconsts + body_nconsts :])
    return jax.lax.while_loop(
        lambda carry: jnp.any(test(*of_test, *carry)[0]), step, start
    )


def _platform_index(*, platforms: Any) -> Any:
    """Return the index of the branch for the CPU, or of the default branch."""
    return jnp.int32(
        next(k for k, names in enumerate(platforms) if names is None or "cpu" in names)
    )


def _is_real(equation: Any) -> bool:
    return equation.invars[0].aval.dtype in (np.float32, np.float64)


_EXPANSIONS: dict[str, tuple[Callable[[Any], bool], Callable[..., Any]]] = {
    # The next three are primitives since JAX 0.12; before, they became arithmetic.
    "log2": (_is_real, _log2),
    "one_minus_square": (_is_real, _one_minus_square),
    "polynomial": (_is_real, _polynomial),
    "eigh": (_is_symmetric_problem, _for_each(_eigh, 2)),
    "lu": (_is_small_matrix, _for_each(_lu, 2)),
    "lu_pivots_to_permutation": (_is_short, _for_each(_permutation, 1)),
    "nextafter": (_is_real, _nextafter),
    "platform_index": (lambda equation: True, _platform_index),
    "svd": (_has_only_singular_values, _for_each(_singular_values, 2)),
    "sort": (_is_sort_of_few, _for_each(_sort, 1)),
    "triangular_solve": (_is_small_matrix, _for_each(_triangular_solve, 2)),
    "while": (_has_members, _while_any),
}
