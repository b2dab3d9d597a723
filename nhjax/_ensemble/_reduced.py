"""The statistics of an ensemble, collected on the way."""

import json
import math
from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .._errors import IntegrationError
from ._failed import Failed
from ._manifest import call_of, program, statistics_manifest
from ._outcome import EnsembleOutcome
from ._program import (
    Chunk,
    each_reduction,
    is_reduction,
    merged_states,
    reduced_chunk,
)
from ._sinks import AbstractSink, on_devices, Work
from ._verdict import without_results


class Reduced(AbstractSink):
    """The states of reductions, which do not grow with the number of members.

    Each process runs the chunks of a part of the members, and states are merged in the
    end. In rounds every process runs one chunk, and their states are merged in the
    order of chunks, so that the number of processes changes nothing.
    """

    def __init__(self, work: Work, reductions: Any, in_rounds: bool):
        self.work, self.reductions, self.failed = work, reductions, Failed()
        self.in_rounds, self.first, self.met = in_rounds, 0, 0
        structure = without_results(work.structure)
        self.neutral = self._placed(
            each_reduction(lambda each: each.init(structure), reductions)
        )
        self.state = self.neutral

    def agree(self) -> None:
        """Raise if processes collect other statistics."""
        work = self.work
        if work.processes.count > 1:
            made = statistics_manifest(work, self.reductions)
            text = program(work, self.reductions)
            call = call_of(made, text, fixed_order=self.in_rounds)
            work.processes.agree(call)

    def todo(self) -> Iterable[int]:
        """Return the chunks of this process."""
        processes = self.work.processes
        if self.in_rounds:
            start = self.first + processes.index
            return range(start, self.work.chunks, processes.count)
        return self.work.share(processes.index)

    def start(self, chunk: int) -> Chunk:
        """Start the program of a chunk, without waiting for its results."""
        work = self.work
        inputs = work.members.inputs(work.start(chunk), work.size)
        is_there = np.arange(work.size) < work.filled(chunk)
        inputs, is_there = on_devices((inputs, is_there), work.layout)
        return reduced_chunk(
            work.run, work.members.make, self.reductions, inputs, is_there, work.layout
        )

    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Merge the state of a chunk, or of one of each process, with that so far."""
        del chunk
        if self.in_rounds and self.work.processes.count > 1:
            self._meet(self._packed(content, Failed(failed)))
        else:
            self._add(content, Failed(failed))

    def outcome(self) -> EnsembleOutcome:
        """Return the outcome of the ensemble, with its finished statistics.

        **Raises:** `nhjax.IntegrationError` if all members have failed.
        """
        self._complete()
        count = self.work.members.count
        bare = self.failed.outcome(count)
        if len(bare.failed) == count:
            index, step, reason = bare.failures()[0]
            raise IntegrationError(
                f"Integration failed in all {count} members, so that there are no "
                f"statistics; in member {index} in step {step}: {reason}"
            )
        statistics = each_reduction(
            lambda each, state: each.finish(state), self.reductions, self.state
        )
        return self.failed.outcome(count, statistics=statistics)

    def _complete(self) -> None:
        """Merge what other processes have collected."""
        processes = self.work.processes
        if processes.count == 1:
            return
        if not self.in_rounds:
            own = self._packed(self.state, self.failed)
            self.state, self.failed = self.neutral, Failed()
            self._meet(own)
            return
        # In the last round there may not be a chunk for everyone.
        while self.met < -(-(self.work.chunks - self.first) // processes.count):
            self._meet(b"")

    def _meet(self, own: bytes) -> None:
        for data in self.work.processes.exchange(own):
            if data:
                self._add(*self._unpacked(data))
        self.met += 1

    def _add(self, state: Any, failed: Failed) -> None:
        state = self._placed(state)
        self.state = merged_states(self.reductions, self.state, state)
        self.failed.add(failed.rows)

    def _placed(self, state: Any) -> Any:
        """Put a state where states are merged, so that there is one program for it."""
        return jax.device_put(state, self.work.layout.devices[0])

    def _packed(self, state: Any, failed: Failed) -> bytes:
        # With their dtypes, which need not be those of the state of no members.
        leaves = [np.asarray(x) for x in jax.tree.leaves(state)]
        kinds = json.dumps([[x.dtype.name, x.shape] for x in leaves]).encode()
        head = np.int64(len(kinds)).tobytes() + kinds
        return b"".join([head, *[x.tobytes() for x in leaves], failed.to_bytes()])

    def _unpacked(self, data: bytes) -> tuple[Any, Failed]:
        at = 8 + int(np.frombuffer(data, np.int64, 1)[0])
        made = []
        for name, shape in json.loads(data[8:at]):
            found = np.frombuffer(data, jnp.dtype(name), math.prod(shape), at)
            made.append(found.reshape(shape))
            at += found.nbytes
        failed = Failed()
        failed.add_bytes(data[at:])
        return jax.tree.unflatten(jax.tree.structure(self.neutral), made), failed


def check_reductions(reductions: Any) -> None:
    """Raise unless there are reductions, and nothing else."""
    leaves = jax.tree.leaves(reductions, is_leaf=is_reduction)
    for leaf in leaves:
        if not is_reduction(leaf):
            raise TypeError(
                f"`reduce` holds {leaf!r}, but it must be a reduction, such as "
                "`nhjax.Mean()`, or several in a tuple, a dictionary or another tree."
            )
    if not leaves:
        raise TypeError(f"`reduce` holds no reduction: {reductions!r}.")
