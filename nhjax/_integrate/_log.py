"""The log of the events of a run: how it is kept, and what is reported of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import FloatScalar
from .._system import State
from ._progress import Progress


class EventLog(eqx.Module):
    """The events of a run, in their order: the field `events` of a `Solution`.

    - `num`: how many there were.
    - `ts`: their times, of shape (e,) for the e events that the run had room for.
    - `which`: which of the events that `integrate` was given each was, an index.
    - `before`, `after`: the states at the events before and after their resets, each a
        `State` with a leading axis of length e.

    Entries that no event has filled are infinite, and -1 in `which`.
    """

    num: Int[Array, ""]
    ts: Float[Array, " e"]
    which: Int[Array, " e"]
    before: PyTree[Array]
    after: PyTree[Array]


class LogEntry(eqx.Module):
    """What is kept of one event, or of all of them along a leading axis.

    The step back from an event starts from `before`; the other fields below are what it
    needs besides.

    - `iteration`: the index of the iteration of the time loop that ended at the event.
    - `node`, `offset`: the iteration started this long after node t_k, k = `node`.
    - `size`: the size of the step that ended at the event; 0 if there was none, since
        a reset before had carried the condition across zero.
    - `scale`: the size of the condition in that step, by `Sides.scale`.
    - `node_after`, `offset_after`: where the next iteration starts.
    - `slot`: the place of the entry in the log, behind its end if there is no event.
    """

    t: Float[Array, "*e"]
    which: Int[Array, "*e"]
    before: State
    after: State
    iteration: Int[Array, "*e"]
    node: Int[Array, "*e"]
    offset: Float[Array, "*e"]
    size: Float[Array, "*e"]
    scale: Float[Array, "*e"]
    node_after: Int[Array, "*e"]
    offset_after: Float[Array, "*e"]
    slot: Int[Array, "*e"]


def reported(log: LogEntry, num: Int[Array, ""]) -> EventLog:
    """Make the report of a run from its log, which has one more row than is used."""
    length = log.t.shape[0] - 1
    is_used = jnp.arange(length, dtype=jnp.int32) < num

    def padded(x: Array, padding: float | int) -> Array:
        used = is_used.reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(used, x[:-1], jnp.asarray(padding, x.dtype))

    def padded_state(y: State) -> State:
        return jax.tree.map(lambda x: padded(x, jnp.inf), y)

    return EventLog(
        num=num,
        ts=padded(log.t, jnp.inf),
        which=padded(log.which, -1),
        before=padded_state(log.before),
        after=padded_state(log.after),
    )


def log_at_end(progress: Progress, t: FloatScalar, y: State) -> LogEntry:
    """Make the log of a run that ended at its first event, if there was one."""
    node, offset = progress.node, progress.offset
    entry = LogEntry(
        t=t,
        which=progress.last,
        before=y,
        after=y,
        iteration=progress.active - 1,
        node=node,
        offset=jnp.zeros_like(offset),
        size=offset,
        scale=progress.sides.scale(offset)[progress.last],
        node_after=node,
        offset_after=offset,
        slot=jnp.zeros_like(node),
    )
    # A log has a row behind its end.
    return jax.tree.map(lambda x: jnp.stack([x, x]), entry)


def no_entry(t: FloatScalar, y: State) -> LogEntry:
    """Make an entry of the shapes that all entries of a run have."""
    zero = jnp.zeros((), jnp.int32)
    return LogEntry(t, zero, y, y, zero, zero, t, t, t, zero, t, zero)
