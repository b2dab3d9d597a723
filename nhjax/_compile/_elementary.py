"""The kinds of operations, which decide if a program can be one kernel of the CPU."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import jax
from jaxtyping import PyTree


# The lists below name, as JAX does, the operations that XLA can put into such kernels.
# Calls into libraries (products of matrices, factorisations, transforms), sorting,
# scattering and callbacks are not among them.
#
# These operations act element by element, which `_index_sets` relies on: no other may
# be listed here.
ELEMENTWISE = """
    abs acos acosh add add_any and asin asinh atan atan2 atanh
    bitcast_convert_type cbrt ceil clamp convert_element_type cos cosh div eq erf
    exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p logistic lt max
    min mul ne neg not or pow rem round rsqrt select_n sign sin sinh sqrt square
    stop_gradient sub tan tanh xor zeros_like
""".split()  # noqa: SIM905
_REDUCING = """
    argmax argmin reduce_and reduce_max reduce_min reduce_or reduce_prod
    reduce_sum
""".split()  # noqa: SIM905
_SHAPING = """
    concatenate copy copy_p expand_dims pad rev slice split squeeze stack
    transpose unstack
""".split()  # noqa: SIM905
# The arrays of these operations may be large, such as the rows that are saved, because
# only a part of an array is moved.
_MOVING = """
    broadcast_in_dim dynamic_slice dynamic_update_slice empty empty2 iota
    reshape
""".split()  # noqa: SIM905
ARITHMETIC_AND_SHAPES = (*ELEMENTWISE, *_REDUCING, *_SHAPING, *_MOVING)
_ARITHMETIC = {"add", "add_any", "div", "mul", "neg", "sub"}
# nhjax's own operation, which is written out in arithmetic and shapes.
SMALL_PRODUCT = "small_product"
# These operations contain programs, whose operations are examined in turn.
CALLING = """
    checkpoint closed_call custom_jvp_call custom_vjp_call jit remat2
""".split()  # noqa: SIM905
_CONTAINING = [*CALLING, "cond", "custom_linear_solve", "cpu_kernel", "scan", "while"]
# Numbers of elements: reductions of more are left to a library, and work on arrays of
# more to several threads, which a kernel cannot start.
LARGEST_REDUCTION = 1024
LARGEST_ARRAY = 4096


def is_elementary(program: Any) -> bool:
    """Tell whether all operations of a program can go into one kernel."""
    return all(map(_is_elementary, program.eqns))


def _is_elementary(equation: Any) -> bool:
    name = equation.primitive.name
    if name in _CONTAINING:
        return all(map(is_elementary, _programs(equation.params)))
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


def _programs(params: PyTree[Any]) -> Iterator[Any]:
    for leaf in jax.tree.leaves(params):
        leaf = getattr(leaf, "jaxpr", leaf)
        if hasattr(leaf, "eqns"):
            yield leaf


def array_size(program: Any) -> float:
    """Compute the root of the mean square of the sizes of arrays in arithmetic."""
    sizes = [size * size for size in _arithmetic_sizes(program)]
    return math.sqrt(sum(sizes) / len(sizes)) if sizes else 0.0


def _arithmetic_sizes(program: Any) -> Iterator[int]:
    for equation in program.eqns:
        if equation.primitive.name in _ARITHMETIC:
            yield _size(equation.outvars[0])
        if equation.primitive.name == SMALL_PRODUCT:
            yield from _sizes_of_product(equation)
        for part in _programs(equation.params):
            yield from _arithmetic_sizes(part)


def _sizes_of_product(product: Any) -> Iterator[int]:
    """List the sizes of arrays in the arithmetic of a small product, written out."""
    size, terms = _size(product.outvars[0]), _terms(product)
    if product.params["by_terms"]:
        yield from itertools.repeat(size, 2 * terms - 1)
    else:
        yield size * terms
