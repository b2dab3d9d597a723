"""The stepper of runs with events: each iteration ends at a node or at an event.

An iteration takes a step or, after an event, the rest of a step. If the step contains
an event, the iteration is discarded, and the next iteration takes the same step again,
truncated at the event. So each event may need two additional iterations, and an event
that ends the run needs one.
"""

from dataclasses import replace
from typing import Any, cast, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._custom_types import BoolScalar, FloatScalar, IntScalar
from ..._numerics import nan_gradient_unless, tree_where, two_sum
from ..._results import RESULTS
from ..._step import first_step_state, ImplicitStep, StepArguments, StepState
from ..._system import FunctionNoise, State
from .._checkpoint import Checkpoint
from .._solution import EventLog
from .._step_sizes import Attempt, Decision
from .._stepper import (
    AbstractCarry,
    AbstractReverseReplay,
    AbstractStepper,
    PlainStepper,
    Rows,
    RunEnd,
    Statistics,
    step_back,
    StepInterval,
    StepResult,
    updated_statistics,
)
from .._variable import (
    Clock,
    NextStep,
    started,
    statistics_of_attempt,
    StepSizes,
)
from ._event import (
    Conditions,
    ConditionSigns,
    Event,
    EventActions,
    EventOutcome,
    signs_at,
)
from ._log import LogEntry, reported_log
from ._root import ImplicitTruncatedStep, TruncatedStep


class EventLoopState(eqx.Module):
    """The current place of a run with events.

    Derivatives pass only through `offset`.

    - `node`, `offset`: the time is t_k + offset with k = `node`.
    - `row`: the number of output rows that are filled. It equals `node` until the run
        ends. After that, with constant steps, every iteration fills one more row.
    - `num_iterations`: the number of iterations so far, except idle iterations after
        the end of the run.
    - `num_events`, `last_event`: the number of events, and the index of the last one.
    - `truncates`: whether the next step must be truncated, because it contains an
        event.
    - `values_at_end`: if the next step is truncated, the values of the conditions at
        the end of the whole step.
    - `signs`: the signs of the conditions.
    - `pending`: the conditions that the last resets have carried across zero, and whose
        events have not happened yet.
    - `clock`: the time of the last node and the size of the step, in a run with
        variable steps.
    """

    node: Int[Array, ""]
    offset: FloatScalar
    row: Int[Array, ""]
    num_iterations: Int[Array, ""]
    num_events: Int[Array, ""]
    last_event: Int[Array, ""]
    truncates: Bool[Array, ""]
    values_at_end: Float[Array, " e"]
    signs: ConditionSigns
    pending: Bool[Array, " e"]
    clock: Clock | None = None


class EventCarry(AbstractCarry):
    """The carry of a run with events.

    Derivatives pass through `step_state` and `place.offset`.
    """

    step_state: StepState
    result: RESULTS
    stats: Statistics
    place: EventLoopState


class ReplayedIteration(eqx.Module):
    """The data that a reverse replay has about an iteration, besides its state.

    - `node`, `offset`, `num_events`: the values at the start of the iteration, as in
        `EventLoopState`.
    - `row`: the number of output rows that were filled before. For a discarded
        iteration it is the number of steps of the run, which is the index of an unused
        row.
    - `which`: the index of the event at the end of the iteration, or -1.
    - `size`: the size of the step.
    - `scale`: as in `LogEntry`, for the event `which`.
    - `is_active`: whether the iteration took a step or handled an event without a step.
        Otherwise the iteration was idle or discarded.
    - `was_truncated`: whether the previous iteration was discarded, because its step
        contains an event.
    """

    node: Int[Array, ""]
    offset: FloatScalar
    num_events: Int[Array, ""]
    row: Int[Array, ""]
    which: Int[Array, ""]
    size: FloatScalar
    scale: FloatScalar
    is_active: Bool[Array, ""]
    was_truncated: Bool[Array, ""]


class AttemptedStep(NamedTuple):
    """The step of an iteration, before the action of its event.

    - `is_alive`: whether the run has not ended before this iteration.
    - `is_taken`: whether a step was taken from the time `t`. An event that is pending
        happens without a step.
    - `step`: that step.
    - `is_discarded`: whether the step is discarded, because an event was found in it.
    - `is_kept`, `size`, `reached`: whether the step is kept, its size, and the state
        that it led to.
    - `which`: the index of the event at the end of the step, -1 if it ended at a node.
    - `values_at_end`: if the step is truncated, the conditions at the end of the whole
        step.
    - `meets`, `fires`: whether there is an event, and whether its action is taken. The
        action is not taken if the limit of events is reached, or if the same event
        repeats at the same time.
    - `whole`: the size of the whole step from the last node.
    - `decision`, `next_step`: in a run with variable steps, the decision of the
        controller about the step, and the step as it would end without events.
    """

    is_alive: BoolScalar
    is_taken: BoolScalar
    t: FloatScalar
    step: TruncatedStep
    is_discarded: BoolScalar
    is_kept: BoolScalar
    which: Int[Array, ""]
    values_at_end: Float[Array, " e"]
    meets: BoolScalar
    fires: BoolScalar
    size: FloatScalar
    reached: StepState
    whole: FloatScalar
    decision: Decision | None
    next_step: NextStep | None

    @property
    def is_rejected(self) -> BoolScalar:
        """Return whether the step was not solved, or not accepted by the controller."""
        return self.is_taken & ~self.is_kept & ~self.is_discarded

    @property
    def reaches_node(self) -> BoolScalar:
        """Return whether the step led to the next node."""
        return self.is_kept & ~self.meets

    @property
    def value(self) -> FloatScalar:
        """Return the event's condition if its value may be round-off, otherwise 0."""
        value, at_end = self.step.values[self.which], self.values_at_end[self.which]
        small = float(jnp.finfo(value.dtype).eps) ** 0.5
        is_small = self.is_kept & (jnp.abs(value) <= small * jnp.abs(at_end))
        return jnp.where(is_small, value, 0)


class EventStepper(AbstractStepper[EventCarry, ReplayedIteration]):
    """Steps from node to node, truncated at events.

    `plain` takes the single steps. `sizes` chooses their sizes, or is None for constant
    steps.
    """

    plain: PlainStepper
    conditions: Conditions
    actions: EventActions
    sizes: StepSizes | None

    @classmethod
    def of(
        cls,
        events: tuple[Event, ...],
        plain: PlainStepper,
        y: State,
        sizes: StepSizes | None = None,
    ) -> "EventStepper":
        """Return the stepper for the user's events in a run that starts at y.

        **Raises:** `TypeError`, `ShapeError` or `DTypeError` for a function of an event
        that returns a wrong type, shape or dtype.
        """
        given = plain.time(0), y, plain.args
        conditions = Conditions.of(events, *given)
        actions = EventActions.of(events, plain.system, *given)
        return cls(plain, conditions, actions, sizes)

    @property
    def num_iterations(self) -> int | IntScalar:
        """Return an upper bound on the number of iterations of the run."""
        actions = self.actions
        goes_on = not all(actions.terminates)
        extra = 2 * actions.max_events if goes_on else 0
        steps = self.plain.num_steps if self.sizes is None else self.sizes.max_steps
        return steps + extra + 1

    @property
    def may_end_early(self) -> bool:
        """Return whether the number of attempts at steps is not known in advance."""
        return self.sizes is not None

    def is_over(self, carry: EventCarry) -> BoolScalar:
        """Return whether the run has ended."""
        over = carry.result != RESULTS.successful
        if carry.place.clock is None:
            return over | (carry.place.node >= self.plain.num_steps)
        return over | carry.place.clock.is_done

    @property
    def log_length(self) -> int:
        """Return the number of events for which the log has room.

        If events only end the run, no log is kept during the run, and `finish` creates
        it.
        """
        return 0 if self.actions.only_end else self.actions.max_events

    def num_filled(self, carry: EventCarry, i: Int[Array, ""]) -> Int[Array, ""]:
        """Return the number of output rows that are filled, from the carry."""
        del i
        return carry.place.row

    def with_noise(self, noise: FunctionNoise) -> "EventStepper":
        """Return the same stepper with the measured round-off of the system."""
        return replace(self, plain=self.plain.with_noise(noise))

    def progress(self, carry: EventCarry) -> Any:
        """Compute the part of the run that is done, from 0 to 1, for variable steps."""
        if self.sizes is None or carry.place.clock is None:
            return None
        return self.sizes.progress(self.plain, carry.place.clock, carry.stats)

    def time(self, place: EventLoopState) -> FloatScalar:
        """Compute the current time of a run."""
        if place.clock is not None:
            return place.clock.t + place.offset
        return self.plain.time(place.node) + place.offset

    def init(self, y0: State | Checkpoint) -> EventCarry:
        """Return the carry before the first iteration."""
        carry = self.plain.init(y0)
        t = self.plain.time(0)
        signs, known = signs_at(self.conditions, self.plain, t, carry.step_state)
        unknown = (carry.result == RESULTS.successful) & ~known
        result = RESULTS.where(unknown, RESULTS.nonfinite_event, carry.result)
        zero = jnp.zeros((), jnp.int32)
        failed = jnp.where(unknown, zero, carry.stats["failed_step"])
        stats = carry.stats | {"failed_step": failed, "num_events": zero}
        clock = None
        if self.sizes is not None:
            clock, sized = self.sizes.first_clock(self.plain, y0, carry.step_state)
            carry = replace(carry, result=result, stats=stats)
            result, stats = started(carry, sized, self.sizes.controller)
        place = EventLoopState(
            node=zero,
            offset=jnp.zeros_like(t),
            row=zero,
            num_iterations=zero,
            num_events=zero,
            last_event=-jnp.ones_like(zero),
            truncates=jnp.zeros((), bool),
            values_at_end=signs.value,
            signs=signs,
            pending=jnp.zeros(signs.sign.shape, bool),
            clock=clock,
        )
        return EventCarry(carry.step_state, result, stats, place)

    def advance(
        self,
        carry: EventCarry,
        i: Int[Array, ""],
        replay: ReplayedIteration | None = None,
    ) -> tuple[EventCarry, StepResult]:
        """Advance to the next node or event. A run that has ended does not change.

        If a reverse replay repeats an iteration, `replay` has its step size and event.
        """
        before, num_steps = carry.place, self.plain.num_steps
        attempt = self._attempt(carry, replay)
        step = attempt.step
        outcome = self.actions.apply(
            self.conditions,
            self.plain,
            fires=attempt.fires,
            which=attempt.which,
            t=attempt.t + attempt.size,
            step_state=attempt.reached,
            value=attempt.value,
            signs=before.signs,
            pending=before.pending,
        )
        result = RESULTS.where(attempt.is_taken, step.outcome.result, carry.result)
        if attempt.decision is not None:
            # The controller decides, because it may repeat a step that is not solved.
            decided = attempt.decision.result
            result = RESULTS.where(attempt.is_taken, decided, carry.result)
        result = RESULTS.where(attempt.meets, RESULTS.too_many_events, result)
        result = RESULTS.where(attempt.fires, outcome.result, result)
        ends = attempt.is_alive & (result != RESULTS.successful)
        after = _place_after(before, attempt, outcome.pending, ends)
        if self.sizes is None:
            has_ended = carry.result != RESULTS.successful
            fills = (after.node > before.node) | ends | has_ended
        else:
            clock, found = self._clock_after(before, after, attempt, outcome)
            after = replace(after, clock=clock)
            is_bad = attempt.fires & (result == RESULTS.successful)
            is_bad = is_bad & (found != RESULTS.successful)
            result = RESULTS.where(is_bad, found, result)
            ends = ends | is_bad
            # Iterations for events do not count towards `max_steps`.
            rejected = attempt.is_rejected.astype(jnp.int32)
            number = after.node + carry.stats["num_rejected_steps"] + rejected
            is_last = jnp.asarray(i, jnp.int32) + 1 >= self.num_iterations
            is_spent = attempt.is_alive & (is_last | (number >= self.sizes.max_steps))
            is_spent = is_spent & (result == RESULTS.successful)
            is_spent = is_spent & ~cast(Clock, after.clock).is_done
            result = RESULTS.where(is_spent, RESULTS.max_steps_reached, result)
            ends = ends | is_spent
            ended_here = ends & (result == RESULTS.event_occurred)
            fills = (after.node > before.node) | ended_here
        signs = before.signs.after_step(attempt.reaches_node, step.values)
        after = replace(
            after,
            row=jnp.minimum(before.row + fills.astype(jnp.int32), num_steps),
            signs=jax.lax.stop_gradient(
                tree_where(attempt.fires, outcome.signs, signs)
            ),
            pending=jnp.where(attempt.fires, outcome.pending, before.pending),
        )
        entry = LogEntry(
            t=attempt.t + attempt.size,
            which=attempt.which,
            before=attempt.reached.state,
            after=outcome.step_state.state,
            # With `jax.disable_jit` the index of a loop is a Python int.
            iteration=jnp.asarray(i, jnp.int32),
            node=before.node,
            offset=before.offset,
            size=attempt.size,
            scale=before.signs.scale(attempt.size)[attempt.which],
            node_after=after.node,
            offset_after=after.offset,
        )
        max_events = self.actions.max_events
        slot = jnp.where(attempt.fires, before.num_events, max_events)
        failed = ends & (result != RESULTS.event_occurred)
        stats = _statistics_after(carry, attempt, after, ends, failed)
        row = jnp.where(fills, before.row, num_steps)
        carry = EventCarry(outcome.step_state, result, stats, after)
        record = step.outcome.record
        if after.clock is not None:
            t = self.time(after)
            record = replace(record, interval=(attempt.t, attempt.size))
        else:
            t = self.plain.time(row + 1)
            t = jnp.where(result == RESULTS.event_occurred, self.time(after), t)
        offered = StepResult(t, record, attempt.is_kept, row)
        return carry, self._with_log(offered, entry, slot)

    def _with_log(
        self, result: StepResult, entry: LogEntry, slot: Int[Array, ""]
    ) -> StepResult:
        if not self.log_length:
            return result
        return result._replace(log_entry=entry, log_slot=slot)

    def _attempt(
        self, carry: EventCarry, replay: ReplayedIteration | None
    ) -> AttemptedStep:
        """Take the rest of a step; if `replay` has an event, only the part up to it."""
        before, plain = carry.place, self.plain
        alive = ~self.is_over(carry)
        at_once = jnp.any(before.pending)
        is_taken = alive & ~at_once
        t, whole, next_step, decision = self.time(before), plain.dt, None, None
        h = whole - before.offset
        if self.sizes is not None and before.clock is not None:
            next_step = self.sizes.next_step(before.clock, before.offset)
            h, whole = next_step.h, before.offset + next_step.h
        if replay is not None:
            h = jnp.where(replay.which >= 0, replay.size, h)
        step = self._step(carry, t, h, ~is_taken, replay)
        solved = is_taken & (step.outcome.result == RESULTS.successful)
        if self.sizes is not None and next_step is not None:
            decision = self._decision(carry, next_step, step, solved)
            # An event counts only if its step is accepted, because an event in an
            # inaccurate step may not exist. A step that ends at an event is a part of a
            # step that was accepted before.
            solved = solved & (decision.is_accepted | (step.fired >= 0))
        is_discarded = solved & (step.fired < 0) & jnp.any(step.crossed)
        if replay is not None:
            is_discarded = jnp.zeros_like(is_discarded)
        is_kept = solved & ~is_discarded
        first_pending = jnp.argmax(before.pending).astype(jnp.int32)
        which = jnp.where(at_once, first_pending, step.fired)
        meets = (is_kept | (alive & at_once)) & (which >= 0)
        reached = tree_where(is_kept, step.outcome.step_state, carry.step_state)
        size = jnp.where(is_kept, step.h, 0)
        # `again` stops an event from occurring repeatedly at the same time.
        at_last = (before.num_events > 0) & before.signs.at_zero[which]
        small = 16 * float(jnp.finfo(t.dtype).eps) * jnp.abs(whole)
        again = is_kept & at_last & (jnp.abs(size) <= small)
        has_room = before.num_events < self.actions.max_events
        return AttemptedStep(
            is_alive=alive,
            is_taken=is_taken,
            t=t,
            step=step,
            is_discarded=is_discarded,
            is_kept=is_kept,
            which=which,
            values_at_end=before.values_at_end,
            meets=meets,
            fires=meets & ~again & has_room,
            size=size,
            reached=reached.differentiated_in_state(),
            whole=whole,
            decision=decision,
            next_step=next_step,
        )

    def _decision(
        self,
        carry: EventCarry,
        next_step: NextStep,
        step: TruncatedStep,
        solved: BoolScalar,
    ) -> Decision:
        """Return the decision of the controller about a step or a part of a step."""
        assert self.sizes is not None
        assert carry.place.clock is not None
        clock, place = carry.place.clock, carry.place
        attempt = Attempt(
            *(next_step.t, step.h, clock.size, carry.step_state, step.outcome),
            *(solved, next_step.is_whole, place.node),
        )
        context = self.sizes.context(self.plain)
        decision = self.sizes.controller.adapt(context, attempt, clock.memory)
        at_event = solved & (step.fired >= 0)
        result = RESULTS.where(at_event, RESULTS.successful, decision.result)
        return decision._replace(result=result)

    def _clock_after(
        self,
        before: EventLoopState,
        after: EventLoopState,
        attempt: AttemptedStep,
        outcome: EventOutcome,
    ) -> tuple[Clock, RESULTS]:
        """Return the clock after an iteration, which may have reached a node.

        The second result is `successful`, or the reason why the controller cannot
        continue after a reset.
        """
        assert self.sizes is not None
        assert before.clock is not None
        assert attempt.decision is not None
        assert attempt.next_step is not None
        clock, decision = before.clock, attempt.decision
        reaches = after.node > before.node
        size = jnp.where(attempt.is_rejected, before.offset + decision.size, clock.size)
        size = jnp.where(reaches & attempt.is_kept, decision.size, size)
        end = two_sum(clock.t, attempt.whole + clock.compensation)
        memory = tree_where(attempt.is_kept, decision.memory, clock.memory)
        clock = self.sizes.after(
            clock, end, attempt.next_step, reaches, size, memory, after.node
        )
        resets, restarted = [x is not None for x in self.actions.resets], None
        if any(resets):
            restarted = self.sizes.controller.after_reset(
                self.sizes.context(self.plain),
                attempt.t + attempt.size,
                outcome.step_state,
            )
        if restarted is None:
            return clock, RESULTS.successful
        # After a reset, the next node is moved: the rest of the step gets the size that
        # the controller chooses for a first step.
        size, memory, result = restarted
        size, memory = jax.lax.stop_gradient((size, memory))
        is_reset = attempt.fires & jnp.asarray(resets)[attempt.which]
        size = jnp.where(is_reset, after.offset + size, clock.size)
        memory = tree_where(is_reset, memory, clock.memory)
        result = RESULTS.where(is_reset, result, RESULTS.successful)
        return replace(clock, size=size, memory=memory), result

    def _step(
        self,
        carry: EventCarry,
        t: FloatScalar,
        h: FloatScalar,
        skip: BoolScalar,
        replay: ReplayedIteration | None,
    ) -> TruncatedStep:
        """Take a step of size h from t, truncated at its first event if it has one."""
        plain, place = self.plain, carry.place
        start = carry.step_state.differentiated_in_state()
        given = plain.args, plain.invariants, plain.noise
        arguments = StepArguments(plain.system, t, h, start, *given)
        # The type checker takes the property `programs` for a missing field.
        step = ImplicitTruncatedStep(  # pyright: ignore[reportCallIssue]
            step=ImplicitStep(
                method=plain.method,
                stage_solver=plain.stage_solver,
                skip=skip,
                programs=plain.programs,
            ),
            signs=place.signs,
            truncates=place.truncates & ~skip,
            values_at_end=place.values_at_end,
            known_event=None if replay is None else replay.which,
        )
        return step((arguments, self.conditions))

    def blank_result(self, carry: EventCarry) -> StepResult:
        """Return the result of an idle iteration."""
        t, y, zero = (
            self.plain.time(0),
            carry.step_state.state,
            jnp.zeros((), jnp.int32),
        )
        entry = LogEntry(t, zero, y, y, zero, zero, t, t, t, zero, t)
        blank = self.plain.blank_result(carry)._replace(row=zero)
        if self.sizes is not None:
            record = replace(blank.record, interval=(t, t))
            blank = blank._replace(record=record)
        return self._with_log(blank, entry, zero)

    def succeeded(self, carry: EventCarry) -> BoolScalar:
        """Return whether the run reached its last node, or an event that ends it."""
        ended = carry.result == RESULTS.event_occurred
        return ended | (carry.result == RESULTS.successful)

    def finish(
        self, carry: EventCarry, rows: Rows, log: LogEntry | None, given: Any
    ) -> RunEnd[Rows, EventLog]:
        """Return the end of the run, at the last node or at an event that ends it."""
        t1 = self.time(carry.place)
        if carry.place.clock is None:
            at_event = carry.result == RESULTS.event_occurred
            t1 = jnp.where(at_event, t1, self.plain.time(self.plain.num_steps))
        found = carry.step_state.state, rows, log, t1
        found = nan_gradient_unless(self.succeeded(carry), found, given)
        state, rows, log, t1 = found
        if log is None:
            log = _log_at_end(carry.place, t1, state)
        return RunEnd(state, t1, rows, reported_log(log, carry.place.num_events))

    def differentiable(self, carry: EventCarry) -> tuple[State, FloatScalar]:
        """Return the state and the time since the last node.

        If `carry` is a cotangent, return the cotangents of both.
        """
        return carry.step_state.state, carry.place.offset

    def reverse_replay(
        self, start: EventCarry, end: EventCarry, log: LogEntry | None
    ) -> "EventReverseReplay":
        """Return the replay of a run, with the events in its log."""
        if log is None:
            t, y = self.time(end.place), end.step_state.state
            log = _log_at_end(end.place, t, y)
        return EventReverseReplay(self, start, end, log)


def _place_after(
    before: EventLoopState,
    attempt: AttemptedStep,
    pending: Bool[Array, " e"],
    ends: BoolScalar,
) -> EventLoopState:
    """Return the place after an iteration; its signs and rows are not updated yet.

    If events are `pending` at the time of a node, they are handled before the node.
    """
    here, dt = before.offset + attempt.size, attempt.whole
    # If the rest of a step is only round-off, it is skipped.
    small = 4 * float(jnp.finfo(dt.dtype).eps)
    at_end = attempt.fires & ~ends & (jnp.abs(dt - here) <= small * jnp.abs(dt))
    at_end = at_end & ~jnp.any(pending)
    offset = jnp.where(attempt.fires, here, before.offset)
    offset = jnp.where(at_end, here - dt, jnp.where(attempt.reaches_node, 0, offset))
    return replace(
        before,
        node=before.node + (attempt.reaches_node | at_end).astype(jnp.int32),
        offset=offset,
        num_iterations=before.num_iterations + attempt.is_alive.astype(jnp.int32),
        num_events=before.num_events + attempt.fires.astype(jnp.int32),
        last_event=jnp.where(attempt.fires, attempt.which, before.last_event),
        truncates=attempt.is_discarded,
        values_at_end=jax.lax.stop_gradient(attempt.step.values),
    )


def _statistics_after(
    carry: EventCarry,
    attempt: AttemptedStep,
    after: EventLoopState,
    ends: BoolScalar,
    failed: BoolScalar,
) -> Statistics:
    """Return the statistics after an iteration, which may end the run."""
    node, outcome = carry.place.node, attempt.step.outcome
    taken, kept = attempt.is_taken, attempt.is_kept
    stats = updated_statistics(carry.stats, outcome, taken, kept, node)
    for name in ("failed_step", "worst_coordinate"):
        # A step that is discarded has not failed.
        stats[name] = jnp.where(ends, stats[name], carry.stats[name])
    stats["failed_step"] = jnp.where(failed, node, stats["failed_step"])
    if attempt.decision is not None:
        is_repeated = attempt.decision.result == RESULTS.successful
        rejected = attempt.is_rejected & is_repeated
        is_solved = outcome.result == RESULTS.successful
        given = carry.stats, attempt.decision, is_solved, rejected
        stats |= statistics_of_attempt(*given, kept & (attempt.step.fired < 0))
    stats |= {"num_steps": after.node, "num_events": after.num_events}
    return jax.lax.stop_gradient(stats)


def _log_at_end(place: EventLoopState, t: FloatScalar, y: State) -> LogEntry:
    """Return the log of a run that ended at its first event, if there was one."""
    node, offset = place.node, place.offset
    entry = LogEntry(
        t=t,
        which=place.last_event,
        before=y,
        after=y,
        iteration=place.num_iterations - 1,
        node=node,
        offset=jnp.zeros_like(offset),
        size=offset,
        scale=place.signs.scale(offset)[place.last_event],
        node_after=node,
        offset_after=offset,
    )
    # The last row of a log is not used.
    return jax.tree.map(lambda x: jnp.stack([x, x]), entry)


class EventReverseReplay(AbstractReverseReplay[EventCarry, ReplayedIteration]):
    """The replay of a run with events; the log has the states before the events."""

    stepper: EventStepper
    start: EventCarry
    end: EventCarry
    log: LogEntry

    @property
    def num_iterations(self) -> int | IntScalar:
        """Return the number of iterations of the run, idle ones included."""
        return self.stepper.num_iterations

    @property
    def after_end(self) -> ReplayedIteration:
        """Return the data of an idle iteration at the end of the run."""
        end = self.end.place
        never = jnp.zeros((), bool)
        return ReplayedIteration(
            node=end.node,
            offset=end.offset,
            num_events=end.num_events,
            row=end.row,
            which=-jnp.ones_like(end.node),
            size=jnp.zeros_like(end.offset),
            scale=jnp.zeros_like(end.offset),
            is_active=never,
            was_truncated=never,
        )

    @property
    def _ended(self) -> BoolScalar:
        return self.end.result == RESULTS.event_occurred

    def back(
        self, following: ReplayedIteration, step_state: StepState, i: Int[Array, ""]
    ) -> tuple[ReplayedIteration, StepState]:
        """Find the data of iteration i and the state from which it started.

        Iterations are undone from the last to the first, and `following` has the start
        of iteration i + 1. Let the entry be the last one in the log whose event is not
        yet undone. If the entry has the number i, iteration i ended at this event, and
        the step back starts from the state `before` the reset.
        """
        plain, end = self.stepper.plain, self.end.place
        i = i.astype(jnp.int32)
        last = jnp.maximum(following.num_events - 1, 0)
        entry = jax.tree.map(lambda x: x[last], self.log)
        active = (i < end.num_iterations) & ~following.was_truncated
        at_event = active & (following.num_events > 0) & (entry.iteration == i)
        # After the last event in a step, another iteration takes the rest of the step.
        is_rest = (following.num_events > 0) & (entry.node_after == following.node - 1)
        offset = jnp.where(is_rest, entry.offset_after, 0)
        offset = jnp.where(at_event, entry.offset, offset)
        offset = jnp.where(active, offset, following.offset)
        node = jnp.where(at_event, entry.node, following.node - 1)
        node = jnp.where(active, node, following.node)
        size = jnp.where(at_event, entry.size, plain.dt - offset)
        start = plain.time(node) + offset

        def before_event() -> StepState:
            t, system, method = start + size, plain.system, plain.method
            return first_step_state(system, method, t, entry.before, plain.args)

        step_state = jax.lax.cond(at_event, before_event, lambda: step_state)
        interval = StepInterval(start, start + size, size)
        step_state = jax.lax.cond(
            active & (size != 0),
            lambda: step_back(plain, step_state, interval),
            lambda: step_state,
        )
        # After its end, a run fills one row in each iteration until all are filled.
        filled = jnp.where(self._ended, end.node + 1, end.row) + i - end.num_iterations
        no_row = jnp.asarray(plain.num_steps, jnp.int32)
        filled = jnp.where(i < end.num_iterations, no_row, jnp.minimum(filled, end.row))
        replayed = ReplayedIteration(
            node=node,
            offset=offset,
            num_events=following.num_events - at_event.astype(jnp.int32),
            row=jnp.where(active, node, filled),
            which=jnp.where(at_event, entry.which, -1),
            size=size,
            scale=entry.scale,
            is_active=active,
            was_truncated=at_event & (size != 0),
        )
        return replayed, step_state

    def carry_before(
        self, replay: ReplayedIteration, step_state: StepState, i: Int[Array, ""]
    ) -> EventCarry:
        """Return the parts of the carry before iteration i that the iteration reads."""
        # Constants in `self.start` may be arrays of NumPy.
        start = jax.tree.map(jnp.asarray, self.start.place)
        numbers = jnp.arange(start.pending.shape[0], dtype=jnp.int32)
        is_one = numbers == replay.which
        scales = jnp.broadcast_to(replay.scale, start.values_at_end.shape)
        at_zero = jnp.zeros(scales.shape, bool)
        place = EventLoopState(
            node=replay.node,
            offset=replay.offset,
            row=replay.row,
            num_iterations=i.astype(jnp.int32),
            num_events=replay.num_events,
            last_event=start.last_event,
            truncates=start.truncates,
            values_at_end=start.values_at_end,
            signs=ConditionSigns(start.signs.sign, scales, at_zero),
            pending=is_one & (replay.size == 0),
        )
        # An idle or discarded iteration is repeated as an iteration after the end of
        # the run.
        ended = RESULTS.event_occurred
        result = RESULTS.where(replay.is_active, RESULTS.successful, ended)
        return EventCarry(step_state, result, self.start.stats, place)

    def places(
        self, replay: ReplayedIteration, i: Int[Array, ""]
    ) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """Return the output row and log entry of iteration i, or unused ones."""
        is_event = replay.which >= 0
        is_last = i.astype(jnp.int32) == self.end.place.num_iterations - 1
        ends_here = self._ended & is_last
        slot = jnp.where(is_event, replay.num_events, self.log.t.shape[0] - 1)
        at_end = self.log.node_after[replay.num_events] > replay.node
        fills = ~is_event | ends_here | at_end
        return jnp.where(fills, replay.row, self.stepper.plain.num_steps), slot
