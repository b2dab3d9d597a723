"""Arrays in memory: large ones, and those with an index that is not known.

Loads and stores are statements, in the order of the program. A store goes into an array
that nobody else uses: who wants to store into an array that is held gets a copy.
"""

import math
from collections.abc import Callable

import numpy as np

from ._buffers import Buffer, InMemory, Registers, Value
from ._graph import Graph, Node
from ._regions import counted
from ._unsupported import Unsupported


# Arrays of more numbers than this live in memory where there is a choice.
LARGE = 128
# At most so many numbers are loaded, stored or computed one by one.
MOST_NUMBERS = 4096
# Copies of more numbers than this become loops.
_UNROLLED = 16


class Memory:
    """The loads and stores of a graph."""

    def __init__(self, graph: Graph):
        self.graph = graph

    def new(self, dtype: str, size: int) -> Buffer:
        """Make scratch memory, whose contents are not defined."""
        return Buffer("scratch", dtype, size, self.graph.region, None)

    def load(self, buffer: Buffer, index: Node | None, offset: int = 0) -> Node:
        """Load the number at `index + offset`."""
        index, offset = _split(index, offset)
        args = () if index is None else (index,)
        if buffer.kind == "constant" and index is None:
            return self.graph.constant(buffer.place[offset], buffer.dtype)
        if buffer.is_fixed:
            attr = (buffer, offset)
            return self.graph.pure("load", args, buffer.dtype, attr, buffer.region)
        key = (buffer, buffer.version, index and index.number, offset)
        loads = self.graph.region.loads
        if key not in loads:
            place = (buffer, offset)
            loads[key] = self.graph.statement("load", args, buffer.dtype, place)
        return loads[key]

    def store(
        self, buffer: Buffer, value: Node, index: Node | None, offset: int = 0
    ) -> None:
        """Store a number at `index + offset`."""
        index, offset = _split(index, offset)
        args = (value,) if index is None else (value, index)
        node = self.graph.statement("store", args, buffer.dtype, (buffer, offset))
        buffer.stores.append(node)
        buffer.version += 1

    def write(
        self, buffer: Buffer, view: np.ndarray, value: Value, shift: Node | None = None
    ) -> None:
        """Store an array at the places that `view` lists, all moved by `shift`.

        The view is one of `places`, so that it is affine in its indices.
        """
        if isinstance(value, InMemory):
            self.move(buffer, view, value.buffer, places(value.shape), shift)
            return
        flat = value.reshape(-1)
        if flat.size > _UNROLLED and all(node is flat[0] for node in flat):

            def fill(k: Node) -> None:
                index = self._sum(self.position(view, k), shift)
                self.store(buffer, flat[0], index)

            counted(self.graph, flat.size, fill)
            return
        _bound(flat.size)
        for node, place in zip(flat, view.reshape(-1), strict=True):
            self.store(buffer, node, shift, int(place))

    def move(
        self,
        target: Buffer,
        target_view: np.ndarray,
        source: Buffer,
        source_view: np.ndarray,
        target_shift: Node | None = None,
        source_shift: Node | None = None,
    ) -> None:
        """Copy numbers from some places of a buffer to some of another one."""
        if target_view.size <= _UNROLLED:
            numbers = [
                self.load(source, source_shift, int(i)) for i in source_view.flat
            ]
            for number, place in zip(numbers, target_view.flat, strict=True):
                self.store(target, number, target_shift, int(place))
            return

        def body(k: Node) -> None:
            place = self._sum(self.position(source_view, k), source_shift)
            number = self.load(source, place)
            place = self._sum(self.position(target_view, k), target_shift)
            self.store(target, number, place)

        counted(self.graph, target_view.size, body)

    def position(self, view: np.ndarray, k: Node) -> Node:
        """Find the place of the number `k` of a view, in its row-major order."""
        graph, total = self.graph, None
        first = int(view.flat[0])
        if np.array_equal(view.reshape(-1), first + np.arange(view.size)):
            return graph.op("add", k, graph.constant(first, "int64"))
        total, rest = graph.constant(first, "int64"), k
        for length, stride in zip(view.shape[::-1], view.strides[::-1], strict=True):
            size = graph.constant(length, "int64")
            index = graph.op("rem", rest, size)
            rest = graph.op("div", rest, size)
            step = graph.constant(stride // view.itemsize, "int64")
            total = graph.op("add", total, graph.op("mul", index, step))
        return total

    def _sum(self, a: Node, b: Node | None) -> Node:
        return a if b is None else self.graph.op("add", a, b)

    def tabulate(
        self, shape: tuple[int, ...], dtype: str, element: Callable[[Node], Node]
    ) -> InMemory:
        """Compute a large array element by element in a loop."""
        buffer = self.new(dtype, math.prod(shape))
        counted(
            self.graph, buffer.size, lambda k: self.store(buffer, element(k), index=k)
        )
        return InMemory(buffer, shape)

    def registers(self, value: Value) -> Registers:
        """Load an array, if it is in memory."""
        if not isinstance(value, InMemory):
            return value
        _bound(value.size)
        out = np.empty(value.size, object)
        for place in range(value.size):
            out[place] = self.load(value.buffer, None, place)
        return out.reshape(value.shape)

    def in_memory(self, value: Value) -> InMemory:
        """Put an array into memory, where nothing is stored into it afterwards.

        This happens where its last number becomes known, outside of loops in which it
        is read.
        """
        if isinstance(value, InMemory):
            return value
        flat = value.reshape(-1)
        graph = self.graph
        known = _origin(flat)
        if known is not None:
            return InMemory(known, value.shape)
        home = graph.home(flat)
        key = tuple(node.number for node in flat)
        if key not in home.spills:
            if all(node.is_constant for node in flat):
                numbers = np.array([node.attr for node in flat])
                home.spills[key] = constant(graph, numbers)
            else:
                here, graph.region = graph.region, home
                buffer = self.new(flat[0].dtype, flat.size)
                self.write(buffer, places(flat.shape), flat)
                buffer.is_fixed = True
                graph.region = here
                home.spills[key] = buffer
        return InMemory(home.spills[key], value.shape)

    def owned(self, value: Value) -> InMemory:
        """Put an array into memory that is free to be overwritten."""
        if isinstance(value, InMemory):
            buffer = value.buffer
            if not buffer.is_fixed and buffer.holders == 0:
                return value
            dtype = buffer.dtype
        else:
            dtype = value.reshape(-1)[0].dtype
        target = self.new(dtype, value.size)
        self.write(target, places(value.shape), value)
        return InMemory(target, value.shape)


def places(shape: tuple[int, ...]) -> np.ndarray:
    """Number the elements of an array in memory."""
    return np.arange(math.prod(shape)).reshape(shape)


def constant(graph: Graph, values: np.ndarray) -> Buffer:
    """Make memory of known contents."""
    flat = np.ascontiguousarray(values).reshape(-1)
    return Buffer("constant", flat.dtype.name, flat.size, graph.root, flat)


def _split(index: Node | None, offset: int) -> tuple[Node | None, int]:
    """Move the known part of an index to the offset."""
    while index is not None:
        if index.is_constant:
            return None, offset + int(index.attr)
        if index.op != "add":
            break
        known = [arg for arg in index.args if arg.is_constant]
        if not known:
            break
        offset += int(known[0].attr)
        index = index.args[0] if known[0] is index.args[1] else index.args[1]
    return index, offset


def _origin(flat: np.ndarray) -> Buffer | None:
    """Find the fixed memory that has just been loaded number by number."""
    first = flat[0]
    if first.op != "load" or first.args or not first.attr[0].is_fixed:
        return None
    buffer = first.attr[0]
    if buffer.size != flat.size:
        return None
    for place, node in enumerate(flat):
        if node.op != "load" or node.args or node.attr != (buffer, place):
            return None
    return buffer


def _bound(size: int) -> None:
    if size > MOST_NUMBERS:
        raise Unsupported(f"{size} numbers one by one")
