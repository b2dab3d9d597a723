"""The loop on the host that runs `integrate` in chunks of steps.

Outside of transformations a run is not one compiled program. Instead, a program takes a
chunk of steps. It computes the loop carry after the chunk from the loop carry before
it, and writes the output of the steps to the rows of a buffer of fixed size. Its
arguments include the first step, the number of steps and the stride of the output,
which is the number of steps from one saved state to the next. A run of another length
or with another stride therefore does not recompile. Between chunks the host moves the
rows to the output, updates the progress meter, and stops the run after Ctrl-C.
"""

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, PyTree

from ._checkpoint import MOST_STEPS
from ._progress_meter import AbstractProgressMeter


# The approximate number of array elements in the buffers of a chunk, and the limits of
# the number of rows.
_BUFFER_SIZE = 2**17
_LEAST_ROWS, _MOST_ROWS = 16, 4096
# Unless a progress meter sets the lengths of chunks, the first chunk has at most
# `_FIRST_ITERATIONS` iterations, and later chunks take about `_SECONDS` or less.
_FIRST_ITERATIONS = 256
_SECONDS = 0.2
# One call computes the output at this many of the times of `SaveAt(ts=...)`.
SAMPLES_AT_ONCE = 64
# The stride of a run in which no step saves output.
NO_STRIDE = MOST_STEPS


class Span(NamedTuple):
    """The part of a run that one chunk takes; a program gets the fields in one array.

    - `start`, `end`: the first iteration, and the index after the last iteration.
    - `stride`: save the state after every `stride`-th step of the run.
    - `num_steps`: the number of steps of the run.
    - `saves_end`: whether to compute the output of the last state, 0 or 1.
    """

    start: Any
    end: Any
    stride: Any
    num_steps: Any
    saves_end: Any


class Output(NamedTuple):
    """The output of all chunks of a run, as arrays of NumPy.

    - `last`: the result of the last chunk.
    - `saved`: the saved rows, along a leading axis, or None.
    - `records`: the data for interpolation of all steps, or of the steps in the
        argument `recorded` of `drive`; None if no records are kept.
    - `num_steps`: the number of steps for which there are rows.
    - `is_interrupted`: whether Ctrl-C ended the run before its last step.
    """

    last: Any
    saved: PyTree[np.ndarray] | None
    records: PyTree[np.ndarray] | None
    num_steps: int
    is_interrupted: bool


def room_for(rows: PyTree[Any]) -> int:
    """Return the number of rows of a buffer, given the arrays of one row."""
    numbers = sum(math.prod(x.shape) for x in jax.tree.leaves(rows))
    room = 2 ** int(math.log2(_BUFFER_SIZE / max(numbers, 1)))
    return min(max(room, _LEAST_ROWS), _MOST_ROWS)


def drive(
    chunk: Callable[[Any, Any, Array], Any],
    carry: Any,
    log: Any,
    *,
    num_steps: int,
    num_iterations: int,
    stride: int,
    room: int,
    saves_end: Callable[[int], bool],
    recorded: np.ndarray | None,
    keeps_records: bool,
    meter: AbstractProgressMeter,
    may_end_early: bool = False,
) -> Output:
    """Take all steps of a run in chunks, and collect their rows.

    **Arguments:**

    - `chunk`: the function that takes a chunk of steps, called with the carry, the log
        and the numbers of a `Span`. Its result has the fields `carry`, `log`,
        `num_filled` (the number of steps with rows so far), `saved` and `records`.
    - `carry`, `log`: the loop carry and the event log before the first iteration.
    - `num_steps`, `num_iterations`: the numbers of steps and of iterations of the run.
    - `stride`, `room`: the stride of the output, and the number of rows of the buffers.
    - `saves_end`: a function that returns whether a run of a given number of steps
        saves its last state.
    - `recorded`: the sorted indices of the steps whose records are needed; None if all
        records are needed.
    - `keeps_records`: whether chunks return records of steps.
    - `meter`: the progress meter.
    - `may_end_early`: whether the run may end before its last iteration. The result of
        a chunk then also has the fields `is_over`, whether the run has ended, and
        `progress`, the part of the run that is done.
    """
    done, filled, last = 0, 0, None
    saved, records = [], []
    schedule = _Schedule(num_steps, num_iterations, meter, may_end_early)
    with _interruptions() as is_interrupted:
        is_over = False
        while not is_over and done < num_iterations and not (done and is_interrupted()):
            most = (filled // stride + room) * stride - filled
            if keeps_records:
                most = min(most, room)
            end = min(done + schedule.length(done, most), num_iterations)
            at_end = end == num_iterations and saves_end(num_steps)
            at_end = at_end or may_end_early
            started = time.monotonic()
            last = chunk(carry, log, _span(done, end, stride, num_steps, at_end))
            before, filled = filled, int(last.num_filled)
            schedule.finished(end - done, time.monotonic() - started)
            carry, log, done = last.carry, last.log, end
            count = filled // stride - before // stride
            if last.saved is not None and count:
                saved.append(_rows(last.saved, slice(count)))
            if keeps_records:
                records.append(_rows(last.records, _asked(recorded, before, filled)))
            if may_end_early:
                is_over = bool(last.is_over)
                schedule.report_part(1.0 if is_over else float(last.progress))
            else:
                is_over = done == num_iterations
                schedule.report(done)
        if not (is_over or may_end_early):
            span = _span(done, done, stride, filled, saves_end(filled))
            last = chunk(carry, log, span)
    return Output(
        last,
        _joined(saved),
        _joined(records),
        filled if may_end_early or not is_over else num_steps,
        not is_over,
    )


def on_device(tree: PyTree[np.ndarray], like: Any) -> PyTree[Any]:
    """Return arrays of JAX with these values, on the device of the array `like`."""
    # In contrast to `jnp.asarray`, this does not compile a program.
    with jax.default_device(next(iter(like.devices()))):
        return jax.device_put(tree)


def joined(pieces: list[PyTree[Any]]) -> PyTree[np.ndarray]:
    """Concatenate pieces of the output along their leading axis, on the host."""
    return _joined([jax.tree.map(np.asarray, piece) for piece in pieces])


def padded(x: np.ndarray, length: int) -> np.ndarray:
    """Extend an array to a given length by repeating its last entry."""
    return np.concatenate([x, np.broadcast_to(x[-1:], (length - len(x), *x.shape[1:]))])


def _span(*numbers: int) -> Array:
    return jax.device_put(np.array(Span(*numbers), np.int32))


def _rows(buffers: PyTree[Any], which: Any) -> PyTree[np.ndarray]:
    # The rows are copied, because a view would keep the whole buffer in memory.
    return jax.tree.map(lambda x: np.array(np.asarray(x)[which]), buffers)


def _asked(recorded: np.ndarray | None, before: int, filled: int) -> Any:
    """Find the rows of a buffer whose records are needed."""
    if recorded is None:
        return slice(filled - before)
    return recorded[(recorded >= before) & (recorded < filled)] - before


def _joined(pieces: list[PyTree[np.ndarray]]) -> PyTree[np.ndarray] | None:
    if len(pieces) < 2:
        return pieces[0] if pieces else None
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *pieces)


class _Schedule:
    """The lengths of the chunks, and the reports to the progress meter.

    Events may take up to `surplus` additional iterations. After `done` iterations, at
    least `done - surplus` steps are therefore complete, and only these steps are
    reported.
    """

    def __init__(
        self,
        num_steps: int,
        num_iterations: int,
        meter: AbstractProgressMeter,
        may_end_early: bool,
    ):
        self._meter, self._num_steps = meter, num_steps
        self._may_end_early = may_end_early
        self._surplus = num_iterations - num_steps
        # A meter is updated about a hundred times per run.
        self._every = max(1, num_steps // 100)
        self._next, self._percent = _FIRST_ITERATIONS, 0

    def length(self, done: int, most: int) -> int:
        """Return the number of iterations of the next chunk, at most `most`."""
        if self._meter.silent or self._may_end_early:
            return min(self._next, most)
        steps = max(done - self._surplus, 0)
        if steps == 0:
            return min(self._surplus + 1 - done, most)
        return min(self._every - steps % self._every, most)

    def finished(self, length: int, seconds: float) -> None:
        """Set the length of the next chunk from the time of the last chunk."""
        factor = _SECONDS / max(seconds, 1e-3 * _SECONDS)
        self._next = max(1, min(int(length * factor), 8 * self._next))

    def report_part(self, part: float) -> None:
        """Report the part of a run that is done, from 0 to 1, as a percentage."""
        percent = int(100 * part)
        if not self._meter.silent and percent > self._percent:
            self._meter.update_part(percent)
        self._percent = max(percent, self._percent)

    def report(self, done: int) -> None:
        """Report the steps that are complete after `done` iterations."""
        steps = done - self._surplus
        is_due = steps == 1 or steps % self._every == 0 or steps == self._num_steps
        if not self._meter.silent and steps > 0 and is_due:
            self._meter.update(steps, self._num_steps)


@contextlib.contextmanager
def _interruptions() -> Iterator[Callable[[], bool]]:
    """Catch Ctrl-C; yield a function that returns whether it was pressed.

    A second Ctrl-C raises `KeyboardInterrupt` as usual. If another handler is
    installed, or if this is not the main thread, Ctrl-C is not caught.
    """
    pressed = threading.Event()
    is_ours = (
        threading.current_thread() is threading.main_thread()
        and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    )
    if not is_ours:
        yield pressed.is_set
        return

    def handle(number: int, frame: Any) -> None:
        if pressed.is_set():
            signal.default_int_handler(number, frame)
        pressed.set()

    signal.signal(signal.SIGINT, handle)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
