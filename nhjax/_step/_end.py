"""The state at the end of a step, from its stages."""

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
    """What a step reports at its end, where its q, u and p have been found.

    **Arguments:**

    - `q`, `u`, `p`: the configuration, the fibre coordinate and the momentum, however
        they were summed.
    - `last_multiplier`: Λ^s, which the propagated closure carries to the next step.
    - `continuous`: gives λ_c(q, u), which is asked for where it is reported.
    """
    v = stages.system.velocity(stages.t + stages.h, q, u, stages.args)
    if stages.method.closure != "propagated":
        return State(q, v, p, continuous())
    # Only nonholonomic multipliers are carried; a step finds the others anew.
    m = stages.num_nonholonomic
    multiplier = last_multiplier[:m]
    if stages.num_holonomic:
        multiplier = jnp.concatenate([multiplier, continuous()[m:]])
    return State(q, v, p, multiplier)
