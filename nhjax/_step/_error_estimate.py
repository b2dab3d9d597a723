"""An estimate of the error of a step, from the values at its stages."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from .._method import AbstractMethod
from .._numerics import max_norm, NOISE_UNITS, relative, small_einsum
from .._system import Linearisation
from ._stage_system import StageEquations
from ._unknowns import StageUnknowns


def error_ratios(
    stages: StageEquations,
    x: StageUnknowns,
    force: Float[Array, "s n"],
    u: Float[Array, " n"],
    lin: Linearisation,
) -> Float[Array, "2"] | None:
    """Compare two quadratures of a step, in positions and in fibre coordinates.

    The state changes by h Σ b_j (H^j, N⁻¹ n^j), with the velocities H^j and the forces
    n^j of the stages. A second quadrature, which leaves out the last node, differs from
    it by the same sum with the weights `method.embedded_difference`. The ratios are
    those of this difference to the change of the state, in positions, divided by h, and
    in fibre coordinates; see `estimated_error`.

    **Arguments:**

    - `x`, `force`: the solved stages and their forces n^j.
    - `u`: the fibre coordinate at the end of the step.
    - `lin`: the linearisation at the start of the step.

    **Returns:** the two ratios, or None for a method with one node, which has no second
    quadrature.
    """
    method, h = stages.method, stages.h
    difference = method.embedded_difference
    if difference is None:
        return None

    def change(weights: Float[Array, " s"]) -> tuple[Array, Array]:
        moved = small_einsum("s,sn->n", weights, x.velocity)
        if stages.hamiltonian:
            moved = lin.metric_inverse.matvec(moved)
        gained = h * small_einsum("s,sn->n", weights, force)
        return moved, lin.momentum_inverse.matvec(gained)

    # A change that is round-off tells nothing of the error.
    size = max_norm(u)
    if stages.round_off is not None:
        size = jnp.maximum(size, stages.round_off.size(jnp.abs(h)))
    floor = NOISE_UNITS * float(jnp.finfo(u.dtype).eps) * size
    whole = max_norm(*change(stages.coefficients("b"))) + floor
    moved, gained = change(jnp.asarray(difference, u.dtype))
    if stages.constrained:
        # The part that violates the constraints is left out, since the step satisfies
        # them: multipliers of single stages may be wrong where their sum is right.
        excess = lin.compliance_inverse.matvec(lin.jacobian.matvec(gained))
        gained = gained - lin.reaction.matvec(excess)
    return relative(jnp.stack([max_norm(moved), max_norm(gained)]), whole)


def estimated_error(ratios: Float[Array, "2"], method: AbstractMethod) -> FloatScalar:
    """Estimate the error of a step, relative to the change of the state in it.

    With s different nodes the `error_ratios` are O(h^{s-1}) in positions and O(h^s) in
    fibre coordinates. The relative error of a step is O(h^p), with the order p of the
    method. The estimate is the larger of the two ratios, each raised to the power that
    makes it O(h^p). It tends to one for steps in which nothing is resolved. It grows
    with the ratios, so that the largest of many steps follows from the largest ratios.
    """
    nodes = len(np.unique(method.c))
    in_position, in_fibre = ratios
    return jnp.maximum(
        in_position ** (method.order / (nodes - 1)),
        in_fibre ** (method.order / nodes),
    )
