"""What is to be run, and where the results of chunks go."""

import abc
from collections.abc import Iterable
from typing import Any

import jax

from ._members import Members
from ._outcome import EnsembleOutcome
from ._processes import Processes
from ._program import AXIS, Chunk, Layout, spread, values_of_chunk


class Work:
    """What is run: a function, its members, in which chunks, where, and by whom."""

    def __init__(
        self,
        run: Any,
        members: Members,
        size: int,
        layout: Layout,
        structure: Any,
        processes: Processes,
    ):
        self.run, self.members, self.size = run, members, size
        self.layout, self.structure, self.processes = layout, structure, processes

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

    def share(self, index: int) -> range:
        """Return the chunks of a process, where each process has consecutive ones."""
        count = self.processes.count
        ends = [self.chunks * i // count for i in (index, index + 1)]
        return range(*ends)

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
    """What becomes of the chunks of an ensemble.

    With `in_rounds` processes meet in `take`, after each chunk.
    """

    in_rounds = False

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
        """Close files and give up locks, if any are held."""
        return
