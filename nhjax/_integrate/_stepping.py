"""The steps of a run: what is carried from one to the next, and how each is taken."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._compile import TraceCache
from .._custom_types import Args, BoolScalar, FloatScalar
from .._method import AbstractMethod
from .._numerics import max_norm, tree_where
from .._results import RESULTS
from .._step import (
    AbstractStageSolver,
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
from ._statistics import first_statistics, Statistics, updated_statistics


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
    programs: TraceCache
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
