"""Stores of Zarr, as the files that they are made of."""

import json
import warnings
from typing import Any

import numpy as np


def _zarr() -> Any:
    try:
        import zarr
    except ImportError as error:
        raise ImportError(
            "`nhjax.ensemble(out=...)` needs zarr 3, an optional dependency: "
            '`pip install "nhjax[ensemble]"`.'
        ) from error
    return zarr


class Files:
    """A store in memory, which makes the content of files and never keeps chunks.

    What is written to disk, and when, is decided elsewhere.
    """

    def __init__(self):
        zarr = _zarr()
        self._content: dict[str, Any] = {}
        self._store = zarr.storage.MemoryStore(self._content)
        self._arrays: dict[str, Any] = {}
        self._zarr = zarr

    def open(
        self,
        variables: dict[str, tuple[tuple[str, ...], tuple[int, ...], Any]],
        chunk_size: int,
        attributes: dict[str, dict[str, Any]],
        manifest: dict[str, Any],
    ) -> None:
        """Make the arrays, each given as (dims, shape, dtype).

        Chunks span `chunk_size` rows and all of the other axes.
        """
        group = self._zarr.create_group(store=self._store, zarr_format=3)
        group.create_group("manifest", attributes=manifest)
        for name, (dims, shape, dtype) in variables.items():
            rows = chunk_size if dims[0] == "trajectory" else shape[0]
            self._arrays[name] = group.create_array(
                name,
                shape=shape,
                dtype=dtype,
                # An axis may be empty, and a chunk may not.
                chunks=(rows, *(max(1, size) for size in shape[1:])),
                dimension_names=dims,
                attributes=attributes.get(name, {}),
                fill_value=np.zeros((), dtype).item(),
                config={"write_empty_chunks": True},
            )
        with warnings.catch_warnings():
            # Zarr warns that version 3 does not describe it; xarray warns without it.
            warnings.simplefilter("ignore")
            self._zarr.consolidate_metadata(self._store)

    def metadata(self) -> dict[str, bytes]:
        """Return the files that describe the store, by name.

        Zarr lists arrays in the order in which it comes across them, which may be any.
        """
        return {
            name: json.dumps(
                json.loads(x.to_bytes()), sort_keys=True, indent=1
            ).encode()
            for name, x in self._content.items()
            if name.endswith("zarr.json")
        }

    def chunk(self, name: str, start: int, rows: np.ndarray) -> dict[str, bytes]:
        """Return the files of the chunk of an array that begins at a row, by name."""
        self._arrays[name][start : start + len(rows)] = rows
        made = [key for key in self._content if not key.endswith("zarr.json")]
        return {key: self._content.pop(key).to_bytes() for key in sorted(made)}
