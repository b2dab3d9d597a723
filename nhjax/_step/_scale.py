"""The scale of a step, to which the round-off of its stages is proportional."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from .._numerics import absolute, matvec, max_norm, uneven_moves
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
    step, and the effect on velocities of the round-off of positions: through holonomic
    constraints, which are divided by h, and through nonholonomic ones, which matters
    where a coordinate has grown large, as the heading of a car after many turns. For a
    system at rest these terms are all there is. With invariants the round-off of these
    is added, as far as impulses have it.
    """
    h = jnp.abs(stages.h)
    rate = max_norm(lin.acceleration)
    if stages.constrained:
        rate = rate + max_norm(matvec(absolute(lin.reaction), jnp.abs(lin.multiplier)))
    scale = h * rate + max_norm(
        x0.node_fibre_coordinate, x0.momentum if stages.hamiltonian else x0.velocity
    )
    m, k = stages.num_nonholonomic, stages.num_holonomic

    def response(sizes):
        multipliers = matvec(absolute(lin.compliance_inverse), sizes)
        return max_norm(matvec(absolute(lin.reaction), multipliers))

    if k:
        sizes = position_scale(stages.system, stages.t, stages.q, stages.args, lin)
        scale = scale + response(jnp.pad(sizes, (m, 0))) / h
    if m:
        scale = scale + response(jnp.pad(_kinematic_scale(stages, x0), (0, k)))
    if stages.kept is not None:
        scale = scale + impulse_weights(stages, x0).noise
    return scale


def _kinematic_scale(stages: StageSystem, x0: Stages) -> Float[Array, " m"]:
    # How far nonholonomic constraints move if each number of the position moves by
    # about its size.
    system, t, args = stages.system, stages.t, stages.args
    u = x0.momentum[0] if stages.hamiltonian else x0.velocity[0]
    change = jax.jvp(
        lambda q: system.kinematic_constraint(t, q, u, args),
        (stages.q,),
        (uneven_moves(stages.q),),
    )[1]
    # Where a constraint has no finite slope this tells nothing of its round-off.
    return jnp.where(jnp.isfinite(change), jnp.abs(change), 0)
