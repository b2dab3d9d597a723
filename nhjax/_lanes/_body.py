"""The body of a function in LLVM IR, written by formulas of Python.

A `Value` is a vector, or a number where the width is 1. Its operators append an
instruction to the body that it belongs to, so that a formula on values reads as usual.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeAlias


class Body:
    """The instructions of a function, with the definitions of what it calls."""

    def __init__(self, width: int):
        self.width = width
        self.lines: list[str] = []
        # The texts of other functions and of tables, by name.
        self.needed: dict[str, str] = {}
        self._flags = "contract "
        self._count = 0
        self._block = "entry"

    def type(self, kind: str) -> str:
        """Name the type of the values of a kind, such as `double` and `i64`."""
        return kind if self.width == 1 else f"<{self.width} x {kind}>"

    def value(self, kind: str, instruction: str) -> "Value":
        """Append an instruction, and return its value."""
        self._count += 1
        name = f"%v{self._count}"
        self.lines.append(f"  {name} = {instruction}")
        return Value(self, kind, name)

    def constant(self, kind: str, number: float | int) -> "Value":
        """Return a constant, the same in all lanes."""
        if kind == "double":
            (bits,) = struct.unpack("<Q", struct.pack("<d", number))
            text = f"0x{bits:016X}"
        else:
            text = str(int(number))
        return Value(self, kind, text if self.width == 1 else f"splat ({kind} {text})")

    def flags(self, kind: str) -> str:
        """Return the fast-math flags of the operations on values of a kind."""
        return self._flags if kind == "double" else ""

    @contextmanager
    def exact(self) -> Iterator[None]:
        """Forbid fused products and sums, so that each operation rounds by itself.

        Elsewhere a product and a sum may become one operation, which rounds once.
        """
        before, self._flags = self._flags, ""
        yield
        self._flags = before

    def call(
        self, function: str, kinds: tuple[str, ...], *arguments: "Value"
    ) -> tuple["Value", ...]:
        """Call a function with one result or several, of the given kinds."""
        result = _struct([self.type(kind) for kind in kinds])
        given = ", ".join(x.typed() for x in arguments)
        found = self.value(kinds[0], f"call {result} {function}({given})")
        return self._members(found, result, kinds)

    def _members(
        self, found: "Value", result: str, kinds: tuple[str, ...]
    ) -> tuple["Value", ...]:
        if len(kinds) == 1:
            return (found,)
        return tuple(
            self.value(kind, f"extractvalue {result} {found.name}, {index}")
            for index, kind in enumerate(kinds)
        )

    def lane_by_lane(
        self, function: str, kinds: tuple[str, ...], *arguments: "Value"
    ) -> tuple["Value", ...]:
        """Call a function of numbers for each lane."""
        if self.width == 1:
            return self.call(function, kinds, *arguments)
        wholes, result = [f"{self.type(kind)} poison" for kind in kinds], _struct(kinds)
        for lane in range(self.width):
            given = ", ".join(
                f"{x.kind} "
                + self.value("", f"extractelement {x.typed()}, i64 {lane}").name
                for x in arguments
            )
            found = self.value("", f"call {result} {function}({given})")
            for index, part in enumerate(self._members(found, result, kinds)):
                operands = f"{wholes[index]}, {kinds[index]} {part.name}, i64 {lane}"
                whole = self.value(kinds[index], f"insertelement {operands}")
                wholes[index] = whole.typed()
        names = [whole.rpartition(" ")[2] for whole in wholes]
        return tuple(
            Value(self, kind, name) for kind, name in zip(kinds, names, strict=True)
        )

    def with_rare_case(
        self,
        unusual: "Value",
        usual: tuple["Value", ...],
        otherwise: Callable[[], tuple["Value", ...]],
    ) -> tuple["Value", ...]:
        """Return `usual`, but what `otherwise` computes in the lanes of `unusual`.

        The function `otherwise` is computed only if there is such a lane.
        """
        any_lane = unusual
        if self.width > 1:
            word = self.value("", f"bitcast {unusual.typed()} to i{self.width}")
            any_lane = self.value("", f"icmp ne i{self.width} {word.name}, 0")
        self._count += 1
        before, rare, after = self._block, f"rare{self._count}", f"after{self._count}"
        self.lines.append(f"  br i1 {any_lane.name}, label %{rare}, label %{after}")
        self._start(rare)
        pairs = list(zip(otherwise(), usual, strict=True))
        found = [(where(unusual, x, y), y) for x, y in pairs]
        last = self._block
        self.lines.append(f"  br label %{after}")
        self._start(after)
        ways = [f"[ {x.name}, %{last} ], [ {y.name}, %{before} ]" for x, y in found]
        return tuple(
            self.value(y.kind, f"phi {self.type(y.kind)} {way}")
            for way, y in zip(ways, usual, strict=True)
        )

    def _start(self, block: str) -> None:
        self.lines.append(f"{block}:")
        self._block = block

    def result(self, *values: "Value") -> None:
        """Return one value or several from the function."""
        result, whole = _struct([self.type(x.kind) for x in values]), values[0].name
        if len(values) > 1:
            whole = "poison"
            for index, x in enumerate(values):
                insertion = f"insertvalue {result} {whole}, {x.typed()}, {index}"
                whole = self.value("", insertion).name
        self.lines.append(f"  ret {result} {whole}")

    def text(self, head: str) -> str:
        """Return the function's definition, which begins with `head`."""
        return "\n".join([f"{head} {{", "entry:", *self.lines, "}"]) + "\n"


def _struct(types: Sequence[str]) -> str:
    """Name the type of a function's result, or results."""
    return types[0] if len(types) == 1 else f"{{ {', '.join(types)} }}"


class Value:
    """The value of an instruction, or a constant."""

    def __init__(self, body: Body, kind: str, name: str):
        self.body = body
        self.kind = kind
        self.name = name

    def typed(self) -> str:
        """Return the value's type and name, as an operand of an instruction."""
        return f"{self.body.type(self.kind)} {self.name}"

    def _constant(self, other: "Operand") -> "Value":
        if isinstance(other, Value):
            return other
        return self.body.constant(self.kind, other)

    def _instruction(
        self, name: str, other: "Operand", result: str | None = None
    ) -> "Value":
        flags, operands = self.body.flags(self.kind), self._constant(other).name
        text = f"{name} {flags}{self.typed()}, {operands}"
        return self.body.value(result or self.kind, text)

    def _arithmetic(self, name: str, other: "Operand") -> "Value":
        prefix = "f" if self.kind == "double" else ""
        return self._instruction(prefix + name, other)

    def __add__(self, other: "Operand") -> "Value":
        return self._arithmetic("add", other)

    def __radd__(self, other: "Operand") -> "Value":
        return self + other

    def __sub__(self, other: "Operand") -> "Value":
        return self._arithmetic("sub", other)

    def __rsub__(self, other: "Operand") -> "Value":
        return self._constant(other) - self

    def __mul__(self, other: "Operand") -> "Value":
        return self._arithmetic("mul", other)

    def __rmul__(self, other: "Operand") -> "Value":
        return self * other

    def __truediv__(self, other: "Operand") -> "Value":
        return self._arithmetic("div", other)

    def __rtruediv__(self, other: "Operand") -> "Value":
        return self._constant(other) / self

    def __neg__(self) -> "Value":
        if self.kind == "double":
            return self.body.value("double", f"fneg {self.typed()}")
        return 0 - self

    def __and__(self, other: "Operand") -> "Value":
        return self._instruction("and", other)

    def __or__(self, other: "Operand") -> "Value":
        return self._instruction("or", other)

    def __xor__(self, other: "Operand") -> "Value":
        return self._instruction("xor", other)

    def __invert__(self) -> "Value":
        return self ^ -1

    def __lshift__(self, other: "Operand") -> "Value":
        return self._instruction("shl", other)

    def __rshift__(self, other: "Operand") -> "Value":
        return self._instruction("lshr", other)

    def _compare(self, floats: str, integers: str, other: "Operand") -> "Value":
        is_float = self.kind == "double"
        name = f"fcmp {floats}" if is_float else f"icmp {integers}"
        with self.body.exact():
            return self._instruction(name, other, "i1")

    def __lt__(self, other: "Operand") -> "Value":
        return self._compare("olt", "slt", other)

    def __le__(self, other: "Operand") -> "Value":
        return self._compare("ole", "sle", other)

    def __gt__(self, other: "Operand") -> "Value":
        return self._compare("ogt", "sgt", other)

    def __ge__(self, other: "Operand") -> "Value":
        return self._compare("oge", "sge", other)

    def equals(self, other: "Operand") -> "Value":
        """Tell in which lanes two values are equal; NaN equals nothing."""
        return self._compare("oeq", "eq", other)

    def cast(self, instruction: str, kind: str) -> "Value":
        """Convert by one of the instructions `zext`, `trunc`, `bitcast`, `uitofp`."""
        types = f"{self.typed()} to {self.body.type(kind)}"
        return self.body.value(kind, f"{instruction} {types}")

    def bits(self) -> "Value":
        """Return the bits of floating-point numbers as integers."""
        return self.cast("bitcast", "i64")

    def number(self) -> "Value":
        """Return the floating-point numbers that have these bits."""
        return self.cast("bitcast", "double")


Operand: TypeAlias = Value | float | int


def where(condition: Value, chosen: Operand, other: Operand) -> Value:
    """Return `chosen` in the lanes where the condition holds, else `other`."""
    body = condition.body
    kinds = [x.kind for x in (chosen, other) if isinstance(x, Value)]
    kind = kinds[0] if kinds else "i64" if isinstance(chosen, int) else "double"
    first, second = (
        x if isinstance(x, Value) else body.constant(kind, x) for x in (chosen, other)
    )
    operands = f"{condition.typed()}, {first.typed()}, {second.typed()}"
    return body.value(kind, f"select {operands}")
