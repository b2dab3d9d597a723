"""Which nodes are needed, differ between lanes, and are needed as vectors."""

from ._buffers import Buffer
from ._graph import BranchInfo, LoopInfo, Node, Region


class Live:
    """The nodes that the results of a program need, by region and in order.

    A store is needed if the memory is read; a loop, if one of its results or a store in
    it is.
    """

    def __init__(self, results: list[Buffer]):
        self.nodes: list[Node] = []
        self.buffers: list[Buffer] = []
        self._waiting: list[Node] = []
        for buffer in results:
            self._need_buffer(buffer)
        while self._waiting:
            self._visit(self._waiting.pop())
        self.nodes.sort(key=lambda node: node.number)
        self.in_region: dict[Region, list[Node]] = {}
        for node in self.nodes:
            self.in_region.setdefault(node.region, []).append(node)

    def _need(self, node: Node) -> None:
        if not node.live:
            node.live = True
            self._waiting.append(node)

    def _need_buffer(self, buffer: Buffer) -> None:
        if not buffer.live:
            buffer.live = True
            self.buffers.append(buffer)
            for store in buffer.stores:
                self._need(store)

    def _visit(self, node: Node) -> None:
        self.nodes.append(node)
        for arg in node.args:
            self._need(arg)
        owner = node.region.owner
        if owner is not None:
            self._need(owner)
        if node.op == "load":
            self._need_buffer(node.attr[0])
        elif node.op == "loop" or node.op == "branch":
            self._need(node.attr.predicate)
        elif node.op == "param" or node.op == "result":
            statement, index = node.attr
            self._need(statement)
            info = statement.attr
            if isinstance(info, BranchInfo):
                self._need(info.outs[0][index])
                self._need(info.outs[1][index])
                return
            self._need(info.params[index])
            self._need(info.inits[index])
            self._need(info.outs[index])


def find_varying(live: Live, is_batched: tuple[bool, ...]) -> None:
    """Mark the nodes and the memory whose values differ between lanes.

    Values are compared between the lanes that are still running: in a loop that lanes
    leave at different times, a counter that starts equal in all of them varies after
    the loop, but not inside of it.
    """
    for buffer in live.buffers:
        if buffer.kind == "operand":
            buffer.varies = is_batched[buffer.place]
        buffer.varies |= buffer.kind == "result"
    rest = [node for node in live.nodes if not node.is_constant]
    while True:
        changed, unknown = False, []
        for node in rest:
            if _varies(node):
                node.varies = changed = True
                if node.op == "store":
                    node.attr[0].varies = True
            else:
                unknown.append(node)
        if not changed:
            return
        rest = unknown


def _varies(node: Node) -> bool:
    if node.op == "param":
        statement, index = node.attr
        return statement.attr.inits[index].varies or statement.attr.outs[index].varies
    if node.op == "result":
        statement, index = node.attr
        info = statement.attr
        if info.predicate.varies:
            return True
        if isinstance(info, LoopInfo):
            return info.params[index].varies
        return info.outs[0][index].varies or info.outs[1][index].varies
    if node.op == "load" and node.attr[0].varies:
        return True
    if node.op == "store" and is_divergent(node.region, node.attr[0].region):
        return True
    if node.op == "loop" or node.op == "branch":
        return node.attr.predicate.varies
    return any(arg.varies for arg in node.args)


def is_divergent(inner: Region, outer: Region) -> bool:
    """Tell whether lanes may be outside of a region that are in one around it."""
    region: Region | None = inner
    while region is not None and region is not outer:
        if region.owner is not None and region.owner.attr.predicate.varies:
            return True
        region = region.parent
    return False


def mark_wide(live: Live) -> None:
    """Mark the nodes that are equal in all lanes and needed as a vector."""
    for node in live.nodes:
        op = node.op
        if op in ("param", "result"):
            statement, index = node.attr
            info = statement.attr
            if isinstance(info, LoopInfo):
                param = info.params[index]
                if param.varies:
                    _widen(info.inits[index], info.outs[index])
                if info.predicate.varies and op == "result":
                    _widen(param, info.inits[index])
            elif node.varies:
                _widen(info.outs[0][index], info.outs[1][index])
        elif op == "store":
            buffer = node.attr[0]
            if buffer.varies:
                _widen(node.args[0])
            if buffer.kind == "result" and len(node.args) > 1:
                _widen(node.args[1])
        elif op == "load":
            if node.attr[0].kind == "operand" and node.varies and node.args:
                _widen(*node.args)
        elif op == "select":
            if node.varies:
                _widen(*node.args[1:])
        elif node.varies:
            _widen(*node.args)


def _widen(*nodes: Node) -> None:
    for node in nodes:
        node.is_wide = not node.varies and not node.is_constant
