"""The compiled programs of a run, and how their results become a solution.

Inside transformations, `run` is one program for all steps. Outside of them,
`run_in_chunks` repeatedly calls a program that takes a chunk of steps, so that a run of
another length or with other output does not recompile.
"""

import reprlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._compile import (
    as_cpu_kernel,
    captured_by,
    started_like,
    TraceCache,
    tracked_jit,
)
from .._custom_types import (
    Args,
    BoolScalar,
    FloatScalar,
    IntScalar,
)
from .._errors import naming, on_host
from .._method import AbstractMethod
from .._numerics import ClosureConverted
from .._results import RESULTS
from .._step import AbstractStageSolver, StepRecord
from .._system import (
    AbstractMechanicalSystem,
    check_multiplier,
    function_noise,
    FunctionNoise,
    linearise,
    State,
    with_kept_functions,
)
from ._checkpoint import (
    Checkpoint,
    Origin,
    start_of,
)
from ._chunks import (
    drive,
    joined,
    NO_STRIDE,
    on_device,
    Output,
    padded,
    room_for,
    SAMPLES_AT_ONCE,
    Span,
)
from ._conservation import kept_invariants
from ._events import Event, EventStepper
from ._grid import Grid, TimeGrid, VariableGrid
from ._interpolation import (
    DenseInterpolation,
    interpolate,
    is_within,
    step_among,
    step_index,
)
from ._loop import AbstractAdjoint, iterate_steps, Loop
from ._progress_meter import AbstractProgressMeter, NoProgressMeter
from ._saving import (
    record_places,
    Rows,
    SaveAt,
    Saving,
    stack_saved,
    static_length,
)
from ._solution import (
    Solution,
)
from ._step_sizes import AbstractStepSizeController
from ._stepper import (
    AbstractCarry,
    AbstractStepper,
    PlainStepper,
    reported_statistics,
    RunEnd,
)
from ._variable import StepSizes, VariableStepper


class RunOptions(eqx.Module):
    """The user's options that contain functions.

    `fn` is the function of `SaveAt`. `invariants` is the argument of `integrate`, and
    `events` is its argument `event` as a tuple. `controller` chooses the step sizes; it
    is None in a run of `num_steps` constant steps.
    """

    fn: Callable[[Any, Any, Any], PyTree[Array]]
    invariants: str | Callable[..., Any] | None
    events: tuple[Event, ...] | None
    controller: AbstractStepSizeController | None = None


class SolverOptions(eqx.Module):
    """The options for how steps are solved, differentiated and reported."""

    stage_solver: AbstractStageSolver
    adjoint: AbstractAdjoint
    meter: AbstractProgressMeter


@tracked_jit("system", "args", "options", "saveat")
def run(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    grid: Grid,
    args: Args,
    options: RunOptions,
    saveat: SaveAt,
    solver_options: SolverOptions,
) -> Solution:
    """Integrate with arguments that have been checked, and return the solution.

    This is one program, for runs inside transformations.
    """
    t0 = grid.t0
    given = system, method, y0, grid, args, options, solver_options.stage_solver
    stepper, fn = _stepper(*given)
    stepper = stepper.with_noise(_noise(stepper, y0))
    adjoint = solver_options.adjoint
    if isinstance(stepper, VariableStepper):
        stepper = replace(stepper, keeps_log=adjoint.needs_log)
    plain = stepper.plain
    system, most = plain.system, plain.num_steps
    is_variable, sampled = isinstance(grid, VariableGrid), None
    if not isinstance(grid, VariableGrid):
        sampled = _sampled_steps(saveat, grid)
    # With variable steps, it is not known before the run which steps contain the times
    # `ts`. Therefore the records of all steps are kept.
    keeps_all = saveat.dense or (is_variable and saveat.ts is not None)
    places = record_places(keeps_all, sampled, most)
    saving = Saving.of(saveat, fn, most, places, stepper.log_length)
    loop = Loop(stepper, saving, solver_options.meter)
    first, carry, rows = _all_steps(adjoint, loop, y0, saveat, t0)
    given = (system, y0, t0, grid, args), options.events, options.controller
    end = loop.stepper.finish(carry, (rows.saved, rows.record), rows.log, given)
    # The number of filled rows includes a row for an event that ends the run.
    zero = jnp.zeros((), jnp.int32)
    number = loop.stepper.num_filled(carry, zero) if is_variable else None
    if number is None:
        ts, ys = _output(saveat, loop, first, end, sampled)
    else:
        ts, ys = _padded_output(saveat, loop, t0, first, end, number)
    interpolation, checkpoint, records = None, None, end.rows[1]
    if saveat.dense and records is not None:
        interpolation = _interpolation(plain, grid, records, number)
    if saveat.checkpoint:
        checkpoint = _checkpoint(stepper, carry, end.state)
    return Solution(
        t0=t0,
        t1=end.t,
        ts=ts,
        ys=ys,
        stats=reported_statistics(carry.stats, method),
        result=carry.result,
        interpolation=interpolation,
        checkpoint=checkpoint,
        coordinates=system.coordinates,
        events=end.log,
    )


def _stepper(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    grid: Grid,
    args: Args,
    options: RunOptions,
    stage_solver: AbstractStageSolver,
) -> tuple[AbstractStepper[Any, Any], ClosureConverted]:
    """Return the stepper of a run, and the function `fn` of its output."""
    t0, fn = grid.t0, options.fn
    dt, num_steps = grid.typical_size, grid.num_steps
    if isinstance(grid, VariableGrid):
        # The times of variable steps are not t0 + k dt, so the origin is only t0.
        num_steps = grid.most_steps
        origin = Origin(t0, jnp.zeros((), jnp.int32), jnp.zeros_like(t0))
        state = y0.state if isinstance(y0, Checkpoint) else y0
    else:
        state, origin = start_of(y0, t0, grid.dt)
    called = "y0.state" if isinstance(y0, Checkpoint) else "y0"
    check_multiplier(system, state, args, called)
    _check_saved(fn, t0, state, args)
    # Arrays that the user's functions close over become leaves of the system, so that
    # the derivative rules reach them.
    u = system.fibre_coordinate(state)
    system = with_kept_functions(system, t0, state.q, u, args)
    # The type checker sees the property `plain` as a field.
    plain = PlainStepper(  # pyright: ignore[reportCallIssue]
        system=system,
        method=method,
        stage_solver=stage_solver,
        origin=origin,
        dt=dt,
        args=args,
        invariants=kept_invariants(options.invariants, system, t0, dt, state, args),
        programs=TraceCache(),
        noise=None,
        num_steps=num_steps,
    )
    fn, sizes = ClosureConverted(fn, t0, state, args), None
    if isinstance(grid, VariableGrid):
        sizes = _sizes(options.controller, grid, plain, state)
    if options.events is not None:
        return EventStepper.of(options.events, plain, state, sizes), fn
    return (plain if sizes is None else VariableStepper(plain, sizes)), fn


def _sizes(
    controller: AbstractStepSizeController | None,
    grid: VariableGrid,
    plain: PlainStepper,
    y: State,
) -> StepSizes:
    """Return how a run chooses the sizes of its steps."""
    assert controller is not None
    controller = controller.closure_converted(plain.system, grid.t0, y, plain.args)
    given = grid.dt, grid.t1, grid.direction, grid.num_steps, grid.max_steps
    return StepSizes(controller, *given)


class _Start(NamedTuple):
    """The start of a run in chunks.

    - `carry`, `log`: the carry and the log before the first iteration.
    - `noise`: the round-off of the functions of the system.
    - `saved`: the output of the initial state, if it is asked for.
    - `surplus`: the number of iterations that the run may need in addition to one for
        each step; in a run with variable steps, the largest number of iterations.
    - `room`: the number of rows of the buffers of a chunk.
    """

    carry: AbstractCarry
    log: PyTree[Array] | None
    noise: FunctionNoise
    saved: PyTree[Array]
    surplus: IntScalar
    room: int


class _Chunk(NamedTuple):
    """The result of a chunk of steps.

    - `carry`, `log`: the carry and the log after the chunk.
    - `num_filled`: the number of rows that the run has filled.
    - `saved`, `records`: buffers, with the rows of this chunk at their start.
    - `end`: the end of the run, if this was its last chunk.
    - `saved_end`: the output of the last state, if it is asked for.
    - `checkpoint`: the checkpoint after the chunk; None for runs with events.
    - `system`: the system for the interpolation of records, if there are any.
    - `stats`: the statistics of the solution.
    - `is_over`, `progress`: whether the run has ended, and the part of the run that is
        done; both only with variable steps.
    """

    carry: AbstractCarry
    log: PyTree[Array] | None
    num_filled: IntScalar
    saved: PyTree[Array]
    records: StepRecord | None
    end: RunEnd[None, Any]
    saved_end: PyTree[Array]
    checkpoint: Checkpoint | None
    system: AbstractMechanicalSystem | None
    stats: dict[str, Any]
    is_over: BoolScalar | None
    progress: FloatScalar | None


@tracked_jit("system", "args", "options")
def _started(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    grid: Grid,
    args: Args,
    options: RunOptions,
    stage_solver: AbstractStageSolver,
    saves_start: BoolScalar,
) -> _Start:
    """Return the start of a run in chunks."""
    # The start does not depend on the number of steps. This number is set to zero, so
    # that the number of iterations is the surplus.
    none = jnp.zeros((), jnp.int32)
    grid = grid.of_length(none)
    stepper, fn = _stepper(system, method, y0, grid, args, options, stage_solver)
    noise = _noise(stepper, y0)
    stepper = stepper.with_noise(noise)
    carry = as_cpu_kernel(_start, stepper, y0)
    saving = _saving_in_chunks(stepper, fn, none, none, 0, 1)
    loop = Loop(stepper, saving, NoProgressMeter())
    rows = loop.row_shapes(carry)
    return _Start(
        carry,
        loop.empty_rows(carry).log,
        noise,
        _saved_if(saves_start, loop, grid.t0, carry.step_state.state),
        jnp.asarray(stepper.num_iterations, jnp.int32),
        room_for((rows.saved, rows.record)),
    )


@tracked_jit("system", "args", "options")
def _chunk(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    grid: Grid,
    args: Args,
    options: RunOptions,
    stage_solver: AbstractStageSolver,
    start: tuple[FunctionNoise, AbstractCarry, PyTree[Array] | None],
    numbers: Int[Array, " 5"],
    room: int,
    keeps_records: bool,
) -> _Chunk:
    """Take the iterations of the `Span` in `numbers`, from the carry in `start`."""
    noise, carry, log = start
    span = Span(*numbers)
    grid = grid.of_length(span.num_steps)
    stepper, fn = _stepper(system, method, y0, grid, args, options, stage_solver)
    stepper = stepper.with_noise(noise)
    num_records = room if keeps_records else 0
    filled = stepper.num_filled(carry, span.start)
    saving = _saving_in_chunks(stepper, fn, filled, span.num_steps, num_records, room)
    saving = replace(saving, stride=span.stride)
    loop = Loop(stepper, saving, NoProgressMeter())

    def steps(loop: Loop, carry: AbstractCarry, log: Any, start: Any, end: Any):
        # Some entries of the linearisation are constants of the program, which the
        # compiler can use in all steps. To find these entries, the linearisation is
        # traced here. Its values are not computed again, but come from the carry.
        plain, state = loop.stepper.plain, carry.step_state.state
        u = plain.system.fibre_coordinate(state)
        given = plain.system, plain.time(0), state.q, u, plain.args
        lin = started_like(linearise(*given, may_be_sparse=True), carry.step_state.lin)
        carry = eqx.tree_at(lambda x: x.step_state.lin, carry, lin)
        buffers = loop.empty_rows(carry)._replace(log=log)
        return iterate_steps(loop, start, end, (carry, buffers))

    given = loop, carry, log, span.start, span.end
    carry, rows = as_cpu_kernel(steps, *given)
    end = stepper.finish(carry, None, rows.log, None)
    checkpoint = None
    if options.events is None:
        checkpoint = _checkpoint(stepper, carry, end.state)
    return _Chunk(
        carry=carry,
        log=rows.log,
        num_filled=stepper.num_filled(carry, span.end),
        saved=rows.saved,
        records=rows.record,
        end=end,
        saved_end=_saved_if(span.saves_end != 0, loop, end.t, end.state),
        checkpoint=checkpoint,
        system=stepper.plain.system if num_records else None,
        stats=reported_statistics(carry.stats, method),
        is_over=stepper.is_over(carry) if stepper.may_end_early else None,
        progress=stepper.progress(carry),
    )


def _checkpoint(
    stepper: AbstractStepper[Any, Any], carry: Any, end: State
) -> Checkpoint:
    """Return the checkpoint after the last step of a run without events."""
    owner = stepper if isinstance(stepper, VariableStepper) else stepper.plain
    return owner.checkpoint(carry, end)


def _saving_in_chunks(
    stepper: AbstractStepper[Any, Any],
    fn: ClosureConverted,
    first_step: IntScalar,
    num_steps: IntScalar,
    num_records: int,
    room: int,
) -> Saving:
    """Return the `Saving` of a chunk, with the stride 1."""
    return Saving(
        fn=fn,
        num_steps=num_steps,
        stride=jnp.ones((), jnp.int32),
        num_saved=room,
        num_records=num_records,
        record_slots=None,
        log_length=stepper.log_length,
        first_step=first_step,
    )


def _saved_if(
    is_asked: BoolScalar, loop: Loop, t: FloatScalar, y: State
) -> PyTree[Array]:
    """Compute the output of a state, or zeros if it is not asked for."""

    def save():
        return loop.saving.saved(t, y, loop.stepper.plain.args)

    shapes = jax.eval_shape(save)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return jax.lax.cond(is_asked, save, lambda: blank)


@tracked_jit("system", "args", "options")
def _samples(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    grid: Grid,
    args: Args,
    options: RunOptions,
    stage_solver: AbstractStageSolver,
    samples: tuple[Float[Array, " k"], Int[Array, " k"], StepRecord],
) -> PyTree[Array]:
    """Compute the output at times, from the indices and records of their steps."""
    none = jnp.zeros((), jnp.int32)
    grid = grid.of_length(none)
    stepper, fn = _stepper(system, method, y0, grid, args, options, stage_solver)
    saving = _saving_in_chunks(stepper, fn, none, none, 0, 1)
    loop = Loop(stepper, saving, NoProgressMeter())
    return jax.vmap(partial(_sample, loop))(*samples)


def run_in_chunks(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    grid: Grid,
    args: Args,
    options: RunOptions,
    saveat: SaveAt,
    solver_options: SolverOptions,
) -> Solution:
    """Integrate by chunks of steps, outside of transformations."""
    is_variable, steps = isinstance(grid, VariableGrid), None
    num_steps = static_length(grid.most_steps)
    if not isinstance(grid, VariableGrid):
        steps = _sampled_steps(saveat, grid)
    keeps_records = saveat.dense or saveat.ts is not None
    # Each chunk reads the number of steps of the run from its `Span`, so that the grid
    # does not need this number.
    whole, grid = grid, grid.of_length(None)
    given = system, method, y0, grid, args, options, solver_options.stage_solver
    captured = captured_by(system, args, options)
    saves_start = jax.device_put(np.array(saveat.t0))
    start = _started(*given, saves_start, captured=captured)
    if not all(isinstance(x.dtype, np.dtype) for x in jax.tree.leaves(start.saved)):
        # NumPy has no arrays of random keys. Therefore a run that saves keys is one
        # program.
        return run(system, method, y0, whole, args, options, saveat, solver_options)

    def chunk(carry: AbstractCarry, log: Any, span: Array) -> _Chunk:
        begun = start.noise, carry, log
        given_span = span, start.room, keeps_records
        return _chunk(*given, begun, *given_span, captured=captured)

    output = drive(
        chunk,
        start.carry,
        start.log,
        num_steps=num_steps,
        num_iterations=int(start.surplus) + (0 if is_variable else num_steps),
        stride=saveat.steps or NO_STRIDE,
        room=start.room,
        saves_end=saveat.saves_end,
        recorded=None if saveat.dense or steps is None else np.unique(steps),
        keeps_records=keeps_records,
        meter=solver_options.meter,
        may_end_early=is_variable,
    )
    last: _Chunk = output.last
    pieces = [_one(on_host(start.saved))] if saveat.t0 else []
    if output.saved is not None:
        pieces.append(output.saved)
    elif saveat.steps:
        # With `SaveAt(steps=k)`, a run of fewer than k steps saves no rows.
        pieces.append(jax.tree.map(lambda x: np.asarray(x)[:0], last.saved))
    if saveat.ts is not None:
        if steps is None:
            saveat, steps = _steps_taken(saveat, grid.t0, last.end.t, output.records)
        pieces += _sampled_in_chunks(given, saveat, np.asarray(steps), output)
    if saveat.saves_end(output.num_steps):
        pieces.append(_one(on_host(last.saved_end)))
    if not pieces and saveat.saves_rows:
        # A run with variable steps may end before the first step that is saved.
        pieces.append(jax.tree.map(lambda x: x[:0], _one(on_host(start.saved))))
    ts, ys = on_device(joined(pieces), last.end.t) if pieces else (None, None)
    interpolation, result = None, last.carry.result
    if saveat.dense and last.system is not None:
        interpolation = DenseInterpolation(
            system=last.system,
            method=method,
            num_steps=output.num_steps,
            t0=grid.t0,
            dt=grid.typical_size,
            records=on_device(output.records, last.end.t),
            args=args,
            count=jnp.asarray(output.num_steps, jnp.int32) if is_variable else None,
        )
    if output.is_interrupted:
        is_good = result == RESULTS.successful
        result = RESULTS.where(is_good, RESULTS.interrupted, result)
    return Solution(
        t0=grid.t0,
        t1=last.end.t,
        ts=ts,
        ys=ys,
        stats=last.stats,
        result=result,
        interpolation=interpolation,
        checkpoint=last.checkpoint if saveat.checkpoint else None,
        coordinates=system.coordinates,
        events=last.end.log,
    )


def _steps_taken(
    saveat: SaveAt, t0: FloatScalar, t1: FloatScalar, records: StepRecord | None
) -> tuple[SaveAt, np.ndarray]:
    """Find, after the run, the steps in which the times of `SaveAt(ts=...)` lie.

    Return `saveat` with only the times that were reached, and the indices of the steps
    that contain these times.
    """
    ts = np.asarray(saveat.ts)
    if records is None or records.interval is None or not len(records.force):
        return eqx.tree_at(lambda x: x.ts, saveat, ts[:0]), np.zeros((0,), np.int32)
    reached = ts[np.asarray(is_within(jnp.asarray(ts), t0, t1))]
    starts, sizes = (np.asarray(x) for x in records.interval)
    forward = np.sign(sizes[0])
    number = np.searchsorted(forward * starts, forward * reached, side="right")
    steps = np.maximum(number - 1, 0)
    return eqx.tree_at(lambda x: x.ts, saveat, reached), steps


def _sampled_in_chunks(
    given: tuple[Any, ...], saveat: SaveAt, steps: np.ndarray, output: Output
) -> list[PyTree[np.ndarray]]:
    """Compute the output at the times `SaveAt(ts=...)`, in blocks of fixed length.

    `steps` are the indices of the steps in which the times lie.
    """
    reached = steps < output.num_steps
    ts, steps = np.asarray(saveat.ts)[reached], steps[reached]
    # There is one record for each step that contains a time or, if `keeps_all`, one
    # record for each step of the run.
    assert output.records is not None
    keeps_all = saveat.dense or len(output.records.force) == output.num_steps
    places = steps if keeps_all else np.unique(steps, return_inverse=True)[1]
    records = jax.tree.map(lambda x: x[places], output.records)
    pieces = []
    for first in range(0, len(ts), SAMPLES_AT_ONCE):
        part = slice(first, first + SAMPLES_AT_ONCE)
        count = len(ts[part])
        samples = jax.tree.map(
            lambda x, part=part: jax.device_put(padded(x[part], SAMPLES_AT_ONCE)),
            (ts, steps, records),
        )
        values = _samples(*given, samples)
        pieces.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], values))
    return pieces


def _sampled_steps(saveat: SaveAt, grid: TimeGrid) -> Int[Array, " k"] | None:
    """Find the steps that contain the times of `SaveAt(ts=...)`; None without `ts`."""
    if saveat.ts is None:
        return None
    length = static_length(grid.num_steps)
    return jax.vmap(lambda t: step_index(t, grid.t0, grid.dt, length))(saveat.ts)


def _all_steps(
    adjoint: AbstractAdjoint,
    loop: Loop,
    y0: State | Checkpoint,
    saveat: SaveAt,
    t0: FloatScalar,
) -> tuple[PyTree[Array] | None, AbstractCarry, Rows]:
    """Take all steps; return the saved start, the last carry and the saved rows."""
    # If the steps call the function `fn` of `SaveAt`, their kernel also calls it for
    # the start. Otherwise `fn` is called outside of this kernel, so that `fn` cannot
    # change which engine (see `nhjax.engines`) compiles the steps.
    is_inside = bool(saveat.steps)

    def saved(loop: Loop, t0: FloatScalar, y: State) -> PyTree[Array] | None:
        return loop.saving.saved(t0, y, loop.stepper.plain.args) if saveat.t0 else None

    def steps(
        loop: Loop, t0: FloatScalar, first: AbstractCarry | None, *given: Any
    ) -> tuple[Any, AbstractCarry, Rows]:
        first = _start(loop.stepper, *given) if first is None else first
        y = first.step_state.state
        start = saved(loop, t0, y) if is_inside else y
        return start, *adjoint.run(loop, loop.moving(first))

    if isinstance(y0, State) and not saveat.checkpoint:
        start, carry, rows = as_cpu_kernel(steps, loop, t0, None, y0)
    else:
        # If the compiler knows values with which a loop starts, such as zeros in
        # matrices, it generates other instructions for the loop, which round
        # differently. The barrier hides the start values, so that this run and a run
        # resumed from its checkpoint take their steps by the same instructions.
        first = as_cpu_kernel(_start, loop.stepper, y0)
        given, rest = eqx.partition((loop, first), eqx.is_array)
        loop, first = eqx.combine(jax.lax.optimization_barrier(given), rest)
        start, carry, rows = as_cpu_kernel(steps, loop, t0, first)
    return start if is_inside else saved(loop, t0, start), carry, rows


def _start(stepper: AbstractStepper[Any, Any], y0: State | Checkpoint) -> AbstractCarry:
    """Return the carry before the first iteration."""
    return stepper.init(y0)


def _noise(stepper: AbstractStepper[Any, Any], y0: State | Checkpoint) -> FunctionNoise:
    """Measure the noise of the system's functions at the start.

    A checkpoint holds the noise from the first run, so that a resumed run takes the
    same steps.
    """
    if isinstance(y0, Checkpoint):
        return jax.lax.stop_gradient(FunctionNoise(*y0.round_off))
    # The noise is measured in its own kernel for two reasons. A loop over steps is
    # compiled to faster code if its kernel contains no other loop before it. If all
    # runs of a batch start from one state, this kernel is not batched.
    plain = stepper.plain
    u = plain.system.fibre_coordinate(y0)
    given = plain.system, plain.time(0), y0.q, u, y0.multiplier, plain.args, plain.dt
    return as_cpu_kernel(function_noise, *given, is_brief=True)


def _output(
    saveat: SaveAt,
    loop: Loop,
    first: PyTree[Array] | None,
    end: RunEnd[Any, Any],
    sampled: Int[Array, " k"] | None,
) -> tuple[PyTree[Array], PyTree[Array]]:
    """Join the output of the start, the steps and the end: times and values.

    `first` is the saved start, or None if the start is not saved.
    """
    saving, args, ts = loop.saving, loop.stepper.plain.args, saveat.ts
    saved, records = end.rows
    pieces = []
    if saveat.t0:
        pieces.append(_one(first))
    if saveat.steps:
        pieces.append(jax.tree.map(lambda x: x[:-1], saved))
    if ts is not None and sampled is not None and saving.record_slots is not None:
        row = saving.record_slots[sampled]
        records = jax.tree.map(lambda x: x[row], records)
        pieces.append(jax.vmap(partial(_sample, loop))(ts, sampled, records))
    if saveat.saves_end(loop.stepper.plain.num_steps):
        pieces.append(_one(saving.saved(end.t, end.state, args)))
    return stack_saved(pieces) if pieces else (None, None)


def _padded_output(
    saveat: SaveAt,
    loop: Loop,
    t0: FloatScalar,
    first: PyTree[Array] | None,
    end: RunEnd[Any, Any],
    number: Int[Array, ""],
) -> tuple[PyTree[Array], PyTree[Array]]:
    """Join the output of a run whose number of steps is not known when tracing.

    Entries after the last saved one, and entries at times that were not reached, are
    infinite.
    """
    saving, args, ts = loop.saving, loop.stepper.plain.args, saveat.ts
    saved, records = end.rows
    pieces = []
    if saveat.t0:
        pieces.append(_one(first))
    last = _one(saving.saved(end.t, end.state, args)) if saveat.t1 else None
    if saveat.steps:
        # The extra row of the buffers leaves room for the output at the end of the run.
        rows = jnp.arange(saving.num_saved + 1, dtype=jnp.int32)
        count = number // saveat.steps
        padded_rows = _infinite_unless(rows < count, saved)
        if last is not None and saveat.steps > 1:
            is_end = (rows == count) & (number % saveat.steps != 0)
            padded_rows = jax.tree.map(
                lambda x, y: jnp.where(_along(is_end, x), y, x), padded_rows, last
            )
        else:
            padded_rows = jax.tree.map(lambda x: x[:-1], padded_rows)
        pieces.append(padded_rows)
    if ts is not None:
        step = jax.vmap(lambda t: step_among(t, records.interval, number))(ts)
        chosen = jax.tree.map(lambda x: x[step], records)
        values = jax.vmap(partial(_sample, loop))(ts, step, chosen)
        pieces.append(_infinite_unless(is_within(ts, t0, end.t), values))
    if last is not None and not saveat.steps:
        pieces.append(last)
    return stack_saved(pieces) if pieces else (None, None)


def _infinite_unless(valid: Bool[Array, " k"], saved: PyTree[Array]) -> PyTree[Array]:
    """Replace entries that are not valid by infinity, except in arrays of integers."""

    def fill(x: Array) -> Array:
        if not jnp.issubdtype(x.dtype, jnp.inexact):
            return x
        return jnp.where(_along(valid, x), x, jnp.inf)

    return jax.tree.map(fill, saved)


def _along(condition: Bool[Array, " k"], x: Array) -> Array:
    """Add axes to a condition on the entries of x, so that it broadcasts with x."""
    return condition.reshape(condition.shape + (1,) * (x.ndim - 1))


def _interpolation(
    stepper: PlainStepper,
    grid: Grid,
    records: StepRecord,
    number: Int[Array, ""] | None,
) -> DenseInterpolation:
    """Return the dense output, from the records of all steps.

    `number` is the number of steps of a run with variable steps.
    """
    return DenseInterpolation(
        system=stepper.system,
        method=stepper.method,
        num_steps=static_length(stepper.num_steps),
        t0=grid.t0,
        dt=stepper.dt,
        records=jax.tree.map(lambda x: x[:-1], records),
        args=stepper.args,
        count=number,
    )


def _one(saved: PyTree[Any]) -> PyTree[Any]:
    """Return an entry of the output with a time axis of length one."""
    return jax.tree.map(lambda x: x[None], saved)


def _sample(
    loop: Loop, t: FloatScalar, k: Int[Array, ""], record: StepRecord
) -> PyTree[Array]:
    """Compute the output at a time t inside step k."""
    run = loop.stepper.plain
    start, h = record.interval or (run.time(k), run.dt)
    theta = (t - start) / h
    y = interpolate(run.system, run.method, record, start, h, theta, run.args)
    return loop.saving.saved(t, y, run.args)


def _check_saved(
    fn: Callable[[Any, Any, Any], PyTree[Array]], t: FloatScalar, y: Any, args: Args
) -> None:
    """Raise a `TypeError` unless `SaveAt(fn=...)` returns a tree of arrays."""
    with naming("SaveAt: fn(t, y, args)", fn, args):
        leaves = jax.tree.leaves(eqx.filter_eval_shape(fn, t, y, args))
    wrong = [
        leaf
        for leaf in leaves
        if not (isinstance(leaf, jax.ShapeDtypeStruct) or eqx.is_array_like(leaf))
    ]
    if leaves and not wrong:
        return
    got = "None: is a `return` missing?"
    if wrong:
        got = f"{reprlib.repr(wrong[0])} of type {type(wrong[0]).__name__}."
    raise TypeError(
        f"SaveAt: `fn(t, y, args)` must return an array, or a tree of arrays, got {got}"
    )
