"""JAX's operations on arrays: shapes, indexing, gathers and scatters, reductions.

Each operation takes the builder of the graph, the equation and the arrays of its
operands, and returns arrays. Where the indices are known at compile time, numbers are
moved while the graph is built, at no cost at run time. If an index is known only at run
time, the array is stored in memory, and the operation becomes loads and stores.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from ._builder import (
    ArrayValue,
    Builder,
    flat_indices,
    InMemory,
    MOST_IN_REGISTERS,
    MOST_ONE_BY_ONE,
    Operation,
)
from ._graph import dtype_name, is_float, LoopBuilder, Node, Unsupported
from ._jaxprs import WRITE_ROW


def _moving(
    move: Callable[..., np.ndarray], builder: Builder, equation: Any, values: list
) -> ArrayValue:
    aval = equation.outvars[0].aval
    return builder.memory.rearranged(
        values[0], partial(move, equation.params, aval.shape)
    )


def _reshape(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    is_reshape = equation.primitive.name == "reshape"
    if is_reshape and equation.params["dimensions"] is not None:
        raise Unsupported("a reshape in another order")
    return values[0].reshape(equation.outvars[0].aval.shape)


def _broadcast_in_dim(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    shape, value = equation.outvars[0].aval.shape, values[0]
    if not isinstance(value, InMemory) and value.size == 1:
        node = value.reshape(-1)[0]
        if node.op == "const" and node.attr == 0 and not np.signbit(float(node.attr)):
            # JAX writes a symbolic zero tangent as a broadcast of the constant zero. It
            # becomes a structural zero, whose products are zero.
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

    return builder.memory.rearranged(value, move)


def _transpose(params: Any, shape: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    return x.transpose(params["permutation"])


def _rev(params: Any, shape: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    return np.flip(x, params["dimensions"])


def _slice(params: Any, shape: tuple[int, ...], x: np.ndarray) -> np.ndarray:
    starts, limits = params["start_indices"], params["limit_indices"]
    strides = params["strides"] or (1,) * len(starts)
    return x[tuple(map(slice, starts, limits, strides))]


def _split(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    axis, start, out = equation.params["axis"], 0, []
    for size in equation.params["sizes"]:
        part = (slice(None),) * axis + (slice(start, start + int(size)),)
        out.append(builder.memory.rearranged(values[0], lambda x, part=part: x[part]))
        start += int(size)
    return out


def _unstack(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    axis = equation.params["axis"]
    rows = range(values[0].shape[axis])

    def row(index: int) -> ArrayValue:
        # A slice is used, because indexing an array with one axis returns an element
        # instead of a view.
        part = (slice(None),) * axis + (slice(index, index + 1),)
        return builder.memory.rearranged(values[0], lambda x: x[part].squeeze(axis))

    return [row(index) for index in rows]


def _concatenate(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    axis, shape = equation.params["dimension"], equation.outvars[0].aval.shape
    starts = np.cumsum([0, *[value.shape[axis] for value in values]])
    parts = [
        (slice(None),) * axis + (slice(start, start + value.shape[axis]),)
        for start, value in zip(starts, values, strict=False)
    ]
    return _assembled(builder, shape, parts, values)


def _stack(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    axis, shape = equation.params["axis"], equation.outvars[0].aval.shape
    parts = [
        (slice(None),) * axis + (slice(index, index + 1),)
        for index in range(len(values))
    ]
    inner = (*shape[:axis], 1, *shape[axis + 1 :])
    return _assembled(builder, shape, parts, [value.reshape(inner) for value in values])


def _assembled(
    builder: Builder, shape: tuple[int, ...], parts: list, values: list[ArrayValue]
) -> ArrayValue:
    size = math.prod(shape)
    if size > MOST_IN_REGISTERS and any(
        isinstance(value, InMemory) for value in values
    ):
        memory = builder.memory
        dtype = next(value.dtype for value in values if isinstance(value, InMemory))
        target = memory.new(dtype, size)
        for part, value in zip(parts, values, strict=True):
            if value.size:
                memory.write(target, flat_indices(shape)[part], value)
        return InMemory(target, shape)
    out = np.empty(shape, object)
    for part, value in zip(parts, values, strict=True):
        out[part] = builder.memory.registers(value)
    return out


def _pad(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
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
        # Negative padding removes numbers. The indices from `first` to `last` - 1 stay.
        first = max(0, -(low // step))
        last = min(length, (most - 1 - low) // step + 1)
        inner.append(slice(first, max(first, last)))
        start = low + first * step
        outer.append(slice(start, start + max(last - first, 0) * step, step))
    if any(part.start == part.stop for part in inner):
        return builder.full(shape, node)
    part = builder.memory.rearranged(value, lambda x: x[tuple(inner)])
    if isinstance(part, InMemory):
        memory = builder.memory
        target = memory.new(part.dtype, math.prod(shape))
        memory.write(target, flat_indices(shape), builder.full(shape, node))
        memory.write(target, flat_indices(shape)[tuple(outer)], part)
        return InMemory(target, shape)
    out = np.empty(shape, object)
    out[...] = node
    out[tuple(outer)] = part
    return out


def _tile(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    inner, outer = [], []
    for count, length in zip(equation.params["reps"], values[0].shape, strict=True):
        inner += [1, length]
        outer += [int(count), length]
    tiled = builder.memory.rearranged(
        values[0], lambda x: np.broadcast_to(x.reshape(inner), outer)
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


# This number is larger than any index of an array.
_FAR = 2**62


def as_index(builder: Builder, node: Node) -> Node:
    """Convert an index to int64, limiting uint64 so that it does not overflow."""
    if node.dtype == "uint64":
        far = builder.graph.constant(_FAR, "uint64")
        node = builder.graph.op("min", node, far)
    return builder.graph.convert(node, "int64")


def place_in_memory(
    builder: Builder, shape: Sequence[int], starts: Sequence[Node | int]
) -> Node:
    """Return the index in memory of the element with the given index on each axis."""
    total = builder.integer(0)
    for axis, start in enumerate(starts):
        stride = math.prod(shape[axis + 1 :])
        if isinstance(start, int):
            start = builder.integer(start)
        step = builder.graph.op("mul", start, builder.integer(stride))
        total = builder.graph.op("add", step, total)
    return total


def _starts(
    builder: Builder,
    shape: Sequence[int],
    sizes: Sequence[int],
    starts: list[ArrayValue],
) -> list[Node]:
    """Clamp the starts of a window, so that the window lies in the array."""
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


def _dynamic_slice(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    value, *starts = values
    sizes = equation.params["slice_sizes"]
    if math.prod(sizes) == 0:
        return np.empty(sizes, object)
    starts = _starts(builder, value.shape, sizes, starts)
    if all(start.is_constant for start in starts):
        return builder.memory.rearranged(value, lambda x: x[_window(starts, sizes)])
    memory, source = builder.memory, builder.memory.in_memory(value)
    view = flat_indices(value.shape)[tuple(map(slice, sizes))]
    shift = place_in_memory(builder, value.shape, starts)
    if view.size <= MOST_IN_REGISTERS:
        out = np.empty(view.size, object)
        for index, place in enumerate(view.flat):
            out[index] = memory.load(source.buffer, shift, int(place))
        return out.reshape(sizes)
    target = memory.new(source.dtype, view.size)
    everywhere = flat_indices(sizes)
    memory.move(target, everywhere, source.buffer, view, source_shift=shift)
    return InMemory(target, sizes)


def _dynamic_update_slice(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    value, update, *starts = values
    return _updated(builder, value, update, starts)


def _write_row(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    value, row, slot = values
    axis = equation.params["axis"]
    update = row.reshape((*row.shape[:axis], 1, *row.shape[axis:]))
    starts: list[ArrayValue] = [
        slot if k == axis else builder.array(0, "int64")
        for k in range(len(value.shape))
    ]
    return _updated(builder, value, update, starts)


def _updated(
    builder: Builder, value: ArrayValue, update: ArrayValue, starts: list[ArrayValue]
) -> ArrayValue:
    """Return `value` with `update` written into it, at the given start on each axis."""
    if update.size == 0:
        return value
    places = _starts(builder, value.shape, update.shape, starts)
    is_known = all(place.is_constant for place in places)
    if is_known and not isinstance(value, InMemory) and value.size <= MOST_ONE_BY_ONE:
        out = value.copy()
        window = _window(places, update.shape)
        out[window] = builder.memory.registers(update)
        return out
    target = builder.memory.owned(value)
    view = flat_indices(value.shape)[tuple(map(slice, update.shape))]
    shift = place_in_memory(builder, value.shape, places)
    builder.memory.write(target.buffer, view, update, shift)
    return target


INDEXING: dict[str, Operation] = {
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    WRITE_ROW: _write_row,
}


_Mode = jax.lax.GatherScatterMode


class _Axes(NamedTuple):
    """The axes of an array on which a window starts at a variable index.

    - `indexed`: the axes on which the start of the window is an entry of the index.
    - `batched`: the batch axes of the array.
    - `sources`: the axes of the array of indices that correspond to `batched`.
    """

    indexed: Sequence[int]
    batched: Sequence[int]
    sources: Sequence[int]


def _located(
    builder: Builder,
    shape: Sequence[int],
    sizes: Sequence[int],
    indices: np.ndarray,
    place: tuple[int, ...],
    axes: _Axes,
) -> tuple[Node, Node]:
    """Return where a window starts in memory, and whether it lies in the array.

    The index of the window is at `place` in the array of indices. The start of a window
    outside the array is clamped.
    """
    graph = builder.graph
    starts: list[Node | int] = [0] * len(shape)
    for axis, source in zip(axes.batched, axes.sources, strict=True):
        starts[axis] = place[source]
    is_inside = graph.constant(True, "bool")
    for axis, node in zip(axes.indexed, indices[place], strict=True):
        start, most = as_index(builder, node), shape[axis] - sizes[axis]
        is_low = graph.op("ge", start, builder.integer(0))
        is_high = graph.op("le", start, builder.integer(most))
        is_inside = graph.op("and", is_inside, graph.op("and", is_low, is_high))
        starts[axis] = builder.clamped(start, most)
    return place_in_memory(builder, shape, starts), is_inside


def _mode(equation: Any) -> _Mode:
    mode = _Mode.from_any(equation.params["mode"])
    if mode not in (_Mode.CLIP, _Mode.FILL_OR_DROP, _Mode.PROMISE_IN_BOUNDS):
        raise Unsupported(f"indices out of bounds by {mode}")
    return mode


def _gather(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    value, indices = values
    numbers, sizes = (
        equation.params["dimension_numbers"],
        equation.params["slice_sizes"],
    )
    aval, is_filled = equation.outvars[0].aval, _mode(equation) is _Mode.FILL_OR_DROP
    if math.prod(aval.shape) > MOST_ONE_BY_ONE or value.size == 0:
        raise Unsupported("a gather of this size")
    indices = builder.memory.registers(indices)
    left_out = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    window = flat_indices(value.shape)[tuple(map(slice, sizes))]
    window = window.reshape([s for d, s in enumerate(sizes) if d not in left_out])
    batch = indices.shape[:-1]
    fill = _fill(builder, equation, value)
    out = np.empty((*batch, *window.shape), object)
    axes = _Axes(
        numbers.start_index_map,
        numbers.operand_batching_dims,
        numbers.start_indices_batching_dims,
    )
    for place in np.ndindex(batch):
        shift, is_inside = _located(builder, value.shape, sizes, indices, place, axes)
        for inner in np.ndindex(window.shape):
            number = _number(builder, value, shift, int(window[inner]))
            if is_filled:
                number = builder.graph.select(is_inside, number, fill)
            out[place + inner] = number
    inner_axes = list(range(len(batch), out.ndim))
    return np.moveaxis(out, inner_axes, list(numbers.offset_dims))


def _number(builder: Builder, value: ArrayValue, shift: Node, offset: int) -> Node:
    if shift.is_constant and not isinstance(value, InMemory):
        return value.reshape(-1)[int(shift.attr) + offset]
    buffer = builder.memory.in_memory(value).buffer
    return builder.memory.load(buffer, shift, offset)


def _fill(builder: Builder, equation: Any, value: ArrayValue) -> Node:
    """Return the number that a gather reads outside of the array."""
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
    op: str | None, builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    value, indices, updates = values
    numbers, is_clipped = (
        equation.params["dimension_numbers"],
        _mode(equation) is _Mode.CLIP,
    )
    if updates.size == 0 or value.size == 0:
        return value
    if updates.size > MOST_ONE_BY_ONE:
        raise Unsupported("a scatter of this size")
    indices, updates = map(builder.memory.registers, (indices, updates))
    batch = indices.shape[:-1]
    inner_axes = list(range(len(batch), updates.ndim))
    updates = np.moveaxis(updates, list(numbers.update_window_dims), inner_axes)
    left_out = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    sizes, inner_sizes = [], iter(updates.shape[len(batch) :])
    for axis in range(len(value.shape)):
        sizes.append(1 if axis in left_out else next(inner_sizes))
    window = flat_indices(value.shape)[tuple(map(slice, sizes))]
    window = window.reshape(updates.shape[len(batch) :])
    located = {}
    axes = _Axes(
        numbers.scatter_dims_to_operand_dims,
        numbers.operand_batching_dims,
        numbers.scatter_indices_batching_dims,
    )
    for place in np.ndindex(batch):
        shift, is_inside = _located(builder, value.shape, sizes, indices, place, axes)
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
    """Return the number that replaces `old`, given its update `new`."""
    if op is not None:
        return builder.graph.op(op, old, new)
    # `x.at[index].apply(function)` is a scatter that combines numbers by a program.
    jaxpr = equation.params["update_jaxpr"]
    if jaxpr is None:
        return new
    pair = [builder.full((), old), builder.full((), new)]
    out = builder.run(jaxpr, equation.params["update_consts"], pair)[0]
    return builder.memory.registers(out).item()


def _target(
    builder: Builder, value: ArrayValue, shifts: list[Node]
) -> tuple[Callable[..., Any], Callable[..., None], ArrayValue]:
    """Return functions that read and write an array, and the array after the writes."""
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
GATHERS: dict[str, Operation] = {
    "gather": _gather,
    **{name: partial(_scatter, op) for name, op in _SCATTERS.items()},
}


def _extreme(dtype: str, sign: int) -> Any:
    """Return the largest number of a dtype, or the smallest if the sign is -1."""
    if is_float(dtype):
        return sign * np.inf
    if dtype == "bool":
        return sign > 0
    return np.iinfo(dtype).max if sign > 0 else np.iinfo(dtype).min


# The operation of each reduction, and its result for an empty array of a dtype.
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
    """Move `axes` to the end, flatten them to one, and flatten the other axes to one.

    Returns the shape of the other axes, and the array with two axes.
    """
    kept = [axis for axis in range(x.ndim) if axis not in axes]
    shape = tuple(x.shape[axis] for axis in kept)
    length = math.prod(x.shape[axis] for axis in axes)
    x = x.transpose([*kept, *axes])
    return shape, x.reshape(math.prod(shape), length)


def _reduce(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    op, empty = _REDUCTIONS[equation.primitive.name]
    dtype = dtype_name(equation.outvars[0].aval.dtype)
    value, axes = values[0], [int(axis) for axis in equation.params["axes"]]
    is_whole = len(axes) == len(value.shape)
    if isinstance(value, InMemory) and is_whole and value.size > MOST_ONE_BY_ONE:
        return _reduced_in_loop(builder, op, value)
    shape, rows = _rows(builder.memory.registers(value), axes)
    out = np.empty(len(rows), object)
    for index, row in enumerate(rows):
        out[index] = builder.graph.folded(op, row)
        if out[index] is None:
            out[index] = builder.graph.constant(
                np.array(empty(dtype)).astype(dtype), dtype
            )
    return out.reshape(shape)


def _reduced_in_loop(builder: Builder, op: str, value: InMemory) -> ArrayValue:
    """Combine all numbers of an array one after the other, in a loop."""
    graph, memory = builder.graph, builder.memory
    first = memory.load(value.buffer, None)
    with LoopBuilder(graph) as loop:
        k = loop.parameter(builder.integer(1))
        total = loop.parameter(first)
        loop.goes_on_while(graph.op("lt", k, builder.integer(value.size)))
        number = memory.load(value.buffer, k)
        after = graph.op("add", k, builder.integer(1)), graph.op(op, total, number)
        loop.end(after)
    out = np.empty((), object)
    out[()] = loop.results()[1]
    return out


def _arg(
    op: str, builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    """Return the index of the first NaN or, without NaN, of the first extremum."""
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


def _cumulative(op: str, builder: Builder, equation: Any, values: list) -> ArrayValue:
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


REDUCTIONS: dict[str, Operation] = {
    **dict.fromkeys(_REDUCTIONS, _reduce),
    "argmax": partial(_arg, "gt"),
    "argmin": partial(_arg, "lt"),
    "cumsum": partial(_cumulative, "add"),
    "cumprod": partial(_cumulative, "mul"),
    "cummax": partial(_cumulative, "max"),
    "cummin": partial(_cumulative, "min"),
}
