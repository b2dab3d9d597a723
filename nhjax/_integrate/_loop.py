"""The body of the time loop: it takes a step and saves what is to be saved of it."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from .._numerics import moving_with
from .._results import RESULTS
from .._step import RoundOff
from .._system import FunctionNoise, State
from ._checkpoint import Checkpoint
from ._event_stepper import EventStepping
from ._log import LogEntry, no_entry
from ._progress import Known
from ._progress_meter import AbstractProgressMeter
from ._saving import Rows, Saving, static_length
from ._stepper import Carry, progress_of, Stepping, Taken


class Loop(eqx.Module):
    """The time loop of a run: its steps, what it saves of them, and its progress meter.

    An adjoint calls `step` for k = 0, ..., num_steps - 1 in turn, and calls `write` to
    put the rows that each step returns into buffers that start as `empty_rows`.
    """

    stepping: Stepping
    saving: Saving
    meter: AbstractProgressMeter
    events: EventStepping | None = None

    @property
    def num_steps(self) -> int | Int[Array, ""]:
        """Return the number of steps of the run."""
        return self.saving.num_steps

    @property
    def num_iterations(self) -> int | Int[Array, ""]:
        """Return the number of iterations of the loop: its steps, unless it has events.

        With events an iteration takes a part of a step where there is an event in it.
        """
        return self.num_steps if self.events is None else self.events.num_iterations

    def start(self, y0: State | Checkpoint, noise: FunctionNoise | None) -> Carry:
        """Make the carry before the first step; see `Stepping.start`."""
        return (self.stepping if self.events is None else self.events).start(y0, noise)

    def with_round_off(self, round_off: RoundOff) -> "Loop":
        """Return the same loop, whose steps know the round-off of the system."""
        stepping = replace(self.stepping, round_off=round_off)
        events = self.events
        if events is not None:
            events = replace(events, stepping=stepping)
        return replace(self, stepping=stepping, events=events)

    def step(
        self, carry: Carry, k: Int[Array, ""], known: Known | None = None
    ) -> tuple[Carry, Rows]:
        """Take step k; return the carry after it and the rows that it saves.

        With events k counts iterations, and `known` is what a step back knows of it.
        """
        if self.events is not None:
            return self._go_on(self.events, carry, k, known)
        carry, taken = self.stepping.advance(carry, k)
        if not self.meter.silent:
            self.meter.report(k, static_length(self.num_steps))
        return carry, self._rows(carry, taken, k)

    def _go_on(
        self,
        events: EventStepping,
        carry: Carry,
        iteration: Int[Array, ""],
        known: Known | None,
    ) -> tuple[Carry, Rows]:
        """Go on to the next node or event."""
        carry, taken, entry, row = events.advance(carry, iteration, known)
        if not self.meter.silent:
            # So many steps are surely done, in all members of a batch: with numbers of
            # their own each member would report, and in all iterations.
            length = static_length(self.num_steps)
            k = iteration + np.int32(length - static_length(self.num_iterations))
            jax.lax.cond(k >= 0, lambda: self.meter.report(k, length), lambda: None)
        return carry, self._event_rows(events, carry, taken, entry, row)

    def _event_rows(
        self,
        events: EventStepping,
        carry: Carry,
        taken: Taken,
        entry: LogEntry,
        row: Int[Array, ""],
    ) -> Rows:
        t = self.stepping.time(row + 1)
        ended = carry.result == RESULTS.event_occurred
        t = jnp.where(ended, events.time(progress_of(carry)), t)
        y, args = carry.step_state.state, self.stepping.args
        rows = self.saving.rows(t, y, args, taken, row)
        log = None if events.consequences.ends_only else entry
        return rows._replace(log=log, row=row)

    def _rows(self, carry: Carry, taken: Taken, k: Int[Array, ""]) -> Rows:
        t, args = self.stepping.time(k + 1), self.stepping.args
        return self.saving.rows(t, carry.step_state.state, args, taken, k)

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of step k to the buffers of all rows."""
        return self.saving.write(buffers, rows, k)

    def row_shapes(self, carry: Carry) -> Rows:
        """Find the shapes of the rows that a step saves."""
        k = jnp.zeros((), jnp.int32)

        def rows() -> Rows:
            # No step is taken for this, since a step is dear to trace.
            taken = self.stepping.nothing_taken(carry)
            if self.events is None:
                return self._rows(carry, taken, k)
            entry = no_entry(self.stepping.time(0), carry.step_state.state)
            return self._event_rows(self.events, carry, taken, entry, k)

        return jax.eval_shape(rows)

    def moving(self, carry: Carry) -> Carry:
        """Return the same carry, whose state has tangents wherever the run has some."""
        state = moving_with(carry.step_state.state, self.stepping)
        return eqx.tree_at(lambda x: x.step_state.state, carry, state)

    def no_rows(self, carry: Carry) -> Rows:
        """Make rows of zeros for steps beyond the run's end, which `write` drops."""
        rows = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype), self.row_shapes(carry)
        )
        if self.events is None:
            return rows
        rows = rows._replace(row=jnp.full_like(rows.row, self.num_steps))
        if rows.log is None:
            return rows
        nowhere = jnp.full_like(rows.log.slot, self.events.consequences.max_events)
        return eqx.tree_at(lambda rows: rows.log.slot, rows, nowhere)

    def empty_rows(self, carry: Carry) -> Rows:
        """Make buffers of zeros for all rows that the run saves."""
        rows = self.saving.empty(self.row_shapes(carry))
        return moving_with(rows, (self.stepping, carry))
