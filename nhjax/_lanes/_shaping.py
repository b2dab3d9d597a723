"""Operations that move numbers to places that are known beforehand."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from ._buffers import InMemory, Value
from ._builder import Builder, Operation
from ._memory import LARGE, places
from ._unsupported import Unsupported


# What moves the elements of an array of NumPy, and results in a view.
_Move = Callable[[np.ndarray], np.ndarray]


def moved(builder: Builder, value: Value, move: _Move) -> Value:
    """Move the numbers of an array, in memory or not, like those of NumPy's."""
    if not isinstance(value, InMemory):
        return move(value)
    memory = builder.memory
    view = move(places(value.shape))
    if view.size <= LARGE:
        out = np.empty(view.size, object)
        for index, place in enumerate(view.flat):
            out[index] = memory.load(value.buffer, None, int(place))
        return out.reshape(view.shape)
    target = memory.new(value.dtype, view.size)
    memory.move(target, places(view.shape), value.buffer, view)
    return InMemory(target, view.shape)


def _moving(
    move: Callable[..., np.ndarray], builder: Builder, equation: Any, values: list
) -> Value:
    aval = equation.outvars[0].aval
    return moved(builder, values[0], partial(move, equation.params, aval.shape))


def _reshape(builder: Builder, equation: Any, values: list[Value]) -> Value:
    is_reshape = equation.primitive.name == "reshape"
    if is_reshape and equation.params["dimensions"] is not None:
        raise Unsupported("a reshape in another order")
    return values[0].reshape(equation.outvars[0].aval.shape)


def _broadcast_in_dim(builder: Builder, equation: Any, values: list[Value]) -> Value:
    shape, value = equation.outvars[0].aval.shape, values[0]
    if not isinstance(value, InMemory) and value.size == 1:
        node = value.reshape(-1)[0]
        if node.op == "const" and node.attr == 0 and not np.signbit(float(node.attr)):
            # So JAX makes tangents that are zero.
            node = builder.graph.zero(node.dtype)
        return builder.full(shape, node)
    if isinstance(value, InMemory) and math.prod(shape) == value.size:
        return value.reshape(shape)
    dimensions = equation.params["broadcast_dimensions"]

    def move(x: np.ndarray) -> np.ndarray:
        inner = [1] * len(shape)
        for dimension, length in zip(dimensions, x.shape, strict=True):
            inner[dimension] = length
        return np.broadcast_to(x.reshape(inner), shape)

    return moved(builder, value, move)


def _transpose(params: Any, shape: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    return x.transpose(params["permutation"])


def _rev(params: Any, shape: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    return np.flip(x, params["dimensions"])


def _slice(params: Any, shape: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    starts, limits = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(starts)
    return x[tuple(map(slice, starts, limits, strides))]


def _split(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    axis, start, out = equation.params["axis"], 0, []
    for size in equation.params["sizes"]:
        part = (slice(None),) * axis + (slice(start, start + int(size)),)
        out.append(moved(builder, values[0], lambda x, part=part: x[part]))
        start += int(size)
    return out


def _unstack(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    axis = equation.params["axis"]
    rows = range(values[0].shape[axis])

    def row(index: int) -> Value:
        # A slice, since an index into an array of one axis would be no view.
        part = (slice(None),) * axis + (slice(index, index + 1),)
        return moved(builder, values[0], lambda x: x[part].squeeze(axis))

    return [row(index) for index in rows]


def _concatenate(builder: Builder, equation: Any, values: list[Value]) -> Value:
    axis, shape = equation.params["dimension"], equation.outvars[0].aval.shape
    starts = np.cumsum([0, *[value.shape[axis] for value in values]])
    parts = [
        (slice(None),) * axis + (slice(start, start + value.shape[axis]),)
        for start, value in zip(starts, values, strict=False)
    ]
    return _assembled(builder, shape, parts, values)


def _stack(builder: Builder, equation: Any, values: list[Value]) -> Value:
    axis, shape = equation.params["axis"], equation.outvars[0].aval.shape
    parts = [
        (slice(None),) * axis + (slice(index, index + 1),)
        for index in range(len(values))
    ]
    inner = (*shape[:axis], 1, *shape[axis + 1 :])
    return _assembled(builder, shape, parts, [value.reshape(inner) for value in values])


def _assembled(
    builder: Builder, shape: tuple[int, ...], parts: list, values: list[Value]
) -> Value:
    size = math.prod(shape)
    if size > LARGE and any(isinstance(value, InMemory) for value in values):
        memory = builder.memory
        dtype = next(value.dtype for value in values if isinstance(value, InMemory))
        target = memory.new(dtype, size)
        for part, value in zip(parts, values, strict=True):
            if value.size:
                memory.write(target, places(shape)[part], value)
        return InMemory(target, shape)
    out = np.empty(shape, object)
    for part, value in zip(parts, values, strict=True):
        out[part] = builder.memory.registers(value)
    return out


def _pad(builder: Builder, equation: Any, values: list[Value]) -> Value:
    value, padding = values
    shape = equation.outvars[0].aval.shape
    node = builder.memory.registers(padding).reshape(-1)[0]
    if node.op == "const" and node.attr == 0 and not np.signbit(float(node.attr)):
        node = builder.graph.zero(node.dtype)
    inner, outer = [], []
    for config, length, most in zip(
        equation.params["padding_config"], value.shape, shape, strict=True
    ):
        low, _, interior = map(int, config)
        step = interior + 1
        # Negative padding cuts off; these are the first and last indices that stay.
        first = max(0, -(low // step))
        last = min(length, (most - 1 - low) // step + 1)
        inner.append(slice(first, max(first, last)))
        start = low + first * step
        outer.append(slice(start, start + max(last - first, 0) * step, step))
    if any(part.start == part.stop for part in inner):
        return builder.full(shape, node)
    part = moved(builder, value, lambda x: x[tuple(inner)])
    if isinstance(part, InMemory):
        memory = builder.memory
        target = memory.new(part.dtype, math.prod(shape))
        memory.write(target, places(shape), builder.full(shape, node))
        memory.write(target, places(shape)[tuple(outer)], part)
        return InMemory(target, shape)
    out = np.empty(shape, object)
    out[...] = node
    out[tuple(outer)] = part
    return out


def _tile(builder: Builder, equation: Any, values: list[Value]) -> Value:
    inner, outer = [], []
    for count, length in zip(equation.params["reps"], values[0].shape, strict=True):
        inner += [1, length]
        outer += [int(count), length]
    tiled = moved(
        builder, values[0], lambda x: np.broadcast_to(x.reshape(inner), outer)
    )
    return tiled.reshape(equation.outvars[0].aval.shape)


SHAPING: dict[str, Operation] = {
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "broadcast_in_dim": _broadcast_in_dim,
    "transpose": partial(_moving, _transpose),
    "rev": partial(_moving, _rev),
    "slice": partial(_moving, _slice),
    "split": _split,
    "unstack": _unstack,
    "concatenate": _concatenate,
    "stack": _stack,
    "pad": _pad,
    "tile": _tile,
}
