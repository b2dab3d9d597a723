"""The outcome of an ensemble, and the sinks that collect results in memory.

A sink decides which chunks a process runs, starts them, collects their results, and
creates the outcome. The sinks that write to disk are in `_store`.
"""

import abc
import itertools
import json
import math
import os
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._errors import IntegrationError
from .._results import messages, RESULTS
from ._program import (
    call_description,
    ChunkResult,
    each_reduction,
    is_success,
    Job,
    manifest,
    merged_states,
    program_text,
    used_arrays,
    without_addresses,
    without_results,
)


# The number of bytes that processes exchange at a time.
_BLOCK = 2**24


class EnsembleOutcome(eqx.Module):
    """The outcome of `nhjax.ensemble`.

    - `num_members`: the number of members, including those that failed.
    - `values`: the values that `run` returned, as NumPy arrays with the members as
        leading axis; None if the values were reduced or written to a store.
    - `statistics`: the results of the reductions, in a tree like `reduce`, or None.
    - `failed`: the indices of the members that failed, in increasing order.
    - `failed_step`: the steps at which they failed, -1 if a step is not known.
    - `failed_result`: the reasons, an array of `nhjax.RESULTS`.
    - `path`: the folder of the store, or None.
    """

    num_members: int = eqx.field(static=True)
    values: Any
    statistics: Any
    failed: np.ndarray
    failed_step: np.ndarray
    failed_result: RESULTS
    path: str | os.PathLike[str] | None = eqx.field(static=True, default=None)

    def failures(self) -> list[tuple[int, int, str]]:
        """List the members that failed, each as (index, step, reason).

        `reason` is the message of its `RESULTS`; the step is -1 if it is not known.

        !!! example

            >>> import jax.numpy as jnp, nhjax
            >>> nhjax.ensemble(jnp.sin, jnp.arange(3.0)).failures()
            []
        """
        texts, codes = messages(), np.asarray(self.failed_result._value)
        return [
            (int(index), int(step), texts[int(code)])
            for index, step, code in zip(
                self.failed, self.failed_step, codes, strict=True
            )
        ]


class FailureList:
    """The members that failed, as rows (index, step, code), in the order of chunks.

    `code` is the integer value of the member's `RESULTS`.
    """

    def __init__(self, rows: list[list[int]] | None = None):
        self.rows = [] if rows is None else rows

    def add(self, rows: list[list[int]]) -> None:
        """Append the failed members of a chunk."""
        self.rows += rows

    def to_bytes(self) -> bytes:
        """Return the rows as the bytes of 64-bit integers."""
        return np.array(self.rows, np.int64).tobytes()

    def add_bytes(self, data: bytes) -> None:
        """Append rows that `to_bytes` has returned."""
        self.rows += np.frombuffer(data, np.int64).reshape(-1, 3).tolist()

    def outcome(
        self,
        num_members: int,
        *,
        values: Any = None,
        statistics: Any = None,
        path: str | os.PathLike[str] | None = None,
    ) -> EnsembleOutcome:
        """Create the outcome of an ensemble with these failures."""
        table = np.array(sorted(self.rows), np.int64).reshape(-1, 3)
        codes = jnp.asarray(table[:, 2].astype(np.int32))
        return EnsembleOutcome(
            num_members=num_members,
            values=values,
            statistics=statistics,
            failed=table[:, 0],
            failed_step=table[:, 1],
            failed_result=eqx.tree_at(
                lambda result: result._value, RESULTS.successful, codes
            ),
            path=path,
        )


def failures_in_chunk(job: Job, chunk: int, result: ChunkResult) -> list[list[int]]:
    """List the members of a chunk that failed, as rows of a `FailureList`."""
    first, count = job.first_member(chunk), job.num_members(chunk)
    codes, steps = np.asarray(result.codes)[:count], np.asarray(result.steps)[:count]
    bad = np.flatnonzero(~is_success(codes))
    return [[int(first + i), int(steps[i]), int(codes[i])] for i in bad]


class AbstractSink(abc.ABC):
    """Collects the results of the chunks of a job.

    If `in_rounds`, each process runs one chunk per round, and all processes exchange
    data in `collect` after each round.
    """

    in_rounds = False

    @abc.abstractmethod
    def remaining_chunks(self) -> Iterable[int]:
        """Return the chunks that this process has to run."""

    @abc.abstractmethod
    def start(self, chunk: int) -> ChunkResult:
        """Start the program of a chunk, without waiting for its result."""

    @abc.abstractmethod
    def collect(self, chunk: int, content: Any, failures: list[list[int]]) -> None:
        """Store the content and the failures of a chunk."""

    @abc.abstractmethod
    def outcome(self) -> EnsembleOutcome:
        """Create the outcome after the last chunk."""

    def close(self) -> None:
        """Close files and release locks, if there are any."""
        return


class MemorySink(AbstractSink):
    """Stores all values in NumPy arrays; in the end every process has all values."""

    def __init__(self, job: Job):
        self.job, self.failures = job, FailureList()
        if job.processes.count > 1:
            leaves = jax.tree.leaves(job.structure)
            made = manifest(job, values=[f"{x.dtype}{x.shape}" for x in leaves])
            job.processes.check_same_call(call_description(made, program_text(job)))
        count = job.members.count
        self.values = jax.tree.map(
            lambda x: np.empty((count, *x.shape), x.dtype), job.structure
        )

    def remaining_chunks(self) -> Iterable[int]:
        """Return the chunks of this process, which are consecutive."""
        return self.job.share(self.job.processes.index)

    def start(self, chunk: int) -> ChunkResult:
        """Start the program of a chunk, without waiting for its result."""
        return self.job.values(chunk)

    def collect(self, chunk: int, content: Any, failures: list[list[int]]) -> None:
        """Copy the values of a chunk into the rows of its members."""
        first, count = self.job.first_member(chunk), self.job.num_members(chunk)
        pairs = zip(jax.tree.leaves(self.values), jax.tree.leaves(content), strict=True)
        for array, x in pairs:
            array[first : first + count] = np.asarray(x)[:count]
        self.failures.add(failures)

    def outcome(self) -> EnsembleOutcome:
        """Create the outcome with the values of all members."""
        if self.job.processes.count > 1:
            own, self.failures = self.failures, FailureList()
            for data in self.job.processes.allgather(own.to_bytes()):
                self.failures.add_bytes(data)
            for array in jax.tree.leaves(self.values):
                self._fill_from_others(array)
        return self.failures.outcome(self.job.members.count, values=self.values)

    def _fill_from_others(self, array: np.ndarray) -> None:
        """Copy the rows of other processes into an array, block by block."""
        job, processes = self.job, self.job.processes
        content = array.reshape(-1).view(np.uint8)
        width = len(content) // len(array)
        ends = [
            min(job.share(i).stop * job.chunk_size, job.members.count) * width
            for i in range(-1, processes.count)
        ]
        longest, block = max(np.diff(ends)), -(-_BLOCK // processes.count)
        for moved in range(0, longest, block):
            places = [
                slice(start + moved, min(start + moved + block, stop))
                for start, stop in itertools.pairwise(ends)
            ]
            own = content[places[processes.index]].tobytes()
            for place, data in zip(places, processes.allgather(own), strict=True):
                content[place] = np.frombuffer(data, np.uint8)


def _dtypes(state: Any) -> list[Any]:
    return [x.dtype for x in jax.tree.leaves(state)]


class ReductionSink(AbstractSink):
    """Stores states of reductions, whose size does not depend on the ensemble's size.

    By default each process runs consecutive chunks, and the states of processes are
    merged at the end. With `in_rounds`, the states of each round are merged in the
    order of chunks, so that the result does not depend on the number of processes.
    """

    def __init__(self, job: Job, reductions: Any, in_rounds: bool):
        self.job, self.reductions, self.failures = job, reductions, FailureList()
        self.in_rounds, self.first_chunk, self.rounds = in_rounds, 0, 0
        structure = without_results(job.structure)
        self.neutral = self._placed(
            each_reduction(lambda each: each.init(structure), reductions)
        )
        self.state = self.neutral
        self.is_used = used_arrays(reductions, structure)

    def description(self) -> tuple[dict[str, Any], str]:
        """Return the manifest of the job and the text of its program."""
        reductions = without_addresses(repr(self.reductions))
        made = manifest(self.job, reduce=reductions)
        return made, program_text(self.job, self.reductions)

    def check_same_call(self) -> None:
        """Raise unless all processes compute the same statistics of the same job."""
        if self.job.processes.count > 1:
            call = call_description(*self.description(), fixed_order=self.in_rounds)
            self.job.processes.check_same_call(call)

    def remaining_chunks(self) -> Iterable[int]:
        """Return this process's chunks; with `in_rounds`, from `first_chunk` on."""
        processes = self.job.processes
        if self.in_rounds:
            start = self.first_chunk + processes.index
            return range(start, self.job.num_chunks, processes.count)
        return self.job.share(processes.index)

    def start(self, chunk: int) -> ChunkResult:
        """Start the program of a chunk, without waiting for its result."""
        return self.job.states(chunk, self.reductions, self.is_used)

    def collect(self, chunk: int, content: Any, failures: list[list[int]]) -> None:
        """Merge the state of a chunk, or the states of a round of chunks."""
        del chunk
        if self.in_rounds and self.job.processes.count > 1:
            self._merge_round(self._packed(content, FailureList(failures)))
        else:
            self._merge(content, FailureList(failures))

    def outcome(self) -> EnsembleOutcome:
        """Create the outcome with the statistics of all members.

        **Raises:** `nhjax.IntegrationError` if all members failed.
        """
        self._merge_other_processes()
        count = self.job.members.count
        if len(self.failures.rows) == count:
            index, step, reason = self.failures.outcome(count).failures()[0]
            raise IntegrationError(
                f"Integration failed in all {count} members, so that there are no "
                f"statistics; in member {index} in step {step}: {reason}"
            )
        statistics = each_reduction(
            lambda each, state: each.finish(state), self.reductions, self.state
        )
        return self.failures.outcome(count, statistics=statistics)

    def packed(self) -> bytes:
        """Return the state and the failures as bytes."""
        return self._packed(self.state, self.failures)

    def restore(self, first_chunk: int, packed: bytes) -> None:
        """Restore state and failures from `packed`, to continue with `first_chunk`."""
        self.first_chunk = first_chunk
        state, self.failures = self._unpacked(packed)
        self.state = self._placed(state)

    def _merge_other_processes(self) -> None:
        processes = self.job.processes
        if processes.count == 1:
            return
        if not self.in_rounds:
            own = self.packed()
            self.state, self.failures = self.neutral, FailureList()
            self._merge_round(own)
            return
        # A process without a chunk in the last round takes part with empty data.
        while self.rounds < -(
            -(self.job.num_chunks - self.first_chunk) // processes.count
        ):
            self._merge_round(b"")

    def _merge_round(self, own: bytes) -> None:
        for data in self.job.processes.allgather(own):
            if data:
                self._merge(*self._unpacked(data))
        self.rounds += 1

    def _merge(self, state: Any, failures: FailureList) -> None:
        state = self._placed(state)
        # Merging the first state with `neutral` can only change dtypes. If the dtypes
        # agree, the merge is skipped, because it would compile a program.
        if self.state is not self.neutral or _dtypes(state) != _dtypes(self.neutral):
            state = merged_states(self.reductions, self.state, state)
        self.state = state
        self.failures.add(failures.rows)

    def _placed(self, state: Any) -> Any:
        """Put a state on one device, so that one program merges all states."""
        return jax.device_put(state, self.job.layout.devices[0])

    def _packed(self, state: Any, failures: FailureList) -> bytes:
        # Dtypes are included, because the states that `init` and `update` of a user's
        # reduction return may have different dtypes.
        leaves = [np.asarray(x) for x in jax.tree.leaves(state)]
        kinds = json.dumps([[x.dtype.name, x.shape] for x in leaves]).encode()
        head = np.int64(len(kinds)).tobytes() + kinds
        return b"".join([head, *[x.tobytes() for x in leaves], failures.to_bytes()])

    def _unpacked(self, data: bytes) -> tuple[Any, FailureList]:
        at = 8 + int(np.frombuffer(data, np.int64, 1)[0])
        made = []
        for name, shape in json.loads(data[8:at]):
            found = np.frombuffer(data, jnp.dtype(name), math.prod(shape), at)
            made.append(found.reshape(shape))
            at += found.nbytes
        failures = FailureList()
        failures.add_bytes(data[at:])
        return jax.tree.unflatten(jax.tree.structure(self.neutral), made), failures
