from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree
import numpy as np

from ._custom_types import Args, FloatScalar, FloatScalarLike
from ._errors import DTypeError, is_traced, NonFiniteError, require, ShapeError
from ._interpolation import (
    DenseInterpolation,
    interpolate,
    require_collocation,
    step_index,
)
from ._method import AbstractMethod
from ._newton import AbstractStageSolver, SimplifiedNewton
from ._progress_meter import AbstractProgressMeter, NoProgressMeter
from ._saveat import SaveAt, stack_saved
from ._solution import raise_failures, RESULTS, Solution
from ._state import State
from ._step import first_node, Node, step, StepOutcome
from ._step_record import StepRecord
from ._system import LagrangianSystem


def integrate(
    system: LagrangianSystem,
    method: AbstractMethod,
    y0: State,
    *,
    dt: FloatScalarLike,
    num_steps: int,
    t0: FloatScalarLike = 0.0,
    args: Args = None,
    saveat: SaveAt | None = None,
    solver: AbstractStageSolver | None = None,
    throw: bool = True,
    progress_meter: AbstractProgressMeter | None = None,
) -> Solution:
    """Integrate a mechanical system over `num_steps` steps of size `dt`.

    Each step solves the discrete nonholonomic equations of the paper (section 4) to
    round-off, so that Φ(q_k, v_k) = 0 holds at every node to round-off as well; q and p
    are summed with compensation. It works under `jit` and `vmap` (over `y0`, `args`,
    `dt`, `t0` and the array leaves of `system`).

    **Arguments:**

    - `system`: the mechanical system.
    - `method`: such as `nhjax.LobattoIIIAB(stages=3)`; `Gauss` only without
        constraints.
    - `y0`: a consistent state, from `nhjax.initial_state` or an earlier `Solution`.
    - `dt`: the step size, a scalar, in units of time; negative to go back.
    - `num_steps`: how many steps, an int >= 1.
    - `t0`: the time of `y0`.
    - `args`: passed on to the functions of the system.

    **Other arguments:**

    - `saveat`: what to save, the final state by default; see `nhjax.SaveAt`.
    - `solver`: `nhjax.SimplifiedNewton()` by default, or `nhjax.Newton()`.
    - `throw`: raise if a step cannot be solved. Otherwise the trajectory stays at its
        last good state from there on, and `result` and `stats` say so; other members of
        a batch are not touched.
    - `progress_meter`: such as `nhjax.TqdmProgressMeter()`.

    **Returns:** a `Solution`.

    **Raises:** `IntegrationError` as described, `ShapeError`, `DTypeError`,
    `NonFiniteError`, `TypeError` and `ValueError` for arguments that cannot be right; a
    `ValueError` that names the failing hypothesis (H1, H2, H3) if the method cannot
    integrate constrained systems.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), dt=0.1, num_steps=100)
        >>> sol.ys.q.shape
        (1, 4)
    """
    saveat = SaveAt(t1=True) if saveat is None else saveat
    solver = SimplifiedNewton() if solver is None else solver
    meter = NoProgressMeter() if progress_meter is None else progress_meter
    for name, x, kind in (
        ("system", system, LagrangianSystem),
        ("method", method, AbstractMethod),
        ("y0", y0, State),
        ("saveat", saveat, SaveAt),
        ("solver", solver, AbstractStageSolver),
        ("progress_meter", meter, AbstractProgressMeter),
    ):
        if not isinstance(x, kind):
            raise TypeError(f"`{name}` must be a {kind.__name__}, got {x!r}.")
    if not isinstance(num_steps, int | np.integer) or num_steps < 1:
        raise ValueError(
            f"`num_steps` must be an int >= 1 known when tracing, got {num_steps!r}."
        )
    num_steps = int(num_steps)
    _check_state(system, y0, args)
    dtype = y0.p.dtype
    dt, t0 = _scalar("dt", dt, dtype), _scalar("t0", t0, dtype)
    dt = require(
        dt,
        dt != 0,
        lambda: ValueError("`dt` is zero; give a positive or negative step size."),
        "integrate: `dt` is zero.",
    )
    if y0.multiplier.shape[0] > 0:
        method.require_constraint_hypotheses()
    if saveat.dense or saveat.ts is not None:
        require_collocation(method)
    if saveat.ts is not None:
        saveat = _checked_ts(saveat, t0, dt, num_steps)
    sol = _integrate(system, method, solver, y0, t0, dt, num_steps, args, saveat, meter)
    return raise_failures(sol) if throw else sol


class _Carry(NamedTuple):
    node: Node
    result: RESULTS
    stats: dict[str, Any]


class _Loop(eqx.Module):
    """The time loop's constants, and what it does with a step's outcome."""

    system: LagrangianSystem
    method: AbstractMethod = eqx.field(static=True)
    solver: AbstractStageSolver
    t0: FloatScalar
    dt: FloatScalar
    num_steps: int = eqx.field(static=True)
    args: Args
    meter: AbstractProgressMeter

    def time(self, k: Int[Array, ""] | int) -> FloatScalar:
        """t_k by a product: a running sum of dt would drift."""
        return self.t0 + jnp.asarray(k, self.dt.dtype) * self.dt

    def start(self, y0: State) -> _Carry:
        """The carry before the first step."""
        zero, none = jnp.zeros((), self.dt.dtype), jnp.zeros((), jnp.int32)
        stats = {
            "num_steps": none,
            "num_iterations": none,
            "max_residual": zero,
            "max_constraint_violation": zero,
            "max_multiplier_defect": zero,
            "failed_step": none - 1,
        }
        node = first_node(self.system, self.t0, y0, self.args)
        return _Carry(node, RESULTS.successful, stats)

    def step(self, carry: _Carry, k: Int[Array, ""]) -> tuple[_Carry, StepRecord]:
        """Step k; a failed trajectory keeps its last good node."""
        alive = carry.result == RESULTS.successful
        outcome = step(
            self.system,
            self.method,
            self.solver,
            self.time(k),
            self.dt,
            carry.node,
            self.args,
            skip=~alive,
        )
        good = alive & (outcome.result == RESULTS.successful)
        node = jax.tree.map(
            lambda new, old: jnp.where(good, new, old), outcome.node, carry.node
        )
        record = StepRecord(
            carry.node.state,
            # At rest after a failure, so that dense output stays where it was.
            jnp.where(good, outcome.record.velocity, 0),
            jnp.where(good, outcome.record.force, 0),
            jnp.where(good, outcome.record.multiplier, carry.node.state.multiplier),
        )
        result = RESULTS.where(alive, outcome.result, carry.result)
        stats = self._updated(carry.stats, outcome, alive, good, k)
        self.meter.report(k, self.num_steps)
        return _Carry(node, result, stats), record

    def _updated(self, stats, outcome: StepOutcome, alive, good, k) -> dict[str, Any]:
        def larger(name, value):
            return jnp.where(good, jnp.maximum(stats[name], value), stats[name])

        return {
            "num_steps": stats["num_steps"] + good.astype(jnp.int32),
            "num_iterations": stats["num_iterations"]
            + jnp.where(alive, outcome.num_iterations, 0),
            "max_residual": larger("max_residual", outcome.residual),
            "max_constraint_violation": larger(
                "max_constraint_violation", outcome.constraint_violation
            ),
            "max_multiplier_defect": larger(
                "max_multiplier_defect", outcome.multiplier_defect
            ),
            "failed_step": jnp.where(alive & ~good, k, stats["failed_step"]),
        }


@eqx.filter_jit
def _integrate(
    system: LagrangianSystem,
    method: AbstractMethod,
    solver: AbstractStageSolver,
    y0: State,
    t0: FloatScalar,
    dt: FloatScalar,
    num_steps: int,
    args: Args,
    saveat: SaveAt,
    meter: AbstractProgressMeter,
) -> Solution:
    loop = _Loop(system, method, solver, t0, dt, num_steps, args, meter)

    def save(t: FloatScalar, y: State) -> PyTree[Array]:
        return t, saveat.fn(t, y, args)

    def one(saved: PyTree[Array]) -> PyTree[Array]:
        return jax.tree.map(lambda x: jnp.asarray(x)[None], saved)

    carry = loop.start(y0)
    if saveat.ts is not None and not saveat.dense:
        carry, saved = _run_to_samples(loop, carry, saveat.ts, save)
        records = None
    else:
        carry, saved, records = _run_to_strides(
            loop, carry, saveat.steps, saveat.dense, save
        )
    t1 = loop.time(num_steps)
    interpolation = None
    if saveat.dense:
        interpolation = DenseInterpolation(
            system, method, num_steps, t0, dt, records, args
        )
        if saveat.ts is not None:
            saved = jax.vmap(lambda t: save(t, interpolation.evaluate(t)))(saveat.ts)
    pieces = [one(save(t0, y0))] if saveat.t0 else []
    pieces += [] if saved is None else [saved]
    if saveat.saves_end(num_steps):
        pieces.append(one(save(t1, carry.node.state)))
    ts, ys = stack_saved(pieces) if pieces else (None, None)
    return Solution(t0, t1, ts, ys, carry.stats, carry.result, interpolation)


def _run_to_strides(
    loop: _Loop, carry: _Carry, stride: int, dense: bool, save
) -> tuple[_Carry, PyTree[Array] | None, StepRecord | None]:
    """All steps, saving after every `stride` of them (0: never)."""

    def advance(carry, ks):
        def body(carry, k):
            carry, record = loop.step(carry, k)
            return carry, record if dense else None

        return jax.lax.scan(body, carry, ks)

    def chunk(carry, ks):
        carry, records = advance(carry, ks) if stride > 1 else loop_once(carry, ks)
        return carry, (save(loop.time(ks[-1] + 1), carry.node.state), records)

    def loop_once(carry, ks):
        carry, record = loop.step(carry, ks[0])
        return carry, one_record(record) if dense else None

    def one_record(record):
        return jax.tree.map(lambda x: x[None], record)

    n = loop.num_steps
    whole = n - n % stride if stride else 0
    saved, records = None, []
    if whole:
        ks = jnp.arange(whole, dtype=jnp.int32).reshape(-1, stride)
        carry, (saved, chunks) = jax.lax.scan(chunk, carry, ks)
        records.append(jax.tree.map(lambda x: x.reshape((whole, *x.shape[2:])), chunks))
    if whole < n:
        carry, rest = advance(carry, jnp.arange(whole, n, dtype=jnp.int32))
        records.append(rest)
    return carry, saved, stack_saved(records) if dense else None


def _run_to_samples(
    loop: _Loop, carry: _Carry, ts: Float[Array, " k"], save
) -> tuple[_Carry, PyTree[Array]]:
    """All steps, stopping after each that contains samples to interpolate there."""

    def not_yet(target):
        return lambda state: state[0] <= target

    def advance(state):
        k, carry, _ = state
        carry, record = loop.step(carry, k)
        return k + 1, carry, record

    def sample(state, item):
        t, last = item
        state = jax.lax.while_loop(not_yet(last), advance, state)
        k, carry, record = state
        start = loop.time(k - 1)
        y = interpolate(
            loop.system,
            loop.method,
            record,
            start,
            loop.dt,
            (t - start) / loop.dt,
            loop.args,
        )
        return state, save(t, y)

    index = jax.vmap(lambda t: step_index(t, loop.t0, loop.dt, loop.num_steps))(ts)
    # One more sample takes the run to its end; it is dropped.
    index = jnp.append(index, loop.num_steps - 1)
    ts = jnp.append(ts, loop.time(loop.num_steps))
    shapes = jax.eval_shape(loop.step, carry, jnp.zeros((), jnp.int32))[1]
    record = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    state = (jnp.zeros((), jnp.int32), carry, record)
    (_, carry, _), saved = jax.lax.scan(sample, state, (ts, index))
    return carry, jax.tree.map(lambda x: x[:-1], saved)


def _scalar(name: str, x: FloatScalarLike, dtype) -> FloatScalar:
    array = jnp.asarray(x)
    if array.shape != ():
        raise ShapeError(
            f"`{name}` has shape {array.shape}, but a scalar is needed; for several "
            "values use `jax.vmap`."
        )
    if not (
        isinstance(x, int) or jnp.issubdtype(array.dtype, jnp.floating)
    ) or isinstance(x, bool):
        raise DTypeError(f"`{name}` must be a real number, got {x!r}.")
    array = array.astype(dtype)
    return require(
        array,
        jnp.isfinite(array),
        lambda: NonFiniteError(f"`{name}` is not finite: {float(array)}."),
        f"integrate: `{name}` is not finite.",
    )


def _check_state(system: LagrangianSystem, y0: State, args: Args) -> None:
    leaves = {name: getattr(y0, name) for name in ("v", "p", "multiplier")}
    manifold = system.manifold_of(y0.q)
    manifold.check(y0.q)
    for name, x in leaves.items():
        if x.dtype != y0.p.dtype or not jnp.issubdtype(x.dtype, jnp.floating):
            raise DTypeError(
                f"`y0.{name}` has dtype {x.dtype} and `y0.p` {y0.p.dtype}: all parts of "
                "a state must be of one floating-point type. Use `initial_state`."
            )
        if name != "multiplier" and x.shape != (manifold.dim,):
            raise ShapeError(
                f"`y0.{name}` has shape {x.shape}, expected ({manifold.dim},). For many "
                "trajectories use `jax.vmap` over `y0`."
            )
    t = jnp.zeros((), y0.v.dtype)
    expected = eqx.filter_eval_shape(system.constraint, t, y0.q, y0.v, args).shape
    if y0.multiplier.shape != expected:
        raise ShapeError(
            f"`y0.multiplier` has shape {y0.multiplier.shape}, but the constraints of "
            f"the system have shape {expected}. Use `initial_state` with this system."
        )
    for name, x in (("q", y0.q), *leaves.items()):
        finite = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(x)]
        if not is_traced(*finite) and not all(finite):
            raise NonFiniteError(f"`y0.{name}` is not finite: {x}.")


def _checked_ts(
    saveat: SaveAt, t0: FloatScalar, dt: FloatScalar, num_steps: int
) -> SaveAt:
    ts = saveat.ts
    assert ts is not None
    ts = ts.astype(dt.dtype)
    # In units of steps, so that direction and dtype need no cases.
    position = (ts - t0) / dt
    slack = 1e-6
    ts = require(
        ts,
        jnp.all((position >= -slack) & (position <= num_steps + slack)),
        lambda: ValueError(
            f"SaveAt: `ts` reaches from {float(ts[0])} to {float(ts[-1])}, outside the "
            f"run from {float(t0)} to {float(t0 + num_steps * dt)}."
        ),
        "SaveAt: `ts` lies outside the run.",
    )
    ts = require(
        ts,
        jnp.all(jnp.diff(position) >= 0),
        lambda: ValueError(
            "SaveAt: `ts` must be sorted in the direction of time, which runs "
            f"{'forward' if dt > 0 else 'backward'} here."
        ),
        "SaveAt: `ts` must be sorted in the direction of time.",
    )
    return eqx.tree_at(lambda s: s.ts, saveat, ts)
