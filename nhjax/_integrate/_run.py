"""The compiled program of a run: its loop, what is saved of it, and the solution."""

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PyTree

from .._compile import as_cpu_kernel, TraceCache, tracked_jit
from .._custom_types import Args, FloatScalar, IntScalar
from .._method import AbstractMethod
from .._numerics import ClosureConverted, nan_gradient_unless
from .._results import RESULTS
from .._step import RoundOff, StepRecord
from .._system import (
    AbstractMechanicalSystem,
    closure_converted,
    function_noise,
    FunctionNoise,
    State,
)
from ._adjoint import AbstractAdjoint
from ._checkpoint import Checkpoint, start_of
from ._checks import check_saved, static_length
from ._conservation import kept_invariants
from ._event_stepping import EventStepping
from ._interpolation import DenseInterpolation, interpolate, step_index
from ._log import EventLog, log_at_end, reported
from ._loop import Loop
from ._options import Means, Options, TimeGrid
from ._saveat import SaveAt, stack_saved
from ._saving import record_places, RecordPlaces, Rows, Saving
from ._solution import Solution
from ._statistics import reported_statistics
from ._stepping import as_checkpoint, Carry, progress_of, Stepping


@tracked_jit("system", "args", "options")
def run(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    grid: TimeGrid,
    args: Args,
    options: Options,
    means: Means,
) -> Solution:
    """Integrate with arguments that have been checked, and return the solution."""
    t0, saveat = grid.t0, options.saveat
    state, origin = start_of(y0, t0, grid.dt)
    check_saved(saveat.fn, t0, state, args)
    # Arrays that the user's functions close over become leaves, for derivatives.
    system = closure_converted(system, t0, state, args)
    stepping = Stepping(
        system=system,
        method=method,
        stage_solver=means.stage_solver,
        origin=origin,
        dt=grid.dt,
        args=args,
        invariants=kept_invariants(options.invariants, system, t0, state, args),
        programs=TraceCache(),
    )
    sampled = _sampled_steps(saveat, grid)
    places = record_places(saveat.dense, sampled, grid.num_steps)
    events = EventStepping.of(options.events, stepping, state, grid.num_steps)
    fn = ClosureConverted(saveat.fn, t0, state, args)
    saving = _saving(saveat, fn, grid.num_steps, places, events)
    loop = Loop(stepping, saving, means.meter, events)
    round_off, start, carry, rows = _all_steps(
        means.adjoint, loop, y0, saveat.checkpoint
    )
    given = system, y0, t0, grid.dt, args
    end = _end(loop, carry, rows, (given, options.events))
    ts, ys = _output(saveat, loop, grid, start, end, sampled)
    return Solution(
        t0=t0,
        t1=end.t,
        ts=ts,
        ys=ys,
        stats=reported_statistics(carry.stats, method),
        result=carry.result,
        interpolation=_interpolation(loop, grid, end.rows) if saveat.dense else None,
        checkpoint=(
            as_checkpoint(stepping, round_off, carry, end.state)
            if saveat.checkpoint
            else None
        ),
        coordinates=system.coordinates,
        events=end.log,
    )


def _sampled_steps(saveat: SaveAt, grid: TimeGrid) -> Int[Array, " k"] | None:
    """Find the steps in which the times of `SaveAt(ts=...)` lie; None without these."""
    if saveat.ts is None:
        return None
    length = static_length(grid.num_steps)
    return jax.vmap(lambda t: step_index(t, grid.t0, grid.dt, length))(saveat.ts)


def _all_steps(
    adjoint: AbstractAdjoint, loop: Loop, y0: State | Checkpoint, checkpoint: bool
) -> tuple[RoundOff, State, Carry, Rows]:
    """Take all steps.

    Return the measured round-off, the first state, what is carried at the end, and the
    rows that were saved.
    """

    def start(loop: Loop, y0: State | Checkpoint, noise: FunctionNoise | None):
        first = loop.start(y0, noise)
        return loop.stepping.round_off_at(y0, first.step_state, noise), first

    def steps(loop: Loop, round_off: RoundOff, first: Carry):
        loop = loop.with_round_off(round_off)
        run = adjoint.run(loop, loop.moving(first))
        return round_off, first.step_state.state, *run

    def whole(loop: Loop, y0: State, noise: FunctionNoise):
        return steps(loop, *start(loop, y0, noise))

    noise = None
    if isinstance(y0, State):
        # A kernel of its own: the loop over steps is compiled to faster code without
        # another loop before it. In a batch of runs from one state it is no batch.
        stepping = loop.stepping
        u = stepping.system.fibre_coordinate(y0)
        given = stepping.time(0), y0.q, u, y0.multiplier, stepping.args
        given = stepping.system, *given
        noise = as_cpu_kernel(function_noise, *given, is_brief=True)
        if not checkpoint:
            return as_cpu_kernel(whole, loop, y0, noise)
    # What a compiler knows of the start of a loop, such as zeros in the matrices there,
    # changes how it rounds in the loop. Here it knows nothing, so that a run which goes
    # on from another takes its steps by the same instructions.
    first = as_cpu_kernel(start, loop, y0, noise)
    given, rest = eqx.partition((loop, first), eqx.is_array)
    loop, first = eqx.combine(jax.lax.optimization_barrier(given), rest)
    return as_cpu_kernel(steps, loop, *first)


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
        num_saved=static_length(num_steps) // saveat.steps if saveat.steps else 0,
        num_records=places.number,
        record_slots=places.slots,
        num_events=0 if events is None else events.num_kept,
    )


class _End(NamedTuple):
    """The state and the time at the end of a run, the rows that it saved, and its log.

    The log of events is None in a run without events.
    """

    state: State
    t: FloatScalar
    rows: Rows
    log: EventLog | None


def _end(loop: Loop, carry: Carry, rows: Rows, given: Any) -> _End:
    """Find the end of a run; derivatives by what is `given` are NaN if it failed."""
    stepping, events, state = loop.stepping, loop.events, carry.step_state.state
    went_well, t1 = carry.result == RESULTS.successful, stepping.time(loop.num_steps)
    if events is None:
        state, rows = nan_gradient_unless(went_well, (state, rows), given)
        return _End(state, t1, rows, None)
    progress, ended = progress_of(carry), carry.result == RESULTS.event_occurred
    t1 = jnp.where(ended, events.time(progress), t1)
    found = state, rows, t1
    state, rows, t1 = nan_gradient_unless(ended | went_well, found, given)
    log = log_at_end(progress, t1, state) if rows.log is None else rows.log
    return _End(state, t1, rows, reported(log, progress.num))


def _output(
    saveat: SaveAt,
    loop: Loop,
    grid: TimeGrid,
    start: State,
    end: _End,
    sampled: Int[Array, " k"] | None,
) -> tuple[PyTree[Array], PyTree[Array]]:
    """Join what was saved at the start, on the way and at the end: times and values."""
    saving, args, ts = loop.saving, loop.stepping.args, saveat.ts
    pieces = []
    if saveat.t0:
        pieces.append(_one(saving.saved(grid.t0, start, args)))
    if saveat.steps:
        pieces.append(jax.tree.map(lambda x: x[:-1], end.rows.saved))
    if ts is not None and sampled is not None and saving.record_slots is not None:
        row = saving.record_slots[sampled]
        records = jax.tree.map(lambda x: x[row], end.rows.record)
        pieces.append(jax.vmap(partial(_sample, loop))(ts, sampled, records))
    if saveat.saves_end(grid.num_steps):
        pieces.append(_one(saving.saved(end.t, end.state, args)))
    return stack_saved(pieces) if pieces else (None, None)


def _interpolation(loop: Loop, grid: TimeGrid, rows: Rows) -> DenseInterpolation:
    """Make the dense output from the records of all steps."""
    stepping = loop.stepping
    return DenseInterpolation(
        system=stepping.system,
        method=stepping.method,
        num_steps=static_length(grid.num_steps),
        t0=grid.t0,
        dt=grid.dt,
        records=jax.tree.map(lambda x: x[:-1], rows.record),
        args=stepping.args,
    )


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
