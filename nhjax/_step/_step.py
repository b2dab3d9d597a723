"""One step of a method, its derivative, and the data that one step passes to the next.

`ImplicitStep` solves the stage equations and computes the state at the end, as a
differentiable function. `AbstractStageSolver` is the interface of the solvers of the
stage equations.
"""

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._compile import TraceCache
from .._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from .._errors import is_traced
from .._manifold import unframed
from .._method import AbstractMethod
from .._numerics import (
    AbstractImplicitFunction,
    ClosureConverted,
    fixed_point_tangent,
    has_tangent,
    largest_column,
    max_norm,
    NOISE_UNITS,
    relative,
    small_einsum,
    Solved,
    stop_gradient,
    two_sum,
    zero_unless,
)
from .._results import RESULTS
from .._system import (
    AbstractMechanicalSystem,
    all_finite,
    FunctionNoise,
    keeps_constraints,
    Linearisation,
    linearise,
    State,
)
from ._equations import (
    end_impulse,
    end_position,
    Evaluation,
    is_in_chart,
    stage_forces,
    StageEquations,
    StageForces,
    StageUnknowns,
    start_impulse,
    unknown_units,
)
from ._invariants import Invariants, InvariantsAtStart
from ._round_off import noise_of_step, PART


class StepState(eqx.Module):
    """The data that one step passes to the next: a state, and its linearisation.

    The compensations are the accumulated rounding errors of the sums q and p. The
    linearisation `lin` gives the Jacobian of the next step and the continuous
    multiplier λ_c. It is valid only for the system and the args with which it was
    computed; `first_step_state` computes a new one.
    """

    state: State
    q_compensation: PyTree[Array]
    p_compensation: Float[Array, " n"]
    lin: Linearisation

    def wrapped(self, system: AbstractMechanicalSystem) -> State:
        """Return the state with its angles reduced to one turn, at full precision."""
        q, manifold = self.state.q, system.manifold_of(self.state.q)
        return replace(self.state, q=manifold.wrapped(q, self.q_compensation))

    def differentiated_in_state(self) -> "StepState":
        """Return the same data, differentiable only with respect to the state.

        Derivatives with respect to the other data are zero. Rounding errors have no
        derivatives, and the end of a step does not depend on the approximate Jacobian
        that the linearisation gives.
        """
        return eqx.tree_at(lambda x: x.state, jax.lax.stop_gradient(self), self.state)


class StepArguments(eqx.Module):
    """The arguments of a step with respect to which it can be differentiated.

    In `step_state` only the state has derivatives; see
    `StepState.differentiated_in_state`. If `invariants` is None, the step keeps no
    invariants. `noise` is the round-off of the functions of the system; if it is None,
    round-off is estimated from the sizes of the unknowns.
    """

    system: AbstractMechanicalSystem
    t: FloatScalar
    h: FloatScalar
    step_state: StepState
    args: Args
    invariants: Invariants | None = None
    noise: FunctionNoise | None = None


class StepRecord(eqx.Module):
    """The data of one step from which dense output builds its polynomials.

    - `start`: the state at the start of the step.
    - `velocity`, `force`, `multiplier`: the values at the s stages.
    - `interval`: the start and the size of the step, in a run with variable steps.
    """

    start: State
    velocity: Float[Array, "s n"]
    force: Float[Array, "s n"]
    multiplier: Float[Array, "s m"]
    interval: tuple[FloatScalar, FloatScalar] | None = None


class StepOutcome(NamedTuple):
    """The outcome of a step: the next state, or the reason why it failed.

    - `step_state`: the data to pass to the next step.
    - `record`, `stages`: the stages of the step, for dense output and for derivatives.
    - `result`: whether the step was solved, and otherwise the reason why not.
    - `num_iterations`: the number of iterations of the stage solver.
    - `residual`: the largest residual of the momentum equations, relative to the
        momenta plus h times the forces.
    - `worst_coordinate`: the index of the coordinate whose momentum equations have this
        residual.
    - `constraint_violation`: the largest violation of a constraint at the end.
    - `multiplier_defect`: the distance |Λ^s - λ_c| between the multiplier of the last
        stage and the continuous multiplier at the end.
    - `newton`: whether Newton's method took over from simplified Newton.
    - `invariant_error`: the largest error of an invariant at the end, relative to the
        size of its terms; None if the run keeps no invariants.
    - `error_ratios`: two numbers from which `estimated_error` estimates the error of
        the step; None for a method with one node.
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


# An iteration on the stages of a step. The equations are an argument, so that the
# iteration can be differentiated with respect to their data.
FrozenNewtonMap: TypeAlias = Callable[[StageEquations, StageUnknowns], StageUnknowns]


class AbstractStageSolver(eqx.Module):
    """A solver of the stage equations, for the option `stage_solver` of a run."""

    max_iterations: eqx.AbstractVar[int]
    tolerance: eqx.AbstractVar[FloatScalarLike]

    def __check_init__(self):
        if not isinstance(self.max_iterations, int) or self.max_iterations < 1:
            raise ValueError(
                f"{type(self).__name__}: `max_iterations` must be an int >= 1, got "
                f"{self.max_iterations!r}."
            )
        check_tolerance(self.tolerance)

    @abstractmethod
    def solve(
        self, stages: StageEquations, x0: StageUnknowns, lin: Linearisation, skip: Array
    ) -> Solved[StageUnknowns, Evaluation]:
        """Solve the stage equations from `x0`; do nothing where `skip` is true."""

    @abstractmethod
    def frozen_newton_map(
        self, stages: StageEquations, lin: Linearisation, x: StageUnknowns
    ) -> FrozenNewtonMap:
        """Build an iteration whose fixed points solve the stage equations.

        Its Jacobian is frozen, that is, constant. The iteration contracts at the
        solution `x`. The derivatives of the solution follow from this iteration by the
        implicit function theorem.
        """


def check_tolerance(tolerance: Any) -> None:
    """Raise a `ValueError` unless the `tolerance` of a solver is finite and >= 0."""
    if is_traced(tolerance):
        return
    if not np.all(np.isfinite(tolerance) & (np.asarray(tolerance) >= 0)):
        raise ValueError(
            f"`tolerance` must be finite and >= 0, got {tolerance}; 0 iterates to "
            "round-off."
        )


def first_step_state(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalar,
    y0: State,
    args: Args,
) -> StepState:
    """Build the data that the first step starts from, given a consistent state.

    If the closure does not carry the multiplier from step to step, the multiplier of
    the first state is the continuous multiplier λ_c.
    """
    u = system.fibre_coordinate(y0)
    lin = linearise(system, t, y0.q, u, args, may_be_sparse=True)
    multiplier = y0.multiplier
    if not method.carries_multiplier:
        multiplier = _ContinuousMultiplier()((system, t, y0.q, u, args))
    return StepState(
        state=State(y0.q, y0.v, y0.p, multiplier),
        q_compensation=system.manifold_of(y0.q).no_compensation(y0.q),
        p_compensation=jnp.zeros_like(y0.p),
        lin=stop_gradient(lin),
    )


class _ContinuousMultiplier(AbstractImplicitFunction[Any, Float[Array, " l"]]):
    """The continuous multiplier λ_c as a function of (system, t, q, u, args).

    Its derivative is zero where the multiplier is not finite. With a derivative of NaN,
    a sum over an ensemble that leaves out failed members would have the derivative NaN,
    because NaN times zero is NaN.
    """

    programs: None = None

    def solve(self, arguments: Any) -> Float[Array, " l"]:
        """Compute the multiplier from the linearised system."""
        return linearise(*arguments, may_be_sparse=True).multiplier

    def tangent(
        self, arguments: Any, rates: Any, solution: Float[Array, " l"]
    ) -> Float[Array, " l"]:
        """Differentiate the linearised system."""
        ok = jnp.all(jnp.isfinite(solution))
        perturbed, fixed = eqx.partition(arguments, has_tangent(rates))
        _, change = jax.jvp(
            lambda perturbed: self.solve(eqx.combine(perturbed, fixed)),
            (perturbed,),
            (zero_unless(ok, rates),),
        )
        return zero_unless(ok, change)


def equations_of_step(
    arguments: StepArguments, method: AbstractMethod
) -> StageEquations:
    """Build the equations of a step, including the equations of kept invariants."""
    system, t, args = arguments.system, arguments.t, arguments.args
    step_state, invariants = arguments.step_state, None
    y, lin = step_state.wrapped(system), step_state.lin
    if arguments.invariants is not None:
        position = step_state.state.q, step_state.q_compensation
        invariants = InvariantsAtStart.at(
            arguments.invariants, system, t, y, position, args, lin
        )
    given = t, arguments.h, y, args, lin, invariants, arguments.noise
    return StageEquations.at(system, method, *given)


def starting_values(
    stages: StageEquations, u: Array, lin: Linearisation
) -> StageUnknowns:
    """Compute the stages to first order in h, from u̇ and λ_c at the start.

    The values do not depend on the previous step, so that a step is a function of its
    state only.
    """
    m, s = stages.num_nonholonomic, stages.method.stages
    invariants = stages.invariants
    push = stages.h * lin.acceleration
    stage_times = jnp.sum(stages.coefficients("a_hat"), axis=1)
    node_times = jnp.sum(stages.node_weights, axis=1)
    # The unknown ν of the symmetric closure tends to zero with h, and starts from zero.
    # All other unknowns of a closure are multipliers, and start from λ_c.
    free = (jnp.arange(s - 1) >= int(stages.end_multiplier_is_unknown)).astype(u.dtype)
    empty = jnp.zeros((0,), u.dtype)
    at_stages = u[None] + jnp.outer(stage_times, push)
    velocity, momentum = at_stages, jnp.zeros((s, 0), u.dtype)
    if stages.hamiltonian:
        velocity = _starting_velocities(stages, u, lin, stage_times)
        momentum = at_stages
    return StageUnknowns(
        velocity=velocity,
        momentum=momentum,
        node_fibre_coordinate=u[None] + jnp.outer(node_times, push),
        closure=jnp.outer(free, lin.multiplier[:m]),
        holonomic=jnp.outer(jnp.ones((s,), u.dtype), lin.multiplier[m:]),
        end_acceleration=lin.acceleration
        if stages.end_multiplier_is_unknown
        else empty,
        end_multiplier=lin.multiplier if stages.end_multiplier_is_unknown else empty,
        impulse=None if invariants is None else jnp.zeros_like(invariants.sizes),
    )


def _starting_velocities(stages: StageEquations, u, lin: Linearisation, times) -> Array:
    v = stages.system.velocity(stages.t, stages.q, u, stages.args)
    _, rate = jax.jvp(
        lambda t, xi, u: stages.system.velocity(
            t, stages.manifold.act(stages.q, xi), u, stages.args
        ),
        (stages.t, jnp.zeros_like(u), u),
        (jnp.ones_like(stages.t), v, lin.acceleration),
    )
    return v[None] + jnp.outer(times, stages.h * rate)


def end_state(
    stages: StageEquations,
    q: PyTree[Array],
    u: Float[Array, " n"],
    p: Float[Array, " n"],
    last_multiplier: Float[Array, " l"],
    continuous: Callable[[], Float[Array, " l"]],
) -> State:
    """Build the state at the end of a step from its q, u, p and multipliers.

    **Arguments:**

    - `q`, `u`, `p`: the configuration, the fibre coordinate and the momentum.
    - `last_multiplier`: Λ^s of the last stage, which the propagated closure carries to
        the next step.
    - `continuous`: a function without arguments that returns λ_c(q, u). It is called
        only if a part of λ_c is needed.
    """
    v = stages.system.velocity(stages.t + stages.h, q, u, stages.args)
    if not stages.method.carries_multiplier:
        return State(q, v, p, continuous())
    # Only nonholonomic multipliers are carried to the next step. The next step computes
    # the holonomic multipliers again.
    m = stages.num_nonholonomic
    multiplier = last_multiplier[:m]
    if stages.num_holonomic:
        multiplier = jnp.concatenate([multiplier, continuous()[m:]])
    return State(q, v, p, multiplier)


def step_record(
    stages: StageEquations, start: State, x: StageUnknowns, forces: StageForces
) -> StepRecord:
    """Build the record of a step.

    Impulses that keep invariants are recorded as a constant force over the step. With
    this force, the polynomial of the momentum in dense output ends at the momentum of
    the next state.
    """
    force = forces.force
    if stages.invariants is not None:
        chart = stages.chart(x)
        y = chart.ends[1][None]
        impulse = chart.momentum_at_origin(start_impulse(stages, x))
        impulse = impulse + chart.to_origin(y, end_impulse(stages, x)[None])[0]
        force = force + (impulse / stages.h)[None]
    return StepRecord(start, x.velocity, force, forces.multiplier)


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
    # If M or C is singular at the end of the step, λ_c does not exist there. Therefore
    # this step, and not the next one, reports the singular matrix.
    singular = lin.is_singular | (solved.converged & step_state.lin.is_singular)
    return RESULTS.where(singular, RESULTS.singular_stage_matrix, result)


def largest_violation(
    system: AbstractMechanicalSystem, t: FloatScalar, step_state: StepState, args: Args
) -> FloatScalar:
    """Compute the largest violation of any constraint at a state."""
    on_positions = system.position_constraint(t, step_state.wrapped(system).q, args)
    return max_norm(step_state.lin.violation, on_positions)


def _invariant_error(
    stages: StageEquations, q: PyTree[Array], u: Float[Array, " n"]
) -> FloatScalar | None:
    """Compute the largest error of an invariant relative to the size of its terms."""
    if stages.invariants is None:
        return None
    functions, t = stages.invariants.functions, stages.t + stages.h
    error = functions.error(stages.system, t, q, u, stages.args)
    return max_norm(relative(error, stages.invariants.sizes))


def error_ratios(
    stages: StageEquations,
    x: StageUnknowns,
    force: Float[Array, "s n"],
    u: Float[Array, " n"],
    lin: Linearisation,
) -> Float[Array, "2"] | None:
    """Compare two quadratures of a step, in positions and in fibre coordinates.

    The state changes by h Σ b_j (H^j, N⁻¹ n^j), with the velocities H^j and the forces
    n^j of the stages, and with N = ∂p/∂u. A second quadrature leaves out the last node.
    The difference of the two quadratures is the same sum with the weights
    `method.embedded_difference`. Changes in positions are divided by h and, if u is p,
    mapped to momenta. The two ratios are the differences in positions and in fibre
    coordinates, divided by the largest change of the state. See `estimated_error`.

    **Arguments:**

    - `x`, `force`: the solved stages and their forces n^j.
    - `u`: the fibre coordinate at the end of the step.
    - `lin`: the linearisation at the start of the step.

    **Returns:** the two ratios, or None for a method with one node, which has no second
    quadrature.
    """
    method, h = stages.method, stages.h
    difference = method.embedded_difference
    if difference is None:
        return None

    def change(weights: Float[Array, " s"]) -> tuple[Array, Array]:
        moved = small_einsum("s,sn->n", weights, x.velocity)
        if stages.hamiltonian:
            moved = lin.fibre_hessian_inverse.matvec(moved)
        gained = h * small_einsum("s,sn->n", weights, force)
        return moved, lin.momentum_inverse.matvec(gained)

    # The divisor is increased by `NOISE_UNITS` times the round-off of u, because
    # smaller differences contain no information about the error.
    round_off = float(jnp.finfo(u.dtype).eps) * max_norm(u)
    if stages.noise is not None:
        noise = noise_of_step(stages.method, lin, stages.noise, h)
        round_off = jnp.maximum(round_off, PART * noise)
    floor = NOISE_UNITS * round_off
    whole = max_norm(*change(stages.coefficients("b"))) + floor
    moved, gained = change(jnp.asarray(difference, u.dtype))
    if stages.constrained:
        # Multipliers of single stages may be wrong although their sum is right.
        # Therefore the part of the difference that violates the constraints is left
        # out: the error of a step, which satisfies the constraints, has no such part.
        excess = lin.delassus_inverse.matvec(lin.jacobian.matvec(gained))
        gained = gained - lin.reaction.matvec(excess)
    return relative(jnp.stack([max_norm(moved), max_norm(gained)]), whole)


def estimated_error(ratios: Float[Array, "2"], method: AbstractMethod) -> FloatScalar:
    """Estimate the error of a step, relative to the change of the state in it.

    With s different nodes the `error_ratios` are O(h^{s-1}) in positions and O(h^s) in
    fibre coordinates. The relative error of a step is O(h^p), with the order p of the
    method. Each ratio is raised to the power that makes it O(h^p), and the estimate is
    the larger of the two results. If a step does not resolve the motion, the estimate
    is about one. The estimate increases with the ratios, so that the largest estimate
    of many steps follows from the largest ratios.
    """
    nodes = len(np.unique(method.c))
    in_position, in_fibre = ratios
    return jnp.maximum(
        in_position ** (method.order / (nodes - 1)),
        in_fibre ** (method.order / nodes),
    )


Changes: TypeAlias = tuple[StageUnknowns, State, StepRecord]


class FrozenIteration(NamedTuple):
    """A Newton iteration on the stages with a frozen Jacobian.

    - `newton_map`: the iteration.
    - `units`: the units of the unknowns; see `unknown_units`.
    """

    newton_map: FrozenNewtonMap
    units: list[FloatScalar]


class ImplicitStep(AbstractImplicitFunction[StepArguments, StepOutcome]):
    """A step of size h, from (q_k, p_k, λ_k) to (q_{k+1}, p_{k+1}, λ_{k+1}).

    The step is a differentiable function of its arguments. Let G(θ, x) be the Newton
    iteration of the stage solver on the stages x, with its Jacobian fixed, and let θ be
    the arguments of the step. The solution is a fixed point of G, so that

    dx = ∂G/∂x dx + ∂G/∂θ dθ,

    and the end of the step follows from x and θ. All derivatives are zero where the
    step failed.

    - `method`: the method.
    - `stage_solver`: the solver of the stage equations.
    - `skip`: if it is true, no iterations are made, and the caller must discard the
        outcome.
    """

    method: AbstractMethod = eqx.field(static=True)
    stage_solver: AbstractStageSolver
    skip: BoolScalar
    programs: TraceCache | None = eqx.field(static=True, default=None)

    def solve(self, arguments: StepArguments) -> StepOutcome:
        """Take the step."""
        system, t, h = arguments.system, arguments.t, arguments.h
        args, step_state = arguments.args, arguments.step_state
        keeps_invariants = arguments.invariants is not None
        state, lin = step_state.state, step_state.lin
        stages = equations_of_step(arguments, self.method)
        x0 = starting_values(stages, system.fibre_coordinate(state), lin)
        solved = self.stage_solver.solve(stages, x0, lin, self.skip)
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
        unwrapped = replace(end, q=q)
        next_state = StepState(unwrapped, q_compensation, p_compensation, lin_next)

        result = _result(solved, lin, next_state, is_in_chart(stages, x))
        if stages.redundancy is not None:
            small = float(jnp.finfo(p.dtype).eps) ** 0.5
            small = small + 100 * self.stage_solver.tolerance
            allowed = None if stages.noise is None else stages.noise.violations
            holds = keeps_constraints(
                system, lin_next, t + h, end, args, small, allowed
            )
            lost = (result == RESULTS.successful) & ~holds
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

    def tangent(
        self, arguments: StepArguments, rates: StepArguments, solution: StepOutcome
    ) -> StepOutcome:
        """Compute the tangents of the stages, the state at the end and the record."""
        ok = ~self.skip & (solution.result == RESULTS.successful)
        perturbed, fixed = eqx.partition(arguments, has_tangent(rates))

        def changes(perturbed, x, rates):
            iteration = self.frozen_iteration(arguments, x)
            return self.changes(iteration, perturbed, fixed, x, rates, ok)

        # With `jax.checkpoint`, reverse mode stores only states and stages. The factors
        # of the Jacobian are computed again in the backward pass.
        changes = jax.checkpoint(changes, prevent_cse=False)
        return tangent_of_outcome(solution, changes(perturbed, solution.stages, rates))

    def frozen_iteration(
        self, arguments: StepArguments, x: StageUnknowns
    ) -> FrozenIteration:
        """Build the Newton iteration with its Jacobian frozen at solved stages x."""
        stages = equations_of_step(arguments, self.method)
        at, lin, solved = stop_gradient((stages, arguments.step_state.lin, x))
        newton_map = self.stage_solver.frozen_newton_map(at, lin, solved)
        return FrozenIteration(newton_map, unknown_units(at, lin))

    def changes(
        self,
        frozen: FrozenIteration,
        perturbed: StepArguments,
        fixed: StepArguments,
        x: StageUnknowns,
        rates: StepArguments,
        ok: BoolScalar,
    ) -> Changes:
        """Compute the changes of the stages x, the state at the end and the record.

        `rates` are the tangents of the `perturbed` part of the arguments. The rest is
        `fixed`. The changes are zero unless the step is `ok`, that is, solved.
        """

        def iteration(perturbed, x):
            arguments = eqx.combine(perturbed, fixed)
            return frozen.newton_map(equations_of_step(arguments, self.method), x)

        def end(perturbed, x):
            return _end(eqx.combine(perturbed, fixed), self.method, x)

        rates = zero_unless(ok, rates)
        # The solver started from a good guess. The iteration for dx has no such guess,
        # and is therefore allowed twice as many iterations.
        limit = 2 * self.stage_solver.max_iterations
        dx = fixed_point_tangent(
            iteration, perturbed, rates, x, frozen.units, max_iterations=limit
        )
        _, dend = jax.jvp(
            ClosureConverted(end, perturbed, x),
            (perturbed, x),
            (rates, zero_unless(ok, dx)),
        )
        return zero_unless(ok, (dx, *dend))


def tangent_of_outcome(outcome: StepOutcome, changes: Changes) -> StepOutcome:
    """Build the tangent of an outcome: the given changes, and None for other fields."""
    none = jax.tree.map(lambda _: None, outcome)
    return eqx.tree_at(
        lambda outcome: (outcome.stages, outcome.step_state.state, outcome.record),
        none,
        changes,
        is_leaf=lambda leaf: leaf is None,
    )


def _end(
    arguments: StepArguments, method: AbstractMethod, x: StageUnknowns
) -> tuple[State, StepRecord]:
    """Compute the state at the end of a step and its record, given only the stages.

    `ImplicitStep.solve` computes the same end up to round-off. Here p follows from the
    fibre coordinate at the end, and there are no compensated sums, because the
    compensation has no derivative.
    """
    system, args, start = arguments.system, arguments.args, arguments.step_state.state
    stages = equations_of_step(arguments, method)
    t, u = arguments.t + arguments.h, x.node_fibre_coordinate[-1]
    q = unframed(end_position(stages, x))
    p = system.momentum(t, q, u, args)

    def continuous():
        # With the symmetric closure, λ_c is an unknown of the step. With redundant
        # constraints it is not used, because it is not the multiplier of least norm.
        if stages.end_multiplier_is_unknown and system.constraints != "redundant":
            return x.end_multiplier
        return linearise(system, t, q, u, args, may_be_sparse=True).multiplier

    end = end_state(stages, q, u, p, stages.multipliers(x)[-1], continuous)
    forces = stage_forces(stages, x)
    return end, step_record(stages, start, x, forces)
