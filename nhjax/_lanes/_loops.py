"""Loops: arrays that go around become parameters, or stay in place in memory.

A number that goes around a loop is taken to be constant if it starts as a constant, the
body is made, and made anew without that assumption for those numbers for which it did
not hold. What was found is kept for when a loop around this one is made anew, so that
the time does not multiply with the depth of loops.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ._buffers import hold, InMemory, Registers, release, Value
from ._builder import Builder
from ._graph import Node
from ._memory import places
from ._regions import LoopBuilder


_Predicate = Callable[[list[Value]], Node]
_Body = Callable[[list[Value]], list[Value]]


def loop(
    builder: Builder,
    inits: Sequence[Value],
    in_memory: Sequence[bool],
    predicate: _Predicate,
    body: _Body,
) -> list[Value]:
    """Make a loop; the arrays that go around it are in memory or in registers."""
    memory = builder.memory
    carried: list[Value] = []
    for value, is_there in zip(inits, in_memory, strict=True):
        carried.append(memory.owned(value) if is_there else memory.registers(value))
        # The same array may go around twice, and needs two places then.
        hold(carried[-1])
    for value in carried:
        release(value)
    buffers = [value.buffer for value in carried if isinstance(value, InMemory)]
    changing = builder.changing.setdefault(tuple(builder.path), set())
    # Scalars that are integers count something.
    for start, value in _starts(carried):
        if value.ndim == 0 and value[()].dtype.startswith("int"):
            changing.add(start)
    while True:
        before = [len(buffer.stores) for buffer in buffers]
        made = _Attempt(builder, carried, changing)
        made.make(predicate, body)
        if made.runs_never:
            break
        wrong = made.wrong()
        if not wrong:
            break
        changing.update(wrong)
        for buffer, length in zip(buffers, before, strict=True):
            del buffer.stores[length:]
    if made.runs_never:
        return carried
    for buffer in buffers:
        buffer.version += 1
    return made.results()


def _starts(values: Sequence[Value]) -> list[tuple[int, Registers]]:
    """List the arrays in registers, with the position of their first numbers."""
    position, out = 0, []
    for value in values:
        if not isinstance(value, InMemory):
            out.append((position, value))
            position += value.size
    return out


class _Attempt:
    """A loop in which numbers that start as constants are taken to remain so.

    Those whose positions are in `changing` are known to change.
    """

    def __init__(self, builder: Builder, carried: list[Value], changing: set[int]):
        self.builder, self.carried = builder, carried
        self.loop = LoopBuilder(builder.graph)
        self.changing = changing
        # By position: the constants that are assumed not to change, and the positions
        # of the parameters.
        self.fixed: dict[int, Node] = {}
        self.varying: list[int] = []
        self.outs: list[Node] = []
        self.runs_never = False

    def make(self, predicate: _Predicate, body: _Body) -> None:
        """Make the loop's predicate and body."""
        with self.loop:
            arrays: list[Value] = []
            for value in self.carried:
                if isinstance(value, InMemory):
                    # What was loaded before the loop is not what it loads.
                    value.buffer.version += 1
                    arrays.append(value)
            in_registers = iter([self._parameters(*x) for x in _starts(self.carried)])
            arrays = [
                value if isinstance(value, InMemory) else next(in_registers)
                for value in self.carried
            ]
            with self.builder.held(arrays):
                go_on = predicate(arrays)
            self.loop.goes_on_while(go_on)
            self.runs_never = go_on.is_constant and not go_on.attr
            if not self.runs_never:
                self._take_over(body(arrays))

    def _parameters(self, start: int, value: Registers) -> Registers:
        out = np.empty(value.size, object)
        for index, node in enumerate(value.reshape(-1)):
            position = start + index
            if node.is_constant and position not in self.changing:
                self.fixed[position] = out[index] = node
            else:
                self.varying.append(position)
                out[index] = self.loop.parameter(node)
        return out.reshape(value.shape)

    def _take_over(self, values: list[Value]) -> None:
        """Make the values of a round those with which the next one starts."""
        memory = self.builder.memory
        own = [v.buffer for v in self.carried if isinstance(v, InMemory)]
        ready: list[Value] = []
        for value, old in zip(values, self.carried, strict=True):
            if not isinstance(old, InMemory):
                value = memory.registers(value)
            elif isinstance(value, InMemory) and value.buffer is not old.buffer:
                # It would be overwritten if it went around as another array.
                hold(value)
                value_free = memory.owned(value) if value.buffer in own else value
                release(value)
                value = value_free
            ready.append(value)
        for value, old in zip(ready, self.carried, strict=True):
            if not isinstance(old, InMemory):
                self.outs.extend(value.reshape(-1))  # pyright: ignore
            elif not (isinstance(value, InMemory) and value.buffer is old.buffer):
                memory.write(old.buffer, places(old.shape), value)
        self.loop.end([self.outs[position] for position in self.varying])

    def wrong(self) -> list[int]:
        """List the numbers that were taken to be constant and are not."""
        return [p for p, node in self.fixed.items() if self.outs[p] is not node]

    def results(self) -> list[Value]:
        """Return the arrays after the loop."""
        nodes = dict(zip(self.varying, self.loop.results(), strict=True))
        nodes.update(self.fixed)
        out: list[Value] = []
        position = 0
        for value in self.carried:
            if isinstance(value, InMemory):
                out.append(value)
                continue
            array = np.empty(value.size, object)
            for index in range(value.size):
                array[index] = nodes[position + index]
            position += value.size
            out.append(array.reshape(value.shape))
        return out
