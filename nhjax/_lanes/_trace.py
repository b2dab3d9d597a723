"""The graph of a whole program, from its operands to its results."""

import math
from typing import Any, NamedTuple

import jax

from ._branches import BRANCHES
from ._buffers import Buffer, InMemory, Value
from ._builder import Builder, Operation
from ._elementwise import ELEMENTWISE
from ._gathers import GATHERS
from ._graph import dtype_name, Region
from ._indexing import INDEXING
from ._memory import LARGE, places
from ._reductions import REDUCTIONS
from ._scans import SCANS
from ._shaping import SHAPING


# A scan of at most so many rounds is unrolled.
UNROLLED = 8
# More nodes than this are refused, unless the program has a fortieth as many of JAX's
# operations: LLVM takes some 10 s for so many, and minutes for more. XLA, which has
# loops over arrays, takes a few seconds where arrays are large, but longer than LLVM
# where there are many small ones.
MOST_NODES, NODES_OF_AN_OPERATION = 100_000, 40

OPERATIONS: dict[str, Operation] = {
    **ELEMENTWISE,
    **SHAPING,
    **REDUCTIONS,
    **INDEXING,
    **GATHERS,
    **SCANS,
    **BRANCHES,
}


class Traced(NamedTuple):
    """A finished graph: its root, and the memory of the results."""

    root: Region
    results: list[Buffer]


def trace(program: Any) -> Traced:
    """Make the graph of a closed jaxpr of one member."""
    builder = Builder(OPERATIONS, UNROLLED)
    builder.graph.most_nodes = max(
        MOST_NODES, NODES_OF_AN_OPERATION * _operations(program.jaxpr)
    )
    root = builder.graph.root
    args = []
    for index, variable in enumerate(program.jaxpr.invars):
        aval = variable.aval
        dtype = dtype_name(aval.dtype)
        buffer = Buffer("operand", dtype, math.prod(aval.shape), root, index)
        array: Value = InMemory(buffer, aval.shape)
        if buffer.size <= LARGE:
            array = builder.memory.registers(array)
        args.append(array)
    values = builder.run(program.jaxpr, program.consts, args)
    results = []
    for index, (variable, value) in enumerate(
        zip(program.jaxpr.outvars, values, strict=True)
    ):
        dtype = dtype_name(variable.aval.dtype)
        buffer = Buffer("result", dtype, value.size, root, index)
        if value.size:
            builder.memory.write(buffer, places(value.shape), value)
        results.append(buffer)
    return Traced(root, results)


def _operations(jaxpr: Any) -> int:
    """Count the operations of a jaxpr and of those within."""
    count = len(jaxpr.eqns)
    for equation in jaxpr.eqns:
        if equation.primitive.name == "small_product":
            # It stands for two broadcasts, a product and a sum.
            count += 3
        for part in jax.tree.leaves(equation.params):
            part = getattr(part, "jaxpr", part)
            count += _operations(part) if hasattr(part, "eqns") else 0
    return count
