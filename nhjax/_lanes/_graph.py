"""The graph of scalar operations of one member, hash-consed, in nested regions.

A node is one number, or one statement: a store, a loop, a branch. Every node lies in a
region: the body of a loop, a side of a branch, or the root. Within a region nodes are
in the order of their numbers, which is the order in which they were made, so that a
node comes after its arguments, and a load after the stores that it has to see.

A pure node lies in the deepest region of its arguments, so that what does not change in
a loop stands before it. It never leaves the side of a branch in which it was made, as
that side may not be taken.
"""

import sys
from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np

from ._unsupported import Unsupported


DTYPES = frozenset(
    """
    bool int8 int16 int32 int64 uint8 uint16 uint32 uint64 float32 float64
    """.split()  # noqa: SIM905
)


@cache
def dtype_name(dtype: Any) -> str:
    """Return the name of a dtype that lanes can hold."""
    name = getattr(dtype, "name", None) or str(dtype)
    if name not in DTYPES:
        raise Unsupported(f"arrays of {name}")
    return name


def is_float(dtype: str) -> bool:
    """Tell whether a dtype, given by its name, is floating-point."""
    return dtype.startswith("float")


class Region:
    """A place of nodes: the root, the body of a loop, or a side of a branch."""

    __slots__ = ("depth", "floor", "loads", "owner", "parent", "spills", "table")

    def __init__(self, parent: "Region | None", owner: "Node | None", is_side: bool):
        self.parent, self.owner = parent, owner
        self.depth = 0 if parent is None else parent.depth + 1
        # The innermost side of a branch around a node, or the root. Only there are
        # tables of nodes.
        self.floor = self if is_side or parent is None else parent.floor
        self.table: dict[Any, Node] = {}
        self.loads: dict[Any, Node] = {}
        self.spills: dict[Any, Any] = {}


class Node:
    """A node of the graph: a number that is computed, or a statement.

    `attr` is what the operation needs beside its arguments: the value of a constant,
    the place of a load, the loop of a parameter. The fields from `live` on belong to
    the passes over the finished graph.
    """

    __slots__ = (
        "args",
        "attr",
        "dtype",
        "is_wide",
        "live",
        "name",
        "number",
        "op",
        "region",
        "varies",
        "wide",
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
        self.live = self.varies = self.is_wide = False
        self.name = self.wide = ""

    @property
    def is_constant(self) -> bool:
        """Tell whether the value is known while the graph is made."""
        return self.op == "const" or self.op == "zero"


class LoopInfo:
    """A loop: its parameters with their first and next values, and its predicate.

    The nodes of the region with numbers below `split` are computed before the
    predicate, the others after it, in rounds that take place.
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
    """A branch: two sides, the first for a predicate that is true, and their values."""

    __slots__ = ("outs", "predicate", "regions", "results")

    def __init__(self, predicate: Node):
        self.predicate = predicate
        self.regions: list[Region] = []
        self.outs: tuple[list[Node], list[Node]] = ([], [])
        self.results: list[Node] = []


class Simplify(Protocol):
    """A function that finds a simpler node for an operation, if there is one."""

    def __call__(
        self, graph: "Graph", op: str, args: Sequence[Node]
    ) -> Node | None: ...


class Graph:
    """All nodes, and the region in which the next ones are made."""

    def __init__(self, simplify: Simplify):
        self.simplify = simplify
        self.most_nodes = sys.maxsize
        self.root = Region(None, None, is_side=False)
        self.region = self.root
        self.count = 0
        self.constants: dict[Any, Node] = {}

    def next_number(self) -> int:
        """Return the number for the next node."""
        self.count += 1
        if self.count > self.most_nodes:
            raise Unsupported(f"more than {self.most_nodes} operations on numbers")
        return self.count

    def constant(self, value: Any, dtype: str, is_structural: bool = False) -> Node:
        """Make the node of a constant.

        Of a structural zero it is known that a product with it is zero, whatever the
        other factor: the zeros around an array that is padded, or those of tangents.
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
        """Make the node of a zero that is known while the graph is made."""
        return self.constant(0, dtype, is_structural=True)

    def pure(
        self,
        op: str,
        args: tuple[Node, ...],
        dtype: str,
        attr: Any = None,
        within: Region | None = None,
    ) -> Node:
        """Make a node without effects, or find the equal one that exists.

        It is not hoisted out of the region `within`.
        """
        key = (op, dtype, attr, *[arg.number for arg in args])
        floor: Region | None = self.region.floor
        while floor is not None:
            node = floor.table.get(key)
            if node is not None:
                return node
            floor = floor.parent.floor if floor.parent is not None else None
        home = self.home(args, within)
        node = Node(op, args, dtype, home, self.next_number(), attr)
        self.region.floor.table[key] = node
        return node

    def home(self, args: Iterable[Node], within: Region | None = None) -> Region:
        """Find the region of a pure node with these arguments."""
        home = self.region.floor
        if within is not None and within.depth > home.depth:
            home = within
        for arg in args:
            if arg.region.depth > home.depth:
                home = arg.region
        return home

    def statement(
        self, op: str, args: tuple[Node, ...], dtype: str = "", attr: Any = None
    ) -> Node:
        """Make a node that stays where it is: a statement, or what one results in."""
        return Node(op, args, dtype, self.region, self.next_number(), attr)

    def op(self, op: str, *args: Node, dtype: str | None = None) -> Node:
        """Make an elementwise operation, simplified.

        The dtype of the result is that of the last argument, if nothing else is said.
        """
        simpler = self.simplify(self, op, args)
        if simpler is not None:
            return simpler
        if op in _COMMUTATIVE and args[0].number > args[1].number:
            args = (args[1], args[0])
        if dtype is None:
            dtype = "bool" if op in COMPARISONS else args[-1].dtype
        return self.pure(op, args, dtype)

    def select(self, predicate: Node, yes: Node, no: Node) -> Node:
        """Make `yes` where the predicate holds, else `no`."""
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
_COMMUTATIVE = frozenset(("add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"))


def converted(value: Any, dtype: str) -> Any:
    """Convert a number of NumPy as XLA does: to integers it is rounded and clamped."""
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
