"""The cache of native code on disk, and the keys of its entries.

The key of a program is a hash of everything that its code depends on: the jaxpr with
its constants, the options of compilation, the machine, and the versions of this
compiler, of LLVM, of JAX and of NumPy. The graph of the program is not needed for the
key, so that computing the key takes much less time than compilation. If a parameter of
an operation has a type that is not known here, such as a Python function, the program
gets no key, and is compiled in each process.

The cache follows JAX's options for its persistent compilation cache. It is a folder in
JAX's directory, with one file for each program. A file contains a checksum, the key,
the program's name for XLA and its code. Each file is written under another name first,
so that other processes never read an incomplete file.
"""

import dataclasses
import enum
import hashlib
import os
import uuid
import warnings
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.core
import jax.extend
import numpy as np

from ._builder import called_program, CALLS, sizes_of_scan
from ._native import host, version


# The name of the folder in JAX's directory. The names of JAX's own files end in
# "-cache" or "-atime".
FOLDER = "nhjax_lanes"
_SUFFIX = ".object"
_MAGIC = b"nhjax lanes 1\n"
_DIGEST = 32


class Entry(NamedTuple):
    """The code of a program: its name for XLA, and its object file."""

    name: str
    code: bytes


def _option(name: str) -> Any:
    return getattr(jax.config, name)


def directory() -> Path | None:
    """Return the folder of the cache, or `None` if JAX's options switch it off.

    A directory that is not a folder of this machine, such as `gs://...`, is not used.
    """
    root = _option("jax_compilation_cache_dir")
    if not root or not _option("jax_enable_compilation_cache"):
        return None
    return None if "://" in str(root) else Path(root) / FOLDER


def read(folder: Path, key: str) -> Entry | None:
    """Return the entry of a key, or `None` if its file is missing or damaged."""
    path = folder / f"{key}{_SUFFIX}"
    try:
        data = path.read_bytes()
        entry = _unpacked(data, key)
        if entry is not None:
            # The least recently used files are deleted first, so mark this file as
            # used.
            os.utime(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        _report(f"could not read {path}", error)
        return None
    return entry


def write(folder: Path, key: str, entry: Entry, seconds: float) -> None:
    """Store the entry of a program that compiled in `seconds`, if JAX's options permit.

    JAX does not store programs that compile quickly or are small, and limits the size
    of its cache. The same limits apply here.
    """
    shortest = _option("jax_persistent_cache_min_compile_time_secs")
    smallest = _option("jax_persistent_cache_min_entry_size_bytes")
    if seconds < shortest or len(entry.code) < smallest:
        return
    path = folder / f"{key}{_SUFFIX}"
    temporary = folder / f"{uuid.uuid4().hex}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            temporary.write_bytes(_packed(entry, key))
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)
        _shrink(folder, _option("jax_compilation_cache_max_size"))
    except OSError as error:
        _report(f"could not write {path}", error)


def _packed(entry: Entry, key: str) -> bytes:
    body = b"\n".join([key.encode(), entry.name.encode(), entry.code])
    return _MAGIC + hashlib.sha256(body).digest() + body


def _unpacked(data: bytes, key: str) -> Entry | None:
    start = len(_MAGIC) + _DIGEST
    digest, body = data[len(_MAGIC) : start], data[start:]
    if not data.startswith(_MAGIC) or hashlib.sha256(body).digest() != digest:
        return None
    found, name, code = body.split(b"\n", 2)
    return Entry(name.decode(), code) if found == key.encode() else None


def _shrink(folder: Path, most: int) -> None:
    """Delete the least recently used files until at most `most` bytes are left.

    A negative number means that there is no limit.
    """
    if most < 0:
        return
    files = []
    for path in folder.glob(f"*{_SUFFIX}"):
        try:
            files.append((path.stat(), path))
        except FileNotFoundError:
            # Another process has deleted the file.
            continue
    total = sum(stat.st_size for stat, _ in files)
    for stat, path in sorted(files, key=lambda pair: pair[0].st_mtime_ns):
        if total <= most:
            return
        path.unlink(missing_ok=True)
        total -= stat.st_size


def _report(what: str, error: OSError) -> None:
    if _option("jax_raise_persistent_cache_errors"):
        raise error
    warnings.warn(f"The cache of native code {what}: {error}", stacklevel=2)


# Keys


def program_key(program: Any, *options: Any) -> str | None:
    """Return the key of a closed jaxpr that is compiled with these options.

    Programs with equal keys are compiled to the same code. The result is `None` if the
    program has a part that cannot be compared.
    """
    try:
        parts = (_Encoder().closed(program), options, _environment())
    except _Unknown:
        return None
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def _hash_of_sources() -> str:
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        data = path.read_bytes()
        digest.update(f"{path.name} {len(data)}\n".encode())
        digest.update(data)
    return digest.hexdigest()


# A hash of the sources of this compiler at the time of its import: the files may change
# later.
_SOURCES = _hash_of_sources()


@lru_cache(maxsize=1)
def _environment() -> tuple[str, ...]:
    """Return everything that code depends on besides its program and its options."""
    return _SOURCES, *host(), version(), jax.__version__, np.__version__


class _Unknown(Exception):
    """A value that cannot be compared by its contents."""


# Parameters that describe the devices of arrays. The code does not depend on them.
_DEVICES = ("sharding", "out_sharding")
_PLAIN = frozenset((int, bool, str, bytes, type(None)))


class _Encoder:
    """Translates jaxprs to tuples of plain values, whose `repr` identifies the jaxpr.

    The names of variables do not count. Inner programs are replaced by their hashes,
    since an inner program may occur several times.
    """

    def __init__(self):
        # The objects are stored too, so that no other objects get the same ids.
        self._jaxprs: dict[int, tuple[Any, str]] = {}
        self._avals: dict[int, tuple[Any, Any]] = {}

    def closed(self, program: Any) -> tuple[Any, ...]:
        """Encode a closed jaxpr, with its constants."""
        return self.jaxpr(program.jaxpr), *map(self.value, program.consts)

    def jaxpr(self, jaxpr: Any) -> str:
        """Return the hash of a jaxpr without its constants."""
        known = self._jaxprs.get(id(jaxpr))
        if known is None:
            digest = hashlib.sha256(repr(self._contents(jaxpr)).encode()).hexdigest()
            known = self._jaxprs[id(jaxpr)] = jaxpr, digest
        return known[1]

    def _contents(self, jaxpr: Any) -> list[Any]:
        if jaxpr.effects:
            raise _Unknown
        # Variables are numbered in the order in which they are defined.
        numbers: dict[Any, int] = {}

        def operand(variable: Any) -> Any:
            if isinstance(variable, jax.extend.core.Literal):
                return self.value(np.asarray(variable.val)), self.aval(variable.aval)
            return numbers[variable]

        def defined(variables: list[Any]) -> list[Any]:
            for variable in variables:
                numbers[variable] = len(numbers)
            return [self.aval(variable.aval) for variable in variables]

        contents: list[Any] = [defined(jaxpr.constvars), defined(jaxpr.invars)]
        for equation in jaxpr.eqns:
            operands = [operand(variable) for variable in equation.invars]
            parameters = self._parameters(equation)
            results = defined(equation.outvars)
            contents.append((equation.primitive.name, operands, parameters, results))
        contents.append([operand(variable) for variable in jaxpr.outvars])
        return contents

    def _parameters(self, equation: Any) -> Any:
        """Encode the parameters that the code of an equation depends on."""
        name, params = equation.primitive.name, equation.params
        if name in CALLS:
            # The other parameters are rules for derivatives, and hints for XLA.
            return self.value(called_program(equation))
        if name == "scan":
            parts = (params["jaxpr"], params["length"], params["reverse"])
            return self.value((*parts, *sizes_of_scan(params)))
        return self._items({k: v for k, v in params.items() if k not in _DEVICES})

    def aval(self, aval: Any) -> Any:
        """Encode the type of an array."""
        known = self._avals.get(id(aval))
        if known is None:
            if not isinstance(aval, jax.core.ShapedArray):
                raise _Unknown
            code = self.value(aval.shape), str(aval.dtype), aval.weak_type
            known = self._avals[id(aval)] = aval, code
        return known[1]

    def _items(self, mapping: Mapping[Any, Any]) -> list[Any]:
        keys = sorted(mapping, key=repr)
        return [(self.value(key), self.value(mapping[key])) for key in keys]

    def value(self, value: Any) -> Any:
        """Encode a parameter or a constant, or raise `_Unknown`."""
        kind = type(value)
        if kind in _PLAIN:
            return value
        if kind is tuple:
            return tuple(map(self.value, value))
        if kind is list:
            return list(map(self.value, value))
        if kind is float:
            return "float", value.hex()
        if isinstance(value, np.dtype):
            return "dtype", str(value)
        if isinstance(value, type) and issubclass(value, np.generic):
            return "dtype", str(np.dtype(value))
        if isinstance(value, jax.core.Tracer):
            raise _Unknown
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return self._array(value)
        if isinstance(value, jax.extend.core.ClosedJaxpr):
            return "program", self.closed(value)
        if isinstance(value, jax.extend.core.Jaxpr):
            return "jaxpr", self.jaxpr(value)
        name = f"{kind.__module__}.{kind.__qualname__}"
        if isinstance(value, enum.Enum):
            return name, value.name
        if isinstance(value, tuple):
            # `value` is a named tuple.
            return name, list(map(self.value, value))
        if isinstance(value, Mapping):
            return name, self._items(value)
        if dataclasses.is_dataclass(value):
            fields = [field.name for field in dataclasses.fields(value)]
            return name, [self.value(getattr(value, field)) for field in fields]
        raise _Unknown

    def _array(self, value: Any) -> Any:
        try:
            array = np.asarray(value)
        except (TypeError, RuntimeError) as error:
            # `value` is, for example, an array of random keys.
            raise _Unknown from error
        if array.dtype.hasobject:
            raise _Unknown
        data: bytes | str = array.tobytes()
        if len(data) > _DIGEST:
            data = hashlib.sha256(data).hexdigest()
        return "array", array.dtype.str, array.shape, data
