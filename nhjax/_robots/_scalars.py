"""Vectors and matrices as lists of scalars, without terms that are known to be zero.

Most numbers in the frames of a robot are 0, 1 or -1. Products with these numbers are
left out while a function is traced, so that the program of a small robot is as short as
a program written by hand. An entry is a Python float if it is known, and a traced
scalar otherwise.
"""

from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array


Entry: TypeAlias = Any
Vector: TypeAlias = list[Entry]
Matrix: TypeAlias = list[Vector]

# Due to round-off, a rotation by a right angle has entries below this size, not zeros.
_NOISE = 1e-15


def known(values: Any) -> Any:
    """Convert constants to nested lists, and remove round-off around 0, 1 and -1."""
    array = np.array(values, float)
    nearest = np.rint(array)
    is_near = (np.abs(array - nearest) < _NOISE) & (np.abs(nearest) <= 1)
    return np.where(is_near, nearest, array).tolist()


def add(a: Entry, b: Entry) -> Entry:
    """Compute a + b."""
    if isinstance(a, float) and a == 0:
        return b
    if isinstance(b, float) and b == 0:
        return a
    return _combined(jax.lax.add, a, b)


def times(a: Entry, b: Entry) -> Entry:
    """Compute a b."""
    for x, y in ((a, b), (b, a)):
        if isinstance(x, float):
            if x == 0:
                return 0.0
            if x in (1.0, -1.0):
                return y if x == 1 else -y
    return _combined(jax.lax.mul, a, b)


def _combined(operation: Any, a: Entry, b: Entry) -> Entry:
    """Add or multiply two entries by `jax.lax`, whose operations trace fastest."""
    if isinstance(a, float) and isinstance(b, float):
        return a + b if operation is jax.lax.add else a * b
    return operation(a, b)


def total(terms: Iterable[Entry]) -> Entry:
    """Compute the sum of the terms."""
    result: Entry = 0.0
    for term in terms:
        result = add(result, term)
    return result


def dot(a: Sequence[Entry], b: Sequence[Entry]) -> Entry:
    """Compute a · b."""
    return total(times(x, y) for x, y in zip(a, b, strict=True))


def sums(a: Vector, b: Vector) -> Vector:
    """Compute the vector a + b."""
    return [add(x, y) for x, y in zip(a, b, strict=True)]


def apply(matrix: Matrix, vector: Vector) -> Vector:
    """Compute the product of a matrix and a vector."""
    return [dot(row, vector) for row in matrix]


def transposed(matrix: Matrix) -> Matrix:
    """Return the transposed matrix."""
    return [list(column) for column in zip(*matrix, strict=True)]


def product(a: Matrix, b: Matrix) -> Matrix:
    """Compute the product of two matrices."""
    columns = transposed(b)
    return [[dot(row, column) for column in columns] for row in a]


def cross(a: Vector, b: Vector) -> Vector:
    """Compute a × b."""
    return [
        add(times(a[i], b[j]), times(-1.0, times(a[j], b[i])))
        for i, j in ((1, 2), (2, 0), (0, 1))
    ]


def stacked(values: Any, dtype: Any) -> Array:
    """Convert nested lists to an array."""
    flat, shape = values, []
    while isinstance(flat, list):
        shape.append(len(flat))
        flat = flat[0]
    entries = values
    for _ in shape[1:]:
        entries = [x for row in entries for x in row]
    return jnp.stack([jnp.asarray(x, dtype) for x in entries]).reshape(shape)
