"""The text of LLVM of a program's kernel.

Nothing but the kernel's scratch memory is allocated: on the stack up to 64 kB, beyond
that by `malloc`, and programs that need more than 64 MB are refused.

Which nodes are needed, differ between lanes, and are needed as vectors.

The text of regions: loops and branches with masks of lanes.

The last values of a loop that lanes leave one by one, which wait in memory.

Loads and stores of lanes, as text of LLVM.

Scratch memory whose contents differ between lanes holds for each number the lanes side
by side, so that an index that all lanes share loads a vector. Of an operand of the
batch, and of a result, the members lie one after the other.
"""

import numpy as np

from ._graph import BranchInfo, Buffer, LoopInfo, Node, Region, Unsupported
from ._instructions import write
from ._writer import bits, literal, memory_type, suffix, Text, vector


# Scratch memory is aligned to this many bytes, and so is each array in it.
ALIGNMENT = 64


class Places:
    """Where the arrays of a kernel lie in memory."""

    def __init__(self, text: Text, buffers: list[Buffer]):
        self.text, self.width = text, text.width
        # Bytes of scratch memory.
        self.size = 0
        self._bases: dict[Buffer, str] = {}
        self._members: dict[int, str] = {}
        order = {"operand": 0, "result": 1, "constant": 2, "scratch": 3}
        for buffer in sorted(buffers, key=lambda buffer: order[buffer.kind]):
            self._bases[buffer] = self._base(buffer)

    def allocate(self, lanes: int, dtype: str, size: int = 1) -> int:
        """Reserve scratch memory, and return its offset."""
        offset = self.size
        count = lanes * size * bits(dtype) // 8
        self.size += -(-count // ALIGNMENT) * ALIGNMENT
        return offset

    def slot(self, dtype: str) -> str:
        """Reserve scratch memory for a number of each lane, and return the pointer."""
        return self._scratch(self.allocate(self.width, dtype))

    def _scratch(self, offset: int) -> str:
        return self.text.value(f"getelementptr i8, ptr %scratch, i64 {offset}")

    def _base(self, buffer: Buffer) -> str:
        """Write what all accesses to a buffer start from, before anything else."""
        text, kind = self.text, memory_type(buffer.dtype)
        if buffer.kind == "scratch":
            lanes = self.width if buffer.varies else 1
            return self._scratch(self.allocate(lanes, buffer.dtype, buffer.size))
        if buffer.kind == "constant":
            return self._constant(buffer)
        array = "%operands" if buffer.kind == "operand" else "%results"
        place = text.value(f"getelementptr ptr, ptr {array}, i64 {buffer.place}")
        start = text.value(f"load ptr, ptr {place}")
        if buffer.kind == "operand" and not self._is_batched(buffer):
            return start
        # The pointers to the first numbers of the members.
        index, members = vector("i64", self.width), self._member(buffer.size)
        return text.value(f"getelementptr {kind}, ptr {start}, {index} {members}")

    def _is_batched(self, buffer: Buffer) -> bool:
        return buffer.kind == "result" or (buffer.kind == "operand" and buffer.varies)

    def _member(self, size: int) -> str:
        if size not in self._members:
            index = vector("i64", self.width)
            by = self.text.splat(str(size), "int64", self.width)
            self._members[size] = self.text.value(f"mul {index} %members, {by}")
        return self._members[size]

    def _constant(self, buffer: Buffer) -> str:
        kind = memory_type(buffer.dtype)
        values = (
            buffer.place.astype(np.uint8) if buffer.dtype == "bool" else buffer.place
        )
        dtype = "uint8" if buffer.dtype == "bool" else buffer.dtype
        name = f"@constant.{len(self.text.globals)}"
        numbers = ", ".join(f"{kind} {literal(value, dtype)}" for value in values)
        self.text.globals.append(
            f"{name} = internal constant [{buffer.size} x {kind}] [{numbers}], align 64"
        )
        return name

    # Addresses

    def _address(
        self, buffer: Buffer, index: Node | None, offset: int
    ) -> tuple[str, bool]:
        """Write the address of a number; tell whether it is one for each lane."""
        text, kind = self.text, memory_type(buffer.dtype)
        base, is_batched = self._bases[buffer], self._is_batched(buffer)
        if buffer.kind == "scratch" and buffer.varies:
            if index is not None and index.varies:
                return self._lane_address(buffer, index, offset), True
            # The lanes of a number are one vector.
            kind = vector(kind, self.width)
        is_vector = self.width > 1 and is_batched
        pointer = base
        if index is not None:
            many = index.varies or (is_vector and self.width > 1)
            of_index = text.ref(index, is_wide=many)
            start = vector("ptr", self.width if is_vector else 1)
            by = vector("i64", self.width if many else 1)
            pointer = text.value(
                f"getelementptr {kind}, {start} {pointer}, {by} {of_index}"
            )
            is_vector = many
        if offset:
            start = vector("ptr", self.width if is_vector else 1)
            pointer = text.value(
                f"getelementptr {kind}, {start} {pointer}, i64 {offset}"
            )
        return pointer, is_vector

    def _lane_address(self, buffer: Buffer, index: Node, offset: int) -> str:
        text, by = self.text, vector("i64", self.width)
        first = ", ".join(
            f"i64 {offset * self.width + lane}" for lane in range(self.width)
        )
        size = text.splat(str(self.width), "int64", self.width)
        start = text.value(f"mul {by} {text.ref(index, True)}, {size}")
        place = text.value(f"add {by} {start}, <{first}>")
        kind = memory_type(buffer.dtype)
        return text.value(
            f"getelementptr {kind}, ptr {self._bases[buffer]}, {by} {place}"
        )

    def _alignment(self, buffer: Buffer, lanes: int) -> int:
        return min(ALIGNMENT, lanes * bits(buffer.dtype) // 8)

    def load(self, node: Node) -> str:
        """Write a load, and return the name of the number."""
        buffer, offset = node.attr
        index = node.args[0] if node.args else None
        pointer, is_vector = self._address(buffer, index, offset)
        text, scalar = self.text, memory_type(buffer.dtype)
        lanes = self.width if node.varies else 1
        kind = vector(scalar, lanes)
        if is_vector:
            out = self._gather(pointer, buffer)
        else:
            known = (
                ", !invariant.load !0"
                if buffer.is_fixed and buffer.kind == "operand"
                else ""
            )
            align = self._alignment(buffer, lanes)
            out = text.value(f"load {kind}, ptr {pointer}, align {align}{known}")
        if buffer.dtype == "bool":
            zero = text.splat("0", "uint8", lanes)
            out = text.value(f"icmp ne {kind} {out}, {zero}")
        return out

    def _gather(self, pointer: str, buffer: Buffer) -> str:
        name, kind = self._masked("gather", buffer)
        pointers, flags = f"<{self.width} x ptr>", f"<{self.width} x i1>"
        self.text.declare(
            name, f"declare {kind} @{name}({pointers}, i32, {flags}, {kind})"
        )
        align = bits(buffer.dtype) // 8
        return self.text.value(
            f"call {kind} @{name}({pointers} {pointer}, i32 {align}, "
            f"{flags} splat (i1 true), {kind} poison)"
        )

    def _masked(self, operation: str, buffer: Buffer) -> tuple[str, str]:
        """Return the name of LLVM's masked gather or scatter, and the type it moves."""
        name = f"llvm.masked.{operation}.{suffix(buffer.dtype, self.width, True)}"
        kind = vector(memory_type(buffer.dtype), self.width)
        return f"{name}.v{self.width}p0", kind

    def store(self, node: Node, mask: str | None) -> None:
        """Write a store, for the lanes of a mask if there is one."""
        buffer, offset = node.attr
        number, *rest = node.args
        index = rest[0] if rest else None
        text = self.text
        is_wide = self.width > 1 and (buffer.varies or buffer.kind == "result")
        lanes = self.width if is_wide else 1
        value = text.ref(number, is_wide)
        kind = vector(memory_type(buffer.dtype), lanes)
        if buffer.dtype == "bool":
            value = text.value(f"zext {vector('i1', lanes)} {value} to {kind}")
        pointer, is_vector = self._address(buffer, index, offset)
        if is_vector:
            self._scatter(value, pointer, buffer, mask)
            return
        align = self._alignment(buffer, lanes)
        if mask is not None:
            old = text.value(f"load {kind}, ptr {pointer}, align {align}")
            flags = vector("i1", lanes)
            value = text.value(f"select {flags} {mask}, {kind} {value}, {kind} {old}")
        text.add(f"store {kind} {value}, ptr {pointer}, align {align}")

    def _scatter(
        self, value: str, pointer: str, buffer: Buffer, mask: str | None
    ) -> None:
        name, kind = self._masked("scatter", buffer)
        pointers, flags = f"<{self.width} x ptr>", f"<{self.width} x i1>"
        self.text.declare(
            name, f"declare void @{name}({kind}, {pointers}, i32, {flags})"
        )
        align = bits(buffer.dtype) // 8
        self.text.add(
            f"call void @{name}({kind} {value}, {pointers} {pointer}, i32 {align}, "
            f"{flags} {mask or 'splat (i1 true)'})"
        )


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


_STACK = 2**16
_MOST_SCRATCH = 2**26


def emit(
    root: Region,
    results: list[Buffer],
    is_batched: tuple[bool, ...],
    width: int,
    contract: bool,
) -> tuple[str, dict[tuple[str, str, int], None]]:
    """Write the kernel of a graph; return its module without elementary functions."""
    live = Live(results)
    if width > 1:
        find_varying(live, is_batched)
        mark_wide(live)
    else:
        for buffer in live.buffers:
            # The member is part of the address even so.
            buffer.varies = buffer.kind == "operand" and is_batched[buffer.place]
    text = Text(width, "contract" if contract else "")
    places = Places(text, live.buffers)
    control = Control(text, places, live)
    control.region(live.in_region.get(root, []))
    text.add("ret void")
    if places.size > _MOST_SCRATCH:
        raise Unsupported(f"{places.size} bytes of scratch memory")
    return _module(text, places.size), text.wanted


def _module(text: Text, size: int) -> str:
    first = [
        "define internal void @member(ptr %operands, ptr %results, i64 %first, "
        "i64 %last, ptr noalias %scratch) noinline nounwind {",
        "entry:",
        *_members(text.width),
    ]
    size = max(size, ALIGNMENT)
    call = (
        "call void @member(ptr %operands, ptr %results, i64 %first, i64 %last, "
        "ptr %scratch)"
    )
    if size <= _STACK:
        body = [
            f"  %scratch = alloca [{size} x i8], align {ALIGNMENT}",
            f"  {call}",
            "  ret i1 false",
        ]
    else:
        body = [
            f"  %piece = call ptr @malloc(i64 {size + ALIGNMENT})",
            "  %is_lacking = icmp eq ptr %piece, null",
            "  br i1 %is_lacking, label %lacking, label %run",
            "lacking:",
            "  ret i1 true",
            "run:",
            f"  %up = getelementptr i8, ptr %piece, i64 {ALIGNMENT - 1}",
            f"  %scratch = call ptr @llvm.ptrmask.p0.i64(ptr %up, i64 -{ALIGNMENT})",
            f"  {call}",
            "  call void @free(ptr %piece)",
            "  ret i1 false",
        ]
        text.declare("malloc", "declare ptr @malloc(i64)")
        text.declare("free", "declare void @free(ptr)")
    lines = [
        *text.globals,
        *first,
        *text.lines,
        "}",
        "define i1 @kernel(ptr %operands, ptr %results, i64 %first, i64 %last) {",
        *body,
        "}",
        *text.declared.values(),
        "!0 = !{}",
    ]
    return "\n".join(lines) + "\n"


def _members(width: int) -> list[str]:
    """Write the numbers of the members in the lanes."""
    if width == 1:
        return ["  %members = add i64 %first, 0"]
    lines, whole, kind = [], "poison", vector("i64", width)
    for lane in range(width):
        lines.append(f"  %i{lane} = add i64 %first, {lane}")
        lines.append(f"  %j{lane} = call i64 @llvm.smin.i64(i64 %i{lane}, i64 %last)")
        name = "%members" if lane == width - 1 else f"%m{lane}"
        lines.append(
            f"  {name} = insertelement {kind} {whole}, i64 %j{lane}, i64 {lane}"
        )
        whole = name
    return lines
