"""The buffers into which a run saves states and records of its steps."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from .._custom_types import Args, FloatScalar
from .._step import StepRecord
from .._system import State
from ._checks import static_length
from ._log import LogEntry
from ._stepping import Taken


class Rows(NamedTuple):
    """The entries that one step saves, or the buffers with the entries of all steps.

    - `saved`: the time and the value of `SaveAt(fn=...)`; None if steps save none.
    - `record`: the record of the step for interpolation; None if none is kept.
    - `log`: the entry of an event for the log; None in a run that keeps none.
    - `row`: in a run with events the index of the step whose rows these are, which may
        be none; None in other runs, and in buffers.
    """

    saved: PyTree[Array] | None
    record: StepRecord | None
    log: LogEntry | None = None
    row: Int[Array, ""] | None = None


class RecordPlaces(NamedTuple):
    """The number of step records that are kept, and the row of each step's record.

    A record that is not kept is written to one extra row at the end of the buffer.
    """

    number: int
    slots: Int[Array, " nodes"] | None


def record_places(
    dense: bool, sampled: Int[Array, " k"] | None, num_steps: int | Int[Array, ""]
) -> RecordPlaces:
    """Find the places of the records for dense output or for the sampled steps."""
    if not dense and sampled is None:
        return RecordPlaces(0, None)
    length = static_length(num_steps)
    if dense or sampled is None:
        return RecordPlaces(length, jnp.arange(length + 1, dtype=jnp.int32))
    # There is one row for each sample, and samples in the same step share the row of
    # the first: there may be more steps than samples, and more samples than steps.
    number = sampled.shape[0]
    slots = jnp.full((length + 1,), number, jnp.int32)
    first = slots.at[sampled].min(jnp.arange(number, dtype=jnp.int32))
    return RecordPlaces(number, first)


class Saving(eqx.Module):
    """The choice of what the steps of a run save, and the places where they save it.

    A run saves the value of `fn` at the state after every `stride`-th step (after none
    if `stride` is 0), which makes `num_saved` entries, and `num_records` records of
    steps. `num_saved` and `num_steps` are Python's integers where their values are
    needed during tracing.
    """

    fn: Callable[[FloatScalar, State, Args], PyTree[Array]]
    num_steps: int | Int[Array, ""]
    stride: int = eqx.field(static=True)
    num_saved: int = eqx.field(static=True)
    num_records: int = eqx.field(static=True)
    record_slots: Int[Array, " nodes"] | None
    num_events: int = eqx.field(static=True, default=0)

    def saved(self, t: FloatScalar, y: State, args: Args) -> PyTree[Array]:
        """Compute the entry that is saved of a state: its time, and `fn` at it."""
        return t, jax.tree.map(jnp.asarray, self.fn(t, y, args))

    def rows(
        self,
        t: FloatScalar,
        y: State,
        args: Args,
        taken: Taken,
        k: Int[Array, ""],
    ) -> Rows:
        """Compute the rows that step k saves, which leads to the state y at t."""
        return Rows(self._state_row(t, y, args, k), self._record_row(taken))

    def _state_row(
        self, t: FloatScalar, y: State, args: Args, k: Int[Array, ""]
    ) -> PyTree[Array] | None:
        def save():
            return self.saved(t, y, args)

        if self.stride <= 1:
            return save() if self.stride else None
        nothing = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(save)
        )
        return jax.lax.cond(self._slot(k) < self.num_saved, save, lambda: nothing)

    def _record_row(self, taken: Taken) -> StepRecord | None:
        if not self.num_records:
            return None
        # After a failure the records are those of a system at rest, so that dense
        # output stays at the last good state.
        record, good = taken
        return StepRecord(
            record.start,
            jnp.where(good, record.velocity, 0),
            jnp.where(good, record.force, 0),
            jnp.where(good, record.multiplier, record.start.multiplier),
        )

    def _slot(self, k: Int[Array, ""]) -> Int[Array, ""]:
        kept = ((k + 1) % self.stride == 0) & (k < self.num_steps)
        return jnp.where(kept, (k + 1) // self.stride - 1, self.num_saved)

    def empty(self, row: Rows) -> Rows:
        """Make buffers of zeros for all rows that are saved, and for one more.

        `row` is what one step saves; its arrays may be given by their shapes alone.
        """

        def buffers(length, tree):
            return jax.tree.map(
                lambda x: jnp.zeros((length + 1, *x.shape), x.dtype), tree
            )

        return Rows(
            buffers(self.num_saved, row.saved),
            buffers(self.num_records, row.record),
            buffers(self.num_events, row.log),
        )

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of step k to their places; save nothing if k >= num_steps."""

        def put(buffer, row, slot):
            return jax.tree.map(
                lambda x, new: jax.lax.dynamic_update_index_in_dim(x, new, slot, 0),
                buffer,
                row,
            )

        saved, records, log, _ = buffers
        if rows.row is not None:
            # Steps that are cut have iterations of their own, but no more rows.
            k = rows.row
        if rows.log is not None:
            log = put(log, rows.log, rows.log.slot)
        if self.stride:
            saved = put(saved, rows.saved, self._slot(k))
        if self.record_slots is not None:
            slot = self.record_slots[jnp.minimum(k, self.num_steps)]
            records = put(records, rows.record, slot)
        return Rows(saved, records, log)

    def read(
        self, buffers: Rows, k: Int[Array, ""], event: Int[Array, ""] | None = None
    ) -> Rows:
        """Read the rows of step k from the buffers, from where `write` puts them.

        In a run with events k is the row that an iteration fills, and `event` the place
        of the event in the log.
        """

        def get(buffer, slot):
            return jax.tree.map(lambda x: x[slot], buffer)

        saved, records, log, _ = buffers
        if log is not None:
            log = get(log, event)
        if self.stride:
            saved = get(saved, self._slot(k))
        if self.record_slots is not None:
            records = get(records, self.record_slots[k])
        return Rows(saved, records, log)
