"""The last values of a loop that lanes leave one by one, which wait in memory."""

from ._graph import LoopInfo, Node
from ._places import ALIGNMENT, Places
from ._types import bits, memory_type, vector
from ._writer import Text


class Slots:
    """Memory for each result of a loop that is needed."""

    def __init__(self, text: Text, places: Places, loop: LoopInfo, is_partial: bool):
        self.text = text
        self.slots: list[tuple[Node, Node, str]] = []
        for result in loop.results:
            if not result.live:
                continue
            index = result.attr[1]
            slot = places.slot(result.dtype)
            if is_partial:
                # Lanes that do not enter the loop must have some value.
                value = self._in_memory(loop.inits[index])
                self._store(result, value, slot)
            self.slots.append((result, loop.params[index], slot))

    def keep(self, ending: str) -> None:
        """Write the present values for the lanes of a mask."""
        text, flags = self.text, vector("i1", self.text.width)
        for result, param, slot in self.slots:
            value, kind = self._in_memory(param), self._kind(result)
            old = text.value(f"load {kind}, ptr {slot}, align {self._align(result)}")
            value = text.value(f"select {flags} {ending}, {kind} {value}, {kind} {old}")
            self._store(result, value, slot)

    def define(self) -> None:
        """Write the results after the loop."""
        for result, _, slot in self.slots:
            kind, align = self._kind(result), self._align(result)
            value = self.text.value(f"load {kind}, ptr {slot}, align {align}")
            if result.dtype == "bool":
                value = self.text.value(f"icmp ne {kind} {value}, zeroinitializer")
            self.text.define(result, value)

    def _kind(self, node: Node) -> str:
        return vector(memory_type(node.dtype), self.text.width)

    def _align(self, node: Node) -> int:
        return min(ALIGNMENT, self.text.width * bits(node.dtype) // 8)

    def _in_memory(self, node: Node) -> str:
        value = self.text.ref(node, is_wide=True)
        if node.dtype != "bool":
            return value
        flags = vector("i1", self.text.width)
        return self.text.value(f"zext {flags} {value} to {self._kind(node)}")

    def _store(self, node: Node, value: str, slot: str) -> None:
        align = self._align(node)
        self.text.add(f"store {self._kind(node)} {value}, ptr {slot}, align {align}")
