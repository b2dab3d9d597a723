"""From a jaxpr to the graph: equations one after the other, inner programs included."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np
from jax.extend.core import DropVar, Literal

from ._buffers import hold, InMemory, Registers, release, Value
from ._graph import dtype_name, Graph, Node
from ._memory import constant, LARGE, Memory, MOST_NUMBERS, places
from ._simplify import simplify
from ._unsupported import Unsupported


# What makes the results of an equation: one array, or several if the primitive has
# several results.
Operation: TypeAlias = Callable[["Builder", Any, list[Value]], Any]


class Builder:
    """The graph of a program while it is made.

    `unroll` is the length up to which a scan is unrolled.
    """

    def __init__(self, operations: dict[str, Operation], unroll: int):
        self.graph = Graph(simplify)
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
