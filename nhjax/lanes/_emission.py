"""Emission of LLVM IR from the graph: a kernel that computes `width` members at once.

Three passes over the finished graph come first. `LiveNodes` finds the nodes that the
results need. `mark_divergent` finds the values that differ between members; the other
values, which are uniform, are scalars. `mark_broadcast` finds the uniform values that
are needed as vectors too.

Then `_Regions` writes the nodes region by region. Loops and branches whose predicate is
uniform become jumps. Where the predicate is divergent, members that do not take part
are masked: they compute too, but their results are discarded. `_Memory` writes loads
and stores.

A kernel allocates only its scratch memory: up to 64 kB on the stack, and larger memory
by `malloc`. Programs that need more than 64 MB are refused.
"""

import numpy as np

from ._graph import (
    BranchInfo,
    Buffer,
    Function,
    is_float,
    LoopInfo,
    needed,
    Node,
    Region,
    Unsupported,
)
from ._instructions import write
from ._writer import (
    bits,
    literal,
    memory_type,
    result_type,
    scalar_type,
    splat,
    suffix,
    vector,
    Writer,
)


# Scratch memory and each array in it are aligned to this many bytes.
_ALIGNMENT = 64
_LARGEST_STACK = 2**16
_LARGEST_SCRATCH = 2**26
# A side of a divergent branch with more nodes than this, or with one of `_STATEMENTS`,
# is skipped when no member takes it. Other sides are always computed.
_LONGEST_SIDE = 24
_STATEMENTS = ("loop", "branch", "store", "load")
_ALL = "splat (i1 true)"


def emit(
    root: Region,
    results: list[Buffer],
    is_batched: tuple[bool, ...],
    width: int,
    contract: bool,
) -> tuple[str, dict[tuple[str, str, int], None]]:
    """Write the kernel of a graph.

    Returns the text of its module, without the definitions of elementary functions, and
    the elementary functions that it calls, in the form that
    `_elementary_functions.definitions` takes.
    """
    live = LiveNodes(results)
    if width > 1:
        mark_divergent(live, is_batched)
        mark_broadcast(live)
    else:
        for buffer in live.buffers:
            # Even at width 1, the address of a batched operand depends on the member.
            buffer.is_divergent = buffer.kind == "operand" and is_batched[buffer.place]
    writer = Writer(width, contract)
    writer.lines.extend(_members(width))
    memory = _Memory(writer, live.buffers)
    functions = _Functions(live)
    _Regions(writer, memory, live, functions).write(live.in_region.get(root, []))
    writer.add("ret void")
    if memory.size > _LARGEST_SCRATCH:
        raise Unsupported(f"{memory.size} bytes of scratch memory")
    kernel = _module(writer, memory.size)
    parts = [kernel, *functions.definitions(writer)]
    return "\n".join([*parts, ""]), writer.wanted


def _members(width: int) -> list[str]:
    """Write the indices of the members, clamped to the index of the last member."""
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


def _module(writer: Writer, size: int) -> str:
    """Write the module: the function `member`, and the kernel that calls it."""
    size = max(size, _ALIGNMENT)
    call = (
        "call void @member(ptr %operands, ptr %results, i64 %first, i64 %last, "
        "ptr %scratch)"
    )
    if size <= _LARGEST_STACK:
        body = [
            f"  %scratch = alloca [{size} x i8], align {_ALIGNMENT}",
            f"  {call}",
            "  ret i1 false",
        ]
    else:
        body = [
            f"  %piece = call ptr @malloc(i64 {size + _ALIGNMENT})",
            "  %is_lacking = icmp eq ptr %piece, null",
            "  br i1 %is_lacking, label %lacking, label %run",
            "lacking:",
            "  ret i1 true",
            "run:",
            f"  %up = getelementptr i8, ptr %piece, i64 {_ALIGNMENT - 1}",
            f"  %scratch = call ptr @llvm.ptrmask.p0.i64(ptr %up, i64 -{_ALIGNMENT})",
            f"  {call}",
            "  call void @free(ptr %piece)",
            "  ret i1 false",
        ]
        writer.declarations["malloc"] = "declare ptr @malloc(i64)"
        writer.declarations["free"] = "declare void @free(ptr)"
    head = (
        "define internal void @member(ptr %operands, ptr %results, i64 %first, "
        "i64 %last, ptr noalias %scratch) noinline nounwind"
    )
    lines = [
        *writer.constants,
        writer.definition(head),
        "define i1 @kernel(ptr %operands, ptr %results, i64 %first, i64 %last) {",
        *body,
        "}",
        *writer.declarations.values(),
        "!0 = !{}",
    ]
    return "\n".join(lines) + "\n"


# The passes over the graph


class LiveNodes:
    """The nodes that the results of a program need, by region and in order.

    A store is needed if it writes a result, or memory that is read. A loop is needed if
    one of its results or a store inside it is needed.
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
        if not node.is_live:
            node.is_live = True
            self._waiting.append(node)

    def _need_buffer(self, buffer: Buffer) -> None:
        if not buffer.is_live:
            buffer.is_live = True
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


def mark_divergent(live: LiveNodes, is_batched: tuple[bool, ...]) -> None:
    """Mark the nodes and the memory whose values differ between members.

    Only members that are still running are compared. In a loop that members leave at
    different times, a counter with equal first values is uniform inside the loop, but
    its last value is divergent after the loop.
    """
    for buffer in live.buffers:
        if buffer.kind == "operand":
            buffer.is_divergent = is_batched[buffer.place]
        buffer.is_divergent |= buffer.kind == "result"
    rest = [node for node in live.nodes if not node.is_constant]
    while True:
        changed, unknown = False, []
        for node in rest:
            if _is_divergent(node):
                node.is_divergent = changed = True
                if node.op == "store":
                    node.attr[0].is_divergent = True
            else:
                unknown.append(node)
        if not changed:
            return
        rest = unknown


def _is_divergent(node: Node) -> bool:
    if node.op == "param":
        statement, index = node.attr
        info = statement.attr
        return info.inits[index].is_divergent or info.outs[index].is_divergent
    if node.op == "result":
        statement, index = node.attr
        info = statement.attr
        if info.predicate.is_divergent:
            return True
        if isinstance(info, LoopInfo):
            return info.params[index].is_divergent
        return any(outs[index].is_divergent for outs in info.outs)
    if node.op == "load" and node.attr[0].is_divergent:
        return True
    if node.op == "store" and _is_masked(node.region, node.attr[0].region):
        return True
    if node.op == "loop" or node.op == "branch":
        return node.attr.predicate.is_divergent
    return any(arg.is_divergent for arg in node.args)


def _is_masked(inner: Region, outer: Region) -> bool:
    """Return whether members that are active in `outer` may be masked in `inner`."""
    region: Region | None = inner
    while region is not None and region is not outer:
        if region.owner is not None and region.owner.attr.predicate.is_divergent:
            return True
        region = region.parent
    return False


def mark_broadcast(live: LiveNodes) -> None:
    """Mark the uniform nodes that some instruction needs as a vector."""
    for node in live.nodes:
        op = node.op
        if op in ("param", "result"):
            statement, index = node.attr
            info = statement.attr
            if isinstance(info, LoopInfo):
                param = info.params[index]
                if param.is_divergent:
                    _broadcast(info.inits[index], info.outs[index])
                if info.predicate.is_divergent and op == "result":
                    _broadcast(param, info.inits[index])
            elif node.is_divergent:
                _broadcast(info.outs[0][index], info.outs[1][index])
        elif op == "store":
            buffer = node.attr[0]
            if buffer.is_divergent:
                _broadcast(node.args[0])
            if buffer.kind == "result" and len(node.args) > 1:
                _broadcast(node.args[1])
        elif op == "load":
            if node.attr[0].kind == "operand" and node.is_divergent and node.args:
                _broadcast(*node.args)
        elif op == "select":
            if node.is_divergent:
                _broadcast(*node.args[1:])
        elif node.is_divergent:
            _broadcast(*node.args)


def _broadcast(*nodes: Node) -> None:
    for node in nodes:
        node.is_broadcast = not node.is_divergent and not node.is_constant


# Nodes as operands of instructions


def _operand(writer: Writer, node: Node, as_vector: bool) -> str:
    if node.is_constant:
        text = literal(node.attr, node.dtype)
        width = writer.width if as_vector else 1
        return splat(text, scalar_type(node.dtype), width)
    if as_vector and not node.is_divergent and writer.width > 1:
        return node.vector_name
    return node.name


def _type(writer: Writer, node: Node, as_vector: bool) -> str:
    return vector(scalar_type(node.dtype), writer.width if as_vector else 1)


def _typed(writer: Writer, node: Node, as_vector: bool) -> str:
    return f"{_type(writer, node, as_vector)} {_operand(writer, node, as_vector)}"


def _define(writer: Writer, node: Node, name: str) -> None:
    """Record the name of a node, and broadcast it to a vector where one is needed."""
    node.name = name
    if node.is_broadcast and not node.is_divergent:
        node.vector_name = writer.broadcast(name, scalar_type(node.dtype))


# Functions


class _Functions:
    """The functions that a kernel calls, with vectors or with single numbers."""

    def __init__(self, live: LiveNodes):
        # For each function, its results that are used, with their places in the struct
        # that it returns. The other results are not computed.
        self._used: dict[Function, dict[int, int]] = {}
        self._names: dict[tuple[Function, int], str] = {}
        for node in live.nodes:
            if node.op == "part":
                function, _ = _called(node.args[0])
                places = self._used.setdefault(function, {})
                places.setdefault(node.attr, len(places))

    def call(self, writer: Writer, node: Node) -> str:
        """Write a call, and return the name of its results."""
        function, args = _called(node)
        width = writer.width if node.is_divergent else 1
        name = f"@program.{len(self._names)}"
        name = self._names.setdefault((function, width), name)
        given = ", ".join(_typed(writer, x, node.is_divergent) for x in args)
        return writer.value(f"call {self._result(function, width)} {name}({given})")

    def part(self, writer: Writer, node: Node) -> str:
        """Write one of the results of a call."""
        (whole,) = node.args
        function, _ = _called(whole)
        result = self._result(function, writer.width if whole.is_divergent else 1)
        if len(self._used[function]) == 1:
            return whole.name
        place = self._used[function][node.attr]
        return writer.value(f"extractvalue {result} {whole.name}, {place}")

    def _result(self, function: Function, width: int) -> str:
        dtypes = [function.outs[index].dtype for index in self._used[function]]
        floats = [x for x in dtypes if is_float(x)]
        if width == 1 and len(floats) in (3, 4):
            # On x86-64 LLVM returns a third and a fourth float in x87 registers, for
            # which it writes invalid instructions if optimisation is off. It returns
            # five floats in memory, so unused floats are added to get five.
            dtypes += floats[: 5 - len(floats)]
        return result_type([vector(scalar_type(x), width) for x in dtypes])

    def definitions(self, outer: Writer) -> list[str]:
        """Write the functions that are called."""
        return [
            self._definition(outer.for_function(width), function, name)
            for (function, width), name in self._names.items()
        ]

    def _definition(self, writer: Writer, function: Function, name: str) -> str:
        outs = [function.outs[index] for index in self._used[function]]
        is_divergent = writer.width > 1
        for index, node in enumerate(function.parameters):
            node.name = f"%a{index}"
        for node in (*function.parameters, *needed(outs)):
            node.is_divergent = is_divergent
            if node.op != "parameter":
                args = [_operand(writer, arg, is_divergent) for arg in node.args]
                node.name = write(writer, node, writer.width, args)
        result = self._result(function, writer.width)
        if len(outs) == 1:
            whole = _operand(writer, outs[0], is_divergent)
        else:
            whole = "poison"
            for index, out in enumerate(outs):
                number = _typed(writer, out, is_divergent)
                whole = writer.value(f"insertvalue {result} {whole}, {number}, {index}")
        writer.add(f"ret {result} {whole}")
        given = ", ".join(_typed(writer, x, is_divergent) for x in function.parameters)
        # These attributes allow LLVM to move calls, and to merge equal calls.
        attributes = "noinline nounwind willreturn memory(none)"
        head = f"define internal {result} {name}({given}) {attributes}"
        return writer.definition(head)


def _called(node: Node) -> tuple[Function, list[Node]]:
    """Return the function that a node calls, and its arguments."""
    function, args = node.attr, list(node.args)
    while function.general is not None:
        function, given = function.general
        args = [args[x] if isinstance(x, int) else x for x in given]
    return function, args


# Regions: loops and branches


class _Regions:
    """The writer of regions, with the loops and branches in them.

    `mask` is the name of the mask of the members that are running; `None` stands for
    all members. Regions that no member enters are skipped at run time, except for sides
    of divergent branches that are short (see `_is_long`).
    """

    def __init__(
        self,
        writer: Writer,
        memory: "_Memory",
        live: LiveNodes,
        functions: "_Functions",
    ):
        self.writer, self.memory, self.live = writer, memory, live
        self.functions = functions
        self.mask: str | None = None
        self.labels = 0

    def write(self, nodes: list[Node]) -> None:
        """Write nodes of one region, in their order."""
        writer = self.writer
        for node in nodes:
            op = node.op
            if op in ("const", "zero", "param", "result"):
                continue
            if op == "loop":
                self._loop(node.attr)
            elif op == "branch":
                self._branch(node.attr)
            elif op == "store":
                self.memory.store(node, self._mask_of_store(node))
            elif op == "load":
                _define(writer, node, self.memory.load(node))
            elif op == "call":
                node.name = self.functions.call(writer, node)
            elif op == "part":
                _define(writer, node, self.functions.part(writer, node))
            else:
                width = writer.width if node.is_divergent else 1
                args = [_operand(writer, arg, node.is_divergent) for arg in node.args]
                if op == "select":
                    predicate = node.args[0]
                    args[0] = _operand(writer, predicate, predicate.is_divergent)
                _define(writer, node, write(writer, node, width, args))

    def _mask_of_store(self, node: Node) -> str | None:
        buffer: Buffer = node.attr[0]
        if self.mask is None or not _is_masked(node.region, buffer.region):
            return None
        return self.mask

    def _next_label(self) -> str:
        self.labels += 1
        return f"b{self.labels}"

    def _loop(self, loop: LoopInfo) -> None:
        writer, tag = self.writer, self._next_label()
        nodes = self.live.in_region.get(loop.region, [])
        before = [node for node in nodes if node.number < loop.split]
        rounds = [node for node in nodes if node.number > loop.split]
        params = [
            (node, loop.inits[index], loop.outs[index])
            for index, node in enumerate(loop.params)
            if node.is_live
        ]
        starts = [
            _operand(writer, init, param.is_divergent) for param, init, _ in params
        ]
        entry, outer = writer.block, self.mask
        results = None
        if loop.predicate.is_divergent:
            results = _LoopResults(writer, self.memory, loop, outer is not None)
        writer.add(f"br label %{tag}.head")
        writer.label(f"{tag}.head")
        # The phi instructions need the names of the next values, which are known only
        # at the end of the loop.
        open_lines = []
        for param, _, _ in params:
            param.name = writer.new_name()
            open_lines.append(writer.placeholder())
        active = writer.new_name()
        open_mask = writer.placeholder() if results is not None else 0
        for param, _, _ in params:
            _define(writer, param, param.name)
        if results is not None:
            # Members that have left this loop are masked in inner loops too.
            self.mask = active
        self.write(before)
        if results is not None:
            self._leave(loop, tag, active, results)
        else:
            go_on = _operand(writer, loop.predicate, False)
            writer.add(f"br i1 {go_on}, label %{tag}.round, label %{tag}.exit")
        writer.label(f"{tag}.round")
        self.write(rounds)
        last = writer.block
        for line, start, (param, _, out) in zip(
            open_lines, starts, params, strict=True
        ):
            kind = _type(writer, param, param.is_divergent)
            after = _operand(writer, out, param.is_divergent)
            phi = f"phi {kind} [ {start}, %{entry} ], [ {after}, %{last} ]"
            writer.lines[line] = f"  {param.name} = {phi}"
        if results is not None:
            flags, first = vector("i1", writer.width), outer or _ALL
            phi = f"phi {flags} [ {first}, %{entry} ], [ {self.mask}, %{last} ]"
            writer.lines[open_mask] = f"  {active} = {phi}"
        writer.add(f"br label %{tag}.head")
        writer.label(f"{tag}.exit")
        self.mask = outer
        if results is not None:
            results.define()
            return
        for result in loop.results:
            if result.is_live:
                _define(writer, result, loop.params[result.attr[1]].name)

    def _leave(
        self, loop: LoopInfo, tag: str, active: str, results: "_LoopResults"
    ) -> None:
        """Store the values of members that leave the loop; other members continue.

        Members that have left still compute, with their results masked, until the last
        member leaves. Stopping them would be more expensive.
        """
        writer, flags = self.writer, vector("i1", self.writer.width)
        go_on = _operand(writer, loop.predicate, True)
        going = writer.value(f"and {flags} {active}, {go_on}")
        ending = writer.value(f"xor {flags} {active}, {going}")
        some = writer.any_of(ending)
        writer.add(f"br i1 {some}, label %{tag}.end, label %{tag}.round")
        writer.label(f"{tag}.end")
        results.store(ending)
        more = writer.any_of(going)
        writer.add(f"br i1 {more}, label %{tag}.round, label %{tag}.exit")
        self.mask = going

    def _branch(self, branch: BranchInfo) -> None:
        if branch.predicate.is_divergent:
            self._both_sides(branch)
        else:
            self._one_side(branch)

    def _one_side(self, branch: BranchInfo) -> None:
        """Write a branch as a jump, because all members take the same side."""
        writer, tag = self.writer, self._next_label()
        predicate = _operand(writer, branch.predicate, False)
        writer.add(f"br i1 {predicate}, label %{tag}.yes, label %{tag}.no")
        ends: list[str] = []
        needed = [result for result in branch.results if result.is_live]
        values: list[list[str]] = []
        for side, name in enumerate(("yes", "no")):
            writer.label(f"{tag}.{name}")
            self.write(self.live.in_region.get(branch.regions[side], []))
            outs = [branch.outs[side][result.attr[1]] for result in needed]
            values.append(
                [
                    _operand(writer, out, result.is_divergent)
                    for out, result in zip(outs, needed, strict=True)
                ]
            )
            ends.append(writer.block)
            writer.add(f"br label %{tag}.join")
        writer.label(f"{tag}.join")
        for result, yes, no in zip(needed, *values, strict=True):
            kind = _type(writer, result, result.is_divergent)
            result.name = writer.value(
                f"phi {kind} [ {yes}, %{ends[0]} ], [ {no}, %{ends[1]} ]"
            )
        for result in needed:
            _define(writer, result, result.name)

    def _both_sides(self, branch: BranchInfo) -> None:
        """Write a divergent branch: both sides with masks, then select instructions."""
        writer, flags = self.writer, vector("i1", self.writer.width)
        outer = self.mask
        predicate = _operand(writer, branch.predicate, True)
        opposite = writer.value(f"xor {flags} {predicate}, {_ALL}")
        needed = [result for result in branch.results if result.is_live]
        values: list[list[str]] = []
        for side, mask in enumerate((predicate, opposite)):
            if outer is not None:
                mask = writer.value(f"and {flags} {outer}, {mask}")
            self.mask = mask
            outs = [branch.outs[side][result.attr[1]] for result in needed]
            nodes = self.live.in_region.get(branch.regions[side], [])
            if _is_long(nodes):
                values.append(self._guarded(nodes, outs, mask))
            else:
                self.write(nodes)
                values.append([_operand(writer, out, True) for out in outs])
        self.mask = outer
        for result, yes, no in zip(needed, *values, strict=True):
            kind = _type(writer, result, True)
            choice = f"select {flags} {predicate}, {kind} {yes}, {kind} {no}"
            _define(writer, result, writer.value(choice))

    def _guarded(self, nodes: list[Node], outs: list[Node], mask: str) -> list[str]:
        """Write a side that is skipped if no member takes it."""
        writer, tag = self.writer, self._next_label()
        some, before = writer.any_of(mask), writer.block
        writer.add(f"br i1 {some}, label %{tag}.side, label %{tag}.join")
        writer.label(f"{tag}.side")
        self.write(nodes)
        values, after = [_operand(writer, out, True) for out in outs], writer.block
        writer.add(f"br label %{tag}.join")
        writer.label(f"{tag}.join")
        return [
            writer.value(
                f"phi {_type(writer, out, True)} [ {value}, %{after} ], "
                f"[ zeroinitializer, %{before} ]"
            )
            for out, value in zip(outs, values, strict=True)
        ]


def _is_long(nodes: list[Node]) -> bool:
    return len(nodes) > _LONGEST_SIDE or any(node.op in _STATEMENTS for node in nodes)


class _LoopResults:
    """The results of a loop that members leave one by one, stored in memory."""

    def __init__(
        self, writer: Writer, memory: "_Memory", loop: LoopInfo, is_partial: bool
    ):
        """Reserve memory. `is_partial` says whether some members may skip the loop."""
        self.writer = writer
        self.slots: list[tuple[Node, Node, str]] = []
        for result in loop.results:
            if not result.is_live:
                continue
            index = result.attr[1]
            slot = memory.slot(result.dtype)
            if is_partial:
                # Members that do not enter the loop get its initial value; any value
                # would do.
                self._write(result, self._in_memory(loop.inits[index]), slot)
            self.slots.append((result, loop.params[index], slot))

    def store(self, ending: str) -> None:
        """Store the current values of the members in the mask `ending`."""
        writer, flags = self.writer, vector("i1", self.writer.width)
        for result, param, slot in self.slots:
            value, kind = self._in_memory(param), self._type(result)
            old = writer.value(f"load {kind}, ptr {slot}, align {self._align(result)}")
            value = writer.value(
                f"select {flags} {ending}, {kind} {value}, {kind} {old}"
            )
            self._write(result, value, slot)

    def define(self) -> None:
        """Load the results after the loop."""
        for result, _, slot in self.slots:
            kind, align = self._type(result), self._align(result)
            value = self.writer.value(f"load {kind}, ptr {slot}, align {align}")
            if result.dtype == "bool":
                value = self.writer.value(f"icmp ne {kind} {value}, zeroinitializer")
            _define(self.writer, result, value)

    def _type(self, node: Node) -> str:
        return vector(memory_type(node.dtype), self.writer.width)

    def _align(self, node: Node) -> int:
        return min(_ALIGNMENT, self.writer.width * bits(node.dtype) // 8)

    def _in_memory(self, node: Node) -> str:
        value = _operand(self.writer, node, True)
        if node.dtype != "bool":
            return value
        flags = vector("i1", self.writer.width)
        return self.writer.value(f"zext {flags} {value} to {self._type(node)}")

    def _write(self, node: Node, value: str, slot: str) -> None:
        align = self._align(node)
        self.writer.add(f"store {self._type(node)} {value}, ptr {slot}, align {align}")


# Memory


class _Memory:
    """The layout of a kernel's arrays in memory, and their loads and stores.

    In divergent scratch memory the values of one number for all members are side by
    side, so that a load with a uniform index loads one vector. In a batched operand and
    in a result, all numbers of one member are followed by all numbers of the next
    member, as in JAX's arrays. Loads and stores in batched operands and results
    are therefore gathers and scatters.
    """

    def __init__(self, writer: Writer, buffers: list[Buffer]):
        self.writer, self.width = writer, writer.width
        # The size of scratch memory in bytes.
        self.size = 0
        self._bases: dict[Buffer, str] = {}
        self._members: dict[int, str] = {}
        order = {"operand": 0, "result": 1, "constant": 2, "scratch": 3}
        for buffer in sorted(buffers, key=lambda buffer: order[buffer.kind]):
            self._bases[buffer] = self._base(buffer)

    def slot(self, dtype: str) -> str:
        """Reserve memory for one number of each member, and return its address."""
        return self._scratch(self.width, dtype)

    def _scratch(self, members: int, dtype: str, size: int = 1) -> str:
        """Reserve scratch memory, and return its address."""
        offset = self.size
        count = members * size * bits(dtype) // 8
        self.size += -(-count // _ALIGNMENT) * _ALIGNMENT
        return self.writer.value(f"getelementptr i8, ptr %scratch, i64 {offset}")

    def _base(self, buffer: Buffer) -> str:
        """Write the base address of a buffer, or of each member in a batched buffer."""
        writer, kind = self.writer, memory_type(buffer.dtype)
        if buffer.kind == "scratch":
            members = self.width if buffer.is_divergent else 1
            return self._scratch(members, buffer.dtype, buffer.size)
        if buffer.kind == "constant":
            return self._constant(buffer)
        array = "%operands" if buffer.kind == "operand" else "%results"
        place = writer.value(f"getelementptr ptr, ptr {array}, i64 {buffer.place}")
        start = writer.value(f"load ptr, ptr {place}")
        if buffer.kind == "operand" and not self._is_batched(buffer):
            return start
        # The returned vector has the address of the first number of each member.
        index, members = vector("i64", self.width), self._starts(buffer.size)
        return writer.value(f"getelementptr {kind}, ptr {start}, {index} {members}")

    def _is_batched(self, buffer: Buffer) -> bool:
        is_operand = buffer.kind == "operand"
        return buffer.kind == "result" or (is_operand and buffer.is_divergent)

    def _starts(self, size: int) -> str:
        """Return where members start in an array with `size` numbers per member."""
        if size not in self._members:
            index, by = vector("i64", self.width), splat(str(size), "i64", self.width)
            self._members[size] = self.writer.value(f"mul {index} %members, {by}")
        return self._members[size]

    def _constant(self, buffer: Buffer) -> str:
        kind = memory_type(buffer.dtype)
        values, dtype = buffer.place, buffer.dtype
        if dtype == "bool":
            values, dtype = values.astype(np.uint8), "uint8"
        name = f"@constant.{len(self.writer.constants)}"
        numbers = ", ".join(f"{kind} {literal(value, dtype)}" for value in values)
        self.writer.constants.append(
            f"{name} = internal constant [{buffer.size} x {kind}] [{numbers}], align 64"
        )
        return name

    def _address(
        self, buffer: Buffer, index: Node | None, offset: int
    ) -> tuple[str, bool]:
        """Write the address of a number; return it and whether it differs by member."""
        writer, kind = self.writer, memory_type(buffer.dtype)
        pointer = self._bases[buffer]
        if buffer.kind == "scratch" and buffer.is_divergent:
            if index is not None and index.is_divergent:
                return self._member_address(buffer, index, offset), True
            # At a uniform index, the values of all members are one vector.
            kind = vector(kind, self.width)
        is_vector = self.width > 1 and self._is_batched(buffer)
        if index is not None:
            many = index.is_divergent or is_vector
            start = vector("ptr", self.width if is_vector else 1)
            by = vector("i64", self.width if many else 1)
            pointer = writer.value(
                f"getelementptr {kind}, {start} {pointer}, "
                f"{by} {_operand(writer, index, many)}"
            )
            is_vector = many
        if offset:
            start = vector("ptr", self.width if is_vector else 1)
            pointer = writer.value(
                f"getelementptr {kind}, {start} {pointer}, i64 {offset}"
            )
        return pointer, is_vector

    def _member_address(self, buffer: Buffer, index: Node, offset: int) -> str:
        """Write the addresses in scratch memory for an index that is divergent."""
        writer, by = self.writer, vector("i64", self.width)
        first = ", ".join(
            f"i64 {offset * self.width + member}" for member in range(self.width)
        )
        size = splat(str(self.width), "i64", self.width)
        start = writer.value(f"mul {by} {_operand(writer, index, True)}, {size}")
        place = writer.value(f"add {by} {start}, <{first}>")
        kind = memory_type(buffer.dtype)
        return writer.value(
            f"getelementptr {kind}, ptr {self._bases[buffer]}, {by} {place}"
        )

    def _align(self, buffer: Buffer, members: int) -> int:
        return min(_ALIGNMENT, members * bits(buffer.dtype) // 8)

    def load(self, node: Node) -> str:
        """Write a load, and return the name of the number."""
        buffer, offset = node.attr
        index = node.args[0] if node.args else None
        pointer, is_vector = self._address(buffer, index, offset)
        members = self.width if node.is_divergent else 1
        kind = vector(memory_type(buffer.dtype), members)
        if is_vector:
            out = self._gather(pointer, buffer)
        else:
            is_invariant = buffer.is_fixed and buffer.kind == "operand"
            known = ", !invariant.load !0" if is_invariant else ""
            align = self._align(buffer, members)
            out = self.writer.value(f"load {kind}, ptr {pointer}, align {align}{known}")
        if buffer.dtype == "bool":
            zero = splat("0", "i8", members)
            out = self.writer.value(f"icmp ne {kind} {out}, {zero}")
        return out

    def _gather(self, pointer: str, buffer: Buffer) -> str:
        name, kind = self._intrinsic("gather", buffer)
        pointers, flags = f"<{self.width} x ptr>", f"<{self.width} x i1>"
        self.writer.declarations[name] = (
            f"declare {kind} @{name}({pointers}, i32, {flags}, {kind})"
        )
        align = bits(buffer.dtype) // 8
        return self.writer.value(
            f"call {kind} @{name}({pointers} {pointer}, i32 {align}, "
            f"{flags} {_ALL}, {kind} poison)"
        )

    def _intrinsic(self, operation: str, buffer: Buffer) -> tuple[str, str]:
        """Return the name of LLVM's masked gather or scatter, and the type it moves."""
        name = f"llvm.masked.{operation}.{suffix(buffer.dtype, self.width, True)}"
        kind = vector(memory_type(buffer.dtype), self.width)
        return f"{name}.v{self.width}p0", kind

    def store(self, node: Node, mask: str | None) -> None:
        """Write a store; with a mask, only for the members in the mask."""
        buffer, offset = node.attr
        number, *rest = node.args
        index = rest[0] if rest else None
        writer = self.writer
        is_vector = buffer.is_divergent or buffer.kind == "result"
        members = self.width if is_vector else 1
        value = _operand(writer, number, members > 1)
        kind = vector(memory_type(buffer.dtype), members)
        if buffer.dtype == "bool":
            value = writer.value(f"zext {vector('i1', members)} {value} to {kind}")
        pointer, is_vector = self._address(buffer, index, offset)
        if is_vector:
            self._scatter(value, pointer, buffer, mask)
            return
        align = self._align(buffer, members)
        if mask is not None:
            old = writer.value(f"load {kind}, ptr {pointer}, align {align}")
            flags = vector("i1", members)
            value = writer.value(f"select {flags} {mask}, {kind} {value}, {kind} {old}")
        writer.add(f"store {kind} {value}, ptr {pointer}, align {align}")

    def _scatter(
        self, value: str, pointer: str, buffer: Buffer, mask: str | None
    ) -> None:
        name, kind = self._intrinsic("scatter", buffer)
        pointers, flags = f"<{self.width} x ptr>", f"<{self.width} x i1>"
        self.writer.declarations[name] = (
            f"declare void @{name}({kind}, {pointers}, i32, {flags})"
        )
        align = bits(buffer.dtype) // 8
        self.writer.add(
            f"call void @{name}({kind} {value}, {pointers} {pointer}, i32 {align}, "
            f"{flags} {mask or _ALL})"
        )
