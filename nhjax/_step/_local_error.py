"""An estimate of the error of one step, from the forces and velocities at its stages.

The estimate needs no further evaluations of forces. The forces of the stages sample the
rate of the momentum p at s points of the step. Multiplied by (∂p/∂u)⁻¹ at the start of
the step, they sample the rate of the fibre coordinate u (v or p). The Legendre
coefficients of these samples give the sizes U_k = |h^k u^(k)| of the derivatives of u,
where k is 1, ..., s. Velocities can also change where momenta do not: if the mass
matrix depends on time, or when a free body turns. Therefore a second estimate of each
U_k is computed from the velocities of the stages and the accelerations at both ends,
and the larger estimate is used. On a group, the second estimate uses the velocities in
the chart without the accelerations, and exists for k < s only.

The error of a method of order p is a multiple of U_{p+1}, a derivative of higher order
than the samples determine. From order to order, derivatives grow by a factor r. The
samples determine this factor, so that

    U_{p+1} ≈ U_s r^(p+1-s).

For example, let s = 3. In an oscillation the rate of u, and with it U_1, passes through
zero twice in each period, and so does U_3. Their ratio still determines r. Where U_3
vanishes but U_1 does not, the ratio of U_2 and U_1 is used. This ratio grows near a
zero of U_1, and is therefore limited by the growth that earlier steps have shown.

On a group, displacements are differentiated in a chart, in which each further
derivative adds a commutator with the velocity, so that

    U_{p+1} ≈ U_s r^(p+1-s) + max_k U_k a^(p+1-k),

where a is a multiple of the largest eigenvalue of ad(h v).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalar
from .._manifold import AbstractLieGroup
from .._method import AbstractMethod
from .._system import AbstractMechanicalSystem
from ._step import StepOutcome, StepState


# The error of a step is the error of the quadrature with the weights b, times `_GROWTH`
# to the power p + 1 - s. The exponent is the number of orders that the samples do not
# determine. The factor a is `_GROWTH_BY_COMMUTATOR` times the largest eigenvalue of
# ad(h v). Both values were fitted to the errors of steps of the gallery's systems
# (`benchmarks.adaptive_steps`).
_GROWTH, _GROWTH_BY_COMMUTATOR = 2.8, 1.2
# A part of the change of velocities in a chart comes from the chart itself. Therefore
# their derivatives are multiplied by this factor, which was fitted to the same errors.
_PART_IN_CHART = 0.5


def local_error(
    system: AbstractMechanicalSystem,
    method: AbstractMethod,
    t: FloatScalar,
    h: FloatScalar,
    start: StepState,
    outcome: StepOutcome,
    scales: tuple[Float[Array, " n"], Float[Array, " n"]],
    args: Args,
    growth_rates: Float[Array, "2"],
) -> tuple[FloatScalar, Float[Array, "2"]]:
    """Estimate the error of a step relative to `scales`, as a root mean square.

    **Arguments:**

    - `t`, `h`: the start and the size of the step.
    - `start`, `outcome`: the state before the step, and the outcome of the step.
    - `scales`: the sizes that count as an error of one, for the n coordinates of a
        displacement in q and for the n fibre coordinates.
    - `growth_rates`: r / h of earlier steps, for u and for q; infinite if unknown.

    **Returns:** the root mean square over all 2n components, and r / h of this step.
    """
    lin, in_position, in_fibre = start.lin, *scales
    weights = jnp.asarray(derivative_weights(method), h.dtype)
    changes = weights @ (
        h * jax.vmap(lin.momentum_inverse.matvec)(outcome.record.force)
    )
    if start.state.multiplier.shape[0]:
        # Multipliers of single stages may be wrong although their sum is right.
        # Therefore the reactions are left out of all derivatives but the first.
        excess = jax.vmap(lin.jacobian.matvec)(changes)
        excess = jax.vmap(lin.delassus_inverse.matvec)(excess)
        reactions = jax.vmap(lin.reaction.matvec)(excess)
        first = jnp.arange(changes.shape[0])[:, None] == 0
        changes = changes - jnp.where(first, 0, reactions)
    u = system.fibre_coordinate(start.state)
    displacements = changes
    if system.manifold_of(start.state.q).is_flat:
        ends = (t, start), (t + h, outcome.step_state)
        rates = [h * _velocity_rate(system, *end, args) for end in ends]
        samples = jnp.concatenate([outcome.record.velocity, jnp.stack(rates)])
        in_velocity = jnp.asarray(_velocity_weights(method), h.dtype) @ samples
    else:
        in_velocity = _PART_IN_CHART * weights[1:] @ outcome.record.velocity
        in_velocity = jnp.pad(in_velocity, ((0, 1), (0, 0)))
    moved = in_velocity
    if system.fibre_coordinate_name == "p":
        moved = jax.vmap(lin.fibre_hessian_inverse.matvec)(moved)
        _, displacements = jax.vmap(
            lambda change: jax.jvp(
                lambda u: system.velocity(t, start.state.q, u, args), (u,), (change,)
            )
        )(changes)
    # The mean of the stage velocities gives a step and the step back the same growth:
    # their stage velocities are the same in reverse order.
    mean = jnp.asarray(method.b, h.dtype) @ outcome.record.velocity
    by_chart = _growth_in_chart(system.manifold_of(start.state.q), h * mean)
    # The derivative of order k + 1 of q is the derivative of order k of the velocity.
    # Products with the inverses take less time than divisions.
    per_fibre, per_position = (1 / in_fibre)[None], (jnp.abs(h) / in_position)[None]
    sizes = (
        _largest(changes * per_fibre, moved * per_fibre),
        _largest(displacements * per_position, in_velocity * per_position),
    )
    orders = method.order + 1, method.order
    (fibre, in_u), (position, in_q) = (
        _extrapolated(x, order, by_chart, known)
        for x, order, known in zip(
            sizes, orders, jnp.abs(h) * growth_rates, strict=True
        )
    )
    error = error_factor(method) * jnp.sqrt(0.5 * (fibre**2 + position**2))
    return error, jnp.stack([in_u, in_q]) / jnp.abs(h)


def _largest(by_force: Array, by_velocity: Array) -> Float[Array, " s"]:
    """Return the size (root mean square) of each row, the larger of two estimates."""
    both = jnp.stack([by_force, by_velocity])
    return jnp.sqrt(jnp.max(jnp.mean(both**2, axis=2), axis=0))


def _velocity_rate(
    system: AbstractMechanicalSystem, t: FloatScalar, y: StepState, args: Args
) -> Float[Array, " n"]:
    """Compute the rate of the velocity at a state in a vector space."""
    rate = y.lin.acceleration
    if system.fibre_coordinate_name == "v":
        return rate
    q, p = y.state.q, y.state.p
    along = jnp.ones_like(t), system.velocity(t, q, p, args), rate
    return jax.jvp(lambda t, q, p: system.velocity(t, q, p, args), (t, q, p), along)[1]


def _growth_in_chart(
    manifold: AbstractLieGroup, xi: Float[Array, " n"]
) -> FloatScalar | None:
    """Return the growth of derivatives in a chart from order to order; None if flat."""
    if manifold.is_flat:
        return None
    ad = jax.jacfwd(lambda eta: manifold.ad(xi, eta))(jnp.zeros_like(xi))
    # For a rotation by the angle a, the eigenvalues of ad are ia, -ia and 0. The size a
    # follows from the trace of the fourth power of ad, which is 2 a^4 in every basis.
    square = ad @ ad
    trace = jnp.maximum(jnp.sum(square * square.T), float(jnp.finfo(xi.dtype).tiny))
    return _GROWTH_BY_COMMUTATOR * (0.5 * trace) ** 0.25


def _extrapolated(
    sizes: Float[Array, " s"],
    order: int,
    by_chart: FloatScalar | None,
    known_growth: FloatScalar,
) -> tuple[FloatScalar, FloatScalar]:
    """Estimate the size of the derivative of the given order from U_1, ..., U_s.

    **Returns:** this size, and the growth r from order to order.
    """
    number = sizes.shape[0]
    # If the first derivative vanishes in the middle of the step, it is about U_2 / 2 at
    # the ends. A smaller U_1 is replaced by this value.
    first = jnp.maximum(sizes[0], 0.5 * sizes[1])
    first = jnp.maximum(first, float(jnp.finfo(sizes.dtype).tiny) ** 0.25)
    last = sizes[-1]
    growth = _root(last / first, number - 1)
    if number > 2:
        # U_s can vanish, but not together with U_{s-1}. Therefore U_{s-1} is used too.
        other = _root(sizes[-2] / first, number - 2)
        growth = jnp.maximum(growth, jnp.minimum(other, known_growth))
        last = jnp.sqrt(last**2 + (growth * sizes[-2]) ** 2)
    found = last * growth ** (order - number)
    if by_chart is not None:
        powers = [by_chart ** (order - 1 - k) for k in range(number)]
        found = found + jnp.max(sizes * jnp.stack(powers))
    return found, growth


def _root(x: FloatScalar, n: int) -> FloatScalar:
    # The functions below take less time than `x ** (1 / n)`. Their errors do not matter
    # here.
    if n == 1:
        return x
    if n <= 3:
        return jnp.sqrt(x) if n == 2 else jnp.cbrt(x)
    return jnp.exp(jnp.log(x) / n)


@functools.cache
def derivative_weights(method: AbstractMethod) -> np.ndarray:
    """Return the weights by which samples at the nodes give h^k f^(k), k = 0, 1, ....

    Row k gives the coefficient of the Legendre polynomial of degree k on the step,
    times (2k)! / k!, the k-th derivative of that polynomial. If nodes coincide, only
    the first of them has a weight.
    """
    nodes, first = np.unique(method.c, return_index=True)
    basis = np.polynomial.legendre.legvander(2 * nodes - 1, len(nodes) - 1)
    weights = np.zeros((len(nodes), method.stages))
    weights[:, first] = np.linalg.inv(basis)
    return _as_derivatives(weights)


@functools.cache
def _velocity_weights(method: AbstractMethod) -> np.ndarray:
    """Return the weights by which velocities and accelerations give h^k v^(k), k > 0.

    The samples are the velocities at the nodes, and h times the accelerations at both
    ends. There are as many rows as `derivative_weights` has.
    """
    nodes, first = np.unique(method.c, return_index=True)
    number = len(nodes)
    legendre = np.polynomial.legendre
    values = legendre.legvander(2 * nodes - 1, number + 1)
    slopes = [2 * legendre.legder(unit) for unit in np.eye(number + 2)]
    at_ends = np.array([legendre.legval([-1, 1], x) for x in slopes]).T
    inverse = np.linalg.inv(np.concatenate([values, at_ends]))
    weights = np.zeros((number + 2, method.stages + 2))
    weights[:, [*first, method.stages, method.stages + 1]] = inverse
    return _as_derivatives(weights)[1 : number + 1]


def _as_derivatives(weights: np.ndarray) -> np.ndarray:
    """Convert weights for Legendre coefficients to weights for derivatives."""
    orders = range(len(weights))
    sizes = [math.factorial(2 * k) // math.factorial(k) for k in orders]
    return np.array(sizes, float)[:, None] * weights


@functools.cache
def error_factor(method: AbstractMethod) -> float:
    """Return the typical error of a step of order p, divided by U_{p+1}."""
    p = method.order
    defect = abs(float(method.b @ method.c**p) - 1 / (p + 1)) / math.factorial(p)
    # With some methods the quadrature has a higher order than p, and no defect.
    defect = max(defect, 1e-2 / math.factorial(2 * p))
    return defect * _GROWTH ** (p + 1 - len(np.unique(method.c)))
