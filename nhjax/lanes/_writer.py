"""The types and literals of LLVM, as text.

The text of a function of LLVM while it is written.

The body of a function in LLVM IR, written by formulas of Python.

A `Value` is a vector, or a number where the width is 1. Its operators append an
instruction to the body that it belongs to, so that a formula on values reads as usual.

The functions of vectors of float64 that are instructions of every processor.

Formulas that the elementary functions share: polynomials, and pairs of numbers.

A pair is a number of about 106 bits, given as a sum of two of which the second is at
most of the size of the first's round-off. What computes a round-off is `exact` in the
sense of `Body.exact`: it relies on the rounding of each operation by itself.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np

from ._graph import Node


_TYPES = {"bool": "i1", "float32": "float", "float64": "double"}


def scalar_type(dtype: str) -> str:
    """Return the type of a number."""
    return _TYPES.get(dtype) or f"i{8 * np.dtype(dtype).itemsize}"


def memory_type(dtype: str) -> str:
    """Return the type of a number in memory, where booleans are bytes."""
    return "i8" if dtype == "bool" else scalar_type(dtype)


def vector(scalar: str, width: int) -> str:
    """Return the type of a vector; of width one, that of a number."""
    return scalar if width == 1 else f"<{width} x {scalar}>"


def suffix(dtype: str, width: int, is_memory: bool = False) -> str:
    """Return how names of intrinsics end for a type."""
    scalar = memory_type(dtype) if is_memory else scalar_type(dtype)
    scalar = {"float": "f32", "double": "f64"}.get(scalar, scalar)
    return scalar if width == 1 else f"v{width}{scalar}"


def symbol(op: str, dtype: str, width: int) -> str:
    """Name the function of `width` lanes that computes a primitive of JAX."""
    lanes = "" if width == 1 else f"x{width}"
    return f"nhjax.{op}.{suffix(dtype, 1)}{lanes}"


def literal(value: Any, dtype: str) -> str:
    """Write a constant as LLVM reads it."""
    if dtype.startswith("float"):
        # LLVM writes numbers of all precisions with 64 bits.
        return f"0x{struct.unpack('<Q', struct.pack('<d', float(value)))[0]:016X}"
    if dtype == "bool":
        return "true" if value else "false"
    return str(int(value.astype(f"i{value.dtype.itemsize}")))


def is_signed(dtype: str) -> bool:
    """Tell whether a dtype is of signed integers."""
    return dtype.startswith("int")


def bits(dtype: str) -> int:
    """Return the number of bits of a number in memory."""
    return 8 * np.dtype(dtype).itemsize


class Text:
    """Lines of instructions in blocks, with what they need outside of the function.

    `contract` is the flag with which products and sums may be fused, or empty.
    """

    def __init__(self, width: int, contract: str):
        self.width, self.contract = width, contract
        self.lines: list[str] = []
        self.block = "entry"
        self.count = 0
        self.declared: dict[str, str] = {}
        self.wanted: dict[tuple[str, str, int], None] = {}
        self.globals: list[str] = []

    def fresh(self) -> str:
        """Return a name that is not in use."""
        self.count += 1
        return f"%v{self.count}"

    def add(self, line: str) -> None:
        """Write an instruction without a result."""
        self.lines.append("  " + line)

    def value(self, text: str) -> str:
        """Write an instruction, and return the name of its result."""
        self.count += 1
        name = f"%v{self.count}"
        self.lines.append(f"  {name} = {text}")
        return name

    def later(self) -> int:
        """Leave a line open, for a node that is complete only later."""
        self.lines.append("")
        return len(self.lines) - 1

    def label(self, name: str) -> None:
        """Start a block of LLVM with its label."""
        self.lines.append(f"{name}:")
        self.block = name

    def declare(self, name: str, declaration: str) -> None:
        """Declare a function to LLVM, unless it is declared already."""
        self.declared[name] = declaration

    def want(self, op: str, dtype: str, width: int) -> None:
        """Ask for an elementary function."""
        self.wanted[op, dtype, width] = None

    def splat(self, text: str, dtype: str, width: int) -> str:
        """Write a constant of any width."""
        return text if width == 1 else f"splat ({scalar_type(dtype)} {text})"

    def spread(self, name: str, scalar: str) -> str:
        """Write the same number into all lanes."""
        kind = vector(scalar, self.width)
        one = self.value(f"insertelement {kind} poison, {scalar} {name}, i64 0")
        lanes = f"<{self.width} x i32> zeroinitializer"
        return self.value(f"shufflevector {kind} {one}, {kind} poison, {lanes}")

    def any_of(self, mask: str) -> str:
        """Tell whether any lane of a mask is set."""
        whole = f"i{self.width}"
        number = self.value(f"bitcast <{self.width} x i1> {mask} to {whole}")
        return self.value(f"icmp ne {whole} {number}, 0")

    # Nodes

    def ref(self, node: Node, is_wide: bool) -> str:
        """Return a node as an operand, as a vector if asked for."""
        if node.is_constant:
            text = literal(node.attr, node.dtype)
            return self.splat(text, node.dtype, self.width if is_wide else 1)
        if is_wide and not node.varies and self.width > 1:
            return node.wide
        return node.name

    def kind(self, node: Node, is_wide: bool) -> str:
        """Return the type of a node."""
        return vector(scalar_type(node.dtype), self.width if is_wide else 1)

    def define(self, node: Node, name: str) -> None:
        """Give a node its name, and a vector of it where one is needed."""
        node.name = name
        if node.is_wide and not node.varies:
            node.wide = self.spread(name, scalar_type(node.dtype))


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


def absolute(x: Value) -> Value:
    """Return |x|."""
    return _intrinsic("fabs", x)


def with_sign(x: Value, sign: Value) -> Value:
    """Return |x| with the sign of another value, also of zeros."""
    return _intrinsic("copysign", x, sign)


def square_root(x: Value) -> Value:
    """Return the square root of x, rounded correctly."""
    return _intrinsic("sqrt", x)


def _intrinsic(name: str, *arguments: Value) -> Value:
    body = arguments[0].body
    lanes = "" if body.width == 1 else f"v{body.width}"
    return body.call(f"@llvm.{name}.{lanes}f64", ("double",), *arguments)[0]


Pair = tuple[Value, Value]

# Adding this rounds to an integer, which is then in the lowest bits.
_TO_INTEGER = 1.5 * 2.0**52
# The bits of 1.0.
ONE_BITS = 0x3FF0000000000000
# Half of the last of the leading 26 bits.
_HALF_UNIT = 1 << 26


def polynomial(x: Value, coefficients: Sequence[float]) -> Value:
    """Evaluate a polynomial, given its coefficients by rising powers.

    The even and the odd powers are evaluated apart, each in the same way, much as in
    Estrin's scheme: fewer products wait for one another than in Horner's.
    """
    powers = [x]
    while 2 ** len(powers) < len(coefficients):
        powers.append(powers[-1] * powers[-1])

    def part(terms: Sequence[float], level: int) -> Value | float:
        if len(terms) == 1:
            return terms[0]
        even = part(terms[::2], level + 1)
        return part(terms[1::2], level + 1) * powers[level] + even

    result = part(coefficients, 0)
    assert isinstance(result, Value)
    return result


def nearest(x: Value) -> tuple[Value, Value]:
    """Return the integer nearest to x, and bits of which the lowest are that integer.

    For |x| < 2^51, with 51 bits for the integer and its sign.
    """
    with x.body.exact():
        shifted = x + _TO_INTEGER
        return shifted - _TO_INTEGER, shifted.bits()


def times_power_of_two(x: Value, exponent: Value) -> Value:
    """Return x 2^n, rounded once, where n is in the 13 lowest bits.

    For |n| of at most 2000: half of the power is multiplied first, so that neither
    factor overflows, and a result that is subnormal is rounded only at last.
    """
    half = exponent >> 1
    first = ((half << 52) + ONE_BITS).number()
    second = (((exponent - half) << 52) + ONE_BITS).number()
    return x * first * second


def power_of_two(exponent: Value) -> Value:
    """Return 2^n for n from -1022 to 1023 in the 12 lowest bits of an integer."""
    return ((exponent << 52) + ONE_BITS).number()


def fast_two_sum(a: Value | float, b: Value) -> Pair:
    """Return a + b without error, where a is 0 or |a| is at least |b|."""
    with b.body.exact():
        high = a + b
        return high, b - (high - a)


def two_sum(a: Value, b: Value) -> Pair:
    """Return a + b without error."""
    with a.body.exact():
        high = a + b
        other = high - a
        return high, (a - (high - other)) + (b - other)


def leading_bits(x: Value, count: int) -> Value:
    """Return a number of that many binary digits, which is x without the others."""
    return (x.bits() & -(1 << (53 - count))).number()


def halves(x: Value) -> Pair:
    """Split x into two numbers of 26 bits, such that products of these are exact."""
    with x.body.exact():
        upper = leading_bits((x.bits() + _HALF_UNIT).number(), 26)
        return upper, x - upper


def two_product(a: Value, b: Value) -> Pair:
    """Return a b without error, if there is no underflow."""
    with a.body.exact():
        high = a * b
        (a1, a2), (b1, b2) = halves(a), halves(b)
        return high, (((a1 * b1 - high) + a1 * b2) + a2 * b1) + a2 * b2


def product(a: Pair, b: Pair) -> Pair:
    """Return the product of two pairs."""
    high, low = two_product(a[0], b[0])
    return fast_two_sum(high, low + (a[0] * b[1] + a[1] * b[0]))


def quotient(a: Pair, b: Pair) -> Pair:
    """Return the quotient of two pairs."""
    high = a[0] / b[0]
    back, error = two_product(high, b[0])
    with high.body.exact():
        rest = (a[0] - back) - error
    return fast_two_sum(high, (rest + (a[1] - high * b[1])) / b[0])


def rounded_quotient(a: Pair, b: Pair) -> Value:
    """Return the quotient of two pairs to little more than half an ulp.

    The quotient of the first numbers is rounded, and only the effect of the second
    numbers is added.
    """
    first = a[0] / b[0]
    return first + (a[1] - first * b[1]) / b[0]


def root(a: Pair) -> Pair:
    """Return the square root of a pair that is positive."""
    high = square_root(a[0])
    back, error = two_product(high, high)
    with high.body.exact():
        rest = ((a[0] - back) - error) + a[1]
    return fast_two_sum(high, rest / (high + high))
