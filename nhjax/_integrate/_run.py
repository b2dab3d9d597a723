"""The compiled program of a run: its loop, what is saved of it, and the solution."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from .._compile import as_cpu_kernel, Programs, tracked_jit
from .._custom_types import Args, FloatScalar, IntScalar
from .._method import AbstractMethod
from .._numerics import ClosureConverted, nan_gradient_unless
from .._results import RESULTS
from .._step import AbstractStageSolver, StepRecord
from .._system import AbstractMechanicalSystem, closure_converted, State
from ._adjoint import AbstractAdjoint
from ._checkpoint import Checkpoint, start_of
from ._checks import check_saved, known
from ._conservation import kept_invariants
from ._event import Event
from ._event_stepping import EventStepping
from ._interpolation import DenseInterpolation, interpolate, step_index
from ._log import EventLog, log_at_end, reported
from ._loop import Loop
from ._progress import progress_of
from ._progress_meter import AbstractProgressMeter
from ._saveat import SaveAt, stack_saved
from ._saving import record_places, RecordPlaces, Rows, Saving
from ._solution import Solution
from ._stepping import as_checkpoint, Carry, Stepping


@tracked_jit("system", "args", "saveat", "invariants", "events")
def run(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    stage_solver: AbstractStageSolver,
    adjoint: AbstractAdjoint,
    y0: State | Checkpoint,
    t0: FloatScalar,
    dt: FloatScalar,
    num_steps: int | IntScalar,
    args: Args,
    saveat: SaveAt,
    meter: AbstractProgressMeter,
    invariants: str | Callable[..., Any] | None,
    events: tuple[Event, ...] | None,
) -> Solution:
    """Integrate with arguments that have been checked, and return the solution."""
    state, origin = start_of(y0, t0, dt)
    check_saved(saveat.fn, t0, state, args)
    # Arrays that the user's functions close over become leaves, for derivatives.
    system = closure_converted(system, t0, state, args)
    kept = kept_invariants(invariants, system, t0, state, args)
    given = system, method, stage_solver, origin, dt, args, kept, Programs()
    stepping = Stepping(*given)
    ts, sampled = saveat.ts, None
    if ts is not None:
        length = known(num_steps)
        sampled = jax.vmap(lambda t: step_index(t, t0, dt, length))(ts)
    places = record_places(saveat.dense, sampled, num_steps)
    event_stepping = EventStepping.of(events, stepping, state, num_steps)
    fn = ClosureConverted(saveat.fn, t0, state, args)
    saving = _saving(saveat, fn, num_steps, places, event_stepping)
    loop = Loop(stepping, saving, meter, event_stepping)
    start, carry, rows = _all_steps(adjoint, loop, y0, saveat.checkpoint)
    found, given = (carry.step_state.state, rows), (system, y0, t0, dt, args)
    log = None
    if event_stepping is None:
        successful = carry.result == RESULTS.successful
        end, rows = nan_gradient_unless(successful, found, given)
        t1 = stepping.time(num_steps)
    else:
        given = *given, events
        end, rows, t1, log = _end_with_events(event_stepping, carry, found, given)
    first = [_one(saving.saved(t0, start, args))] if saveat.t0 else []
    on_the_way = [jax.tree.map(lambda x: x[:-1], rows.saved)] if saveat.steps else []
    if ts is not None and sampled is not None and places.slots is not None:
        row = places.slots[sampled]
        records = jax.tree.map(lambda x: x[row], rows.record)
        on_the_way = [jax.vmap(partial(_sample, loop))(ts, sampled, records)]
    last = [_one(saving.saved(t1, end, args))] if saveat.saves_end(num_steps) else []
    pieces = first + on_the_way + last
    times, ys = stack_saved(pieces) if pieces else (None, None)
    interpolation = None
    if saveat.dense:
        records = jax.tree.map(lambda x: x[:-1], rows.record)
        given = system, method, known(num_steps), t0, dt, records, args
        interpolation = DenseInterpolation(*given)
    checkpoint = as_checkpoint(stepping, carry, end) if saveat.checkpoint else None
    how = carry.stats, carry.result, interpolation, checkpoint, system.coordinates
    return Solution(t0, t1, times, ys, *how, events=log)


def _all_steps(
    adjoint: AbstractAdjoint, loop: Loop, y0: State | Checkpoint, checkpoint: bool
) -> tuple[State, Carry, Rows]:
    """Take all steps; return the first state, what is carried at the end, and rows."""

    def start(loop: Loop, y0: State | Checkpoint):
        return loop.start(y0)

    def steps(loop: Loop, first: Carry):
        return first.step_state.state, *adjoint.run(loop, loop.moving(first))

    if not checkpoint and isinstance(y0, State):
        return as_cpu_kernel(lambda loop, y0: steps(loop, start(loop, y0)), loop, y0)
    # What a compiler knows of the start of a loop, such as zeros in the matrices there,
    # changes how it rounds in the loop. Here it knows nothing, so that a run which goes
    # on from another takes its steps by the same instructions.
    first = as_cpu_kernel(start, loop, y0)
    given, rest = eqx.partition((loop, first), eqx.is_array)
    loop, first = eqx.combine(jax.lax.optimization_barrier(given), rest)
    return as_cpu_kernel(steps, loop, first)


def _saving(
    saveat: SaveAt,
    fn: ClosureConverted,
    num_steps: int | IntScalar,
    places: RecordPlaces,
    events: EventStepping | None,
) -> Saving:
    """Make the choice of what the steps of a run save."""
    return Saving(
        fn=fn,
        num_steps=num_steps,
        stride=saveat.steps,
        num_saved=known(num_steps) // saveat.steps if saveat.steps else 0,
        num_records=places.number,
        record_slots=places.slots,
        num_events=0 if events is None else events.num_kept,
    )


def _end_with_events(
    events: EventStepping, carry: Carry, found: tuple[State, Rows], given: Any
) -> tuple[State, Rows, FloatScalar, EventLog]:
    """Find the state and the time at the end of a run with events, and their log.

    Derivatives with respect to what is `given` are NaN if the run failed.
    """
    progress, ended = progress_of(carry), carry.result == RESULTS.event_occurred
    last = events.stepping.time(events.num_steps)
    t1 = jnp.where(ended, events.time(progress), last)
    went_well = ended | (carry.result == RESULTS.successful)
    end, rows, t1 = nan_gradient_unless(went_well, (*found, t1), given)
    log = rows.log
    if log is None:
        log = log_at_end(progress, t1, end)
    return end, rows, t1, reported(log, progress.num)


def _one(saved: PyTree[Array]) -> PyTree[Array]:
    """Make a piece of the output, with a time axis of length one, from one entry."""
    return jax.tree.map(lambda x: x[None], saved)


def _sample(
    loop: Loop, t: FloatScalar, k: Int[Array, ""], record: StepRecord
) -> PyTree[Array]:
    """Compute what is saved at a time t that lies inside of step k."""
    run = loop.stepping
    start, h = run.time(k), run.dt
    theta = (t - start) / h
    y = interpolate(run.system, run.method, record, start, h, theta, run.args)
    return loop.saving.saved(t, y, run.args)
