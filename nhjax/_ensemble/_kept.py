"""Statistics that are kept in a folder on the way, and so can be resumed."""

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._files import load, save
from . import _durable as durable
from ._manifest import differences, program, program_difference, statistics_manifest
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
        text = re.sub(r"0x[0-9a-f]+", "0x", repr(reductions))
        self.manifest = statistics_manifest(work, text)
        self.program = program(work, reductions)
        try:
            if self.path.is_dir() and any(self.path.iterdir()):
                self._resume(resume)
            else:
                # The manifest stands for all of it, and so comes last.
                durable.write(self.path / _PROGRAM, self.program.encode())
                durable.write(self.path / _MANIFEST, json.dumps(self.manifest).encode())
        except OSError as error:
            what = f"The folder {str(self.path)!r} cannot be used"
            raise durable.told(error, what) from error

    def _resume(self, resume: bool) -> None:
        where = f"The folder {str(self.path)!r}"
        manifest, own = self.path / _MANIFEST, {_PROGRAM, f".{_PROGRAM}.unfinished"}
        own.add(f".{_MANIFEST}.unfinished")
        if {x.name for x in self.path.iterdir()} <= own:
            # Interrupted before anything was run.
            durable.write(self.path / _PROGRAM, self.program.encode())
            durable.write(manifest, json.dumps(self.manifest).encode())
            return
        if not resume:
            raise FileExistsError(
                f"{where} exists: go on with it by `resume=True`, or name another one."
            )
        for name in (_MANIFEST, _PROGRAM):
            if not (self.path / name).is_file():
                raise ValueError(
                    f"{where} has no {name!r}: it was not made by "
                    "`nhjax.ensemble(reduce=...)`, or is damaged. Name another folder, "
                    "or put the file back."
                )
        try:
            old = json.loads(manifest.read_text())
        except ValueError as error:
            text = f"{where} has a damaged {_MANIFEST!r}: {error}."
            raise ValueError(text) from error
        kept: dict[str, Any] = {}
        if (self.path / _STATE).is_file():
            kept = load(self.path / _STATE)
            self.done = kept["chunks"]
        found = differences(old, self.manifest, self.done == self.work.chunks)
        if not found:
            before = (self.path / _PROGRAM).read_text()
            found = program_difference(before, self.program)
        if found:
            raise ValueError(
                f"{where} is that of another run. What differs: {'; '.join(found)}. "
                "Call with the same arguments, or name another folder."
            )
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
        try:
            save(
                self.path / _STATE,
                {"chunks": chunk + 1, "failed": rows, "state": leaves},
            )
        except OSError as error:
            what = (
                f"The state after chunk {chunk} could not be written to "
                f"{str(self.path)!r}; the one before is kept, and the same call goes "
                "on once this is mended"
            )
            raise durable.told(error, what) from error

    def outcome(self) -> EnsembleOutcome:
        """Finish the statistics."""
        made = super().outcome()
        return self.failed.outcome(
            made.num_members, statistics=made.statistics, path=self.given
        )
