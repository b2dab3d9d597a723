"""The size that the stages of a step are rounded by."""

import jax.numpy as jnp

from .._custom_types import FloatScalar
from .._numerics import max_norm, small_einsum
from .._system import Linearisation, position_scale
from ._stage_system import StageSystem
from ._unknowns import Stages


def fibre_coordinate_scale(
    stages: StageSystem, x0: Stages, lin: Linearisation
) -> FloatScalar:
    """What the fibre coordinates of a step are rounded by, over the unit round-off.

    Beside their own size, at the starting values x0, that of the terms that cancel in
    them: forces and reactions over the step, and what the round-off of a holonomic
    constraint, divided by h, makes of velocities. A system at rest has nothing else.
    """
    h = jnp.abs(stages.h)
    rate = max_norm(lin.acceleration)
    if stages.constrained:
        rate = rate + max_norm(
            small_einsum("nl,l->n", jnp.abs(lin.reaction), jnp.abs(lin.multiplier))
        )
    scale = h * rate + max_norm(
        x0.node_fibre_coordinate, x0.momentum if stages.hamiltonian else x0.velocity
    )
    if stages.num_holonomic:
        m = stages.num_nonholonomic
        sizes = position_scale(stages.system, stages.t, stages.q, stages.args)
        response = small_einsum(
            "nl,lk->nk",
            jnp.abs(lin.reaction),
            jnp.abs(lin.compliance_inverse[:, m:]),
        )
        scale = scale + max_norm(small_einsum("nk,k->n", response, sizes)) / h
    return scale
