"""Arrays in memory: large ones, and those with an index that is not known.

Loads and stores are statements, in the order of the program. A store goes into an array
that nobody else uses: who wants to store into an array that is held gets a copy.

From a jaxpr to the graph: equations one after the other, inner programs included.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
from jax.extend.core import DropVar, Literal

from ._graph import Buffer, counted, dtype_name, Graph, Node, Unsupported


# An array of nodes: each number has a name of its own.
Registers: TypeAlias = np.ndarray[Any, Any]


class InMemory:
    """An array that is the whole of a buffer, in row-major order."""

    __slots__ = ("buffer", "shape")

    def __init__(self, buffer: Buffer, shape: tuple[int, ...]):
        self.buffer, self.shape = buffer, tuple(shape)

    @property
    def size(self) -> int:
        """The number of elements."""
        return self.buffer.size

    @property
    def dtype(self) -> str:
        """The name of the dtype of the elements."""
        return self.buffer.dtype

    def reshape(self, shape: tuple[int, ...]) -> "InMemory":
        """Return the same memory in another shape."""
        return InMemory(self.buffer, shape)


Value: TypeAlias = Registers | InMemory


def hold(value: Value) -> None:
    """Keep an array in memory from being overwritten."""
    if isinstance(value, InMemory):
        value.buffer.holders += 1


def release(value: Value) -> None:
    """Allow a piece of memory that `hold` has kept to be used again."""
    if isinstance(value, InMemory):
        value.buffer.holders -= 1


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


# What makes the results of an equation: one array, or several if the primitive has
# several results.
Operation: TypeAlias = Callable[["Builder", Any, list[Value]], Any]


class Builder:
    """The graph of a program while it is made.

    `unroll` is the length up to which a scan is unrolled.
    """

    def __init__(self, operations: dict[str, Operation], unroll: int):
        self.graph = Graph()
        self.memory = Memory(self.graph)
        self.operations, self.unroll = operations, unroll
        # The equations around the present one, which name it.
        self.path: list[int] = []
        # For each loop, by its path, the numbers that are known not to be constant.
        self.changing: dict[tuple[int, ...], set[int]] = {}
        self._last_uses: dict[int, tuple[Any, list[list[Any]]]] = {}

    def run(
        self, jaxpr: Any, consts: Sequence[Any], args: Sequence[Value]
    ) -> list[Value]:
        """Compute the results of a jaxpr."""
        if jaxpr.effects:
            raise Unsupported(f"effects: {', '.join(map(str, jaxpr.effects))}")
        env: dict[Any, Value] = {}

        def bind(variable: Any, value: Value) -> None:
            hold(value)
            env[variable] = value

        def read(variable: Any) -> Value:
            if isinstance(variable, Literal):
                aval: Any = variable.aval
                return self.array(variable.val, dtype_name(aval.dtype))
            return env[variable]

        for variable, value in zip(jaxpr.constvars, consts, strict=True):
            bind(variable, self.constant(value, variable.aval))
        for variable, value in zip(jaxpr.invars, args, strict=True):
            bind(variable, value)
        for equation, last in zip(jaxpr.eqns, self.last_uses(jaxpr), strict=True):
            values = [read(variable) for variable in equation.invars]
            # What nobody else holds may be overwritten by the equation.
            for variable in last:
                release(env.pop(variable))
            self.path.append(id(equation))
            outs = self.equation(equation, values)
            self.path.pop()
            for variable, value in zip(equation.outvars, outs, strict=True):
                if tuple(value.shape) != tuple(variable.aval.shape):
                    raise AssertionError(equation.primitive.name, value.shape)
                if not isinstance(variable, DropVar):
                    bind(variable, value)
        outs = [read(variable) for variable in jaxpr.outvars]
        for value in env.values():
            release(value)
        return outs

    def equation(self, equation: Any, values: list[Value]) -> list[Value]:
        """Compute the results of one equation."""
        name = equation.primitive.name
        operation = self.operations.get(name)
        if operation is None:
            raise Unsupported(f"the primitive {name}")
        for variable in equation.outvars:
            dtype_name(variable.aval.dtype)
        try:
            outs = operation(self, equation, values)
        except KeyError as error:
            # Another release of JAX may have other parameters.
            parameter = error.args[0]
            if not isinstance(parameter, str) or parameter in equation.params:
                raise
            raise Unsupported(f"{name} without its {parameter}") from error
        return list(outs) if equation.primitive.multiple_results else [outs]

    def last_uses(self, jaxpr: Any) -> list[list[Any]]:
        """List for each equation the variables that nothing after it uses."""
        known = self._last_uses.get(id(jaxpr))
        if known is not None:
            return known[1]
        used = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
        lists = []
        for equation in reversed(jaxpr.eqns):
            now = {v for v in equation.invars if not isinstance(v, Literal)} - used
            used |= now
            lists.append(list(now))
        # The jaxpr is kept, so that its identity is not reused.
        self._last_uses[id(jaxpr)] = (jaxpr, lists[::-1])
        return lists[::-1]

    @contextmanager
    def held(self, values: Sequence[Value]) -> Iterator[None]:
        """Keep arrays from being overwritten inside of a `with` statement."""
        for value in values:
            hold(value)
        yield
        for value in values:
            release(value)

    # Arrays

    def array(self, values: Any, dtype: str) -> Registers:
        """Make an array of constants."""
        values = np.asarray(values)
        out = np.empty(values.shape, object)
        for index in np.ndindex(values.shape):
            out[index] = self.graph.constant(values[index], dtype)
        return out

    def constant(self, value: Any, aval: Any) -> Value:
        """Make an array of constants, in memory if it is large."""
        dtype = dtype_name(aval.dtype)
        values = np.asarray(value)
        if values.size > LARGE:
            return InMemory(constant(self.graph, values), values.shape)
        return self.array(values, dtype)

    def full(self, shape: tuple[int, ...], node: Node) -> Registers:
        """Make an array of one number everywhere, which takes no space."""
        out = np.empty((), object)
        out[()] = node
        return np.broadcast_to(out, shape)

    def index(self, value: Value) -> Node:
        """Read a scalar as an index."""
        node = self.memory.registers(value).reshape(-1)[0]
        return self.graph.convert(node, "int64")

    def integer(self, value: int) -> Node:
        """Make an integer constant, for indices."""
        return self.graph.constant(value, "int64")

    def clamped(self, index: Node, most: int) -> Node:
        """Bring an index into the range from 0 to `most`."""
        index = self.graph.op("max", index, self.integer(0))
        return self.graph.op("min", index, self.integer(most))

    def element(self, value: Value, shape: tuple[int, ...], k: Node) -> Node:
        """Read the number `k` of an array that is broadcast to a shape, in its order.

        Axes of length one are broadcast, and scalars.
        """
        if not isinstance(value, InMemory):
            if _is_uniform(value):
                return value.reshape(-1)[0]
            value = self.memory.in_memory(value)
        view = np.broadcast_to(places(value.shape), shape)
        return self.memory.load(value.buffer, self.memory.position(view, k))

    def each(
        self,
        shape: tuple[int, ...],
        dtype: str,
        function: Callable[..., Node],
        *values: Value,
    ) -> Value:
        """Apply a function to the numbers of arrays, one after the other."""
        size = math.prod(shape)
        values = tuple(
            value.reshape(shape) if value.size == size else value for value in values
        )
        if size > LARGE and any(isinstance(value, InMemory) for value in values):
            return self.memory.tabulate(
                shape,
                dtype,
                lambda k: function(*[self.element(x, shape, k) for x in values]),
            )
        arrays = [self.memory.registers(value) for value in values]
        if size > 1 and all(map(_is_uniform, arrays)):
            node = function(*[array.reshape(-1)[0] for array in arrays])
            return self.full(shape, node)
        if size > MOST_NUMBERS:
            raise Unsupported(f"{size} numbers one by one")
        flat = [
            array.reshape(-1)
            if array.shape == tuple(shape)
            else np.broadcast_to(array, shape).reshape(-1)
            for array in arrays
        ]
        out = np.empty(size, object)
        for index, numbers in enumerate(zip(*flat, strict=True)):
            out[index] = function(*numbers)
        return out.reshape(shape)


def _is_uniform(value: Registers) -> bool:
    return value.size == 1 or (value.size > 0 and not any(value.strides))
