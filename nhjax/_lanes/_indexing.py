"""Operations with indices that may be unknown until the program runs."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from ._buffers import InMemory, Value
from ._builder import Builder, Operation
from ._graph import is_float, Node
from ._memory import LARGE, MOST_NUMBERS, places
from ._shaping import moved
from ._unsupported import Unsupported


_Mode = jax.lax.GatherScatterMode
# No array is so long.
_FAR = 2**62


def _index(builder: Builder, node: Node) -> Node:
    """Convert an index to a signed one of 64 bits."""
    if node.dtype == "uint64":
        far = builder.graph.constant(_FAR, "uint64")
        node = builder.graph.op("min", node, far)
    return builder.graph.convert(node, "int64")


def _shift(
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
        out.append(builder.clamped(_index(builder, node), length - size))
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
    shift = _shift(builder, value.shape, starts)
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
    shift = _shift(builder, value.shape, starts)
    builder.memory.write(target.buffer, view, update, shift)
    return target


def _located(
    builder: Builder,
    shape: Sequence[int],
    sizes: Sequence[int],
    index: Sequence[Node],
    axes: Sequence[int],
    fixed: dict[int, int],
) -> tuple[Node, Node]:
    """Find where a window starts in memory, and whether it lies in the array.

    `index` are the starts on some `axes`, and `fixed` those on axes of batches. If the
    window lies outside, the start is that of the nearest one inside.
    """
    graph = builder.graph
    starts: list[Node | int] = [fixed.get(axis, 0) for axis in range(len(shape))]
    is_inside = graph.constant(True, "bool")
    for axis, node in zip(axes, index, strict=True):
        start, most = _index(builder, node), shape[axis] - sizes[axis]
        is_low = graph.op("ge", start, builder.integer(0))
        is_high = graph.op("le", start, builder.integer(most))
        is_inside = graph.op("and", is_inside, graph.op("and", is_low, is_high))
        starts[axis] = builder.clamped(start, most)
    return _shift(builder, shape, starts), is_inside


def _mode(equation: Any) -> _Mode:
    mode = _Mode.from_any(equation.params["mode"])
    if mode not in (_Mode.CLIP, _Mode.FILL_OR_DROP, _Mode.PROMISE_IN_BOUNDS):
        raise Unsupported(f"indices out of bounds by {mode}")
    return mode


def _gather(builder: Builder, equation: Any, values: list[Value]) -> Value:
    value, indices = values
    numbers, sizes = (
        equation.params["dimension_numbers"],
        equation.params["slice_sizes"],
    )
    aval, is_filled = equation.outvars[0].aval, _mode(equation) is _Mode.FILL_OR_DROP
    if math.prod(aval.shape) > MOST_NUMBERS or value.size == 0:
        raise Unsupported("a gather of this size")
    indices = builder.memory.registers(indices)
    left_out = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    window = places(value.shape)[tuple(map(slice, sizes))]
    window = window.reshape([s for d, s in enumerate(sizes) if d not in left_out])
    batch = indices.shape[:-1]
    fill = _fill(builder, equation, value)
    out = np.empty((*batch, *window.shape), object)
    for place in np.ndindex(batch):
        fixed = _fixed(
            numbers.operand_batching_dims, numbers.start_indices_batching_dims, place
        )
        shift, is_inside = _located(
            builder,
            value.shape,
            sizes,
            list(indices[place]),
            numbers.start_index_map,
            fixed,
        )
        for inner in np.ndindex(window.shape):
            number = _number(builder, value, shift, int(window[inner]))
            if is_filled:
                number = builder.graph.select(is_inside, number, fill)
            out[place + inner] = number
    axes = range(len(batch), out.ndim)
    return np.moveaxis(out, list(axes), list(numbers.offset_dims))


def _fixed(axes: Sequence[int], sources: Sequence[int], place: tuple) -> dict[int, int]:
    return {axis: place[source] for axis, source in zip(axes, sources, strict=True)}


def _number(builder: Builder, value: Value, shift: Node, offset: int) -> Node:
    if shift.is_constant and not isinstance(value, InMemory):
        return value.reshape(-1)[int(shift.attr) + offset]
    buffer = builder.memory.in_memory(value).buffer
    return builder.memory.load(buffer, shift, offset)


def _fill(builder: Builder, equation: Any, value: Value) -> Node:
    """Make what a gather reads outside of the array."""
    dtype = equation.outvars[0].aval.dtype.name
    fill = equation.params["fill_value"]
    if fill is None:
        if is_float(dtype):
            fill = np.nan
        elif dtype == "bool":
            fill = True
        else:
            limits = np.iinfo(dtype)
            fill = limits.min if limits.min < 0 else limits.max
    return builder.graph.constant(fill, dtype)


def _scatter(
    op: str | None, builder: Builder, equation: Any, values: list[Value]
) -> Value:
    value, indices, updates = values
    numbers, is_clipped = (
        equation.params["dimension_numbers"],
        _mode(equation) is _Mode.CLIP,
    )
    if updates.size == 0 or value.size == 0:
        return value
    if updates.size > MOST_NUMBERS:
        raise Unsupported("a scatter of this size")
    indices, updates = map(builder.memory.registers, (indices, updates))
    batch = indices.shape[:-1]
    axes = list(range(len(batch), updates.ndim))
    updates = np.moveaxis(updates, list(numbers.update_window_dims), axes)
    left_out = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    sizes, inner_sizes = [], iter(updates.shape[len(batch) :])
    for axis in range(len(value.shape)):
        sizes.append(1 if axis in left_out else next(inner_sizes))
    window = places(value.shape)[tuple(map(slice, sizes))]
    window = window.reshape(updates.shape[len(batch) :])
    located = {}
    for place in np.ndindex(batch):
        fixed = _fixed(
            numbers.operand_batching_dims, numbers.scatter_indices_batching_dims, place
        )
        shift, is_inside = _located(
            builder,
            value.shape,
            sizes,
            list(indices[place]),
            numbers.scatter_dims_to_operand_dims,
            fixed,
        )
        if is_clipped:
            is_inside = builder.graph.constant(True, "bool")
        located[place] = shift, is_inside
    read, write, result = _target(builder, value, [s for s, _ in located.values()])
    for place, (shift, is_inside) in located.items():
        for inner in np.ndindex(window.shape):
            offset = int(window[inner])
            old: Any = read(shift, offset)
            new: Any = updates[place + inner]
            number = _combined(builder, equation, op, old, new)
            write(shift, offset, builder.graph.select(is_inside, number, old))
    return result


def _combined(
    builder: Builder, equation: Any, op: str | None, old: Node, new: Node
) -> Node:
    """Make what a scatter stores where one number stands and another one comes."""
    if op is not None:
        return builder.graph.op(op, old, new)
    # `x.at[index].apply(function)` is a scatter whose numbers come from a program.
    jaxpr = equation.params["update_jaxpr"]
    if jaxpr is None:
        return new
    pair = [builder.full((), old), builder.full((), new)]
    out = builder.run(jaxpr, equation.params["update_consts"], pair)[0]
    return builder.memory.registers(out).item()


def _target(
    builder: Builder, value: Value, shifts: list[Node]
) -> tuple[Callable[..., Any], Callable[..., None], Value]:
    """Make functions that read and write an array, and the array when they are done."""
    if not isinstance(value, InMemory) and all(shift.is_constant for shift in shifts):
        out = value.copy()
        flat = out.reshape(-1)

        def write(shift: Node, offset: int, number: Node) -> None:
            flat[int(shift.attr) + offset] = number

        return (
            lambda shift, offset: flat[int(shift.attr) + offset],
            write,
            flat.reshape(value.shape),
        )
    target = builder.memory.owned(value)
    memory, buffer = builder.memory, target.buffer
    return (
        lambda shift, offset: memory.load(buffer, shift, offset),
        lambda shift, offset, number: memory.store(buffer, number, shift, offset),
        target,
    )


_SCATTERS = {
    "scatter": None,
    "scatter-add": "add",
    "scatter_add": "add",
    "scatter-sub": "sub",
    "scatter_sub": "sub",
    "scatter-mul": "mul",
    "scatter_mul": "mul",
    "scatter-min": "min",
    "scatter_min": "min",
    "scatter-max": "max",
    "scatter_max": "max",
}
INDEXING: dict[str, Operation] = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "gather": _gather,
    **{name: partial(_scatter, op) for name, op in _SCATTERS.items()},
}
