"""The sinks that write to a folder, so that an interrupted run can be resumed.

`ZarrSink` writes the values of members to a store of Zarr, and
`CheckpointedReductionSink` writes the states of reductions. Both lock the folder while
they write, store in it the text of the program and a manifest that describes the job,
and refuse to resume the run of another job. The format of their files is part of the
interface: files of an earlier release remain readable.
"""

import hashlib
import json
import os
import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

from .._integrate import named_arrays, Solution, units_of_coordinates
from .._io import load, save
from .._results import result_codes
from . import _durable as durable
from ._program import (
    call_description,
    ChunkResult,
    Job,
    manifest,
    program_text,
    results_as_codes,
)
from ._sinks import AbstractSink, EnsembleOutcome, FailureList, ReductionSink


# The entries of a manifest that may differ if a run is complete.
_VERSIONS = ("nhjax", "jax")
_BATCH = ("trajectory",)


class ZarrSink(AbstractSink):
    """Writes the values of members to a store of Zarr, with a journal of chunks.

    A chunk is finished when its files, and after them its line of the journal, are on
    the disk. The line has the number of the chunk, its failures, and a checksum of each
    file. Process 0 creates the store and its journal; every process writes its own
    chunks.
    """

    MANIFEST = "manifest/zarr.json"
    PROGRAM = "manifest/program.txt"
    JOURNAL = f"manifest/{durable.JOURNAL}"
    LOCK = "manifest/lock"

    def __init__(
        self,
        job: Job,
        path: str | os.PathLike[str],
        units: Mapping[str, str],
        resume: bool,
    ):
        self.job, self.given, self.path = job, path, Path(path).absolute()
        # Only process 0 resolves links: if another process looks for the folder before
        # it exists, NFS reports it as missing for up to a minute.
        if job.processes.index == 0:
            self.path = self.path.resolve()
        self.where = f"The store {str(self.path)!r}"
        self.variables = _empty_variables(job)
        self.attributes = _attributes(job.structure, self.variables, units)
        self.manifest = manifest(
            job,
            variables={
                name: [list(dims[1:]), list(x.shape[1:]), x.dtype.name]
                for name, (dims, x) in self.variables.items()
            },
        )
        # The encoder is created before all comparisons and writes, so that a missing
        # package zarr is reported first.
        self.encoder, self.lock = self._encoder(self.variables), durable.Lock()
        self.program = program_text(job)
        job.processes.check_same_call(
            call_description(self.manifest, self.program, out=True, units=dict(units))
        )
        self.journal = durable.Journal(self.path / "manifest", job.processes.index)
        try:
            with durable.explaining(f"{self.where} cannot be used"):
                self.lines = self._open(resume)
                self._check_files()
        except BaseException:
            self.close()
            raise

    def remaining_chunks(self) -> Iterable[int]:
        """Return this process's share of the chunks that are not in the journal."""
        processes = self.job.processes
        left = [k for k in range(self.job.num_chunks) if k not in self.lines]
        return left[processes.index :: processes.count]

    def start(self, chunk: int) -> ChunkResult:
        """Start the program of a chunk, without waiting for its result."""
        return self.job.values(chunk)

    def collect(self, chunk: int, content: Any, failures: list[list[int]]) -> None:
        """Write the files of a chunk, and then its line of the journal."""
        first, count = self.job.first_member(chunk), self.job.num_members(chunk)
        rows = jax.tree.map(lambda x: np.asarray(x)[:count], content)
        variables = named_arrays(results_as_codes(rows), _BATCH)
        line: dict[str, Any] = {"chunk": chunk, "failed": failures, "files": {}}
        line["times"] = _digest_of_common_times(variables)
        what = (
            f"Members {first} to {first + count - 1} could not be written to "
            f"{str(self.path)!r}; finished chunks are kept. Once the cause is removed, "
            "the same call resumes the run"
        )
        with durable.explaining(what):
            for name, (_, x) in variables.items():
                for file, data in self.encoder.chunk(name, first, x).items():
                    durable.write(self.path / file, data)
                    line["files"][file] = hashlib.sha256(data).hexdigest()
            self.journal.append(line)

    def outcome(self) -> EnsembleOutcome:
        """Finish the journal, store the times if all agree, and return the outcome."""
        processes = self.job.processes
        self.journal.close()
        new = json.dumps([*self.journal.lines.values()]).encode()
        for lines in map(json.loads, processes.allgather(new)):
            self.lines |= {line["chunk"]: line for line in lines}
        if processes.index == 0:
            with durable.explaining(f"{self.where} could not be finished"):
                if "t" in self.variables and not (self.path / "time").is_dir():
                    times = {line["times"] for line in self.lines.values()}
                    if len(times) == 1 and None not in times:
                        self._label_times()
                self.journal.finish(self.lines)
                self.lock.write(b"")
        failures = FailureList()
        for line in self.lines.values():
            failures.add(line["failed"])
        return failures.outcome(self.job.members.count, path=self.given)

    def close(self) -> None:
        """Release the locks."""
        self.journal.close()
        self.lock.release()

    def _encoder(self, variables: dict[str, Any]) -> "_ZarrEncoder":
        count = self.job.members.count
        arrays = {
            name: (
                dims,
                (count if dims[0] in _BATCH else len(x), *x.shape[1:]),
                x.dtype,
            )
            for name, (dims, x) in variables.items()
        }
        return _ZarrEncoder(arrays, self.job.chunk_size, self.attributes, self.manifest)

    def _open(self, resume: bool) -> dict[int, durable.Line]:
        """Create or open the store, and return the lines of its journal."""
        processes, lines, token = self.job.processes, {}, b""
        if processes.index == 0:
            if self.path.is_dir() and any(self.path.iterdir()):
                lines = self._resume(resume)
            else:
                self._create()
            token = os.urandom(16).hex().encode() if processes.count > 1 else b""
            self.lock.write(token)
        shared = json.loads(
            processes.broadcast(
                json.dumps([token.decode(), [*lines.values()]]).encode()
            )
        )
        if processes.index > 0:
            self._check_shared(shared[0])
            self.journal.open_part()
        # Wait until each process has locked its part of the journal.
        processes.allgather()
        return {line["chunk"]: line for line in shared[1]}

    def _check_shared(self, token: str) -> None:
        """Raise unless this process reads the token that process 0 has written."""
        lock = self.path / self.LOCK
        if not lock.is_file() or lock.read_text() != token:
            raise ValueError(
                f"Process {self.job.processes.index} does not see the store that "
                f"process 0 has created in {str(self.path)!r}: `out` must be a folder "
                "that all processes share."
            )

    def _create(self) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise FileExistsError(
                f"{str(self.path)!r} is a file: `out` names a folder."
            )
        unfinished = self.path.with_name(f".{self.path.name}.unfinished")
        lock = unfinished / self.LOCK
        lock.parent.mkdir(parents=True, exist_ok=True)
        self.lock.acquire(lock, self.where)
        for left in sorted({*unfinished.rglob("*")} - {lock, lock.parent})[::-1]:
            left.rmdir() if left.is_dir() else left.unlink()
        content = self.encoder.metadata()
        content |= {self.PROGRAM: self.program.encode(), self.JOURNAL: b""}
        for name, data in content.items():
            durable.write(unfinished / name, data)
        # Once its first files are written, the store gets its final name atomically.
        os.replace(unfinished, self.path)
        durable.sync_folder(self.path.parent)

    def _resume(self, resume: bool) -> dict[int, durable.Line]:
        names = self.MANIFEST, self.PROGRAM, self.JOURNAL
        _check_resumable(self.where, self.path, names, "nhjax.ensemble", resume)
        self.lock.acquire(self.path / self.LOCK, self.where)
        lines = self.journal.merge_parts()
        try:
            old = json.loads((self.path / self.MANIFEST).read_text())["attributes"]
        except (ValueError, KeyError) as error:
            raise ValueError(
                f"{self.where} has a damaged {self.MANIFEST!r}: {error}."
            ) from error
        is_complete = len(lines) == self.job.num_chunks
        programs = (self.path / self.PROGRAM).read_text(), self.program
        _check_same_job(self.where, old, self.manifest, programs, is_complete)
        return lines

    def _check_files(self) -> None:
        """Compare checksums, and drop chunks with missing files from `lines`.

        Each process checks some of the chunks.
        """
        processes, missing = self.job.processes, []
        for chunk in sorted(self.lines)[processes.index :: processes.count]:
            for name, expected in self.lines[chunk]["files"].items():
                file = self.path / name
                if not file.is_file():
                    missing.append(chunk)
                    break
                if hashlib.sha256(file.read_bytes()).hexdigest() != expected:
                    first = self.job.first_member(chunk)
                    last = first + self.job.num_members(chunk) - 1
                    raise ValueError(
                        f"The file {str(file)!r} is damaged: its checksum differs from "
                        "the journal. Delete the file; the same call then runs members "
                        f"{first} to {last} again."
                    )
        for found in processes.allgather(json.dumps(missing).encode()):
            for chunk in json.loads(found):
                del self.lines[chunk]

    def _label_times(self) -> None:
        import zarr

        array: Any = zarr.open_array(str(self.path / "t"), mode="r")
        times = np.asarray(array[0])
        self.encoder = self._encoder(self.variables | {"time": (("time",), times)})
        # The folder `time` is moved into place last: if it exists, the times are saved.
        for name, data in self.encoder.chunk("time", 0, times).items():
            durable.write(self.path / ".time.unfinished" / name, data)
        metadata = self.encoder.metadata()
        own = metadata.pop("time/zarr.json")
        durable.write(self.path / ".time.unfinished/time/zarr.json", own)
        durable.write(self.path / "zarr.json", metadata["zarr.json"])
        os.replace(self.path / ".time.unfinished/time", self.path / "time")
        (self.path / ".time.unfinished").rmdir()
        durable.sync_folder(self.path)


class CheckpointedReductionSink(AbstractSink):
    """Writes the states of reductions to a folder after each round of chunks.

    In a round, each process runs one chunk. The state, the failures and the number of
    finished chunks are in one file, which process 0 replaces atomically.
    """

    in_rounds = True
    MANIFEST, PROGRAM, STATE, LOCK = "manifest.json", "program.txt", "state.npz", "lock"

    def __init__(
        self, job: Job, reductions: Any, path: str | os.PathLike[str], resume: bool
    ):
        self.job, self.inner = job, ReductionSink(job, reductions, in_rounds=True)
        self.given, self.path = path, Path(path).resolve()
        self.where = f"The folder {str(self.path)!r}"
        self.lock = durable.Lock()
        self.manifest, self.program = self.inner.description()
        job.processes.check_same_call(
            call_description(self.manifest, self.program, out=True)
        )
        content = b""
        try:
            if job.processes.index == 0:
                with durable.explaining(f"{self.where} cannot be used"):
                    self._open(resume)
                number = np.int64(self.inner.first_chunk).tobytes()
                content = number + self.inner.packed()
            content = job.processes.broadcast(content)
        except BaseException:
            self.close()
            raise
        if first_chunk := int(np.frombuffer(content, np.int64, 1)[0]):
            self.inner.restore(first_chunk, content[8:])

    def remaining_chunks(self) -> Iterable[int]:
        """Return the chunks of this process after the last finished chunk."""
        return self.inner.remaining_chunks()

    def start(self, chunk: int) -> ChunkResult:
        """Start the program of a chunk, without waiting for its result."""
        return self.inner.start(chunk)

    def collect(self, chunk: int, content: Any, failures: list[list[int]]) -> None:
        """Merge a chunk or a round of chunks; process 0 then writes the state."""
        self.inner.collect(chunk, content, failures)
        processes = self.job.processes
        if processes.index > 0:
            return
        finished = min(chunk + processes.count, self.job.num_chunks)
        leaves = [np.asarray(x) for x in jax.tree.leaves(self.inner.state)]
        rows = np.array(self.inner.failures.rows, np.int64).reshape(-1, 3)
        what = (
            f"The state after {finished} chunks could not be written to "
            f"{str(self.path)!r}; the state before it is kept. Once the cause is "
            "removed, the same call resumes the run"
        )
        with durable.explaining(what):
            save(
                self.path / self.STATE,
                {"chunks": finished, "failed": rows, "state": leaves},
            )

    def outcome(self) -> EnsembleOutcome:
        """Create the outcome with the statistics of all members."""
        return replace(self.inner.outcome(), path=self.given)

    def close(self) -> None:
        """Release the lock."""
        self.lock.release()

    def _open(self, resume: bool) -> None:
        """Create the folder, or open it and read the state."""
        # If a run is interrupted before it writes its manifest, only these files exist.
        early = {
            self.LOCK,
            self.PROGRAM,
            f".{self.PROGRAM}.unfinished",
            f".{self.MANIFEST}.unfinished",
        }
        self.path.mkdir(parents=True, exist_ok=True)
        is_new = {x.name for x in self.path.iterdir()} <= early
        if not is_new:
            names, maker = (self.MANIFEST, self.PROGRAM), "nhjax.ensemble(reduce=...)"
            _check_resumable(self.where, self.path, names, maker, resume)
        self.lock.acquire(self.path / self.LOCK, self.where)
        if is_new:
            # The manifest comes last, because it marks the folder as complete.
            durable.write(self.path / self.PROGRAM, self.program.encode())
            manifest = json.dumps(self.manifest).encode()
            durable.write(self.path / self.MANIFEST, manifest)
        else:
            self._resume()

    def _resume(self) -> None:
        for path in self.path.glob(".*"):
            # Delete a temporary file of `save` that a killed process has left.
            if re.fullmatch("[.][0-9a-f]{32}", path.name):
                path.unlink()
        try:
            old = json.loads((self.path / self.MANIFEST).read_text())
        except ValueError as error:
            raise ValueError(
                f"{self.where} has a damaged {self.MANIFEST!r}: {error}."
            ) from error
        inner, kept = self.inner, {}
        if (self.path / self.STATE).is_file():
            kept = load(self.path / self.STATE)
            inner.first_chunk = kept["chunks"]
        programs = (self.path / self.PROGRAM).read_text(), self.program
        is_complete = inner.first_chunk == self.job.num_chunks
        _check_same_job(self.where, old, self.manifest, programs, is_complete)
        if inner.first_chunk:
            structure = jax.tree.structure(inner.state)
            inner.state = jax.tree.unflatten(structure, kept["state"])
            inner.failures.add(np.asarray(kept["failed"]).tolist())


def _check_resumable(
    where: str, folder: Path, names: tuple[str, ...], maker: str, resume: bool
) -> None:
    """Raise unless `resume` is true and `folder` has all files in `names`.

    `where` names the folder, and `maker` the call that should have created it.
    """
    if not resume:
        raise FileExistsError(
            f"{where} exists: resume its run by `resume=True`, or name another one."
        )
    for name in names:
        if not (folder / name).is_file():
            raise ValueError(
                f"{where} has no {name!r}: it was not made by `{maker}`, or is "
                "damaged. Name another folder, or put the file back."
            )


def _check_same_job(
    where: str,
    old: dict[str, Any],
    new: dict[str, Any],
    programs: tuple[str, str],
    is_complete: bool,
) -> None:
    """Raise if the manifests or the texts of the programs (old, new) differ."""
    found = _differences(old, new, is_complete) or _program_difference(*programs)
    if found:
        raise ValueError(
            f"{where} belongs to another run. Differences: {'; '.join(found)}. Call "
            "with the same arguments, or name another folder."
        )


def _differences(
    old: dict[str, Any], new: dict[str, Any], is_complete: bool
) -> list[str]:
    """List the differences of two manifests, without versions if `is_complete`."""
    words = {
        "members": "the arrays of `members`, or whether `members` is a function",
        "variables": "the names, shapes or dtypes of what `run` returns",
    }
    found = []
    for name in new:
        if old.get(name) == new[name] or (is_complete and name in _VERSIONS):
            continue
        if name in words:
            found.append(words[name])
        else:
            found.append(f"`{name}`, {old.get(name)} before and {new[name]} now")
    return found


def _program_difference(old: str, new: str) -> list[str]:
    """Describe the first difference of two programs."""
    if old == new:
        return []
    before, now = old.splitlines(), new.splitlines()
    at = next(
        (i for i, (a, b) in enumerate(zip(before, now, strict=False)) if a != b),
        min(len(before), len(now)),
    )
    one, other = [
        " ".join(lines[at].split())[:100] if at < len(lines) else "at its end"
        for lines in (before, now)
    ]
    return [
        "the computation in `run`, or the numbers in it; the first different line of "
        f"its program was {one!r} and is {other!r}"
    ]


def _empty_variables(job: Job) -> dict[str, Any]:
    """Return the axes and one uninitialised row of each array of values, by name."""
    empty = jax.tree.map(lambda x: np.empty((1, *x.shape), x.dtype), job.structure)
    made = named_arrays(results_as_codes(empty), _BATCH)
    for name, (dims, x) in made.items():
        if name in ("manifest", "time", *_BATCH) or "/" in name or name.startswith("."):
            raise ValueError(
                f"`run` returns an array called {name!r}, a name that is not allowed "
                "in a store: use another key."
            )
        if x.dtype.kind not in "biufc":
            raise TypeError(
                f"`run` returns the array {name!r} of dtype {x.dtype}, which Zarr does "
                "not support: convert it to a numeric dtype of NumPy."
            )
        if len(set(dims)) < len(dims):
            raise ValueError(f"Two axes of {name!r} have the same name: {dims}.")
    return made


def _attributes(
    structure: Any, variables: dict[str, Any], units: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    """Return the attributes of the arrays: units, and the labels of a solution.

    Names of coordinates and their units are attributes, because not all releases of
    Zarr read arrays of strings.
    """
    made: dict[str, dict[str, Any]] = {name: {} for name in (*variables, "time")}
    names = structure.coordinates if isinstance(structure, Solution) else None
    along = [name for name, (dims, _) in variables.items() if "coordinate" in dims]
    coordinates = names if names is not None and along else ()
    for name, unit in units.items():
        if name in made:
            made[name]["units"] = unit
        elif name not in coordinates:
            raise ValueError(
                f"`units` has the name {name!r}, but the known names are: "
                f"{', '.join([*made, *coordinates])}."
            )
    if isinstance(structure, Solution):
        codes = result_codes()
        made["result"]["flag_values"] = list(codes.values())
        made["result"]["flag_meanings"] = " ".join(codes)
    for name in along if coordinates else ():
        made[name]["coordinate_names"] = list(coordinates)
    labels = units_of_coordinates(coordinates, units)
    for name, label in (("q", "coordinate_unit"), ("v", "velocity_unit")):
        if name in along and label in labels:
            made[name]["coordinate_units"] = labels[label][1]
    return made


def _digest_of_common_times(variables: dict[str, Any]) -> str | None:
    """Compute a digest of the members' times, or return None if they differ."""
    if "t" not in variables:
        return None
    times = variables["t"][1]
    if not np.all(times == times[:1]):
        return None
    return hashlib.sha256(np.ascontiguousarray(times[0]).tobytes()).hexdigest()


class _ZarrEncoder:
    """Computes the content of the files of a Zarr store, without writing them.

    Arrays are given as (dims, shape, dtype). Their chunks span `chunk_size` rows, and
    all entries of the other axes. Chunks are removed from memory when they are encoded.
    """

    def __init__(
        self,
        variables: dict[str, tuple[tuple[str, ...], tuple[int, ...], Any]],
        chunk_size: int,
        attributes: dict[str, dict[str, Any]],
        manifest: dict[str, Any],
    ):
        try:
            import zarr
            import zarr.storage
        except ImportError as error:
            raise ImportError(
                "`nhjax.ensemble(out=...)` needs zarr 3, an optional dependency: "
                '`pip install "nhjax[ensemble]"`.'
            ) from error
        self._content: dict[str, Any] = {}
        self._arrays: dict[str, Any] = {}
        store = zarr.storage.MemoryStore(self._content)
        group: Any = zarr.create_group(store=store, zarr_format=3)
        group.create_group("manifest", attributes=manifest)
        for name, (dims, shape, dtype) in variables.items():
            rows = chunk_size if dims[0] in _BATCH else shape[0]
            self._arrays[name] = group.create_array(
                name,
                shape=shape,
                dtype=dtype,
                # An axis may have length 0, but a chunk must have at least length 1.
                chunks=(rows, *(max(1, size) for size in shape[1:])),
                dimension_names=dims,
                attributes=attributes.get(name, {}),
                fill_value=np.zeros((), dtype).item(),
                config={"write_empty_chunks": True},
            )
        with warnings.catch_warnings():
            # Zarr warns that its version 3 does not specify consolidated metadata;
            # xarray warns if they are missing.
            warnings.simplefilter("ignore")
            zarr.consolidate_metadata(store)

    def metadata(self) -> dict[str, bytes]:
        """Return the files that describe the store, by name.

        Keys are sorted, because the order in which Zarr lists arrays may vary.
        """
        return {
            name: json.dumps(
                json.loads(x.to_bytes()), sort_keys=True, indent=1
            ).encode()
            for name, x in self._content.items()
            if name.endswith("zarr.json")
        }

    def chunk(self, name: str, start: int, rows: np.ndarray) -> dict[str, bytes]:
        """Return the files of the chunk of array `name` whose first row is `start`."""
        self._arrays[name][start : start + len(rows)] = rows
        made = [key for key in self._content if not key.endswith("zarr.json")]
        return {key: self._content.pop(key).to_bytes() for key in sorted(made)}
