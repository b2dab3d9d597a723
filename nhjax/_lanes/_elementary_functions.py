"""Elementary functions of vectors, as text of LLVM IR that calls no library.

Errors are below 2 ulp everywhere, and the values at infinities, zeros and NaN are those
of C. All formulas are for float64, which float32 is converted to: its results are then
the nearest float32 but for few. Arguments that are infinite or NaN take no longer than
others, so that a failed member does not delay those in the other lanes.
"""

from collections.abc import Callable, Iterable
from functools import cache

from ._body import Body, Value
from ._error_function import erf
from ._exponentials import cosh, exp, exp2, expm1, logistic, sinh, tanh
from ._inverse_trigonometric import acos, asin, atan, atan2
from ._logarithms import acosh, asinh, atanh, log, log1p
from ._powers import cbrt, pow
from ._remainder import rem
from ._trigonometric import sine_and_cosine, tan


_SUFFIXES = {"float64": "f64", "float32": "f32"}
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


def symbol(op: str, dtype: str, width: int) -> str:
    """Name the function of `width` lanes that computes a primitive of JAX."""
    lanes = "" if width == 1 else f"x{width}"
    return f"nhjax.{op}.{_SUFFIXES[dtype]}{lanes}"


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
