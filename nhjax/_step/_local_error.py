"""An estimate of the error of one step, from the forces at its stages.

The estimate needs no further evaluations. The stages sample the rate of u, the fibre
coordinate, at s points of the step. Their Legendre coefficients give the sizes
U_k = |h^k u^(k)| of its derivatives for k = 1, ..., s. The error of a method of order p
is a multiple of U_{p+1}, a derivative of higher order than the samples show. From order
to order derivatives grow by a factor r, which the samples do show, so that

    U_{p+1} ≈ U_s r^(p+1-s).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalar
from .._method import AbstractMethod
from .._system import AbstractMechanicalSystem
from ._step import StepOutcome, StepState


# The error of a step is this power of a factor times the error of the quadrature b.
# Both factors are medians over the gallery, measured by `benchmarks.adaptive_steps`. On
# groups the chart contributes to the error.
_GROWTH, _GROWTH_ON_GROUPS = 4.0, 20.0


def local_error(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalar,
    h: FloatScalar,
    start: StepState,
    outcome: StepOutcome,
    scales: tuple[Float[Array, " n"], Float[Array, " n"]],
    args: Args,
) -> FloatScalar:
    """Estimate the error of a step relative to `scales`, as a root mean square.

    **Arguments:**

    - `t`, `h`: the start and the size of the step.
    - `start`, `outcome`: the state before the step, and its outcome.
    - `scales`: the sizes that count as an error of one, for the n coordinates of a
        displacement in q and for the n fibre coordinates.

    **Returns:** the root mean square over all 2n components.
    """
    lin, in_position, in_fibre = start.lin, *scales
    changes = jnp.asarray(derivative_weights(method), h.dtype) @ (
        h * jax.vmap(lin.momentum_inverse.matvec)(outcome.record.force)
    )
    if start.state.multiplier.shape[0]:
        # Multipliers of single stages may be wrong although their sum is right. The
        # reactions in the differences are therefore left out.
        excess = jax.vmap(lin.jacobian.matvec)(changes)
        excess = jax.vmap(lin.delassus_inverse.matvec)(excess)
        reactions = jax.vmap(lin.reaction.matvec)(excess)
        first = jnp.arange(changes.shape[0])[:, None] == 0
        changes = changes - jnp.where(first, 0, reactions)
    u = system.fibre_coordinate(start.state)
    displacements = changes
    if system.fibre_coordinate_name == "p":
        _, displacements = jax.vmap(
            lambda change: jax.jvp(
                lambda u: system.velocity(t, start.state.q, u, args), (u,), (change,)
            )
        )(changes)
    factor = error_factor(method, system.manifold_of(start.state.q).is_flat)
    fibre = _extrapolated(changes / in_fibre[None], method.order + 1)
    # The derivative of order k + 1 of q is that of order k of u.
    position = _extrapolated(h * displacements / in_position[None], method.order)
    return factor * jnp.sqrt(0.5 * (fibre**2 + position**2))


def _extrapolated(changes: Float[Array, "s n"], order: int) -> FloatScalar:
    """Estimate the size of a derivative from scaled derivatives of orders 1, ..., s."""
    sizes = jnp.sqrt(jnp.mean(changes**2, axis=1))
    number = sizes.shape[0]
    # The first derivative may vanish inside the step, but not at both of its ends.
    first = jnp.maximum(sizes[0], 0.5 * sizes[1])
    first = jnp.maximum(first, float(jnp.finfo(sizes.dtype).tiny) ** 0.25)
    last = sizes[-1]
    growth = (last / first) ** (1 / (number - 1))
    if number > 2:
        # One derivative may vanish at a time, but not the next one with it.
        growth = jnp.maximum(growth, (sizes[-2] / first) ** (1 / (number - 2)))
        last = jnp.sqrt(last**2 + (growth * sizes[-2]) ** 2)
    return last * growth ** (order - number)


@functools.cache
def derivative_weights(method: AbstractMethod) -> np.ndarray:
    """Return the weights by which samples at the nodes give h^k f^(k), k = 0, 1, ....

    Row k has the coefficient of the Legendre polynomial of degree k on the step, times
    (2k)! / k!, the k-th derivative of that polynomial. If nodes coincide, only the
    first of them has a weight.
    """
    nodes, first = np.unique(method.c, return_index=True)
    basis = np.polynomial.legendre.legvander(2 * nodes - 1, len(nodes) - 1)
    weights = np.zeros((len(nodes), method.stages))
    weights[:, first] = np.linalg.inv(basis)
    sizes = [math.factorial(2 * k) // math.factorial(k) for k in range(len(nodes))]
    return np.array(sizes, float)[:, None] * weights


@functools.cache
def error_factor(method: AbstractMethod, is_flat: bool) -> float:
    """Return the typical error of a step of order p, divided by U_{p+1}."""
    p = method.order
    defect = abs(float(method.b @ method.c**p) - 1 / (p + 1)) / math.factorial(p)
    # Some methods have the order p for another reason than their quadrature.
    defect = max(defect, 1e-2 / math.factorial(2 * p))
    growth = _GROWTH if is_flat else _GROWTH_ON_GROUPS
    return defect * growth ** (p / 2)
