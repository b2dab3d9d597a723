"""Slices that start at indices which may be unknown until the program runs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ._buffers import InMemory, Value
from ._builder import Builder, Operation
from ._graph import Node
from ._memory import LARGE, MOST_NUMBERS, places
from ._shaping import moved


# No array is so long.
_FAR = 2**62


def as_index(builder: Builder, node: Node) -> Node:
    """Convert an index to a signed one of 64 bits."""
    if node.dtype == "uint64":
        far = builder.graph.constant(_FAR, "uint64")
        node = builder.graph.op("min", node, far)
    return builder.graph.convert(node, "int64")


def place_in_memory(
    builder: Builder, shape: Sequence[int], starts: Sequence[Node | int]
) -> Node:
    """Find the place in memory of the element with the given index on each axis."""
    total = builder.integer(0)
    for axis, start in enumerate(starts):
        stride = math.prod(shape[axis + 1 :])
        if isinstance(start, int):
            start = builder.integer(start)
        step = builder.graph.op("mul", start, builder.integer(stride))
        total = builder.graph.op("add", step, total)
    return total


def _starts(
    builder: Builder, shape: Sequence[int], sizes: Sequence[int], starts: list[Value]
) -> list[Node]:
    """Clamp the starts of a window so that it lies in the array."""
    out = []
    for length, size, start in zip(shape, sizes, starts, strict=True):
        node = builder.memory.registers(start).reshape(-1)[0]
        out.append(builder.clamped(as_index(builder, node), length - size))
    return out


def _window(start: Sequence[Node], sizes: Sequence[int]) -> tuple[slice, ...]:
    return tuple(
        slice(int(s.attr), int(s.attr) + size)
        for s, size in zip(start, sizes, strict=True)
    )


def _dynamic_slice(builder: Builder, equation: Any, values: list[Value]) -> Value:
    value, *starts = values
    sizes = equation.params["slice_sizes"]
    if math.prod(sizes) == 0:
        return np.empty(sizes, object)
    starts = _starts(builder, value.shape, sizes, starts)
    if all(start.is_constant for start in starts):
        return moved(builder, value, lambda x: x[_window(starts, sizes)])
    memory, source = builder.memory, builder.memory.in_memory(value)
    view = places(value.shape)[tuple(map(slice, sizes))]
    shift = place_in_memory(builder, value.shape, starts)
    if view.size <= LARGE:
        out = np.empty(view.size, object)
        for index, place in enumerate(view.flat):
            out[index] = memory.load(source.buffer, shift, int(place))
        return out.reshape(sizes)
    target = memory.new(source.dtype, view.size)
    everywhere = places(sizes)
    memory.move(target, everywhere, source.buffer, view, source_shift=shift)
    return InMemory(target, sizes)


def _dynamic_update_slice(
    builder: Builder, equation: Any, values: list[Value]
) -> Value:
    value, update, *starts = values
    if update.size == 0:
        return value
    starts = _starts(builder, value.shape, update.shape, starts)
    is_known = all(start.is_constant for start in starts)
    if is_known and not isinstance(value, InMemory) and value.size <= MOST_NUMBERS:
        out = value.copy()
        window = _window(starts, update.shape)
        out[window] = builder.memory.registers(update)
        return out
    target = builder.memory.owned(value)
    view = places(value.shape)[tuple(map(slice, update.shape))]
    shift = place_in_memory(builder, value.shape, starts)
    builder.memory.write(target.buffer, view, update, shift)
    return target


INDEXING: dict[str, Operation] = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
}
