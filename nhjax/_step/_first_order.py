"""The terms of order h in the linearised stage equations of one step."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from .._numerics import full_jacobian, small_einsum
from .._system import Linearisation, total_force
from ._equations import (
    node_coordinates,
    stage_coordinates,
    StageEquations,
    StageUnknowns,
)


class FirstOrderTerms(eqx.Module):
    """The terms of order h in the linearised stage equations of a Lagrangian system.

    The equations of the stages, r_i = Π_i - base - h Σ â_ij F^j, change with the stage
    velocities by

    δr_i = N_i δH_i + ∂Π/∂y δy_i - h Σ_j â_ij ∂F/∂H δH_j - ∂base/∂ξ δξ - ...,
    δy_i = h Σ_j a_ij δH_j,

    and those of the nodes likewise. The leading part is N δH_i with the mass matrix N
    at the start of the step. All others are of the order of h: how the mass matrix
    turns until the stage, N_i = N + h c_i Ṅ, how momenta change with positions, and how
    forces change with velocities. Their derivatives are those at the start of the step,
    multiplied by N⁻¹, so that with z_i = N⁻¹ r_i

    δH_i = z_i - N⁻¹ (the terms, of z),

    of which the error is of the order of h². The first product of the Neumann series is
    enough: what it leaves out is as small as what the derivatives at the start leave
    out.
    """

    inertia: Float[Array, "s n n"]  # N⁻¹ (N_i - N) of the stages
    momentum: Float[Array, "n n"]  # h N⁻¹ ∂Π/∂y
    force: Float[Array, "n n"]  # h N⁻¹ ∂F/∂H
    base: Float[Array, "n n"]  # h N⁻¹ times the derivative of the constant term by ξ
    node_inertia: Float[Array, "r n n"]  # N⁻¹ (N_i - N) of the nodes
    node_momentum: Float[Array, "n n"]  # the same as above, of the momenta at nodes
    node_force: Float[Array, "n n"]

    def of_stages(
        self, stages: StageEquations, z: Float[Array, "s n *c"]
    ) -> Float[Array, "s n *c"]:
        """Solve for changes of stage velocities that change the residuals by N z."""
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
        """Compute the changes of the velocities at the nodes that balance N z."""
        return z - _times(self.node_inertia, z)

    def by_force(
        self, stages: StageEquations, change: Float[Array, "s n *c"]
    ) -> Float[Array, "r n *c"]:
        """Compute the changes of the node velocities by forces, given the stages'."""
        return _times(self.node_force, _weighted(stages.node_weights, change))

    def by_position(
        self, stages: StageEquations, change: Float[Array, "s n *c"]
    ) -> Float[Array, "r n *c"]:
        """Compute how positions move the nodes if the stage velocities change."""
        return -_times(self.node_momentum, _weighted(stages.node_weights, change))


# Forces that change so much, as a friction that is steep at rest, are no part of a
# series: the leading part alone does better, and more so if friction soon saturates.
_LARGEST = 5.0


def _weighted(
    weights: Float[Array, "r s"], z: Float[Array, "s n *c"]
) -> Float[Array, "r n *c"]:
    rest = "nc"[: z.ndim - 1]
    return small_einsum(f"ij,j{rest}->i{rest}", weights, z)


def _times(
    matrix: Float[Array, "... k n"], z: Float[Array, "r n *c"]
) -> Float[Array, "r k *c"]:
    """Multiply the rows of z by one matrix, or each by a matrix of its own."""
    own, rest = "i"[: matrix.ndim - 2], "c"[: z.ndim - 2]
    return small_einsum(f"{own}kn,in{rest}->ik{rest}", matrix, z)


def full_momentum_inverse(lin: Linearisation) -> Float[Array, "n n"]:
    """Return N⁻¹ as a matrix, also where only its diagonal is kept."""
    inverse = lin.momentum_inverse
    return jnp.diag(inverse) if inverse.ndim == 1 else inverse


def first_order_terms(
    stages: StageEquations, x: StageUnknowns, lin: Linearisation
) -> FirstOrderTerms:
    """Compute the terms at the start of the step, in the chart of the stages x."""
    h, c = stages.h, stages.coefficients("c")
    # The starting values begin at u_k.
    first = jnp.sum(stages.coefficients("a_hat"), axis=1)[0]
    u = x.velocity[0] - first * h * lin.acceleration
    inverse = full_momentum_inverse(lin)

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
    # A derivative may not be finite, as that of |v| at rest.
    keeps = [jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(terms)]
    keeps = jnp.all(jnp.stack(keeps)) & (_size(terms.force) <= _LARGEST)
    return jax.tree.map(lambda x: jnp.where(keeps, x, 0), terms)


def _size(matrix: Float[Array, "n n"]) -> FloatScalar:
    """Measure a matrix, whatever the units of the coordinates are."""
    return jnp.sqrt(jnp.sum(jnp.abs(matrix * matrix.T)))


def momenta_of_forces(
    stages: StageEquations, x: StageUnknowns, forces: Float[Array, "s n c"]
) -> tuple[Float[Array, "s n c"], Float[Array, "r n c"]]:
    """Compute the momenta of stages and nodes from forces at the stages, for h = 1.

    The chart carries forces from stage to stage, which is of the order of h too.
    """
    a_hat, b = stages.coefficients("a_hat"), stages.coefficients("b")
    if stages.manifold.is_flat:
        return _weighted(a_hat, forces), _weighted(stages.node_weights, forces)
    chart, y = stage_coordinates(stages, x)
    nodes = node_coordinates(stages, x)[1]

    def one(force):
        zero = jnp.zeros_like(force)
        _, chart_force = chart.to_chart(y, zero, zero, force)
        carried = chart.to_origin(y, force)
        sums = (_weighted(b[None], part)[0] for part in (carried, chart_force))
        base = chart.base_momentum(zero[0], *sums)
        on_nodes = chart.from_origin(nodes, _weighted(stages.node_weights, carried))
        return base[None] + _weighted(a_hat, chart_force), on_nodes

    return jax.vmap(one, in_axes=2, out_axes=2)(forces)


class _BodySlopes(NamedTuple):
    """Derivatives at the start of a step, in the body frame.

    They are the rate of N = ∂p/∂u along the motion, and the derivatives of the momenta
    by positions, less how momenta are carried there.
    """

    inertia_rate: Array
    momentum: Array


class _ChartSlopes(NamedTuple):
    """Derivatives at the start of a step, in its chart.

    They are how ∂Π/∂H changes with dτ_y along y = v, then ∂Π/∂y, ∂F/∂H, ∂w/∂H, and the
    derivative of the constant term of Π by the increment of the step.
    """

    turning: Array
    momentum: Array
    force: Array
    body_force: Array
    base: Array


def _in_body(stages: StageEquations, u: Array, acceleration: Array) -> _BodySlopes:
    system, args, manifold = stages.system, stages.args, stages.manifold
    t, zero = stages.t, jnp.zeros_like(u)

    def momentum(t, xi, u):
        return system.momentum(t, manifold.act(stages.q, xi), u, args)

    def carried(xi):
        p = momentum(t, xi, u)
        return p if manifold.is_flat else p - manifold.to_end(xi, stages.p)

    _, rate = jax.jvp(
        lambda t, xi, u: full_jacobian(lambda u: momentum(t, xi, u), u),
        (t, zero, u),
        (jnp.ones_like(t), u, acceleration),
    )
    return _BodySlopes(rate, full_jacobian(carried, zero))


def _force_slope(stages: StageEquations, x: StageUnknowns, u: Array) -> Array:
    system, t, q, args = stages.system, stages.t, stages.q, stages.args
    multiplier = stages.multipliers(x)[0]
    return full_jacobian(lambda u: total_force(system, t, q, u, multiplier, args), u)


def _coordinates(stages: StageEquations, x: StageUnknowns, u: Array) -> _ChartSlopes:
    system, args, manifold = stages.system, stages.args, stages.manifold
    t, multiplier, chart = stages.t, stages.multipliers(x)[0], stages.chart(x)
    zero = jnp.zeros_like(u)

    def pair(y, xi, velocity):
        """Compute Π, F and w at q_k τ(ξ), as if its coordinates were y."""
        q = manifold.act(stages.q, xi)
        u = chart.body_velocities(y[None], velocity[None])[0]
        p = system.momentum(t, q, u, args)
        w = total_force(system, t, q, u, multiplier, args)
        is_in_chart = chart.to_chart(y[None], velocity[None], p[None], w[None])
        return is_in_chart[0][0], is_in_chart[1][0], w

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
        # The coordinates of all points move by -½ δξ; of the constant term, the forces
        # enter at both ends alike.
        of_base = of_base + 0.5 * slope + 0.5 * (body_force - force)
    else:
        of_base = of_base + body_force - force
    return _ChartSlopes(rate, slope, force, body_force, of_base)
