from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ._checks import (
    all_finite,
    check_num_steps,
    check_state,
    check_type,
    finite,
    parameters,
    real_scalar,
)
from ._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from ._errors import Check, require
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
from ._scales import position_scale, violation_scale
from ._solution import raise_failures, RESULTS, Solution
from ._state import State
from ._step import first_node, largest_violation, Node, step, StepOutcome
from ._step_record import StepRecord
from ._system import AbstractMechanicalSystem, HamiltonianSystem, LagrangianSystem


def integrate(
    system: AbstractMechanicalSystem,
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

    Each step solves the discrete equations of the paper (its four summaries) to
    round-off, so that the constraints on velocities and positions hold at every node to
    round-off as well; q and p are summed with compensation, and elements of a group
    stay on it. It works under `jit` and `vmap` (over `y0`, `args`,
    `dt`, `t0` and the array leaves of `system`).

    **Arguments:**

    - `system`: the mechanical system.
    - `method`: such as `nhjax.LobattoIIIAB(stages=3)`; `Gauss` only without
        constraints.
    - `y0`: a consistent state, from `nhjax.initial_state` or an earlier `Solution`. Its
        multiplier matters to the propagated closure alone.
    - `dt`: the step size, a scalar, in units of time; negative to go back.
    - `num_steps`: how many steps, an int >= 1.
    - `t0`: the time of `y0`.
    - `args`: passed on to the functions of the system. Arrays and floats in it are
        traced, so that other values recompile nothing; anything else is static.

    **Other arguments:**

    - `saveat`: what to save, the final state by default; see `nhjax.SaveAt`.
    - `solver`: `nhjax.SimplifiedNewton()` by default, or `nhjax.Newton()`.
    - `throw`: raise if a step cannot be solved. Otherwise the trajectory stays at its
        last good state from there on, and `result` and `stats` say so; other members
        of a batch are not touched.
    - `progress_meter`: such as `nhjax.TqdmProgressMeter()`.

    **Returns:** a `Solution`.

    **Raises:** `IntegrationError` as described (under `jit` or `vmap` its message comes
    in a runtime error of JAX), `ShapeError`, `DTypeError`, `NonFiniteError`,
    `TypeError` and `ValueError` for arguments that cannot be right; a `ValueError` that
    names the failing hypothesis (H1, H2, H3) if the method cannot integrate constrained
    systems.

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
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    check_type("method", method, AbstractMethod, "Such as nhjax.LobattoIIIAB(3).")
    check_type("y0", y0, State, "Make one with nhjax.initial_state.")
    check_type("saveat", saveat, SaveAt, "Such as nhjax.SaveAt(t0=True, steps=True).")
    check_type("solver", solver, AbstractStageSolver, "Such as nhjax.Newton().")
    check_type("progress_meter", meter, AbstractProgressMeter)
    num_steps = check_num_steps(num_steps)
    args = parameters(args)
    check_state(system, y0, args)
    dtype = y0.p.dtype
    dt, t0 = real_scalar("dt", dt, dtype), real_scalar("t0", t0, dtype)
    # All on dt, which is always used: jit drops a check of what is not.
    dt = require(
        dt,
        finite("dt", dt),
        finite("t0", t0),
        Check(
            dt != 0,
            lambda: ValueError("`dt` is zero; give a positive or negative step size."),
            "`dt` is zero.",
        ),
    )
    if y0.multiplier.shape[0] > 0:
        method.require_constraint_hypotheses()
    if saveat.dense or saveat.ts is not None:
        require_collocation(method)
    saveat = saveat.within(t0, dt, num_steps)
    sol = _integrate(system, method, solver, y0, t0, dt, num_steps, args, saveat, meter)
    return raise_failures(sol) if throw else sol


_Save: TypeAlias = Callable[[FloatScalar, State], PyTree[Array]]


class _Carry(NamedTuple):
    node: Node
    result: RESULTS
    stats: dict[str, Any]


class _Loop(eqx.Module):
    """The time loop's constants, and what it does with a step's outcome."""

    system: AbstractMechanicalSystem
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
        node = first_node(self.system, self.method, self.t0, y0, self.args)
        result = RESULTS.where(
            self._is_consistent(node),
            RESULTS.successful,
            RESULTS.inconsistent_start,
        )
        result = RESULTS.where(all_finite(y0), result, RESULTS.nonfinite_state)
        zero, none = jnp.zeros((), self.dt.dtype), jnp.zeros((), jnp.int32)
        stats = {
            "num_steps": none,
            "num_iterations": none,
            "max_residual": zero,
            "max_constraint_violation": largest_violation(
                self.system, self.t0, node, self.args
            ),
            "max_multiplier_defect": zero,
            "failed_step": jnp.where(result == RESULTS.successful, none - 1, none),
        }
        return _Carry(node, result, stats)

    def _is_consistent(self, node: Node) -> BoolScalar:
        """Whether Φ = 0 and v, p belong together at the start, but for small errors.

        The bound is to find a state of another system, or one changed by hand in one
        part; it lets pass the perturbations by which derivatives are approximated.
        """
        y, lin, system = node.state, node.lin, self.system
        small = float(jnp.finfo(y.p.dtype).eps) ** 0.25
        u = system.fibre(y)
        conjugate = system.conjugate(self.t0, y.q, u, self.args)
        given = y.p if system.fibre_name == "v" else y.v
        size = jnp.max(jnp.abs(conjugate)) + jnp.max(jnp.abs(given))
        scale = violation_scale(system, lin, self.t0, y.q, u, self.args)
        positions = system.position_constraint(self.t0, y.q, self.args)
        allowed = position_scale(system, self.t0, y.q, self.args)
        return (
            jnp.all(jnp.abs(lin.violation) <= small * scale)
            & jnp.all(jnp.abs(positions) <= small * allowed)
            & (system.manifold_of(y.q).defect(y.q) <= small)
            & (jnp.max(jnp.abs(conjugate - given)) <= small * size)
        )

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
    system: AbstractMechanicalSystem,
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
        return t, jax.tree.map(jnp.asarray, saveat.fn(t, y, args))

    def one(saved: PyTree[Array]) -> PyTree[Array]:
        return jax.tree.map(lambda x: x[None], saved)

    carry, interpolation = loop.start(y0), None
    pieces = [one(save(t0, carry.node.state))] if saveat.t0 else []
    if saveat.ts is not None and not saveat.dense:
        carry, saved = _run_to_samples(loop, carry, saveat.ts, save)
    else:
        carry, saved, records = _run_to_strides(
            loop, carry, saveat.steps, saveat.dense, save
        )
        if records is not None:
            interpolation = DenseInterpolation(
                system, method, num_steps, t0, dt, records, args
            )
            if saveat.ts is not None:
                saved = jax.vmap(lambda t: save(t, interpolation.evaluate(t)))(
                    saveat.ts
                )
    t1 = loop.time(num_steps)
    pieces += [] if saved is None else [saved]
    if saveat.saves_end(num_steps):
        pieces.append(one(save(t1, carry.node.state)))
    ts, ys = stack_saved(pieces) if pieces else (None, None)
    return Solution(t0, t1, ts, ys, carry.stats, carry.result, interpolation)


def _run_to_strides(
    loop: _Loop, carry: _Carry, stride: int, dense: bool, save: _Save
) -> tuple[_Carry, PyTree[Array] | None, StepRecord | None]:
    """All steps, saving after every `stride` of them (0: never)."""

    def advance(carry, k):
        carry, record = loop.step(carry, k)
        return carry, record if dense else None

    def chunk(carry, ks):
        if stride == 1:
            # One loop less to compile.
            carry, record = advance(carry, ks[0])
            records = jax.tree.map(lambda x: x[None], record)
        else:
            carry, records = jax.lax.scan(advance, carry, ks)
        return carry, (save(loop.time(ks[-1] + 1), carry.node.state), records)

    n = loop.num_steps
    whole = n - n % stride if stride else 0
    saved, records = None, []
    if whole:
        ks = jnp.arange(whole, dtype=jnp.int32).reshape(-1, stride)
        carry, (saved, chunks) = jax.lax.scan(chunk, carry, ks)
        records.append(jax.tree.map(lambda x: x.reshape((whole, *x.shape[2:])), chunks))
    if whole < n:
        carry, rest = jax.lax.scan(
            advance, carry, jnp.arange(whole, n, dtype=jnp.int32)
        )
        records.append(rest)
    return carry, saved, stack_saved(records) if dense else None


def _run_to_samples(
    loop: _Loop, carry: _Carry, ts: Float[Array, " k"], save: _Save
) -> tuple[_Carry, PyTree[Array]]:
    """All steps, interpolating in each at the samples that it contains."""
    index = jax.vmap(lambda t: step_index(t, loop.t0, loop.dt, loop.num_steps))(ts)
    # Beyond the last sample comes one in no step.
    index = jnp.append(index, jnp.asarray(loop.num_steps, index.dtype))

    def advance(state, k):
        carry, count, saved = state
        carry, record = loop.step(carry, k)
        start = loop.time(k)

        def in_this_step(state):
            return index[state[0]] == k

        def sample(state):
            count, saved = state
            theta = (ts[count] - start) / loop.dt
            y = interpolate(
                loop.system, loop.method, record, start, loop.dt, theta, loop.args
            )
            new = save(ts[count], y)
            saved = jax.tree.map(lambda x, row: x.at[count].set(row), saved, new)
            return count + 1, saved

        count, saved = jax.lax.while_loop(in_this_step, sample, (count, saved))
        return (carry, count, saved), None

    shapes = jax.eval_shape(save, loop.t0, carry.node.state)
    saved = jax.tree.map(lambda x: jnp.zeros((*ts.shape, *x.shape), x.dtype), shapes)
    state = (carry, jnp.zeros((), jnp.int32), saved)
    ks = jnp.arange(loop.num_steps, dtype=jnp.int32)
    (carry, _, saved), _ = jax.lax.scan(advance, state, ks)
    return carry, saved
