"""The LLVM instructions for each pure operation of the graph.

`write` is called with the operands as text. Intrinsics of LLVM need no declaration.
"""

from collections.abc import Callable

import numpy as np

from ._graph import is_float, Node
from ._writer import (
    bits,
    is_signed,
    literal,
    scalar_type,
    splat,
    suffix,
    symbol,
    vector,
    Writer,
)


# A rule writes a node's instructions. Its arguments are the writer, the node, the
# number of members in its result, and its operands as text.
_Rule = Callable[[Writer, Node, int, list[str]], str]

_FLOAT_COMPARISONS = {
    "eq": "oeq",
    "ne": "une",
    "lt": "olt",
    "le": "ole",
    "gt": "ogt",
    "ge": "oge",
}
_INTRINSICS = {
    "sqrt": "sqrt",
    "floor": "floor",
    "ceil": "ceil",
    "round_even": "roundeven",
    "round_away": "round",
    "population_count": "ctpop",
}


def write(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    """Write the instructions of a pure node, and return the name of the result."""
    if node.op in _INTRINSICS:
        return _intrinsic(writer, _INTRINSICS[node.op], node.dtype, width, args)
    return _RULES[node.op](writer, node, width, args)


def _intrinsic(
    writer: Writer, name: str, dtype: str, width: int, args: list[str], more: str = ""
) -> str:
    kind = vector(scalar_type(dtype), width)
    full = f"llvm.{name}.{suffix(dtype, width)}"
    arguments = ", ".join(f"{kind} {arg}" for arg in args)
    return writer.value(f"call {kind} @{full}({arguments}{more})")


def _arithmetic(name: str) -> _Rule:
    def rule(writer: Writer, node: Node, width: int, args: list[str]) -> str:
        kind = vector(scalar_type(node.dtype), width)
        op = f"f{name} {writer.contract}" if is_float(node.dtype) else f"{name} "
        return writer.value(f"{op}{kind} {args[0]}, {args[1]}")

    return rule


def _bitwise(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    kind = vector(scalar_type(node.dtype), width)
    return writer.value(f"{node.op} {kind} {args[0]}, {args[1]}")


def _div(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    if is_float(node.dtype):
        return _arithmetic("div")(writer, node, width, args)
    return _integer_division(writer, node, width, args)


def _integer_division(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    """Compute the quotient or remainder of integers with the same results as XLA.

    LLVM's own instructions may trap for the divisor 0, and for -1 if the quotient
    overflows.
    """
    a, b = args
    divisor, signed = node.args[1], is_signed(node.dtype)
    kind, flag = vector(scalar_type(node.dtype), width), vector("i1", width)
    op = ("s" if signed else "u") + node.op
    if (
        divisor.is_constant
        and divisor.attr != 0
        and not (signed and divisor.attr == -1)
    ):
        return writer.value(f"{op} {kind} {a}, {b}")
    zero, one = (splat(text, scalar_type(node.dtype), width) for text in "01")
    ones = splat("-1", scalar_type(node.dtype), width)
    is_zero = writer.value(f"icmp eq {kind} {b}, {zero}")
    is_odd, is_minus = is_zero, ""
    if signed:
        is_minus = writer.value(f"icmp eq {kind} {b}, {ones}")
        is_odd = writer.value(f"or {flag} {is_zero}, {is_minus}")
    safe = writer.value(f"select {flag} {is_odd}, {kind} {one}, {kind} {b}")
    out = writer.value(f"{op} {kind} {a}, {safe}")
    if node.op == "rem":
        # The remainder by -1 equals the remainder by 1.
        return writer.value(f"select {flag} {is_zero}, {kind} {a}, {kind} {out}")
    if signed:
        minus = writer.value(f"sub {kind} {zero}, {a}")
        out = writer.value(f"select {flag} {is_minus}, {kind} {minus}, {kind} {out}")
    return writer.value(f"select {flag} {is_zero}, {kind} {ones}, {kind} {out}")


def _neg(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    kind = vector(scalar_type(node.dtype), width)
    if is_float(node.dtype):
        return writer.value(f"fneg {kind} {args[0]}")
    zero = splat("0", scalar_type(node.dtype), width)
    return writer.value(f"sub {kind} {zero}, {args[0]}")


def _not(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    kind = vector(scalar_type(node.dtype), width)
    ones = splat(
        "true" if node.dtype == "bool" else "-1", scalar_type(node.dtype), width
    )
    return writer.value(f"xor {kind} {args[0]}, {ones}")


def _abs(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    if is_float(node.dtype):
        return _intrinsic(writer, "fabs", node.dtype, width, args)
    return _intrinsic(writer, "abs", node.dtype, width, args, more=", i1 false")


def _clz(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    return _intrinsic(writer, "ctlz", node.dtype, width, args, more=", i1 false")


def _extremum(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    is_max, dtype = node.op == "max", node.dtype
    kind, flag = vector(scalar_type(dtype), width), vector("i1", width)
    if dtype == "bool":
        return writer.value(f"{'or' if is_max else 'and'} {kind} {args[0]}, {args[1]}")
    if not is_float(dtype):
        sign = "s" if is_signed(dtype) else "u"
        return _intrinsic(writer, sign + node.op, dtype, width, args)
    for index, arg in enumerate(node.args):
        if arg.is_constant and arg.attr != 0 and not np.isnan(arg.attr):
            # With such a constant, signed zeros and NaN need no special case.
            known, other = args[index], args[1 - index]
            order = "ogt" if is_max else "olt"
            wins = writer.value(f"fcmp {order} {kind} {known}, {other}")
            return writer.value(f"select {flag} {wins}, {kind} {known}, {kind} {other}")
    return _intrinsic(writer, node.op + "imum", dtype, width, args)


def _sign(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    (x,), dtype = args, node.dtype
    kind, flag = vector(scalar_type(dtype), width), vector("i1", width)
    if is_float(dtype):
        zero = splat(literal(np.float64(0), dtype), scalar_type(dtype), width)
        one = splat(literal(np.float64(1), dtype), scalar_type(dtype), width)
        signed = _intrinsic(writer, "copysign", dtype, width, [one, x])
        moves = writer.value(f"fcmp one {kind} {x}, {zero}")
        return writer.value(f"select {flag} {moves}, {kind} {signed}, {kind} {x}")
    zero = splat("0", scalar_type(dtype), width)
    order = "sgt" if is_signed(dtype) else "ugt"
    positive = writer.value(f"icmp {order} {kind} {x}, {zero}")
    out = writer.value(f"zext {flag} {positive} to {kind}")
    if is_signed(dtype):
        negative = writer.value(f"icmp slt {kind} {x}, {zero}")
        minus = writer.value(f"sext {flag} {negative} to {kind}")
        out = writer.value(f"or {kind} {out}, {minus}")
    return out


def _is_finite(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    dtype = node.args[0].dtype
    kind = vector(scalar_type(dtype), width)
    size = _intrinsic(writer, "fabs", dtype, width, args)
    infinity = splat(literal(np.float64(np.inf), dtype), scalar_type(dtype), width)
    return writer.value(f"fcmp olt {kind} {size}, {infinity}")


def _compare(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    dtype = node.args[0].dtype
    kind = vector(scalar_type(dtype), width)
    if is_float(dtype):
        text = f"fcmp {_FLOAT_COMPARISONS[node.op]}"
    elif node.op in ("eq", "ne"):
        text = f"icmp {node.op}"
    else:
        text = f"icmp {'s' if is_signed(dtype) else 'u'}{node.op}"
    return writer.value(f"{text} {kind} {args[0]}, {args[1]}")


def _select(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    kind = vector(scalar_type(node.dtype), width)
    # A uniform predicate may select between vectors.
    flag = vector("i1", width if node.args[0].is_divergent else 1)
    return writer.value(f"select {flag} {args[0]}, {kind} {args[1]}, {kind} {args[2]}")


def _convert(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    before, after = node.args[0].dtype, node.dtype
    source, target = (vector(scalar_type(d), width) for d in (before, after))
    if is_float(before) and not is_float(after):
        name = f"llvm.fpto{'s' if is_signed(after) else 'u'}i.sat"
        name = f"{name}.{suffix(after, width)}.{suffix(before, width)}"
        return writer.value(f"call {target} @{name}({source} {args[0]})")
    grows = before == "bool" or bits(after) > bits(before)
    if is_float(before):
        op = "fpext" if grows else "fptrunc"
    elif is_float(after):
        op = "sitofp" if is_signed(before) else "uitofp"
    elif grows:
        op = "sext" if is_signed(before) else "zext"
    elif bits(after) < bits(before):
        op = "trunc"
    else:
        op = "bitcast"
    return writer.value(f"{op} {source} {args[0]} to {target}")


def _bitcast(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    source = vector(scalar_type(node.args[0].dtype), width)
    target = vector(scalar_type(node.dtype), width)
    return writer.value(f"bitcast {source} {args[0]} to {target}")


_SHIFTS = {
    "shift_left": "shl",
    "shift_right_logical": "lshr",
    "shift_right_arithmetic": "ashr",
}


def _shift(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    """Shift integers as XLA does.

    A shift by at least the number of bits gives zero, except that an arithmetic shift
    to the right gives only sign bits.
    """
    kind, flag = vector(scalar_type(node.dtype), width), vector("i1", width)
    size, op = bits(node.dtype), _SHIFTS[node.op]
    limit = splat(str(size), scalar_type(node.dtype), width)
    most = splat(str(size - 1), scalar_type(node.dtype), width)
    zero = splat("0", scalar_type(node.dtype), width)
    fits = writer.value(f"icmp ult {kind} {args[1]}, {limit}")
    by = writer.value(f"select {flag} {fits}, {kind} {args[1]}, {kind} {most}")
    out = writer.value(f"{op} {kind} {args[0]}, {by}")
    if op == "ashr":
        return out
    return writer.value(f"select {flag} {fits}, {kind} {out}, {kind} {zero}")


def _function(writer: Writer, node: Node, width: int, args: list[str]) -> str:
    kind = vector(scalar_type(node.dtype), width)
    writer.wanted[node.attr, node.dtype, width] = None
    arguments = ", ".join(f"{kind} {arg}" for arg in args)
    name = symbol(node.attr, node.dtype, width)
    return writer.value(f"call {kind} @{name}({arguments})")


_RULES: dict[str, _Rule] = {
    **{name: _arithmetic(name) for name in ("add", "sub", "mul")},
    **dict.fromkeys(("and", "or", "xor"), _bitwise),
    **dict.fromkeys(_FLOAT_COMPARISONS, _compare),
    **dict.fromkeys(_SHIFTS, _shift),
    "div": _div,
    "rem": _integer_division,
    "neg": _neg,
    "not": _not,
    "abs": _abs,
    "clz": _clz,
    "max": _extremum,
    "min": _extremum,
    "sign": _sign,
    "is_finite": _is_finite,
    "select": _select,
    "convert": _convert,
    "bitcast": _bitcast,
    "function": _function,
}
