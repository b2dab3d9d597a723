"""A step with its derivative: the implicit function theorem at the converged stages."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from ._custom_types import Args, BoolScalar, FloatScalar
from ._implicit import frozen, is_given, masked, solve_contraction
from ._kernel import in_one_kernel
from ._linearisation import linearise
from ._method import AbstractMethod
from ._newton import AbstractStageSolver
from ._solution import RESULTS
from ._stages import Stages, StageSystem
from ._state import State
from ._step import Node, step, StepOutcome
from ._step_record import StepRecord
from ._system import AbstractMechanicalSystem


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
    node: Node,
    skip: BoolScalar,
) -> StepOutcome:
    """One step, as `step`, from the state in `parameters` and what else `node` holds.

    Derivatives do not pass through the iterations. With G(x; θ) the simplified Newton
    iteration on the stages x, its Jacobian frozen, the solution is a fixed point, so
    that

    dx = ∂G/∂x dx + ∂G/∂θ dθ,

    and the end of the step follows from x and θ. They are zero where the step failed.
    """
    node = eqx.tree_at(lambda node: node.state, node, parameters.state)
    return step(
        parameters.system,
        method,
        solver,
        parameters.t,
        parameters.h,
        node,
        parameters.args,
        skip,
    )


@differentiable_step.def_jvp
def _differentiable_step_jvp(primals, tangents):
    parameters, method, solver, node, skip = primals
    outcome = primitive_step(*primals)
    x, ok = outcome.stages, ~skip & (outcome.result == RESULTS.successful)
    perturbed, fixed = eqx.partition(parameters, is_given(tangents[0]))

    stages = _stage_system(parameters, method)
    correction = solver.correction(*frozen((stages, node.lin, x)))

    # Nothing but states and stages is kept for a reverse pass.
    @partial(jax.checkpoint, prevent_cse=False)
    def change(perturbed, x, rates):
        rates = masked(ok, rates)

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
        _, dend = jax.jvp(end, (perturbed, x), (rates, masked(ok, dx)))
        return masked(ok, (dx, *dend))

    none = jax.tree.map(lambda _: None, outcome)
    return outcome, eqx.tree_at(
        lambda outcome: (outcome.stages, outcome.node.state, outcome.record),
        none,
        change(perturbed, x, tangents[0]),
        is_leaf=lambda leaf: leaf is None,
    )


# Where JAX splits a scan into what is known and what is linear, it drops the rules of
# functions, but not those of primitives. Without its rule a step could be
# differentiated in reverse mode once, and not again.
primitive_step = partial(in_one_kernel, differentiable_step)


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
    t, u = parameters.t + parameters.h, x.node_fibre[-1]
    q = system.manifold_of(parameters.state.q).act(
        parameters.state.q, stages.increment(x)
    )
    m, carried = stages.num_nonholonomic, method.multiplier == "propagated"
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
