"""Names of compiled programs, under which XLA finds their handlers.

A program's name is made of its content, its machine's, the compiler's version and how
it optimises: equal programs share a name, in all processes. XLA keeps names for as long
as the process runs, and an executable may call them at any time. For this reason
neither code nor name is ever given up: each program costs its code, some 20 to 150 KB,
and `held` tells how much that is in all. What is compiled once per process is not
compiled again.

Executables that JAX keeps on disk call programs by these names too. JAX lowers a
program before it looks for its executable, and lowering registers the name, so that it
is there when the executable is loaded. One that is loaded by other ways, in a process
that has not registered the name, is refused by XLA.
"""

import ctypes
import functools
import hashlib
import os
import threading
from typing import NamedTuple

import jax
import jax.ffi

from ._handler import HANDLE, handle_ir, HANDLER, handler_ir
from ._native import host, load, object_code, version
from ._pool import WORKERS


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


class Held(NamedTuple):
    """How much is kept until the process ends: programs, and bytes of their code."""

    programs: int
    bytes: int


def held() -> Held:
    """Return how many programs have been compiled, and the size of their code."""
    with _lock:
        return Held(len(_programs), sum(_programs.values()))


def registered(
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
