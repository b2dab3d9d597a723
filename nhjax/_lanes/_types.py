"""The types and literals of LLVM, as text."""

import struct
from typing import Any

import numpy as np

from ._graph import is_float


_TYPES = {"bool": "i1", "float32": "float", "float64": "double"}


def scalar_type(dtype: str) -> str:
    """Return the type of a number."""
    return _TYPES.get(dtype) or f"i{8 * np.dtype(dtype).itemsize}"


def memory_type(dtype: str) -> str:
    """Return the type of a number in memory, where booleans are bytes."""
    return "i8" if dtype == "bool" else scalar_type(dtype)


def vector(scalar: str, width: int) -> str:
    """Return the type of a vector; of width one, that of a number."""
    return scalar if width == 1 else f"<{width} x {scalar}>"


def suffix(dtype: str, width: int, is_memory: bool = False) -> str:
    """Return how names of intrinsics end for a type."""
    scalar = memory_type(dtype) if is_memory else scalar_type(dtype)
    scalar = {"float": "f32", "double": "f64"}.get(scalar, scalar)
    return scalar if width == 1 else f"v{width}{scalar}"


def literal(value: Any, dtype: str) -> str:
    """Write a constant as LLVM reads it."""
    if is_float(dtype):
        # LLVM writes numbers of all precisions with 64 bits.
        return f"0x{struct.unpack('<Q', struct.pack('<d', float(value)))[0]:016X}"
    if dtype == "bool":
        return "true" if value else "false"
    return str(int(value.astype(f"i{value.dtype.itemsize}")))


def is_signed(dtype: str) -> bool:
    """Tell whether a dtype is of signed integers."""
    return dtype.startswith("int")


def bits(dtype: str) -> int:
    """Return the number of bits of a number in memory."""
    return 8 * np.dtype(dtype).itemsize
