"""A stand-in for XLA's runtime that calls handlers, built from XLA's header.

The structures are read from `xla/ffi/api/c_api.h` and laid out by ctypes, as the
platform's C compiler does. nhjax's own description of them is not used.
"""

import ctypes
import re
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np


_PLAIN = {"size_t": ctypes.c_size_t, "int64_t": ctypes.c_int64, "int": ctypes.c_int32}
_HANDLER = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p)
TASK = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


def _read_structs() -> dict[str, type[ctypes.Structure]]:
    text = Path(jax.ffi.include_dir(), "xla/ffi/api/c_api.h").read_text("utf-8")
    text = re.sub(r"//[^\n]*", "", text)
    structs: dict[str, type[ctypes.Structure]] = {}
    for name, body in re.findall(r"struct (XLA_FFI_\w+) \{(.*?)\n\}", text, re.DOTALL):
        fields = [_field(line, structs) for line in body.split(";") if line.strip()]
        structs[name] = type(name, (ctypes.Structure,), {"_fields_": fields})
    return structs


def _field(line: str, structs: dict[str, type[ctypes.Structure]]) -> tuple[str, type]:
    line = " ".join(line.split())
    function = re.fullmatch(r"_XLA_FFI_API_STRUCT_FIELD\((\w+)\)|.*\(\*(\w+)\).*", line)
    if function:
        return function[1] or function[2], ctypes.c_void_p
    kind, name = line.rsplit(" ", 1)
    if "*" in kind:
        return name, ctypes.c_void_p
    # A type that is neither plain nor a structure is an enumeration or a bit set.
    return name, structs.get(kind) or _PLAIN.get(kind, ctypes.c_int32)


STRUCTS = _read_structs()


def _make(name: str, **values: object) -> ctypes.Structure:
    struct = STRUCTS[name]()
    struct.struct_size = ctypes.sizeof(struct)
    for field, value in values.items():
        setattr(struct, field, value)
    return struct


def _at(name: str, address: int) -> ctypes.Structure:
    return STRUCTS[name].from_address(address)


class Runtime:
    """A runtime whose thread pool does what a test prescribes.

    **Arguments:**

    - `threads`: the reported size of its pool; if None, it has no pool.
    - `schedule`: receives a task, which is a function without arguments, and returns
        whether the pool has accepted it. By default tasks are stored in `tasks`.
    """

    def __init__(
        self,
        threads: int | None = 4,
        schedule: Callable[[Callable[[], None]], bool] | None = None,
    ):
        self.threads = threads
        self.schedule = schedule or self.keep
        self.tasks: list[Callable[[], None]] = []
        # The number of offered tasks, the live errors, and the messages of all errors.
        self.offers = 0
        self.errors: set[int] = set()
        self.messages: dict[int, tuple[int, str]] = {}
        functions = {
            "XLA_FFI_Error_Create": self._create,
            "XLA_FFI_Error_Destroy": self._destroy,
            "XLA_FFI_ThreadPool_Schedule": self._schedule,
            "XLA_FFI_ThreadPool_NumThreads": self._num_threads,
        }
        self._functions = {name: _HANDLER(f) for name, f in functions.items()}
        self.api = _make(
            "XLA_FFI_Api",
            **{
                name: ctypes.cast(f, ctypes.c_void_p)
                for name, f in self._functions.items()
            },
        )

    def keep(self, task: Callable[[], None]) -> bool:
        """Accept a task, which the test will run."""
        self.tasks.append(task)
        return True

    def run_tasks(self) -> None:
        """Run the stored tasks."""
        while self.tasks:
            self.tasks.pop()()

    def _error(self, code: int, message: str) -> int:
        error = 4096 + len(self.messages)
        self.errors.add(error)
        self.messages[error] = code, message
        return error

    def _create(self, args: int) -> int:
        made = _at("XLA_FFI_Error_Create_Args", args)
        return self._error(made.errc, ctypes.string_at(made.message).decode())

    def _destroy(self, args: int) -> None:
        self.errors.remove(_at("XLA_FFI_Error_Destroy_Args", args).error)

    def _schedule(self, args: int) -> int | None:
        asked = _at("XLA_FFI_ThreadPool_Schedule_Args", args)
        task, data = TASK(asked.task), asked.data
        self.offers += 1
        if self.threads is None or not self.schedule(lambda: task(data)):
            return self._error(14, "no pool")
        return None

    def _num_threads(self, args: int) -> int | None:
        if self.threads is None:
            return self._error(14, "no pool")
        asked = _at("XLA_FFI_ThreadPool_NumThreads_Args", args)
        ctypes.c_int64.from_address(asked.num_threads).value = self.threads
        return None

    def call(
        self, handler: int, operands: list[np.ndarray], results: list[np.ndarray]
    ) -> int | None:
        """Call a handler, and return the address of its error, if there is one."""
        kept: list[object] = []
        frame = _make("XLA_FFI_CallFrame", api=ctypes.addressof(self.api))
        for part, arrays in (("args", operands), ("rets", results)):
            buffers = [_buffer(array, kept) for array in arrays]
            pointers = (ctypes.c_void_p * len(buffers))(*map(ctypes.addressof, buffers))
            kept += [buffers, pointers]
            whole = getattr(frame, part)
            whole.size = len(arrays)
            setattr(whole, part, ctypes.addressof(pointers))
        return _HANDLER(handler)(ctypes.addressof(frame))

    def metadata(self, handler: int) -> ctypes.Structure:
        """Ask a handler for its metadata."""
        metadata = _make("XLA_FFI_Metadata", traits=7)
        asked = STRUCTS["XLA_FFI_Metadata_Extension"]()
        asked.extension_base.struct_size = ctypes.sizeof(asked)
        asked.extension_base.type = 1
        asked.metadata = ctypes.addressof(metadata)
        frame = _make("XLA_FFI_CallFrame", extension_start=ctypes.addressof(asked))
        assert _HANDLER(handler)(ctypes.addressof(frame)) is None
        return metadata


def _buffer(array: np.ndarray, kept: list[object]) -> ctypes.Structure:
    dims = (ctypes.c_int64 * max(array.ndim, 1))(*array.shape)
    kept.append(dims)
    # XLA has no address for an array without elements.
    data = array.ctypes.data if array.size else None
    return _make(
        "XLA_FFI_Buffer", data=data, rank=array.ndim, dims=ctypes.addressof(dims)
    )
