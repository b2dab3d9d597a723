"""The writer of LLVM IR: text, values with operators, and arithmetic on them.

Kernels and elementary functions are written by one class, `Writer`, which collects the
instructions of one function. Its method `value` appends an instruction that is given as
text and returns the name of the result. The code that writes kernels calls this method
directly to save time, because a kernel has 10^4 instructions or more.

Formulas are written with `Value`, which holds the name of a result and its type. The
operators of `Value` append instructions, so that the Python expression
`(x - n * a) * b` writes the instructions that compute it. The functions below `Value`
are the common arithmetic of the elementary functions: polynomials, and double-double
numbers.
"""

import struct
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeAlias

import numpy as np


# Types and literals

_TYPES = {"bool": "i1", "float32": "float", "float64": "double"}


def scalar_type(dtype: str) -> str:
    """Return the LLVM type of one number of a dtype."""
    return _TYPES.get(dtype) or f"i{8 * np.dtype(dtype).itemsize}"


def memory_type(dtype: str) -> str:
    """Return the LLVM type of one number in memory, where booleans are bytes."""
    return "i8" if dtype == "bool" else scalar_type(dtype)


def vector(scalar: str, width: int) -> str:
    """Return the type of a vector; a vector of width 1 is a scalar."""
    return scalar if width == 1 else f"<{width} x {scalar}>"


def suffix(dtype: str, width: int, is_memory: bool = False) -> str:
    """Return the suffix that the name of an overloaded intrinsic has for a type."""
    scalar = memory_type(dtype) if is_memory else scalar_type(dtype)
    scalar = {"float": "f32", "double": "f64"}.get(scalar, scalar)
    return scalar if width == 1 else f"v{width}{scalar}"


def symbol(op: str, dtype: str, width: int) -> str:
    """Return the name of the function that computes a primitive of JAX on vectors."""
    return f"nhjax.{op}.{suffix(dtype, 1)}{'' if width == 1 else f'x{width}'}"


def literal(value: Any, dtype: str) -> str:
    """Return a number in the notation of LLVM IR."""
    if dtype.startswith("float"):
        # LLVM IR writes the bits of a float64 for float32 too.
        return f"0x{struct.unpack('<Q', struct.pack('<d', float(value)))[0]:016X}"
    if dtype == "bool":
        return "true" if value else "false"
    return str(int(value.astype(f"i{value.dtype.itemsize}")))


def splat(text: str, scalar: str, width: int) -> str:
    """Return a vector constant with the same number in all elements."""
    return text if width == 1 else f"splat ({scalar} {text})"


def is_signed(dtype: str) -> bool:
    """Return whether a dtype is a signed integer."""
    return dtype.startswith("int")


def bits(dtype: str) -> int:
    """Return the number of bits of one number in memory."""
    return 8 * np.dtype(dtype).itemsize


def result_type(types: Sequence[str]) -> str:
    """Return the type of a function with one result, or with several in a struct."""
    return types[0] if len(types) == 1 else f"{{ {', '.join(types)} }}"


# The writer


class Writer:
    """The instructions of one function, and the definitions that they refer to.

    - `width`: the number of members, which is the length of the vectors.
    - `contract`: the text of the fast-math flag that allows a product and a sum to be
        fused, with a space at the end, or an empty text.
    - `block`: the label of the basic block that is being written.
    - `constants`, `declarations`: text that stands outside of the function.
    - `wanted`: the elementary functions that are called, as (primitive, dtype, width).
    - `helpers`: definitions of other functions and tables, by name.
    """

    def __init__(self, width: int, contract: bool = True):
        self.width = width
        self.contract = "contract " if contract else ""
        self.lines: list[str] = []
        self.block = "entry"
        self.count = 0
        self.constants: list[str] = []
        self.declarations: dict[str, str] = {}
        self.wanted: dict[tuple[str, str, int], None] = {}
        self.helpers: dict[str, str] = {}

    def for_function(self, width: int) -> "Writer":
        """Return a writer for another function of the same module."""
        writer = Writer(width)
        writer.contract = self.contract
        writer.wanted = self.wanted
        return writer

    def new_name(self) -> str:
        """Return a name that is not in use."""
        self.count += 1
        return f"%v{self.count}"

    def add(self, instruction: str) -> None:
        """Append an instruction without a result."""
        self.lines.append("  " + instruction)

    def value(self, instruction: str) -> str:
        """Append an instruction, and return the name of its result."""
        self.count += 1
        name = f"%v{self.count}"
        self.lines.append(f"  {name} = {instruction}")
        return name

    def placeholder(self) -> int:
        """Append an empty line, to be filled in later, and return its index."""
        self.lines.append("")
        return len(self.lines) - 1

    def label(self, name: str) -> None:
        """Start a basic block."""
        self.lines.append(f"{name}:")
        self.block = name

    def definition(self, head: str) -> str:
        """Return the text of the function, which begins with `head`."""
        return "\n".join([f"{head} {{", "entry:", *self.lines, "}"])

    def broadcast(self, name: str, scalar: str) -> str:
        """Copy a scalar into all elements of a vector."""
        kind = vector(scalar, self.width)
        one = self.value(f"insertelement {kind} poison, {scalar} {name}, i64 0")
        zeros = f"<{self.width} x i32> zeroinitializer"
        return self.value(f"shufflevector {kind} {one}, {kind} poison, {zeros}")

    def any_of(self, mask: str) -> str:
        """Compute whether a mask is true for any member."""
        if self.width == 1:
            return mask
        whole = f"i{self.width}"
        number = self.value(f"bitcast <{self.width} x i1> {mask} to {whole}")
        return self.value(f"icmp ne {whole} {number}, 0")

    @contextmanager
    def exact(self) -> Iterator[None]:
        """Forbid fused products and sums, so that each operation rounds by itself."""
        before, self.contract = self.contract, ""
        yield
        self.contract = before

    # Methods for formulas

    def type(self, scalar: str) -> str:
        """Return the type of the vectors of a scalar type."""
        return vector(scalar, self.width)

    def compute(self, kind: str, instruction: str) -> "Value":
        """Append an instruction, and return its result as a `Value`."""
        return Value(self, kind, self.value(instruction))

    def constant(self, kind: str, number: float | int) -> "Value":
        """Return a constant that is the same for all members."""
        is_float = kind == "double"
        text = literal(number, "float64") if is_float else str(int(number))
        return Value(self, kind, splat(text, kind, self.width))

    def call(
        self, function: str, kinds: tuple[str, ...], *arguments: "Value"
    ) -> tuple["Value", ...]:
        """Call a function of vectors; `kinds` are the scalar types of its results."""
        result = result_type([self.type(kind) for kind in kinds])
        given = ", ".join(x.typed() for x in arguments)
        found = self.value(f"call {result} {function}({given})")
        return self._unpack(found, result, kinds)

    def _unpack(
        self, found: str, result: str, kinds: tuple[str, ...]
    ) -> tuple["Value", ...]:
        if len(kinds) == 1:
            return (Value(self, kinds[0], found),)
        return tuple(
            self.compute(kind, f"extractvalue {result} {found}, {index}")
            for index, kind in enumerate(kinds)
        )

    def call_for_each_member(
        self, function: str, kinds: tuple[str, ...], *arguments: "Value"
    ) -> tuple["Value", ...]:
        """Call a function of scalars once for each member."""
        if self.width == 1:
            return self.call(function, kinds, *arguments)
        wholes = [Value(self, kind, "poison") for kind in kinds]
        result = result_type(kinds)
        for member in range(self.width):
            given = ", ".join(
                f"{x.kind} {self.value(f'extractelement {x.typed()}, i64 {member}')}"
                for x in arguments
            )
            found = self.value(f"call {result} {function}({given})")
            for index, part in enumerate(self._unpack(found, result, kinds)):
                operands = f"{wholes[index].typed()}, {part.kind} {part.name}"
                wholes[index] = self.compute(
                    part.kind, f"insertelement {operands}, i64 {member}"
                )
        return tuple(wholes)

    def with_rare_case(
        self,
        is_rare: "Value",
        usual: tuple["Value", ...],
        rare: Callable[[], tuple["Value", ...]],
    ) -> tuple["Value", ...]:
        """Return `rare()` for the members where `is_rare` is true, otherwise `usual`.

        If `is_rare` is false for all members, the instructions of `rare` are skipped at
        run time.
        """
        is_any = self.any_of(is_rare.name)
        self.count += 1
        before, there, after = self.block, f"rare{self.count}", f"after{self.count}"
        self.add(f"br i1 {is_any}, label %{there}, label %{after}")
        self.label(there)
        pairs = list(zip(rare(), usual, strict=True))
        found = [(where(is_rare, x, y), y) for x, y in pairs]
        last = self.block
        self.add(f"br label %{after}")
        self.label(after)
        ways = [f"[ {x.name}, %{last} ], [ {y.name}, %{before} ]" for x, y in found]
        return tuple(
            self.compute(y.kind, f"phi {self.type(y.kind)} {way}")
            for way, y in zip(ways, usual, strict=True)
        )

    def result(self, *values: "Value") -> None:
        """Append the instruction that returns one value or several values."""
        result, whole = result_type([self.type(x.kind) for x in values]), values[0].name
        if len(values) > 1:
            whole = "poison"
            for index, x in enumerate(values):
                insertion = f"insertvalue {result} {whole}, {x.typed()}, {index}"
                whole = self.value(insertion)
        self.add(f"ret {result} {whole}")


# Values with operators


class Value:
    """A vector, or a scalar if the width is 1, for use in formulas.

    - `kind`: the LLVM type of the elements, such as `double` or `i64`.
    - `name`: the name of the instruction that computed the vector, or a constant.
    """

    def __init__(self, writer: Writer, kind: str, name: str):
        self.writer = writer
        self.kind = kind
        self.name = name

    def typed(self) -> str:
        """Return `type name`, as the first operand of an instruction is written."""
        return f"{self.writer.type(self.kind)} {self.name}"

    def _other(self, other: "Operand") -> "Value":
        if isinstance(other, Value):
            return other
        return self.writer.constant(self.kind, other)

    def _instruction(
        self, name: str, other: "Operand", result: str | None = None
    ) -> "Value":
        flags = self.writer.contract if self.kind == "double" else ""
        text = f"{name} {flags}{self.typed()}, {self._other(other).name}"
        return self.writer.compute(result or self.kind, text)

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
        return self._other(other) - self

    def __mul__(self, other: "Operand") -> "Value":
        return self._arithmetic("mul", other)

    def __rmul__(self, other: "Operand") -> "Value":
        return self * other

    def __truediv__(self, other: "Operand") -> "Value":
        return self._arithmetic("div", other)

    def __rtruediv__(self, other: "Operand") -> "Value":
        return self._other(other) / self

    def __neg__(self) -> "Value":
        if self.kind == "double":
            return self.writer.compute("double", f"fneg {self.typed()}")
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
        with self.writer.exact():
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
        """Return for which members two values are equal; NaN equals no value."""
        return self._compare("oeq", "eq", other)

    def cast(self, instruction: str, kind: str) -> "Value":
        """Convert by an LLVM instruction, such as `zext`, `trunc` or `bitcast`."""
        types = f"{self.typed()} to {self.writer.type(kind)}"
        return self.writer.compute(kind, f"{instruction} {types}")

    def bits(self) -> "Value":
        """Return the bits of floating-point numbers as integers."""
        return self.cast("bitcast", "i64")

    def number(self) -> "Value":
        """Return the floating-point numbers that have these bits."""
        return self.cast("bitcast", "double")


Operand: TypeAlias = Value | float | int


def where(condition: Value, chosen: Operand, other: Operand) -> Value:
    """Return `chosen` for the members where the condition holds, otherwise `other`."""
    writer = condition.writer
    kinds = [x.kind for x in (chosen, other) if isinstance(x, Value)]
    kind = kinds[0] if kinds else "i64" if isinstance(chosen, int) else "double"
    first, second = (
        x if isinstance(x, Value) else writer.constant(kind, x) for x in (chosen, other)
    )
    operands = f"{condition.typed()}, {first.typed()}, {second.typed()}"
    return writer.compute(kind, f"select {operands}")


# Arithmetic of float64


def absolute(x: Value) -> Value:
    """Return |x|."""
    return _intrinsic("fabs", x)


def with_sign(x: Value, sign: Value) -> Value:
    """Return |x| with the sign of another value; the signs of zeros count."""
    return _intrinsic("copysign", x, sign)


def square_root(x: Value) -> Value:
    """Return the correctly rounded square root of x."""
    return _intrinsic("sqrt", x)


def _intrinsic(name: str, *arguments: Value) -> Value:
    writer = arguments[0].writer
    full = f"llvm.{name}.{suffix('float64', writer.width)}"
    return writer.call(f"@{full}", ("double",), *arguments)[0]


# A number of about 106 bits: the sum of two float64. The second number is at most the
# round-off of the first number.
DoubleDouble: TypeAlias = tuple[Value, Value]

# Adding this number to x rounds x to an integer, stored in the lowest bits of the sum.
_TO_INTEGER = 1.5 * 2.0**52
# The bits of 1.0.
ONE_BITS = 0x3FF0000000000000
# Half a unit of the last bit among the leading 26 bits.
_HALF_UNIT = 1 << 26


def polynomial(x: Value, coefficients: Sequence[float]) -> Value:
    """Evaluate a polynomial with the given coefficients, lowest power first.

    As in Estrin's scheme, the even and the odd powers are evaluated separately, by
    recursion. The chain of dependent products is shorter than in Horner's scheme.
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
    """Return the integer nearest to x, as a float and in the lowest bits of an integer.

    The results are valid for |x| < 2^51. The lowest 51 bits of the second result are
    the integer modulo 2^51.
    """
    with x.writer.exact():
        shifted = x + _TO_INTEGER
        return shifted - _TO_INTEGER, shifted.bits()


def times_power_of_two(x: Value, exponent: Value) -> Value:
    """Return x 2^n, rounded once, where n is in the lowest 13 bits of `exponent`.

    |n| must be at most 2000. The factor 2^n is divided into two factors, so that
    neither factor overflows and a subnormal result is rounded only in the last product.
    """
    half = exponent >> 1
    first = ((half << 52) + ONE_BITS).number()
    second = (((exponent - half) << 52) + ONE_BITS).number()
    return x * first * second


def power_of_two(exponent: Value) -> Value:
    """Return 2^n, where the lowest 12 bits of `exponent` are n from -1022 to 1023."""
    return ((exponent << 52) + ONE_BITS).number()


def fast_two_sum(a: Value | float, b: Value) -> DoubleDouble:
    """Return a + b without error, if a is 0 or |a| >= |b|."""
    with b.writer.exact():
        high = a + b
        return high, b - (high - a)


def two_sum(a: Value, b: Value) -> DoubleDouble:
    """Return a + b without error."""
    with a.writer.exact():
        high = a + b
        other = high - a
        return high, (a - (high - other)) + (b - other)


def leading_bits(x: Value, count: int) -> Value:
    """Return x truncated to `count` binary digits."""
    return (x.bits() & -(1 << (53 - count))).number()


def halves(x: Value) -> DoubleDouble:
    """Split x into two numbers of 26 bits, whose products are exact."""
    with x.writer.exact():
        upper = leading_bits((x.bits() + _HALF_UNIT).number(), 26)
        return upper, x - upper


def two_product(a: Value, b: Value) -> DoubleDouble:
    """Return the product a b without error, unless it overflows or underflows."""
    with a.writer.exact():
        high = a * b
        (a1, a2), (b1, b2) = halves(a), halves(b)
        return high, (((a1 * b1 - high) + a1 * b2) + a2 * b1) + a2 * b2


def product(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the product of two double-double numbers."""
    high, low = two_product(a[0], b[0])
    return fast_two_sum(high, low + (a[0] * b[1] + a[1] * b[0]))


def quotient(a: DoubleDouble, b: DoubleDouble) -> DoubleDouble:
    """Return the quotient of two double-double numbers."""
    high = a[0] / b[0]
    back, error = two_product(high, b[0])
    with high.writer.exact():
        rest = (a[0] - back) - error
    return fast_two_sum(high, (rest + (a[1] - high * b[1])) / b[0])


def rounded_quotient(a: DoubleDouble, b: DoubleDouble) -> Value:
    """Return the quotient of two double-double numbers, rounded to one float64.

    The error is little more than half an ulp. The quotient of the high parts is
    rounded, and the effect of the low parts is added.
    """
    first = a[0] / b[0]
    return first + (a[1] - first * b[1]) / b[0]


def root(a: DoubleDouble) -> DoubleDouble:
    """Return the square root of a positive double-double number."""
    high = square_root(a[0])
    back, error = two_product(high, high)
    with high.writer.exact():
        rest = ((a[0] - back) - error) + a[1]
    return fast_two_sum(high, rest / (high + high))
