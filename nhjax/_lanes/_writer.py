"""The text of a function of LLVM while it is written."""

from ._graph import Node
from ._types import literal, scalar_type, vector


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
