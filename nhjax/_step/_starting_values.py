"""The starting values of the iteration on the stages of a step."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .._system import Linearisation
from ._stage_system import StageEquations
from ._unknowns import StageUnknowns


def starting_values(stages: StageEquations, u: Array, lin: Linearisation) -> StageUnknowns:
    """Compute the stages to first order in h, from acceleration and λ_c at the start.

    The values do not depend on the step before, so that a step is a function of its
    state alone.
    """
    m, s = stages.num_nonholonomic, stages.method.stages
    push = stages.h * lin.acceleration
    stage_times = jnp.sum(stages.coefficients("a_hat"), axis=1)
    node_times = jnp.sum(stages.node_weights, axis=1)
    # The unknown ν of the symmetric closure vanishes with h, and starts from zero; all
    # other unknowns of a closure are multipliers.
    free = (jnp.arange(s - 1) >= int(stages.end_multiplier_is_unknown)).astype(u.dtype)
    nothing = jnp.zeros((0,), u.dtype)
    in_stages = u[None] + jnp.outer(stage_times, push)
    velocity, momentum, kept = in_stages, jnp.zeros((s, 0), u.dtype), stages.invariants
    if stages.hamiltonian:
        velocity, momentum = (
            _starting_velocities(stages, u, lin, stage_times),
            in_stages,
        )
    return StageUnknowns(
        velocity=velocity,
        momentum=momentum,
        node_fibre_coordinate=u[None] + jnp.outer(node_times, push),
        closure=jnp.outer(free, lin.multiplier[:m]),
        holonomic=jnp.outer(jnp.ones((s,), u.dtype), lin.multiplier[m:]),
        end_acceleration=lin.acceleration if stages.end_multiplier_is_unknown else nothing,
        end_multiplier=lin.multiplier if stages.end_multiplier_is_unknown else nothing,
        impulse=None if kept is None else jnp.zeros_like(kept.sizes),
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
