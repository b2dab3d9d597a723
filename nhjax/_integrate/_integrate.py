"""The functions `integrate`, `step` and `suggest_step`, and checks of their arguments.

The run itself is in `_run`.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import (
    Args,
    BoolScalar,
    FloatScalar,
    FloatScalarLike,
    IntScalar,
    PhaseFunction,
)
from .._errors import (
    Check,
    hold,
    IntegrationError,
    is_traced,
    require,
    ShapeError,
)
from .._method import AbstractMethod, Gauss, LobattoIIIAB, PartitionedRungeKutta
from .._numerics import nan_unless
from .._results import RESULTS
from .._step import (
    AbstractStageSolver,
    ForceSlopeError,
    has_default_jacobian,
    has_force_slopes,
    is_simplified_alone,
    SimplifiedNewton,
    solvers_of_unsolved_steps,
)
from .._system import (
    AbstractMechanicalSystem,
    check_flag,
    check_type,
    describe_inconsistency,
    finite,
    HamiltonianSystem,
    LagrangianSystem,
    parameters,
    real_scalar,
    require_independent,
    State,
)
from ._checkpoint import (
    check_start,
    Checkpoint,
    countable_from,
    MOST_STEPS,
    time_of,
)
from ._events import checked_events, Event
from ._grid import checks_of_output, Grid, TimeGrid, variable_grid, VariableGrid
from ._interpolation import (
    require_collocation,
)
from ._loop import AbstractAdjoint, DirectAdjoint
from ._progress_meter import AbstractProgressMeter, NoProgressMeter
from ._reversible import ReversibleAdjoint
from ._run import run, run_in_chunks, RunOptions, SolverOptions
from ._saving import (
    SaveAt,
)
from ._solution import (
    ended_as,
    is_singular_from_the_start,
    is_unsolved,
    raise_failures,
    Solution,
)
from ._step_sizes import (
    AbstractStepSizeController,
    ConstantStepSize,
    PIDController,
)


METHODS = LobattoIIIAB, Gauss, PartitionedRungeKutta

# A call outside of transformations warns if the estimated error of a step, relative to
# the change of the state in the step, exceeds this value. For large steps this ratio
# tends to one.
_TOO_LARGE_ERROR = 0.9

_TOO_LARGE = (
    "`dt` = {:.6g} is too large: the error of a step is estimated to be as large as "
    'the change of the state in it (`sol.stats["max_error_estimate"]` is {:.2g}). The '
    "equations of each step are solved, but the trajectory is meaningless. Try `dt` = "
    "{:.6g}."
)
_REPEATED = (
    "`SimplifiedNewton` did not solve step {} of this run, which is therefore repeated "
    "with {}. This compiles another program. To compile only one, pass "
    "`stage_solver={}`, or take a smaller `dt`."
)
_BY_FULL = "the full Jacobian", 'nhjax.SimplifiedNewton(jacobian="full")'
_BY_NEWTON = (
    "Newton's method for such steps",
    "nhjax.SimplifiedNewton(fallback=True)` or `nhjax.Newton()",
)
# If the average step takes more iterations than this, the full Jacobian takes less time
# on the mechanical systems that were measured (`benchmarks.iterations`).
_MANY_ITERATIONS = 40
# Runs with fewer steps than this cause no warning of slow convergence, because they
# take less time than compiling another program.
_FEW_STEPS = 10
_FULL = (
    '`stage_solver=nhjax.SimplifiedNewton(jacobian="full")` takes fewer iterations and '
    "often allows larger steps. Its first call takes two to three times as long."
)
_SLOW = "The steps of this run took {:.0f} iterations on average. "
# If more than this fraction of the attempts is not solved, the step sizes are limited
# by the convergence of the stage solver, and not by the estimated errors.
_MANY_UNSOLVED = 0.2
_UNSOLVED = (
    "In {} of the {} attempts at a step of this run the equations were not solved, and "
    "a smaller step was taken. "
)
_INTERRUPTED = (
    "The run was interrupted after {} steps, and the solution ends there, at t = "
    "{:.6g}. Its `result` is `nhjax.RESULTS.interrupted`."
)


def integrate(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State | Checkpoint,
    *,
    dt: FloatScalarLike | Float[Array, " num_steps"] | None = None,
    num_steps: int | IntScalar | None = None,
    t0: FloatScalarLike | None = None,
    t1: FloatScalarLike | None = None,
    args: Args = None,
    saveat: SaveAt = SaveAt(t1=True),
    stage_solver: AbstractStageSolver = SimplifiedNewton(),
    stepsize_controller: AbstractStepSizeController = ConstantStepSize(),
    max_steps: int | None = None,
    adjoint: AbstractAdjoint = DirectAdjoint(),
    throw: bool = True,
    progress_meter: AbstractProgressMeter = NoProgressMeter(),
    invariants: Literal["energy"] | PhaseFunction | None = None,
    event: Event | Sequence[Event] | None = None,
) -> Solution:
    """Integrate a mechanical system over `num_steps` steps, or to the time `t1`.

    Each step solves the discrete equations of the paper (listed in its four summaries)
    to round-off. The constraints on velocities and positions therefore also hold to
    round-off at the end of every step. Compensated sums add the steps to q and p, and
    elements of a group stay on the group.

    `integrate` works under `jit`, `vmap`, `grad`, `jvp` and `hessian`, with respect to
    `y0`, `args`, `dt`, `t0` and the array leaves of `system`. Stage equations are
    differentiated by the implicit function theorem. To perturb a state, call
    `initial_state` with the perturbed values. It is not enough to change v in a state,
    because a step starts from q and p, and reads v only for the first multiplier.

    **Arguments:**

    - `system`: the mechanical system.
    - `method`: the method, such as `nhjax.LobattoIIIAB(stages=3)`. `nhjax.Gauss`
        supports only systems without constraints.
    - `y0`: a consistent state, from `nhjax.initial_state` or an earlier `Solution`.
        Only methods with `closure="propagated"` use the multiplier of this state. `y0`
        may also be the `Checkpoint` of an earlier run, which then continues bit for
        bit.
    - `dt`: the step size, a scalar, in units of time; negative to integrate backwards.
        An array of shape (num_steps,) gives the size of each step. With a controller
        that chooses the sizes, `dt` is the size of the first step, and may be left out.
    - `num_steps`: the number of steps, an int >= 1; see below for arrays.
    - `t0`: the time of `y0`, 0 by default. A checkpoint has its own time.
    - `t1`: the end of the run, in place of `num_steps`. The last step ends exactly at
        this time.
    - `args`: passed on to the functions of the system. Arrays and floats in it are
        traced, so that changing them does not recompile. All other values are static.

    **Other arguments:**

    - `saveat`: the output to save, the final state by default; see `nhjax.SaveAt`.
    - `stage_solver`: how the equations of a step are solved,
        `nhjax.SimplifiedNewton()` by default, or `nhjax.Newton()`.
    - `stepsize_controller`: how the sizes of the steps are chosen. By default all are
        equal to `dt`. `nhjax.PIDController(rtol, atol)` keeps an estimated error below
        a tolerance. A third choice is `nhjax.ReversibleController(eps, density)`.
        Derivatives treat the sizes that a controller chooses as constants.
    - `max_steps`: the largest number of attempts at a step, an int; only for runs to
        `t1` or with a controller. The default is the number of steps, if it is known
        when tracing and no step can be repeated; otherwise 4096, or 4 `num_steps` if
        this is larger. Under `jit`, the memory for `SaveAt(steps=..., ts=...,
        dense=...)` and for reverse mode grows with `max_steps`.
    - `adjoint`: which data reverse mode stores: `nhjax.DirectAdjoint()` by default,
        `nhjax.RecursiveCheckpointAdjoint()`, or `nhjax.ReversibleAdjoint()`.
    - `throw`: whether to raise an error if a step cannot be solved. If false, the
        trajectory stays at its last good state, `result` and `stats` report the
        failure, and derivatives are NaN (zero for a zero cotangent). Other members of a
        batch are not affected.
    - `progress_meter`: the meter that shows how many steps are done, such as
        `nhjax.TqdmProgressMeter()`.
    - `invariants`: quantities that the steps keep at their values in `y0`, up to
        round-off: `"energy"`, or a function that returns shape () or (k,). The function
        is called with (t, q, v, args), or (t, q, p, args) for a Hamiltonian system. The
        system itself must conserve these quantities. `docs/invariants.md` describes the
        method, its cost and its behaviour at rest.
    - `event`: an `nhjax.Event`, or a sequence of events. An event is a zero of a
        function of the state, at which the run ends or the state is reset. If a step
        has several events, the earliest is handled first.

    **Returns:** a `Solution`.

    **Raises:** `IntegrationError` if the run fails and `throw` is true (under `jit` its
    message is in a `JaxRuntimeError` or `ValueError`); `ShapeError`, `DTypeError`,
    `NonFiniteError`, `TypeError` and `ValueError` for invalid arguments;
    `DependentConstraintsError` with the names of constraints that depend on each other
    in `y0`; a `ValueError` that names the paper's failing hypothesis (H1, H2 or H3) if
    the method cannot integrate constrained systems.

    !!! note

        Outside of JAX transformations, the host repeatedly calls a compiled program,
        which takes one chunk of steps. Changing `num_steps`, `SaveAt(steps=k)`,
        `adjoint` or `progress_meter` does not recompile it. The first run with `ts` or
        `dense` compiles programs that also store the stage values from which the output
        between steps is computed. Ctrl-C ends a run after the current chunk, within
        about a fifth of a second: `integrate` warns and returns the solution up to the
        end of this chunk, with the `result` `nhjax.RESULTS.interrupted`.

        Under `jit` an int `num_steps` is static. An integer array is traced, and under
        `vmap` each member may have its own number of steps. With an array, all steps
        must have the size `dt`, a `progress_meter` is not possible, and `saveat` must
        not have `steps`, `ts` or `dense`, because the shape of their output depends on
        the number of steps. Reverse mode needs an int, or `ReversibleAdjoint`.

    !!! note

        The functions of `system` and `saveat` may read globals and variables of
        enclosing functions, which become constants of the compiled program. Outside of
        transformations, a call traces the functions again if such a value has changed.
        See `nhjax.LagrangianSystem` for the tracked values, and for calls inside your
        own `jax.jit`.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), dt=0.1, num_steps=100)
        >>> sol.ys.q.shape
        (1, 4)
    """
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    check_type("method", method, METHODS, "For example, pass nhjax.LobattoIIIAB(3).")
    check_type(
        "saveat", saveat, SaveAt, "For example, pass nhjax.SaveAt(t0=True, steps=True)."
    )
    newton = "For example, pass nhjax.Newton()."
    check_type("stage_solver", stage_solver, AbstractStageSolver, newton)
    check_type(
        "adjoint", adjoint, AbstractAdjoint, "For example, pass nhjax.DirectAdjoint()."
    )
    check_type("progress_meter", progress_meter, AbstractProgressMeter)
    check_type(
        "stepsize_controller",
        stepsize_controller,
        AbstractStepSizeController,
        "For example, pass nhjax.PIDController(rtol=1e-6, atol=1e-6).",
    )
    throw = check_flag("throw", throw)
    args = parameters(args)
    state = check_start(system, y0, args)
    events = checked_events(event, saveat, invariants)
    _check_method(method, state, saveat)
    controller, size = None, None
    if _has_constant_steps(stepsize_controller, dt, t1):
        needed_by = _what_needs_the_length(saveat, progress_meter)
        _refuse_max_steps(max_steps)
        num_steps = _check_num_steps(num_steps, needed_by)
        t0, size, checks = _times(y0, state, t0, dt, num_steps)
        checks += saveat.checks(t0, size, num_steps)
        if not isinstance(num_steps, int):
            num_steps = num_steps.astype(jnp.int32)
        grid = TimeGrid(t0, size, num_steps)
    else:
        t0 = real_scalar("t0", time_of(y0, t0), state.p.dtype)
        controller, grid, checks = variable_grid(
            stepsize_controller, t0, dt, t1, num_steps, max_steps
        )
        controller.check(system, method, t0, state, args)
        checks += checks_of_output(saveat, grid, controller)
        if events is not None and isinstance(adjoint, ReversibleAdjoint):
            raise ValueError(
                "ReversibleAdjoint cannot retrace runs with both events and steps that "
                "differ. Use `nhjax.RecursiveCheckpointAdjoint()`."
            )
    saveat, valid = saveat.within(t0), None
    if throw:
        # All checks are attached to the grid, whose times are always used, because jit
        # drops checks of unused values.
        grid = require(grid, *checks)
    else:
        valid = hold(*checks)
    options = RunOptions(saveat.fn, invariants, events, controller)
    solver_options = SolverOptions(stage_solver, adjoint, progress_meter)
    whole_run = _program_of_run(grid)
    sol = whole_run(system, method, y0, grid, args, options, saveat, solver_options)
    used, used_newton = stage_solver, not is_simplified_alone(stage_solver)
    repeats = [] if _is_tracing() else solvers_of_unsolved_steps(stage_solver)
    for solver in repeats:
        if not is_unsolved(sol):
            break
        used, used_newton = solver, not is_simplified_alone(solver)
        told = _BY_NEWTON if used_newton else _BY_FULL
        failed = int(sol.stats["failed_step"])
        warnings.warn(_REPEATED.format(failed, *told), stacklevel=2)
        # The progress meter has already shown this run, so the repetition has no meter.
        again = SolverOptions(solver, adjoint, NoProgressMeter())
        try:
            sol = whole_run(system, method, y0, grid, args, options, saveat, again)
        except ForceSlopeError:
            # A force lacks a derivative that the full Jacobian needs. Newton's method
            # needs it too.
            used_newton = True
            break
    if valid is not None:
        sol = _invalid_unless(valid, sol)
    is_interrupted = not _is_tracing() and ended_as(sol, "interrupted")
    if is_interrupted:
        done = int(sol.stats["num_steps"])
        of = "" if isinstance(grid, VariableGrid) else f" of {grid.num_steps}"
        message = _INTERRUPTED.format(f"{done}{of}", float(sol.t1))
        warnings.warn(message, stacklevel=2)
    if not _is_tracing() and has_default_jacobian(used):
        # The warning comes before errors are raised, because unsolved steps can be the
        # reason why a run did not reach its end.
        _warn_of_iterations(sol, system, t0, state, args)
    if throw and not is_interrupted:
        _require_constraints(sol, system, t0, state, args)
        sol = raise_failures(sol, size, used_newton)
    if size is not None:
        _warn_of_errors(sol, size)
    return sol


def _has_constant_steps(
    controller: AbstractStepSizeController, dt: Any, t1: FloatScalarLike | None
) -> bool:
    """Return whether all steps have the same size and `num_steps` ends the run."""
    is_constant = isinstance(controller, ConstantStepSize)
    return is_constant and t1 is None and np.ndim(dt) == 0


def _refuse_max_steps(max_steps: int | None) -> None:
    if max_steps is not None:
        raise ValueError(
            "`max_steps` is given together with `num_steps`. It limits runs to `t1`, "
            "whose number of steps is not known."
        )


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

    The step solves the discrete equations of the paper (listed in its four summaries).
    The result equals the result of `integrate` with `num_steps=1` bit for bit. Use this
    function for control loops, for environments of reinforcement learning, and for
    other time loops that `integrate` does not offer. It works under `jit`, `vmap`,
    `grad`, `jvp`, `hessian` and inside `jax.lax.scan`. For many steps, `integrate` is
    faster than a loop over `step`, and its compensated sums lose less to round-off.

    **Arguments:**

    - `system`, `method`: as for `nhjax.integrate`.
    - `t`: the time of `y`.
    - `dt`: the step size, a scalar, in units of time; negative to integrate backwards.
    - `y`: a consistent state, from `nhjax.initial_state`, a `Solution` or an earlier
        step.
    - `args`: passed on to the functions of the system, for instance controls that are
        constant during the step.
    - `stage_solver`: `nhjax.SimplifiedNewton()` by default, or `nhjax.Newton()`.
    - `throw`: whether to raise an error if the step cannot be solved. If false, all
        numbers of the state returned in this case are NaN.
    - `invariants`: quantities that the step conserves, as for `nhjax.integrate`.

    **Returns:** the `State` at `t + dt`.

    **Raises:** the same errors as `nhjax.integrate`.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> y, method = disc.initial_state(), nhjax.LobattoIIIAB(3)
        >>> y = nhjax.step(disc.system, method, t=0.0, dt=0.1, y=y)
        >>> y.q.shape
        (4,)
    """
    call = "Call it as `step(system, method, t, dt, y, args)`."
    check_type("y", y, State, f"Make one with nhjax.initial_state. {call}")
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


def suggest_step(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    y0: State,
    *,
    t1: FloatScalarLike,
    rtol: FloatScalarLike,
    atol: FloatScalarLike | None = None,
    t0: FloatScalarLike = 0.0,
    args: Args = None,
    stage_solver: AbstractStageSolver = SimplifiedNewton(),
    max_steps: int = 4096,
) -> float:
    """Suggest a step size for runs with constant steps, from a trial run.

    In the trial run from `t0` to `t1`, `nhjax.PIDController(rtol, atol)` chooses the
    step sizes. The suggestion is the smallest of these sizes. The first steps, in which
    the controller still searches for a suitable size, and the last step, which must end
    at `t1`, are left out. The size is then rounded down, so that a whole number of
    steps leads from `t0` to `t1`. Constant steps of this size have errors within the
    tolerance in the fastest phase of the motion, and smaller errors elsewhere.

    **Arguments:**

    - `system`, `method`, `y0`, `args`, `stage_solver`: as for `nhjax.integrate`.
    - `t0`, `t1`: the start and the end of the trial, which should contain the fastest
        phase of the motion; in the unit of time of the system.
    - `rtol`, `atol`: the tolerances of each step; `atol` is `rtol` by default.
    - `max_steps`: the largest number of attempts at a step.

    **Returns:** the step size, a float with the sign of t1 - t0.

    **Raises:** `IntegrationError` if the trial fails; `RuntimeError` under `jit` and
    other transformations; otherwise the same errors as `nhjax.integrate`.

    !!! example

        >>> import nhjax
        >>> disc, method = nhjax.systems.VerticalRollingDisc(), nhjax.LobattoIIIAB(3)
        >>> dt = nhjax.suggest_step(disc.system, method, disc.initial_state(), t1=1.0,
        ...     rtol=1e-6)
        >>> 0.0 < dt <= 1.0
        True
    """
    if _is_tracing():
        raise RuntimeError(
            "`suggest_step` chooses a number on the host: call it outside of jit, vmap "
            "and grad, and pass its result on."
        )
    sol = integrate(
        system,
        method,
        y0,
        t0=t0,
        t1=t1,
        args=args,
        saveat=SaveAt(t0=True, steps=True, fn=lambda t, y, args: t),
        stage_solver=stage_solver,
        stepsize_controller=PIDController(rtol, rtol if atol is None else atol),
        max_steps=max_steps,
    )
    ts = np.asarray(sol.ts, float)
    sizes = np.abs(np.diff(ts))
    # Sizes grow by large factors until the controller has found a suitable size.
    growing = sizes[1:] > 2 * sizes[:-1]
    first = len(growing) if growing.all() else int(np.argmin(growing))
    needed = sizes[first:-1] if sizes[first:-1].size else sizes[-1:]
    number = max(1, math.ceil(abs(ts[-1] - ts[0]) / np.min(needed) * (1 - 1e-9)))
    return float((ts[-1] - ts[0]) / number)


def _program_of_run(grid: Grid) -> Callable[..., Solution]:
    """Choose between one program for the whole run and chunks of steps."""
    # With `jax.disable_jit`, the user wants to step through single operations.
    no_jit = jax.config.jax_disable_jit  # pyright: ignore[reportAttributeAccessIssue]
    if _is_tracing() or no_jit or not isinstance(grid.most_steps, int):
        return run
    return run_in_chunks


def _warn_of_errors(sol: Solution, dt: FloatScalar) -> None:
    """Warn, outside of transformations, if the steps are far too large."""
    estimate = sol.stats.get("max_error_estimate")
    if estimate is None or is_traced(estimate, dt):
        return
    if float(estimate) > _TOO_LARGE_ERROR:
        size = float(dt)
        warnings.warn(_TOO_LARGE.format(size, float(estimate), size / 4), stacklevel=3)


def _warn_of_iterations(
    sol: Solution,
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    y: State,
    args: Args,
) -> None:
    """Warn if steps with the approximate Jacobian converged slowly or not at all.

    There is no warning if the full Jacobian is not available. The time `t` and the
    state `y` are the start of the run.
    """
    steps = int(sol.stats["num_steps"]) + int(sol.stats.get("num_rejected_steps", 0))
    if steps < _FEW_STEPS or is_unsolved(sol):
        return
    number = int(sol.stats["num_iterations"]) / steps
    unsolved = int(sol.stats.get("num_unsolved_steps", 0))
    if unsolved > max(_FEW_STEPS, _MANY_UNSOLVED * steps):
        message = _UNSOLVED.format(unsolved, steps) + _FULL
    elif number > _MANY_ITERATIONS:
        message = _SLOW.format(number) + _FULL
    else:
        return
    u = system.fibre_coordinate(y)
    if has_force_slopes(system, t, y.q, u, y.multiplier, args):
        warnings.warn(message, stacklevel=3)


def _require_constraints(
    sol: Solution,
    system: AbstractMechanicalSystem,
    t0: FloatScalar,
    y0: State,
    args: Args,
) -> None:
    """Raise with the details if a run failed at its start because of constraints."""
    if _is_tracing():
        return
    if is_singular_from_the_start(sol):
        require_independent(system, t0, y0, args)
    if ended_as(sol, "inconsistent_start"):
        message = sol.failures()[0][2]
        details = describe_inconsistency(system, t0, y0, args)
        raise IntegrationError(f"Integration failed in step 0: {message} {details}")


def _invalid_unless(valid: BoolScalar, sol: Solution) -> Solution:
    """Return the solution, with the result `invalid_argument` unless `valid`."""
    result = RESULTS.where(valid, sol.result, RESULTS.invalid_argument)
    failed_step = jnp.where(valid, sol.stats["failed_step"], 0)
    return replace(sol, result=result, stats=sol.stats | {"failed_step": failed_step})


def _times(
    y0: State | Checkpoint,
    state: State,
    t0: FloatScalarLike | None,
    dt: Any,
    num_steps: int | IntScalar,
) -> tuple[FloatScalar, FloatScalar, list[Check]]:
    """Return the time of `y0` and the step size as arrays, and the checks of both."""
    if dt is None:
        raise TypeError(
            "`dt` is missing: give the size of the steps, or a `stepsize_controller` "
            "that chooses it, such as nhjax.PIDController(rtol=1e-6, atol=1e-6)."
        )
    dt = real_scalar("dt", dt, state.p.dtype)
    t0 = real_scalar("t0", time_of(y0, t0), state.p.dtype)
    known = dt if is_traced(dt) else np.asarray(dt)
    checks = [
        finite("dt", dt),
        finite("t0", t0),
        Check(known != 0, _zero_step),
        *_countable(num_steps),
        *countable_from(y0, num_steps),
        _advancing(t0, dt),
    ]
    return t0, dt, checks


def _check_method(method: AbstractMethod, y0: State, saveat: SaveAt) -> None:
    """Raise unless the method supports the constraints and the output."""
    if y0.multiplier.shape[0] > 0:
        method.require_constraint_hypotheses()
    if saveat.dense or saveat.ts is not None:
        require_collocation(method)


def _zero_step() -> ValueError:
    return ValueError("`dt` is zero; give a positive or negative step size.")


def _what_needs_the_length(saveat: SaveAt, meter: AbstractProgressMeter) -> str | None:
    """Return the first option that needs `num_steps` when tracing, or None."""
    needs = {
        "the output of `SaveAt(steps=...)`": bool(saveat.steps),
        "the output of `SaveAt(dense=True)`": saveat.dense,
        "the output of `SaveAt(ts=...)`": saveat.ts is not None,
        "the `progress_meter`": not meter.silent,
    }
    return next((name for name, needed in needs.items() if needed), None)


def _check_num_steps(num_steps: Any, needed_by: str | None) -> int | IntScalar:
    """Return `num_steps` as an int >= 1, or as an array if no option needs its value.

    **Arguments:**

    - `num_steps`: the user's argument.
    - `needed_by`: the name of an option that needs the number of steps when tracing,
        for instance because the shape of its output depends on it; None if no option
        needs it.
    """
    if isinstance(num_steps, jax.Array | np.ndarray):
        return _traced_count(num_steps, needed_by)
    if num_steps is None:
        raise TypeError(
            "`num_steps` is missing: give the number of steps, or `t1`, the end of the "
            "run."
        )
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


def _countable(num_steps: int | IntScalar) -> list[Check]:
    """Return the check that a traced number of steps is in its range.

    The list is empty for a concrete number, which `_check_num_steps` has checked.
    """
    if isinstance(num_steps, int) or not is_traced(num_steps):
        return []
    ok = num_steps >= 1
    if jnp.iinfo(num_steps.dtype).max > MOST_STEPS:
        ok = ok & (num_steps <= MOST_STEPS)
    return [Check(ok, _count_error, (num_steps,))]


def _advancing(t0: FloatScalar, dt: FloatScalar) -> Check:
    """Return the check that t0 + dt differs from t0, so that time advances."""
    # Concrete values are compared with NumPy, which is ten times faster than JAX.
    numpy: Any = jnp if is_traced(t0, dt) else np
    first, h = numpy.asarray(t0), numpy.asarray(dt)
    # Infinite numbers are checked separately, and need no warning here.
    with np.errstate(over="ignore", invalid="ignore"):
        ok = first + h != first
    return Check(ok, _standstill_error, (first, h))


def _standstill_error(first: Any, h: Any) -> ValueError:
    return ValueError(
        f"`dt` = {h} is below the round-off of the time `t0` = {first} in {h.dtype}: "
        "t0 + dt equals t0, and time would not advance. Measure time from a later "
        "origin, or take larger steps."
    )


# The function `get_opaque_trace_state` of JAX returns a value that identifies the
# current transformations. Such values can only be compared with each other. In releases
# of JAX in which this function is not public, `_is_tracing` is always True.
_trace_state = getattr(jax.extend.core, "get_opaque_trace_state", lambda **_: object())
with jax.ensure_compile_time_eval():
    # This is the value outside of all transformations, even if this module is imported
    # inside a transformation.
    _NOT_TRACING = _trace_state(convention="nhjax")


def _is_tracing() -> bool:
    """Return whether this is called inside a transformation such as jit or vmap."""
    return _trace_state(convention="nhjax") != _NOT_TRACING
