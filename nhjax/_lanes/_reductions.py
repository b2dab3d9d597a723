"""Operations that combine many numbers into one: reductions, sums, products."""

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from ._buffers import Value
from ._builder import Builder, Operation
from ._graph import dtype_name, is_float, Node
from ._memory import MOST_NUMBERS
from ._unsupported import Unsupported


def _extreme(dtype: str, sign: int) -> Any:
    """Return the largest number of a dtype, or for the sign -1 the smallest."""
    if is_float(dtype):
        return sign * np.inf
    if dtype == "bool":
        return sign > 0
    return np.iinfo(dtype).max if sign > 0 else np.iinfo(dtype).min


# The operation, and what it makes of no numbers at all.
_REDUCTIONS = {
    "reduce_sum": ("add", lambda dtype: 0),
    "reduce_prod": ("mul", lambda dtype: 1),
    "reduce_max": ("max", lambda dtype: _extreme(dtype, -1)),
    "reduce_min": ("min", lambda dtype: _extreme(dtype, 1)),
    "reduce_and": ("and", lambda dtype: -1 if dtype != "bool" else True),
    "reduce_or": ("or", lambda dtype: 0),
    "reduce_xor": ("xor", lambda dtype: 0),
}


def _rows(x: np.ndarray, axes: Sequence[int]) -> tuple[tuple[int, ...], np.ndarray]:
    """Bring the axes to the end, and make them one."""
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    shape = tuple(x.shape[axis] for axis in kept)
    length = math.prod(x.shape[axis] for axis in axes)
    x = x.transpose([*kept, *axes])
    return shape, x.reshape(math.prod(shape), length)


def _reduce(builder: Builder, equation: Any, values: list[Value]) -> Value:
    op, empty = _REDUCTIONS[equation.primitive.name]
    dtype = dtype_name(equation.outvars[0].aval.dtype)
    x = builder.memory.registers(values[0])
    shape, rows = _rows(x, [int(axis) for axis in equation.params["axes"]])
    out = np.empty(len(rows), object)
    for index, row in enumerate(rows):
        out[index] = _folded(builder, op, row)
        if out[index] is None:
            out[index] = builder.graph.constant(
                np.array(empty(dtype)).astype(dtype), dtype
            )
    return out.reshape(shape)


def _folded(builder: Builder, op: str, numbers: Iterable[Node]) -> Node | None:
    total = None
    for number in numbers:
        total = number if total is None else builder.graph.op(op, total, number)
    return total


def _arg(op: str, builder: Builder, equation: Any, values: list[Value]) -> Value:
    """Find the index of the first NaN, or else of the first extremum."""
    graph = builder.graph
    dtype = dtype_name(equation.params["index_dtype"])
    x = builder.memory.registers(values[0])
    shape, rows = _rows(x, [int(axis) for axis in equation.params["axes"]])
    out = np.empty(len(rows), object)
    for index, row in enumerate(rows):
        best, place = row[0], graph.constant(0, dtype)
        for k, number in enumerate(row[1:], 1):
            is_better = graph.op(op, number, best)
            if is_float(number.dtype):
                is_nan = graph.op("ne", number, number)
                was_number = graph.op("eq", best, best)
                is_better = graph.op("or", is_better, is_nan)
                is_better = graph.op("and", is_better, was_number)
            best = graph.select(is_better, number, best)
            place = graph.select(is_better, graph.constant(k, dtype), place)
        out[index] = place
    return out.reshape(shape)


def _cumulative(op: str, builder: Builder, equation: Any, values: list) -> Value:
    axis, is_reversed = equation.params["axis"], equation.params["reverse"]
    x = builder.memory.registers(values[0])
    out = np.moveaxis(x, axis, 0).copy()
    order = range(len(out) - 1, -1, -1) if is_reversed else range(len(out))
    before = None
    for index in order:
        if before is not None:
            for place in np.ndindex(out.shape[1:]):
                here, earlier = (index, *place), (before, *place)
                out[here] = builder.graph.op(op, out[earlier], out[here])
        before = index
    return np.moveaxis(out, 0, axis)


def _dot_general(builder: Builder, equation: Any, values: list[Value]) -> Value:
    (left, right), (left_batch, right_batch) = equation.params["dimension_numbers"]
    graph, aval = builder.graph, equation.outvars[0].aval
    dtype = dtype_name(aval.dtype)
    a, b = map(builder.memory.registers, values)
    summed = math.prod(a.shape[axis] for axis in left)
    if math.prod(aval.shape) * max(summed, 1) > 16 * MOST_NUMBERS:
        raise Unsupported("a large product of matrices")
    a = _arranged(a, left_batch, left)
    b = _arranged(b, right_batch, right)
    out = np.empty((a.shape[0], a.shape[1], b.shape[1]), object)
    times, plus = ("and", "or") if dtype == "bool" else ("mul", "add")
    for batch, i, j in np.ndindex(out.shape):
        products = [
            graph.op(times, graph.convert(x, dtype), graph.convert(y, dtype))
            for x, y in zip(a[batch, i], b[batch, j], strict=True)
        ]
        out[batch, i, j] = _folded(builder, plus, products) or graph.zero(dtype)
    return out.reshape(aval.shape)


def _arranged(x: np.ndarray, batch: Sequence[int], summed: Sequence[int]) -> np.ndarray:
    """Bring an operand into the shape (batch, free, summed)."""
    free = [axis for axis in range(x.ndim) if axis not in (*batch, *summed)]
    sizes = [
        math.prod(x.shape[axis] for axis in axes) for axes in (batch, free, summed)
    ]
    return x.transpose([*batch, *free, *summed]).reshape(sizes)


def _small_product(builder: Builder, equation: Any, values: list[Value]) -> Value:
    first, second, result = (equation.params[k] for k in ("first", "second", "result"))
    graph, aval = builder.graph, equation.outvars[0].aval
    a, b = map(builder.memory.registers, values)
    lengths = {
        **dict(zip(first, a.shape, strict=True)),
        **dict(zip(second, b.shape, strict=True)),
    }
    order = [*result, *(index for index in first if index not in result)]
    shape = [lengths[index] for index in order]

    def rows(x: np.ndarray, indices: str) -> np.ndarray:
        """Repeat the numbers of an operand for each sum, one after the other."""
        x = x.transpose([indices.index(index) for index in order if index in indices])
        x = x.reshape([lengths[index] if index in indices else 1 for index in order])
        terms = math.prod(shape[len(result) :])
        return np.broadcast_to(x, shape).reshape(aval.size, terms)

    products = [
        [graph.op("mul", x, y) for x, y in zip(*pair, strict=True)]
        for pair in zip(rows(a, first), rows(b, second), strict=True)
    ]
    out = np.empty(aval.size, object)
    for index, row in enumerate(products):
        out[index] = _folded(builder, "add", row)
        if out[index] is None:
            out[index] = graph.zero(dtype_name(aval.dtype))
    return out.reshape(aval.shape)


REDUCTIONS: dict[str, Operation] = {
    **dict.fromkeys(_REDUCTIONS, _reduce),
    "argmax": partial(_arg, "gt"),
    "argmin": partial(_arg, "lt"),
    "cumsum": partial(_cumulative, "add"),
    "cumprod": partial(_cumulative, "mul"),
    "cummax": partial(_cumulative, "max"),
    "cummin": partial(_cumulative, "min"),
    "dot_general": _dot_general,
    "small_product": _small_product,
}
