"""Loops, branches, calls and products of a jaxpr: `while`, `cond`, `dot_general`, ….

A loop carries arrays as parameters, number by number, or leaves them in place in
memory. First, numbers that start as constants are assumed to stay constant, and the
body is built. If some of these numbers change, the body is built again without the
assumption for them. The changing numbers are remembered: if an outer loop is built
again, its inner loops need no second attempt. Otherwise the time to build nested loops
would double with each level. If a loop continues an earlier loop, the operation
`loop_start` names the constants with which the earlier loop started.

Short scans are unrolled, unless their body contains loops. Products of arrays are
written out number by number, or in a loop over the first index if they are long.
"""

import math
import string
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from jax.extend.core import Literal

from ._builder import (
    ArrayValue,
    Builder,
    called_program,
    CALLS,
    flat_indices,
    hold,
    InMemory,
    inner_programs,
    MOST_IN_REGISTERS,
    Operation,
    Registers,
    release,
    sizes_of_scan,
)
from ._graph import (
    BranchBuilder,
    call,
    dtype_name,
    Function,
    LoopBuilder,
    Node,
    parameters_for,
    Region,
    Unsupported,
)
from ._jaxprs import COMPILED_ONCE, KEPT_CALL, WRITE_ROW


# The indices of both factors and of the result of a sum of products, as for
# `jax.numpy.einsum`.
_Indices: TypeAlias = tuple[str, str, str]

# Sums of products of two arrays with more terms than this are computed in a loop. The
# loop takes less time to compile than written-out terms, and runs as fast.
_LONGEST_PRODUCT = 1000
# Programs that contain sums of products with more terms than this are left to XLA,
# which calls a library for these sums.
_LARGEST_PRODUCT = 2**16


def _call(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    inner = called_program(equation)
    jaxpr = getattr(inner, "jaxpr", inner)
    return builder.run(jaxpr, getattr(inner, "consts", ()), values)


def _function_call(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    """Call a program as a function that is compiled once, or write it out."""
    if builder.is_written_out or any(isinstance(x, InMemory) for x in values):
        return _call(builder, equation, values)
    numbers = [node for value in values for node in value.reshape(-1)]  # pyright: ignore
    # The program of a `kept_call` is one object, the same at all of its calls.
    program = equation.params.get("kept", called_program(equation))
    build = partial(_function, builder, equation, values)
    function = builder.functions.of(program, numbers, build)
    if function is None:
        return _call(builder, equation, values)
    args = [node for node in numbers if not node.is_constant]
    results = iter(call(builder.graph, function, args))
    return [_taken(results, variable.aval) for variable in equation.outvars]


def _function(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> Function | None:
    """Build the function of a program; return `None` if a result is in memory."""
    graph = builder.graph
    region = Region(None, None, is_side=False)
    arrays, parameters = parameters_for(graph, region, values)  # pyright: ignore
    outer, graph.region = graph.region, region
    try:
        outs = _call(builder, equation, [*arrays])
    finally:
        graph.region = outer
    if any(isinstance(out, InMemory) for out in outs):
        return None
    numbers = [node for out in outs for node in out.reshape(-1)]  # pyright: ignore
    return Function(parameters, numbers)


def _jit(builder: Builder, equation: Any, values: list[ArrayValue]) -> list[ArrayValue]:
    is_function = equation.params.get("name", "").startswith(COMPILED_ONCE)
    return (_function_call if is_function else _call)(builder, equation, values)


def _linear_solve(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    lengths, jaxprs = equation.params["const_lengths"], equation.params["jaxprs"]
    start = lengths.matvec + lengths.vecmat
    consts = values[start : start + lengths.solve]
    rest = values[start + lengths.solve + lengths.transpose_solve :]
    return builder.run(jaxprs.solve.jaxpr, jaxprs.solve.consts, [*consts, *rest])


def _cond(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
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
    runs: list[Callable[[], list[ArrayValue]]],
    first: int,
    avals: list[Any],
) -> list[ArrayValue]:
    """Run the branch that an index selects, among the branches from `first` on.

    An index that is too large selects the last branch.
    """
    if first == len(runs) - 1:
        return runs[first]()
    graph = builder.graph
    if index.dtype == "bool":
        is_first = graph.op("not", index)
    else:
        is_first = graph.op("le", index, graph.constant(first, index.dtype))

    def rest() -> list[ArrayValue]:
        return _chosen(builder, index, runs, first + 1, avals)

    return _branch(builder, is_first, runs[first], rest, avals)


def _branch(
    builder: Builder,
    predicate: Node,
    yes: Callable[[], list[ArrayValue]],
    no: Callable[[], list[ArrayValue]],
    avals: list[Any],
) -> list[ArrayValue]:
    """Create a branch; each side has a region of its own."""
    if predicate.is_constant:
        return yes() if predicate.attr else no()
    memory = builder.memory
    branch = BranchBuilder(builder.graph, predicate)
    outs = []
    for side, run in enumerate((yes, no)):
        builder.path.append(side)
        outs.append(branch.on_side(side, run))
        builder.path.pop()
    results: list[ArrayValue | None] = []
    numbers: tuple[list[Node], list[Node]] = ([], [])
    for aval, one, other in zip(avals, *outs, strict=True):
        pair = (one, other)
        shared = _shared(one, other)
        if shared is None and _goes_to_memory(one, other):
            # The result gets its own memory, because neither side may change an array
            # that the other side returns.
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


def _write(builder: Builder, target: Any, value: ArrayValue) -> list:
    builder.memory.write(target, flat_indices(value.shape), value)
    return []


def _shared(one: ArrayValue, other: ArrayValue) -> ArrayValue | None:
    """Return the result of both sides if it is the same array, and None otherwise."""
    if isinstance(one, InMemory) and isinstance(other, InMemory):
        return one if one.buffer is other.buffer else None
    if isinstance(one, InMemory) or isinstance(other, InMemory):
        return None
    pairs = zip(one.reshape(-1), other.reshape(-1), strict=True)
    return one if one.size and all(a is b for a, b in pairs) else None


def _goes_to_memory(one: ArrayValue, other: ArrayValue) -> bool:
    there = [isinstance(value, InMemory) for value in (one, other)]
    return all(there) or (any(there) and one.size > MOST_IN_REGISTERS)


def _taken(nodes: Any, aval: Any) -> np.ndarray:
    out = np.empty(int(np.prod(aval.shape)), object)
    for index in range(out.size):
        out[index] = next(nodes)
    return out.reshape(aval.shape)


def _loop_start(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    """Remember the constants with which a carry started in an earlier loop."""
    del equation
    carry, firsts = values[: len(values) // 2], values[len(values) // 2 :]
    for value, first in zip(carry, firsts, strict=True):
        if not (isinstance(value, InMemory) or isinstance(first, InMemory)):
            pairs = zip(value.reshape(-1), first.reshape(-1), strict=True)
            builder.loop_starts.update((x, one) for x, one in pairs if one.is_constant)
    return carry


BRANCHES: dict[str, Operation] = {
    **dict.fromkeys(CALLS, _call),
    KEPT_CALL: _function_call,
    "jit": _jit,
    "pjit": _jit,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
    "loop_start": _loop_start,
}


def _while(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    params = equation.params
    test, body = params["cond_jaxpr"], params["body_jaxpr"]
    if test.out_avals[0].shape:
        raise Unsupported("a loop with a condition for each of several members")
    first, second = params["cond_nconsts"], params["body_nconsts"]
    of_test, of_body = values[:first], values[first : first + second]
    inits = values[first + second :]
    variables = body.jaxpr.invars[second:]
    # Values that the body returns unchanged are not carried.
    is_same = [a is b for a, b in zip(variables, body.jaxpr.outvars, strict=True)]
    same, _ = _split(is_same, inits)
    stored = {index - second for index in updated_inputs(body.jaxpr)}
    goes_to_memory = [
        value.size > 0 and (value.size > MOST_IN_REGISTERS or index in stored)
        for index, value in enumerate(inits)
    ]

    def everything(carry: list[ArrayValue]) -> list[ArrayValue]:
        return _merged(is_same, same, carry)

    def predicate(carry: list[ArrayValue]) -> Node:
        args = [*of_test, *everything(carry)]
        return builder.run(test.jaxpr, test.consts, args)[0].reshape(-1)[0]  # pyright: ignore

    def step(carry: list[ArrayValue]) -> list[ArrayValue]:
        args = [*of_body, *everything(carry)]
        return _split(is_same, builder.run_body(body, args))[1]

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


def _scan(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    params, length = equation.params, equation.params["length"]
    first, count = sizes_of_scan(params)
    consts, carry = values[:first], values[first : first + count]
    rows = values[first + count :]
    with builder.held([*consts, *rows]):
        is_short = length <= 1 or (
            length <= builder.unroll and not _has_loop(params["jaxpr"].jaxpr, builder)
        )
        if is_short:
            return _unrolled(builder, equation, consts, carry, rows)
        return _scanned(builder, equation, consts, carry, rows)


def _has_loop(jaxpr: Any, builder: Builder) -> bool:
    """Return whether a program has loops that are not unrolled.

    A loop around such loops is not unrolled either, so that the program does not grow
    with the number of iterations.
    """
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        if name in ("while", "batched_call"):
            return True
        if name == "scan" and equation.params["length"] > builder.unroll:
            return True
        if any(_has_loop(inner, builder) for inner, _ in inner_programs(equation)):
            return True
    return False


def _row(builder: Builder, value: ArrayValue, index: Node) -> ArrayValue:
    """Read one of the rows over which a scan iterates."""
    shape = value.shape[1:]
    size = math.prod(shape)
    if size == 0:
        return np.empty(shape, object)
    if index.is_constant and not isinstance(value, InMemory):
        return value[int(index.attr) : int(index.attr) + 1].reshape(shape)
    memory, source = builder.memory, builder.memory.in_memory(value)
    start = builder.graph.op("mul", index, builder.integer(size))
    if size > MOST_IN_REGISTERS:
        target = memory.new(source.dtype, size)
        memory.move(
            target,
            flat_indices(shape),
            source.buffer,
            flat_indices(shape),
            source_shift=start,
        )
        return InMemory(target, shape)
    out = np.empty(size, object)
    for offset in range(size):
        out[offset] = memory.load(source.buffer, start, offset)
    return out.reshape(shape)


def _unrolled(
    builder: Builder, equation: Any, consts: list, carry: list, rows: list
) -> list[ArrayValue]:
    params = equation.params
    body, length, count = params["jaxpr"], params["length"], len(carry)
    order = range(length - 1, -1, -1) if params["reverse"] else range(length)
    saved: dict[int, list[ArrayValue]] = {}
    for index in order:
        row = [_row(builder, value, builder.integer(index)) for value in rows]
        builder.path.append(index)
        outs = builder.run(body.jaxpr, body.consts, [*consts, *carry, *row])
        builder.path.pop()
        carry, saved[index] = outs[:count], outs[count:]
        # Without `hold`, the next iteration could overwrite a row that is in memory.
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


def _stacked(builder: Builder, aval: Any, values: list[ArrayValue]) -> ArrayValue:
    memory = builder.memory
    if not any(isinstance(value, InMemory) for value in values):
        out = np.empty(aval.shape, object)
        for index, value in enumerate(values):
            out[index, ...] = value
        return out
    size = values[0].size
    target = memory.new(dtype_name(aval.dtype), size * len(values))
    for index, value in enumerate(values):
        view = flat_indices(value.shape) + index * size
        memory.write(target, view, value)
    return InMemory(target, aval.shape)


def _scanned(
    builder: Builder, equation: Any, consts: list, carry: list, rows: list
) -> list[ArrayValue]:
    params, count = equation.params, len(carry)
    body, length = params["jaxpr"], params["length"]
    stored = {index - len(consts) for index in updated_inputs(body.jaxpr)}
    of_carry = [
        value.size > 0 and (value.size > MOST_IN_REGISTERS or index in stored)
        for index, value in enumerate(carry)
    ]

    def iteration(
        carry: list[ArrayValue], row: list[ArrayValue]
    ) -> tuple[list[ArrayValue], list[ArrayValue]]:
        outs = builder.run_body(body, [*consts, *carry, *row])
        return outs[:count], outs[count:]

    avals = [variable.aval for variable in equation.outvars[count:]]
    order = length, params["reverse"]
    return _over_rows(builder, iteration, carry, of_carry, rows, avals, order)


def _each_row(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> list[ArrayValue]:
    """Compute a program for each row of some operands, in a loop."""
    params = equation.params
    program, is_row = params["program"], params["is_batched"]
    rows, shared = _split(is_row, values)

    def iteration(
        carry: list[ArrayValue], row: list[ArrayValue]
    ) -> tuple[list[ArrayValue], list[ArrayValue]]:
        del carry
        operands = _merged(is_row, row, shared)
        return [], builder.run_body(program, operands)

    avals = [variable.aval for variable in equation.outvars]
    order = rows[0].shape[0], False
    with builder.held([*shared, *rows]):
        return _over_rows(builder, iteration, [], [], rows, avals, order)


_Iteration = Callable[
    [list[ArrayValue], list[ArrayValue]], tuple[list[ArrayValue], list[ArrayValue]]
]


def _over_rows(
    builder: Builder,
    iteration: _Iteration,
    carry: list[ArrayValue],
    of_carry: list[bool],
    rows: list[ArrayValue],
    avals: list[Any],
    order: tuple[int, bool],
) -> list[ArrayValue]:
    """Create a loop over rows, which carries some arrays and stacks other results.

    `of_carry` says which of the carried arrays are in memory, and `avals` are the types
    of the stacked results. `order` has two entries: the number of rows, and whether the
    loop begins with the last row.
    """
    graph, memory, count = builder.graph, builder.memory, len(carry)
    length, reverse = order
    saved: list[ArrayValue] = []
    for aval in avals:
        size = math.prod(aval.shape)
        if size == 0:
            saved.append(np.empty(aval.shape, object))
        else:
            buffer = memory.new(dtype_name(aval.dtype), size)
            saved.append(InMemory(buffer, aval.shape))
    if length == 0:
        return [*carry, *saved]

    def predicate(values: list[ArrayValue]) -> Node:
        return graph.op("lt", builder.index(values[0]), builder.integer(length))

    def step(values: list[ArrayValue]) -> list[ArrayValue]:
        k = builder.index(values[0])
        place = k
        if reverse:
            place = graph.op("sub", builder.integer(length - 1), k)
        row = [_row(builder, value, place) for value in rows]
        carry, out = iteration(values[1 : 1 + count], row)
        after = values[1 + count :]
        with builder.held([*carry, *out]):
            for target, value in zip(after, out, strict=True):
                if isinstance(target, InMemory):
                    shift = graph.op("mul", place, builder.integer(value.size))
                    memory.write(target.buffer, flat_indices(value.shape), value, shift)
        counter = builder.full((), graph.op("add", k, builder.integer(1)))
        return [counter, *carry, *after]

    counter = builder.full((), builder.integer(0))
    flags = [False, *of_carry, *[isinstance(value, InMemory) for value in saved]]
    return loop(builder, [counter, *carry, *saved], flags, predicate, step)[1:]


def _small_product(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    first, second, result = (equation.params[k] for k in ("first", "second", "result"))
    aval = equation.outvars[0].aval
    return _product(builder, values, (first, second, result), aval)


def _dot_general(
    builder: Builder, equation: Any, values: list[ArrayValue]
) -> ArrayValue:
    aval = equation.outvars[0].aval
    (left, right), (left_batch, right_batch) = equation.params["dimension_numbers"]
    letters = iter(string.ascii_letters)
    first, second = ([next(letters) for _ in value.shape] for value in values)
    for i, j in zip((*left_batch, *left), (*right_batch, *right), strict=True):
        second[j] = first[i]
    free = [first[i] for i in range(len(first)) if i not in (*left_batch, *left)]
    free += [second[j] for j in range(len(second)) if j not in (*right_batch, *right)]
    result = [*(first[i] for i in left_batch), *free]
    indices = "".join(first), "".join(second), "".join(result)
    return _product(builder, values, indices, aval)


def _product(
    builder: Builder, values: list[ArrayValue], indices: _Indices, aval: Any
) -> ArrayValue:
    """Compute sums of products; if long, in a loop over the result's first index."""
    first, second, result = indices
    dtype = dtype_name(aval.dtype)
    lengths = {
        index: length
        for names, value in zip((first, second), values, strict=True)
        for index, length in zip(names, value.shape, strict=True)
    }
    size = math.prod(lengths.values())
    if size > _LARGEST_PRODUCT:
        raise Unsupported("a large product of matrices")
    if size <= _LONGEST_PRODUCT or aval.shape[:1] in ((), (1,)):
        a, b = map(builder.memory.registers, values)
        return _written_out(builder, a, b, indices, dtype)
    index = result[0]
    is_row = [index in first, index in second]

    def iteration(
        carry: list[ArrayValue], row: list[ArrayValue]
    ) -> tuple[list[ArrayValue], list[ArrayValue]]:
        del carry
        a, b = map(builder.memory.registers, _merged(is_row, row, shared))
        left, right, kept = (names.replace(index, "") for names in indices)
        return [], [_written_out(builder, a, b, (left, right, kept), dtype)]

    values = [
        _with_axis_first(builder, value, names.index(index)) if mark else value
        for mark, value, names in zip(is_row, values, (first, second), strict=True)
    ]
    rows, shared = _split(is_row, values)
    with builder.held(values):
        order = aval.shape[0], False
        return _over_rows(builder, iteration, [], [], rows, [aval], order)[0]


def _with_axis_first(builder: Builder, value: ArrayValue, axis: int) -> ArrayValue:
    if axis == 0:
        return value
    return builder.memory.rearranged(value, lambda x: np.moveaxis(x, axis, 0))


def _written_out(
    builder: Builder, a: Registers, b: Registers, indices: _Indices, dtype: str
) -> Registers:
    """Compute a sum of products number by number, in the dtype of the result."""
    first, second, result = indices
    times, plus = ("and", "or") if dtype == "bool" else ("mul", "add")
    graph = builder.graph
    lengths = {
        **dict(zip(first, a.shape, strict=True)),
        **dict(zip(second, b.shape, strict=True)),
    }
    order = [*result, *(index for index in first if index not in result)]
    shape = [lengths[index] for index in order]
    size = math.prod(shape[: len(result)])

    def rows(x: np.ndarray, indices: str) -> np.ndarray:
        """Return the numbers of an operand as rows, one row for each sum."""
        x = x.transpose([indices.index(index) for index in order if index in indices])
        x = x.reshape([lengths[index] if index in indices else 1 for index in order])
        terms = math.prod(shape[len(result) :])
        return np.broadcast_to(x, shape).reshape(size, terms)

    products = [
        [
            graph.op(times, graph.convert(x, dtype), graph.convert(y, dtype))
            for x, y in zip(*pair, strict=True)
        ]
        for pair in zip(rows(a, first), rows(b, second), strict=True)
    ]
    out = np.empty(size, object)
    for index, row in enumerate(products):
        out[index] = graph.folded(plus, row)
        if out[index] is None:
            out[index] = graph.zero(dtype)
    return out.reshape(shape[: len(result)])


SCANS: dict[str, Operation] = {
    "while": _while,
    "scan": _scan,
    "batched_call": _each_row,
    "dot_general": _dot_general,
    "small_product": _small_product,
}


_Predicate = Callable[[list[ArrayValue]], Node]
_Body = Callable[[list[ArrayValue]], list[ArrayValue]]


def loop(
    builder: Builder,
    inits: Sequence[ArrayValue],
    in_memory: Sequence[bool],
    predicate: _Predicate,
    body: _Body,
) -> list[ArrayValue]:
    """Create a loop; `in_memory` says which of the carried arrays are in memory."""
    memory = builder.memory
    carried: list[ArrayValue] = []
    for value, is_there in zip(inits, in_memory, strict=True):
        carried.append(memory.owned(value) if is_there else memory.registers(value))
        # If a loop carries the same array twice, `hold` makes `owned` copy the second.
        hold(carried[-1])
    for value in carried:
        release(value)
    buffers = [value.buffer for value in carried if isinstance(value, InMemory)]
    changing = builder.changing.setdefault(tuple(builder.path), set())
    # Integer scalars are usually counters, so they are assumed to change.
    for start, value in _starts(carried):
        if value.ndim == 0 and value[()].dtype.startswith("int"):
            changing.add(start)
    while True:
        before = [len(buffer.stores) for buffer in buffers]
        made = _Attempt(builder, carried, changing)
        made.make(predicate, body)
        if made.runs_never:
            break
        wrong = made.wrong()
        if not wrong:
            break
        changing.update(wrong)
        for buffer, length in zip(buffers, before, strict=True):
            del buffer.stores[length:]
    if made.runs_never:
        return carried
    for buffer in buffers:
        buffer.version += 1
    return made.results()


def _starts(values: Sequence[ArrayValue]) -> list[tuple[int, Registers]]:
    """List the arrays in registers, each with the position of its first number."""
    position, out = 0, []
    for value in values:
        if not isinstance(value, InMemory):
            out.append((position, value))
            position += value.size
    return out


class _Attempt:
    """A loop in which numbers that start as constants are assumed to stay constant.

    The numbers at the positions in `changing` are known to change.
    """

    def __init__(self, builder: Builder, carried: list[ArrayValue], changing: set[int]):
        self.builder, self.carried = builder, carried
        self.loop = LoopBuilder(builder.graph)
        self.changing = changing
        # `fixed` maps positions to the constants that are assumed not to change.
        # `varying` lists the positions of the numbers that are parameters of the loop.
        self.fixed: dict[int, Node] = {}
        self.varying: list[int] = []
        self.outs: list[Node] = []
        self.runs_never = False

    def make(self, predicate: _Predicate, body: _Body) -> None:
        """Build the predicate and the body of the loop."""
        with self.loop:
            arrays: list[ArrayValue] = []
            for value in self.carried:
                if isinstance(value, InMemory):
                    # Values that were loaded before the loop are not valid inside it.
                    value.buffer.version += 1
                    arrays.append(value)
            in_registers = iter([self._parameters(*x) for x in _starts(self.carried)])
            arrays = [
                value if isinstance(value, InMemory) else next(in_registers)
                for value in self.carried
            ]
            with self.builder.held(arrays):
                go_on = predicate(arrays)
            self.loop.goes_on_while(go_on)
            self.runs_never = go_on.is_constant and not go_on.attr
            if not self.runs_never:
                self._take_over(body(arrays))

    def _parameters(self, start: int, value: Registers) -> Registers:
        out, starts = np.empty(value.size, object), self.builder.loop_starts
        for index, node in enumerate(value.reshape(-1)):
            position = start + index
            first = starts[node] if node in starts else node  # noqa: SIM401
            if first.is_constant and position not in self.changing:
                self.fixed[position] = out[index] = first
            else:
                self.varying.append(position)
                out[index] = self.loop.parameter(node)
        return out.reshape(value.shape)

    def _take_over(self, values: list[ArrayValue]) -> None:
        """Make the values of an iteration the initial values of the next iteration."""
        memory = self.builder.memory
        own = [v.buffer for v in self.carried if isinstance(v, InMemory)]
        ready: list[ArrayValue] = []
        for value, old in zip(values, self.carried, strict=True):
            if not isinstance(old, InMemory):
                value = memory.registers(value)
            elif isinstance(value, InMemory) and value.buffer is not old.buffer:
                # `value` may be in the buffer of another carried array, which is
                # overwritten below.
                hold(value)
                value_free = memory.owned(value) if value.buffer in own else value
                release(value)
                value = value_free
            ready.append(value)
        for value, old in zip(ready, self.carried, strict=True):
            if not isinstance(old, InMemory):
                self.outs.extend(value.reshape(-1))  # pyright: ignore
            elif not (isinstance(value, InMemory) and value.buffer is old.buffer):
                memory.write(old.buffer, flat_indices(old.shape), value)
        self.loop.end([self.outs[position] for position in self.varying])

    def wrong(self) -> list[int]:
        """List the positions of numbers that change but were assumed constant."""
        return [p for p, node in self.fixed.items() if self.outs[p] is not node]

    def results(self) -> list[ArrayValue]:
        """Return the arrays after the loop."""
        nodes = dict(zip(self.varying, self.loop.results(), strict=True))
        nodes.update(self.fixed)
        out: list[ArrayValue] = []
        position = 0
        for value in self.carried:
            if isinstance(value, InMemory):
                out.append(value)
                continue
            array = np.empty(value.size, object)
            for index in range(value.size):
                array[index] = nodes[position + index]
            position += value.size
            out.append(array.reshape(value.shape))
        return out


_UPDATES = ("dynamic_update_slice", WRITE_ROW, "scatter")
_SAME = ("reshape", "squeeze", "expand_dims", "copy", "copy_p", "optimization_barrier")


def updated_inputs(jaxpr: Any) -> frozenset[int]:
    """List the inputs that a jaxpr, or an inner program of it, updates at an index.

    A loop carries these arrays in memory. Updates at an index that is a literal do not
    count.
    """
    origins: dict[Any, int] = {v: i for i, v in enumerate(jaxpr.invars)}
    found: set[int] = set()
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        ins = [None if isinstance(v, Literal) else v for v in equation.invars]
        if name.startswith(_UPDATES):
            origin = origins.get(ins[0])
            is_scatter = name.startswith("scatter")
            places = equation.invars[1:2] if is_scatter else equation.invars[2:]
            if origin is not None:
                if any(not isinstance(v, Literal) for v in places):
                    found.add(origin)
                origins[equation.outvars[0]] = origin
        elif name in _SAME:
            for before, after in zip(ins, equation.outvars, strict=True):
                if before in origins:
                    origins[after] = origins[before]
        for inner, first in inner_programs(equation):
            for index in updated_inputs(inner):
                variable = ins[first + index]
                if variable in origins:
                    found.add(origins[variable])
    return frozenset(found)
