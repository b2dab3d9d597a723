"""A primitive that writes a row into a buffer, and is one operation until lowering.

A loop that saves its states writes each row of a buffer once. JAX's own update of an
array cannot assume this. Its derivative in reverse mode therefore sets the row of the
cotangent to zero, and XLA copies the whole buffer for this in each iteration. With
JAX's update, the time of a gradient would grow with the square of the number of rows.
"""

from functools import partial
from typing import Any

import jax
import jax.core
import jax.extend
import jax.numpy as jnp
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Int, Shaped

from ..lanes import never_high, WRITE_ROW


_write = jax.extend.core.Primitive(WRITE_ROW)
_write.is_high = never_high


def write_row(
    buffer: Shaped[Array, "rows *shape"],
    row: Shaped[Array, "*shape"],
    slot: Int[Array, ""],
) -> Shaped[Array, "rows *shape"]:
    """Write a row to the index `slot` of a buffer, where 0 <= slot < length.

    Each row of the buffer may be written only once. The exception is a row that is
    never read, such as a row for data that are not saved.
    """
    return _write.bind(buffer, row, slot, axis=0)


@_write.def_impl
def _written(buffer: Array, row: Array, slot: Array, *, axis: int) -> Array:
    return jax.lax.dynamic_update_index_in_dim(buffer, row, slot, axis)


@_write.def_abstract_eval
def _shape(buffer: Any, row: Any, slot: Any, *, axis: int) -> Any:
    operands = buffer, row, slot
    if all(x == jax.core.ShapedArray(x.shape, x.dtype, x.weak_type) for x in operands):
        return jax.core.ShapedArray(buffer.shape, buffer.dtype)
    # For operands that are sharded over devices, JAX determines the sharding of the
    # result.
    return jax.make_jaxpr(partial(_written, axis=axis))(*operands).out_avals[0]


def _jvp(primals, tangents, *, axis):
    buffer, row, slot = primals
    out = _write.bind(buffer, row, slot, axis=axis)
    if all(isinstance(tangent, ad.Zero) for tangent in tangents[:2]):
        return out, ad.Zero(jax.typeof(out).to_tangent_aval())
    rates = map(ad.instantiate_zeros, tangents[:2])
    return out, _write.bind(*rates, slot, axis=axis)


def _transpose(cotangent, buffer, row, slot, *, axis):
    # No earlier operation has written the row. Therefore this row of the cotangent
    # need not be set to zero.
    of_buffer = cotangent if ad.is_undefined_primal(buffer) else None
    of_row = None
    if ad.is_undefined_primal(row) and not isinstance(cotangent, ad.Zero):
        of_row = jax.lax.dynamic_index_in_dim(cotangent, slot, axis, keepdims=False)
    return of_buffer, of_row, None


def _batched(operands, axes, *, axis):
    if axes[2] is not None:
        # Members write to different slots, so that JAX's own update is used.
        return jax.vmap(partial(_written, axis=axis), axes)(*operands), 0
    pairs = list(zip(operands[:2], axes[:2], strict=True))
    size = next(x.shape[place] for x, place in pairs if place is not None)
    buffer, row = (
        jnp.broadcast_to(x, (size, *x.shape))
        if place is None
        else jnp.moveaxis(x, place, 0)
        for x, place in pairs
    )
    return _write.bind(buffer, row, operands[2], axis=axis + 1), 0


ad.primitive_jvps[_write] = _jvp
ad.primitive_transposes[_write] = _transpose
batching.primitive_batchers[_write] = _batched
mlir.register_lowering(_write, mlir.lower_fun(_written, multiple_results=False))
