"""Statistics that are kept in a folder on the way, and so can be resumed."""

import json
import os
import re
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._files import load, save
from . import _durable as durable
from ._lock import Lock
from ._manifest import (
    call_of,
    check_resumable,
    check_same_run,
    program,
    statistics_manifest,
)
from ._outcome import EnsembleOutcome
from ._reduced import Reduced
from ._sinks import Work


_MANIFEST, _PROGRAM, _STATE = "manifest.json", "program.txt", "state.npz"
_LOCK = "lock"


class Kept(Reduced):
    """The states of reductions, written to a folder after each round of chunks.

    The state, the failures and the number of chunks in it are one file, which process 0
    replaces in one operation.
    """

    def __init__(
        self, work: Work, reductions: Any, path: str | os.PathLike[str], resume: bool
    ):
        super().__init__(work, reductions, in_rounds=True)
        self.given, self.path = path, Path(path).resolve()
        self.where = f"The folder {str(self.path)!r}"
        self.lock = Lock()
        self.manifest = statistics_manifest(work, reductions)
        self.program = program(work, reductions)
        work.processes.agree(call_of(self.manifest, self.program, out=True))
        content = b""
        try:
            if work.processes.index == 0:
                with durable.explaining(f"{self.where} cannot be used"):
                    self._begin(resume)
                number = np.int64(self.first).tobytes()
                content = number + self._packed(self.state, self.failed)
            content = work.processes.of_first(content)
        except BaseException:
            self.close()
            raise
        self.first = int(np.frombuffer(content, np.int64, 1)[0])
        if self.first:
            state, self.failed = self._unpacked(content[8:])
            self.state = self._placed(state)

    def _begin(self, resume: bool) -> None:
        """Make or open the folder, and read the state in it."""
        own = {_LOCK, _PROGRAM, f".{_PROGRAM}.unfinished", f".{_MANIFEST}.unfinished"}
        self.path.mkdir(parents=True, exist_ok=True)
        # A run that was interrupted before anything was run leaves no more than these.
        is_new = {x.name for x in self.path.iterdir()} <= own
        if not is_new:
            names, maker = (_MANIFEST, _PROGRAM), "nhjax.ensemble(reduce=...)"
            check_resumable(self.where, self.path, names, maker, resume)
        self.lock.take(self.path / _LOCK, self.where)
        if is_new:
            # The manifest stands for all of it, and so comes last.
            durable.write(self.path / _PROGRAM, self.program.encode())
            durable.write(self.path / _MANIFEST, json.dumps(self.manifest).encode())
        else:
            self._resume()

    def _resume(self) -> None:
        for path in self.path.glob(".*"):
            # What a kill in the midst of `save` has left.
            if re.fullmatch("[.][0-9a-f]{32}", path.name):
                path.unlink()
        try:
            old = json.loads((self.path / _MANIFEST).read_text())
        except ValueError as error:
            text = f"{self.where} has a damaged {_MANIFEST!r}: {error}."
            raise ValueError(text) from error
        kept: dict[str, Any] = {}
        if (self.path / _STATE).is_file():
            kept = load(self.path / _STATE)
            self.first = kept["chunks"]
        programs = (self.path / _PROGRAM).read_text(), self.program
        is_done = self.first == self.work.chunks
        check_same_run(self.where, old, self.manifest, programs, is_done)
        if self.first:
            structure = jax.tree.structure(self.state)
            self.state = jax.tree.unflatten(structure, kept["state"])
            self.failed.add(np.asarray(kept["failed"]).tolist())

    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Write the state after a chunk, or after a round of them."""
        super().take(chunk, content, failed)
        processes = self.work.processes
        if processes.index > 0:
            return
        done = min(chunk + processes.count, self.work.chunks)
        leaves = [np.asarray(x) for x in jax.tree.leaves(self.state)]
        rows = np.array(self.failed.rows, np.int64).reshape(-1, 3)
        what = (
            f"The state after {done} chunks could not be written to "
            f"{str(self.path)!r}; the one before is kept, and the same call goes "
            "on once this is mended"
        )
        with durable.explaining(what):
            save(
                self.path / _STATE,
                {"chunks": done, "failed": rows, "state": leaves},
            )

    def outcome(self) -> EnsembleOutcome:
        """Return the outcome of the ensemble, with its finished statistics."""
        made = super().outcome()
        return self.failed.outcome(
            made.num_members, statistics=made.statistics, path=self.given
        )

    def close(self) -> None:
        """Let others write to the folder."""
        self.lock.release()
