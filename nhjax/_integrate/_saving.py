"""The saved data of a run: the options of the user, and the buffers of the data."""

import reprlib
from collections.abc import Callable, Sequence
from typing import Any, cast, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._compile import write_row
from .._custom_types import Args, BoolScalar, FloatScalar, IntScalar
from .._errors import Check, DTypeError, is_traced, NonFiniteError
from .._step import StepRecord
from .._system import check_signature, State
from ._interpolation import step_position


def save_state(t: FloatScalar, y: State, args: Any) -> State:
    """Return the whole state `y`: the default of `fn` in `SaveAt`."""
    del t, args
    return y


class SaveAt(eqx.Module):
    """Options for the output of `integrate`: which states of a run are saved.

    Except for `checkpoint`, the options mean the same as in `diffrax.SaveAt`.

    **Arguments:**

    - `t0`: save the initial state.
    - `t1`: save the final state.
    - `ts`: save at these times, by evaluating the collocation polynomials. The times
        must not decrease; in a run backward in time, they must not increase.
    - `steps`: save after every step (True), or after every k-th step (an int k). With
        `t1=True` the final state is saved too, unless it is one of these states.
    - `dense`: save the collocation polynomials for `Solution.evaluate`.
    - `fn`: save `fn(t, y, args)` instead of y.
    - `checkpoint`: save a `Solution.checkpoint`, from which a later run continues bit
        for bit; see `nhjax.Checkpoint`.

    The output has one entry for each saved state; `nhjax.Solution` describes the
    exceptions in runs with events or with steps that differ in size. With constant
    steps, saving every k-th step (`steps=k`) and saving at given times (`ts`) need no
    buffer of the length of the run. The samples at `ts` are computed after the run,
    from the records of the steps that contain them. Inside a step, the polynomials have
    larger errors than the states at its ends, and the constraints hold up to these
    errors, not to round-off.

    **Raises:** `ValueError` if no output is selected, a flag is not a bool, `steps` is
    not a bool or an int >= 1, `ts` is not a sorted vector, or `ts` and `steps` are
    given together; `DTypeError` if `ts` is not real; `TypeError` if `fn` is not a
    function of (t, y, args). `integrate` raises a `TypeError` if `fn` returns something
    that is not an array or a tree of arrays.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...     disc.initial_state(), dt=0.1, num_steps=100,
        ...     saveat=nhjax.SaveAt(t0=True, steps=10))
        >>> sol.ts.shape
        (11,)
    """

    t0: bool = eqx.field(static=True, default=False)
    t1: bool = eqx.field(static=True, default=False)
    ts: Float[Array, " k"] | None = None
    steps: int = eqx.field(static=True, default=0)
    dense: bool = eqx.field(static=True, default=False)
    fn: Callable[[Any, Any, Any], PyTree[Array]] = save_state
    checkpoint: bool = eqx.field(static=True, default=False)

    def __init__(
        self,
        *,
        t0: bool = False,
        t1: bool = False,
        ts: Float[Array, " k"] | np.ndarray | Sequence[float] | None = None,
        steps: bool | int = False,
        dense: bool = False,
        fn: Callable[[Any, Any, Any], PyTree[Array]] = save_state,
        checkpoint: bool = False,
    ):
        flags = {"t0": t0, "t1": t1, "dense": dense, "checkpoint": checkpoint}
        for name, flag in flags.items():
            if not isinstance(flag, bool):
                advice = ""
                if name in ("t0", "t1"):
                    advice = (
                        " To save at given times, pass `ts`. A run starts at the `t0` "
                        "of `integrate`, and ends at its `t1` or after `num_steps`."
                    )
                raise ValueError(
                    f"SaveAt: `{name}` must be True or False, got {flag!r}.{advice}"
                )
        if not isinstance(steps, int | np.integer) or steps < 0:
            raise ValueError(
                f"SaveAt: `steps` must be a bool or an int >= 1, got {steps!r}."
            )
        if not (t0 or t1 or dense or steps or checkpoint or ts is not None):
            raise ValueError(
                "SaveAt: nothing is saved. Give at least one of `t0`, `t1`, `ts`, "
                "`steps`, `dense`, `checkpoint`."
            )
        if ts is not None and steps:
            raise ValueError(
                "SaveAt: give `ts` or `steps`, not both. With `dense=True` the "
                "solution can be evaluated at any time afterwards."
            )
        check_signature("SaveAt", "fn", fn, ("t", "y", "args"))
        self.t0, self.t1, self.dense, self.fn = t0, t1, dense, fn
        self.checkpoint = checkpoint
        self.steps = int(steps)
        self.ts = None if ts is None else _times(ts)

    def within(self, dt: FloatScalar) -> "SaveAt":
        """Return the options with `ts` in the dtype of a run."""
        if self.ts is None:
            return self
        return eqx.tree_at(lambda s: s.ts, self, self.ts.astype(dt.dtype))

    def checks(
        self, t0: FloatScalar, dt: FloatScalar, num_steps: int | IntScalar
    ) -> list[Check]:
        """Return the checks of `ts` for a run; raise if the run saves no data."""
        if self.num_saved(num_steps) == 0 and not (self.dense or self.checkpoint):
            raise ValueError(
                f"SaveAt: `steps={self.steps}` saves nothing in a run of {num_steps} "
                "steps. Add `t1=True`."
            )
        if self.ts is None:
            return []
        ts = self.ts.astype(dt.dtype)
        # In units of steps, the checks are the same for both directions of time and for
        # all dtypes.
        position, inside = step_position(ts, t0, dt, static_length(num_steps))
        return [
            Check(jnp.all(inside), _outside, (ts, t0, dt, num_steps)),
            Check(jnp.all(jnp.diff(position) >= 0), _unsorted, (dt,)),
        ]

    def num_saved(self, num_steps: int | IntScalar) -> int:
        """Return the number of entries of the output for a run of `num_steps` steps."""
        sampled = 0 if self.ts is None else self.ts.shape[0]
        strided = static_length(num_steps) // self.steps if self.steps else 0
        return self.t0 + sampled + strided + self.saves_end(num_steps)

    @property
    def saves_rows(self) -> bool:
        """Return whether an option other than `dense` or `checkpoint` saves output."""
        return self.t0 or self.t1 or self.steps > 0 or self.ts is not None

    def saves_end(self, num_steps: int | IntScalar) -> bool:
        """Return whether `t1` adds a final state that `steps` does not save."""
        last_is_saved = bool(self.steps) and static_length(num_steps) % self.steps == 0
        return self.t1 and not last_is_saved


def static_length(num_steps: int | IntScalar) -> int:
    """Return `num_steps`, which is known when tracing, as an int for type checkers."""
    assert isinstance(num_steps, int)
    return num_steps


def stack_saved(pieces: list[PyTree[Array]]) -> PyTree[Array]:
    """Concatenate pieces of the output along their leading axis, the time axis."""
    if len(pieces) == 1:
        return pieces[0]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pieces)


def _outside(
    ts: np.ndarray, t0: np.ndarray, dt: np.ndarray, num_steps: int
) -> ValueError:
    return ValueError(
        f"SaveAt: `ts` reaches from {float(np.min(ts))} to {float(np.max(ts))}, "
        f"outside the run from {float(t0)} to {float(t0 + num_steps * dt)}."
    )


def _unsorted(dt: np.ndarray) -> ValueError:
    return ValueError(
        "SaveAt: `ts` must be sorted in the direction of time, which runs "
        f"{'forward' if dt > 0 else 'backward'} here."
    )


def _times(ts: Any) -> Float[Array, " k"]:
    try:
        if is_traced(*jax.tree.leaves(ts)):
            ts = jnp.asarray(ts)
        else:
            # Concrete times stay concrete inside `jit`.
            with jax.ensure_compile_time_eval():
                ts = jnp.asarray(ts)
    except (TypeError, ValueError):
        raise DTypeError(
            f"SaveAt: `ts` must be a vector of real numbers, got {reprlib.repr(ts)} of "
            f"type {type(ts).__name__}."
        ) from None
    if jnp.issubdtype(ts.dtype, jnp.integer):
        ts = ts.astype(jnp.result_type(float))
    if not jnp.issubdtype(ts.dtype, jnp.floating):
        raise DTypeError(f"SaveAt: `ts` must be real, got dtype {ts.dtype}.")
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"SaveAt: `ts` must have shape (k,), k >= 1, got {ts.shape}.")
    if not is_traced(ts):
        # NumPy is needed: inside `jit`, operations of JAX return traced values.
        known = np.asarray(ts)
        if not np.all(np.isfinite(known)):
            raise NonFiniteError(f"SaveAt: `ts` is not finite: {ts}.")
        gaps = np.diff(known)
        if not (np.all(gaps >= 0) or np.all(gaps <= 0)):
            raise ValueError("SaveAt: `ts` must be sorted in the direction of time.")
    return ts


class Rows(NamedTuple):
    """The entries that one iteration saves, or buffers for all iterations.

    - `saved`: the time and the value of `SaveAt(fn=...)`, or None if the steps of the
        run save no values.
    - `record`: the record of the step for interpolation, or None if the run keeps no
        records.
    - `log`: an entry of the stepper's log, or None without a log.
    - `row`: the index of the output row, if it can differ from the index of the
        iteration. Otherwise, and in buffers, it is None.
    - `log_slot`: the index of the entry in the log; None without a log and in buffers.
    """

    saved: PyTree[Array] | None
    record: StepRecord | None
    log: PyTree[Array] | None = None
    row: Int[Array, ""] | None = None
    log_slot: Int[Array, ""] | None = None


class RecordPlaces(NamedTuple):
    """The number of step records that are kept, and the row of each step's record.

    A record that is not kept is written to one extra row at the end of the buffer.
    """

    number: int
    slots: Int[Array, " nodes"] | None


def record_places(
    dense: bool, sampled: Int[Array, " k"] | None, num_steps: int | Int[Array, ""]
) -> RecordPlaces:
    """Find the places of the records for dense output or for the steps in `sampled`."""
    if not dense and sampled is None:
        return RecordPlaces(0, None)
    length = static_length(num_steps)
    if dense or sampled is None:
        return RecordPlaces(length, jnp.arange(length + 1, dtype=jnp.int32))
    # The buffer has one row for each sample, but samples in the same step share the row
    # of the first such sample.
    number = sampled.shape[0]
    slots = jnp.full((length + 1,), number, jnp.int32)
    first = slots.at[sampled].min(jnp.arange(number, dtype=jnp.int32))
    return RecordPlaces(number, first)


class Saving(eqx.Module):
    """The data that the iterations of a run save, and their places in the buffers.

    A run saves the value of `fn` at the state after every `stride`-th step (after none
    if `stride` is 0), which gives `num_saved` entries. The run keeps `num_records`
    records of steps, and `log_length` entries of the stepper's log. `num_steps` is used
    only if steps save rows or records.

    For a chunk of a run, `first_step` is set, and the buffers begin with this step.
    Then `num_saved` and `num_records` are the numbers of rows in the buffers, and the
    records of all steps of the chunk are kept.
    """

    fn: Callable[[FloatScalar, State, Args], PyTree[Array]]
    num_steps: int | IntScalar
    stride: int | IntScalar
    num_saved: int = eqx.field(static=True)
    num_records: int = eqx.field(static=True)
    record_slots: Int[Array, " nodes"] | None
    log_length: int = eqx.field(static=True)
    first_step: IntScalar | None = None

    @classmethod
    def of(
        cls,
        saveat: SaveAt,
        fn: Callable[[FloatScalar, State, Args], PyTree[Array]],
        num_steps: int | IntScalar,
        places: RecordPlaces,
        log_length: int,
    ) -> "Saving":
        """Return the `Saving` for the options `saveat` and the function `fn`."""
        needs_length = saveat.steps or places.slots is not None
        length = static_length(num_steps) if needs_length else 0
        return cls(
            fn=fn,
            num_steps=length,
            stride=saveat.steps,
            num_saved=length // saveat.steps if saveat.steps else 0,
            num_records=places.number,
            record_slots=places.slots,
            log_length=log_length,
        )

    def saved(self, t: FloatScalar, y: State, args: Args) -> PyTree[Array]:
        """Compute the saved entry of a state: its time and the value of `fn`."""
        return t, jax.tree.map(jnp.asarray, self.fn(t, y, args))

    def row_of_state(
        self, t: FloatScalar, y: State, args: Args, k: Int[Array, ""]
    ) -> PyTree[Array] | None:
        """Compute the entry for the state y at t, the state after step k.

        The entry is zero if this step is not saved, and None if no step is saved.
        """

        def save():
            return self.saved(t, y, args)

        if isinstance(self.stride, int) and self.stride <= 1:
            return save() if self.stride else None
        zeros = jax.tree.map(
            lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(save)
        )
        return jax.lax.cond(self._slot(k) < self.num_saved, save, lambda: zeros)

    def row_of_record(
        self, record: StepRecord, is_good: BoolScalar
    ) -> StepRecord | None:
        """Return the record of a step, if records are saved.

        After a failure, records describe a system at rest, so that dense output stays
        at the last good state.
        """
        if not self.num_records:
            return None
        return StepRecord(
            record.start,
            jnp.where(is_good, record.velocity, 0),
            jnp.where(is_good, record.force, 0),
            jnp.where(is_good, record.multiplier, record.start.multiplier),
            record.interval,
        )

    def _slot(self, k: Int[Array, ""]) -> Int[Array, ""]:
        kept = ((k + 1) % self.stride == 0) & (k < self.num_steps)
        slot = (k + 1) // self.stride - 1
        if self.first_step is not None:
            slot = slot - self.first_step // self.stride
        return jnp.where(kept, slot, self.num_saved)

    def _record_slot(self, k: Int[Array, ""]) -> Int[Array, ""]:
        if self.record_slots is not None:
            return self.record_slots[jnp.minimum(k, self.num_steps)]
        # A chunk of a run has no `record_slots`, because it keeps the record of each of
        # its steps.
        slot = k - cast(Array, self.first_step)
        return jnp.where(k < self.num_steps, slot, self.num_records)

    def empty(self, row: Rows) -> Rows:
        """Return buffers of zeros for all rows that are saved, and for one extra row.

        `row` is the saved data of one iteration, as arrays or as their shapes.
        """

        def buffers(length, tree):
            return jax.tree.map(
                lambda x: jnp.zeros((length + 1, *x.shape), x.dtype), tree
            )

        return Rows(
            buffers(self.num_saved, row.saved),
            buffers(self.num_records, row.record),
            buffers(self.log_length, row.log),
        )

    def write(self, buffers: Rows, rows: Rows, k: Int[Array, ""]) -> Rows:
        """Write the rows of iteration k to their places.

        Rows that are not saved, such as rows after the last step, go to the extra row.
        """

        def put(buffer, row, slot):
            return jax.tree.map(
                lambda x, new: write_row(x, new, slot),
                buffer,
                row,
            )

        saved, records, log = buffers[:3]
        k = k if rows.row is None else rows.row
        if rows.log is not None:
            log = put(log, rows.log, rows.log_slot)
        if rows.saved is not None:
            saved = put(saved, rows.saved, self._slot(k))
        if self.num_records:
            records = put(records, rows.record, self._record_slot(k))
        return Rows(saved, records, log)

    def read(
        self, buffers: Rows, k: Int[Array, ""], log_slot: Int[Array, ""] | None = None
    ) -> Rows:
        """Read row k and an entry of the log from where `write` stored them."""

        def get(buffer, slot):
            return jax.tree.map(lambda x: x[slot], buffer)

        saved, records, log = buffers[:3]
        if log is not None:
            log = get(log, log_slot)
        if self.stride:
            saved = get(saved, self._slot(k))
        if self.record_slots is not None:
            records = get(records, self.record_slots[k])
        return Rows(saved, records, log)
