"""Reading and storing at many places at once: `gather` and the kinds of `scatter`."""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from ._buffers import InMemory, Value
from ._builder import Builder, Operation
from ._graph import is_float, Node
from ._indexing import as_index, place_in_memory
from ._memory import MOST_NUMBERS, places
from ._unsupported import Unsupported


_Mode = jax.lax.GatherScatterMode


class _Axes(NamedTuple):
    """The axes of an array on which its windows start at places of their own.

    - `indexed`: those whose starts are the entries of an index.
    - `batched`: those that go along with the axes `sources` of the array of indices.
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
    """Find where a window starts in memory, and whether it lies in the array.

    Its index stands at `place` in the array of indices. If the window lies outside, the
    start is that of the nearest one inside.
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
    inner_axes = list(range(len(batch), updates.ndim))
    updates = np.moveaxis(updates, list(numbers.update_window_dims), inner_axes)
    left_out = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    sizes, inner_sizes = [], iter(updates.shape[len(batch) :])
    for axis in range(len(value.shape)):
        sizes.append(1 if axis in left_out else next(inner_sizes))
    window = places(value.shape)[tuple(map(slice, sizes))]
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
    """Combine the number in an array with its update, as a scatter stores it."""
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
GATHERS: dict[str, Operation] = {
    "gather": _gather,
    **{name: partial(_scatter, op) for name, op in _SCATTERS.items()},
}
