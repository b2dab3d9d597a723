"""The state at the end of a step and its record, made from its stages."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._system import State
from ._record import StepRecord
from ._stage_equations import end_impulse, start_impulse
from ._stage_system import StageEquations
from ._unknowns import StageForces, StageUnknowns


def end_state(
    stages: StageEquations,
    q: PyTree[Array],
    u: Float[Array, " n"],
    p: Float[Array, " n"],
    last_multiplier: Float[Array, " l"],
    continuous: Callable[[], Float[Array, " l"]],
) -> State:
    """Make the state at the end of a step from its q, u, p and multipliers.

    **Arguments:**

    - `q`, `u`, `p`: the configuration, the fibre coordinate and the momentum, however
        they were summed.
    - `last_multiplier`: Λ^s, which the propagated closure carries to the next step.
    - `continuous`: a function without arguments that returns λ_c(q, u). It is called
        only if the closure reports the continuous multiplier.
    """
    v = stages.system.velocity(stages.t + stages.h, q, u, stages.args)
    if stages.method.closure != "propagated":
        return State(q, v, p, continuous())
    # Only nonholonomic multipliers are carried to the next step, which finds the
    # holonomic ones anew.
    m = stages.num_nonholonomic
    multiplier = last_multiplier[:m]
    if stages.num_holonomic:
        multiplier = jnp.concatenate([multiplier, continuous()[m:]])
    return State(q, v, p, multiplier)


def step_record(
    stages: StageEquations, start: State, x: StageUnknowns, forces: StageForces
) -> StepRecord:
    """Make the record of a step.

    Impulses are recorded as a constant force over the step, so that the polynomials of
    dense output lead from the momentum at its start to that at its end.
    """
    force = forces.force
    if stages.invariants is not None:
        chart = stages.chart(x)
        y = chart.ends[1][None]
        impulse = chart.momentum_at_origin(start_impulse(stages, x))
        impulse = impulse + chart.to_origin(y, end_impulse(stages, x)[None])[0]
        force = force + (impulse / stages.h)[None]
    return StepRecord(start, x.velocity, force, forces.multiplier)
