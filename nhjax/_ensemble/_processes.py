"""The processes of JAX that run an ensemble together, and what they tell each other."""

import json
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import jax
import numpy as np
from jax.experimental.multihost_utils import process_allgather


# Data go in vectors of so many bytes at least, and of powers of two, so that few
# programs are compiled for them.
_LEAST = 1024
# Processes that run chunks of their own meet about as often: one that waits in an
# operation for the others is given up on the CPU after 30 minutes.
_SECONDS = 60.0


class Processes:
    """The processes that run an ensemble together, and how they exchange data.

    There is one unless `jax.distributed.initialize` has been called. All of them meet
    in the same order: each meeting is a collective operation of JAX, in which every
    process also says whether it has failed.
    """

    def __init__(self):
        self.index, self.count = jax.process_index(), jax.process_count()
        if self.count > 1:
            check_devices([device.process_index for device in jax.devices()])
        self._is_over = False

    @contextmanager
    def together(self) -> Iterator[None]:
        """Do a part of the work, and go on once all processes have done theirs.

        An error in one process is told to the others at their next meeting, and raised
        there as well.
        """
        try:
            yield
        except Exception as error:
            if self.count > 1 and not self._is_over:
                self._is_over = True
                # If they are gone as well, this error is the one to tell of.
                with suppress(RuntimeError):
                    self._gather(True, f"{type(error).__name__}: {error}".encode())
            raise
        self.exchange()

    def exchange(self, data: bytes = b"") -> list[bytes]:
        """Return the data of all processes, in their order.

        **Raises:** `RuntimeError` if one of them has failed or is gone.
        """
        if self.count == 1:
            return [data]
        found = self._gather(False, data)
        for index, (has_failed, text) in enumerate(found):
            if has_failed:
                self._is_over = True
                raise RuntimeError(
                    f"Process {index} of {self.count} has failed, and so this one "
                    f"ends: {text.decode(errors='replace')}"
                )
        return [text for _, text in found]

    def of_first(self, data: bytes) -> bytes:
        """Return the data of process 0."""
        return self.exchange(data if self.index == 0 else b"")[0]

    def agree(self, call: dict[str, Any]) -> None:
        """Raise if `call`, which says in terms of JSON what is run, differs anywhere.

        It does so in all processes alike.

        **Raises:** `ValueError` with the names of what differs.
        """
        calls = [json.loads(x) for x in self.exchange(json.dumps(call).encode())]
        for index, other in enumerate(calls):
            for name in calls[0] | other:
                if other.get(name) != calls[0].get(name):
                    raise ValueError(
                        "All processes must call `nhjax.ensemble` alike, but process "
                        f"0 and process {index} differ in `{name}`: "
                        f"{calls[0].get(name)} and {other.get(name)}."
                    )

    def _gather(self, has_failed: bool, data: bytes) -> list[tuple[bool, bytes]]:
        head = np.array([has_failed, len(data)], np.int32)
        try:
            heads = np.asarray(process_allgather(head))
            longest = int(heads[:, 1].max())
            size = max(_LEAST, 1 << (longest - 1).bit_length()) if longest else 0
            row = np.zeros(size, np.uint8)
            row[: len(data)] = np.frombuffer(data, np.uint8)
            rows = np.asarray(process_allgather(row)) if size else [row] * self.count
        # JAX raises one or the other of these if a process is gone.
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            self._is_over = True
            raise RuntimeError(
                f"Another of the {self.count} processes has ended or cannot be "
                "reached. Start all of them again: with `out` the same call goes on. "
                f"JAX says: {error}"
            ) from error
        return [
            (bool(failed), bytes(rows[i][:length]))
            for i, (failed, length) in enumerate(heads)
        ]


def check_devices(owners: list[int]) -> None:
    """Raise, in all processes alike, unless each owns as many devices as any other."""
    numbers = Counter(owners)
    if len(set(numbers.values())) > 1:
        listed = ", ".join(f"process {i} has {numbers[i]}" for i in sorted(numbers))
        raise ValueError(
            "JAX lets processes meet that have as many devices each, but "
            f"{listed}: start them with equal numbers."
        )


class Pace:
    """Lets processes meet now and then, while each runs chunks of its own.

    So they learn of an error soon, and none waits long for one that is slower. All of
    them know from each meeting how many chunks there are to the next.
    """

    def __init__(self, processes: Processes, chunks: int, is_needed: bool):
        self._processes, self._left, self._to_run = processes, chunks, 1
        self._is_over = processes.count == 1 or not is_needed
        self._ran, self._since = 0, time.monotonic()

    def chunk_done(self) -> None:
        """Count a chunk, and meet if it is time."""
        self._left, self._ran = self._left - 1, self._ran + 1
        if not self._is_over and (self._left == 0 or self._ran == self._to_run):
            self._meet()

    def finish(self) -> None:
        """Meet until no process has a chunk left."""
        while not self._is_over:
            self._meet()

    def _meet(self) -> None:
        seconds = (time.monotonic() - self._since) / self._ran if self._ran else 0.0
        told = json.dumps([self._left, seconds]).encode()
        found = [json.loads(x) for x in self._processes.exchange(told)]
        slowest = max(seconds for _, seconds in found)
        self._to_run = max(1, int(_SECONDS / slowest)) if slowest else 1
        self._is_over = not any(left for left, _ in found)
        self._ran, self._since = 0, time.monotonic()
