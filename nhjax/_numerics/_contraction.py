"""Products of small matrices, written in elementary operations.

For matrices of a few rows, calling a library of linear algebra is too expensive. Inside
a time loop the calls cost more than the arithmetic. The calls cannot be compiled into
one kernel with the operations around them, and a batch of calls runs one by one. Up to
a size limit, `small_einsum` therefore consists of elementary operations.
`with_small_products` replaces the products in the user's functions by `small_einsum`.
"""

import math
import string
from collections.abc import Callable
from typing import Any

import jax
import jax.extend
import jax.numpy as jnp
from jaxtyping import Array

from .._compile import LONGEST_SUM, small_product
from ..lanes import LARGEST_REDUCTION


# A library computes products with more terms than this, so that the program stays
# short. It also computes products with more than `LARGEST_REDUCTION` terms if each sum
# is longer than `LONGEST_SUM`. From about 10⁵ terms on the library was faster
# (measured).
LARGEST_PRODUCT = 2**15


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


def with_small_products(program: Any) -> Callable[..., list[Any]]:
    """Return a jaxpr as a function that computes products by `small_einsum`."""

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
            # In earlier releases of JAX, `get_bind_params` returns functions separately
            # from the other parameters.
            functions, params = bound if isinstance(bound, tuple) else ((), bound)
            out = primitive.bind(*functions, *inputs, **params)
            out = out if primitive.multiple_results else [out]
        values |= zip(equation.outvars, out, strict=True)
    return [read(variable) for variable in program.outvars]


def _is_plain(equation) -> bool:
    """Return whether a product and its factors have the same floating dtype."""
    types = {variable.aval.dtype for variable in (*equation.invars, *equation.outvars)}
    return len(types) == 1 and jnp.issubdtype(types.pop(), jnp.inexact)
