"""The elementary functions, defined in LLVM IR that calls no library.

A kernel calls a function such as `@nhjax.exp.f64x8`, and `definitions` returns the text
of all functions that a kernel calls. Errors are below 2 ulp everywhere, and the values
at infinities, zeros and NaN are the same as in C. All formulas are for float64; float32
is converted to float64 and back, so that nearly all results are the nearest float32.
Infinite and NaN arguments take no longer than finite arguments, so that a failed member
does not slow down the other members of its vector.
"""

import math
from collections.abc import Callable, Iterable
from functools import cache

from ._exponentials import (
    acosh,
    asinh,
    atanh,
    cbrt,
    cosh,
    erf,
    exp,
    exp2,
    expm1,
    log,
    log1p,
    logistic,
    pow,
    sinh,
    tanh,
)
from ._trigonometry import acos, asin, atan, atan2, sine_and_cosine, tan
from ._writer import (
    absolute,
    nearest,
    result_type,
    scalar_type,
    symbol,
    two_product,
    Value,
    where,
    with_sign,
    Writer,
)


def definitions(wanted: Iterable[tuple[str, str, int]]) -> str:
    """Return the definitions of functions and of the functions they call, each once.

    A function is given by the name of JAX's primitive, the dtype and the width.
    """
    texts: dict[str, str] = {}
    for function in wanted:
        texts |= _texts(*function)
    return "\n".join(texts.values())


@cache
def _texts(op: str, dtype: str, width: int) -> dict[str, str]:
    """Return the definitions of a function and of the functions it calls, by name."""
    writer = Writer(width)
    scalar = scalar_type(dtype)
    names = ["%x", "%y"] if op in _BINARY else ["%x"]
    results = _write(op, [Value(writer, scalar, name) for name in names])
    writer.result(*results)
    kind = writer.type(scalar)
    result = result_type([kind] * len(results))
    # A function that only calls another function is inlined. `sin` and `cos` call one
    # common function, which is not inlined, so that LLVM merges its calls.
    is_call = dtype == "float32" or op in _RESULT_OF_BOTH
    inlining = "noinline" if op == _SIN_AND_COS else "alwaysinline" if is_call else ""
    name, parameters = symbol(op, dtype, width), ", ".join(f"{kind} {x}" for x in names)
    # With these attributes LLVM merges calls with equal arguments, and removes calls
    # whose results are not used.
    attributes = "nounwind willreturn memory(none)"
    head = f"define internal {result} @{name}({parameters}) {inlining} {attributes}"
    texts: dict[str, str] = {}
    for function in writer.wanted:
        texts |= _texts(*function)
    return {**texts, **writer.helpers, name: f"{writer.definition(head)}\n"}


def _write(op: str, arguments: list[Value]) -> tuple[Value, ...]:
    """Write the formulas of a function, and return its results."""
    if arguments[0].kind == "float":
        (result,) = _call(op, 1, *[x.cast("fpext", "double") for x in arguments])
        return (result.cast("fptrunc", "float"),)
    if op == _SIN_AND_COS:
        return sine_and_cosine(*arguments)
    if op in _RESULT_OF_BOTH:
        return (_call(_SIN_AND_COS, 2, *arguments)[_RESULT_OF_BOTH[op]],)
    function = _BINARY[op] if op in _BINARY else _UNARY[op]
    return (function(*arguments),)


def _call(op: str, results: int, *arguments: Value) -> tuple[Value, ...]:
    """Write a call of another elementary function, for float64."""
    writer = arguments[0].writer
    writer.wanted[op, "float64", writer.width] = None
    name = symbol(op, "float64", writer.width)
    return writer.call(f"@{name}", ("double",) * results, *arguments)


# The remainder of a division that is rounded towards zero


_LARGEST_QUOTIENT = 2.0**50
_LONG_REMAINDER = "nhjax.long_remainder"

# The remainder of the division of x by y for finite x >= y > 0, by long division of the
# mantissas. Each step shifts the remainder by up to 11 bits.
_LONG_REMAINDER_HEAD = (
    f"define internal double @{_LONG_REMAINDER}(double %x, double %y)"
)
_LONG_REMAINDER_DEFINITION = f"""\
{_LONG_REMAINDER_HEAD} cold noinline nounwind {{
entry:
  %xb = bitcast double %x to i64
  %yb = bitcast double %y to i64
  %xe.raw = lshr i64 %xb, 52
  %ye.raw = lshr i64 %yb, 52
  %xm.low = and i64 %xb, 4503599627370495
  %ym.low = and i64 %yb, 4503599627370495
  %x.subnormal = icmp eq i64 %xe.raw, 0
  %y.subnormal = icmp eq i64 %ye.raw, 0
  %xm.one = or i64 %xm.low, 4503599627370496
  %ym.one = or i64 %ym.low, 4503599627370496
  %xm = select i1 %x.subnormal, i64 %xm.low, i64 %xm.one
  %ym = select i1 %y.subnormal, i64 %ym.low, i64 %ym.one
  %xe = call i64 @llvm.umax.i64(i64 %xe.raw, i64 1)
  %ye = call i64 @llvm.umax.i64(i64 %ye.raw, i64 1)
  %distance = sub i64 %xe, %ye
  %is.zero = icmp eq i64 %ym, 0
  %divisor = select i1 %is.zero, i64 1, i64 %ym
  %first = urem i64 %xm, %divisor
  br label %loop
loop:
  %left = phi i64 [ %distance, %entry ], [ %left.next, %step ]
  %rest = phi i64 [ %first, %entry ], [ %rest.next, %step ]
  %goes.on = icmp sgt i64 %left, 0
  br i1 %goes.on, label %step, label %done
step:
  %shift = call i64 @llvm.umin.i64(i64 %left, i64 11)
  %shifted = shl i64 %rest, %shift
  %rest.next = urem i64 %shifted, %divisor
  %left.next = sub i64 %left, %shift
  br label %loop
done:
  %whole = uitofp i64 %rest to double
  %upper = lshr i64 %ye, 1
  %lower = sub i64 %ye, %upper
  %upper.raw = add i64 %upper, 486
  %lower.raw = add i64 %lower, 485
  %upper.bits = shl i64 %upper.raw, 52
  %lower.bits = shl i64 %lower.raw, 52
  %upper.factor = bitcast i64 %upper.bits to double
  %lower.factor = bitcast i64 %lower.bits to double
  %half = fmul double %whole, %upper.factor
  %result = fmul double %half, %lower.factor
  ret double %result
}}
"""


def rem(x: Value, y: Value) -> Value:
    """Return x - y trunc(x / y), computed without error."""
    a, b = absolute(x), absolute(y)
    ratio = a / b
    whole, _ = nearest(ratio)
    high, low = two_product(whole, b)
    with x.writer.exact():
        rest = (a - high) - low
        rest = where(rest < 0.0, rest + b, rest)
    rest = where(a < b, a, rest)
    # Long division is used for large quotients, and also for very large and very small
    # numbers. For these `two_product` may overflow, or may underflow if the processor
    # replaces subnormal numbers by 0.
    is_long = (ratio > _LARGEST_QUOTIENT) | (a > 2.0**1000) | (b < 2.0**-900)
    is_long = is_long & (a < math.inf) & (b > 0.0) & (a >= b)

    def otherwise() -> tuple[Value, ...]:
        x.writer.helpers[_LONG_REMAINDER] = _LONG_REMAINDER_DEFINITION
        return x.writer.call_for_each_member(f"@{_LONG_REMAINDER}", ("double",), a, b)

    (rest,) = x.writer.with_rare_case(is_long, (rest,), otherwise)
    return with_sign(rest, x)


# The table of functions

_UNARY: dict[str, Callable[[Value], Value]] = {
    "acos": acos,
    "acosh": acosh,
    "asin": asin,
    "asinh": asinh,
    "atan": atan,
    "atanh": atanh,
    "cbrt": cbrt,
    "cosh": cosh,
    "erf": erf,
    "exp": exp,
    "exp2": exp2,
    "expm1": expm1,
    "log": log,
    "log1p": log1p,
    "logistic": logistic,
    "sinh": sinh,
    "tan": tan,
    "tanh": tanh,
}
_BINARY = {"atan2": atan2, "pow": pow, "rem": rem}
# Sine and cosine are two results of one function.
_SIN_AND_COS = "sin_and_cos"
_RESULT_OF_BOTH = {"sin": 0, "cos": 1}

SUPPORTED = frozenset([*_UNARY, *_BINARY, *_RESULT_OF_BOTH])
