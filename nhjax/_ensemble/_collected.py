"""All values of an ensemble in the memory of the host."""

import itertools
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from ._failed import Failed
from ._manifest import call_of, program, values_manifest
from ._outcome import EnsembleOutcome
from ._program import Chunk
from ._sinks import AbstractSink, Work


# So many bytes come from all processes at a time.
_BLOCK = 2**24


class Collected(AbstractSink):
    """All values in arrays of NumPy; each process has them all in the end."""

    def __init__(self, work: Work):
        self.work, self.failed = work, Failed()
        if work.processes.count > 1:
            work.processes.agree(call_of(values_manifest(work), program(work)))
        count = work.members.count
        self.whole = jax.tree.map(
            lambda x: np.empty((count, *x.shape), x.dtype), work.structure
        )

    def todo(self) -> Iterable[int]:
        """Return the chunks of this process."""
        return self.work.share(self.work.processes.index)

    def start(self, chunk: int) -> Chunk:
        """Start the program of a chunk, without waiting for its results."""
        return self.work.values(chunk)

    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Copy the results of a chunk into the rows of its members."""
        first, count = self.work.start(chunk), self.work.filled(chunk)
        pairs = zip(jax.tree.leaves(self.whole), jax.tree.leaves(content), strict=True)
        for array, x in pairs:
            array[first : first + count] = np.asarray(x)[:count]
        self.failed.add(failed)

    def outcome(self) -> EnsembleOutcome:
        """Return the outcome of the ensemble, with the values of all members."""
        if self.work.processes.count > 1:
            own, self.failed = self.failed, Failed()
            for data in self.work.processes.exchange(own.to_bytes()):
                self.failed.add_bytes(data)
            for array in jax.tree.leaves(self.whole):
                self._complete(array)
        return self.failed.outcome(self.work.members.count, values=self.whole)

    def _complete(self, array: np.ndarray) -> None:
        """Fill in the rows of other processes, block after block."""
        work, processes = self.work, self.work.processes
        content = array.reshape(-1).view(np.uint8)
        width = len(content) // len(array)
        ends = [
            min(work.share(i).stop * work.size, work.members.count) * width
            for i in range(-1, processes.count)
        ]
        longest, block = max(np.diff(ends)), -(-_BLOCK // processes.count)
        for moved in range(0, longest, block):
            places = [
                slice(start + moved, min(start + moved + block, stop))
                for start, stop in itertools.pairwise(ends)
            ]
            own = content[places[processes.index]].tobytes()
            for place, data in zip(places, processes.exchange(own), strict=True):
                content[place] = np.frombuffer(data, np.uint8)
