"""The remainder of a division that is rounded towards zero, for vectors of float64.

Elementary functions of vectors, as text of LLVM IR that calls no library.

Errors are below 2 ulp everywhere, and the values at infinities, zeros and NaN are those
of C. All formulas are for float64, which float32 is converted to: its results are then
the nearest float32 but for few. Arguments that are infinite or NaN take no longer than
others, so that a failed member does not delay those in the other lanes.
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
    Body,
    nearest,
    symbol,
    two_product,
    Value,
    where,
    with_sign,
)


_LARGEST_QUOTIENT = 2.0**50
_LONG_REMAINDER = "nhjax.long_remainder"

# The remainder of |x| by |y| for finite x >= y > 0, by a long division of the mantissas
# in which each step shifts the rest by up to 11 bits.
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
    """Return x - y trunc(x / y), which is exact."""
    a, b = absolute(x), absolute(y)
    ratio = a / b
    whole, _ = nearest(ratio)
    high, low = two_product(whole, b)
    with x.body.exact():
        rest = (a - high) - low
        rest = where(rest < 0.0, rest + b, rest)
    rest = where(a < b, a, rest)
    # The exact product may be beyond the range of float64 for very large and, where
    # subnormal numbers are flushed to 0, for very small numbers.
    is_long = (ratio > _LARGEST_QUOTIENT) | (a > 2.0**1000) | (b < 2.0**-900)
    is_long = is_long & (a < math.inf) & (b > 0.0) & (a >= b)

    def otherwise() -> tuple[Value, ...]:
        x.body.needed[_LONG_REMAINDER] = _LONG_REMAINDER_DEFINITION
        return x.body.lane_by_lane(f"@{_LONG_REMAINDER}", ("double",), a, b)

    (rest,) = x.body.with_rare_case(is_long, (rest,), otherwise)
    return with_sign(rest, x)


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
# Sine and cosine are the results of one function.
_BOTH = "sin_and_cos"
_OF_BOTH = {"sin": 0, "cos": 1}

SUPPORTED = frozenset([*_UNARY, *_BINARY, *_OF_BOTH])

# So LLVM may merge calls with the same arguments, and drop what is not used.
_ATTRIBUTES = "nounwind willreturn memory(none)"


def definition(op: str, dtype: str, width: int) -> str:
    """Return the definition of a function, with all that it needs."""
    return library([(op, dtype, width)])


def library(wanted: Iterable[tuple[str, str, int]]) -> str:
    """Return the definitions of functions, with what they need, each once."""
    texts: dict[str, str] = {}
    for op, dtype, width in wanted:
        texts |= _texts(op, dtype, width)
    return "\n".join(texts.values())


@cache
def _texts(op: str, dtype: str, width: int) -> dict[str, str]:
    """Return definitions by name: of a function, and of those that it calls."""
    body = Body(width)
    kind = "double" if dtype == "float64" else "float"
    names = ["%x", "%y"] if op in _BINARY else ["%x"]
    results = _write(op, [Value(body, kind, name) for name in names])
    types = [body.type(kind)] * len(results)
    result = types[0] if len(types) == 1 else f"{{ {', '.join(types)} }}"
    body.result(*results)
    # What only calls another function is put in place. That of sine and cosine is not,
    # so that its calls can be merged.
    is_call = dtype == "float32" or op in _OF_BOTH
    kept = "noinline" if op == _BOTH else "alwaysinline" if is_call else ""
    name, given = symbol(op, dtype, width), ", ".join(f"{types[0]} {x}" for x in names)
    head = f"define internal {result} @{name}({given}) {kept} {_ATTRIBUTES}"
    return {**body.needed, name: body.text(head)}


def _write(op: str, arguments: list[Value]) -> tuple[Value, ...]:
    """Write the formulas of a function, and return its results."""
    if arguments[0].kind == "float":
        long = [x.cast("fpext", "double") for x in arguments]
        (result,) = _call(op, 1, *long)
        return (result.cast("fptrunc", "float"),)
    if op == _BOTH:
        return sine_and_cosine(*arguments)
    if op in _OF_BOTH:
        return (_call(_BOTH, 2, *arguments)[_OF_BOTH[op]],)
    function = _BINARY[op] if op in _BINARY else _UNARY[op]
    return (function(*arguments),)


def _call(op: str, results: int, *arguments: Value) -> tuple[Value, ...]:
    """Call another of the functions for float64."""
    body = arguments[0].body
    body.needed |= _texts(op, "float64", body.width)
    name = symbol(op, "float64", body.width)
    return body.call(f"@{name}", ("double",) * results, *arguments)
