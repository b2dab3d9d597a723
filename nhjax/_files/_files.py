import importlib.metadata
import os
import shutil
import uuid
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from .._errors import DTypeError
from ._format import as_text, described, from_text, rebuilt


# Raise it when files are written that earlier releases cannot read.
VERSION = 1
_HEADER = "nhjax"


# Names under which another program would look for something else, and what writes it.
_XARRAY = "`sol.to_xarray()` and the methods of its result"
_OTHER_FORMATS = {
    **dict.fromkeys((".nc", ".nc4", ".h5", ".hdf5", ".zarr"), _XARRAY),
    ".csv": "`sol.to_xarray().to_dataframe().to_csv(path)`",
    ".npy": "`numpy.save` for a single array",
    ".mat": "`scipy.io.savemat` for arrays",
    **dict.fromkeys((".pkl", ".pickle"), "`pickle` for objects of Python"),
}


def save(path: str | os.PathLike[str], tree: Any) -> None:
    """Write a state, a solution or a checkpoint to a file, to be read by `load`.

    The file is one of NumPy's, an .npz without pickled objects: each array is there
    under its path in the tree, such as `ys.q`, to the last bit, and `numpy.load` reads
    it too. A header in JSON, the entry `nhjax`, has the version of the format and of
    nhjax, and the structure of the tree by the names of classes and fields. No code is
    stored, so that files do not depend on the versions of Python, JAX and equinox.

    The file is written beside the old one of that name, if any, and then takes its
    place: what interrupts this leaves the old one whole.

    **Arguments:**

    - `path`: the name of the file, taken as it is; .npz is customary.
    - `tree`: an `nhjax.State`, `nhjax.Solution` (without dense output) or
        `nhjax.Checkpoint`, or tuples, lists and dictionaries of these, of arrays,
        numbers and strings.

    **Raises:** `TypeError` with the place of what cannot be saved, such as the dense
    output of a run, which holds functions; `FileNotFoundError` if the folder does not
    exist, `IsADirectoryError` if `path` is one itself; `ValueError` for a name of
        another format, such as one that ends in .nc.

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
    # A link stays one, to the new file.
    path = Path(path).resolve()
    other = _OTHER_FORMATS.get(path.suffix.lower())
    if other is not None:
        raise ValueError(
            f"{path.name!r} would be a file of NumPy's (.npz) under the name of "
            f"another format: use {other}, or a name that ends in .npz."
        )
    if path.is_dir():
        raise IsADirectoryError(
            f"{str(path)!r} is a folder: give the name of a file in it."
        )
    if not path.parent.is_dir():
        raise FileNotFoundError(
            f"There is no folder {str(path.parent)!r} to save {path.name!r} in: make "
            "it first."
        )
    arrays: dict[str, np.ndarray] = {}
    header = {
        "format": VERSION,
        "nhjax": installed_version(),
        "tree": described(tree, arrays),
    }
    unfinished = path.with_name(f".{uuid.uuid4().hex}")
    try:
        # Not by `tempfile`, whose files only their owner may read.
        with open(unfinished, "xb") as file:
            entries: dict[str, Any] = {_HEADER: as_text(header), **arrays}
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
    """Read what `save` has written to a file.

    **Arguments:**

    - `path`: the name of the file.

    **Returns:** the tree that was saved, with the same bits; its arrays are those of
    JAX.

    **Raises:** `FileNotFoundError` if there is no such file, `IsADirectoryError` if it
    is a folder; `ValueError` if it is not
    one that `save` has written, is damaged, or was written by a later release in a
    format that this one does not know; `DTypeError` if it holds float64 and JAX is not
    set to it, rather than to round.

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
        raise FileNotFoundError(f"There is no file {str(path)!r}.")
    try:
        header, arrays = _read(path)
    except (PermissionError, MemoryError):
        raise
    # Whatever else goes wrong, in unpacking or in what was unpacked.
    except Exception as error:
        raise ValueError(
            f"{str(path)!r} is no file of `nhjax.save`, or is damaged: {error}"
        ) from error
    if header["format"] > VERSION:
        raise ValueError(
            f"{str(path)!r} was written by nhjax {header['nhjax']} in format "
            f"{header['format']}, but this release reads formats up to {VERSION}: use "
            "a newer one."
        )
    try:
        return rebuilt(header["tree"], arrays)
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
    """Return the release of nhjax; `"unknown"` for sources that are not installed."""
    try:
        return importlib.metadata.version("nhjax")
    except importlib.metadata.PackageNotFoundError:
        # It is used from its sources, without having been installed.
        return "unknown"


def _read(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read all entries; those of a damaged file fail by their check sums."""
    # What NumPy opens itself stays open if it is damaged.
    with open(path, "rb") as opened:
        # NumPy would take it for pickled objects, and advise to load these.
        if not zipfile.is_zipfile(opened):
            raise ValueError("it is no .npz")
        opened.seek(0)
        file = np.load(opened, allow_pickle=False)
        with file:
            if _HEADER not in file:
                raise ValueError(f"it has no entry {_HEADER!r}")
            arrays = {name: file[name] for name in file.files}
    return from_text(arrays.pop(_HEADER)), arrays
