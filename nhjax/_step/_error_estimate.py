"""An estimate of the error of a step, from the values at its stages."""

import jax.numpy as jnp
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

    The change of the state is h Σ b_j (H^j, N⁻¹ n^j), with the velocities H^j and the
    forces n^j of the stages. A second quadrature, which leaves out the last node,
    differs from it by the same sum with the weights `method.embedded_difference`. The
    ratio r of the two is O(h^{s-1}), while the relative error is O(h^p) with the order
    p of the method: the estimate is r^{p/(s-1)}, with the number of different nodes for
    s. Positions, divided by h, and fibre coordinates count alike.

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

    def change(weights: Float[Array, " s"]) -> FloatScalar:
        gained = h * small_einsum("s,sn->n", weights, force)
        moved = small_einsum("s,sn->n", weights, x.velocity)
        if stages.hamiltonian:
            moved = matvec(lin.metric_inverse, moved)
        return max_norm(matvec(lin.momentum_inverse, gained), moved)

    # A change that is round-off tells nothing of the error.
    size = max_norm(u)
    if stages.round_off is not None:
        size = jnp.maximum(size, stages.round_off.size(jnp.abs(h)))
    floor = NOISE_UNITS * float(jnp.finfo(u.dtype).eps) * size
    difference = jnp.asarray(difference, u.dtype)
    ratio = relative(change(difference), change(stages.coefficients("b")) + floor)
    return ratio**method.error_exponent
