"""Statistics that are kept in a folder on the way, and so can be resumed."""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._files import load, save
from . import _durable as durable
from ._manifest import check_resumable, check_same_run, program, statistics_manifest
from ._outcome import EnsembleOutcome
from ._program import spread
from ._sinks import Reduced, Work


_MANIFEST, _PROGRAM, _STATE = "manifest.json", "program.txt", "state.npz"


class Kept(Reduced):
    """The states of reductions, written to a folder after each chunk.

    The state, the failures and the number of chunks in it are one file, which is
    replaced in one operation.
    """

    def __init__(
        self, work: Work, reductions: Any, path: str | os.PathLike[str], resume: bool
    ):
        super().__init__(work, reductions)
        self.given, self.path, self.done = path, Path(path).resolve(), 0
        self.manifest = statistics_manifest(work, reductions)
        self.program = program(work, reductions)
        with durable.telling(f"The folder {str(self.path)!r} cannot be used"):
            if self.path.is_dir() and any(self.path.iterdir()):
                self._resume(resume)
            else:
                self._create()

    def _create(self) -> None:
        # The manifest stands for all of it, and so comes last.
        durable.write(self.path / _PROGRAM, self.program.encode())
        durable.write(self.path / _MANIFEST, json.dumps(self.manifest).encode())

    def _resume(self, resume: bool) -> None:
        where = f"The folder {str(self.path)!r}"
        own = {_PROGRAM, f".{_PROGRAM}.unfinished", f".{_MANIFEST}.unfinished"}
        if {x.name for x in self.path.iterdir()} <= own:
            # Interrupted before anything was run.
            self._create()
            return
        names, maker = (_MANIFEST, _PROGRAM), "nhjax.ensemble(reduce=...)"
        check_resumable(where, self.path, names, maker, resume)
        try:
            old = json.loads((self.path / _MANIFEST).read_text())
        except ValueError as error:
            text = f"{where} has a damaged {_MANIFEST!r}: {error}."
            raise ValueError(text) from error
        kept: dict[str, Any] = {}
        if (self.path / _STATE).is_file():
            kept = load(self.path / _STATE)
            self.done = kept["chunks"]
        programs = (self.path / _PROGRAM).read_text(), self.program
        is_done = self.done == self.work.chunks
        check_same_run(where, old, self.manifest, programs, is_done)
        if self.done:
            structure = jax.tree.structure(self.state)
            state = jax.tree.unflatten(structure, kept["state"])
            self.state = jax.device_put(state, spread(self.work.layout, jax.P()))
            self.failed.add(np.asarray(kept["failed"]).tolist())

    def todo(self) -> Iterable[int]:
        """Return the chunks that are not in the state yet."""
        return range(self.done, self.work.chunks)

    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Write the state after a chunk."""
        super().take(chunk, content, failed)
        leaves = [np.asarray(x) for x in jax.tree.leaves(content)]
        rows = np.array(self.failed.rows, np.int64).reshape(-1, 3)
        what = (
            f"The state after chunk {chunk} could not be written to "
            f"{str(self.path)!r}; the one before is kept, and the same call goes "
            "on once this is mended"
        )
        with durable.telling(what):
            save(
                self.path / _STATE,
                {"chunks": chunk + 1, "failed": rows, "state": leaves},
            )

    def outcome(self) -> EnsembleOutcome:
        """Finish the statistics."""
        made = super().outcome()
        return self.failed.outcome(
            made.num_members, statistics=made.statistics, path=self.given
        )
