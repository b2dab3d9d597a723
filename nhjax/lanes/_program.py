"""The whole way of a program, from its jaxpr to a name that XLA can call.

The graph of a whole program, from its operands to its results.

Names of compiled programs, under which XLA finds their handlers.

A program's name is made of its content, its machine's, the compiler's version and how
it optimises: equal programs share a name, in all processes. XLA keeps names for as long
as the process runs, and an executable may call them at any time. For this reason
neither code nor name is ever given up: each program costs its code, some 20 to 150 KB,
and `compiled_code` tells how much that is in all. What is compiled once per process is
not compiled again.

Executables that JAX keeps on disk call programs by these names too. JAX lowers a
program before it looks for its executable, and lowering registers the name, so that it
is there when the executable is loaded. One that is loaded by other ways, in a process
that has not registered the name, is refused by XLA.
"""

import ctypes
import functools
import hashlib
import math
import os
import threading
from typing import Any, NamedTuple

import jax
import jax.ffi

from ._arrays import GATHERS, INDEXING, REDUCTIONS, SHAPING
from ._builder import Builder, InMemory, LARGE, Operation, places, Value
from ._control_flow import BRANCHES, SCANS
from ._elementary_functions import definitions
from ._elementwise import ELEMENTWISE
from ._emission import emit
from ._graph import Buffer, dtype_name, Region
from ._handler import HANDLE, handle_ir, HANDLER, handler_ir, WORKERS
from ._native import host, host_width, load, object_code, version


def compile_single(program: Any, is_brief: bool = False) -> str:
    """Compile a program for one run, and return the name to call it by.

    What `is_brief` is compiled in less time to slower code.

    **Raises:** `Unsupported` if the program holds what cannot be compiled.
    """
    shared = (False,) * len(program.in_avals)
    kernel = llvm_ir(program, shared, 1)
    return register_kernel(
        kernel,
        len(program.in_avals),
        len(program.out_avals),
        1,
        is_batched=False,
        is_brief=is_brief,
    )


def compile_batched(
    program: Any, is_batched: tuple[bool, ...], is_brief: bool = False
) -> str:
    """Compile a member's program for an ensemble, and return the name to call it by.

    **Arguments:**

    - `program`: a closed jaxpr, the program of one member.
    - `is_batched`: for each operand whether members have their own, along its leading
        axis, or share it. All results have members.
    - `is_brief`: whether to compile it in less time to slower code.

    **Returns:** a name for `jax.ffi.ffi_call` and `jax.ffi.ffi_lowering`.

    **Raises:** `Unsupported` if the program holds what cannot be compiled.
    """
    width = host_width("float64" if _is_double(program) else "float32")
    kernel = llvm_ir(program, is_batched, width)
    return register_kernel(
        kernel,
        len(program.in_avals),
        len(program.out_avals),
        width,
        is_batched=True,
        is_brief=is_brief,
    )


def _is_double(program: Any) -> bool:
    avals = [*program.in_avals, *program.out_avals]
    return any(aval.dtype == "float64" for aval in avals) or not any(
        aval.dtype == "float32" for aval in avals
    )


def llvm_ir(
    program: Any, is_batched: tuple[bool, ...], width: int, *, contract: bool = True
) -> str:
    """Write a kernel that runs a program for a number of members at a time.

    **Arguments:**

    - `program`: the closed jaxpr of one member.
    - `is_batched`: for each operand, whether it has the member as its leading axis.
    - `width`: the number of members that run in the lanes of vectors, a power of two.
    - `contract`: whether a product and a sum may be rounded together.

    **Returns:**

    The text of a module of LLVM with the function
    `i1 kernel(ptr operands, ptr results, i64 first, i64 last)`. It computes the members
    from `first` to `first + width - 1`; those beyond `last` repeat that one. It returns
    whether that failed, for lack of scratch memory.

    **Raises:**

    - `Unsupported`: if the program has to run in another way.
    """
    traced = trace(program)
    kernel, wanted = emit(traced.root, traced.results, is_batched, width, contract)
    return f"{kernel}{definitions(wanted)}\n"


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


# The size in bytes of the code of each program, by its name.
_programs: dict[str, int] = {}

# How many threads are at work in kernels, which all programs count together.
_workers = ctypes.c_int64(0)

# One program is compiled at a time: LLVM is not to be used by two threads at once, and
# of two threads that want the same program the second then finds it.
_lock = threading.RLock()


def _after_fork() -> None:
    # The threads that were at work are the parent's.
    _workers.value = 0
    _lock.release()


# A fork waits for the lock, so that the child has a whole compiler and a free lock.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_after_fork
    )


class CompiledCode(NamedTuple):
    """How much is kept until the process ends: programs, and bytes of their code."""

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
    """Compile and register a kernel, unless that has been done, and return its name.

    **Arguments:**

    - `kernel_ir`: the text of a module in LLVM IR with `define i1 @kernel(ptr
        %operands, ptr %results, i64 %first, i64 %last)`, which computes the members
        from `%first` on, `width` of them but none after `%last`. `%operands` and
        `%results` are arrays of the addresses of the data. Other threads may run it at
        the same time, on other members.
    - `num_operands`, `num_results`: how many arrays it reads and writes.
    - `width`: how many members it computes at once.
    - `is_batched`: whether the results have members, along the leading axis; else it
        is called once, for the member 0.
    - `is_brief`: whether it runs so shortly that it is to be compiled quickly.

    **Returns:**

    A name for `jax.ffi.ffi_call` and `jax.ffi.ffi_lowering`.
    """
    handler = handler_ir(num_operands, num_results, width, is_batched)
    quick = is_brief or is_quick()
    name = _name(kernel_ir, handler, "quick" if quick else "optimised")
    with _lock:
        if name not in _programs:
            code = object_code([kernel_ir, handler], HANDLER, host(), quick)
            imports = {HANDLE: _handle()}
            address = ctypes.c_void_p(load(code, name, HANDLER, imports))
            jax.ffi.register_ffi_target(
                name, jax.ffi.pycapsule(address), platform="cpu", api_version=1
            )
            _programs[name] = len(code)
    return name


@functools.cache
def _handle() -> int:
    """Return the address of the function that the handlers of all programs call.

    It runs for less than a microsecond beside the kernels, so that optimising it would
    cost more than it gains.
    """
    code = object_code([handle_ir()], HANDLE, host(), is_quick=True)
    imports = {WORKERS: ctypes.addressof(_workers)}
    return load(code, "nhjax_lanes_handle", HANDLE, imports)


def is_quick() -> bool:
    """Tell whether JAX is set to optimise little: programs are wanted early then."""
    return bool(jax.config.read("jax_disable_most_optimizations"))


def _name(*texts: str) -> str:
    digest = hashlib.sha256()
    for part in (*texts, *host(), version()):
        digest.update(part.encode())
        digest.update(b"\0")
    return f"nhjax_lanes_{digest.hexdigest()[:32]}"
