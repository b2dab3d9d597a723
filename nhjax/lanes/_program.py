"""Compilation of a jaxpr to native code that XLA calls by a name, and lowering rules.

`compile_batched` and `compile_single` build the graph of a program (`build_graph`),
write its kernel (`llvm_ir`), compile the kernel together with a handler, and register
the handler with XLA under a name (`register_kernel`).

The name is a hash of the kernel, the machine, the version of the compiler and the level
of optimisation. Equal programs therefore have equal names in all processes, and are
compiled once in each process. A name stays registered with XLA as long as the process
runs, and an executable may call the handler at any time. Code is therefore never freed.
A program takes 20 to 150 KB; `compiled_code` returns the total.

Before the graph is built, the key of the jaxpr is looked up (`_cache`): in this
process, and then in the cache on disk if JAX's options switch it on. An entry on disk
contains the name and the native code, so that neither the graph nor LLVM is needed.

The rules at the end of the file lower the operations that stand for a program
(`_kernel`, `_batched_call`) to calls of native code, or leave the program to another
engine.

Executables in JAX's persistent cache call programs by these names too. JAX lowers a
program before it looks for its executable, and lowering registers the name. If an
executable is loaded in another way, in a process that has not registered the name, XLA
refuses it.
"""

import ctypes
import functools
import hashlib
import math
import os
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.extend
import jax.ffi
from jax.interpreters import mlir

from ._arrays import GATHERS, INDEXING, REDUCTIONS, SHAPING
from ._batched_call import batched_call, by_vmap, num_members
from ._builder import (
    ArrayValue,
    Builder,
    flat_indices,
    InMemory,
    MOST_IN_REGISTERS,
    Operation,
)
from ._cache import directory, Entry, program_key, read, write
from ._control_flow import BRANCHES, SCANS
from ._elementary_functions import definitions
from ._elementwise import ELEMENTWISE
from ._emission import emit
from ._engines import (
    as_parts_of_a_program,
    by_one_kernel,
    chosen_engine,
    is_exported,
    is_part_of_a_program,
    is_within_kernel,
    reason_against_kernel,
    reason_against_lanes,
    record_engine,
)
from ._expansion import expanded
from ._garbage_collection import rare_collections
from ._graph import Buffer, dtype_name, Region, Unsupported
from ._handler import HANDLER, handler_ir, SHARED_HANDLER, shared_handler_ir, WORKERS
from ._jaxprs import rms_array_size
from ._kernel import CompileOptions, kernel, merge_lists, partition_list
from ._native import host, host_width, load, object_code, version


def compile_single(program: Any, is_brief: bool = False) -> str:
    """Compile a program for a single run, and return its name for `jax.ffi.ffi_call`.

    With `is_brief` the program is compiled in less time, to slower code.

    **Raises:** `Unsupported` if the program cannot be compiled.
    """
    return _compile(program, None, 1, is_brief)


def compile_batched(
    program: Any, is_batched: tuple[bool, ...], is_brief: bool = False
) -> str:
    """Compile the program of one member for many members, and return its name.

    **Arguments:**

    - `program`: a closed jaxpr, the program of one member.
    - `is_batched`: for each operand, whether its leading axis is the axis of the
        members. Otherwise all members share the operand. The leading axis of all
        results is the axis of the members.
    - `is_brief`: whether to compile in less time, to slower code.

    **Returns:** a name for `jax.ffi.ffi_call` and `jax.ffi.ffi_lowering`.

    **Raises:** `Unsupported` if the program cannot be compiled.
    """
    width = host_width("float64" if _is_double(program) else "float32")
    return _compile(program, is_batched, width, is_brief)


def _compile(
    program: Any, is_batched: tuple[bool, ...] | None, width: int, is_brief: bool
) -> str:
    """Return the name of a program: find its code in a cache, or compile it.

    `is_batched` is `None` for a single run.
    """
    quick = is_brief or is_quick()
    program = expanded(program, OPERATIONS)
    key = program_key(program, is_batched, width, quick)
    folder = directory()
    with _lock:
        if key is not None and key in _names:
            return _names[key]
        if key is not None and folder is not None:
            found = read(folder, key)
            if found is not None:
                _register(*found)
                _names[key] = found.name
                return found.name
    start = time.perf_counter()
    marks = (False,) * len(program.in_avals) if is_batched is None else is_batched
    kernel = llvm_ir(program, marks, width)
    sizes = len(program.in_avals), len(program.out_avals), width
    made = _registered(kernel, *sizes, is_batched is not None, quick)
    if key is not None:
        _names[key] = made.name
        if folder is not None and made.code:
            write(folder, key, made, time.perf_counter() - start)
    return made.name


def _is_double(program: Any) -> bool:
    avals = [*program.in_avals, *program.out_avals]
    return any(aval.dtype == "float64" for aval in avals) or not any(
        aval.dtype == "float32" for aval in avals
    )


def llvm_ir(
    program: Any, is_batched: tuple[bool, ...], width: int, *, contract: bool = True
) -> str:
    """Write a kernel that runs a program for `width` members at a time.

    **Arguments:**

    - `program`: the closed jaxpr of one member.
    - `is_batched`: for each operand, whether its leading axis is the axis of the
        members.
    - `width`: the number of members in a vector, a power of two.
    - `contract`: whether a product and a sum may be fused, so that they are rounded
        once.

    **Returns:**

    The text of an LLVM module with the function `i1 kernel(ptr operands, ptr results,
    i64 first, i64 last)`. The function computes the members from `first` to `first +
    width - 1`; instead of members beyond `last`, it computes `last` again. It returns
    true if it failed, which happens only if it cannot allocate scratch memory.

    **Raises:** `Unsupported` if the program cannot be compiled.
    """
    traced = build_graph(expanded(program, OPERATIONS))
    kernel, wanted = emit(traced.root, traced.results, is_batched, width, contract)
    return f"{kernel}{definitions(wanted)}\n"


# Scans of at most this length are unrolled.
LONGEST_UNROLLED_SCAN = 8
# Programs with more nodes than `MOST_NODES` are refused, unless they have on average at
# most `NODES_PER_OPERATION` nodes for each operation of JAX. LLVM takes about 10 s for
# `MOST_NODES` nodes, and minutes for more. XLA does not unroll operations on arrays: it
# compiles programs with large arrays in a few seconds, but takes longer than LLVM if
# there are many small arrays.
MOST_NODES, NODES_PER_OPERATION = 100_000, 40

OPERATIONS: dict[str, Operation] = {
    **ELEMENTWISE,
    **SHAPING,
    **REDUCTIONS,
    **INDEXING,
    **GATHERS,
    **SCANS,
    **BRANCHES,
}


class ProgramGraph(NamedTuple):
    """A finished graph: its root region, and the memory of the results."""

    root: Region
    results: list[Buffer]


def build_graph(program: Any) -> ProgramGraph:
    """Build the graph of a closed jaxpr of one member."""
    builder = Builder(OPERATIONS, LONGEST_UNROLLED_SCAN)
    builder.graph.most_nodes = max(
        MOST_NODES, NODES_PER_OPERATION * _count_operations(program.jaxpr)
    )
    root = builder.graph.root
    args = []
    for index, variable in enumerate(program.jaxpr.invars):
        aval = variable.aval
        dtype = dtype_name(aval.dtype)
        buffer = Buffer("operand", dtype, math.prod(aval.shape), root, index)
        array: ArrayValue = InMemory(buffer, aval.shape)
        if buffer.size <= MOST_IN_REGISTERS:
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
            builder.memory.write(buffer, flat_indices(value.shape), value)
        results.append(buffer)
    return ProgramGraph(root, results)


def _count_operations(jaxpr: Any) -> int:
    """Count the operations of a jaxpr and of its inner programs."""
    count = len(jaxpr.eqns)
    for equation in jaxpr.eqns:
        if equation.primitive.name == "small_product":
            # A small product counts as four operations: two broadcasts, a product and a
            # sum.
            count += 3
        for part in jax.tree.leaves(equation.params):
            part = getattr(part, "jaxpr", part)
            count += _count_operations(part) if hasattr(part, "eqns") else 0
    return count


# The size in bytes of the code of each program, by its name.
_programs: dict[str, int] = {}

# The names of programs by the keys of their jaxprs. Two different jaxprs may have the
# same kernel, and then have the same name.
_names: dict[str, str] = {}

# The number of threads that are working in kernels. All programs share this counter.
_workers = ctypes.c_int64(0)

# One program is compiled at a time: LLVM must not be used by two threads at once, and
# if two threads request the same program, the second thread finds it compiled.
_lock = threading.RLock()


def _after_fork() -> None:
    # The counted threads run in the parent process, so the child's counter is reset.
    _workers.value = 0
    _lock.release()


# A fork waits for the lock, so that the child gets a compiler in a consistent state.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_after_fork
    )


class CompiledCode(NamedTuple):
    """The number of compiled programs, and the total size of their code in bytes."""

    programs: int
    bytes: int


def compiled_code() -> CompiledCode:
    """Return how many programs have been compiled, and the size of their code."""
    with _lock:
        return CompiledCode(len(_programs), sum(_programs.values()))


def register_kernel(
    kernel_ir: str,
    num_operands: int,
    num_results: int,
    width: int,
    is_batched: bool,
    is_brief: bool = False,
) -> str:
    """Compile and register a kernel, unless this has been done, and return its name.

    **Arguments:**

    - `kernel_ir`: a module in LLVM IR with `define i1 @kernel(ptr %operands, ptr
        %results, i64 %first, i64 %last)`, which computes `width` members from `%first`
        on, but no members after `%last`. `%operands` and `%results` are arrays of the
        addresses of the data. Several threads may run the kernel at the same time, on
        different members.
    - `num_operands`, `num_results`: the numbers of arrays that the kernel reads and
        writes.
    - `width`: the number of members that the kernel computes at once.
    - `is_batched`: whether the leading axis of the results is the axis of the members.
        Otherwise the kernel is called once, for member 0.
    - `is_brief`: whether to compile in less time, to slower code.

    **Returns:** a name for `jax.ffi.ffi_call` and `jax.ffi.ffi_lowering`.
    """
    quick = is_brief or is_quick()
    sizes = num_operands, num_results, width
    return _registered(kernel_ir, *sizes, is_batched, quick).name


def _registered(
    kernel_ir: str,
    num_operands: int,
    num_results: int,
    width: int,
    is_batched: bool,
    quick: bool,
) -> Entry:
    """Compile and register a kernel, unless this has been done.

    The code of the returned entry is empty if the kernel was already registered.
    """
    handler = handler_ir(num_operands, num_results, width, is_batched)
    name = _name(kernel_ir, handler, "quick" if quick else "optimised")
    with _lock:
        if name in _programs:
            return Entry(name, b"")
        code = object_code([kernel_ir, handler], HANDLER, host(), quick)
        _register(name, code)
    return Entry(name, code)


def _register(name: str, code: bytes) -> None:
    """Load the code of a program and register it with XLA, unless this has been done.

    The caller holds the lock.
    """
    if name in _programs:
        return
    imports = {SHARED_HANDLER: _shared_handler()}
    address = ctypes.c_void_p(load(code, name, HANDLER, imports))
    jax.ffi.register_ffi_target(
        name, jax.ffi.pycapsule(address), platform="cpu", api_version=1
    )
    _programs[name] = len(code)


@functools.cache
def _shared_handler() -> int:
    """Return the address of the function that the handlers of all programs call.

    Apart from the kernels that it runs, this function takes less than a microsecond.
    Optimising it would therefore take longer than the time saved.
    """
    code = object_code([shared_handler_ir()], SHARED_HANDLER, host(), is_quick=True)
    imports = {WORKERS: ctypes.addressof(_workers)}
    return load(code, "nhjax_lanes_handle", SHARED_HANDLER, imports)


def is_quick() -> bool:
    """Return whether JAX is configured for fast compilation and little optimisation."""
    return bool(jax.config.read("jax_disable_most_optimizations"))


def _name(*texts: str) -> str:
    digest = hashlib.sha256()
    for part in (*texts, *host(), version()):
        digest.update(part.encode())
        digest.update(b"\0")
    return f"nhjax_lanes_{digest.hexdigest()[:32]}"


# The lowering of the operations that stand for programs


# This compiler turns operations on arrays into operations on scalars. Measurements on
# the gallery's systems (2 to 8 stages), and on larger systems, show that its code is
# faster than XLA's if the root mean square of array sizes is at most `_SMALL_ARRAYS`.
# For larger arrays XLA is often faster, since it uses vectors for operations on arrays
# even in a single run. But XLA takes more than 1 ms to compile an operation. Therefore,
# up to `_LARGE_ARRAYS`, XLA compiles only short programs. Above this size it compiles
# all programs.
_SMALL_ARRAYS, _LARGE_ARRAYS = 40, 110
_SHORT_PROGRAM = 2800
# A program can have large arrays in operations that are computed once in each step, and
# small arrays in the iterations of each step. For such a program, the code of this
# compiler is faster than XLA's.
_PER_LOOP, _SMALL_IN_LOOPS = 16, 32


def _suits_vectors(program: Any) -> bool:
    """Return whether XLA should compile a single run, with vectors for its arrays."""
    size = rms_array_size(program)
    if _SMALL_ARRAYS < size <= _LARGE_ARRAYS:
        is_short = _count_operations(program) < _SHORT_PROGRAM
        return is_short and rms_array_size(program, _PER_LOOP) > _SMALL_IN_LOOPS
    return size > _LARGE_ARRAYS


_NOT_LANES = (
    "The environment variable NHJAX_ENGINE is 'lanes', but this engine cannot compile "
    "the program: {}. Unset the variable, so that another engine compiles it."
)


class _Ways(NamedTuple):
    """The ways to lower an operation: native code, XLA, and single kernels of XLA.

    `compiled` compiles the program to native code, and returns its name.
    """

    compiled: Callable[[], str]
    by_xla: Callable[..., Any]
    by_kernels: Callable[..., Any]


@rare_collections()
def _lower_single(ctx: Any, *operands: Any, program: Any, options: CompileOptions):
    params = {"program": program, "options": options}
    is_inlined = is_part_of_a_program() and (
        _count_operations(program.jaxpr) < options.xla_below
    )
    if is_within_kernel() or is_inlined:
        return _single_by_xla(ctx, *operands, **params)
    reason = reason_against_lanes()
    is_free = reason is None and chosen_engine() is None
    if is_free and _suits_vectors(program.jaxpr):
        reason = "its arrays are so large that XLA uses vectors for them"
    compiled = partial(compile_single, program, options.is_brief)
    ways = _Ways(compiled, _single_by_xla, by_one_kernel)
    return _by_first_engine(ctx, operands, params, None, reason, ways)


@rare_collections()
def _lower_batched(
    ctx: Any,
    *operands: Any,
    program: Any,
    is_batched: tuple[bool, ...],
    options: CompileOptions,
):
    params = {"program": program, "is_batched": is_batched, "options": options}
    if is_part_of_a_program():
        return _batched_by_xla(ctx, *operands, **params)
    members = num_members(ctx.avals_in, is_batched)
    compiled = partial(compile_batched, program, is_batched, options.is_brief)
    ways = _Ways(compiled, _batched_by_xla, _one_by_one)
    reason = reason_against_lanes()
    return _by_first_engine(ctx, operands, params, members, reason, ways)


def _by_first_engine(
    ctx: Any,
    operands: tuple[Any, ...],
    params: dict[str, Any],
    members: int | None,
    reason: str | None,
    ways: _Ways,
):
    """Lower a program by the first engine that can compile it, and record the engine.

    `reason` is the reason not to try native code, or `None` if native code is tried.
    """
    options = params["options"]
    if is_exported(ctx):
        # Another process cannot call machine code of this process.
        record_engine("xla", "the program is exported", members)
        return ways.by_xla(ctx, *operands, **params)
    if reason is None:
        try:
            name = ways.compiled()
        except Unsupported as error:
            reason = str(error)
        else:
            record_engine("lanes", f"the first choice{options.note}", members)
            return jax.ffi.ffi_lowering(name)(ctx, *operands)
    if chosen_engine() == "lanes":
        raise RuntimeError(_NOT_LANES.format(reason))
    against = _reason_against_kernel(params["program"], options, reason)
    if against is not None:
        record_engine("xla", f"{against}{options.note}", members)
        return ways.by_xla(ctx, *operands, **params)
    record_engine("kernels", reason, members)
    return ways.by_kernels(ctx, *operands, **params)


def _reason_against_kernel(
    program: Any, options: CompileOptions, reason: str
) -> str | None:
    """Return why XLA does not compile a single kernel, or `None` if it does.

    `reason` is the reason against `lanes`. The returned text begins with it, if both
    reasons differ.
    """
    if "kernels" not in options.engines:
        return reason
    against = reason_against_kernel(program)
    if against is None or reason == against:
        return against
    return f"{reason}; no kernel: {against}"


def _run_single(*operands: Any, program: Any, options: CompileOptions) -> list[Any]:
    del options
    return jax.extend.core.jaxpr_as_fun(program)(*operands)


def _run_one_by_one(
    *operands: Any,
    program: Any,
    is_batched: tuple[bool, ...],
    options: CompileOptions,
) -> list[Any]:
    batched, shared = partition_list(is_batched, operands)

    def member(batched: list[Any]) -> list[Any]:
        given = {"program": program, "options": options}
        return kernel.bind(*merge_lists(is_batched, batched, shared), **given)

    return jax.lax.map(member, batched)


_single_by_xla = as_parts_of_a_program(
    mlir.lower_fun(_run_single, multiple_results=True)
)
_batched_by_xla = as_parts_of_a_program(mlir.lower_fun(by_vmap, multiple_results=True))
_one_by_one = mlir.lower_fun(_run_one_by_one, multiple_results=True)
mlir.register_lowering(kernel, _single_by_xla, cacheable=False)
mlir.register_lowering(kernel, _lower_single, platform="cpu", cacheable=False)
mlir.register_lowering(batched_call, _batched_by_xla, cacheable=False)
mlir.register_lowering(batched_call, _lower_batched, platform="cpu", cacheable=False)
