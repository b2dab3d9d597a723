"""The functions `integrate` and `step`: checks, the compiled run, and its solution."""

import reprlib
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, PyTree

from .._compile import as_cpu_kernel, Programs, tracked_jit
from .._custom_types import (
    Args,
    BoolScalar,
    FloatScalar,
    FloatScalarLike,
    IntScalar,
    PhaseFunction,
)
from .._errors import Check, hold, is_traced, naming, require, ShapeError
from .._method import AbstractMethod, Gauss, LobattoIIIAB, PartitionedRungeKutta
from .._numerics import ClosureConverted, nan_gradient_unless, nan_unless
from .._results import RESULTS
from .._step import (
    AbstractStageSolver,
    is_simplified_alone,
    leaves_steps_to_newton,
    RoundOff,
    SimplifiedNewton,
    StepRecord,
)
from .._system import (
    AbstractMechanicalSystem,
    check_flag,
    check_type,
    closure_converted,
    finite,
    function_noise,
    FunctionNoise,
    HamiltonianSystem,
    LagrangianSystem,
    parameters,
    real_scalar,
    require_independent,
    State,
)
from ._adjoint import AbstractAdjoint, DirectAdjoint
from ._checkpoint import (
    check_start,
    Checkpoint,
    countable_from,
    MOST_STEPS,
    start_of,
    time_of,
)
from ._conservation import kept_invariants
from ._event import checked_events, Event
from ._event_stepper import EventStepping
from ._interpolation import (
    DenseInterpolation,
    interpolate,
    require_collocation,
    step_index,
)
from ._log import EventLog, log_at_end, reported
from ._loop import Loop
from ._progress_meter import AbstractProgressMeter, NoProgressMeter
from ._saving import (
    record_places,
    RecordPlaces,
    Rows,
    SaveAt,
    Saving,
    stack_saved,
    static_length,
)
from ._solution import is_singular_from_the_start, is_unsolved, raise_failures, Solution
from ._stepper import as_checkpoint, Carry, progress_of, reported_statistics, Stepping


class TimeGrid(eqx.Module):
    """The nodes t_k = t0 + k dt of a run, for k = 0, ..., num_steps."""

    t0: FloatScalar
    dt: FloatScalar
    num_steps: int | IntScalar


class Options(eqx.Module):
    """The functions of a user beside the system's: what is saved, kept and waited for.

    The fields are the arguments of `integrate` of the same names, and `events` its
    `event` as a tuple.
    """

    saveat: SaveAt
    invariants: str | Callable[..., Any] | None
    events: tuple[Event, ...] | None


class Means(eqx.Module):
    """The means by which steps are solved, differentiated and reported."""

    stage_solver: AbstractStageSolver
    adjoint: AbstractAdjoint
    meter: AbstractProgressMeter


METHODS = LobattoIIIAB, Gauss, PartitionedRungeKutta

# The estimated error of a step, relative to the change in it, of which a plain call
# warns. For steps that are ever larger the estimate tends to one.
_NOTHING_IS_RIGHT = 0.9

_TOO_LARGE = (
    "`dt` = {:.6g} is too large: the error of a step is estimated to be as large as "
    'the change of the state in it (`sol.stats["max_error_estimate"]` is {:.2g}). The '
    "equations of each step are solved, but the trajectory means nothing. Try `dt` = "
    "{:.6g}."
)
_TAKEN_OVER = (
    "`SimplifiedNewton` did not solve step {} of this run, which is therefore repeated "
    "with Newton's method for such steps. This compiles a second program. To compile "
    "one alone, pass `stage_solver=nhjax.SimplifiedNewton(fallback=True)` or "
    "`nhjax.Newton()`, or take a smaller `dt`."
)


def integrate(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    *,
    dt: FloatScalarLike,
    num_steps: int | IntScalar,
    t0: FloatScalarLike | None = None,
    args: Args = None,
    saveat: SaveAt = SaveAt(t1=True),
    stage_solver: AbstractStageSolver = SimplifiedNewton(),
    adjoint: AbstractAdjoint = DirectAdjoint(),
    throw: bool = True,
    progress_meter: AbstractProgressMeter = NoProgressMeter(),
    invariants: Literal["energy"] | PhaseFunction | None = None,
    event: Event | Sequence[Event] | None = None,
) -> Solution:
    """Integrate a mechanical system over `num_steps` steps of size `dt`.

    Each step solves the discrete equations of the paper (its four summaries) to
    round-off, so that the constraints on velocities and positions hold at every node to
    round-off as well; q and p are summed with compensation, and elements of a group
    stay on it. It works under `jit`, `vmap`, `grad`, `jvp` and `hessian`, with respect
    to `y0`, `args`, `dt`, `t0` and the array leaves of `system`; stage equations are
    differentiated by the implicit function theorem. Perturb a state through
    `initial_state`: the equations of a step read q and p, and only the first multiplier
    v too.

    **Arguments:**

    - `system`: the mechanical system.
    - `method`: such as `nhjax.LobattoIIIAB(stages=3)`; `Gauss` only without
        constraints.
    - `y0`: a consistent state, from `nhjax.initial_state` or an earlier `Solution`. Its
        multiplier matters to the propagated closure alone. Or the `Checkpoint` of an
        earlier run, to go on bit for bit as if that run had been longer.
    - `dt`: the step size, a scalar, in units of time; negative to go back.
    - `num_steps`: how many steps, an int >= 1; see below for arrays.
    - `t0`: the time of `y0`, 0 by default; a checkpoint has its own.
    - `args`: passed on to the functions of the system. Arrays and floats in it are
        traced, so that other values recompile nothing; anything else is static.

    **Other arguments:**

    - `saveat`: what to save, the final state by default; see `nhjax.SaveAt`.
    - `stage_solver`: how the equations of a step are solved,
        `nhjax.SimplifiedNewton()` by default, or `nhjax.Newton()`.
    - `adjoint`: what reverse mode keeps of the trajectory: `nhjax.DirectAdjoint()` by
        default, `nhjax.RecursiveCheckpointAdjoint()`, or `nhjax.ReversibleAdjoint()`.
    - `throw`: raise if a step cannot be solved. Otherwise the trajectory stays at its
        last good state from there on, and `result` and `stats` say so; its derivatives
        are NaN (zero where nothing depends on it). Other members of a batch are not
        touched.
    - `progress_meter`: such as `nhjax.TqdmProgressMeter()`.
    - `invariants`: what the steps keep at its value in `y0` to round-off: `"energy"`,
        or a function of (t, q, v, args), or of (t, q, p, args) of a Hamiltonian system,
        of shape () or (k,), that the system conserves. `docs/invariants.md` says how,
        what it costs and what it does at rest.
    - `event`: an `nhjax.Event`, or a sequence of them, of which the first in time wins:
        zeros of functions of the state, where the run ends or the state is reset.

    **Returns:** a `Solution`.

    **Raises:** `IntegrationError` as described (under `jit` its message comes in an
    error of JAX, a `JaxRuntimeError` or a `ValueError`), `ShapeError`, `DTypeError`,
    `NonFiniteError`, `TypeError` and `ValueError` for arguments that cannot be right;
    `DependentConstraintsError` with the names of constraints that depend on each other
    in `y0`; a `ValueError` that names the failing hypothesis (H1, H2, H3) if the method
    cannot integrate constrained systems.

    !!! note

        If what is saved has the same shape for any number of steps (`SaveAt` with `t0`,
        `t1` and `fn` alone) and there is no progress meter, another `num_steps`
        recompiles nothing in a plain call. Under `jit` an int is static; an integer
        array is traced, and under `vmap` each member may have its own. Reverse mode
        needs an int, or `ReversibleAdjoint`.

        With `steps`, `ts` or `dense` another `num_steps` recompiles everything. For
        runs of many lengths compile a chunk that leads from state to state, and join
        what it saves:

            @jax.jit
            def chunk(y, t):
                return nhjax.integrate(system, method, y, t0=t, dt=dt, num_steps=100,
                    saveat=nhjax.SaveAt(steps=True))

            sol = chunk(y, t)
            y, t = jax.tree.map(lambda x: x[-1], sol.ys), sol.t1

    !!! note

        Globals and variables of enclosing functions that the functions of `system` and
        `saveat` read are compiled in. A plain call traces them anew if one of them has
        changed; see `nhjax.LagrangianSystem` for what is tracked, and for the cure
        under a `jax.jit` of your own.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), dt=0.1, num_steps=100)
        >>> sol.ys.q.shape
        (1, 4)
    """
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    check_type("method", method, METHODS, "Such as nhjax.LobattoIIIAB(3).")
    check_type("y0", y0, (State, Checkpoint), "Make one with nhjax.initial_state.")
    check_type("saveat", saveat, SaveAt, "Such as nhjax.SaveAt(t0=True, steps=True).")
    newton = "Such as nhjax.Newton()."
    check_type("stage_solver", stage_solver, AbstractStageSolver, newton)
    check_type("adjoint", adjoint, AbstractAdjoint, "Such as nhjax.DirectAdjoint().")
    check_type("progress_meter", progress_meter, AbstractProgressMeter)
    throw = check_flag("throw", throw)
    needed_by = _what_needs_the_length(saveat, progress_meter)
    num_steps = check_num_steps(num_steps, needed_by)
    args = parameters(args)
    state = check_start(system, y0, args)
    t0, dt, checks = _times(y0, state, t0, dt, num_steps)
    events = checked_events(event, saveat, invariants)
    _check_method(method, state, saveat)
    checks += saveat.checks(t0, dt, num_steps)
    saveat, valid = saveat.within(dt), None
    if throw:
        # All on dt, which is always used: jit drops a check of what is not.
        dt = require(dt, *checks)
    else:
        valid = hold(*checks)
    # A plain call has no use for a length that is known, but for one that changes.
    if not isinstance(num_steps, int) or (needed_by is None and not is_tracing()):
        num_steps = jnp.asarray(num_steps, jnp.int32)
    grid = TimeGrid(t0, dt, num_steps)
    options = Options(saveat, invariants, events)
    means = Means(stage_solver, adjoint, progress_meter)
    sol = run(system, method, y0, grid, args, options, means)
    used_newton = not is_simplified_alone(stage_solver)
    if not is_tracing() and leaves_steps_to_newton(stage_solver) and is_unsolved(sol):
        used_newton = True
        warnings.warn(_TAKEN_OVER.format(int(sol.stats["failed_step"])), stacklevel=2)
        # Without the meter, which has shown its run already.
        solver = replace(stage_solver, fallback=True)
        means = Means(solver, adjoint, NoProgressMeter())
        sol = run(system, method, y0, grid, args, options, means)
    if valid is not None:
        sol = _invalid_unless(valid, sol)
    if throw:
        _require_constraints(sol, system, t0, state, args)
        sol = raise_failures(sol, dt, used_newton)
    _warn_of_errors(sol, dt)
    return sol


def _warn_of_errors(sol: Solution, dt: FloatScalar) -> None:
    """Warn, in a plain call, of steps that are so large that nothing is right."""
    estimate = sol.stats.get("max_error_estimate")
    if estimate is None or is_traced(estimate, dt):
        return
    if float(estimate) > _NOTHING_IS_RIGHT:
        size = float(dt)
        warnings.warn(_TOO_LARGE.format(size, float(estimate), size / 4), stacklevel=3)


def _require_constraints(
    sol: Solution,
    system: AbstractMechanicalSystem,
    t0: FloatScalar,
    y0: State,
    args: Args,
) -> None:
    """Raise for constraints that are dependent, if a plain run failed for them."""
    if not is_tracing() and is_singular_from_the_start(sol):
        require_independent(system, t0, y0, args)


def _invalid_unless(valid: BoolScalar, sol: Solution) -> Solution:
    """Give a run of arguments that were not valid the result that says so."""
    result = RESULTS.where(valid, sol.result, RESULTS.invalid_argument)
    failed_step = jnp.where(valid, sol.stats["failed_step"], 0)
    return replace(sol, result=result, stats=sol.stats | {"failed_step": failed_step})


def _times(
    y0: State | Checkpoint,
    state: State,
    t0: FloatScalarLike | None,
    dt: FloatScalarLike,
    num_steps: int | IntScalar,
) -> tuple[FloatScalar, FloatScalar, list[Check]]:
    """Return the time of `y0` and the step size as arrays, and the checks of both."""
    dt = real_scalar("dt", dt, state.p.dtype)
    t0 = real_scalar("t0", time_of(y0, t0), state.p.dtype)
    known = dt if is_traced(dt) else np.asarray(dt)
    checks = [
        finite("dt", dt),
        finite("t0", t0),
        Check(known != 0, _zero_step),
        *countable(num_steps),
        *countable_from(y0, num_steps),
        advancing(t0, dt),
    ]
    return t0, dt, checks


def _check_method(method: AbstractMethod, y0: State, saveat: SaveAt) -> None:
    """Raise unless the method can integrate with constraints and save what is asked."""
    if y0.multiplier.shape[0] > 0:
        method.require_constraint_hypotheses()
    if saveat.dense or saveat.ts is not None:
        require_collocation(method)


def _zero_step() -> ValueError:
    return ValueError("`dt` is zero; give a positive or negative step size.")


def _what_needs_the_length(saveat: SaveAt, meter: AbstractProgressMeter) -> str | None:
    """Name the first option that needs `num_steps` when tracing; None if none does."""
    needs = {
        "the output of `SaveAt(steps=...)`": bool(saveat.steps),
        "the output of `SaveAt(dense=True)`": saveat.dense,
        "the output of `SaveAt(ts=...)`": saveat.ts is not None,
        "the `progress_meter`": not meter.silent,
    }
    return next((name for name, needed in needs.items() if needed), None)


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
        programs=Programs(),
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


def step(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalarLike,
    dt: FloatScalarLike,
    y: State,
    args: Args = None,
    *,
    stage_solver: AbstractStageSolver = SimplifiedNewton(),
    throw: bool = True,
    invariants: Literal["energy"] | PhaseFunction | None = None,
) -> State:
    """Take one step of size `dt`, from the state `y` at `t` to the state at `t + dt`.

    The step solves the discrete equations of the paper (its four summaries), and its
    result is the same to the last bit as that of `integrate` with `num_steps=1`. Use it
    for control loops, environments and other time loops that `integrate` does not
    offer. It works under `jit`, `vmap`, `grad`, `jvp`, `hessian` and inside of
    `jax.lax.scan`. Over many steps `integrate` is faster and its rounding errors are
    smaller, because it sums q and p with a compensation that a `State` does not hold.

    **Arguments:**

    - `system`, `method`: as for `nhjax.integrate`.
    - `t`: the time of `y`.
    - `dt`: the step size, a scalar, in units of time; negative to go back.
    - `y`: a consistent state, from `nhjax.initial_state`, from a `Solution` or from a
        step before.
    - `args`: passed on to the functions of the system, for instance the controls that
        are held during the step.
    - `stage_solver`: `nhjax.SimplifiedNewton()` by default, or `nhjax.Newton()`.
    - `throw`: raise if the step cannot be solved. Otherwise all numbers of the state
        that is returned are NaN.
    - `invariants`: what the step keeps at its value in `y`, as for `nhjax.integrate`.

    **Returns:** the `State` at `t + dt`.

    **Raises:** as `nhjax.integrate` does.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> y, method = disc.initial_state(), nhjax.LobattoIIIAB(3)
        >>> y = nhjax.step(disc.system, method, t=0.0, dt=0.1, y=y)
        >>> y.q.shape
        (4,)
    """
    check_type("y", y, State, "Make one with nhjax.initial_state.")
    t = real_scalar("t", t, jnp.result_type(float))
    sol = integrate(
        system,
        method,
        y,
        dt=dt,
        num_steps=1,
        t0=t,
        args=args,
        stage_solver=stage_solver,
        throw=throw,
        invariants=invariants,
    )
    end = jax.tree.map(lambda x: x[0], sol.ys)
    if throw:
        return end
    return nan_unless(sol.result == RESULTS.successful, end)


def check_num_steps(num_steps: Any, needed_by: str | None) -> int | IntScalar:
    """Return `num_steps` as an int >= 1, or as an array if no option needs its value.

    **Arguments:**

    - `num_steps`: the argument of the user.
    - `needed_by`: the name of an option that needs the number of steps when tracing,
        for instance because the shape of its output depends on it; None if there is
        none.
    """
    if isinstance(num_steps, jax.Array | np.ndarray):
        return _traced_count(num_steps, needed_by)
    if isinstance(num_steps, bool) or not isinstance(num_steps, int | np.integer):
        raise TypeError(
            "`num_steps` must be an int, or an integer array of shape (), got "
            f"{num_steps!r} of type {type(num_steps).__name__}."
        )
    _require_count(int(num_steps))
    return int(num_steps)


def _traced_count(num_steps: Array | np.ndarray, needed_by: str | None) -> IntScalar:
    if not jnp.issubdtype(num_steps.dtype, jnp.integer):
        raise TypeError(
            "`num_steps` must be an int, or an integer array of shape (), got "
            f"{num_steps!r} of dtype {num_steps.dtype}."
        )
    if num_steps.shape != ():
        raise ShapeError(
            f"`num_steps` has shape {num_steps.shape}, but a scalar is needed; for "
            "runs of several lengths use `jax.vmap`."
        )
    if needed_by is not None:
        raise TypeError(
            f"`num_steps` must be an int known when tracing (under `jax.jit` a static "
            f"argument), because {needed_by} depends on it; got {num_steps!r} of type "
            f"{type(num_steps).__name__}."
        )
    if not is_traced(num_steps):
        _require_count(int(num_steps))
    return jnp.asarray(num_steps)


def _require_count(num_steps: int) -> None:
    if not 1 <= num_steps <= MOST_STEPS:
        raise _count_error(num_steps)


def _count_error(num_steps: Any) -> ValueError:
    return ValueError(f"`num_steps` must be in 1..2^31 - 1, got {num_steps}.")


def countable(num_steps: int | IntScalar) -> list[Check]:
    """Make the check that a traced number of steps is in its range.

    The list is empty for a number that is known, which `check_num_steps` has checked.
    """
    if isinstance(num_steps, int) or not is_traced(num_steps):
        return []
    ok = num_steps >= 1
    if jnp.iinfo(num_steps.dtype).max > MOST_STEPS:
        ok = ok & (num_steps <= MOST_STEPS)
    return [Check(ok, _count_error, (num_steps,))]


def advancing(t0: FloatScalar, dt: FloatScalar) -> Check:
    """Make the check that t0 + dt differs from t0, so that time advances."""
    # Known values are compared on the host with NumPy, where an operation takes a tenth
    # of the time.
    numpy: Any = jnp if is_traced(t0, dt) else np
    first, h = numpy.asarray(t0), numpy.asarray(dt)
    # Infinite numbers have a check of their own.
    with np.errstate(over="ignore", invalid="ignore"):
        ok = first + h != first
    return Check(ok, _standstill_error, (first, h))


def _standstill_error(first: Any, h: Any) -> ValueError:
    return ValueError(
        f"`dt` = {h} is below the round-off of the time `t0` = {first} in {h.dtype}: "
        "t0 + dt equals t0, and time would not advance. Measure time from a later "
        "origin, or take larger steps."
    )


def check_saved(
    fn: Callable[[Any, Any, Any], PyTree[Array]], t: FloatScalar, y: Any, args: Args
) -> None:
    """Raise a `TypeError` unless `SaveAt(fn=...)` returns what can be saved, arrays."""
    with naming("SaveAt: fn(t, y, args)", fn, args):
        leaves = jax.tree.leaves(eqx.filter_eval_shape(fn, t, y, args))
    wrong = [
        leaf
        for leaf in leaves
        if not (isinstance(leaf, jax.ShapeDtypeStruct) or eqx.is_array_like(leaf))
    ]
    if leaves and not wrong:
        return
    got = "nothing: does it lack a `return`?"
    if wrong:
        got = f"{reprlib.repr(wrong[0])} of type {type(wrong[0]).__name__}."
    raise TypeError(
        f"SaveAt: `fn(t, y, args)` must return an array, or a tree of arrays, got {got}"
    )


# JAX keeps what is being traced, if anything, in a state that can only be compared
# with another. In releases of JAX that do not make this function public, `is_tracing`
# always returns True.
_trace_state = getattr(jax.extend.core, "get_opaque_trace_state", lambda **_: object())
with jax.ensure_compile_time_eval():
    # This gives the state outside of all transformations also if this module is
    # imported inside of one.
    _NOT_TRACING = _trace_state(convention="nhjax")


def is_tracing() -> bool:
    """Tell whether this is called inside a transformation such as jit, vmap or grad."""
    return _trace_state(convention="nhjax") != _NOT_TRACING
