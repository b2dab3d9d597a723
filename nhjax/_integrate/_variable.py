"""The stepper of runs whose steps have different sizes.

Each iteration tries one step. The carry has the time and the size of this step, whereas
the plain stepper computes times as multiples of a constant size. A controller accepts
the step or rejects it, and chooses the size of the next one.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._custom_types import BoolScalar, FloatScalar, IntScalar
from .._numerics import nan_gradient_unless, tree_where, two_sum
from .._results import RESULTS
from .._step import StepState
from .._system import FunctionNoise, State
from ._checkpoint import Checkpoint
from ._step_sizes import (
    AbstractStepSizeController,
    Attempt,
    Decision,
    Memory,
    StepContext,
)
from ._stepper import (
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


class Clock(eqx.Module):
    """The time of the last node, and the size that is chosen for the next step.

    - `t`, `compensation`: the time, and the rounding error of the sum of all sizes.
    - `size`: the size of the next step, negative in a run backward in time.
    - `memory`: the data of the controller.
    - `is_done`: whether the run has reached its end.
    """

    t: FloatScalar
    compensation: FloatScalar
    size: FloatScalar
    memory: Memory
    is_done: Bool[Array, ""]


class NextStep(NamedTuple):
    """The next step of a run, from the time t with the size h.

    - `is_whole`: whether the step ends where a step of the chosen size would end.
    - `is_last`: whether the step instead ends at the given end `t1` of the run.
    """

    t: FloatScalar
    h: FloatScalar
    is_whole: BoolScalar
    is_last: BoolScalar


class StepSizes(eqx.Module):
    """How a run chooses the sizes of its steps, and where the run ends.

    - `t1`: the end of the run, or None for a run of `num_steps` steps.
    - `max_steps`: the largest number of attempted steps in the run.
    """

    controller: AbstractStepSizeController
    dt: FloatScalar | None
    t1: FloatScalar | None
    direction: FloatScalar
    num_steps: int | IntScalar | None
    max_steps: int | IntScalar

    def context(self, plain: PlainStepper) -> StepContext:
        """Return the data that the controller gets."""
        t0 = plain.time(0)
        length = jnp.full_like(t0, jnp.inf)
        if self.t1 is not None:
            length = jnp.abs(self.t1 - t0)
        return StepContext(
            plain.system, plain.method, plain.args, self.direction, self.dt, length
        )

    def first_clock(
        self, plain: PlainStepper, y0: State | Checkpoint, start: StepState
    ) -> tuple[Clock, RESULTS]:
        """Return the clock before the first step, and whether the run can start.

        If `y0` is a checkpoint with data that fit this controller, the run continues
        with them.
        """
        t, context = plain.time(0), self.context(plain)
        size, memory, result = self.controller.init(context, t, start)
        compensation = jnp.zeros_like(t)
        if isinstance(y0, Checkpoint) and y0.clock:
            leaves, structure = jax.tree.flatten((compensation, size, memory))
            kinds = [(x.shape, x.dtype) for x in leaves]
            if [(x.shape, x.dtype) for x in y0.clock] == kinds:
                saved = jax.tree.unflatten(structure, y0.clock)
                compensation, size, memory = jax.lax.stop_gradient(saved)
                size, memory = self.controller.resume(context, size, memory)
        return Clock(t, compensation, size, memory, jnp.zeros((), bool)), result

    def next_step(self, clock: Clock, offset: FloatScalar | float = 0.0) -> NextStep:
        """Return the next step, or the rest of the step after an event inside it.

        `offset` is the time from the last node to this event. A step that would pass
        the end of the run, or almost reach it, ends exactly at the end of the run.
        """
        t, h = clock.t + offset, clock.size - offset
        never = jnp.zeros((), bool)
        if self.t1 is None:
            return NextStep(t, h, ~never, never)
        rest = (self.t1 - t) - clock.compensation
        # A step almost reaches the end if the rest of the run exceeds the step by at
        # most a slack. The slack includes the round-off of the time, which may be
        # larger than a small fraction of the step.
        eps, size = float(jnp.finfo(t.dtype).eps), jnp.abs(h)
        largest = jnp.maximum(jnp.abs(self.t1), jnp.abs(t))
        slack = jnp.maximum(1e-9 * size, 4 * eps * largest)
        is_last = jnp.abs(rest) <= size + jnp.minimum(slack, 1e-2 * size)
        h = jnp.where(is_last, rest, h)
        return NextStep(t, h, ~is_last, is_last)

    def after(
        self,
        clock: Clock,
        end: tuple[FloatScalar, FloatScalar],
        step: NextStep,
        accepted: BoolScalar,
        size: FloatScalar,
        memory: Memory,
        num_steps: Int[Array, ""],
    ) -> Clock:
        """Return the clock after an attempt.

        After a rejected attempt, only `size` is new. `end` is the time after the step
        with its rounding error, and `num_steps` is the number of completed steps.
        """
        t, compensation = end
        if self.t1 is not None:
            t = jnp.where(step.is_last, self.t1, t)
            compensation = jnp.where(step.is_last, 0, compensation)
        done = accepted & step.is_last
        if self.num_steps is not None:
            done = done | (num_steps >= self.num_steps)
        moved = t, compensation, memory, clock.is_done | done
        kept = clock.t, clock.compensation, clock.memory, clock.is_done
        t, compensation, memory, done = tree_where(accepted, moved, kept)
        return Clock(t, jax.lax.stop_gradient(compensation), size, memory, done)

    def progress(
        self, plain: PlainStepper, clock: Clock, stats: Statistics
    ) -> FloatScalar:
        """Compute the part of the run that is done, from 0 to 1."""
        if self.t1 is None:
            number = jnp.asarray(self.num_steps, clock.t.dtype)
            return stats["num_steps"].astype(clock.t.dtype) / number
        t0 = plain.time(0)
        return (clock.t - t0) / (self.t1 - t0)


class VariableCarry(AbstractCarry):
    """The carry of a run with variable steps.

    Derivatives pass through the state and the time.
    """

    step_state: StepState
    result: RESULTS
    stats: Statistics
    clock: Clock


class StepLogEntry(eqx.Module):
    """The start and the size of an accepted step, for the reversible adjoint."""

    t: FloatScalar
    size: FloatScalar


class VariableStepper(AbstractStepper[VariableCarry, StepLogEntry]):
    """One attempt at a step per iteration. `plain` takes the single steps.

    If `keeps_log`, the run saves the start and the size of each step, for the
    reversible adjoint.
    """

    plain: PlainStepper
    sizes: StepSizes
    keeps_log: bool = eqx.field(static=True, default=False)

    @property
    def num_iterations(self) -> int | IntScalar:
        """Return the largest number of attempts."""
        return self.sizes.max_steps

    @property
    def may_end_early(self) -> bool:
        """Return True: the number of attempts is not known before the run."""
        return True

    @property
    def log_length(self) -> int:
        """Return the largest number of steps, or 0 without a log.

        There is no log if this number is not known when tracing.
        """
        number = self.plain.num_steps
        return number if self.keeps_log and isinstance(number, int) else 0

    def num_filled(self, carry: VariableCarry, i: Int[Array, ""]) -> Int[Array, ""]:
        """Return the number of accepted steps."""
        del i
        return carry.stats["num_steps"]

    def with_noise(self, noise: FunctionNoise) -> "VariableStepper":
        """Return the same stepper with the measured round-off of the system."""
        return replace(self, plain=self.plain.with_noise(noise))

    def init(self, y0: State | Checkpoint) -> VariableCarry:
        """Return the carry before the first attempt."""
        carry = self.plain.init(y0)
        clock, sized = self.sizes.first_clock(self.plain, y0, carry.step_state)
        result, stats = started(carry, sized, self.sizes.controller)
        return VariableCarry(carry.step_state, result, stats, clock)

    def is_over(self, carry: VariableCarry) -> BoolScalar:
        """Return whether the run has reached its end or has failed."""
        return (carry.result != RESULTS.successful) | carry.clock.is_done

    def progress(self, carry: VariableCarry) -> FloatScalar:
        """Compute the part of the run that is done, from 0 to 1."""
        return self.sizes.progress(self.plain, carry.clock, carry.stats)

    def advance(
        self,
        carry: VariableCarry,
        i: Int[Array, ""],
        replay: StepLogEntry | None = None,
    ) -> tuple[VariableCarry, StepResult]:
        """Try a step. A run that has ended does not change."""
        plain, sizes, clock = self.plain, self.sizes, carry.clock
        alive, node = ~self.is_over(carry), carry.stats["num_steps"]
        context = sizes.context(plain)
        if replay is not None:
            # Sizes that the user gives have derivatives. They are therefore not read
            # from the log.
            given = sizes.controller.given_size(context, node)
            size = replay.size if given is None else given
            clock = replace(clock, size=size)
        step = sizes.next_step(clock)
        outcome = plain.one_step(carry.step_state, step.t, step.h, ~alive)
        solved = alive & (outcome.result == RESULTS.successful)
        attempt = Attempt(
            *(step.t, step.h, clock.size, carry.step_state, outcome),
            *(solved, step.is_whole, node),
        )
        decision = sizes.controller.adapt(context, attempt, clock.memory)
        accepted = alive & decision.is_accepted
        if replay is not None:
            accepted = solved
        step_state = tree_where(accepted, outcome.step_state, carry.step_state)
        result = RESULTS.where(alive, decision.result, carry.result)
        failed = alive & (result != RESULTS.successful)
        stats = updated_statistics(carry.stats, outcome, alive, accepted, node)
        for name in ("failed_step", "worst_coordinate"):
            stats[name] = jnp.where(failed, stats[name], carry.stats[name])
        rejected = alive & ~accepted & ~failed
        stats |= statistics_of_attempt(
            carry.stats, decision, solved, rejected, accepted
        )
        size = jnp.where(alive, decision.size, clock.size)
        end = two_sum(step.t, step.h + clock.compensation)
        clock = sizes.after(
            clock, end, step, accepted, size, decision.memory, stats["num_steps"]
        )
        # The run fails if its last allowed attempt has not reached the end.
        i = jnp.asarray(i, jnp.int32)
        spent = alive & ~failed & ~clock.is_done & (i + 1 >= sizes.max_steps)
        result = RESULTS.where(spent, RESULTS.max_steps_reached, result)
        stats["failed_step"] = jnp.where(
            spent, stats["num_steps"], stats["failed_step"]
        )
        bound = jnp.asarray(plain.num_steps, jnp.int32)
        row = jnp.where(accepted, node, bound)
        carry = VariableCarry(
            step_state.differentiated_in_state(),
            result,
            jax.lax.stop_gradient(stats),
            clock,
        )
        record = replace(outcome.record, interval=(step.t, step.h))
        found = StepResult(clock.t, record, accepted, row)
        if self.log_length:
            entry = StepLogEntry(step.t, step.h)
            found = found._replace(log_entry=entry, log_slot=row)
        return carry, found

    def blank_result(self, carry: VariableCarry) -> StepResult:
        """Return an empty step result, with zeros at the stages."""
        zero, t = jnp.zeros((), jnp.int32), carry.clock.t
        blank = self.plain.blank_result(carry)
        record = replace(blank.record, interval=(t, t))
        blank = blank._replace(row=zero, record=record)
        if self.log_length:
            blank = blank._replace(log_entry=StepLogEntry(t, t), log_slot=zero)
        return blank

    def succeeded(self, carry: VariableCarry) -> BoolScalar:
        """Return whether the run reached its end."""
        return carry.result == RESULTS.successful

    def finish(
        self, carry: VariableCarry, rows: Rows, log: Any, given: Any
    ) -> RunEnd[Rows, None]:
        """Return the end of the run, at the last node."""
        del log
        found = carry.step_state.state, rows, carry.clock.t
        found = nan_gradient_unless(self.succeeded(carry), found, given)
        state, rows, t1 = found
        return RunEnd(state, t1, rows, None)

    def differentiable(self, carry: VariableCarry) -> tuple[State, FloatScalar]:
        """Return the state and the time of a carry, or of its cotangent."""
        return carry.step_state.state, carry.clock.t

    def reverse_replay(
        self, start: VariableCarry, end: VariableCarry, log: StepLogEntry | None
    ) -> "VariableReverseReplay":
        """Return the replay of a run from its end, with the steps in its log."""
        assert log is not None
        return VariableReverseReplay(self, start, end, log)

    def checkpoint(self, carry: VariableCarry, end: State) -> Checkpoint:
        """Return the checkpoint after the last accepted step."""
        clock = carry.clock
        made = self.plain.checkpoint(carry, end)
        return replace(
            made,
            t0=clock.t,
            dt=clock.size,
            num_steps=jnp.zeros_like(made.num_steps),
            clock=tuple(
                jax.tree.leaves((clock.compensation, clock.size, clock.memory))
            ),
        )


def started(
    carry: AbstractCarry, sized: RESULTS, controller: AbstractStepSizeController
) -> tuple[RESULTS, Statistics]:
    """Return the result and the statistics before the first step.

    `sized` is the result of the controller's search for the first size.
    """
    bad = (carry.result == RESULTS.successful) & (sized != RESULTS.successful)
    result = RESULTS.where(bad, sized, carry.result)
    none = jnp.zeros_like(carry.stats["num_steps"])
    failed = jnp.where(bad, none, carry.stats["failed_step"])
    more = {"failed_step": failed}
    more |= dict.fromkeys(("num_rejected_steps", "num_unsolved_steps"), none)
    if controller.estimates_errors:
        zero = jnp.zeros_like(carry.stats["max_residual"])
        more["max_error_over_tolerance"] = zero
    return result, carry.stats | more


def statistics_of_attempt(
    stats: Statistics,
    decision: Decision,
    is_solved: BoolScalar,
    rejected: BoolScalar,
    accepted: BoolScalar,
) -> Statistics:
    """Return the statistics that only variable steps have, updated by an attempt."""
    more: Statistics = {}
    counted = {
        "num_rejected_steps": rejected,
        "num_unsolved_steps": rejected & ~is_solved,
    }
    for name, happened in counted.items():
        more[name] = stats[name] + happened.astype(jnp.int32)
    name = "max_error_over_tolerance"
    if decision.error is not None:
        error = jnp.where(accepted, decision.error, 0)
        more[name] = jnp.maximum(stats[name], error)
    return more


class VariableReverseReplay(AbstractReverseReplay[VariableCarry, StepLogEntry]):
    """The replay of a run from its end, with a log of the starts and sizes of steps."""

    stepper: VariableStepper
    start: VariableCarry
    end: VariableCarry
    log: StepLogEntry

    @property
    def num_iterations(self) -> Int[Array, ""]:
        """Return the number of accepted steps, because only these must be undone."""
        return self.end.stats["num_steps"]

    @property
    def after_end(self) -> StepLogEntry:
        """Return an arbitrary entry of the log, because `back` does not read it."""
        return self._entry(jnp.zeros((), jnp.int32))

    def _entry(self, k: Int[Array, ""]) -> StepLogEntry:
        return jax.tree.map(lambda x: x[k], self.log)

    def back(
        self, following: StepLogEntry, step_state: StepState, i: Int[Array, ""]
    ) -> tuple[StepLogEntry, StepState]:
        """Find the log entry of step i, and the state that the step started from."""
        del following
        entry = self._entry(i)
        interval = StepInterval(entry.t, entry.t + entry.size, entry.size)
        return entry, step_back(self.stepper.plain, step_state, interval)

    def carry_before(
        self, replay: StepLogEntry, step_state: StepState, i: Int[Array, ""]
    ) -> VariableCarry:
        """Return the carry before step i."""
        not_done = jnp.zeros_like(self.end.clock.is_done)
        clock = replace(self.end.clock, t=replay.t, is_done=not_done)
        number = jnp.asarray(i, jnp.int32)
        stats = self.start.stats | {"num_steps": number}
        result = RESULTS.where(
            jnp.ones((), bool), RESULTS.successful, self.start.result
        )
        return VariableCarry(step_state, result, stats, clock)

    def places(
        self, replay: StepLogEntry, i: Int[Array, ""]
    ) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """Return the index of the step twice: as output row and place in the log."""
        del replay
        number = jnp.asarray(i, jnp.int32)
        return number, number
