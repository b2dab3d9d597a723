"""The terms of order h in the Jacobian of the stage equations, and when to use them.

If simplified Newton uses only the mass matrix and the constraints at the start of the
step, each iteration reduces the error by a factor O(h). With `FirstOrderTerms` the
factor is O(h²). These terms are the change of the mass matrix along the step, the
derivatives of momenta with respect to positions, and the derivatives of forces with
respect to velocities. `uses_first_order_terms` decides whether these terms are
available and whether they make a step faster.
"""

from typing import Literal, NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalar
from .._numerics import full_jacobian, jacobian_sparsity, small_einsum
from .._system import AbstractMechanicalSystem, Linearisation, total_force
from ._equations import StageEquations, StageUnknowns


# The part of the Jacobian that simplified Newton inverts; None selects the faster one
# of "leading" and "first_order".
JacobianName: TypeAlias = Literal["leading", "first_order", "full"] | None

# The terms make a step faster if the saved iterations cost more time than the terms.
# This is the case if there are no holonomic constraints, and at most this many stages,
# coordinates, and derivatives of stage velocities with respect to multipliers. For one
# trajectory of a larger system, the program with the terms is no longer compiled to
# scalar operations, which makes it several times slower.
_MOST_STAGES, _MOST_COORDINATES, _MOST_RESPONSES = 5, 6, 100


def uses_first_order_terms(
    stages: StageEquations, lin: Linearisation, jacobian: JacobianName
) -> bool:
    """Return whether the Jacobian of simplified Newton includes the terms of order h.

    **Raises:** `ValueError` if they are requested and not available.
    """
    if jacobian == "leading":
        return False
    is_available = not stages.hamiltonian
    is_available &= stages.redundancy is None and not lin.is_sparse
    if jacobian == "first_order":
        if not is_available:
            raise ValueError(
                '`SimplifiedNewton(jacobian="first_order")` is not available for '
                "Hamiltonian systems, redundant constraints, or constraints so many "
                'that they are kept sparse; use "leading" or None.'
            )
        return True
    s, n, m = stages.method.stages, stages.p.shape[0], stages.num_nonholonomic
    is_small = s <= _MOST_STAGES and n <= _MOST_COORDINATES
    is_small &= s * n * (s - 1) * m <= _MOST_RESPONSES
    if not is_available or not is_small or stages.num_holonomic > 0:
        return False
    if not forces_have_slopes(stages):
        return False
    return not stages.manifold.is_flat or _has_terms(stages)


def forces_have_slopes(stages: StageEquations) -> bool:
    """Return whether the forces of this step have derivatives in the velocities."""
    at_start = stages.t, stages.q, stages.p, stages.multiplier, stages.args
    return has_force_slopes(stages.system, *at_start)


def has_force_slopes(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    multiplier: Float[Array, " l"],
    args: Args,
) -> bool:
    """Return whether forces have forward-mode derivatives in the velocities.

    Callbacks do not have such derivatives, and neither do functions whose custom
    derivative rule is for reverse mode only. Simplified Newton with the leading part of
    the Jacobian does not need these derivatives.
    """

    def force(u):
        return total_force(system, t, q, u, multiplier, args)

    try:
        jax.eval_shape(lambda u: full_jacobian(force, u), jnp.zeros_like(u))
    except (NotImplementedError, TypeError, ValueError):
        return False
    return True


def _has_terms(stages: StageEquations) -> bool:
    # On a vector space the terms vanish unless momenta depend on positions, or forces
    # on velocities. The traced functions of the system show whether they do.
    system, t, args = stages.system, stages.t, stages.args
    q, zero = stages.q, jnp.zeros_like(stages.p)
    by_position = jacobian_sparsity(
        lambda xi: system.momentum(t, stages.manifold.act(q, xi), zero, args), zero
    )
    by_velocity = jacobian_sparsity(
        lambda u: total_force(system, t, q, u, stages.multiplier, args), zero
    )
    return bool(by_position.any() or by_velocity.any())


class FirstOrderTerms(eqx.Module):
    """The terms of order h in the linearised stage equations of a Lagrangian system.

    The residuals of the stages, r_i = Π_i - base - h Σ â_ij F^j (symbols as in
    `StageEquations`), change with the stage velocities H_i and the increment ξ by

    δr_i = N_i δH_i + ∂Π/∂y δy_i - h Σ_j â_ij ∂F/∂H δH_j - ∂base/∂ξ δξ - ...,
    δy_i = h Σ_j a_ij δH_j,

    and the equations of the nodes change in the same form. The leading part is N δH_i
    with the mass matrix N at the start of the step. All other terms are of order h: the
    change of the mass matrix from the start to the stage, N_i = N + h c_i Ṅ, the change
    of momenta with positions, and the change of forces with velocities. All derivatives
    are taken at the start of the step and multiplied by N⁻¹, so that with
    z_i = N⁻¹ r_i

    δH_i = z_i - N⁻¹ (the other terms, with z for δH),

    with an error of order h². The first term of the Neumann series is enough: the
    derivatives at the start of the step have an error of the same order.
    """

    inertia: Float[Array, "s n n"]  # N⁻¹ (N_i - N) of the stages
    momentum: Float[Array, "n n"]  # h N⁻¹ ∂Π/∂y
    force: Float[Array, "n n"]  # h N⁻¹ ∂F/∂H
    base: Float[Array, "n n"]  # h N⁻¹ ∂base/∂ξ
    node_inertia: Float[Array, "r n n"]  # N⁻¹ (N_i - N) of the nodes
    node_momentum: Float[Array, "n n"]  # h N⁻¹ ∂p/∂y of the momenta p at the nodes
    node_force: Float[Array, "n n"]  # h N⁻¹ ∂w/∂H of the body forces w

    def of_stages(
        self, stages: StageEquations, z: Float[Array, "s n *c"]
    ) -> Float[Array, "s n *c"]:
        """Compute the changes of stage velocities that change the residuals by N z."""
        a, a_hat, b = (stages.coefficients(name) for name in ("a", "a_hat", "b"))
        by_node = _weighted(a, z)
        return (
            z
            - _times(self.inertia, z)
            - _times(self.momentum, by_node)
            + _times(self.force, _weighted(a_hat, z))
            + _times(self.base, _weighted(b[None], z))
        )

    def of_nodes(self, z: Float[Array, "r n *c"]) -> Float[Array, "r n *c"]:
        """Compute the changes of node velocities that change the residuals by N z."""
        return z - _times(self.node_inertia, z)

    def by_force(
        self, stages: StageEquations, change: Float[Array, "s n *c"]
    ) -> Float[Array, "r n *c"]:
        """Compute the changes of node velocities that are due to forces.

        `change` is the change of the stage velocities.
        """
        return _times(self.node_force, _weighted(stages.node_weights, change))

    def by_position(
        self, stages: StageEquations, change: Float[Array, "s n *c"]
    ) -> Float[Array, "r n *c"]:
        """Compute the changes of node velocities that are due to positions.

        `change` is the change of the stage velocities, which changes the positions.
        """
        return -_times(self.node_momentum, _weighted(stages.node_weights, change))


# If the size of h N⁻¹ ∂F/∂H is larger than this, the Neumann series of
# `FirstOrderTerms` does not converge. An example is friction that changes steeply near
# rest. Iterations with the leading part of the Jacobian alone then converge better, in
# particular if the friction saturates at a low velocity.
_LARGEST = 5.0


def _weighted(
    weights: Float[Array, "r s"], z: Float[Array, "s n *c"]
) -> Float[Array, "r n *c"]:
    rest = "nc"[: z.ndim - 1]
    return small_einsum(f"ij,j{rest}->i{rest}", weights, z)


def _times(
    matrix: Float[Array, "... k n"], z: Float[Array, "r n *c"]
) -> Float[Array, "r k *c"]:
    """Multiply all rows of z by one matrix, or each row by its own matrix."""
    own, rest = "i"[: matrix.ndim - 2], "c"[: z.ndim - 2]
    return small_einsum(f"{own}kn,in{rest}->ik{rest}", matrix, z)


def first_order_terms(
    stages: StageEquations, x: StageUnknowns, lin: Linearisation
) -> FirstOrderTerms:
    """Compute the terms at the start of the step, in the chart of the stages x."""
    h, c = stages.h, stages.coefficients("c")
    # The fibre coordinate u_k at the start of the step follows from the starting value
    # of the first stage, which is u_k + `first` h u̇.
    first = jnp.sum(stages.coefficients("a_hat"), axis=1)[0]
    u = x.velocity[0] - first * h * lin.acceleration
    inverse = lin.momentum_inverse.as_matrix()

    def scaled(matrix):
        return small_einsum("kl,ln->kn", inverse, matrix)

    def moved(times, rate):
        return h * times[:, None, None] * scaled(rate)[None]

    body = _in_body(stages, u, lin.acceleration)
    if stages.manifold.is_flat:
        force = _force_slope(stages, x, u)
        none = jnp.zeros_like(force)
        chart = _ChartSlopes(none, body.momentum, force, force, none)
    else:
        chart = _coordinates(stages, x, u)
    coordinates = c - 0.5 if stages.method.chart == "middle" else c
    node_times = c[1:] if stages.num_nonholonomic else c[-1:]
    terms = FirstOrderTerms(
        inertia=moved(c, body.inertia_rate) + moved(coordinates, chart.turning),
        momentum=h * scaled(chart.momentum),
        force=h * scaled(chart.force),
        base=h * scaled(chart.base),
        node_inertia=moved(node_times, body.inertia_rate),
        node_momentum=h * scaled(body.momentum),
        node_force=h * scaled(chart.body_force),
    )
    # A derivative can be infinite or NaN, such as the derivative of |v| at rest. Then,
    # or if `force` is larger than `_LARGEST`, all terms become zero.
    is_finite = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(terms)]
    is_usable = jnp.all(jnp.stack(is_finite)) & (_size(terms.force) <= _LARGEST)
    return jax.tree.map(lambda x: jnp.where(is_usable, x, 0), terms)


def _size(matrix: Float[Array, "n n"]) -> FloatScalar:
    """Compute a size of a matrix that does not depend on the units of coordinates."""
    return jnp.sqrt(jnp.sum(jnp.abs(matrix * matrix.T)))


class _BodySlopes(NamedTuple):
    """Derivatives at the start of a step, in the body frame.

    - `inertia_rate`: the rate of N = ∂p/∂u along the motion.
    - `momentum`: the derivative of p - p₀ with respect to the position, where p is the
        momentum at this position, and p₀ is the initial momentum carried to it.
    """

    inertia_rate: Float[Array, "n n"]
    momentum: Float[Array, "n n"]


class _ChartSlopes(NamedTuple):
    """Derivatives at the start of a step, in its chart.

    - `turning`: the rate of ∂Π/∂H that the change of dτ_y, the derivative of the
        retraction, causes if y changes at the rate u.
    - `momentum`, `force`, `body_force`: ∂Π/∂y, ∂F/∂H and ∂w/∂H.
    - `base`: the derivative of `AbstractChart.base_momentum`, the constant term of Π,
        with respect to the increment ξ of the step.
    """

    turning: Float[Array, "n n"]
    momentum: Float[Array, "n n"]
    force: Float[Array, "n n"]
    body_force: Float[Array, "n n"]
    base: Float[Array, "n n"]


def _in_body(stages: StageEquations, u: Array, acceleration: Array) -> _BodySlopes:
    system, args, manifold = stages.system, stages.args, stages.manifold
    t, zero = stages.t, jnp.zeros_like(u)

    def momentum(t, xi, u):
        return system.momentum(t, manifold.act(stages.q, xi), u, args)

    def less_transported(xi):
        p = momentum(t, xi, u)
        return p if manifold.is_flat else p - manifold.to_end(xi, stages.p)

    _, rate = jax.jvp(
        lambda t, xi, u: full_jacobian(lambda u: momentum(t, xi, u), u),
        (t, zero, u),
        (jnp.ones_like(t), u, acceleration),
    )
    return _BodySlopes(rate, full_jacobian(less_transported, zero))


def _force_slope(stages: StageEquations, x: StageUnknowns, u: Array) -> Array:
    system, t, q, args = stages.system, stages.t, stages.q, stages.args
    multiplier = stages.multipliers(x)[0]
    return full_jacobian(lambda u: total_force(system, t, q, u, multiplier, args), u)


def _coordinates(stages: StageEquations, x: StageUnknowns, u: Array) -> _ChartSlopes:
    system, args, manifold = stages.system, stages.args, stages.manifold
    t, multiplier, chart = stages.t, stages.multipliers(x)[0], stages.chart(x)
    zero = jnp.zeros_like(u)

    def pair(y, xi, velocity):
        """Compute Π, F and w at the position q_k τ(ξ), with the chart coordinates y."""
        q = manifold.act(stages.q, xi)
        u = chart.body_velocities(y[None], velocity[None])[0]
        p = system.momentum(t, q, u, args)
        w = total_force(system, t, q, u, multiplier, args)
        pair = chart.to_chart(y[None], velocity[None], p[None], w[None])
        return pair[0][0], pair[1][0], w

    def inertia(y):
        return full_jacobian(lambda v: pair(y, zero, v)[0], u)

    def base(increment):
        moved = eqx.tree_at(lambda z: z.increment, chart, increment)
        momentum = moved.momentum_at_origin(stages.p)
        return moved.base_momentum(momentum, 0 * increment, 0 * increment)

    _, rate = jax.jvp(inertia, (zero,), (u,))
    slope = full_jacobian(lambda y: pair(y, y, u)[0], zero)
    force, body_force = full_jacobian(lambda v: pair(zero, zero, v)[1:], u)
    of_base = full_jacobian(base, stages.increment(x))
    if stages.method.chart == "middle":
        # A change δξ of the increment moves the coordinates of all points by -½ δξ,
        # because the origin lies in the middle. Forces have the factor ½ in
        # `MiddleChart.base_momentum`.
        of_base = of_base + 0.5 * slope + 0.5 * (body_force - force)
    else:
        of_base = of_base + body_force - force
    return _ChartSlopes(rate, slope, force, body_force, of_base)
