"""What follows from an event: a reset of the state, the end of the run, or nothing."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from .._custom_types import Args, BoolScalar, FloatScalar
from .._numerics import ClosureConverted, tree_where
from .._results import RESULTS
from .._step import first_step_state, StepState
from .._system import AbstractMechanicalSystem, all_finite, State
from ._conditions import Conditions, sides_at, with_continuous_multiplier
from ._event import Event
from ._progress import Progress
from ._reset import completed
from ._sides import Sides
from ._stepping import is_consistent, Stepping


class AfterEvent(NamedTuple):
    """What follows from an event: the state to go on with, and what is known there."""

    step_state: StepState
    sides: Sides
    pending: Bool[Array, " e"]
    result: RESULTS


class Consequences(eqx.Module):
    """What follows from each of the events of a run.

    `max_events` is the number of events that the run has room for.
    """

    resets: tuple[ClosureConverted | None, ...]
    terminates: tuple[bool, ...] = eqx.field(static=True)
    max_events: int = eqx.field(static=True)

    @property
    def ends_only(self) -> bool:
        """Tell whether every event ends the run, and none resets the state.

        Then there is no log to be kept on the way.
        """
        return all(self.terminates) and not any(self.resets)

    def after_event(
        self,
        conditions: Conditions,
        stepping: Stepping,
        fires: BoolScalar,
        which: Int[Array, ""],
        t: FloatScalar,
        step_state: StepState,
        value: FloatScalar,
        before: Progress,
    ) -> AfterEvent:
        """Find what follows from an event; nothing follows unless it `fires`.

        Its condition has this `value`, zero up to round-off.
        """
        ends = jnp.asarray(self.terminates)[which]
        result = RESULTS.where(ends, RESULTS.event_occurred, RESULTS.successful)
        nothing = AfterEvent(step_state, before.sides, before.pending, result)
        if self.ends_only:
            return nothing

        def reset() -> AfterEvent:
            resets = [partial(_reset, stepping, x, t, step_state) for x in self.resets]
            after, consistent = jax.lax.switch(which, resets)
            others = jnp.arange(len(self.resets), dtype=jnp.int32) != which
            round_off = jnp.where(others, 0, jnp.abs(value))
            sides, known = sides_at(conditions, stepping, t, after, round_off)
            turned = conditions.crossed(before.sides.sign, sides.sign)
            pending = (before.pending | (turned & (sides.sign != 0))) & others
            found = RESULTS.where(known, result, RESULTS.nonfinite_event)
            found = RESULTS.where(consistent, found, RESULTS.inconsistent_reset)
            after = tree_where(consistent, after, step_state)
            return AfterEvent(after.differentiated_in_state(), sides, pending, found)

        return jax.lax.cond(fires, reset, lambda: nothing)


def consequences_of(
    events: tuple[Event, ...],
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    y: State,
    args: Args,
) -> Consequences:
    """Make the consequences of events, or raise for a reset of a wrong kind."""
    resets = [
        ClosureConverted(partial(completed, system, i, event.reset), t, y, args)
        if event.reset is not None
        else None
        for i, event in enumerate(events)
    ]
    terminates = tuple(event.terminate for event in events)
    room = sum(event.max_events for event in events)
    # A run of which all events are the end has at most one.
    return Consequences(tuple(resets), terminates, 1 if all(terminates) else room)


def _reset(
    stepping: Stepping,
    reset: ClosureConverted | None,
    t: FloatScalar,
    step_state: StepState,
) -> tuple[StepState, BoolScalar]:
    """Reset the state at an event; tell whether the result is consistent."""
    system, method, args = stepping.system, stepping.method, stepping.args
    if reset is None:
        return step_state, jnp.ones((), bool)
    y = with_continuous_multiplier(system, method, t, step_state.state, args)
    y = with_continuous_multiplier(system, method, t, reset(t, y, args), args)
    after = first_step_state(system, method, t, y, args)
    assert stepping.round_off is not None
    violations = stepping.round_off.violations
    return after, all_finite(y) & is_consistent(system, t, after, args, violations)
