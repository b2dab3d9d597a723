"""The graph of scalar operations of one member, simplified while it is built.

A node is one number or one statement: a store, a loop or a branch. Every node lies in a
region: the root, the body of a loop, a side of a branch, or a function. Within a region
nodes are ordered by their numbers, that is, in the order of creation. A node therefore
comes after its arguments, and a load comes after the stores that it must see.

Nodes without side effects are pure. They are hash-consed: an operation with the same
arguments exists once. A pure node lies in the deepest region of its arguments, so that
invariant code is hoisted out of loops. It never leaves the side of a branch in which it
was created, because the program may take the other side.

`Graph.op` folds constants and removes operations, but never changes a result: rounding,
infinities, NaN and -0.0 are unchanged. The exception is a structural zero, such as a
zero from padding: its product with any number is zero, even with infinity and NaN.

The order of this file: the data (regions, nodes, memory), `Graph`, the rules of
simplification, the builders of loops and branches, and functions: programs that are
compiled once and called at several places.
"""

import itertools
import sys
from collections.abc import Callable, Hashable, Iterable, Sequence
from functools import cache
from typing import Any, TypeAlias, TypeVar

import numpy as np


class Unsupported(Exception):
    """This compiler cannot compile a program; the message says why."""


DTYPES = frozenset(
    """
    bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float32 float64
    """.split()  # noqa: SIM905
)


@cache
def dtype_name(dtype: Any) -> str:
    """Return the name of a dtype; raise `Unsupported` if kernels do not have it."""
    name = getattr(dtype, "name", None) or str(dtype)
    if name not in DTYPES:
        raise Unsupported(f"arrays of {name}")
    return name


def is_float(dtype: str) -> bool:
    """Return whether a dtype is floating-point."""
    return dtype.startswith("float")


class Region:
    """A part of the graph: the root, a loop's body, a branch's side or a function."""

    __slots__ = ("depth", "floor", "loads", "owner", "parent", "spills", "table")

    def __init__(self, parent: "Region | None", owner: "Node | None", is_side: bool):
        self.parent, self.owner = parent, owner
        self.depth = 0 if parent is None else parent.depth + 1
        # The innermost side of a branch around this region, or else the root or the
        # function. Only these regions have tables of pure nodes.
        self.floor = self if is_side or parent is None else parent.floor
        self.table: dict[Any, Node] = {}
        self.loads: dict[Any, Node] = {}
        self.spills: dict[Any, Any] = {}


class Node:
    """A node of the graph: a number that is computed, or a statement.

    `attr` is the data of the operation besides its arguments, for example the value of
    a constant, the address of a load, or the loop of a parameter. The passes over the
    finished graph record in the node whether it is needed (`is_live`), whether it
    differs between members (`is_divergent`), whether a uniform value is needed as a
    vector too (`is_broadcast`), and the names in LLVM IR.
    """

    __slots__ = (
        "args",
        "attr",
        "dtype",
        "is_broadcast",
        "is_divergent",
        "is_live",
        "name",
        "number",
        "op",
        "region",
        "vector_name",
    )

    def __init__(
        self,
        op: str,
        args: "tuple[Node, ...]",
        dtype: str,
        region: Region,
        number: int,
        attr: Any = None,
    ):
        self.op, self.args, self.dtype = op, args, dtype
        self.region, self.number, self.attr = region, number, attr
        self.is_live = self.is_divergent = self.is_broadcast = False
        self.name = self.vector_name = ""

    @property
    def is_constant(self) -> bool:
        """Whether the value is known while the graph is built."""
        return self.op == "const" or self.op == "zero"


class LoopInfo:
    """A loop: its parameters with their first and next values, and its predicate.

    Nodes of the region with numbers below `split` are computed before the predicate.
    The other nodes are computed after the predicate if it is true.
    """

    __slots__ = ("inits", "outs", "params", "predicate", "region", "results", "split")

    def __init__(self, region: Region):
        self.region = region
        self.params: list[Node] = []
        self.inits: list[Node] = []
        self.outs: list[Node] = []
        self.results: list[Node] = []
        self.predicate: Node
        self.split = 0


class BranchInfo:
    """A branch: its two sides, the first for a true predicate, and their results."""

    __slots__ = ("outs", "predicate", "regions", "results")

    def __init__(self, predicate: Node):
        self.predicate = predicate
        self.regions: list[Region] = []
        self.outs: tuple[list[Node], list[Node]] = ([], [])
        self.results: list[Node] = []


class Graph:
    """All nodes, and the region in which new nodes are created."""

    def __init__(self):
        self.most_nodes = sys.maxsize
        self.root = Region(None, None, is_side=False)
        self.region = self.root
        self.count = 0
        self.constants: dict[Any, Node] = {}

    def next_number(self) -> int:
        """Return the number for the next node."""
        self.count += 1
        if self.count > self.most_nodes:
            self.refuse()
        return self.count

    def refuse(self) -> None:
        """Raise the error for too many nodes."""
        raise Unsupported(f"more than {self.most_nodes} operations on numbers")

    def constant(self, value: Any, dtype: str, is_structural: bool = False) -> Node:
        """Return the node of a constant.

        A product with a structural zero is zero for every value of the other factor.
        Structural zeros come from padding, from arrays filled with zero, and from JAX's
        symbolic zero tangents.
        """
        value = np.dtype(dtype).type(value)
        op = "zero" if is_structural else "const"
        key = (op, dtype, value.tobytes())
        node = self.constants.get(key)
        if node is None:
            node = Node(op, (), dtype, self.root, self.next_number(), value)
            self.constants[key] = node
        return node

    def zero(self, dtype: str) -> Node:
        """Return the node of a structural zero."""
        return self.constant(0, dtype, is_structural=True)

    def folded(self, op: str, nodes: Iterable[Node]) -> Node | None:
        """Combine nodes by `op`, one after the other; return `None` for no nodes."""
        total = None
        for node in nodes:
            total = node if total is None else self.op(op, total, node)
        return total

    def pure(
        self,
        op: str,
        args: tuple[Node, ...],
        dtype: str,
        attr: Any = None,
        within: Region | None = None,
    ) -> Node:
        """Create a node without effects, or return the equal node that exists.

        The node is not hoisted out of the region `within`.
        """
        # This is the inner loop of the compiler: nodes are compared by identity, and
        # `next_number` and `home` are inlined.
        key = (op, dtype, attr, *args)
        region = self.region.floor
        floor: Region | None = region
        while floor is not None:
            node = floor.table.get(key)
            if node is not None:
                return node
            floor = floor.parent.floor if floor.parent is not None else None
        home = region
        if within is not None and within.depth > home.depth:
            home = within
        for arg in args:
            if arg.region.depth > home.depth:
                home = arg.region
        self.count = number = self.count + 1
        if number > self.most_nodes:
            self.refuse()
        region.table[key] = node = Node(op, args, dtype, home, number, attr)
        return node

    def home(self, args: Iterable[Node]) -> Region:
        """Return the region in which a pure node with these arguments lies."""
        home = self.region.floor
        for arg in args:
            if arg.region.depth > home.depth:
                home = arg.region
        return home

    def statement(
        self, op: str, args: tuple[Node, ...], dtype: str = "", attr: Any = None
    ) -> Node:
        """Create a node that is not hoisted: a statement, or a statement's result."""
        return Node(op, args, dtype, self.region, self.next_number(), attr)

    def op(self, op: str, *args: Node, dtype: str | None = None) -> Node:
        """Return the node of an elementwise operation, simplified if possible.

        If `dtype` is not given, comparisons return bool, and other operations return
        the dtype of the last argument.
        """
        first, last = args[0], args[-1]
        rule = _RULES.get(op)
        if rule is not None:
            simpler = rule(self, *args) if op == "select" else rule(self, first, last)
            if simpler is not None:
                return simpler
        if first.op in _KNOWN:
            simpler = _folded(self, op, args)
            if simpler is not None:
                return simpler
        if op in COMMUTATIVE and first.number > last.number:
            args = (last, first)
            last = first
        if dtype is None:
            dtype = "bool" if op in COMPARISONS else last.dtype
        return self.pure(op, args, dtype)

    def select(self, predicate: Node, yes: Node, no: Node) -> Node:
        """Return `yes` where the predicate holds, otherwise `no`."""
        return self.op("select", predicate, yes, no)

    def convert(self, node: Node, dtype: str) -> Node:
        """Convert a number to another dtype."""
        if node.dtype == dtype:
            return node
        if node.op == "zero":
            return self.zero(dtype)
        if node.op == "const":
            return self.constant(converted(node.attr, dtype), dtype)
        if dtype == "bool":
            return self.op("ne", node, self.constant(0, node.dtype))
        return self.pure("convert", (node,), dtype)


COMPARISONS = frozenset(("eq", "ne", "lt", "le", "gt", "ge", "is_finite"))
COMMUTATIVE = frozenset(("add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"))


def converted(value: Any, dtype: str) -> Any:
    """Convert a NumPy number as XLA does: truncate and clamp floats to integers."""
    kind = np.dtype(dtype).kind
    if kind in "iu" and value.dtype.kind == "f":
        if np.isnan(value):
            return np.dtype(dtype).type(0)
        limits = np.iinfo(dtype)
        if np.isinf(value):
            return np.dtype(dtype).type(limits.max if value > 0 else limits.min)
        return np.dtype(dtype).type(min(max(int(value), limits.min), limits.max))
    with np.errstate(all="ignore"):
        return value.astype(dtype)


class Buffer:
    """A piece of memory that a kernel reads or writes.

    `kind` is "operand", "result", "constant" or "scratch". Operands and constants are
    only read, results are only written, scratch memory is read and written. `is_fixed`
    means that no more stores follow.
    """

    __slots__ = (
        "dtype",
        "holders",
        "is_divergent",
        "is_fixed",
        "is_live",
        "kind",
        "place",
        "region",
        "size",
        "stores",
        "version",
    )

    def __init__(self, kind: str, dtype: str, size: int, region: Region, place: Any):
        self.kind, self.dtype, self.size, self.region = kind, dtype, size, region
        # The index of the operand or result, or the values of a constant.
        self.place = place
        self.stores: list[Node] = []
        self.holders = self.version = 0
        self.is_fixed = kind in ("operand", "constant")
        self.is_divergent = self.is_live = False


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


# The functions that fold constants. They return the same results as compiled code.
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

_Rule = Callable[..., Node | None]


# `_KNOWN`: the `op` of nodes whose value is known. `_SPECIAL`: the `op` of arguments
# that the rules for sums and products can simplify. Most nodes have another `op`.
# Therefore the rules test this first.
_KNOWN = frozenset(("const", "zero"))
_SPECIAL = frozenset((*_KNOWN, "neg"))


def _folded(graph: Graph, op: str, args: Sequence[Node]) -> Node | None:
    """Return the constant result of an operation, or `None` if it is not known."""
    fold = _FOLDS.get(op)
    if fold is None:
        return None
    for arg in args:
        if arg.op not in _KNOWN:
            return None
    with np.errstate(all="ignore"):
        value = fold(*[arg.attr for arg in args])
    return graph.constant(value, "bool" if op in COMPARISONS else args[0].dtype)


def _is(node: Node, value: float) -> bool:
    return node.op == "const" and bool(node.attr == value)


def _is_no_summand(node: Node) -> bool:
    """Return whether adding a number is a no-op; adding +0.0 changes -0.0."""
    if node.op == "zero":
        return True
    if node.op != "const" or node.attr != 0:
        return False
    return not is_float(node.dtype) or bool(np.signbit(node.attr))


def _add(graph: Graph, a: Node, b: Node) -> Node | None:
    if a.op not in _SPECIAL and b.op not in _SPECIAL:
        return None
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
    if a.op not in _SPECIAL and b.op not in _SPECIAL:
        return None
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
        # For a power of two, the product with its reciprocal is exactly the quotient.
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
            # JAX converts a predicate to the index of a branch, which is then compared.
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
    "select": _select,
    **{op: _compare(op) for op in ("eq", "ne", "lt", "le", "gt", "ge")},
}


T = TypeVar("T")


class LoopBuilder:
    """A loop whose body is created inside a `with` statement."""

    def __init__(self, graph: Graph):
        self.graph = graph
        self.node = Node("loop", (), "", graph.region, 0)
        self.info = LoopInfo(Region(graph.region, self.node, is_side=False))
        self.node.attr = self.info

    def __enter__(self) -> "LoopBuilder":
        self.graph.region = self.info.region
        return self

    def __exit__(self, *_: object) -> None:
        self.graph.region = self.node.region
        # Hoisted nodes have to come before the loop.
        self.node.number = self.graph.next_number()

    def parameter(self, init: Node) -> Node:
        """Create a number that starts as `init` and may change in each iteration."""
        info = self.info
        place = (self.node, len(info.params))
        node = self.graph.statement("param", (), init.dtype, place)
        info.params.append(node)
        info.inits.append(init)
        return node

    def goes_on_while(self, predicate: Node) -> None:
        """Set the predicate; later nodes run only in iterations where it is true."""
        self.info.predicate = predicate
        self.info.split = self.graph.next_number()

    def end(self, outs: Sequence[Node]) -> None:
        """Set the next values of the parameters."""
        self.info.outs = list(outs)

    def results(self) -> list[Node]:
        """Return the nodes of the parameters' values after the loop."""
        info, out = self.info, []
        for index, (param, init, after) in enumerate(
            zip(info.params, info.inits, info.outs, strict=True)
        ):
            # A parameter that the body returns unchanged has its first value at the
            # end too.
            if after is param:
                out.append(init)
            else:
                place = (self.node, index)
                result = self.graph.statement("result", (), init.dtype, place)
                info.results.append(result)
                out.append(result)
        return out


def counted_loop(graph: Graph, length: int, body: Callable[[Node], None]) -> None:
    """Create a loop over a counter from 0 to `length` - 1 whose body only stores."""
    if length == 0:
        return
    with LoopBuilder(graph) as loop:
        k = loop.parameter(graph.constant(0, "int64"))
        loop.goes_on_while(graph.op("lt", k, graph.constant(length, "int64")))
        body(k)
        loop.end([graph.op("add", k, graph.constant(1, "int64"))])


class BranchBuilder:
    """A branch; its two sides are created one after the other."""

    def __init__(self, graph: Graph, predicate: Node):
        self.graph = graph
        self.node = Node("branch", (), "", graph.region, 0)
        self.info = BranchInfo(predicate)
        self.info.regions = [Region(graph.region, self.node, True) for _ in range(2)]
        self.node.attr = self.info

    def on_side(self, side: int, function: Callable[[], T]) -> T:
        """Call a function whose nodes go into one of the sides."""
        self.graph.region = self.info.regions[side]
        try:
            return function()
        finally:
            self.graph.region = self.node.region

    def close(self, yes: list[Node], no: list[Node]) -> list[Node]:
        """End the branch; return its results, which are numbers of the side taken."""
        graph, info = self.graph, self.info
        info.outs = (yes, no)
        self.node.number = graph.next_number()
        info.results = [
            graph.statement("result", (), node.dtype, (self.node, index))
            for index, node in enumerate(yes)
        ]
        return info.results


# Functions

# A run uses each function of a system, and its derivatives, at ten or more places. If
# kernels could not call functions, LLVM would compile a copy at each of these places. A
# program becomes a function if it is long and consists only of arithmetic. Operands
# that are constants are part of the function, so that zeros and ones are simplified as
# in a copy.
#
# A copy shares its common subexpressions with its surroundings, and its invariant
# operations are hoisted out of loops. Therefore programs inside a loop are still copied
# (written out), unless this loop contains another loop of unknown length. For example,
# the loop over the steps of a run contains such a loop, the iterations of the stage
# solver.
#
# A function is a region of its own, in which `parameter` nodes stand for the arguments.
# A node `call` stands for all results, and a node `part` for one of them. Both are
# pure, so that calls with equal arguments are merged, and calls without users are
# removed.

# Programs with fewer nodes than this are written out, because a function would save too
# little compile time.
_SHORTEST = 500
# A function with constants is replaced by a more general function if the constants save
# at most this fraction of the nodes.
_LEAST_GAIN = 0.1
# A function contains none of these nodes, which access memory, jump or call.
_STATEMENTS = frozenset(
    ("load", "store", "loop", "branch", "param", "result", "call", "part")
)

# The numbers in the operands of a program, with `None` for each non-constant number.
_Pattern: TypeAlias = tuple[Node | None, ...]


class Function:
    """A program in a region of its own.

    - `parameters`: the nodes that stand for the arguments of a call.
    - `outs`: the results.
    - `nodes`: the nodes that compute the results, in order.
    - `general`: `None`, or the more general function that is called instead, with its
        arguments: constants, and indices of arguments of this function.
    """

    __slots__ = ("general", "nodes", "outs", "parameters")

    def __init__(self, parameters: list[Node], outs: list[Node]):
        self.parameters, self.outs = parameters, outs
        self.nodes = needed(outs)
        self.general: tuple[Function, list[Node | int]] | None = None

    @property
    def is_shared(self) -> bool:
        """Whether the function is long, and computes only with numbers."""
        is_pure = all(node.op not in _STATEMENTS for node in self.nodes)
        return is_pure and len(self.nodes) >= _SHORTEST

    def structure(self) -> Hashable:
        """Return a key; functions with equal keys compute the same results."""
        places = {node: k for k, node in enumerate(self.parameters)}

        def place(node: Node) -> int:
            # Functions share the nodes of constants. The numbers of nodes are positive,
            # so that negative places stand for constants.
            return -node.number if node.is_constant else places[node]

        lines: list[Hashable] = []
        for node in self.nodes:
            if node.op != "parameter":
                args = list(map(place, node.args))
                if node.op in COMMUTATIVE:
                    args.sort()
                lines.append((node.op, node.dtype, node.attr, *args))
                places[node] = len(places)
        kinds = [node.dtype for node in self.parameters]
        return (*kinds, *lines, *map(place, self.outs))


class Functions:
    """The functions of a kernel."""

    def __init__(self):
        # For each program, a dictionary from its constant operands to the function that
        # is called with them, or to `None` if the program is written out.
        self._found: dict[Any, dict[_Pattern, Function | None]] = {}
        self._by_structure: dict[Hashable, Function] = {}

    def of(
        self, program: Any, numbers: list[Node], build: Callable[[], Function | None]
    ) -> Function | None:
        """Return the function of a program, or `None` if it is to be written out."""
        pattern = tuple(node if node.is_constant else None for node in numbers)
        variants = self._found.setdefault(program, {})
        if pattern not in variants:
            made = build()
            if made is not None and made.is_shared:
                made = self._by_structure.setdefault(made.structure(), made)
                for other, function in variants.items():
                    if function is not None and function is not made:
                        _unify(made, pattern, function, other)
                        _unify(function, other, made, pattern)
            else:
                made = None
            variants[pattern] = made
        return variants[pattern]


def _unify(one: Function, own: _Pattern, general: Function, wider: _Pattern) -> None:
    """Let `one` call `general`, if the longer code of `general` costs little.

    All constants of `general` must be constants of `one` too, and `general` must not be
    much longer.
    """
    pairs = list(zip(own, wider, strict=True))
    is_wider = all(b is None or a is b for a, b in pairs)
    is_short = len(one.nodes) >= (1 - _LEAST_GAIN) * len(general.nodes)
    if is_wider and is_short and one.general is None:
        indices = itertools.count()
        given = [next(indices) if a is None else a for a in own]
        kept = [x for x, b in zip(given, wider, strict=True) if b is None]
        one.general = general, kept


def needed(outs: Sequence[Node]) -> list[Node]:
    """List `outs` and all nodes that they depend on, in order, without constants."""
    found, waiting = set(), list(outs)
    while waiting:
        node = waiting.pop()
        if node not in found and not node.is_constant:
            found.add(node)
            waiting.extend(node.args)
    return sorted(found, key=lambda node: node.number)


def parameters_for(
    graph: Graph, region: Region, values: Sequence[np.ndarray]
) -> tuple[list[np.ndarray], list[Node]]:
    """Replace non-constant numbers by parameters; return arrays and parameters."""
    arrays, parameters = [], []
    for value in values:
        array = np.empty(value.size, object)
        for index, node in enumerate(value.reshape(-1)):
            if node.is_constant:
                array[index] = node
            else:
                number = graph.next_number()
                made = Node("parameter", (), node.dtype, region, number)
                array[index] = made
                parameters.append(made)
        arrays.append(array.reshape(value.shape))
    return arrays, parameters


def call(graph: Graph, function: Function, args: Sequence[Node]) -> list[Node]:
    """Create a call of a function, and return its results."""
    node = graph.pure("call", tuple(args), "struct", function)
    return [
        out if out.is_constant else graph.pure("part", (node,), out.dtype, index)
        for index, out in enumerate(function.outs)
    ]
