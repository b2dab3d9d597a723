"""An iteration of a run with events: what it tried, and the place that it leads to."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import BoolScalar, FloatScalar
from .._step import StepState
from ._cut import Cut
from ._progress import Progress
from ._statistics import Statistics, updated_statistics
from ._stepping import Carry, progress_of


class Tried(NamedTuple):
    """An iteration of the time loop, before what follows from its event.

    - `alive`: whether the run had not ended before.
    - `steps`: whether it took a step from the time `t`, and did not meet an event at
        once; `cut` is that step.
    - `is_next`: whether the step is discarded, since there is an event in it at which
        the next iteration is to end.
    - `stepped`: whether the step, of the given `size`, is kept. It led to the state
        that is `reached`.
    - `which`: the index of the event at its end, -1 if it ended at a node.
    - `far`: the conditions at the end of the whole step, if it is cut.
    - `meets`, `fires`: whether there is an event, and whether there is room for it.
    """

    alive: BoolScalar
    steps: BoolScalar
    t: FloatScalar
    cut: Cut
    is_next: BoolScalar
    stepped: BoolScalar
    which: Int[Array, ""]
    far: Float[Array, " e"]
    meets: BoolScalar
    fires: BoolScalar
    size: FloatScalar
    reached: StepState

    @property
    def at_node(self) -> BoolScalar:
        """Tell whether the step led to the next node."""
        return self.stepped & ~self.meets

    @property
    def value(self) -> FloatScalar:
        """Return the value of the condition at the event, if it is round-off."""
        value, far = self.cut.values[self.which], self.far[self.which]
        small = float(jnp.finfo(value.dtype).eps) ** 0.5
        is_small = self.stepped & (jnp.abs(value) <= small * jnp.abs(far))
        return jnp.where(is_small, value, 0)


def statistics_after(
    carry: Carry, it: Tried, after: Progress, ends: BoolScalar, failed: BoolScalar
) -> Statistics:
    """Update the statistics of a run by an iteration, with which it may end."""
    node = progress_of(carry).node
    stats = updated_statistics(carry.stats, it.cut.outcome, it.steps, it.stepped, node)
    for name in ("failed_step", "worst_coordinate"):
        # A step that is discarded has not failed.
        stats[name] = jnp.where(ends, stats[name], carry.stats[name])
    stats["failed_step"] = jnp.where(failed, node, stats["failed_step"])
    stats |= {"num_steps": after.node, "num_events": after.num}
    return jax.lax.stop_gradient(stats)


def progress_after(
    dt: FloatScalar,
    before: Progress,
    it: Tried,
    pending: Bool[Array, " e"],
    ends: BoolScalar,
) -> Progress:
    """Find the place after an iteration, but for the sides of the conditions.

    The events that are `pending` come before the node at the same time.
    """
    here = before.offset + it.size
    # What is left of a step by round-off is left out.
    small = 4 * float(jnp.finfo(dt.dtype).eps)
    at_end = it.fires & ~ends & (jnp.abs(dt - here) <= small * jnp.abs(dt))
    at_end = at_end & ~jnp.any(pending)
    offset = jnp.where(it.fires, here, before.offset)
    offset = jnp.where(at_end, here - dt, jnp.where(it.at_node, 0, offset))
    return replace(
        before,
        node=before.node + (it.at_node | at_end).astype(jnp.int32),
        offset=offset,
        active=before.active + it.alive.astype(jnp.int32),
        num=before.num + it.fires.astype(jnp.int32),
        last=jnp.where(it.fires, it.which, before.last),
        is_cut=it.is_next,
        far=jax.lax.stop_gradient(it.cut.values),
    )
