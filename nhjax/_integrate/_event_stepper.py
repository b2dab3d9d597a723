"""The steps of a run with events: each iteration ends at a node or at an event."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import BoolScalar, FloatScalar, IntScalar
from .._numerics import tree_where
from .._results import RESULTS
from .._step import StepArguments, StepState
from .._system import FunctionNoise, State
from ._checkpoint import Checkpoint
from ._event import (
    Conditions,
    conditions_of,
    Consequences,
    consequences_of,
    Event,
    sides_at,
)
from ._log import LogEntry
from ._progress import Known, Progress
from ._root import Cut, CutOptions, primitive_cut_step
from ._stepper import (
    Carry,
    progress_of,
    Statistics,
    Stepping,
    Taken,
    updated_statistics,
)


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


class EventStepping(eqx.Module):
    """The events of a run, with functions that step from one to the next or to a node.

    An iteration of the time loop takes the rest of a step. If there is an event in it,
    the next iteration takes the same step again, as far as the event. So there may be
    two iterations more for each event, and one if it ends the run.
    """

    stepping: Stepping
    conditions: Conditions
    consequences: Consequences
    num_steps: int | IntScalar

    @classmethod
    def of(
        cls,
        events: tuple[Event, ...] | None,
        stepping: Stepping,
        y: State,
        num_steps: int | IntScalar,
    ) -> "EventStepping | None":
        """Make the stepping of a run from the user's events; None without events.

        A wrong event raises an error.
        """
        if events is None:
            return None
        given = stepping.time(0), y, stepping.args
        return cls(
            stepping=stepping,
            conditions=conditions_of(events, *given),
            consequences=consequences_of(events, stepping.system, *given),
            num_steps=num_steps,
        )

    @property
    def num_kept(self) -> int:
        """Return the number of events that are kept in a log on the way."""
        return 0 if self.consequences.ends_only else self.consequences.max_events

    @property
    def num_iterations(self) -> int | IntScalar:
        """Return the number of iterations within which the run surely ends."""
        consequences = self.consequences
        goes_on = not all(consequences.terminates)
        extra = 2 * consequences.max_events if goes_on else 0
        return self.num_steps + extra + 1

    def time(self, progress: Progress) -> FloatScalar:
        """Compute the time that a run has come to."""
        return self.stepping.time(progress.node) + progress.offset

    def start(self, y0: State | Checkpoint, noise: FunctionNoise | None) -> Carry:
        """Make the carry of the time loop before the first step."""
        carry = self.stepping.start(y0, noise)
        t = self.stepping.time(0)
        sides, known = sides_at(self.conditions, self.stepping, t, carry.step_state)
        unknown = (carry.result == RESULTS.successful) & ~known
        result = RESULTS.where(unknown, RESULTS.nonfinite_event, carry.result)
        zero = jnp.zeros((), jnp.int32)
        failed = jnp.where(unknown, zero, carry.stats["failed_step"])
        stats = carry.stats | {"failed_step": failed, "num_events": zero}
        progress = Progress(
            node=zero,
            offset=jnp.zeros_like(t),
            row=zero,
            active=zero,
            num=zero,
            last=-jnp.ones_like(zero),
            is_cut=jnp.zeros((), bool),
            far=sides.value,
            sides=sides,
            pending=jnp.zeros(sides.sign.shape, bool),
        )
        return Carry(carry.step_state, result, stats, progress)

    def advance(
        self, carry: Carry, iteration: Int[Array, ""], known: Known | None = None
    ) -> tuple[Carry, Taken, LogEntry, Int[Array, ""]]:
        """Go on to the next node or event; a run that has ended stays where it is.

        Also return what was taken, the entry of the event for the log, and the index of
        the output row that is filled, which is `num_steps` if none is. With `known` the
        event is not looked for.
        """
        before, it = progress_of(carry), self._tried(carry, known)
        met = self.consequences.after_event(
            self.conditions,
            self.stepping,
            fires=it.fires,
            which=it.which,
            t=it.t + it.size,
            step_state=it.reached,
            value=it.value,
            before=before,
        )
        result = RESULTS.where(it.steps, it.cut.outcome.result, carry.result)
        result = RESULTS.where(it.meets, RESULTS.too_many_events, result)
        result = RESULTS.where(it.fires, met.result, result)
        ends = it.alive & (result != RESULTS.successful)
        after = progress_after(self.stepping.dt, before, it, met.pending, ends)
        has_ended = carry.result != RESULTS.successful
        fills = (after.node > before.node) | ends | has_ended
        sides = before.sides.moved(it.at_node, it.cut.values)
        after = replace(
            after,
            row=jnp.minimum(before.row + fills.astype(jnp.int32), self.num_steps),
            sides=jax.lax.stop_gradient(tree_where(it.fires, met.sides, sides)),
            pending=jnp.where(it.fires, met.pending, before.pending),
        )
        entry = LogEntry(
            t=it.t + it.size,
            which=it.which,
            before=it.reached.state,
            after=met.step_state.state,
            # Under `jax.disable_jit` a loop counts by ints of Python.
            iteration=jnp.asarray(iteration, jnp.int32),
            node=before.node,
            offset=before.offset,
            size=it.size,
            scale=before.sides.scale(it.size)[it.which],
            node_after=after.node,
            offset_after=after.offset,
            slot=jnp.where(it.fires, before.num, self.consequences.max_events),
        )
        failed = ends & (result != RESULTS.event_occurred)
        stats = statistics_after(carry, it, after, ends, failed)
        taken = Taken(it.cut.outcome.record, it.stepped)
        row = jnp.where(fills, before.row, self.num_steps)
        return Carry(met.step_state, result, stats, after), taken, entry, row

    def _tried(self, carry: Carry, known: Known | None) -> Tried:
        """Take the rest of a step, or as far as the event that is known to be in it."""
        before = progress_of(carry)
        alive = (carry.result == RESULTS.successful) & (before.node < self.num_steps)
        at_once = jnp.any(before.pending)
        steps = alive & ~at_once
        t, h = self.time(before), self.stepping.dt - before.offset
        if known is not None:
            h = jnp.where(known.which >= 0, known.size, h)
        cut = _cut(self.stepping, self.conditions, carry, t, h, ~steps, known)
        solved = steps & (cut.outcome.result == RESULTS.successful)
        is_next = solved & (cut.fired < 0) & jnp.any(cut.crossed)
        if known is not None:
            is_next = jnp.zeros_like(is_next)
        stepped = solved & ~is_next
        first_pending = jnp.argmax(before.pending).astype(jnp.int32)
        which = jnp.where(at_once, first_pending, cut.fired)
        meets = (stepped | (alive & at_once)) & (which >= 0)
        reached = tree_where(stepped, cut.outcome.step_state, carry.step_state)
        size = jnp.where(stepped, cut.h, 0)
        # An event that is met again within round-off of its own time would be met for
        # ever.
        at_last = (before.num > 0) & before.sides.at_zero[which]
        small = 16 * float(jnp.finfo(t.dtype).eps) * jnp.abs(self.stepping.dt)
        again = stepped & at_last & (jnp.abs(size) <= small)
        return Tried(
            alive=alive,
            steps=steps,
            t=t,
            cut=cut,
            is_next=is_next,
            stepped=stepped,
            which=which,
            far=before.far,
            meets=meets,
            fires=meets & ~again & (before.num < self.consequences.max_events),
            size=size,
            reached=reached.differentiated_in_state(),
        )


def _cut(
    stepping: Stepping,
    conditions: Conditions,
    carry: Carry,
    t: FloatScalar,
    h: FloatScalar,
    skip: BoolScalar,
    known: Known | None,
) -> Cut:
    """Take the rest of a step as far as the first event in it."""
    start = carry.step_state.differentiated_in_state()
    given = stepping.args, stepping.invariants, stepping.round_off
    arguments = StepArguments(stepping.system, t, h, start, *given)
    progress = progress_of(carry)
    options = CutOptions(
        method=stepping.method,
        stage_solver=stepping.stage_solver,
        skip=skip,
        sides=progress.sides,
        is_cut=progress.is_cut & ~skip,
        far=progress.far,
        known=None if known is None else known.which,
    )
    programs = stepping.programs
    return primitive_cut_step(arguments, conditions, options, programs)
