"""The way back along a run, iteration by iteration, from its end to its start."""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._results import RESULTS
from .._step import first_step_state, StepState
from .._system import State
from ._log import log_at_end, LogEntry
from ._loop import Loop
from ._progress import Known, Progress, Sides
from ._saving import Rows
from ._stepper import Carry, PartOfStep, progress_of, step_back, WholeStep


class AbstractWayBack(eqx.Module):
    """The retracing of a run from its end, which finds where each iteration started.

    A place is what is known of such a starting point besides the state.
    """

    loop: eqx.AbstractVar[Loop]
    start: eqx.AbstractVar[Carry]
    end: eqx.AbstractVar[Carry]

    @property
    @abstractmethod
    def place_at_end(self) -> Any:
        """Return the place at the end of the run."""

    @property
    @abstractmethod
    def went_well(self) -> BoolScalar:
        """Tell whether the run reached its end, or an event that ends it."""

    @abstractmethod
    def back(
        self, place: Any, step_state: StepState, i: Int[Array, ""]
    ) -> tuple[Any, StepState]:
        """Find the place and the state that iteration i started from."""

    @abstractmethod
    def differentiable_part(self, carry: Carry) -> PyTree[Array]:
        """Return the part through which derivatives pass, of a carry or a cotangent."""

    @abstractmethod
    def rerun(
        self,
        loop: Loop,
        place: Any,
        step_state: StepState,
        part: PyTree[Array],
        i: Int[Array, ""],
    ) -> tuple[Carry, Rows]:
        """Run iteration i again from a place, with its differentiable part as given."""

    @abstractmethod
    def differentiable_part_at(
        self, place: Any, step_state: StepState
    ) -> PyTree[Array]:
        """Return the differentiable part of the carry at a place."""

    @abstractmethod
    def rows(self, rows: Rows, place: Any, i: Int[Array, ""]) -> Rows:
        """Read the rows that iteration i, which starts at a place, has written."""


class WayBackOverNodes(AbstractWayBack):
    """The way back along a run without events, from node to node."""

    loop: Loop
    start: Carry
    end: Carry

    @property
    def place_at_end(self) -> None:
        """Return nothing: the index of the step says where it started."""
        return None

    @property
    def went_well(self) -> BoolScalar:
        """Tell whether the run reached its end."""
        return self.end.result == RESULTS.successful

    def back(
        self, place: None, step_state: StepState, i: Int[Array, ""]
    ) -> tuple[None, StepState]:
        """Find the state that step i started from."""
        stepping = self.loop.stepping
        return None, step_back(stepping, step_state, WholeStep(stepping, i))

    def differentiable_part(self, carry: Carry) -> State:
        """Return the state, or its cotangent."""
        return carry.step_state.state

    def rerun(
        self,
        loop: Loop,
        place: None,
        step_state: StepState,
        part: State,
        i: Int[Array, ""],
    ) -> tuple[Carry, Rows]:
        """Take step i again, from the state given."""
        start = eqx.tree_at(lambda step_state: step_state.state, step_state, part)
        return loop.step(self.start._replace(step_state=start), i)

    def differentiable_part_at(self, place: None, step_state: StepState) -> State:
        """Return the state that the step started from."""
        return step_state.state

    def rows(self, rows: Rows, place: None, i: Int[Array, ""]) -> Rows:
        """Read the rows that step i has written."""
        return self.loop.saving.read(rows, i)


class EventPlace(eqx.Module):
    """A point on the way back of a run with events, where an iteration starts.

    - `node`, `offset`, `num`: as in `Progress`.
    - `row`: how many rows of output were filled before.
    - `known`: what the iteration ended at, and its size.
    - `scale`: the size of the condition of that event in the step.
    - `active`: whether the iteration took a step, or met an event without one.
    - `was_cut`: whether the iteration before found out that this one is to be cut, and
        did nothing else.
    """

    node: Int[Array, ""]
    offset: FloatScalar
    num: Int[Array, ""]
    row: Int[Array, ""]
    known: Known
    scale: FloatScalar
    active: Bool[Array, ""]
    was_cut: Bool[Array, ""]


class WayBackOverEvents(AbstractWayBack):
    """The way back along a run with events, whose log has the states before them."""

    loop: Loop
    start: Carry
    end: Carry
    log: LogEntry

    @property
    def place_at_end(self) -> EventPlace:
        """Return the place at the end of the run, from which no iteration starts."""
        end = progress_of(self.end)
        none = Known(-jnp.ones_like(end.node), jnp.zeros_like(end.offset))
        never = jnp.zeros((), bool)
        return EventPlace(
            node=end.node,
            offset=end.offset,
            num=end.num,
            row=end.row,
            known=none,
            scale=jnp.zeros_like(end.offset),
            active=never,
            was_cut=never,
        )

    @property
    def went_well(self) -> BoolScalar:
        """Tell whether the run reached its end, or an event that ends it."""
        result = self.end.result
        return (result == RESULTS.successful) | self._ended

    @property
    def _ended(self) -> BoolScalar:
        return self.end.result == RESULTS.event_occurred

    def back(
        self, place: EventPlace, step_state: StepState, i: Int[Array, ""]
    ) -> tuple[EventPlace, StepState]:
        """Find the place and the state that iteration i started from."""
        stepping, end = self.loop.stepping, progress_of(self.end)
        i = i.astype(jnp.int32)
        last = jnp.maximum(place.num - 1, 0)
        entry = jax.tree.map(lambda x: x[last], self.log)
        active = (i < end.active) & ~place.was_cut
        at_event = active & (place.num > 0) & (entry.iteration == i)
        # Another iteration took what was left of a step after its last event, if any.
        follows = (place.num > 0) & (entry.node_after == place.node - 1)
        offset = jnp.where(follows, entry.offset_after, 0)
        offset = jnp.where(at_event, entry.offset, offset)
        offset = jnp.where(active, offset, place.offset)
        node = jnp.where(at_event, entry.node, place.node - 1)
        node = jnp.where(active, node, place.node)
        size = jnp.where(at_event, entry.size, stepping.dt - offset)
        start = stepping.time(node) + offset

        def before_event() -> StepState:
            t, system, method = start + size, stepping.system, stepping.method
            return first_step_state(system, method, t, entry.before, stepping.args)

        step_state = jax.lax.cond(at_event, before_event, lambda: step_state)
        step_state = jax.lax.cond(
            active & (size != 0),
            lambda: step_back(stepping, step_state, PartOfStep(start, size)),
            lambda: step_state,
        )
        # A run that has ended fills one row in each iteration, until all are filled.
        filled = jnp.where(self._ended, end.node + 1, end.row) + i - end.active
        nowhere = jnp.asarray(self.loop.num_steps, jnp.int32)
        filled = jnp.where(i < end.active, nowhere, jnp.minimum(filled, end.row))
        place = EventPlace(
            node=node,
            offset=offset,
            num=place.num - at_event.astype(jnp.int32),
            row=jnp.where(active, node, filled),
            known=Known(jnp.where(at_event, entry.which, -1), size),
            scale=entry.scale,
            active=active,
            was_cut=at_event & (size != 0),
        )
        return place, step_state

    def differentiable_part(self, carry: Carry) -> tuple[Any, Any]:
        """Return the state and the time since the last node, or their cotangents."""
        return carry.step_state.state, progress_of(carry).offset

    def rerun(
        self,
        loop: Loop,
        place: EventPlace,
        step_state: StepState,
        part: tuple[State, FloatScalar],
        i: Int[Array, ""],
    ) -> tuple[Carry, Rows]:
        """Run iteration i again, as far as it went."""
        state, offset = part
        # Constants come back as arrays of NumPy.
        start = jax.tree.map(jnp.asarray, progress_of(self.start))
        which = place.known.which
        numbers = jnp.arange(start.pending.shape[0], dtype=jnp.int32)
        is_one = numbers == which
        scales = jnp.broadcast_to(place.scale, start.far.shape)
        progress = Progress(
            node=place.node,
            offset=offset,
            row=place.row,
            active=i.astype(jnp.int32),
            num=place.num,
            last=start.last,
            is_cut=start.is_cut,
            far=start.far,
            sides=Sides(start.sides.sign, scales, jnp.zeros(scales.shape, bool)),
            pending=is_one & (place.known.size == 0),
        )
        at_state = eqx.tree_at(lambda step_state: step_state.state, step_state, state)
        # An iteration that did nothing is run again as one after the end of a run, and
        # does nothing again.
        ended = RESULTS.event_occurred
        result = RESULTS.where(place.active, RESULTS.successful, ended)
        carry = Carry(at_state, result, self.start.stats, progress)
        return loop.step(carry, i, place.known)

    def differentiable_part_at(
        self, place: EventPlace, step_state: StepState
    ) -> tuple[State, FloatScalar]:
        """Return the state and the time since the last node."""
        return step_state.state, place.offset

    def rows(self, rows: Rows, place: EventPlace, i: Int[Array, ""]) -> Rows:
        """Read the rows of iteration i, and its entry in the log."""
        is_event = place.known.which >= 0
        active = progress_of(self.end).active
        ends_here = self._ended & (i.astype(jnp.int32) == active - 1)
        log = self.log
        nothing = log.slot.shape[0] - 1
        slot = jnp.where(is_event, place.num, nothing)
        at_end = log.node_after[place.num] > place.node
        fills = ~is_event | ends_here | at_end
        row = jnp.where(fills, place.row, self.loop.num_steps)
        return self.loop.saving.read(rows, row, slot)


def way_back(
    loop: Loop, start: Carry, end: Carry, log: LogEntry | None
) -> AbstractWayBack:
    """Make the way back along a run, which may have kept a `log` of its events."""
    if loop.events is None:
        return WayBackOverNodes(loop, start, end)
    if log is None:
        y, t = end.step_state.state, loop.events.time(progress_of(end))
        log = log_at_end(progress_of(end), t, y)
    return WayBackOverEvents(loop, start, end, log)
