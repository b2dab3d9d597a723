"""Branches, and the programs that stand in an equation."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from ._buffers import InMemory, Value
from ._builder import Builder, Operation
from ._graph import dtype_name, Node
from ._memory import LARGE, places
from ._regions import BranchBuilder


def _call(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    params = equation.params
    keys = ("jaxpr", "call_jaxpr", "program", "fun_jaxpr")
    inner = next(params[key] for key in keys if key in params)
    jaxpr = getattr(inner, "jaxpr", inner)
    return builder.run(jaxpr, getattr(inner, "consts", ()), values)


def _linear_solve(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    lengths, jaxprs = equation.params["const_lengths"], equation.params["jaxprs"]
    start = lengths.matvec + lengths.vecmat
    consts = values[start : start + lengths.solve]
    rest = values[start + lengths.solve + lengths.transpose_solve :]
    return builder.run(jaxprs.solve.jaxpr, jaxprs.solve.consts, [*consts, *rest])


def _cond(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    which, *args = values
    branches = equation.params["branches"]
    index = builder.memory.registers(which).reshape(-1)[0]
    avals = [variable.aval for variable in equation.outvars]
    runs = [
        partial(builder.run, branch.jaxpr, branch.consts, args) for branch in branches
    ]
    return _chosen(builder, index, runs, 0, avals)


def _chosen(
    builder: Builder,
    index: Node,
    runs: list[Callable[[], list[Value]]],
    first: int,
    avals: list[Any],
) -> list[Value]:
    """Take the program that the index says; the last one for all larger indices."""
    if first == len(runs) - 1:
        return runs[first]()
    graph = builder.graph
    if index.dtype == "bool":
        is_first = graph.op("not", index)
    else:
        is_first = graph.op("le", index, graph.constant(first, index.dtype))

    def rest() -> list[Value]:
        return _chosen(builder, index, runs, first + 1, avals)

    return _branch(builder, is_first, runs[first], rest, avals)


def _branch(
    builder: Builder,
    predicate: Node,
    yes: Callable[[], list[Value]],
    no: Callable[[], list[Value]],
    avals: list[Any],
) -> list[Value]:
    """Make a branch; only the side that is taken runs."""
    if predicate.is_constant:
        return yes() if predicate.attr else no()
    memory = builder.memory
    branch = BranchBuilder(builder.graph, predicate)
    outs = []
    for side, run in enumerate((yes, no)):
        builder.path.append(side)
        outs.append(branch.on_side(side, run))
        builder.path.pop()
    results: list[Value | None] = []
    numbers: tuple[list[Node], list[Node]] = ([], [])
    for aval, one, other in zip(avals, *outs, strict=True):
        pair = (one, other)
        shared = _shared(one, other)
        if shared is None and _goes_to_memory(one, other):
            # Neither side may have changed what the other hands on.
            target = memory.new(dtype_name(aval.dtype), one.size)
            shared = InMemory(target, aval.shape)
            for side, value in enumerate(pair):
                branch.on_side(
                    side,
                    partial(_write, builder, target, value),
                )
        results.append(shared)
        if shared is None:
            for side, value in enumerate(pair):
                load = partial(memory.registers, value)
                numbers[side].extend(branch.on_side(side, load).reshape(-1))  # pyright: ignore
    nodes = iter(branch.close(*numbers))
    return [
        _taken(nodes, aval) if result is None else result
        for aval, result in zip(avals, results, strict=True)
    ]


def _write(builder: Builder, target: Any, value: Value) -> list:
    builder.memory.write(target, places(value.shape), value)
    return []


def _shared(one: Value, other: Value) -> Value | None:
    """Find the array that both sides result in, if it is the same memory."""
    if isinstance(one, InMemory) and isinstance(other, InMemory):
        return one if one.buffer is other.buffer else None
    if isinstance(one, InMemory) or isinstance(other, InMemory):
        return None
    pairs = zip(one.reshape(-1), other.reshape(-1), strict=True)
    return one if one.size and all(a is b for a, b in pairs) else None


def _goes_to_memory(one: Value, other: Value) -> bool:
    there = [isinstance(value, InMemory) for value in (one, other)]
    return all(there) or (any(there) and one.size > LARGE)


def _taken(nodes: Any, aval: Any) -> np.ndarray:
    out = np.empty(int(np.prod(aval.shape)), object)
    for index in range(out.size):
        out[index] = next(nodes)
    return out.reshape(aval.shape)


def _expanded(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    """Run the program of an operation that JAX writes out when it compiles."""
    expand = partial(equation.primitive.to_lojax, **equation.params)
    avals = [variable.aval for variable in equation.invars]
    args = [
        jax.ShapeDtypeStruct(a.shape, a.dtype, weak_type=a.weak_type) for a in avals
    ]
    program = jax.make_jaxpr(expand)(*args)
    return builder.run(program.jaxpr, program.consts, values)


_CALLS = """
    checkpoint closed_call core_call custom_jvp_call custom_vjp_call
    custom_vjp_call_jaxpr jit cpu_kernel pjit remat remat2
""".split()  # noqa: SIM905
BRANCHES: dict[str, Operation] = {
    **dict.fromkeys(_CALLS, _call),
    "call_hi_primitive": _expanded,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
}
