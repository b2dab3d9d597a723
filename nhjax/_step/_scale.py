"""The scale of a step, to which the round-off of its stages is proportional."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import FloatScalar
from .._manifold import unframed
from .._numerics import max_norm, uneven_perturbations
from .._system import Linearisation, position_scale
from ._stage_equations import impulse_weights
from ._stage_system import StageEquations
from ._unknowns import StageUnknowns


class Scale(NamedTuple):
    """The size of the fibre coordinates of a step, and what adds to their round-off.

    Both are in units of fibre coordinates: the round-off of these is about the unit
    round-off times the sum of the two.
    """

    size: FloatScalar
    round_off: FloatScalar


def fibre_coordinate_scale(
    stages: StageEquations, x0: StageUnknowns, lin: Linearisation
) -> Scale:
    """Estimate the size of the fibre coordinates of a step and their round-off.

    The size is that of the coordinates at the starting values x0, plus that of the
    terms that cancel in them, the forces and reactions over the step. For a system at
    rest these terms are all there is. Round-off of the positions adds to it, in so far
    as velocities feel it: through holonomic constraints, whose round-off is divided by
    h, and through nonholonomic ones, which matters where a coordinate has grown large,
    as the heading of a car after many turns. With invariants the round-off of these is
    added, as far as impulses have it. Last comes the measured round-off of the
    functions of the system.
    """
    h = jnp.abs(stages.h)
    rate = max_norm(lin.acceleration)
    if stages.constrained:
        rate = rate + max_norm(lin.reaction.absolute().matvec(jnp.abs(lin.multiplier)))
    size = h * rate + max_norm(
        x0.node_fibre_coordinate, x0.momentum if stages.hamiltonian else x0.velocity
    )
    round_off = jnp.zeros_like(size)
    m, k = stages.num_nonholonomic, stages.num_holonomic
    t, q, args = stages.t, unframed(stages.q), stages.args

    if k:
        sizes = position_scale(stages.system, t, q, args, lin)
        correction = lin.largest_correction(jnp.pad(sizes, (m, 0)))
        round_off = round_off + correction / h
    if m:
        sizes = jnp.pad(_kinematic_scale(stages, q, x0), (0, k))
        round_off = round_off + lin.largest_correction(sizes)
    if stages.invariants is not None:
        round_off = round_off + impulse_weights(stages, x0).noise
    if stages.round_off is not None:
        round_off = jnp.maximum(round_off, stages.round_off.size(h))
    return Scale(size, round_off)


def _kinematic_scale(
    stages: StageEquations, q: PyTree[Array], x0: StageUnknowns
) -> Float[Array, " m"]:
    """Estimate how far nonholonomic constraints move if positions move by their size.

    One direction of the moves is enough for an estimate: to take each number by itself
    would cost as many derivatives as there are coordinates.
    """
    system, t, args = stages.system, stages.t, stages.args
    u = x0.momentum[0] if stages.hamiltonian else x0.velocity[0]
    change = jax.jvp(
        lambda q: system.kinematic_constraint(t, q, u, args),
        (q,),
        (uneven_perturbations(q),),
    )[1]
    # Where a constraint has no finite slope this tells nothing of its round-off.
    return jnp.where(jnp.isfinite(change), jnp.abs(change), 0)
