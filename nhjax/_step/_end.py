"""The state at the end of a step, made from its stages."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._system import State
from ._stage_system import StageSystem


def end_state(
    stages: StageSystem,
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
