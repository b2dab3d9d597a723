"""Where the results of chunks go: into arrays, or into the states of reductions."""

import abc
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np

from .._errors import IntegrationError
from ._failed import Failed
from ._members import Members
from ._outcome import EnsembleOutcome
from ._program import (
    AXIS,
    Chunk,
    each_reduction,
    is_reduction,
    Layout,
    reduced_chunk,
    spread,
    values_of_chunk,
)
from ._verdict import without_results


class Work:
    """What is to be run: a function, its members, the size of chunks, the devices."""

    def __init__(
        self, run: Any, members: Members, size: int, layout: Layout, structure: Any
    ):
        self.run, self.members, self.size = run, members, size
        self.layout, self.structure = layout, structure

    @property
    def chunks(self) -> int:
        """How many chunks there are; the last one may not be full."""
        return -(-self.members.count // self.size)

    def start(self, chunk: int) -> int:
        """Return the index of the first member of a chunk."""
        return chunk * self.size

    def filled(self, chunk: int) -> int:
        """Return how many members a chunk has."""
        return min(self.size, self.members.count - self.start(chunk))

    def values(self, chunk: int) -> Chunk:
        """Run a chunk; JAX returns before it has ended."""
        inputs = self.members.inputs(self.start(chunk), self.size)
        return values_of_chunk(
            self.run, self.members.make, on_devices(inputs, self.layout), self.layout
        )


def on_devices(inputs: Any, layout: Layout) -> Any:
    """Put the rows of inputs on devices, some on each."""
    return jax.device_put(inputs, spread(layout, jax.P(AXIS)))


class AbstractSink(abc.ABC):
    """What becomes of the chunks of an ensemble."""

    @abc.abstractmethod
    def todo(self) -> Iterable[int]:
        """Return the chunks that are not done yet."""

    @abc.abstractmethod
    def start(self, chunk: int) -> Chunk:
        """Set a chunk running; JAX returns before it has ended."""

    @abc.abstractmethod
    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Keep what came of a chunk that has ended."""

    @abc.abstractmethod
    def outcome(self) -> EnsembleOutcome:
        """Return the outcome once no chunk is left."""

    def close(self) -> None:
        """Let go of files."""
        return


class Collected(AbstractSink):
    """All values in arrays of NumPy, in the memory of the host."""

    def __init__(self, work: Work):
        self.work, self.failed = work, Failed()
        count = work.members.count
        self.whole = jax.tree.map(
            lambda x: np.empty((count, *x.shape), x.dtype), work.structure
        )

    def todo(self) -> Iterable[int]:
        """Return all chunks."""
        return range(self.work.chunks)

    def start(self, chunk: int) -> Chunk:
        """Set a chunk running."""
        return self.work.values(chunk)

    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Copy the rows of a chunk."""
        first, count = self.work.start(chunk), self.work.filled(chunk)
        pairs = zip(jax.tree.leaves(self.whole), jax.tree.leaves(content), strict=True)
        for array, x in pairs:
            array[first : first + count] = np.asarray(x)[:count]
        self.failed.add(failed)

    def outcome(self) -> EnsembleOutcome:
        """Return the values."""
        return self.failed.outcome(self.work.members.count, values=self.whole)


class Reduced(AbstractSink):
    """The states of reductions, which do not grow with the number of members."""

    def __init__(self, work: Work, reductions: Any):
        self.work, self.reductions, self.failed = work, reductions, Failed()
        structure = without_results(work.structure)
        state = each_reduction(lambda each: each.init(structure), reductions)
        # Where programs leave it: elsewhere it would be another program for JAX.
        self.state = jax.device_put(state, spread(work.layout, jax.P()))

    def todo(self) -> Iterable[int]:
        """Return all chunks."""
        return range(self.work.chunks)

    def start(self, chunk: int) -> Chunk:
        """Set a chunk running, from the state that the one before it leaves."""
        work = self.work
        inputs = work.members.inputs(work.start(chunk), work.size)
        is_there = np.arange(work.size) < work.filled(chunk)
        inputs, is_there = on_devices((inputs, is_there), work.layout)
        done = reduced_chunk(
            work.run,
            work.members.make,
            self.reductions,
            self.state,
            inputs,
            is_there,
            work.layout,
        )
        self.state = done.content
        return done

    def take(self, chunk: int, content: Any, failed: list[list[int]]) -> None:
        """Note the failures; the state has come already."""
        del chunk, content
        self.failed.add(failed)

    def outcome(self) -> EnsembleOutcome:
        """Finish the statistics.

        **Raises:** `nhjax.IntegrationError` if all members have failed.
        """
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
