from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from ._checks import all_finite
from ._compensated import two_sum
from ._custom_types import Args, BoolScalar, FloatScalar
from ._iteration import Solved
from ._linearisation import Linearisation, linearise
from ._method import AbstractMethod
from ._newton import AbstractStageSolver, Evaluation
from ._solution import RESULTS
from ._stages import Stages, StageSystem
from ._state import State
from ._step_record import StepRecord
from ._system import LagrangianSystem


class Node(eqx.Module):
    """What is carried from step to step: a state and what is known there.

    The compensations are the rounding errors of the running sums q and p; the
    linearisation is both the Jacobian of the next step and the source of λ_c.
    """

    state: State
    q_compensation: PyTree[Array]
    p_compensation: Float[Array, " n"]
    lin: Linearisation


class StepOutcome(NamedTuple):
    """A step: the next node, or the reason why there is none."""

    node: Node
    record: StepRecord
    result: RESULTS
    num_iterations: Int[Array, ""]
    residual: FloatScalar
    constraint_violation: FloatScalar
    multiplier_defect: FloatScalar


def first_node(
    system: LagrangianSystem,
    method: AbstractMethod,
    t: FloatScalar,
    y0: State,
    args: Args,
) -> Node:
    """The node to start from at a consistent state.

    Closures that do not carry the multiplier report λ_c from the first node on.
    """
    lin = linearise(system, t, y0.q, y0.v, args)
    carried = method.multiplier == "propagated"
    return Node(
        state=State(y0.q, y0.v, y0.p, y0.multiplier if carried else lin.multiplier),
        q_compensation=system.manifold_of(y0.q).no_compensation(y0.q),
        p_compensation=jnp.zeros_like(y0.p),
        lin=lin,
    )


def step(
    system: LagrangianSystem,
    method: AbstractMethod,
    solver: AbstractStageSolver,
    t: FloatScalar,
    h: FloatScalar,
    node: Node,
    args: Args,
    skip: BoolScalar,
) -> StepOutcome:
    """One step of size h: (q_k, p_k, λ_k) -> (q_{k+1}, p_{k+1}, λ_{k+1}).

    Where `skip` is true nothing is solved and the outcome is to be discarded.
    """
    state, lin = node.state, node.lin
    propagated = method.multiplier == "propagated"
    stages = StageSystem(
        system,
        method,
        t,
        h,
        state.q,
        state.p,
        state.multiplier if propagated else lin.multiplier,
        args,
    )
    x0 = stages.starting_values(state.v, lin)
    solved = solver.solve(stages, x0, lin, skip)
    x, forces = solved.x, solved.aux.forces

    manifold = system.manifold_of(state.q)
    q, q_compensation = manifold.advance(
        state.q, stages.increment(x), node.q_compensation
    )
    p_increment = h * (stages.coefficients("b") @ forces.force)
    p, p_compensation = two_sum(state.p, p_increment + node.p_compensation)
    v = x.node_velocity[-1]
    lin_next = linearise(system, t + h, q, v, args)
    multiplier = forces.multiplier[-1] if propagated else lin_next.multiplier
    next_node = Node(
        State(q, v, p, multiplier), q_compensation, p_compensation, lin_next
    )

    residual = jnp.maximum(
        jnp.max(jnp.abs(forces.residual)), jnp.max(jnp.abs(solved.aux.node_residual))
    )
    scale = forces.momentum_scale
    return StepOutcome(
        node=next_node,
        record=StepRecord(state, x.velocity, forces.force, forces.multiplier),
        result=_result(solved, lin, next_node),
        num_iterations=solved.num_iterations,
        residual=residual / jnp.where(scale > 0, scale, 1),
        constraint_violation=_largest(lin_next.violation),
        multiplier_defect=_largest(forces.multiplier[-1] - lin_next.multiplier),
    )


def _result(
    solved: Solved[Stages, Evaluation], lin: Linearisation, node: Node
) -> RESULTS:
    finite = all_finite(node.state) & all_finite(node.lin)
    # What is not finite at the first iterate is so near the state itself.
    failed = RESULTS.where(
        solved.num_iterations > 1,
        RESULTS.nonlinear_divergence,
        RESULTS.nonfinite_state,
    )
    converged = RESULTS.where(finite, RESULTS.successful, RESULTS.nonfinite_state)
    result = RESULTS.where(solved.converged, converged, failed)
    # A singular M or C at the end is found at once: λ_c does not exist there.
    singular = lin.is_singular | (solved.converged & node.lin.is_singular)
    return RESULTS.where(singular, RESULTS.singular_stage_matrix, result)


def _largest(x: Float[Array, " m"]) -> FloatScalar:
    return jnp.max(jnp.abs(x), initial=0.0)
