"""Conversion of a jaxpr to the graph: equation by equation, with inner programs.

An array is either in registers, as a NumPy array of nodes, or in memory. Large arrays
are in memory, and so are arrays that are read or updated at an index that is known only
at run time. `Builder.run` interprets a jaxpr: for each equation it calls the operation
that `_elementwise`, `_arrays` or `_control_flow` provides for the primitive.

Loads and stores are statements in the order of the program. A store overwrites an array
only if the array has no other users: `hold` and `release` count the users, and an array
with other users is copied first.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
from jax.extend.core import DropVar, Literal

from ._graph import (
    Buffer,
    counted_loop,
    dtype_name,
    Functions,
    Graph,
    Node,
    Unsupported,
)


# An array in registers: a node for each number.
Registers: TypeAlias = np.ndarray[Any, Any]


class InMemory:
    """An array that fills a buffer, in row-major order."""

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


ArrayValue: TypeAlias = Registers | InMemory


def hold(value: ArrayValue) -> None:
    """Protect an array in memory from being overwritten."""
    if isinstance(value, InMemory):
        value.buffer.holders += 1


def release(value: ArrayValue) -> None:
    """Undo `hold`."""
    if isinstance(value, InMemory):
        value.buffer.holders -= 1


# Arrays with more numbers than this are in memory, unless they must be in registers.
MOST_IN_REGISTERS = 128
# For arrays with more numbers than this, loads, stores and computations are not written
# number by number: a loop is used, or the program is refused.
MOST_ONE_BY_ONE = 4096
# Copies of more numbers than this become loops.
_LONGEST_UNROLLED = 16


class Memory:
    """The loads and stores of a graph."""

    def __init__(self, graph: Graph):
        self.graph = graph

    def new(self, dtype: str, size: int) -> Buffer:
        """Allocate scratch memory, whose contents are undefined."""
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
        self,
        buffer: Buffer,
        view: np.ndarray,
        value: ArrayValue,
        shift: Node | None = None,
    ) -> None:
        """Store an array at the indices in `view`, all shifted by `shift`.

        The view is a slice of `flat_indices`, so that its entries are affine functions
        of their positions.
        """
        if isinstance(value, InMemory):
            self.move(buffer, view, value.buffer, flat_indices(value.shape), shift)
            return
        flat = value.reshape(-1)
        if flat.size > _LONGEST_UNROLLED and all(node is flat[0] for node in flat):

            def fill(k: Node) -> None:
                index = self._sum(self.position(view, k), shift)
                self.store(buffer, flat[0], index)

            counted_loop(self.graph, flat.size, fill)
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
        """Copy numbers from indices of one buffer to indices of another buffer."""
        if target_view.size <= _LONGEST_UNROLLED:
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

        counted_loop(self.graph, target_view.size, body)

    def position(self, view: np.ndarray, k: Node) -> Node:
        """Return the index in memory of element `k` of a view, in row-major order."""
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

    def rearranged(
        self, value: ArrayValue, move: Callable[[np.ndarray], np.ndarray]
    ) -> ArrayValue:
        """Apply `move`, which rearranges a NumPy array and returns a view of it."""
        if not isinstance(value, InMemory):
            return move(value)
        view = move(flat_indices(value.shape))
        if view.size <= MOST_IN_REGISTERS:
            out = np.empty(view.size, object)
            for index, place in enumerate(view.flat):
                out[index] = self.load(value.buffer, None, int(place))
            return out.reshape(view.shape)
        target = self.new(value.dtype, view.size)
        self.move(target, flat_indices(view.shape), value.buffer, view)
        return InMemory(target, view.shape)

    def tabulate(
        self, shape: tuple[int, ...], dtype: str, element: Callable[[Node], Node]
    ) -> InMemory:
        """Compute a large array element by element in a loop."""
        buffer = self.new(dtype, math.prod(shape))
        counted_loop(
            self.graph, buffer.size, lambda k: self.store(buffer, element(k), index=k)
        )
        return InMemory(buffer, shape)

    def registers(self, value: ArrayValue) -> Registers:
        """Return an array in registers; an array in memory is loaded."""
        if not isinstance(value, InMemory):
            return value
        _bound(value.size)
        out = np.empty(value.size, object)
        for place in range(value.size):
            out[place] = self.load(value.buffer, None, place)
        return out.reshape(value.shape)

    def in_memory(self, value: ArrayValue) -> InMemory:
        """Put an array into memory that is not changed afterwards.

        The array is stored in the region in which its last number becomes known. It is
        not stored again in a loop that only reads it.
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
                self.write(buffer, flat_indices(flat.shape), flat)
                buffer.is_fixed = True
                graph.region = here
                home.spills[key] = buffer
        return InMemory(home.spills[key], value.shape)

    def owned(self, value: ArrayValue) -> InMemory:
        """Put an array into memory that may be overwritten."""
        if isinstance(value, InMemory):
            buffer = value.buffer
            if not buffer.is_fixed and buffer.holders == 0:
                return value
            dtype = buffer.dtype
        else:
            dtype = value.reshape(-1)[0].dtype
        target = self.new(dtype, value.size)
        self.write(target, flat_indices(value.shape), value)
        return InMemory(target, value.shape)


def flat_indices(shape: tuple[int, ...]) -> np.ndarray:
    """Return the indices in memory of the elements of an array."""
    return np.arange(math.prod(shape)).reshape(shape)


def constant(graph: Graph, values: np.ndarray) -> Buffer:
    """Create memory with known contents."""
    flat = np.ascontiguousarray(values).reshape(-1)
    return Buffer("constant", flat.dtype.name, flat.size, graph.root, flat)


def _split(index: Node | None, offset: int) -> tuple[Node | None, int]:
    """Move the constant part of an index to the offset, and return both."""
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
    """Return the memory from which exactly these numbers were loaded, in this order.

    The result is `None` if there is no such memory, or if it may still change.
    """
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
    if size > MOST_ONE_BY_ONE:
        raise Unsupported(f"{size} numbers one by one")


# A function that computes the results of an equation: one array, or a list of arrays if
# the primitive has multiple results.
Operation: TypeAlias = Callable[["Builder", Any, list[ArrayValue]], Any]


class Builder:
    """The graph of a program while it is built.

    `unroll` is the length up to which a scan is unrolled.
    """

    def __init__(self, operations: dict[str, Operation], unroll: int):
        self.graph = Graph()
        self.memory = Memory(self.graph)
        self.operations, self.unroll = operations, unroll
        # The place of the current equation: the ids of the enclosing equations, the
        # side of each enclosing branch and the index of each unrolled iteration.
        self.path: list[int] = []
        # For the path of each loop, the positions of carried numbers that change.
        self.changing: dict[tuple[int, ...], set[int]] = {}
        # For each number carried by a loop that continues an earlier loop: the constant
        # with which the number started in the earlier loop.
        self.loop_starts: dict[Node, Node] = {}
        self.functions = Functions()
        # Whether called programs are currently written out, instead of becoming
        # functions.
        self.is_written_out = False
        self._last_uses: dict[int, tuple[Any, list[list[Any]]]] = {}

    def run(
        self, jaxpr: Any, consts: Sequence[Any], args: Sequence[ArrayValue]
    ) -> list[ArrayValue]:
        """Compute the results of a jaxpr."""
        if jaxpr.effects:
            raise Unsupported(f"effects: {', '.join(map(str, jaxpr.effects))}")
        env: dict[Any, ArrayValue] = {}

        def bind(variable: Any, value: ArrayValue) -> None:
            hold(value)
            env[variable] = value

        def read(variable: Any) -> ArrayValue:
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
            # The equation may overwrite an array that has no other users.
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

    def run_body(self, body: Any, args: Sequence[ArrayValue]) -> list[ArrayValue]:
        """Compute the results of the body of a loop, a closed jaxpr.

        The programs that the body calls are written out, unless the body contains a
        loop of unknown length (`has_iteration`).
        """
        outer = self.is_written_out
        self.is_written_out = outer or not has_iteration(body.jaxpr)
        out = self.run(body.jaxpr, body.consts, args)
        self.is_written_out = outer
        return out

    def equation(self, equation: Any, values: list[ArrayValue]) -> list[ArrayValue]:
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
            # Another release of JAX may have different parameters.
            parameter = error.args[0]
            if not isinstance(parameter, str) or parameter in equation.params:
                raise
            raise Unsupported(f"{name} without its {parameter}") from error
        return list(outs) if equation.primitive.multiple_results else [outs]

    def last_uses(self, jaxpr: Any) -> list[list[Any]]:
        """List for each equation the variables whose last use it is."""
        known = self._last_uses.get(id(jaxpr))
        if known is not None:
            return known[1]
        used = {v for v in jaxpr.outvars if not isinstance(v, Literal)}
        lists = []
        for equation in reversed(jaxpr.eqns):
            now = {v for v in equation.invars if not isinstance(v, Literal)} - used
            used |= now
            lists.append(list(now))
        # The jaxpr is stored too, so that no other object gets the same identity.
        self._last_uses[id(jaxpr)] = (jaxpr, lists[::-1])
        return lists[::-1]

    @contextmanager
    def held(self, values: Sequence[ArrayValue]) -> Iterator[None]:
        """Protect arrays from being overwritten inside a `with` statement."""
        for value in values:
            hold(value)
        yield
        for value in values:
            release(value)

    # Arrays

    def array(self, values: Any, dtype: str) -> Registers:
        """Create an array of constants."""
        values = np.asarray(values)
        out = np.empty(values.shape, object)
        for index in np.ndindex(values.shape):
            out[index] = self.graph.constant(values[index], dtype)
        return out

    def constant(self, value: Any, aval: Any) -> ArrayValue:
        """Create an array of constants, in memory if it is large."""
        dtype = dtype_name(aval.dtype)
        values = np.asarray(value)
        if values.size > MOST_IN_REGISTERS:
            return InMemory(constant(self.graph, values), values.shape)
        return self.array(values, dtype)

    def full(self, shape: tuple[int, ...], node: Node) -> Registers:
        """Create an array with the same number everywhere, as a broadcast view."""
        out = np.empty((), object)
        out[()] = node
        return np.broadcast_to(out, shape)

    def index(self, value: ArrayValue) -> Node:
        """Convert a scalar to an index, which is a node of int64."""
        node = self.memory.registers(value).reshape(-1)[0]
        return self.graph.convert(node, "int64")

    def integer(self, value: int) -> Node:
        """Create an integer constant, for indices."""
        return self.graph.constant(value, "int64")

    def clamped(self, index: Node, most: int) -> Node:
        """Clamp an index to the range from 0 to `most`."""
        index = self.graph.op("max", index, self.integer(0))
        return self.graph.op("min", index, self.integer(most))

    def element(self, value: ArrayValue, shape: tuple[int, ...], k: Node) -> Node:
        """Read element `k` of an array that is broadcast to a shape.

        Axes of length one are broadcast, and so are scalars.
        """
        if not isinstance(value, InMemory):
            if _is_uniform(value):
                return value.reshape(-1)[0]
            value = self.memory.in_memory(value)
        view = np.broadcast_to(flat_indices(value.shape), shape)
        return self.memory.load(value.buffer, self.memory.position(view, k))

    def map_numbers(
        self,
        shape: tuple[int, ...],
        dtype: str,
        function: Callable[..., Node],
        *values: ArrayValue,
    ) -> ArrayValue:
        """Apply a function to the numbers of arrays, one after the other."""
        size = math.prod(shape)
        values = tuple(
            value.reshape(shape) if value.size == size else value for value in values
        )
        if size > MOST_IN_REGISTERS and any(
            isinstance(value, InMemory) for value in values
        ):
            return self.memory.tabulate(
                shape,
                dtype,
                lambda k: function(*[self.element(x, shape, k) for x in values]),
            )
        arrays = [self.memory.registers(value) for value in values]
        if size > 1 and all(map(_is_uniform, arrays)):
            node = function(*[array.reshape(-1)[0] for array in arrays])
            return self.full(shape, node)
        if size > MOST_ONE_BY_ONE:
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


# The primitives that only run an inner program. `eval_jaxpr` is the name of
# `closed_call` since JAX 0.12.
CALLS = frozenset(
    """
    checkpoint closed_call core_call custom_jvp_call custom_vjp_call
    custom_vjp_call_jaxpr eval_jaxpr jit kept_call cpu_kernel pjit remat remat2
    """.split()  # noqa: SIM905
)
_PROGRAM_KEYS = ("jaxpr", "call_jaxpr", "program", "fun_jaxpr")


def called_program(equation: Any) -> Any:
    """Return the inner program of an equation, or `None` if it has none."""
    params = equation.params
    return next((params[key] for key in _PROGRAM_KEYS if key in params), None)


def inner_programs(equation: Any) -> Iterator[tuple[Any, int]]:
    """List the inner programs of an equation, with the index of their first operand.

    The operands of the body of a loop start with the constants of the body.
    """
    params, name = equation.params, equation.primitive.name
    if name == "while":
        # The operands of the body follow after the constants of the predicate.
        yield params["body_jaxpr"].jaxpr, params["cond_nconsts"]
    elif name == "cond":
        for branch in params["branches"]:
            yield branch.jaxpr, 1
    else:
        inner = called_program(equation)
        if inner is not None:
            yield getattr(inner, "jaxpr", inner), 0


def has_iteration(jaxpr: Any) -> bool:
    """Return whether a program has a loop whose length is not known beforehand."""
    return any(
        _is_iteration(equation)
        or any(has_iteration(inner) for inner, _ in inner_programs(equation))
        for equation in jaxpr.eqns
    )


def _is_iteration(equation: Any) -> bool:
    if equation.primitive.name != "while":
        return False
    tests = equation.params["cond_jaxpr"].jaxpr.eqns
    is_counted = len(tests) == 1 and any(
        isinstance(x, Literal) and np.issubdtype(x.aval.dtype, np.integer)  # pyright: ignore
        for x in tests[0].invars
    )
    return not is_counted


def sizes_of_scan(params: dict[str, Any]) -> tuple[int, int]:
    """Return the number of constants of a scan, and the number of carried arrays."""
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    # Since JAX 0.12 a scan has the tree structures of its operands instead.
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts), len(carry)


def _is_uniform(value: Registers) -> bool:
    return value.size == 1 or (value.size > 0 and not any(value.strides))
