"""A step with its derivative, by the implicit function theorem at the solved stages."""

from collections.abc import Callable
from typing import TypeAlias

import equinox as eqx
import jax

from .._compile import as_cpu_kernel, TraceCache
from .._custom_types import BoolScalar
from .._manifold import unframed
from .._method import AbstractMethod
from .._numerics import (
    ClosureConverted,
    stop_gradient,
    has_tangent,
    solve_contraction,
    zero_unless,
)
from .._results import RESULTS
from .._system import linearise, State
from ._end import end_state, step_record
from ._jacobian import unknown_units
from ._newton import AbstractStageSolver
from ._positions import end_position
from ._record import StepRecord
from ._stage_equations import stage_forces
from ._step import equations_of_step, step, StepArguments, StepOutcome
from ._unknowns import StageUnknowns


@eqx.filter_custom_jvp
def differentiable_step(
    arguments: StepArguments,
    method: AbstractMethod,
    stage_solver: AbstractStageSolver,
    skip: BoolScalar,
    programs: TraceCache,
) -> StepOutcome:
    """Take one step as `step` does, with a derivative that skips the iterations.

    Let G(x; θ) be the Newton iteration of the stage solver on the stages x, with its
    Jacobian frozen, and θ the arguments of the step. The solution is a fixed point, so
    that

    dx = ∂G/∂x dx + ∂G/∂θ dθ,

    and the end of the step follows from x and θ. All derivatives are zero where the
    step failed.
    """
    del programs
    return step(arguments, method, stage_solver, skip)


@differentiable_step.def_jvp
def _differentiable_step_jvp(primals, tangents):
    arguments, method, stage_solver, skip, _ = primals
    # The program that the derivative was asked of is found again.
    outcome = primitive_step(*primals)
    x, ok = outcome.stages, ~skip & (outcome.result == RESULTS.successful)
    perturbed, fixed = eqx.partition(arguments, has_tangent(tangents[0]))
    change = change_of_step(arguments, method, stage_solver, ok, x, fixed)
    # By the checkpoint nothing but states and stages is kept for a reverse pass.
    change = jax.checkpoint(change, prevent_cse=False)
    return outcome, tangent_of_outcome(outcome, change(perturbed, x, tangents[0]))


Changes: TypeAlias = tuple[StageUnknowns, State, StepRecord]


def change_of_step(
    arguments: StepArguments,
    method: AbstractMethod,
    stage_solver: AbstractStageSolver,
    ok: BoolScalar,
    x: StageUnknowns,
    fixed: StepArguments,
) -> Callable[[StepArguments, StageUnknowns, StepArguments], Changes]:
    """Make the function (perturbed, x, rates) of the changes of a solved step.

    It computes how the stages x, the state at the end and the record of the step
    change if the `perturbed` part of its arguments changes at `rates`; the other part
    is `fixed`. The changes are zero unless the step is `ok`.
    """
    stages = equations_of_step(arguments, method)
    at, lin, solved = stop_gradient((stages, arguments.step_state.lin, x))
    frozen_newton_map = stage_solver.frozen_newton_map(at, lin, solved)

    def change(perturbed, x, rates):
        rates = zero_unless(ok, rates)

        def sweep(perturbed, x):
            arguments = eqx.combine(perturbed, fixed)
            return frozen_newton_map(equations_of_step(arguments, method), x)

        # The program of a sweep is made once, and differentiated twice.
        corrected = ClosureConverted(sweep, perturbed, x)
        end = ClosureConverted(
            lambda perturbed, x: _end(eqx.combine(perturbed, fixed), method, x),
            perturbed,
            x,
        )
        _, b = jax.jvp(lambda theta: corrected(theta, x), (perturbed,), (rates,))
        _, contraction = jax.linearize(lambda x: corrected(perturbed, x), x)
        # This iteration starts from zero, while that of the step starts from a good
        # guess, so that it is allowed twice as many iterations.
        limit = 2 * stage_solver.max_iterations
        units = unknown_units(at, lin)
        dx = solve_contraction(contraction, b, units, max_iterations=limit)
        _, dend = jax.jvp(end, (perturbed, x), (rates, zero_unless(ok, dx)))
        return zero_unless(ok, (dx, *dend))

    return change


def tangent_of_outcome(outcome: StepOutcome, changes: Changes) -> StepOutcome:
    """Make the tangent of an outcome from the changes of its stages and its end."""
    none = jax.tree.map(lambda _: None, outcome)
    return eqx.tree_at(
        lambda outcome: (outcome.stages, outcome.step_state.state, outcome.record),
        none,
        changes,
        is_leaf=lambda leaf: leaf is None,
    )


def primitive_step(
    arguments: StepArguments,
    method: AbstractMethod,
    stage_solver: AbstractStageSolver,
    skip: BoolScalar,
    programs: TraceCache,
) -> StepOutcome:
    """Take one step by `differentiable_step`, in a program that is traced once."""
    # When JAX splits a scan into a known and a linear part, it drops the derivative
    # rules of functions, but not those of primitives. Without its rule a step could be
    # differentiated in reverse mode only once, and not again.
    return as_cpu_kernel(
        differentiable_step,
        arguments,
        method,
        stage_solver,
        skip,
        programs,
        programs=programs,
    )


def _end(
    arguments: StepArguments, method: AbstractMethod, x: StageUnknowns
) -> tuple[State, StepRecord]:
    """Compute the state at the end of a step and its record, given the stages alone.

    This is the end of `step` without its compensated sums, whose compensation has no
    derivative, and with p from the fibre coordinate found at the end; the results agree
    to round-off.
    """
    system, args, start = arguments.system, arguments.args, arguments.step_state.state
    stages = equations_of_step(arguments, method)
    t, u = arguments.t + arguments.h, x.node_fibre_coordinate[-1]
    q = unframed(end_position(stages, x))
    p = system.momentum(t, q, u, args)

    def continuous():
        # With the symmetric closure this multiplier is one of the unknowns of the step,
        # but of redundant constraints it is not the one of the least norm there.
        if stages.end_multiplier_is_unknown and system.constraints != "redundant":
            return x.end_multiplier
        return linearise(system, t, q, u, args, may_be_sparse=True).multiplier

    end = end_state(stages, q, u, p, stages.multipliers(x)[-1], continuous)
    forces = stage_forces(stages, x)
    return end, step_record(stages, start, x, forces)
