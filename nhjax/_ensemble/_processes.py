"""The JAX processes that run an ensemble together, and how they exchange data."""

import json
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import jax
import numpy as np
from jax.experimental.multihost_utils import process_allgather


# Data are padded to vectors whose length is a power of two and at least this number of
# bytes. This saves compilations, because JAX compiles a program for each length.
_MIN_BYTES = 1024
# The time between two collective operations while processes run separate chunks. On the
# CPU, a collective operation fails after a process has waited for 30 minutes.
_SECONDS = 60.0


class Processes:
    """The processes that run an ensemble together.

    There is one process unless `jax.distributed.initialize` has been called. All
    processes call the collective operations below in the same order. In each operation
    every process also reports whether it has failed.
    """

    def __init__(self):
        self.index, self.count = jax.process_index(), jax.process_count()
        if self.count > 1:
            check_equal_devices([device.process_index for device in jax.devices()])
        self._has_ended = False

    @contextmanager
    def sharing_errors(self) -> Iterator[None]:
        """Run a block in all processes, and wait until all of them have finished it.

        An error in one process is reported to the others in their next collective
        operation, and is raised there too.
        """
        try:
            yield
        except Exception as error:
            if self.count > 1 and not self._has_ended:
                self._has_ended = True
                # If the other processes cannot be reached, raise the original error.
                with suppress(RuntimeError):
                    self._gather(True, f"{type(error).__name__}: {error}".encode())
            raise
        self.allgather()

    def allgather(self, data: bytes = b"") -> list[bytes]:
        """Return the data of all processes, in the order of processes.

        **Raises:** `RuntimeError` if a process has failed or has ended.
        """
        if self.count == 1:
            return [data]
        found = self._gather(False, data)
        for index, (has_failed, text) in enumerate(found):
            if has_failed:
                self._has_ended = True
                raise RuntimeError(
                    f"Process {index} of {self.count} has failed, and so this one "
                    f"ends: {text.decode(errors='replace')}"
                )
        return [text for _, text in found]

    def broadcast(self, data: bytes) -> bytes:
        """Return the data of process 0."""
        return self.allgather(data if self.index == 0 else b"")[0]

    def check_same_call(self, call: dict[str, Any]) -> None:
        """Raise in all processes if `call`, as JSON, differs between processes.

        **Raises:** `ValueError` with the name of the first entry that differs.
        """
        calls = [json.loads(x) for x in self.allgather(json.dumps(call).encode())]
        for index, other in enumerate(calls):
            for name in calls[0] | other:
                if other.get(name) != calls[0].get(name):
                    raise ValueError(
                        "All processes must call `nhjax.ensemble` with the same "
                        f"arguments, but process 0 and process {index} differ in "
                        f"`{name}`: {calls[0].get(name)} and {other.get(name)}."
                    )

    def _gather(self, has_failed: bool, data: bytes) -> list[tuple[bool, bytes]]:
        head = np.array([has_failed, len(data)], np.int32)
        try:
            heads = np.asarray(process_allgather(head))
            longest = int(heads[:, 1].max())
            size = max(_MIN_BYTES, 1 << (longest - 1).bit_length()) if longest else 0
            row = np.zeros(size, np.uint8)
            row[: len(data)] = np.frombuffer(data, np.uint8)
            rows = np.asarray(process_allgather(row)) if size else [row] * self.count
        # JAX raises either of these errors if a process has ended.
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            self._has_ended = True
            raise RuntimeError(
                f"Another of the {self.count} processes has ended or cannot be "
                "reached. Start all processes again: with `out`, the same call "
                f"resumes the run. The error of JAX is: {error}"
            ) from error
        return [
            (bool(failed), bytes(rows[i][:length]))
            for i, (failed, length) in enumerate(heads)
        ]


def check_equal_devices(owners: list[int]) -> None:
    """Raise in all processes unless each owns the same number of devices.

    `owners` lists the index of the process that owns each device.
    """
    numbers = Counter(owners)
    if len(set(numbers.values())) > 1:
        listed = ", ".join(f"process {i} has {numbers[i]}" for i in sorted(numbers))
        raise ValueError(
            "The collective operations of JAX need the same number of devices in each "
            f"process, but {listed}: start the processes with equal numbers."
        )


class PeriodicExchange:
    """Lets processes exchange errors periodically while each runs its own chunks.

    An error in one process therefore ends the other processes soon, and no process
    waits long for a slower process. Each exchange decides how many chunks each process
    runs before the next exchange.
    """

    def __init__(self, processes: Processes, num_chunks: int, is_needed: bool):
        self._processes, self._left, self._until_next = processes, num_chunks, 1
        self._has_ended = processes.count == 1 or not is_needed
        self._ran, self._since = 0, time.monotonic()

    def chunk_done(self) -> None:
        """Count a chunk, and run the next exchange if it is due."""
        self._left, self._ran = self._left - 1, self._ran + 1
        if not self._has_ended and (self._left == 0 or self._ran == self._until_next):
            self._exchange()

    def finish(self) -> None:
        """Exchange until no process has a chunk left."""
        while not self._has_ended:
            self._exchange()

    def _exchange(self) -> None:
        seconds = (time.monotonic() - self._since) / self._ran if self._ran else 0.0
        own = json.dumps([self._left, seconds]).encode()
        found = [json.loads(x) for x in self._processes.allgather(own)]
        slowest = max(seconds for _, seconds in found)
        self._until_next = max(1, int(_SECONDS / slowest)) if slowest else 1
        self._has_ended = not any(left for left, _ in found)
        self._ran, self._since = 0, time.monotonic()
