"""The sum of products of two small arrays, as one operation until it is lowered.

Without this operation, a product would be about five operations, and its derivatives
several times as many. Tracing a gradient would take 15 to 40 percent longer.
"""

import itertools
import math
import string
from functools import lru_cache, partial, reduce
from typing import Any

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from ..lanes import never_high, SMALL_PRODUCT


# Sums with more terms than this are not written out term by term.
LONGEST_SUM = 128


# The parameters `first`, `second` and `result` are the indices of the operands and of
# the result, as in the subscripts of an einsum. Each index that is summed occurs in
# both operands. If `by_terms` is true, the terms are added one by one. Both operands
# have the same dtype, real or complex.
small_product = jax.extend.core.Primitive(SMALL_PRODUCT)
small_product.is_high = never_high


def _written_out(
    a: Array, b: Array, *, first: str, second: str, result: str, by_terms: bool
) -> Array:
    summed = [index for index in first if index not in result]
    order = [*result, *summed]
    x, y = _aligned(a, first, order), _aligned(b, second, order)
    if not by_terms:
        return jnp.sum(x * y, axis=tuple(range(len(result), len(order))))
    # The terms are added one by one, because XLA calls a library to reduce arrays of
    # more than `LARGEST_REDUCTION` elements.
    ranges = (range(a.shape[first.index(index)]) for index in summed)
    return reduce(
        jnp.add, (x[..., *k] * y[..., *k] for k in itertools.product(*ranges))
    )


def _aligned(x: Array, indices: str, order: list[str]) -> Array:
    """Transpose x to an order of indices; missing indices get an axis of length 1."""
    present = [index for index in order if index in indices]
    x = jnp.transpose(x, [indices.index(index) for index in present])
    return jnp.expand_dims(
        x, [k for k, index in enumerate(order) if index not in indices]
    )


@small_product.def_impl
def _run(a, b, **params):
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return _written_out(a, b, **params)
    return _compiled(**params)(a, b)


@lru_cache(maxsize=1000)
def _compiled(**params):
    return jax.jit(partial(small_product.bind, **params))


@small_product.def_abstract_eval
def _shape(a: Any, b: Any, **params: Any) -> Any:
    if all(x == jax.core.ShapedArray(x.shape, x.dtype, x.weak_type) for x in (a, b)):
        lengths = dict(zip(params["first"], a.shape, strict=True))
        lengths |= zip(params["second"], b.shape, strict=True)
        shape = tuple(lengths[index] for index in params["result"])
        return jax.core.ShapedArray(shape, a.dtype)
    # For operands that are sharded over devices, JAX determines the sharding of the
    # result.
    return jax.make_jaxpr(partial(_written_out, **params))(a, b).out_avals[0]


def _pull_first(cotangent, _, y, *, first, second, result, by_terms):
    return _pulled(cotangent, y, result, second, first, by_terms)


def _pull_second(cotangent, x, _, *, first, second, result, by_terms):
    return _pulled(cotangent, x, result, first, second, by_terms)


def _pulled(cotangent, other, first: str, second: str, result: str, by_terms: bool):
    # The cotangent of an operand that all members of a batch share is a sum over the
    # members, which may be too long to be written out.
    lengths = zip(first, cotangent.shape, strict=True)
    terms = math.prod(n for index, n in lengths if index not in result)
    indices = {"first": first, "second": second, "result": result}
    by_terms = by_terms and terms <= LONGEST_SUM
    return small_product.bind(cotangent, other, **indices, by_terms=by_terms)


ad.defbilinear(small_product, _pull_first, _pull_second)


def _batched(operands, axes, *, first, second, result, by_terms):
    new = next(x for x in string.ascii_letters if x not in first + second)
    first, second = (
        indices if axis is None else indices[:axis] + new + indices[axis:]
        for indices, axis in zip((first, second), axes, strict=True)
    )
    indices = {"first": first, "second": second, "result": new + result}
    return small_product.bind(*operands, **indices, by_terms=by_terms), 0


batching.primitive_batchers[small_product] = _batched
mlir.register_lowering(
    small_product, mlir.lower_fun(_written_out, multiple_results=False)
)
