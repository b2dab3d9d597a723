"""JAX's operations that act element by element.

A function of scalars is applied to each number of the arrays; the tables at the end map
JAX's primitives to these functions.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from ._builder import ArrayValue, Builder, Operation
from ._graph import dtype_name, is_float, Node, Unsupported


def _each(
    function: Callable[..., Node],
    builder: Builder,
    equation: Any,
    values: list[ArrayValue],
) -> ArrayValue:
    aval = equation.outvars[0].aval
    dtype = dtype_name(aval.dtype)
    bound = partial(function, builder, equation)
    return builder.map_numbers(aval.shape, dtype, bound, *values)


def _each_op(
    op: str, builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    """Apply to each number an operation that ignores the equation's parameters."""
    aval = equation.outvars[0].aval
    function = partial(builder.graph.op, op)
    return builder.map_numbers(aval.shape, dtype_name(aval.dtype), function, *values)


def _elementary(name: str) -> Callable[..., Node]:
    def function(builder: Builder, equation: Any, *numbers: Node) -> Node:
        dtype = dtype_name(equation.outvars[0].aval.dtype)
        numbers = tuple(builder.graph.convert(x, dtype) for x in numbers)
        if not is_float(dtype):
            raise Unsupported(f"{name} of integers")
        return builder.graph.pure("function", numbers, dtype, name)

    return function


def _rem(builder: Builder, equation: Any, a: Node, b: Node) -> Node:
    if is_float(a.dtype) and not (a.is_constant and b.is_constant):
        return _elementary("rem")(builder, equation, a, b)
    return builder.graph.op("rem", a, b)


def _square(builder: Builder, equation: Any, x: Node) -> Node:
    return builder.graph.op("mul", x, x)


def _integer_pow(builder: Builder, equation: Any, x: Node) -> Node:
    return _power(builder, x, equation.params["y"])


def _power(builder: Builder, x: Node, exponent: int) -> Node:
    one = builder.graph.constant(1, x.dtype)
    if exponent < 0:
        return builder.graph.op("div", one, _power(builder, x, -exponent))
    result, factor = one, x
    while exponent:
        if exponent & 1:
            result = builder.graph.op("mul", result, factor)
        exponent >>= 1
        if exponent:
            factor = builder.graph.op("mul", factor, factor)
    return result


def _rsqrt(builder: Builder, equation: Any, x: Node) -> Node:
    one = builder.graph.constant(1, x.dtype)
    return builder.graph.op("div", one, builder.graph.op("sqrt", x))


def _round(builder: Builder, equation: Any, x: Node) -> Node:
    method = equation.params["rounding_method"]
    is_even = method == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return builder.graph.op("round_even" if is_even else "round_away", x)


def _in_total_order(op: str) -> Callable[..., Node]:
    """Return a comparison in the order -NaN < -inf < ... < -0.0 < 0.0 < ... < NaN."""

    def function(builder: Builder, equation: Any, *numbers: Node) -> Node:
        keys = [_sorting_key(builder, number) for number in numbers]
        return builder.graph.op(op, *keys)

    return function


def _sorting_key(builder: Builder, x: Node) -> Node:
    graph = builder.graph
    if not is_float(x.dtype):
        return x
    dtype = "int64" if x.dtype == "float64" else "int32"
    bits = _pattern(builder, x, dtype)
    is_negative = graph.op("lt", bits, graph.constant(0, dtype))
    largest = graph.constant(np.iinfo(dtype).max, dtype)
    return graph.select(is_negative, graph.op("xor", bits, largest), bits)


def _convert(builder: Builder, equation: Any, x: Node) -> Node:
    return builder.graph.convert(x, dtype_name(equation.params["new_dtype"]))


def _bitcast(builder: Builder, equation: Any, x: Node) -> Node:
    return _pattern(builder, x, dtype_name(equation.params["new_dtype"]))


def _pattern(builder: Builder, x: Node, dtype: str) -> Node:
    """Reinterpret the bits of a number as another dtype."""
    if dtype == x.dtype:
        return x
    if "bool" in (dtype, x.dtype):
        raise Unsupported("bit patterns of booleans")
    if np.dtype(dtype).itemsize != np.dtype(x.dtype).itemsize:
        raise Unsupported("bit patterns of another size")
    if x.is_constant:
        return builder.graph.constant(x.attr.view(dtype), dtype)
    if x.op == "bitcast" and x.args[0].dtype == dtype:
        return x.args[0]
    return builder.graph.pure("bitcast", (x,), dtype)


def _select(builder: Builder, equation: Any, which: Node, *cases: Node) -> Node:
    graph = builder.graph
    if which.dtype == "bool":
        return graph.select(which, cases[-1], cases[0])
    out = cases[-1]
    for index in range(len(cases) - 2, -1, -1):
        is_below = graph.op("le", which, graph.constant(index, which.dtype))
        out = graph.select(is_below, cases[index], out)
    return out


def _clamp(builder: Builder, equation: Any, low: Node, x: Node, high: Node) -> Node:
    return builder.graph.op("min", builder.graph.op("max", x, low), high)


def _zeros_like(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    aval = equation.outvars[0].aval
    return builder.full(aval.shape, builder.graph.zero(dtype_name(aval.dtype)))


def _iota(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    aval, dimension = equation.outvars[0].aval, equation.params["dimension"]
    dtype = dtype_name(aval.dtype)
    shape = [-1 if d == dimension else 1 for d in range(len(aval.shape))]
    with np.errstate(all="ignore"):
        numbers = np.arange(aval.shape[dimension]).astype(dtype).reshape(shape)
    return builder.constant(np.broadcast_to(numbers, aval.shape), aval)


def _empty(builder: Builder, equation: Any, values: list[ArrayValue]) -> ArrayValue:
    aval = equation.outvars[0].aval
    zero = builder.graph.constant(0, dtype_name(aval.dtype))
    return builder.full(aval.shape, zero)


def _same(builder: Builder, equation: Any, values: list[ArrayValue]) -> Any:
    return values if equation.primitive.multiple_results else values[0]


_NAMES = {
    "add_any": "add",
    **{
        name: name
        for name in """
            abs add and ceil div eq floor ge gt is_finite le lt max min mul ne neg not
            or shift_left shift_right_arithmetic shift_right_logical sign sqrt sub xor
            population_count clz
        """.split()  # noqa: SIM905
    },
}
_FUNCTIONS: dict[str, Callable[..., Node]] = {
    **{
        name: _elementary(name)
        for name in """
            acos acosh asin asinh atan atan2 atanh cbrt cos cosh erf exp exp2 expm1 log
            log1p logistic pow sin sinh tan tanh
        """.split()  # noqa: SIM905
    },
    "rem": _rem,
    "square": _square,
    "integer_pow": _integer_pow,
    "rsqrt": _rsqrt,
    "round": _round,
    "convert_element_type": _convert,
    "bitcast_convert_type": _bitcast,
    "select_n": _select,
    "clamp": _clamp,
    **{f"{op}_to": _in_total_order(op) for op in ("eq", "lt", "le")},
}
ELEMENTWISE: dict[str, Operation] = {
    **{name: partial(_each_op, op) for name, op in _NAMES.items()},
    **{name: partial(_each, function) for name, function in _FUNCTIONS.items()},
    **dict.fromkeys(
        ("copy", "copy_p", "stop_gradient", "optimization_barrier", "pvary"), _same
    ),
    "zeros_like": _zeros_like,
    "iota": _iota,
    "empty": _empty,
    "empty2": _empty,
}
