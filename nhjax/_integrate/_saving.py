"""What is saved of a run on the way, and where."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from .._custom_types import Args, FloatScalar
from .._step import StepRecord
from .._system import State
from ._checks import known
from ._stepping import Taken


class Rows(NamedTuple):
    """What a step leaves to be saved, or the buffers of all that was."""

    saved: PyTree[Array] | None
    record: StepRecord | None


class RecordPlaces(NamedTuple):
    """How many records of steps are kept, and in which row that of each step is.

    What is not kept is written to one row more than there are.
    """

    number: int
    slots: Int[Array, " num_steps+1"] | None


def record_places(
    dense: bool, sampled: Int[Array, " k"] | None, num_steps: int | Int[Array, ""]
) -> RecordPlaces:
    """The places of records for dense output, or for samples in the given steps."""
    if not dense and sampled is None:
        return RecordPlaces(0, None)
    length = known(num_steps)
    if dense or sampled is None:
        return RecordPlaces(length, jnp.arange(length + 1, dtype=jnp.int32))
    # A row per sample, of which the first in a step is used: there may be more steps
    # than samples, and more samples than steps.
    number = sampled.shape[0]
    slots = jnp.full((length + 1,), number, jnp.int32)
    first = slots.at[sampled].min(jnp.arange(number, dtype=jnp.int32))
    return RecordPlaces(number, first)


class Saving(eqx.Module):
    """What is saved: `fn` of the state after every `stride`-th step (0: of none), and
    the records of some steps.

    `num_saved` is how many states that makes; it and `num_steps` are known where they
    are needed.
    """

    fn: Callable[[FloatScalar, State, Args], PyTree[Array]]
    num_steps: int | Int[Array, ""]
    stride: int = eqx.field(static=True)
    num_saved: int = eqx.field(static=True)
    num_records: int = eqx.field(static=True)
    record_slots: Int[Array, " num_steps+1"] | None

    def saved(self, t: FloatScalar, y: State, args: Args) -> PyTree[Array]:
        """What is saved of a state: its time and `fn` of it."""
        return t, jax.tree.map(jnp.asarray, self.fn(t, y, args))

    def rows(
        self, t: FloatScalar, y: State, args: Args, taken: Taken, k: Int[Array, ""]
    ) -> Rows:
        """What step k, which leads to the state y at t, leaves to be saved."""
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
        # At rest after a failure, so that dense output stays where it was.
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
        """Buffers for all rows that are saved, and one more, from the shapes of one."""

        def buffers(length, tree):
            return jax.tree.map(
                lambda x: jnp.zeros((length + 1, *x.shape), x.dtype), tree
            )

        return Rows(
            buffers(self.num_saved, row.saved), buffers(self.num_records, row.record)
        )

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of step k where they belong; k >= num_steps saves nothing."""

        def put(buffer, row, slot):
            return jax.tree.map(
                lambda x, new: jax.lax.dynamic_update_index_in_dim(x, new, slot, 0),
                buffer,
                row,
            )

        saved, records = buffers
        if self.stride:
            saved = put(saved, rows.saved, self._slot(k))
        if self.record_slots is not None:
            slot = self.record_slots[jnp.minimum(k, self.num_steps)]
            records = put(records, rows.record, slot)
        return Rows(saved, records)

    def read(self, buffers: Rows, k: Int[Array, ""]) -> Rows:
        """The rows of step k in buffers of all rows, where `write` puts them."""

        def get(buffer, slot):
            return jax.tree.map(lambda x: x[slot], buffer)

        saved, records = buffers
        if self.stride:
            saved = get(saved, self._slot(k))
        if self.record_slots is not None:
            records = get(records, self.record_slots[k])
        return Rows(saved, records)
