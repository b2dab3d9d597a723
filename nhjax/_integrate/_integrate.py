import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import jax.numpy as jnp
import numpy as np

from .._custom_types import (
    Args,
    BoolScalar,
    FloatScalar,
    FloatScalarLike,
    IntScalar,
    PhaseFunction,
)
from .._errors import Check, hold, is_traced, require
from .._method import AbstractMethod, Gauss, LobattoIIIAB, PartitionedRungeKutta
from .._results import RESULTS
from .._step import (
    AbstractStageSolver,
    is_simplified_alone,
    leaves_steps_to_newton,
    SimplifiedNewton,
)
from .._system import (
    AbstractMechanicalSystem,
    check_flag,
    check_type,
    finite,
    HamiltonianSystem,
    LagrangianSystem,
    parameters,
    real_scalar,
    require_independent,
    State,
)
from ._adjoint import AbstractAdjoint, DirectAdjoint
from ._checkpoint import check_start, Checkpoint, countable_from, time_of
from ._checks import advancing, check_num_steps, countable, is_tracing
from ._event import checked_events, Event
from ._interpolation import require_collocation
from ._options import Means, Options, TimeGrid
from ._progress_meter import AbstractProgressMeter, NoProgressMeter
from ._run import run
from ._saveat import SaveAt
from ._solution import (
    is_singular_from_the_start,
    is_unsolved,
    raise_failures,
    Solution,
)


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
