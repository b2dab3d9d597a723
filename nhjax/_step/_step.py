"""One step of a method, and the data that is carried from step to step."""

from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import Args, BoolScalar, FloatScalar
from .._method import AbstractMethod
from .._numerics import (
    stop_gradient,
    has_tangent,
    largest_column,
    max_norm,
    relative,
    small_einsum,
    Solved,
    two_sum,
    zero_unless,
)
from .._results import RESULTS
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    keeps_constraints,
    Linearisation,
    linearise,
    State,
)
from ._end import end_state, step_record
from ._error_estimate import error_ratios
from ._invariants import Invariants, StartImpulses
from ._jacobian import Evaluation
from ._newton import AbstractStageSolver
from ._record import StepRecord
from ._round_off import RoundOff
from ._stage_equations import end_impulse, in_chart, start_impulse
from ._stage_system import StageEquations
from ._starting_values import starting_values
from ._unknowns import StageUnknowns


class StepState(eqx.Module):
    """The data that is carried from step to step: a state, and what is known there.

    The compensations are the rounding errors of the running sums q and p. The
    linearisation `lin` gives the Jacobian of the next step and the multiplier λ_c. It
    belongs to the system and the args with which it was made; `first_step_state` makes
    one for others.
    """

    state: State
    q_compensation: PyTree[Array]
    p_compensation: Float[Array, " n"]
    lin: Linearisation

    def wrapped(self, system: AbstractMechanicalSystem) -> State:
        """Return the state with the angles of the first turn, with all their digits."""
        q, manifold = self.state.q, system.manifold_of(self.state.q)
        return replace(self.state, q=manifold.wrapped(q, self.q_compensation))

    def differentiated_in_state(self) -> "StepState":
        """Return the same data, differentiable with respect to the state alone.

        The derivatives with respect to the other data are zero: rounding errors have
        none, and the linearisation serves as a Jacobian, on which the end of a step
        does not depend.
        """
        return eqx.tree_at(lambda x: x.state, jax.lax.stop_gradient(self), self.state)


class StepArguments(eqx.Module):
    """The arguments of a step with respect to which it can be differentiated.

    Of `step_state` this is the state alone; see `StepState.differentiated_in_state`.
    Without `invariants` the step keeps none. Without `round_off` the sizes of the
    unknowns tell how large round-off is.
    """

    system: AbstractMechanicalSystem
    t: FloatScalar
    h: FloatScalar
    step_state: StepState
    args: Args
    invariants: Invariants | None = None
    round_off: RoundOff | None = None


class StepOutcome(NamedTuple):
    """The outcome of a step: the next state or the reason why there is none.

    - `step_state`: the data to carry to the next step.
    - `record`, `stages`: the stages of the step, for dense output and for derivatives.
    - `result`: whether the step was solved, and otherwise why not.
    - `num_iterations`: how many iterations the stage solver made.
    - `residual`: the residual of the stage equations, relative to the momenta.
    - `worst_coordinate`: the index of the coordinate whose equations have the largest
        residual.
    - `constraint_violation`: the largest violation of a constraint at the end.
    - `multiplier_defect`: the distance |Λ^s - λ_c| at the end.
    - `newton`: whether Newton's method took over from simplified Newton.
    - `invariant_error`: the largest error of an invariant at the end, relative to the
        size of its terms; None if the run keeps none.
    - `error_ratios`: what tells how large the error of the step is; None for a method
        with one node.
    """

    step_state: StepState
    record: StepRecord
    stages: StageUnknowns
    result: RESULTS
    num_iterations: Int[Array, ""]
    residual: FloatScalar
    worst_coordinate: Int[Array, ""]
    constraint_violation: FloatScalar
    multiplier_defect: FloatScalar
    newton: BoolScalar
    invariant_error: FloatScalar | None
    error_ratios: Float[Array, "2"] | None


def first_step_state(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalar,
    y0: State,
    args: Args,
) -> StepState:
    """Make the data that the first step starts from, given a consistent state.

    With closures that do not carry the multiplier from step to step, the first state
    already has the continuous multiplier λ_c.
    """
    u = system.fibre_coordinate(y0)
    lin = linearise(system, t, y0.q, u, args, may_be_sparse=True)
    multiplier = _continuous_multiplier(
        (system, t, y0.q, system.fibre_coordinate(y0), args)
    )
    carried = method.closure == "propagated"
    return StepState(
        state=State(y0.q, y0.v, y0.p, y0.multiplier if carried else multiplier),
        q_compensation=system.manifold_of(y0.q).no_compensation(y0.q),
        p_compensation=jnp.zeros_like(y0.p),
        lin=stop_gradient(lin),
    )


@eqx.filter_custom_jvp
def _continuous_multiplier(arguments: tuple[Any, ...]) -> Float[Array, " l"]:
    return linearise(*arguments, may_be_sparse=True).multiplier


@_continuous_multiplier.def_jvp
def _continuous_multiplier_jvp(primals, tangents):
    # The derivative is set to zero where the multiplier is not finite: NaN times zero
    # would be NaN even for a lane on which nothing depends.
    (arguments,), (rates,) = primals, tangents
    multiplier = _continuous_multiplier(arguments)
    ok = jnp.all(jnp.isfinite(multiplier))
    perturbed, fixed = eqx.partition(arguments, has_tangent(rates))
    _, change = jax.jvp(
        lambda perturbed: (
            linearise(*eqx.combine(perturbed, fixed), may_be_sparse=True).multiplier
        ),
        (perturbed,),
        (zero_unless(ok, rates),),
    )
    return multiplier, zero_unless(ok, change)


def equations_of_step(arguments: StepArguments, method: AbstractMethod) -> StageEquations:
    """Make the equations of a step, with those of the invariants that it keeps."""
    system, t, args = arguments.system, arguments.t, arguments.args
    step_state, invariants = arguments.step_state, arguments.invariants
    y, lin, kept = step_state.wrapped(system), step_state.lin, None
    if invariants is not None:
        position = step_state.state.q, step_state.q_compensation
        kept = StartImpulses.at(invariants, system, t, y, position, args, lin)
    given = t, arguments.h, y, args, lin, kept, arguments.round_off
    return StageEquations.at(system, method, *given)


def step(
    arguments: StepArguments,
    method: AbstractMethod,
    stage_solver: AbstractStageSolver,
    skip: BoolScalar,
) -> StepOutcome:
    """Take one step of size h, from (q_k, p_k, λ_k) to (q_{k+1}, p_{k+1}, λ_{k+1}).

    Where `skip` is true nothing is solved, and the outcome is to be discarded.
    """
    system, args, step_state = arguments.system, arguments.args, arguments.step_state
    t, h, keeps_invariants = arguments.t, arguments.h, arguments.invariants is not None
    state, lin = step_state.state, step_state.lin
    stages = equations_of_step(arguments, method)
    x0 = starting_values(stages, system.fibre_coordinate(state), lin)
    solved = stage_solver.solve(stages, x0, lin, skip)
    x, forces = solved.x, solved.aux.forces

    chart = stages.chart(x)
    q, q_compensation = chart.advance(state.q, step_state.q_compensation)
    at_end = chart.manifold.wrapped(q, q_compensation)
    gained = h * small_einsum("s,sn->n", stages.coefficients("b"), forces.force)
    p, p_compensation = state.p, step_state.p_compensation
    if keeps_invariants:
        p_compensation = p_compensation + start_impulse(stages, x)
    p, p_compensation = chart.advance_momentum(p, gained, p_compensation)
    if keeps_invariants:
        p, p_compensation = two_sum(p, p_compensation + end_impulse(stages, x))
    u = p if stages.hamiltonian else x.node_fibre_coordinate[-1]
    lin_next = linearise(system, t + h, at_end, u, args, may_be_sparse=True)
    last = forces.multiplier[-1]
    end = end_state(stages, at_end, u, p, last, lambda: lin_next.multiplier)
    next_state = StepState(replace(end, q=q), q_compensation, p_compensation, lin_next)

    result = _result(solved, lin, next_state, in_chart(stages, x))
    if stages.redundancy is not None:
        small = float(jnp.finfo(p.dtype).eps) ** 0.5 + 100 * stage_solver.tolerance
        allowed = None if stages.round_off is None else stages.round_off.violations
        kept = keeps_constraints(system, lin_next, t + h, end, args, small, allowed)
        lost = (result == RESULTS.successful) & ~kept
        result = RESULTS.where(lost, RESULTS.lost_constraints, result)
    residual, worst = largest_column(forces.residual, solved.aux.node_residual)
    scale = max_norm(forces.momentum) + max_norm(h * forces.force)
    return StepOutcome(
        step_state=next_state,
        record=step_record(stages, state, x, forces),
        stages=x,
        result=result,
        num_iterations=solved.num_iterations,
        residual=relative(residual, scale),
        worst_coordinate=worst,
        constraint_violation=largest_violation(system, t + h, next_state, args),
        multiplier_defect=max_norm(last - lin_next.multiplier),
        newton=solved.aux.newton,
        invariant_error=_invariant_error(stages, at_end, u),
        error_ratios=error_ratios(stages, x, forces.force, u, lin),
    )


def _invariant_error(
    stages: StageEquations, q: PyTree[Array], u: Float[Array, " n"]
) -> FloatScalar | None:
    """Measure the errors of invariants at the end by the sizes of their terms."""
    if stages.invariants is None:
        return None
    invariants, t = stages.invariants.invariants, stages.t + stages.h
    error = invariants.error(stages.system, t, q, u, stages.args)
    return max_norm(relative(error, stages.invariants.sizes))


def _result(
    solved: Solved[StageUnknowns, Evaluation],
    lin: Linearisation,
    step_state: StepState,
    is_in_chart: BoolScalar,
) -> RESULTS:
    finite = all_finite(step_state.state) & all_finite(step_state.lin)
    # If the first iterate is not finite, the system is not finite near the state.
    failed = RESULTS.where(
        solved.num_iterations > 1,
        RESULTS.nonlinear_divergence,
        RESULTS.nonfinite_state,
    )
    failed = RESULTS.where(solved.exhausted, RESULTS.nonlinear_max_iterations, failed)
    converged = RESULTS.where(finite, RESULTS.successful, RESULTS.nonfinite_state)
    result = RESULTS.where(solved.converged, converged, failed)
    result = RESULTS.where(is_in_chart, result, RESULTS.left_chart)
    # A singular M or C at the end of the step is reported now and not in the next step,
    # because λ_c does not exist there.
    singular = lin.is_singular | (solved.converged & step_state.lin.is_singular)
    return RESULTS.where(singular, RESULTS.singular_stage_matrix, result)


def largest_violation(
    system: AbstractMechanicalSystem, t: FloatScalar, step_state: StepState, args: Args
) -> FloatScalar:
    """Compute the largest violation of any constraint at a state."""
    on_positions = system.position_constraint(t, step_state.wrapped(system).q, args)
    return max_norm(step_state.lin.violation, on_positions)
