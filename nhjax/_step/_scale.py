"""The scale of a step, to which the round-off of its stages is proportional."""

import jax.numpy as jnp

from .._custom_types import FloatScalar
from .._numerics import absolute, matvec, max_norm
from .._system import Linearisation, position_scale
from ._stage_equations import impulse_weights
from ._stage_system import StageSystem
from ._unknowns import Stages


def fibre_coordinate_scale(
    stages: StageSystem, x0: Stages, lin: Linearisation
) -> FloatScalar:
    """Estimate the round-off of the fibre coordinates of a step, in units of round-off.

    The estimate adds to the size of the coordinates themselves, at the starting values
    x0, the size of the terms that cancel in them: the forces and reactions over the
    step, and the effect on velocities of the round-off of holonomic constraints, which
    are divided by h. For a system at rest these terms are all there is. With invariants
    the round-off of these is added, as far as impulses have it.
    """
    h = jnp.abs(stages.h)
    rate = max_norm(lin.acceleration)
    if stages.constrained:
        rate = rate + max_norm(matvec(absolute(lin.reaction), jnp.abs(lin.multiplier)))
    scale = h * rate + max_norm(
        x0.node_fibre_coordinate, x0.momentum if stages.hamiltonian else x0.velocity
    )
    if stages.num_holonomic:
        m = stages.num_nonholonomic
        sizes = position_scale(stages.system, stages.t, stages.q, stages.args, lin)
        sizes = jnp.concatenate([jnp.zeros((m,), sizes.dtype), sizes]) if m else sizes
        response = matvec(absolute(lin.compliance_inverse), sizes)
        scale = scale + max_norm(matvec(absolute(lin.reaction), response)) / h
    if stages.kept is not None:
        scale = scale + impulse_weights(stages, x0).noise
    return scale
