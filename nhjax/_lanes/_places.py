"""Loads and stores of lanes, as text of LLVM.

Scratch memory whose contents differ between lanes holds for each number the lanes side
by side, so that an index that all lanes share loads a vector. Of an operand of the
batch, and of a result, the members lie one after the other.
"""

import numpy as np

from ._buffers import Buffer
from ._graph import Node
from ._types import bits, literal, memory_type, suffix, vector
from ._writer import Text


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
