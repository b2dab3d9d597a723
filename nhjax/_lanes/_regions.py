"""Loops and branches while they are made: nodes go into their regions meanwhile."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from ._graph import BranchInfo, Graph, LoopInfo, Node, Region


T = TypeVar("T")


class LoopBuilder:
    """A loop whose body is made inside of a `with` statement."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self.node = Node("loop", (), "", graph.region, 0)
        self.info = LoopInfo(Region(graph.region, self.node, is_side=False))
        self.node.attr = self.info

    def __enter__(self) -> "LoopBuilder":
        self.graph.region = self.info.region
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.region = self.node.region
        # What was hoisted out of the loop has to come before it.
        self.node.number = self.graph.next_number()

    def parameter(self, init: Node) -> Node:
        """Make a number that starts as `init` and is another one in each round."""
        info = self.info
        place = (self.node, len(info.params))
        node = self.graph.statement("param", (), init.dtype, place)
        info.params.append(node)
        info.inits.append(init)
        return node

    def goes_on_while(self, predicate: Node) -> None:
        """Set the predicate; what is made afterwards belongs to rounds that happen."""
        self.info.predicate = predicate
        self.info.split = self.graph.next_number()

    def end(self, outs: Sequence[Node]) -> None:
        """Set the next values of the parameters."""
        self.info.outs = list(outs)

    def results(self) -> list[Node]:
        """Make the last values of the parameters, after the loop."""
        info, out = self.info, []
        for index, (param, init, after) in enumerate(
            zip(info.params, info.inits, info.outs, strict=True)
        ):
            # A parameter that the body returns unchanged keeps its first value.
            if after is param:
                out.append(init)
            else:
                place = (self.node, index)
                result = self.graph.statement("result", (), init.dtype, place)
                info.results.append(result)
                out.append(result)
        return out


def counted(graph: Graph, length: int, body: Callable[[Node], None]) -> None:
    """Make a loop over a counter from 0 to `length`, whose body only stores."""
    if length == 0:
        return
    with LoopBuilder(graph) as loop:
        k = loop.parameter(graph.constant(0, "int64"))
        loop.goes_on_while(graph.op("lt", k, graph.constant(length, "int64")))
        body(k)
        loop.end([graph.op("add", k, graph.constant(1, "int64"))])


class BranchBuilder:
    """A branch; its two sides are made one after the other."""

    def __init__(self, graph: Graph, predicate: Node):
        self.graph = graph
        self.node = Node("branch", (), "", graph.region, 0)
        self.info = BranchInfo(predicate)
        self.info.regions = [Region(graph.region, self.node, True) for _ in range(2)]
        self.node.attr = self.info

    def on_side(self, side: int, function: Callable[[], T]) -> T:
        """Call a function whose nodes go into one of the sides."""
        self.graph.region = self.info.regions[side]
        try:
            return function()
        finally:
            self.graph.region = self.node.region

    def close(self, yes: list[Node], no: list[Node]) -> list[Node]:
        """Choose between numbers of the two sides."""
        graph, info = self.graph, self.info
        info.outs = (yes, no)
        self.node.number = graph.next_number()
        info.results = [
            graph.statement("result", (), node.dtype, (self.node, index))
            for index, node in enumerate(yes)
        ]
        return info.results
