"""A step with its derivative: the implicit function theorem at the converged stages."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from .._compile import as_cpu_kernel
from .._custom_types import Args, BoolScalar, FloatScalar
from .._method import AbstractMethod
from .._numerics import frozen, has_tangent, solve_contraction, zero_unless
from .._results import RESULTS
from .._system import AbstractMechanicalSystem, linearise, State
from ._newton import AbstractStageSolver
from ._record import StepRecord
from ._stages import Stages, StageSystem
from ._step import step, StepOutcome, StepState


class Parameters(eqx.Module):
    """What a step is differentiated with respect to."""

    system: AbstractMechanicalSystem
    t: FloatScalar
    h: FloatScalar
    state: State
    args: Args


@eqx.filter_custom_jvp
def differentiable_step(
    parameters: Parameters,
    method: AbstractMethod,
    solver: AbstractStageSolver,
    step_state: StepState,
    skip: BoolScalar,
) -> StepOutcome:
    """One step, as `step`, from the state in `parameters` and what else `node` holds.

    Derivatives do not pass through the iterations. With G(x; θ) the simplified Newton
    iteration on the stages x, its Jacobian frozen, the solution is a fixed point, so
    that

    dx = ∂G/∂x dx + ∂G/∂θ dθ,

    and the end of the step follows from x and θ. They are zero where the step failed.
    """
    step_state = eqx.tree_at(
        lambda step_state: step_state.state, step_state, parameters.state
    )
    return step(
        parameters.system,
        method,
        solver,
        parameters.t,
        parameters.h,
        step_state,
        parameters.args,
        skip,
    )


@differentiable_step.def_jvp
def _differentiable_step_jvp(primals, tangents):
    parameters, method, solver, step_state, skip = primals
    outcome = primitive_step(*primals)
    x, ok = outcome.stages, ~skip & (outcome.result == RESULTS.successful)
    perturbed, fixed = eqx.partition(parameters, has_tangent(tangents[0]))

    stages = _stage_system(parameters, method)
    correction = solver.frozen_newton_map(*frozen((stages, step_state.lin, x)))

    # Nothing but states and stages is kept for a reverse pass.
    @partial(jax.checkpoint, prevent_cse=False)
    def change(perturbed, x, rates):
        rates = zero_unless(ok, rates)

        def corrected(perturbed, x):
            parameters = eqx.combine(perturbed, fixed)
            return correction(_stage_system(parameters, method), x)

        def end(perturbed, x):
            return _end(eqx.combine(perturbed, fixed), method, x)

        _, b = jax.jvp(lambda theta: corrected(theta, x), (perturbed,), (rates,))
        _, contraction = jax.linearize(lambda x: corrected(perturbed, x), x)
        # From nothing, where the iteration of the step started from a good guess.
        limit = 2 * solver.max_iterations
        dx = solve_contraction(contraction, b, max_iterations=limit)
        _, dend = jax.jvp(end, (perturbed, x), (rates, zero_unless(ok, dx)))
        return zero_unless(ok, (dx, *dend))

    none = jax.tree.map(lambda _: None, outcome)
    return outcome, eqx.tree_at(
        lambda outcome: (outcome.stages, outcome.step_state.state, outcome.record),
        none,
        change(perturbed, x, tangents[0]),
        is_leaf=lambda leaf: leaf is None,
    )


# Where JAX splits a scan into what is known and what is linear, it drops the rules of
# functions, but not those of primitives. Without its rule a step could be
# differentiated in reverse mode once, and not again.
primitive_step = partial(as_cpu_kernel, differentiable_step)


def _stage_system(parameters: Parameters, method: AbstractMethod) -> StageSystem:
    y, args = parameters.state, parameters.args
    return StageSystem.at(
        parameters.system, method, parameters.t, parameters.h, y, args
    )


def _end(
    parameters: Parameters, method: AbstractMethod, x: Stages
) -> tuple[State, StepRecord]:
    """The state at the end of a step and its record, as functions of the stages.

    Without the sums of a step, whose compensation has no derivative, and with p from
    the velocity found at the end: both are the same to round-off.
    """
    system, args = parameters.system, parameters.args
    stages = _stage_system(parameters, method)
    t, u = parameters.t + parameters.h, x.node_fibre_coordinate[-1]
    q = system.manifold_of(parameters.state.q).act(
        parameters.state.q, stages.increment(x)
    )
    m, carried = stages.num_nonholonomic, method.closure == "propagated"
    if stages.symmetric:
        multiplier = x.end_multiplier
    elif carried and not stages.num_holonomic:
        multiplier = stages.multipliers(x)[-1]
    else:
        multiplier = linearise(system, t, q, u, args).multiplier
        if carried:
            nonholonomic = stages.multipliers(x)[-1, :m]
            multiplier = jnp.concatenate([nonholonomic, multiplier[m:]])
    v, p = system.velocity(t, q, u, args), system.momentum(t, q, u, args)
    forces = stages.evaluate(x)
    record = StepRecord(parameters.state, x.velocity, forces.force, forces.multiplier)
    return State(q, v, p, multiplier), record
