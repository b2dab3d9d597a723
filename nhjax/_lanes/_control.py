"""The text of regions: loops and branches with masks of lanes."""

from ._buffers import Buffer
from ._graph import BranchInfo, LoopInfo, Node
from ._instructions import write
from ._liveness import is_divergent, Live
from ._places import Places
from ._slots import Slots
from ._types import vector
from ._writer import Text


# A side of a branch that has more nodes than this is left out if no lane takes it.
_SHORT = 24
_STATEMENTS = ("loop", "branch", "store", "load")


class Control:
    """The writer of a program's regions, its loops and branches, as blocks of LLVM.

    `mask` has the lanes that are running; None stands for all of them. At least one
    lane is, wherever instructions are written: a region that no lane enters is jumped
    over.
    """

    def __init__(self, text: Text, places: Places, live: Live):
        self.text, self.places, self.live = text, places, live
        self.mask: str | None = None
        self.labels = 0

    def region(self, nodes: list[Node]) -> None:
        """Write nodes of one region, in their order."""
        text, width = self.text, self.text.width
        for node in nodes:
            op = node.op
            if op in ("const", "zero", "param", "result"):
                continue
            if op == "loop":
                self._loop(node.attr)
            elif op == "branch":
                self._branch(node.attr)
            elif op == "store":
                self.places.store(node, self._mask_of_store(node))
            elif op == "load":
                text.define(node, self.places.load(node))
            else:
                lanes = width if node.varies else 1
                args = [text.ref(arg, node.varies) for arg in node.args]
                if op == "select":
                    args[0] = text.ref(node.args[0], node.args[0].varies)
                text.define(node, write(text, node, lanes, args))

    def _mask_of_store(self, node: Node) -> str | None:
        buffer: Buffer = node.attr[0]
        if self.mask is None or not is_divergent(node.region, buffer.region):
            return None
        return self.mask

    def _next_label(self) -> str:
        self.labels += 1
        return f"b{self.labels}"

    # Loops

    def _loop(self, loop: LoopInfo) -> None:
        text, tag = self.text, self._next_label()
        nodes = self.live.in_region.get(loop.region, [])
        before = [node for node in nodes if node.number < loop.split]
        rounds = [node for node in nodes if node.number > loop.split]
        params = [
            (node, loop.inits[index], loop.outs[index])
            for index, node in enumerate(loop.params)
            if node.live
        ]
        starts = [text.ref(init, param.varies) for param, init, _ in params]
        entry, outer = text.block, self.mask
        slots = None
        if loop.predicate.varies:
            slots = Slots(text, self.places, loop, is_partial=outer is not None)
        text.add(f"br label %{tag}.head")
        text.label(f"{tag}.head")
        open_lines = []
        for param, _, _ in params:
            param.name = text.fresh()
            open_lines.append(text.later())
        active, open_mask = text.fresh(), text.later() if slots is not None else 0
        for param, _, _ in params:
            text.define(param, param.name)
        if slots is not None:
            # Lanes that have ended do not run inner loops either.
            self.mask = active
        self.region(before)
        if slots is not None:
            self._leave(loop, tag, active, slots)
        else:
            go_on = text.ref(loop.predicate, False)
            text.add(f"br i1 {go_on}, label %{tag}.round, label %{tag}.exit")
        text.label(f"{tag}.round")
        self.region(rounds)
        last = text.block
        for line, start, (param, _, out) in zip(
            open_lines, starts, params, strict=True
        ):
            kind, after = text.kind(param, param.varies), text.ref(out, param.varies)
            phi = f"phi {kind} [ {start}, %{entry} ], [ {after}, %{last} ]"
            text.lines[line] = f"  {param.name} = {phi}"
        if slots is not None:
            flags, first = vector("i1", text.width), outer or "splat (i1 true)"
            text.lines[open_mask] = (
                f"  {active} = phi {flags} [ {first}, %{entry} ], "
                f"[ {self.mask}, %{last} ]"
            )
        text.add(f"br label %{tag}.head")
        text.label(f"{tag}.exit")
        self.mask = outer
        if slots is not None:
            slots.define()
            return
        for result in loop.results:
            if result.live:
                text.define(result, loop.params[result.attr[1]].name)

    def _leave(self, loop: LoopInfo, tag: str, active: str, slots: Slots) -> None:
        """Keep the values of lanes that end, and go on with the others.

        Lanes that have ended run on unheeded, which costs less than to stop them.
        """
        text, flags = self.text, vector("i1", self.text.width)
        go_on = text.ref(loop.predicate, True)
        going = text.value(f"and {flags} {active}, {go_on}")
        ending = text.value(f"xor {flags} {active}, {going}")
        some = text.any_of(ending)
        text.add(f"br i1 {some}, label %{tag}.end, label %{tag}.round")
        text.label(f"{tag}.end")
        slots.keep(ending)
        more = text.any_of(going)
        text.add(f"br i1 {more}, label %{tag}.round, label %{tag}.exit")
        self.mask = going

    # Branches

    def _branch(self, branch: BranchInfo) -> None:
        if branch.predicate.varies:
            self._both_sides(branch)
        else:
            self._one_side(branch)

    def _one_side(self, branch: BranchInfo) -> None:
        text, tag = self.text, self._next_label()
        predicate = text.ref(branch.predicate, False)
        text.add(f"br i1 {predicate}, label %{tag}.yes, label %{tag}.no")
        ends: list[str] = []
        needed = [result for result in branch.results if result.live]
        values: list[list[str]] = []
        for side, name in enumerate(("yes", "no")):
            text.label(f"{tag}.{name}")
            self.region(self.live.in_region.get(branch.regions[side], []))
            values.append(
                [text.ref(branch.outs[side][r.attr[1]], r.varies) for r in needed]
            )
            ends.append(text.block)
            text.add(f"br label %{tag}.join")
        text.label(f"{tag}.join")
        for result, yes, no in zip(needed, *values, strict=True):
            kind = text.kind(result, result.varies)
            result.name = text.value(
                f"phi {kind} [ {yes}, %{ends[0]} ], [ {no}, %{ends[1]} ]"
            )
        for result in needed:
            text.define(result, result.name)

    def _both_sides(self, branch: BranchInfo) -> None:
        text, flags = self.text, vector("i1", self.text.width)
        outer = self.mask
        predicate = text.ref(branch.predicate, True)
        ones = "splat (i1 true)"
        opposite = text.value(f"xor {flags} {predicate}, {ones}")
        needed = [result for result in branch.results if result.live]
        values: list[list[str]] = []
        for side, lanes in enumerate((predicate, opposite)):
            if outer is not None:
                lanes = text.value(f"and {flags} {outer}, {lanes}")
            self.mask = lanes
            region = branch.regions[side]
            outs = [branch.outs[side][result.attr[1]] for result in needed]
            nodes = self.live.in_region.get(region, [])
            if _is_long(nodes):
                values.append(self._guarded(nodes, outs))
            else:
                self.region(nodes)
                values.append([text.ref(out, True) for out in outs])
        self.mask = outer
        for result, yes, no in zip(needed, *values, strict=True):
            kind = text.kind(result, True)
            text.define(
                result,
                text.value(f"select {flags} {predicate}, {kind} {yes}, {kind} {no}"),
            )

    def _guarded(self, nodes: list[Node], outs: list[Node]) -> list[str]:
        """Write a side that is jumped over if no lane takes it."""
        text, tag = self.text, self._next_label()
        assert self.mask is not None
        some, before = text.any_of(self.mask), text.block
        text.add(f"br i1 {some}, label %{tag}.side, label %{tag}.join")
        text.label(f"{tag}.side")
        self.region(nodes)
        values, after = [text.ref(out, True) for out in outs], text.block
        text.add(f"br label %{tag}.join")
        text.label(f"{tag}.join")
        return [
            text.value(
                f"phi {text.kind(out, True)} [ {value}, %{after} ], "
                f"[ zeroinitializer, %{before} ]"
            )
            for out, value in zip(outs, values, strict=True)
        ]


def _is_long(nodes: list[Node]) -> bool:
    return len(nodes) > _SHORT or any(node.op in _STATEMENTS for node in nodes)
