"""Jaxprs: which operations they contain, and the removal of superfluous operations.

`fits_one_kernel` decides, by the operations and the sizes of their arrays, whether XLA
can compile a program to a single kernel of the CPU. `cse_dce` removes repeated
operations (common-subexpression elimination) and unused operations (dead-code
elimination). A traced program repeats many operations, because derivatives also compute
the function itself. Without `cse_dce`, each transformation and the compiler would
process every copy.
"""

import itertools
import math
from collections.abc import Hashable, Iterator, Mapping
from typing import Any

import jax
import jax.extend
import numpy as np


# The lists below contain, by JAX's names, the operations that XLA can put into one
# kernel. Calls into libraries (products of matrices, factorisations, transforms),
# sorting, scattering and callbacks are not in the lists.
#
# The operations in `ELEMENTWISE` act element by element. `nhjax._numerics._sparsity`
# relies on this property, so do not list other operations here.
ELEMENTWISE = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh
    bitcast_convert_type cbrt ceil clamp convert_element_type cos cosh div eq erf
    exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p log2 logistic lt max
    min mul ne neg not one_minus_square or polynomial pow rem round rsqrt select_n sign
    sin sinh sqrt square stop_gradient sub tan tanh xor zeros_like
""".split()  # noqa: SIM905
_REDUCING = """
    argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod
    reduce_sum
""".split()  # noqa: SIM905
_SHAPING = """
    concatenate copy copy_p expand_dims pad rev slice split squeeze stack
    transpose unstack
""".split()  # noqa: SIM905
# The arrays of these operations may be large, such as the array of all saved rows,
# because only a part of the array is moved.
_MOVING = """
    broadcast_in_dim dynamic_slice dynamic_update_slice empty empty2 iota
    loop_start reshape write_row
""".split()  # noqa: SIM905
ARITHMETIC_AND_SHAPES = (*ELEMENTWISE, *_REDUCING, *_SHAPING, *_MOVING)
_ARITHMETIC = {"add", "add_any", "div", "mul", "neg", "sub"}
# nhjax's own operation, which is lowered to broadcasts, a product and a sum, or to a
# product and an addition for each term.
SMALL_PRODUCT = "small_product"
# nhjax's own operation, which inverts a matrix. Its parameter is the program by which
# XLA computes the inverse.
SMALL_INVERSE = "small_inverse"
# nhjax's own operation, which writes a row of an array.
WRITE_ROW = "write_row"
# nhjax's own operation, which calls a program. The program and its derivatives are
# traced once, and then reused.
KEPT_CALL = "kept_call"
# Functions under `jax.jit` whose names have this prefix are compiled once, and called
# by kernels.
COMPILED_ONCE = "compiled_once_"
# These operations contain programs; the operations of these programs are checked too.
CALLING = """
    checkpoint closed_call custom_jvp_call custom_vjp_call jit kept_call remat2
""".split()  # noqa: SIM905
# nhjax's own operation, which runs a program for each row of its operands.
BATCHED_CALL = "batched_call"
_CONTAINING = [
    *CALLING,
    BATCHED_CALL,
    "cond",
    "custom_linear_solve",
    "cpu_kernel",
    SMALL_INVERSE,
    "scan",
    "while",
]
# These limits are numbers of elements. XLA leaves larger reductions to a library, and
# shares work on larger arrays among threads, which a kernel cannot start.
LARGEST_REDUCTION = 1024
LARGEST_ARRAY = 4096


def fits_one_kernel(program: Any) -> bool:
    """Return whether all operations of a jaxpr can go into one kernel of the CPU."""
    return all(map(_fits_one_kernel, program.eqns))


def _fits_one_kernel(equation: Any) -> bool:
    name = equation.primitive.name
    if name in _CONTAINING:
        return all(map(fits_one_kernel, _programs(equation.params)))
    if name in _MOVING:
        return True
    if name == SMALL_PRODUCT and not equation.params["by_terms"]:
        return _terms(equation) * _size(equation.outvars[0]) <= LARGEST_REDUCTION
    if name.startswith("reduce_") and _size(equation.invars[0]) > LARGEST_REDUCTION:
        return False
    small = all(_size(x) <= LARGEST_ARRAY for x in equation.outvars)
    return small and name in (*ELEMENTWISE, *_REDUCING, *_SHAPING, SMALL_PRODUCT)


def _terms(product: Any) -> int:
    """Count the terms of each sum of a small product."""
    pairs = zip(product.params["first"], product.invars[0].aval.shape, strict=True)
    return math.prod(n for index, n in pairs if index not in product.params["result"])


def _size(variable: Any) -> int:
    return math.prod(variable.aval.shape)


def _programs(params: Any) -> Iterator[Any]:
    for leaf in jax.tree.leaves(params):
        leaf = getattr(leaf, "jaxpr", leaf)
        if hasattr(leaf, "eqns"):
            yield leaf


def rms_array_size(program: Any, per_loop: int = 1) -> float:
    """Return the root mean square size of the results of arithmetic operations.

    An operation inside a loop counts `per_loop` times as much as an operation outside
    of the loop.

    In a program with loops, large arrays outside of the loops do not count: such an
    array often holds the output of all steps, and the steps take far longer than an
    operation on this array.
    """
    found = list(_arithmetic_sizes(program, 0))
    has_loop = any(depth for _, depth in found)
    squares = [
        (size * size, per_loop**depth)
        for size, depth in found
        if depth or not has_loop or size <= LARGEST_REDUCTION
    ]
    if not squares:
        return 0.0
    total = sum(weight for _, weight in squares)
    return math.sqrt(sum(square * weight for square, weight in squares) / total)


def _arithmetic_sizes(program: Any, depth: int) -> Iterator[tuple[int, int]]:
    """List, for each arithmetic operation, the size of its array and its loop depth."""
    for equation in program.eqns:
        name = equation.primitive.name
        if name in _ARITHMETIC:
            yield _size(equation.outvars[0]), depth
        if name == SMALL_PRODUCT:
            for size in _sizes_of_product(equation):
                yield size, depth
        for part in _programs(equation.params):
            yield from _arithmetic_sizes(part, depth + (name in ("scan", "while")))


def _sizes_of_product(product: Any) -> Iterator[int]:
    """List the sizes of arrays in the arithmetic that a small product is lowered to."""
    size, terms = _size(product.outvars[0]), _terms(product)
    if product.params["by_terms"]:
        yield from itertools.repeat(size, 2 * terms - 1)
    else:
        yield size * terms


def num_results(program: Any) -> int:
    """Count the numbers that a jaxpr computes; the body of a loop counts once."""
    count = 0
    for equation in program.eqns:
        inner = [num_results(part) for part in _programs(equation.params)]
        count += sum(inner) if inner else sum(map(_size, equation.outvars))
    return count


# Repeated operations are removed only if they are in this set. They have no state
# (unlike random numbers), and call no Python function.
_REPEATABLE = frozenset(
    (
        *ARITHMETIC_AND_SHAPES,
        "dot_general",
        "gather",
        KEPT_CALL,
        SMALL_PRODUCT,
        SMALL_INVERSE,
    )
)
# The operations whose inner programs are simplified, and the parameters that hold these
# programs. The inner programs of other operations are not simplified, because the rules
# of these operations may rely on the original programs.
_INNER = {
    BATCHED_CALL: ("program",),
    "checkpoint": ("jaxpr",),
    "cond": ("branches",),
    "custom_jvp_call": ("call_jaxpr",),
    "custom_linear_solve": ("jaxprs",),
    "jit": ("jaxpr",),
    "remat2": ("jaxpr",),
    "scan": ("jaxpr",),
    "while": ("body_jaxpr", "cond_jaxpr"),
}


def cse_dce(program: Any) -> Any:
    """Remove unused and repeated operations from a jaxpr and from its inner programs.

    The operations that stay are not changed, so that results are the same to the last
    bit.
    """
    return _Simplifier()(program)


class _Simplifier:
    """Removes operations from programs.

    A program that occurs several times is simplified once.
    """

    def __init__(self):
        # Programs are found by their `id`. The original program is stored too: if it
        # were freed, another object could get its `id`.
        self._known: dict[int, tuple[Any, Any]] = {}

    def __call__(self, program: Any) -> Any:
        if id(program) not in self._known:
            short = (
                program.replace(jaxpr=self._open(program.jaxpr))
                if hasattr(program, "jaxpr")
                else self._open(program)
            )
            self._known[id(program)] = program, short
        return self._known[id(program)][1]

    def _open(self, jaxpr: Any) -> Any:
        first: dict[Any, Any] = {}
        made: dict[Hashable, list[Any]] = {}
        equations = []

        def same(variable: Any) -> Any:
            if isinstance(variable, jax.extend.core.Literal):
                return variable
            return first.get(variable, variable)

        for equation in _used(jaxpr):
            operands = [same(variable) for variable in equation.invars]
            if _is_repeatable(equation):
                key = _key(equation, operands)
                if key in made:
                    first.update(zip(equation.outvars, made[key], strict=True))
                    continue
                made[key] = equation.outvars
            params = self._params(equation)
            equations.append(equation.replace(invars=operands, params=params))
        return jaxpr.replace(eqns=equations, outvars=[same(v) for v in jaxpr.outvars])

    def _params(self, equation: Any) -> dict[str, Any]:
        """Return the parameters of an operation, with its inner programs simplified."""
        names = _INNER.get(equation.primitive.name, ())
        inner = {name: jax.tree.map(self, equation.params[name]) for name in names}
        return {**equation.params, **inner}


def _used(jaxpr: Any) -> list[Any]:
    """List the operations that have effects, or results that are used."""
    used, found = set(variables(jaxpr.outvars)), []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or not used.isdisjoint(equation.outvars):
            used.update(variables(equation.invars))
            found.append(equation)
    return found[::-1]


def variables(operands: Any) -> list[Any]:
    """Return the operands that are variables, and not literals."""
    return [v for v in operands if not isinstance(v, jax.extend.core.Literal)]


def _is_repeatable(equation: Any) -> bool:
    # A dropped result has no name, so it cannot replace the result of a repetition.
    return equation.primitive.name in _REPEATABLE and not any(
        isinstance(variable, jax.extend.core.DropVar) for variable in equation.outvars
    )


def _key(equation: Any, operands: list[Any]) -> Hashable:
    """Return a key; operations with equal keys compute the same values."""
    params = tuple((name, _exact(equation.params[name])) for name in equation.params)
    # The context holds settings of JAX, such as the device of the operation.
    context = _exact(getattr(equation, "ctx", None))
    return equation.primitive, tuple(map(_operand, operands)), params, context


def _operand(variable: Any) -> Hashable:
    if not isinstance(variable, jax.extend.core.Literal):
        return variable
    return _exact(np.asarray(variable.val)[()]), str(variable.aval)


def _exact(value: Any) -> Hashable:
    """Return a key of a parameter; an object without a hash equals only itself.

    Numbers that compare equal but differ, such as 0.0 and -0.0 or 1 and True, have
    different keys.
    """
    if isinstance(value, tuple | list):
        return type(value), *map(_exact, value)
    if isinstance(value, Mapping):
        return type(value), *((name, _exact(value[name])) for name in value)
    if isinstance(value, np.generic):
        return type(value), value.dtype.str, value.tobytes()
    if isinstance(value, float | complex):
        return type(value), repr(value)
    try:
        hash(value)
    except TypeError:
        return type(value), id(value)
    return type(value), value
