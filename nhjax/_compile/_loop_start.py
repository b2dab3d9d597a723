"""An operation that tells the compiler the initial carry of an interrupted loop.

A run is a loop, and some numbers in its initial carry are constants, such as the zeros
of a mass matrix. If no iteration changes such a number, it is a constant of the whole
loop, and the compiler simplifies operations with it. If the loop is interrupted and
continued from arrays, the compiler no longer knows these constants. Without this
operation, the continued loop would be slower than the original loop, and would round
differently.
"""

from typing import TypeVar

import jax
import jax.core
import jax.extend
from jax.interpreters import batching, mlir

from ..lanes import never_high


T = TypeVar("T")

loop_start = jax.extend.core.Primitive("loop_start")
loop_start.multiple_results = True
loop_start.is_high = never_high


def started_like(first: T, carry: T) -> T:
    """Return `carry`, to continue a loop whose initial carry was `first`.

    If a number in `first` is a constant of the program, and the loop does not change
    this number, the compiler uses the constant. The values in `carry` must come from
    earlier iterations of the same loop, which started from `first`.
    """
    ours, structure = jax.tree.flatten(carry)
    out = loop_start.bind(*ours, *jax.tree.leaves(first))
    return jax.tree.unflatten(structure, out)


def _carry(*operands):
    return list(operands[: len(operands) // 2])


def _batched(operands, axes):
    return _carry(*operands), _carry(*axes)


loop_start.def_impl(_carry)
loop_start.def_abstract_eval(_carry)
mlir.register_lowering(loop_start, mlir.lower_fun(_carry, multiple_results=True))
batching.primitive_batchers[loop_start] = _batched
