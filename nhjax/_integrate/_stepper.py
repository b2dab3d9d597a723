"""The steps of a run: the loop carry, one step forward and one step back."""

from abc import abstractmethod
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._compile import Programs
from .._custom_types import Args, BoolScalar, FloatScalar
from .._method import AbstractMethod
from .._numerics import iterate, max_norm, Sizes, tree_where
from .._results import RESULTS
from .._step import (
    AbstractStageSolver,
    estimated_error,
    first_step_state,
    Invariants,
    largest_violation,
    primitive_step,
    round_off_of_steps,
    RoundOff,
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
from ._progress import Progress


Statistics: TypeAlias = dict[str, Any]


class Carry(NamedTuple):
    """The data that the time loop carries from one step to the next.

    Derivatives pass through `step_state` alone, and in a run with events through the
    time in `progress`, which other runs do not have.
    """

    step_state: StepState
    result: RESULTS
    stats: Statistics
    progress: Progress | None = None


def progress_of(carry: Carry) -> Progress:
    """Return the progress of a run that has events."""
    assert carry.progress is not None
    return carry.progress


class Taken(NamedTuple):
    """The record of a step that was taken, and whether the step was solved."""

    record: StepRecord
    good: BoolScalar


class Stepping(eqx.Module):
    """The system, method and options of a run, with functions that take its steps.

    `programs` keeps the program of a step, which is the same for each way in which the
    run is differentiated. The first step is number `origin.first_step` of those counted
    from `origin.t0`. The `round_off` of the functions of the system is measured at the
    start; see `round_off_at`.
    """

    system: AbstractMechanicalSystem
    method: AbstractMethod = eqx.field(static=True)
    stage_solver: AbstractStageSolver
    origin: Origin
    dt: FloatScalar
    args: Args
    invariants: Invariants | None
    programs: Programs
    round_off: RoundOff | None = None

    def time(self, k: Int[Array, ""] | int) -> FloatScalar:
        """Compute the time t_k as a product, since a running sum of dt would drift."""
        t0, first_step, shift = self.origin
        number = (first_step + k).astype(self.dt.dtype)
        return t0 + number * self.dt + shift

    def start(self, y0: State | Checkpoint, noise: FunctionNoise | None) -> Carry:
        """Make the carry of the time loop before the first step.

        The noise of the functions of the system is given with a state, not with a
        checkpoint, which has what follows from it.
        """
        system, t, args = self.system, self.time(0), self.args
        checkpoint = y0 if isinstance(y0, Checkpoint) else None
        if isinstance(y0, Checkpoint):
            y0 = y0.state
        step_state = first_step_state(system, self.method, t, y0, args)
        if checkpoint is not None:
            step_state = resumed(checkpoint, step_state)
            violations = RoundOff.of_arrays(checkpoint.round_off).violations
        else:
            assert noise is not None
            violations = noise.violations
        result = RESULTS.where(
            is_consistent(system, t, step_state, args, violations),
            RESULTS.successful,
            RESULTS.inconsistent_start,
        )
        if y0.multiplier.shape[0] > 1:
            # That of one constraint is found singular by the first step.
            result = RESULTS.where(
                (result == RESULTS.successful) & ~step_state.lin.determines_multipliers,
                RESULTS.singular_stage_matrix,
                result,
            )
        if self.invariants is not None:
            kept = conserves(system, self.invariants, t, self.dt, y0, args)
            result = RESULTS.where(
                (result == RESULTS.successful) & ~kept, RESULTS.not_conserved, result
            )
        result = RESULTS.where(all_finite(y0), result, RESULTS.nonfinite_state)
        violation = largest_violation(system, t, step_state, args)
        redundant = step_state.lin.num_redundant
        stats = first_statistics(violation, redundant, result == RESULTS.successful)
        if self.invariants is not None:
            stats["max_invariant_error"] = jnp.zeros_like(violation)
        if self.method.embedded_difference is not None:
            stats["max_error_ratios"] = jnp.zeros((2,), violation.dtype)
        return Carry(step_state, result, stats)

    def round_off_at(
        self, y0: State | Checkpoint, first: StepState, noise: FunctionNoise | None
    ) -> RoundOff:
        """Compute the round-off of steps from the noise of the functions.

        A checkpoint holds the value of the first run: a resumed run takes the same
        steps.
        """
        if isinstance(y0, Checkpoint):
            return jax.lax.stop_gradient(RoundOff.of_arrays(y0.round_off))
        assert noise is not None
        return round_off_of_steps(self.method, first.lin, noise)

    def one_step(
        self, step_state: StepState, t: FloatScalar, h: FloatScalar, skip: BoolScalar
    ) -> StepOutcome:
        """Take one step of size h from t; h may be negative, to go back."""
        start = step_state.differentiated_in_state()
        given = self.system, t, h, start, self.args, self.invariants, self.round_off
        arguments = StepArguments(*given)
        method, stage_solver = self.method, self.stage_solver
        return primitive_step(arguments, method, stage_solver, skip, self.programs)

    def nothing_taken(self, carry: Carry) -> Taken:
        """Make the record of a step that was not taken, all zeros at the stages."""
        state = carry.step_state.state

        def at_stages(x: Array) -> Array:
            return jnp.zeros((self.method.stages, *x.shape), x.dtype)

        stages = map(at_stages, (state.v, state.p, state.multiplier))
        return Taken(StepRecord(state, *stages), jnp.zeros((), bool))

    def advance(self, carry: Carry, k: Int[Array, ""]) -> tuple[Carry, Taken]:
        """Take step k; a trajectory that has failed keeps its last good state."""
        alive = carry.result == RESULTS.successful
        outcome = self.one_step(carry.step_state, self.time(k), self.dt, ~alive)
        good = alive & (outcome.result == RESULTS.successful)
        step_state = tree_where(good, outcome.step_state, carry.step_state)
        # A loop is differentiated again and again until it is known which parts of its
        # carry have derivatives: here it is known from the first time on.
        step_state = step_state.differentiated_in_state()
        result = RESULTS.where(alive, outcome.result, carry.result)
        stats = updated_statistics(carry.stats, outcome, alive, good, k)
        carry = Carry(step_state, result, jax.lax.stop_gradient(stats))
        return carry, Taken(outcome.record, good)


def as_checkpoint(
    stepping: Stepping, round_off: RoundOff, carry: Carry, end: State
) -> Checkpoint:
    """Make the checkpoint of what is carried after the last step, with the state `end`.

    That is the last state with the derivatives that it is to have. The round-off is the
    one that the run started with.
    """
    origin, last = stepping.origin, carry.step_state
    return Checkpoint(
        end,
        last.q_compensation,
        last.p_compensation,
        tuple(jax.tree.leaves(last.lin)),
        tuple(jax.tree.leaves(round_off)),
        origin.t0 + origin.shift,
        stepping.dt,
        origin.first_step + carry.stats["num_steps"],
    )


def is_consistent(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    start: StepState,
    args: Args,
    violations: tuple[Float[Array, " l"], Float[Array, " k"]],
) -> BoolScalar:
    """Tell whether the initial state is consistent, up to small errors.

    `violations` are those of constraints that are round-off.

    It is if it lies on the group, satisfies the constraints, and its v and p belong
    together by the Legendre transform. The bound on the errors is meant to find a state
    of another system, or one of which a single part was changed by hand. It is large
    enough for the perturbations by which derivatives are approximated.
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
    """Make the statistics of a run before its first step.

    **Arguments:**

    - `violation`: the largest constraint violation of the initial state.
    - `redundant`: how many constraints follow from others at the initial state.
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
    """Make the statistics that a solution has, of those that are carried."""
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
    """Update the statistics of a run after its step k.

    **Arguments:**

    - `stats`: the statistics before the step.
    - `outcome`: the outcome of the step.
    - `alive`: whether the run had not failed before, so that the step was taken.
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


class AbstractStepInterval(eqx.Module):
    """The time interval of a step that is to be retraced."""

    @property
    @abstractmethod
    def start(self) -> FloatScalar:
        """Return the time at which the step started."""

    @property
    @abstractmethod
    def end(self) -> FloatScalar:
        """Return the time at which the step ended."""

    @property
    @abstractmethod
    def size(self) -> FloatScalar:
        """Return the size of the step."""


class WholeStep(AbstractStepInterval):
    """The time interval of step k of a run without events."""

    stepping: Stepping
    k: Int[Array, ""]

    @property
    def start(self) -> FloatScalar:
        """Return the time t_k at which the step started."""
        return self.stepping.time(self.k)

    @property
    def end(self) -> FloatScalar:
        """Return the time t_{k+1} at which the step ended."""
        return self.stepping.time(self.k + 1)

    @property
    def size(self) -> FloatScalar:
        """Return the step size dt."""
        return self.stepping.dt


class PartOfStep(AbstractStepInterval):
    """The time interval of a part of a step, from a time `since`, of some `length`."""

    since: FloatScalar
    length: FloatScalar

    @property
    def start(self) -> FloatScalar:
        """Return the time at which the step started."""
        return self.since

    @property
    def end(self) -> FloatScalar:
        """Return the time at which the step ended."""
        return self.since + self.length

    @property
    def size(self) -> FloatScalar:
        """Return the size of the step."""
        return self.length


def step_back(
    stepping: Stepping, step_state: StepState, interval: AbstractStepInterval
) -> StepState:
    """Compute the state that a step started from, given the one that it led to."""
    go_on = jnp.asarray(False)

    def back_from(step_state: StepState) -> StepState:
        t, h = interval.end, -interval.size
        return stepping.one_step(step_state, t, h, go_on).step_state

    if _retraces(stepping, step_state):
        return back_from(step_state)

    # Let y be the end of a step back from z. Each sweep moves z by the difference
    # between `step_state` and the end of the step forward from y. The two steps undo
    # each other up to a small error, so that this iteration contracts far faster than
    # one that moves y would.
    target = step_state.state
    manifold = stepping.system.manifold_of(target.q)
    propagated = stepping.method.closure == "propagated"

    def sweep(z: State):
        y = back_from(eqx.tree_at(lambda x: x.state, step_state, z))
        t, h = interval.start, interval.size
        reached = stepping.one_step(y, t, h, go_on).step_state.state
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
        return z, Sizes(size), y

    scale = 1 + max_norm(target.p)
    limit = stepping.stage_solver.max_iterations
    return iterate(sweep, target, scale, max_iterations=limit).aux


def _retraces(stepping: Stepping, step_state: StepState) -> bool:
    """Tell whether a step of -h undoes a step of h, up to round-off."""
    system, method = stepping.system, stepping.method
    is_flat = system.manifold_of(step_state.state.q).is_flat
    if not is_flat and method.chart != "middle":
        return False
    if system.nonholonomic is not None and method.closure == "consistent":
        return False
    return method.is_symmetric
