"""The log of the events of a run, from which the report for users is made."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..._system import State
from .._solution import EventLog


class LogEntry(eqx.Module):
    """The log entry of one event, or the entries of all events along a leading axis.

    A reverse replay, for derivatives, undoes the step to an event from `before`, the
    state at the event before the reset. It also needs the following fields.

    - `iteration`: the index of the iteration of the time loop that ended at the event.
    - `node`, `offset`: the iteration started at t_k + offset, where k = `node`.
    - `size`: the size of the step that ended at the event; 0 if there was no step,
        because an earlier reset had carried the condition across zero.
    - `scale`: the size of the event's condition at the start of that step, computed by
        `ConditionSigns.scale`.
    - `node_after`, `offset_after`: where the next iteration starts.
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


def reported_log(log: LogEntry, num: Int[Array, ""]) -> EventLog:
    """Return the report of `num` events from a log, whose last row is unused."""
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
