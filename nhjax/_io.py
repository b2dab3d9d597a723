"""The functions `save` and `load`, which write and read states and solutions.

A file is an .npz of NumPy without pickled objects. It has one entry for each array of
the saved tree, and the entry `nhjax`, a JSON header that describes the structure of the
tree by the names of classes and fields. No code is stored.
"""

import dataclasses
import importlib.metadata
import json
import math
import os
import reprlib
import shutil
import uuid
import zipfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ._errors import DTypeError, is_traced
from ._integrate import Checkpoint, DenseInterpolation, EventLog, Solution
from ._results import result_codes, RESULTS
from ._system import State


# The version of the file format. Increase it after a change that makes new files
# unreadable for earlier releases.
_VERSION = 1
_HEADER = "nhjax"

# The suffixes of formats that `save` does not write, and the functions that do.
_XARRAY = "`sol.to_xarray()` and the methods of its result"
_OTHER_FORMATS = {
    **dict.fromkeys((".nc", ".nc4", ".h5", ".hdf5", ".zarr"), _XARRAY),
    ".csv": "`sol.to_xarray().to_dataframe().to_csv(path)`",
    ".npy": "`numpy.save` for a single array",
    ".mat": "`scipy.io.savemat` for arrays",
    **dict.fromkeys((".pkl", ".pickle"), "`pickle` for Python objects"),
}
# The classes that a file may contain. They are stored by fields, so that a later
# release can add fields with defaults.
_CLASSES: dict[str, type] = {
    kind.__name__: kind for kind in (State, Solution, Checkpoint, EventLog)
}


def save(path: str | os.PathLike[str], tree: Any) -> None:
    """Write a state, a solution or a checkpoint to a file that `load` reads.

    The file is an .npz of NumPy without pickled objects. `numpy.load` reads it too:
    each array has its path in the tree as its name, such as `ys.q`, and is stored bit
    for bit. The entry `nhjax` is a JSON header with the versions of the format and of
    nhjax, and the structure of the tree by the names of classes and fields. No code is
    stored, so that files do not depend on the versions of Python, JAX and equinox.

    The file is written under a temporary name and then renamed. If `save` is
    interrupted, an existing file at `path` is not changed.

    **Arguments:**

    - `path`: the name of the file, used without change; .npz is the usual suffix.
    - `tree`: an `nhjax.State`, `nhjax.Solution` (without dense output) or
        `nhjax.Checkpoint`, or tuples, lists and dictionaries of these and of arrays,
        numbers and strings.

    **Raises:** `TypeError` that names the part that cannot be saved, such as dense
    output, which holds functions; `FileNotFoundError` if the folder does not exist,
    `IsADirectoryError` if `path` is a folder; `ValueError` for the suffix of another
    format, such as .nc.

    !!! example

        >>> import nhjax, pathlib, tempfile
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), dt=0.1, num_steps=50,
        ...     saveat=nhjax.SaveAt(checkpoint=True))
        >>> path = pathlib.Path(tempfile.mkdtemp(), "disc.npz")
        >>> nhjax.save(path, sol.checkpoint)
        >>> int(nhjax.load(path).num_steps)
        50
    """
    _check_path(path, "Call it as `save(path, tree)`.")
    # Write to the target of a symbolic link, so that the link is kept.
    path = Path(path).resolve()
    other = _OTHER_FORMATS.get(path.suffix.lower())
    if other is not None:
        raise ValueError(
            f"{path.name!r} has the suffix of another format, but `nhjax.save` writes "
            f".npz files of NumPy: use {other}, or a name that ends in .npz."
        )
    if path.is_dir():
        raise IsADirectoryError(
            f"{str(path)!r} is a folder: give the name of a file in it."
        )
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"The folder {str(path.parent)!r} for {path.name!r} does not exist: create "
            "it first."
        )
    arrays: dict[str, np.ndarray] = {}
    header = {
        "format": _VERSION,
        "nhjax": installed_version(),
        "tree": _describe(tree, arrays),
    }
    text = json.dumps(header, allow_nan=False).encode("utf-8")
    entries: dict[str, Any] = {_HEADER: np.frombuffer(text, np.uint8), **arrays}
    unfinished = path.with_name(f".{uuid.uuid4().hex}")
    try:
        # `tempfile` is not used: it creates files that only the owner may read.
        with open(unfinished, "xb") as file:
            np.savez(file, **entries)
            file.flush()
            os.fsync(file.fileno())
        if path.exists():
            shutil.copymode(path, unfinished)
        os.replace(unfinished, path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def load(path: str | os.PathLike[str]) -> Any:
    """Read a file that `save` has written.

    **Arguments:**

    - `path`: the name of the file.

    **Returns:** the tree that was saved, bit for bit, with JAX arrays.

    **Raises:** `FileNotFoundError` if the file does not exist, `IsADirectoryError` if
    it is a folder; `ValueError` if `save` has not written it, if it is damaged, or if a
    later release has written it in a format that this release does not know;
    `DTypeError` if JAX would round an array in the file, such as float64 to float32.

    !!! example

        >>> import jax.numpy as jnp, nhjax, pathlib, tempfile
        >>> path = pathlib.Path(tempfile.mkdtemp(), "numbers.npz")
        >>> nhjax.save(path, {"radius": jnp.ones(2), "name": "disc"})
        >>> nhjax.load(path)["name"]
        'disc'
    """
    _check_path(path, "Call it as `load(path)`.")
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(
            f"{str(path)!r} is a folder: give the name of a file that `nhjax.save` has "
            "written. `xarray.open_zarr` opens the store of an ensemble."
        )
    if not path.is_file():
        raise FileNotFoundError(f"The file {str(path)!r} does not exist.")
    try:
        header, arrays = _read(path)
    except (PermissionError, MemoryError):
        raise
    # A damaged file can raise any error when it is decompressed or parsed.
    except Exception as error:
        raise ValueError(
            f"{str(path)!r} is not a file of `nhjax.save`, or is damaged: {error}"
        ) from error
    if header["format"] > _VERSION:
        raise ValueError(
            f"{str(path)!r} was written by nhjax {header['nhjax']} in format "
            f"{header['format']}, but this release reads formats up to {_VERSION}: "
            "install a newer one."
        )
    try:
        return _rebuild(header["tree"], arrays)
    except DTypeError:
        raise
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{str(path)!r}, written by nhjax {header['nhjax']}, cannot be read: "
            f"{error}."
        ) from error


def _check_path(path: object, advice: str) -> None:
    if not isinstance(path, str | os.PathLike):
        raise TypeError(
            "`path` must be the name of a file, got an object of type "
            f"{type(path).__name__}. {advice}"
        )


def installed_version() -> str:
    """Return the release of nhjax, or `"unknown"` if it is not installed."""
    try:
        return importlib.metadata.version("nhjax")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the header and the arrays; checksums of the .npz detect damaged entries."""
    # Open the file here: NumPy does not close a damaged file that it has opened itself.
    with open(path, "rb") as opened:
        # For other formats, NumPy's own error would recommend loading pickled objects.
        if not zipfile.is_zipfile(opened):
            raise ValueError("it is not an .npz")
        opened.seek(0)
        file = np.load(opened, allow_pickle=False)
        with file:
            if _HEADER not in file:
                raise ValueError(f"it has no entry {_HEADER!r}")
            arrays = {name: file[name] for name in file.files}
    header = json.loads(arrays.pop(_HEADER).tobytes().decode("utf-8"))
    kinds = {"format": int, "nhjax": str, "tree": dict}
    if not isinstance(header, dict) or any(
        not isinstance(header.get(name), kind) for name, kind in kinds.items()
    ):
        raise ValueError(f"its header lacks {', '.join(kinds)}")
    return header, arrays


def _describe(tree: Any, arrays: dict[str, np.ndarray], path: str = "") -> Any:
    """Describe a tree as JSON, and add its arrays to `arrays` by name."""
    kind = type(tree).__name__
    where = f"`{path.strip('.')}`" if path else "the tree to save"
    if is_traced(tree):
        raise TypeError(
            f"{where} is traced and has no value yet: call `nhjax.save` outside of "
            "jit, vmap and grad."
        )
    if tree is None or type(tree) in (bool, int, str):
        return {"kind": "value", "value": tree}
    if type(tree) is float:
        # JSON has no infinity and no NaN, so that `_rebuild` reads `text`.
        value = tree if math.isfinite(tree) else None
        return {"kind": "float", "value": value, "text": repr(tree)}
    if isinstance(tree, type(RESULTS.successful)) and tree._enumeration is RESULTS:
        codes = _describe(tree._value, arrays, path)
        return {"kind": "RESULTS", "codes": codes, "names": result_codes()}
    if isinstance(tree, jax.Array | np.ndarray | np.generic):
        return {"kind": "array", "name": _add_array(tree, arrays, path, where)}
    if isinstance(tree, DenseInterpolation):
        raise TypeError(
            f"{where} is the dense output of a run, which holds the functions of the "
            "system; functions cannot be written to a file. Evaluate it and save the "
            "values, or leave it out: `dataclasses.replace(sol, interpolation=None)`."
        )
    if _CLASSES.get(kind) is type(tree):
        items = [(x.name, getattr(tree, x.name)) for x in dataclasses.fields(tree)]
        parts = {name: _describe(x, arrays, f"{path}.{name}") for name, x in items}
        return {"kind": kind, "parts": parts}
    if isinstance(tree, tuple | list) and type(tree) in (tuple, list):
        parts = [_describe(x, arrays, f"{path}[{i}]") for i, x in enumerate(tree)]
        return {"kind": kind, "parts": parts}
    if type(tree) is dict:
        parts = [
            [_check_key(key, where), _describe(x, arrays, f"{path}[{key!r}]")]
            for key, x in tree.items()
        ]
        return {"kind": kind, "parts": parts}
    raise TypeError(
        f"{where} is {reprlib.repr(tree)} of type {kind}, which cannot be saved. A "
        "file holds states, solutions, checkpoints, and tuples, lists and dictionaries "
        "of arrays, numbers and strings."
    )


def _check_key(key: Any, where: str) -> str | int:
    if type(key) in (str, int):
        return key
    raise TypeError(
        f"{where} has the key {key!r} of type {type(key).__name__}, but the keys of a "
        "dictionary in a file must be strings or ints."
    )


def _add_array(x: Any, arrays: dict[str, np.ndarray], path: str, where: str) -> str:
    """Add an array under a unique name, made from its path, and return the name."""
    if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        raise TypeError(f"{where} is a random key: save `jax.random.key_data` of it.")
    array = np.asarray(x)
    if array.dtype.kind not in "biufc":
        raise TypeError(
            f"{where} has dtype {array.dtype}, which the files of NumPy do not "
            "support; convert it to a numeric dtype of NumPy."
        )
    name = path.strip(".") or "array"
    while name in arrays:
        name += "_"
    arrays[name] = array
    return name


def _rebuild(description: Any, arrays: dict[str, np.ndarray]) -> Any:
    """Build the tree of a description."""
    kind = description["kind"]
    if kind == "value":
        return description["value"]
    if kind == "float":
        return float(description["text"])
    if kind == "array":
        return _to_jax(description["name"], arrays[description["name"]])
    if kind == "RESULTS":
        codes = _rebuild(description["codes"], arrays)
        return _rebuild_results(codes, description["names"])
    parts = description["parts"]
    if kind in ("tuple", "list"):
        made = [_rebuild(part, arrays) for part in parts]
        return tuple(made) if kind == "tuple" else made
    if kind == "dict":
        return {key: _rebuild(part, arrays) for key, part in parts}
    if kind not in _CLASSES:
        raise ValueError(
            f"it contains the type {kind!r}, which this release does not know"
        )
    fields = {x.name for x in dataclasses.fields(_CLASSES[kind])}
    unknown = sorted(set(parts) - fields)
    if unknown:
        raise ValueError(
            f"its {kind} has the fields {', '.join(unknown)}, which this release does "
            "not know"
        )
    return _CLASSES[kind](**{name: _rebuild(x, arrays) for name, x in parts.items()})


def _to_jax(name: str, array: np.ndarray) -> Array:
    made = jnp.asarray(array)
    if made.dtype != array.dtype:
        raise DTypeError(
            f"`{name}` has dtype {array.dtype} in the file, but JAX would round it to "
            f'{made.dtype}: run `jax.config.update("jax_enable_x64", True)` first.'
        )
    return made


def _rebuild_results(codes: Array, names: dict[str, int]) -> PyTree[Array]:
    """Find result codes by their names: other releases may use other codes."""
    unknown = sorted(set(names) - set(result_codes()))
    if unknown:
        raise ValueError(
            f"it contains the results {', '.join(unknown)}, which this release does "
            "not know"
        )
    table = np.zeros(max(names.values()) + 1, np.int32)
    for name, code in names.items():
        table[code] = result_codes()[name]
    ours = jnp.asarray(table[np.asarray(codes)])
    return eqx.tree_at(lambda result: result._value, RESULTS.successful, ours)
