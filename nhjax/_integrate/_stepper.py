"""The stepper protocol, by which the time loop advances, and the plain stepper.

A stepper has its own loop carry: `init` creates it, `advance` performs one iteration,
and `finish` returns the end of the run. The plain stepper takes one step of the method
in each iteration. Two further steppers call the plain stepper: the stepper in
`_variable` for steps of different sizes, and the stepper in `_events` for runs with
events. The loop and the adjoints work with any stepper.
"""

from abc import abstractmethod
from dataclasses import replace
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from .._compile import TraceCache
from .._custom_types import Args, BoolScalar, FloatScalar, IntScalar
from .._method import AbstractMethod
from .._numerics import iterate, max_norm, nan_gradient_unless, tree_where, UpdateNorms
from .._results import RESULTS
from .._step import (
    AbstractStageSolver,
    estimated_error,
    first_step_state,
    ImplicitStep,
    Invariants,
    largest_violation,
    StepArguments,
    StepOutcome,
    StepRecord,
    StepState,
)
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    FunctionNoise,
    keeps_constraints,
    State,
)
from ._checkpoint import Checkpoint, Origin, resumed
from ._conservation import conserves


Statistics: TypeAlias = dict[str, Any]


class AbstractCarry(eqx.Module):
    """The data that the time loop carries from one iteration to the next."""

    step_state: eqx.AbstractVar[StepState]
    result: eqx.AbstractVar[RESULTS]
    stats: eqx.AbstractVar[Statistics]


class StepResult(NamedTuple):
    """The data that one iteration of the time loop can save.

    - `t`: the time that the iteration reached.
    - `record`: the record of the step, for interpolation.
    - `is_good`: whether a step was taken and solved.
    - `row`: the index of the output row that the iteration fills; the number of steps
        if it fills no row; None if iteration k always fills row k.
    - `log_entry`, `log_slot`: an entry for the log of the stepper, from which a reverse
        replay finds the iterations again, and its index in the log. Without an entry
        the index is the length of the log. Both are None for a stepper without a log.
    """

    t: FloatScalar
    record: StepRecord
    is_good: BoolScalar
    row: Int[Array, ""] | None = None
    log_entry: PyTree[Array] | None = None
    log_slot: Int[Array, ""] | None = None


Rows = TypeVar("Rows")
Log = TypeVar("Log")


class RunEnd(NamedTuple, Generic[Rows, Log]):
    """The end of a run: its state and time, the saved rows, and the log.

    The `log` is None for a stepper without a log.
    """

    state: State
    t: FloatScalar
    rows: Rows
    log: Log


C = TypeVar("C", bound=AbstractCarry)
# The data that a reverse replay has about an iteration, besides the state from which
# the iteration started.
R = TypeVar("R")


class AbstractStepper(eqx.Module, Generic[C, R]):
    """The way in which the time loop of a run advances."""

    # The stepper that takes single steps of the method.
    plain: eqx.AbstractVar["PlainStepper"]

    @property
    @abstractmethod
    def num_iterations(self) -> int | IntScalar:
        """Return an upper bound on the number of iterations of the run."""

    @property
    def may_end_early(self) -> bool:
        """Return whether the loop stops as soon as `is_over` is true for the carry."""
        return False

    def is_over(self, carry: C) -> BoolScalar:
        """Return whether all further iterations would leave the carry unchanged."""
        return carry.result != RESULTS.successful

    def progress(self, carry: C) -> Any:
        """Compute the part of the run that is done, from 0 to 1.

        The result is None if the run cannot end early.
        """
        del carry
        return None

    @property
    @abstractmethod
    def log_length(self) -> int:
        """Return the number of entries of the log, or 0 for a stepper without a log."""

    @abstractmethod
    def num_filled(self, carry: C, i: Int[Array, ""]) -> Int[Array, ""]:
        """Return the number of output rows that are filled before iteration i."""

    @abstractmethod
    def with_noise(self, noise: FunctionNoise) -> "AbstractStepper[C, R]":
        """Return the same stepper with the measured round-off of the system."""

    @abstractmethod
    def init(self, y0: State | Checkpoint) -> C:
        """Return the carry before the first iteration."""

    @abstractmethod
    def advance(
        self, carry: C, i: Int[Array, ""], replay: R | None = None
    ) -> tuple[C, StepResult]:
        """Perform iteration i. A run that has ended or failed keeps its state.

        A reverse replay passes its data about the iteration as `replay`. The iteration
        then repeats what it did in the run.
        """

    @abstractmethod
    def blank_result(self, carry: C) -> StepResult:
        """Return a step result of the right shapes, without tracing a step."""

    @abstractmethod
    def succeeded(self, carry: C) -> BoolScalar:
        """Return whether the run came to its end without a failure."""

    @abstractmethod
    def finish(
        self, carry: C, rows: Rows, log: PyTree[Array] | None, given: Any
    ) -> RunEnd[Rows, Any]:
        """Return the end of the run, from the last carry and all saved rows.

        If the run failed, the derivatives with respect to all `given` values are NaN.
        """

    @abstractmethod
    def differentiable(self, carry: C) -> PyTree[Array]:
        """Return the parts of a carry, or of its cotangent, that have derivatives.

        This method also serves as the argument `where` of `equinox.tree_at`.
        """

    @abstractmethod
    def reverse_replay(
        self, start: C, end: C, log: PyTree[Array] | None
    ) -> "AbstractReverseReplay[C, R]":
        """Return the replay of a run from its `end` back to its `start`."""


class AbstractReverseReplay(eqx.Module, Generic[C, R]):
    """The replay of a run from its end, which finds where each iteration started."""

    @property
    @abstractmethod
    def num_iterations(self) -> int | IntScalar:
        """Return the number of iterations that are undone."""

    @property
    @abstractmethod
    def after_end(self) -> R:
        """Return the data that `back` needs for the last iteration."""

    @abstractmethod
    def back(
        self, following: R, step_state: StepState, i: Int[Array, ""]
    ) -> tuple[R, StepState]:
        """Find the data of iteration i and the state from which it started.

        `following` is the data of iteration i + 1, and `step_state` is the state from
        which iteration i + 1 started.
        """

    @abstractmethod
    def carry_before(self, replay: R, step_state: StepState, i: Int[Array, ""]) -> C:
        """Return a carry from which `advance(carry, i, replay)` repeats iteration i."""

    @abstractmethod
    def places(
        self, replay: R, i: Int[Array, ""]
    ) -> tuple[Int[Array, ""], Int[Array, ""] | None]:
        """Return the indices of the output row and of the log entry of iteration i."""


class PlainCarry(AbstractCarry):
    """The carry of a run with constant steps and without events.

    Derivatives pass only through the state.
    """

    step_state: StepState
    result: RESULTS
    stats: Statistics


class PlainStepper(AbstractStepper[PlainCarry, None]):
    """One step of the method per iteration, from the time t_k to t_{k+1}.

    - `args`: the `args` of the run; the loop, the output and the events read it here.
    - `programs`: the traced program of a step, shared by all derivatives of the run.
    - `origin`: where times and steps are counted from. The first step of the run has
        the number `origin.first_step`.
    - `noise`: the round-off of the functions of the system, measured at the start of
        the run. If the run resumes a checkpoint, it is the value of the first run.
    """

    system: AbstractMechanicalSystem
    method: AbstractMethod = eqx.field(static=True)
    stage_solver: AbstractStageSolver
    origin: Origin
    dt: FloatScalar
    args: Args
    invariants: Invariants | None
    programs: TraceCache
    noise: FunctionNoise | None
    num_steps: int | IntScalar

    @property
    def plain(self) -> "PlainStepper":
        """Return this stepper."""
        return self

    @property
    def num_iterations(self) -> int | IntScalar:
        """Return the number of steps."""
        return self.num_steps

    @property
    def log_length(self) -> int:
        """Return 0: this stepper has no log."""
        return 0

    def num_filled(self, carry: PlainCarry, i: Int[Array, ""]) -> Int[Array, ""]:
        """Return i: every step fills a row."""
        del carry
        return i

    def with_noise(self, noise: FunctionNoise) -> "PlainStepper":
        """Return the same stepper with the measured round-off of the system."""
        return replace(self, noise=noise)

    def time(self, k: Int[Array, ""] | IntScalar | int) -> FloatScalar:
        """Compute the time t_k as a product, since a running sum of dt would drift."""
        t0, first_step, shift = self.origin
        number = (first_step + k).astype(self.dt.dtype)
        return t0 + number * self.dt + shift

    def init(self, y0: State | Checkpoint) -> PlainCarry:
        """Return the carry before the first step.

        The field `result` of the carry is a failure if the run cannot start.
        """
        system, t, args = self.system, self.time(0), self.args
        checkpoint = y0 if isinstance(y0, Checkpoint) else None
        if isinstance(y0, Checkpoint):
            y0 = y0.state
        step_state = first_step_state(system, self.method, t, y0, args)
        if checkpoint is not None:
            step_state = resumed(checkpoint, step_state)
        assert self.noise is not None
        violations = self.noise.violations
        result = RESULTS.where(
            is_consistent(system, t, step_state, args, violations),
            RESULTS.successful,
            RESULTS.inconsistent_start,
        )
        if y0.multiplier.shape[0] > 1:
            # This check is made only with several constraints. With a single
            # constraint, the first step itself detects a singular matrix.
            result = RESULTS.where(
                (result == RESULTS.successful) & ~step_state.lin.determines_multipliers,
                RESULTS.singular_stage_matrix,
                result,
            )
        if self.invariants is not None:
            conserved = conserves(system, self.invariants, t, self.dt, y0, args)
            result = RESULTS.where(
                (result == RESULTS.successful) & ~conserved,
                RESULTS.not_conserved,
                result,
            )
        result = RESULTS.where(all_finite(y0), result, RESULTS.nonfinite_state)
        violation = largest_violation(system, t, step_state, args)
        redundant = step_state.lin.num_redundant
        stats = first_statistics(violation, redundant, result == RESULTS.successful)
        if self.invariants is not None:
            stats["max_invariant_error"] = jnp.zeros_like(violation)
        if self.method.embedded_difference is not None:
            stats["max_error_ratios"] = jnp.zeros((2,), violation.dtype)
        return PlainCarry(step_state, result, stats)

    def one_step(
        self, step_state: StepState, t: FloatScalar, h: FloatScalar, skip: BoolScalar
    ) -> StepOutcome:
        """Take one step of size h from t; a negative h integrates backwards in time.

        If `skip` is true, the step is not solved, and its outcome must not be used.
        """
        start = step_state.differentiated_in_state()
        given = self.system, t, h, start, self.args, self.invariants, self.noise
        arguments = StepArguments(*given)
        step = ImplicitStep(
            method=self.method,
            stage_solver=self.stage_solver,
            skip=skip,
            programs=self.programs,
        )
        return step(arguments)

    def advance(
        self, carry: PlainCarry, i: Int[Array, ""], replay: None = None
    ) -> tuple[PlainCarry, StepResult]:
        """Take step i. A run that has failed keeps its last good state."""
        del replay
        alive = carry.result == RESULTS.successful
        outcome = self.one_step(carry.step_state, self.time(i), self.dt, ~alive)
        good = alive & (outcome.result == RESULTS.successful)
        step_state = tree_where(good, outcome.step_state, carry.step_state)
        # JAX differentiates the body of a loop repeatedly, until it knows which parts
        # of the carry have derivatives. With the next line, the first pass is enough.
        step_state = step_state.differentiated_in_state()
        result = RESULTS.where(alive, outcome.result, carry.result)
        stats = updated_statistics(carry.stats, outcome, alive, good, i)
        carry = PlainCarry(step_state, result, jax.lax.stop_gradient(stats))
        return carry, StepResult(self.time(i + 1), outcome.record, good)

    def blank_result(self, carry: AbstractCarry) -> StepResult:
        """Return an empty step result, with zeros at the stages."""
        state = carry.step_state.state

        def at_stages(x: Array) -> Array:
            return jnp.zeros((self.method.stages, *x.shape), x.dtype)

        v, p, multiplier = map(at_stages, (state.v, state.p, state.multiplier))
        record = StepRecord(state, v, p, multiplier)
        return StepResult(self.time(0), record, jnp.zeros((), bool))

    def succeeded(self, carry: PlainCarry) -> BoolScalar:
        """Return whether all steps were solved."""
        return carry.result == RESULTS.successful

    def finish(
        self, carry: PlainCarry, rows: Rows, log: None, given: Any
    ) -> RunEnd[Rows, None]:
        """Return the end of the run, at the end of the last step."""
        del log
        t1 = self.time(self.num_steps)
        found = carry.step_state.state, rows
        state, rows = nan_gradient_unless(self.succeeded(carry), found, given)
        return RunEnd(state, t1, rows, None)

    def differentiable(self, carry: PlainCarry) -> State:
        """Return the state, or its cotangent."""
        return carry.step_state.state

    def reverse_replay(
        self, start: PlainCarry, end: PlainCarry, log: None
    ) -> "PlainReverseReplay":
        """Return the replay of a run, step by step."""
        del end, log
        return PlainReverseReplay(self, start)

    def checkpoint(self, carry: AbstractCarry, end: State) -> Checkpoint:
        """Return the checkpoint after the last step.

        `end` is the last state, through which the checkpoint is differentiated.
        """
        origin, last = self.origin, carry.step_state
        return Checkpoint(
            end,
            last.q_compensation,
            last.p_compensation,
            tuple(jax.tree.leaves(last.lin)),
            tuple(jax.tree.leaves(self.noise)),
            origin.t0 + origin.shift,
            self.dt,
            origin.first_step + carry.stats["num_steps"],
        )


class PlainReverseReplay(AbstractReverseReplay[PlainCarry, None]):
    """The replay of a run with constant steps and without events.

    The index of a step gives its times, so that no log is needed.
    """

    stepper: PlainStepper
    start: PlainCarry

    @property
    def num_iterations(self) -> int | IntScalar:
        """Return the number of steps."""
        return self.stepper.num_steps

    @property
    def after_end(self) -> None:
        """Return None: the replay needs only the state."""
        return None

    def back(
        self, following: None, step_state: StepState, i: Int[Array, ""]
    ) -> tuple[None, StepState]:
        """Find the state that step i started from."""
        stepper = self.stepper
        interval = StepInterval(stepper.time(i), stepper.time(i + 1), stepper.dt)
        return None, step_back(stepper, step_state, interval)

    def carry_before(
        self, replay: None, step_state: StepState, i: Int[Array, ""]
    ) -> PlainCarry:
        """Return the carry before step i."""
        return PlainCarry(step_state, self.start.result, self.start.stats)

    def places(self, replay: None, i: Int[Array, ""]) -> tuple[Int[Array, ""], None]:
        """Return the index of the step: step i fills row i."""
        return i, None


class StepInterval(NamedTuple):
    """The time interval of a step that is to be undone, and the size of the step."""

    start: FloatScalar
    end: FloatScalar
    size: FloatScalar


def step_back(
    stepper: PlainStepper, step_state: StepState, interval: StepInterval
) -> StepState:
    """Compute the state at the start of a step from the state at its end."""
    run = jnp.asarray(False)

    def back_from(step_state: StepState) -> StepState:
        t, h = interval.end, -interval.size
        return stepper.one_step(step_state, t, h, run).step_state

    if _is_undone_by_negative_step(stepper, step_state):
        return back_from(step_state)

    # The unknown is the state z from which a step back starts. Each iteration takes
    # this step from z to a state y, and then a step forward from y. The iteration then
    # moves z by the difference between `step_state` and the end of the forward step.
    # The two steps undo each other up to a small error, so this iteration converges far
    # faster than an iteration with the unknown y.
    target = step_state.state
    manifold = stepper.system.manifold_of(target.q)
    propagated = stepper.method.carries_multiplier

    def move(z: State):
        y = back_from(eqx.tree_at(lambda x: x.state, step_state, z))
        t, h = interval.start, interval.size
        reached = stepper.one_step(y, t, h, run).step_state.state
        to_reached = manifold.inverse(reached.q)
        xi = manifold.local(manifold.compose(to_reached, target.q))
        misses = [xi, target.p - reached.p]
        multiplier = z.multiplier
        if propagated:
            miss = target.multiplier - reached.multiplier
            misses.append(interval.size * miss)
            multiplier = multiplier + miss
        size = max_norm(*misses)
        z = State(manifold.act(z.q, xi), z.v, z.p + misses[1], multiplier)
        return z, UpdateNorms(size), y

    scale = 1 + max_norm(target.p)
    limit = stepper.stage_solver.max_iterations
    return iterate(move, target, scale, max_iterations=limit).aux


def _is_undone_by_negative_step(stepper: PlainStepper, step_state: StepState) -> bool:
    """Return whether a step of -h undoes a step of h, up to round-off."""
    system, method = stepper.system, stepper.method
    is_flat = system.manifold_of(step_state.state.q).is_flat
    if not is_flat and method.chart != "middle":
        return False
    has_symmetric_closure = method.closure in ("propagated", "symmetric")
    if system.nonholonomic is not None and not has_symmetric_closure:
        return False
    return method.is_symmetric


def is_consistent(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    start: StepState,
    args: Args,
    violations: tuple[Float[Array, " l"], Float[Array, " k"]],
) -> BoolScalar:
    """Return whether a state is consistent, up to small errors.

    A consistent state lies on the group and satisfies the constraints, and the Legendre
    transform maps its v to its p. `violations` are the largest constraint violations
    that count as round-off. The bound on the errors is small enough to detect a state
    of another system, or a state of which only one part was changed. It is large enough
    for the perturbations of finite differences.
    """
    y, lin = start.state, start.lin
    small = float(jnp.finfo(y.p.dtype).eps) ** 0.25
    u = system.fibre_coordinate(y)
    derivative = system.fibre_derivative(t, y.q, u, args)
    given = y.p if system.fibre_coordinate_name == "v" else y.v
    size = max_norm(derivative) + max_norm(given)
    return (
        keeps_constraints(system, lin, t, y, args, small, violations)
        & (system.manifold_of(y.q).distance_to_group(y.q) <= small)
        & (max_norm(derivative - given) <= small * size)
    )


def first_statistics(
    violation: FloatScalar, redundant: Int[Array, ""], is_good: BoolScalar
) -> Statistics:
    """Return the statistics of a run before its first step.

    **Arguments:**

    - `violation`: the largest constraint violation of the initial state.
    - `redundant`: the number of redundant constraints at the initial state.
    - `is_good`: whether the run can start; otherwise step 0 counts as failed.
    """
    zero, none = jnp.zeros_like(violation), jnp.zeros((), jnp.int32)
    return {
        "num_steps": none,
        "num_iterations": none,
        "num_newton_steps": none,
        "num_redundant": redundant,
        "max_residual": zero,
        "max_constraint_violation": violation,
        "max_multiplier_defect": zero,
        "failed_step": jnp.where(is_good, none - 1, none),
        "worst_coordinate": none - 1,
    }


def reported_statistics(stats: Statistics, method: AbstractMethod) -> Statistics:
    """Return the statistics of a solution, from the statistics in the carry."""
    stats = dict(stats)
    ratios = stats.pop("max_error_ratios", None)
    if ratios is not None:
        stats["max_error_estimate"] = estimated_error(ratios, method)
    return stats


def updated_statistics(
    stats: Statistics,
    outcome: StepOutcome,
    alive: BoolScalar,
    good: BoolScalar,
    k: Int[Array, ""],
) -> Statistics:
    """Return the statistics of a run after its step k.

    **Arguments:**

    - `stats`: the statistics before the step.
    - `outcome`: the outcome of the step.
    - `alive`: whether the step was taken, because the run had not failed before.
    - `good`: whether the step was taken and solved.
    - `k`: the index of the step.
    """

    def larger(name, value):
        return jnp.where(good, jnp.maximum(stats[name], value), stats[name])

    failed = alive & ~good
    optional = {
        "max_invariant_error": outcome.invariant_error,
        "max_error_ratios": outcome.error_ratios,
    }
    present = {k: x for k, x in optional.items() if x is not None}
    return {name: larger(name, x) for name, x in present.items()} | {
        "num_steps": stats["num_steps"] + good.astype(jnp.int32),
        "num_iterations": stats["num_iterations"]
        + jnp.where(alive, outcome.num_iterations, 0),
        "num_newton_steps": stats["num_newton_steps"]
        + (good & outcome.newton).astype(jnp.int32),
        "num_redundant": stats["num_redundant"],
        "max_residual": larger("max_residual", outcome.residual),
        "max_constraint_violation": larger(
            "max_constraint_violation", outcome.constraint_violation
        ),
        "max_multiplier_defect": larger(
            "max_multiplier_defect", outcome.multiplier_defect
        ),
        "failed_step": jnp.where(failed, k, stats["failed_step"]),
        "worst_coordinate": jnp.where(
            failed, outcome.worst_coordinate, stats["worst_coordinate"]
        ),
    }
