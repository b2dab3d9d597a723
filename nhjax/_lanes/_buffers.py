"""Arrays while a program is made: in registers, or in memory.

`hold` and `release` count who uses an array in memory.
"""

from typing import Any, TypeAlias

import numpy as np

from ._graph import Node, Region


# An array of nodes: each number has a name of its own.
Registers: TypeAlias = np.ndarray[Any, Any]


class Buffer:
    """A piece of memory that a kernel reads or writes.

    The kind is "operand", "result", "constant" or "scratch". Operands and constants are
    only read, results are only written, and scratch memory is both; `is_fixed` says
    that nothing more is stored into it.
    """

    __slots__ = (
        "dtype",
        "holders",
        "is_fixed",
        "kind",
        "live",
        "place",
        "region",
        "size",
        "stores",
        "varies",
        "version",
    )

    def __init__(self, kind: str, dtype: str, size: int, region: Region, place: Any):
        self.kind, self.dtype, self.size, self.region = kind, dtype, size, region
        # The number of the operand or result, the values of a constant, or the offset
        # in scratch memory, which is known in the end.
        self.place = place
        self.stores: list[Node] = []
        self.holders = self.version = 0
        self.is_fixed = kind in ("operand", "constant")
        self.varies = self.live = False


class InMemory:
    """An array that is the whole of a buffer, in row-major order."""

    __slots__ = ("buffer", "shape")

    def __init__(self, buffer: Buffer, shape: tuple[int, ...]):
        self.buffer, self.shape = buffer, tuple(shape)

    @property
    def size(self) -> int:
        """The number of elements."""
        return self.buffer.size

    @property
    def dtype(self) -> str:
        """The name of the dtype of the elements."""
        return self.buffer.dtype

    def reshape(self, shape: tuple[int, ...]) -> "InMemory":
        """Return the same memory in another shape."""
        return InMemory(self.buffer, shape)


Value: TypeAlias = Registers | InMemory


def hold(value: Value) -> None:
    """Keep an array in memory from being overwritten."""
    if isinstance(value, InMemory):
        value.buffer.holders += 1


def release(value: Value) -> None:
    """Allow a piece of memory that `hold` has kept to be used again."""
    if isinstance(value, InMemory):
        value.buffer.holders -= 1
