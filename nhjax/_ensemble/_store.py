"""Stores of the values of ensembles, which can be resumed."""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from . import _durable as durable
from ._failed import Failed
from ._journal import Journal, Line, NAME as JOURNAL
from ._lock import Lock
from ._manifest import (
    call_of,
    check_resumable,
    check_same_run,
    check_shared,
    manifest,
    program,
)
from ._outcome import EnsembleOutcome
from ._program import Chunk
from ._sinks import AbstractSink, Work
from ._variables import attributes_of, BATCH, common_times, rows_of, variables_of
from ._zarr import Files


_MANIFEST = "manifest/zarr.json"
_PROGRAM = "manifest/program.txt"
_JOURNAL = f"manifest/{JOURNAL}"
_LOCK = "manifest/lock"


class Stored(AbstractSink):
    """The values of members in a store of Zarr, with a journal of finished chunks.

    A chunk counts as done once its files are on the disk and so is its line of the
    journal: its number, its failures, and a checksum of each file. Process 0 makes the
    store and its journal, and all write their own chunks.
    """

    def __init__(
        self,
        work: Work,
        path: str | os.PathLike[str],
        units: Mapping[str, str],
        resume: bool,
    ):
        self.work, self.given, self.path = work, path, Path(path).absolute()
        # The others do not look for it before it is there: NFS would go on to tell
        # them for up to a minute that it is not.
        if work.processes.index == 0:
            self.path = self.path.resolve()
        self.where = f"The store {str(self.path)!r}"
        self.variables = variables_of(work)
        self.attributes = attributes_of(work.structure, self.variables, units)
        self.files, self.lock = Files(), Lock()
        self.manifest = manifest(work, self.variables)
        self.program = program(work)
        call = call_of(self.manifest, self.program, out=True, units=dict(units))
        work.processes.agree(call)
        self._open(self.variables)
        self.journal = Journal(self.path / "manifest", work.processes.index)
        try:
            with durable.explaining(f"{self.where} cannot be used"):
                self.lines = self._begin(resume)
                self._check_files()
        except BaseException:
            self.close()
            raise

    def _open(self, variables: dict[str, Any]) -> None:
        count = self.work.members.count
        arrays = {
            name: (
                dims,
                (count if dims[0] in BATCH else len(x), *x.shape[1:]),
                x.dtype,
            )
            for name, (dims, x) in variables.items()
        }
        self.files.open(arrays, self.work.size, self.attributes, self.manifest)

    def _begin(self, resume: bool) -> dict[int, Line]:
        """Make or open the store, and return the lines of its journal."""
        processes, lines, token = self.work.processes, {}, b""
        if processes.index == 0:
            if self.path.is_dir() and any(self.path.iterdir()):
                lines = self._resume(resume)
            else:
                self._create()
            token = os.urandom(16).hex().encode() if processes.count > 1 else b""
            self.lock.write(token)
        told = json.loads(
            processes.of_first(json.dumps([token.decode(), [*lines.values()]]).encode())
        )
        if processes.index > 0:
            check_shared(self.path / _LOCK, told[0], processes)
            self.journal.open_part()
        # From here on all parts are locked.
        processes.exchange()
        return {line["chunk"]: line for line in told[1]}

    def _create(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise FileExistsError(
                f"{str(self.path)!r} is a file: `out` names a folder."
            )
        unfinished = self.path.with_name(f".{self.path.name}.unfinished")
        (unfinished / _LOCK).parent.mkdir(parents=True, exist_ok=True)
        self.lock.take(unfinished / _LOCK, self.where)
        kept = unfinished / _LOCK
        for left in sorted({*unfinished.rglob("*")} - {kept, kept.parent})[::-1]:
            left.rmdir() if left.is_dir() else left.unlink()
        content = self.files.metadata()
        content |= {_PROGRAM: self.program.encode(), _JOURNAL: b""}
        for name, data in content.items():
            durable.write(unfinished / name, data)
        # The complete store appears under its name in one operation.
        os.replace(unfinished, self.path)
        durable.sync_folder(self.path.parent)

    def _resume(self, resume: bool) -> dict[int, Line]:
        names = _MANIFEST, _PROGRAM, _JOURNAL
        check_resumable(self.where, self.path, names, "nhjax.ensemble", resume)
        self.lock.take(self.path / _LOCK, self.where)
        lines = self.journal.collect()
        try:
            old = json.loads((self.path / _MANIFEST).read_text())["attributes"]
        except (ValueError, KeyError) as error:
            raise ValueError(
                f"{self.where} has a damaged {_MANIFEST!r}: {error}."
            ) from error
        is_done = len(lines) == self.work.chunks
        programs = (self.path / _PROGRAM).read_text(), self.program
        check_same_run(self.where, old, self.manifest, programs, is_done)
        return lines

    def _check_files(self) -> None:
        """Compare checksums, each process those of some chunks."""
        processes, missing = self.work.processes, []
        for chunk in sorted(self.lines)[processes.index :: processes.count]:
            for name, expected in self.lines[chunk]["files"].items():
                file = self.path / name
                if not file.is_file():
                    missing.append(chunk)
                    break
                if hashlib.sha256(file.read_bytes()).hexdigest() != expected:
                    first = self.work.start(chunk)
                    raise ValueError(
                        f"The file {str(file)!r} is not what was written: its checksum "
                        "differs. Delete it and call again: members "
                        f"{first} to {first + self.work.filled(chunk) - 1} are then "
                        "run again."
                    )
        for found in processes.exchange(json.dumps(missing).encode()):
            for chunk in json.loads(found):
                del self.lines[chunk]

    def todo(self) -> Iterable[int]:
        """Return this process' share of the chunks without a line in the journal."""
        processes = self.work.processes
        left = [k for k in range(self.work.chunks) if k not in self.lines]
        return left[processes.index :: processes.count]

    def start(self, chunk: int) -> Chunk:
        """Start the program of a chunk, without waiting for its results."""
        return self.work.values(chunk)

    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Write the files of a chunk, and then its line of the journal."""
        first, count = self.work.start(chunk), self.work.filled(chunk)
        rows = rows_of(content, count)
        line: dict[str, Any] = {"chunk": chunk, "failed": failed, "files": {}}
        line["times"] = common_times(rows)
        what = (
            f"Members {first} to {first + count - 1} could not be written to "
            f"{str(self.path)!r}; those of finished chunks are kept, and the same "
            "call goes on once this is mended"
        )
        with durable.explaining(what):
            for name, (_, x) in rows.items():
                for file, data in self.files.chunk(name, first, x).items():
                    durable.write(self.path / file, data)
                    line["files"][file] = hashlib.sha256(data).hexdigest()
            self.journal.append(line)

    def outcome(self) -> EnsembleOutcome:
        """Close the journal, and label times if all members have the same."""
        processes = self.work.processes
        self.journal.close()
        new = json.dumps([*self.journal.lines.values()]).encode()
        for lines in map(json.loads, processes.exchange(new)):
            self.lines |= {line["chunk"]: line for line in lines}
        if processes.index == 0:
            with durable.explaining(f"{self.where} could not be finished"):
                if "t" in self.variables and not (self.path / "time").is_dir():
                    times = {line["times"] for line in self.lines.values()}
                    if len(times) == 1 and None not in times:
                        self._label_times()
                self.journal.finish(self.lines)
                self.lock.write(b"")
        failed = Failed()
        for line in self.lines.values():
            failed.add(line["failed"])
        return failed.outcome(self.work.members.count, path=self.given)

    def _label_times(self) -> None:
        import zarr

        array: Any = zarr.open_array(str(self.path / "t"), mode="r")
        times = np.asarray(array[0])
        self.files = Files()
        self._open(self.variables | {"time": (("time",), times)})
        # The folder `time` tells that all of this has been done, and so comes last.
        for name, data in self.files.chunk("time", 0, times).items():
            durable.write(self.path / ".time.unfinished" / name, data)
        metadata = self.files.metadata()
        own = metadata.pop("time/zarr.json")
        durable.write(self.path / ".time.unfinished/time/zarr.json", own)
        durable.write(self.path / "zarr.json", metadata["zarr.json"])
        os.replace(self.path / ".time.unfinished/time", self.path / "time")
        (self.path / ".time.unfinished").rmdir()
        durable.sync_folder(self.path)

    def close(self) -> None:
        """Let others write to the store."""
        self.journal.close()
        self.lock.release()
