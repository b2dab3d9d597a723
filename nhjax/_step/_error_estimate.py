"""An estimate of the error of a step, from the values at its stages."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from .._numerics import matvec, max_norm, NOISE_UNITS, relative, small_einsum
from .._system import Linearisation
from ._stage_system import StageSystem
from ._unknowns import Stages


def error_estimate(
    stages: StageSystem,
    x: Stages,
    force: Float[Array, "s n"],
    u: Float[Array, " n"],
    lin: Linearisation,
) -> FloatScalar | None:
    """Estimate the error of a step, relative to the change of the state in it.

    The state changes by h Σ b_j (H^j, N⁻¹ n^j), with the velocities H^j and the forces
    n^j of the stages. A second quadrature, which leaves out the last node, differs from
    it by the same sum with the weights `method.embedded_difference`. With s different
    nodes this difference, relative to the change of the state, is O(h^{s-1}) in
    positions, divided by h, and O(h^s) in fibre coordinates. The relative error of the
    step is O(h^p), with the order p of the method. The estimate is the larger of the
    two ratios, each raised to the power that makes it O(h^p). It tends to one for steps
    in which nothing is resolved.

    **Arguments:**

    - `x`, `force`: the solved stages and their forces n^j.
    - `u`: the fibre coordinate at the end of the step.
    - `lin`: the linearisation at the start of the step.

    **Returns:** the estimate, or None for a method with one node, which has no second
    quadrature.
    """
    method, h = stages.method, stages.h
    difference = method.embedded_difference
    if difference is None:
        return None

    def change(weights: Float[Array, " s"]) -> tuple[Array, Array]:
        moved = small_einsum("s,sn->n", weights, x.velocity)
        if stages.hamiltonian:
            moved = matvec(lin.metric_inverse, moved)
        gained = h * small_einsum("s,sn->n", weights, force)
        return moved, matvec(lin.momentum_inverse, gained)

    # A change that is round-off tells nothing of the error.
    size = max_norm(u)
    if stages.round_off is not None:
        size = jnp.maximum(size, stages.round_off.size(jnp.abs(h)))
    floor = NOISE_UNITS * float(jnp.finfo(u.dtype).eps) * size
    whole = max_norm(*change(stages.coefficients("b"))) + floor
    moved, gained = change(jnp.asarray(difference, u.dtype))
    if stages.constrained:
        # What violates the constraints is no error of the step, which satisfies them:
        # multipliers of single stages may be wrong where their sum is right.
        excess = matvec(lin.compliance_inverse, matvec(lin.jacobian, gained))
        gained = gained - matvec(lin.reaction, excess)
    nodes = len(np.unique(method.c))
    return jnp.maximum(
        _power(relative(max_norm(moved), whole), method.order, nodes - 1),
        _power(relative(max_norm(gained), whole), method.order, nodes),
    )


def _power(x: FloatScalar, numerator: int, denominator: int) -> FloatScalar:
    """Raise x to a rational power, by multiplications if it is a whole number."""
    whole, rest = divmod(numerator, denominator)
    return x**whole if rest == 0 else x ** (numerator / denominator)
