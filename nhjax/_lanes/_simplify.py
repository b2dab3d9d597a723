"""Simplifications of scalar operations that never change a result.

What is rounded, infinite, NaN or -0.0 stays so. Only a zero that is structural makes a
product zero whatever the other factor.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ._graph import COMPARISONS, Graph, is_float, Node


def _quotient(a: Any, b: Any) -> Any:
    if a.dtype.kind == "f":
        return a / b
    if b == 0:
        return -1 if a.dtype.kind == "i" else np.iinfo(a.dtype).max
    size = abs(int(a)) // abs(int(b))
    return _wrapped(size if (a < 0) == (b < 0) else -size, a.dtype)


def _remainder(a: Any, b: Any) -> Any:
    return a if a.dtype.kind != "f" and b == 0 else np.fmod(a, b)


def _wrapped(value: int, dtype: np.dtype) -> Any:
    return np.array(value % 2 ** (8 * dtype.itemsize), f"u{dtype.itemsize}").view(dtype)


def _round_away(a: Any) -> Any:
    whole = np.trunc(a)
    return whole + np.copysign(np.where(np.abs(a - whole) >= 0.5, 1, 0), a)


# What NumPy computes from constants, just as the compiled program would.
_FOLDS: dict[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": _quotient,
    "rem": _remainder,
    "neg": np.negative,
    "abs": np.abs,
    "max": np.maximum,
    "min": np.minimum,
    "sign": np.sign,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "round_even": np.rint,
    "round_away": _round_away,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "not": np.bitwise_not,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "is_finite": np.isfinite,
}

_Rule = Callable[[Graph, Any, Any], Node | None]


def simplify(graph: Graph, op: str, args: Sequence[Node]) -> Node | None:
    """Find a simpler node for an operation, if there is one."""
    if op == "select":
        return _select(graph, *args)
    rule = _RULES.get(op)
    if rule is not None:
        first = args[0]
        simpler = rule(graph, first, args[1] if len(args) > 1 else first)
        if simpler is not None:
            return simpler
    fold = _FOLDS.get(op)
    if fold is None:
        return None
    for arg in args:
        if arg.op != "const" and arg.op != "zero":
            return None
    with np.errstate(all="ignore"):
        value = fold(*[arg.attr for arg in args])
    return graph.constant(value, "bool" if op in COMPARISONS else args[0].dtype)


def _is(node: Node, value: float) -> bool:
    return node.op == "const" and bool(node.attr == value)


def _is_no_summand(node: Node) -> bool:
    """Tell whether adding a number changes nothing; +0.0 changes -0.0."""
    if node.op == "zero":
        return True
    if node.op != "const" or node.attr != 0:
        return False
    return not is_float(node.dtype) or bool(np.signbit(node.attr))


def _add(graph: Graph, a: Node, b: Node) -> Node | None:
    if _is_no_summand(a):
        return b
    if _is_no_summand(b):
        return a
    if b.op == "neg":
        return graph.op("sub", a, b.args[0])
    if a.op == "neg":
        return graph.op("sub", b, a.args[0])
    return None


def _sub(graph: Graph, a: Node, b: Node) -> Node | None:
    if b.op == "zero" or (_is(b, 0) and not _is_no_summand(b)):
        return a
    if not is_float(a.dtype) and (_is(b, 0) or a is b):
        return a if a is not b else graph.constant(0, a.dtype)
    if a.op == "zero":
        return graph.op("neg", b)
    if b.op == "neg":
        return graph.op("add", a, b.args[0])
    return None


def _mul(graph: Graph, a: Node, b: Node) -> Node | None:
    for x, y in ((a, b), (b, a)):
        if x.op == "zero" or (_is(x, 0) and not is_float(x.dtype)):
            return x
        if _is(x, 1):
            return y
        if _is(x, -1) and x.dtype[0] != "u":
            return graph.op("neg", y)
    if a.op == "neg" and b.op == "neg":
        return graph.op("mul", a.args[0], b.args[0])
    return None


def _div(graph: Graph, a: Node, b: Node) -> Node | None:
    if _is(b, 1):
        return a
    if not is_float(a.dtype):
        return None
    if a.op == "zero" and b.op != "zero":
        return a
    if b.op == "const" and not a.is_constant and np.isfinite(b.attr):
        # The product with the reciprocal of a power of two is exact.
        exponent = np.frexp(b.attr)[1]
        if abs(np.frexp(b.attr)[0]) == 0.5 and abs(exponent) < 120:
            return graph.op("mul", a, graph.constant(1 / b.attr, b.dtype))
    return None


def _neg(graph: Graph, a: Node, _: Node) -> Node | None:
    if a.op == "neg":
        return a.args[0]
    return a if a.op == "zero" else None


def _abs(graph: Graph, a: Node, _: Node) -> Node | None:
    if a.op == "abs" or a.dtype[0] == "u":
        return a
    if a.op == "neg":
        return graph.op("abs", a.args[0])
    return None


def _extremum(graph: Graph, a: Node, b: Node) -> Node | None:
    return a if a is b else None


def _and(graph: Graph, a: Node, b: Node) -> Node | None:
    for x, y in ((a, b), (b, a)):
        if x.is_constant and not x.attr:
            return x
        if x.is_constant and x.attr == _ones(x.dtype):
            return y
    return a if a is b else None


def _or(graph: Graph, a: Node, b: Node) -> Node | None:
    for x, y in ((a, b), (b, a)):
        if x.is_constant and not x.attr:
            return y
        if x.is_constant and x.attr == _ones(x.dtype):
            return x
    return a if a is b else None


def _ones(dtype: str) -> Any:
    return dtype == "bool" or np.invert(np.dtype(dtype).type(0))


_OPPOSITE = {"eq": "ne", "ne": "eq"}


def _not(graph: Graph, a: Node, _: Node) -> Node | None:
    if a.op == "not":
        return a.args[0]
    if a.op in _OPPOSITE:
        return graph.op(_OPPOSITE[a.op], *a.args)
    return None


def _compare(op: str) -> _Rule:
    fold, of_equals = _FOLDS[op], op in ("eq", "le", "ge")

    def rule(graph: Graph, a: Node, b: Node) -> Node | None:
        if a is b and not is_float(a.dtype):
            return graph.constant(of_equals, "bool")
        if a.op == "convert" and a.args[0].dtype == "bool" and b.is_constant:
            # The index of a branch is made from a predicate, and compared again.
            one = np.dtype(a.dtype).type(1)
            at_no, at_yes = bool(fold(one - one, b.attr)), bool(fold(one, b.attr))
            if at_no == at_yes:
                return graph.constant(at_no, "bool")
            return a.args[0] if at_yes else graph.op("not", a.args[0])
        if a.dtype == "bool" and b.is_constant and op in ("eq", "ne"):
            return a if bool(b.attr) == (op == "eq") else graph.op("not", a)
        return None

    return rule


def _select(graph: Graph, predicate: Node, yes: Node, no: Node) -> Node | None:
    if predicate.is_constant:
        return yes if predicate.attr else no
    if yes is no:
        return yes
    if predicate.op == "not":
        return graph.op("select", predicate.args[0], no, yes)
    if yes.dtype == "bool":
        if yes.is_constant:
            rest = predicate if yes.attr else graph.op("not", predicate)
            return graph.op("or" if yes.attr else "and", rest, no)
        if no.is_constant:
            rest = graph.op("not", predicate) if no.attr else predicate
            return graph.op("or" if no.attr else "and", rest, yes)
    return None


_RULES: dict[str, _Rule] = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "abs": _abs,
    "max": _extremum,
    "min": _extremum,
    "and": _and,
    "or": _or,
    "not": _not,
    **{op: _compare(op) for op in ("eq", "ne", "lt", "le", "gt", "ge")},
}
