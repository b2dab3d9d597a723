"""The primitives `while` and `scan`; a short scan is unrolled."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ._buffers import hold, InMemory, release, Value
from ._builder import Builder, Operation
from ._graph import dtype_name, Node
from ._loops import loop
from ._memory import LARGE, places
from ._updated import inner_programs, updated


def _while(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    params = equation.params
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    first, second = params["cond_nconsts"], params["body_nconsts"]
    of_test, of_body = values[:first], values[first : first + second]
    inits = values[first + second :]
    variables = body.jaxpr.invars[second:]
    # What the body hands on as it is does not go around.
    is_same = [a is b for a, b in zip(variables, body.jaxpr.outvars, strict=True)]
    same, _ = _split(is_same, inits)
    stored = {index - second for index in updated(body.jaxpr)}
    goes_to_memory = [
        value.size > 0 and (value.size > LARGE or index in stored)
        for index, value in enumerate(inits)
    ]

    def everything(carry: list[Value]) -> list[Value]:
        return _merged(is_same, same, carry)

    def predicate(carry: list[Value]) -> Node:
        args = [*of_test, *everything(carry)]
        return builder.run(test.jaxpr, test.consts, args)[0].reshape(-1)[0]  # pyright: ignore

    def step(carry: list[Value]) -> list[Value]:
        args = [*of_body, *everything(carry)]
        return _split(is_same, builder.run(body.jaxpr, body.consts, args))[1]

    with builder.held([*of_test, *of_body, *same]):
        moving, _ = _split([not s for s in is_same], inits)
        flags, _ = _split([not s for s in is_same], goes_to_memory)
        return everything(loop(builder, moving, flags, predicate, step))


def _split(marks: Sequence[bool], values: Sequence) -> tuple[list, list]:
    pairs = list(zip(marks, values, strict=True))
    return [x for mark, x in pairs if mark], [x for mark, x in pairs if not mark]


def _merged(marks: Sequence[bool], marked: Sequence, others: Sequence) -> list:
    one, other = iter(marked), iter(others)
    return [next(one) if mark else next(other) for mark in marks]


def _scan(builder: Builder, equation: Any, values: list[Value]) -> list[Value]:
    params, length = equation.params, equation.params["length"]
    first, count = _sizes(params)
    consts, carry = values[:first], values[first : first + count]
    rows = values[first + count :]
    with builder.held([*consts, *rows]):
        is_short = length <= 1 or (
            length <= builder.unroll and not _has_loop(params["jaxpr"].jaxpr, builder)
        )
        if is_short:
            return _unrolled(builder, equation, consts, carry, rows)
        return _scanned(builder, equation, consts, carry, rows)


def _sizes(params: dict[str, Any]) -> tuple[int, int]:
    """Count the operands of a scan that are the same in each round, and its carry."""
    if "num_carry" in params:
        return params["num_consts"], params["num_carry"]
    # Since JAX 0.12 a scan has the trees of its operands, without leaves, instead.
    consts, carry, _ = params["ft_in"].unpack()
    return len(consts), len(carry)


def _has_loop(jaxpr: Any, builder: Builder) -> bool:
    """Tell whether a program has loops that are not unrolled.

    A loop around such loops is not unrolled either, lest the program grow as their
    number of rounds.
    """
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        if name == "while":
            return True
        if name == "scan" and equation.params["length"] > builder.unroll:
            return True
        if any(_has_loop(inner, builder) for inner, _ in inner_programs(equation)):
            return True
    return False


def _row(builder: Builder, value: Value, index: Node) -> Value:
    """Read one of the rows that a scan goes over."""
    shape = value.shape[1:]
    size = math.prod(shape)
    if size == 0:
        return np.empty(shape, object)
    if index.is_constant and not isinstance(value, InMemory):
        return value[int(index.attr) : int(index.attr) + 1].reshape(shape)
    memory, source = builder.memory, builder.memory.in_memory(value)
    start = builder.graph.op("mul", index, builder.integer(size))
    if size > LARGE:
        target = memory.new(source.dtype, size)
        memory.move(
            target, places(shape), source.buffer, places(shape), source_shift=start
        )
        return InMemory(target, shape)
    out = np.empty(size, object)
    for offset in range(size):
        out[offset] = memory.load(source.buffer, start, offset)
    return out.reshape(shape)


def _unrolled(
    builder: Builder, equation: Any, consts: list, carry: list, rows: list
) -> list[Value]:
    params = equation.params
    body, length, count = params["jaxpr"], params["length"], len(carry)
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    saved: dict[int, list[Value]] = {}
    for index in order:
        row = [_row(builder, value, builder.integer(index)) for value in rows]
        builder.path.append(index)
        outs = builder.run(body.jaxpr, body.consts, [*consts, *carry, *row])
        builder.path.pop()
        carry, saved[index] = outs[:count], outs[count:]
        # A row may lie in memory that the next round would overwrite.
        for value in saved[index]:
            hold(value)
    stacked = []
    for column, variable in enumerate(equation.outvars[count:]):
        values = [saved[index][column] for index in range(length)]
        stacked.append(_stacked(builder, variable.aval, values))
    for index in order:
        for value in saved[index]:
            release(value)
    return [*carry, *stacked]


def _stacked(builder: Builder, aval: Any, values: list[Value]) -> Value:
    memory = builder.memory
    if not any(isinstance(value, InMemory) for value in values):
        out = np.empty(aval.shape, object)
        for index, value in enumerate(values):
            out[index, ...] = value
        return out
    size = values[0].size
    target = memory.new(dtype_name(aval.dtype), size * len(values))
    for index, value in enumerate(values):
        view = places(value.shape) + index * size
        memory.write(target, view, value)
    return InMemory(target, aval.shape)


def _scanned(
    builder: Builder, equation: Any, consts: list, carry: list, rows: list
) -> list[Value]:
    params, graph, memory = equation.params, builder.graph, builder.memory
    body, length, count = params["jaxpr"], params["length"], len(carry)
    stored = {index - len(consts) for index in updated(body.jaxpr)}
    of_carry = [
        value.size > 0 and (value.size > LARGE or index in stored)
        for index, value in enumerate(carry)
    ]
    avals = [variable.aval for variable in equation.outvars[count:]]
    saved: list[Value] = []
    for aval in avals:
        size = math.prod(aval.shape)
        if size == 0:
            saved.append(np.empty(aval.shape, object))
        else:
            buffer = memory.new(dtype_name(aval.dtype), size)
            saved.append(InMemory(buffer, aval.shape))

    def predicate(values: list[Value]) -> Node:
        return graph.op("lt", builder.index(values[0]), builder.integer(length))

    def step(values: list[Value]) -> list[Value]:
        k = builder.index(values[0])
        place = k
        if params["reverse"]:
            place = graph.op("sub", builder.integer(length - 1), k)
        row = [_row(builder, value, place) for value in rows]
        args = [*consts, *values[1 : 1 + count], *row]
        outs = builder.run(body.jaxpr, body.consts, args)
        after = values[1 + count :]
        with builder.held(outs):
            for target, value in zip(after, outs[count:], strict=True):
                if isinstance(target, InMemory):
                    shift = graph.op("mul", place, builder.integer(value.size))
                    memory.write(target.buffer, places(value.shape), value, shift)
        counter = builder.full((), graph.op("add", k, builder.integer(1)))
        return [counter, *outs[:count], *after]

    counter = builder.full((), builder.integer(0))
    flags = [False, *of_carry, *[isinstance(value, InMemory) for value in saved]]
    return loop(builder, [counter, *carry, *saved], flags, predicate, step)[1:]


SCANS: dict[str, Operation] = {"while": _while, "scan": _scan}
