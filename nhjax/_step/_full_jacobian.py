"""The Jacobian of all stage equations of a step, by blocks, and its inverse.

Without terms of order h, the Jacobian has only the mass matrix and the Schur complement
of the constraints. `LinearisedStep` has all derivatives of momenta, forces, reactions
and constraints, at the starting values of the step, and solves the linear system
exactly.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import reduce
from itertools import pairwise
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._numerics import inverse_by_blocks, inverses, mapped, small_einsum
from .._system import force_by_multiplier, motion_residual, total_force
from ._chart import AbstractChart
from ._equations import (
    end_impulse,
    end_position,
    forces_by_multiplier,
    momenta_of_forces,
    stage_coordinates,
    stage_positions,
    StageEquations,
    StageUnknowns,
    start_momentum,
)


class StageResponses(NamedTuple):
    """The changes of stages and nodes, divided by h, that reactions cause."""

    velocity: Float[Array, "s n"]
    momentum: Float[Array, "s p"]
    node_fibre_coordinate: Float[Array, "r n"]


class Slopes(NamedTuple):
    """The derivatives of quantities of the stages with respect to H, Ξ and ξ.

    H are the stage velocities, Ξ the increments from the start of the step to the
    stages, and ξ is the increment of the whole step. Row i of a quantity depends on H_i
    and Ξ_i of the same row, and on ξ. On a vector space the quantity does not depend on
    ξ, and `by_xi` is None.
    """

    by_velocity: Float[Array, "s n n"]
    by_increment: Float[Array, "s n n"]
    by_xi: Float[Array, "s n n"] | None

    def along(
        self,
        velocity: Float[Array, "s n"],
        increment: Float[Array, "s n"],
        xi: Float[Array, "1 n"],
    ) -> Float[Array, "s n"]:
        """Compute the change of the quantity for given changes of H, Ξ and ξ."""
        total = _times(self.by_velocity, velocity) + _times(
            self.by_increment, increment
        )
        if self.by_xi is None:
            return total
        return total + _times(self.by_xi, jnp.broadcast_to(xi, increment.shape))

    def plus(self, factors: Array, other: "Slopes") -> "Slopes":
        """Add other derivatives, multiplied by given matrices."""
        by_xi = self.by_xi
        if by_xi is not None and other.by_xi is not None:
            by_xi = by_xi + _products(factors, other.by_xi)
        return Slopes(
            self.by_velocity + _products(factors, other.by_velocity),
            self.by_increment + _products(factors, other.by_increment),
            by_xi,
        )


class LinearisedStep(eqx.Module):
    """The stage equations of one step, linearised at given stages.

    `StageEquations` and `StageUnknowns` define Π, F, n, base, H and u. The chart
    depends on the increment ξ = h Σ b_j H_j, and stage i is at the increment
    Ξ_i = h Σ a_ij H_j from the start. The momenta Π_i of the stages, their chart forces
    F_i and their transported forces n_i change by

    δΠ_i = ∂Π_i/∂H δH_i + ∂Π_i/∂Ξ δΞ_i + ∂Π_i/∂ξ δξ,

    and likewise for F_i and n_i. Here ∂F/∂Ξ is the stiffness, including the change of
    the reactions Bᵀλ with positions, and ∂F/∂H is the damping. The residuals of the
    stages are r_i = Π_i - base(ξ, h Σ b_j n_j, h Σ b_j F_j) - h Σ â_ij F_j. Their
    changes are a matrix of s n rows times δH. This matrix is inverted by blocks of n
    rows. It does not split into smaller systems, since the matrices (a_ij) and (â_ij)
    do not commute. The changes of the nodes follow from the changes of the stages, and
    the multipliers from a Schur complement. For nodes, r_i is the residual of the
    equation that determines u_i.

    For a Hamiltonian system, the stage momenta μ_i determine the velocities v_i = H_i.
    Therefore δμ_i = (∂v_i/∂μ)⁻¹ (δH_i - ∂v_i/∂Ξ δΞ_i - ∂v_i/∂ξ δξ), and the derivatives
    above include this change of μ_i.
    """

    stages: Float[Array, "s n s n"]  # the inverse of ∂r_i/∂H_j
    transported: Slopes  # of n_i
    conjugate: Slopes | None  # of μ_i, for a Hamiltonian system
    node_inverse: Float[Array, "r n n"]  # the inverse of ∂r_i/∂u_i of the nodes
    end_inverse: Float[Array, "n n"]  # (∂p/∂u)⁻¹ at the end
    node_gain: Float[Array, "r n n"] | None  # Ad^*_{τ(y_i)}; None on a vector space
    node_position: Float[Array, "r n n"]  # ∂r_i/∂Ξ_i of the nodes
    node_xi: Float[Array, "r n n"] | None  # ∂r_i/∂ξ of the nodes

    def of_stages(
        self, stages: StageEquations, residual: Float[Array, "s n"]
    ) -> tuple[Float[Array, "s n"], Float[Array, "s p"]]:
        """Compute the δH and δμ that change the stage residuals by `residual`."""
        velocity = _block_product(self.stages, residual)
        if self.conjugate is None:
            return velocity, jnp.zeros_like(velocity[:, :0])
        return velocity, self.conjugate.along(*_moves(stages, velocity))

    def by_force(
        self, stages: StageEquations, change: Float[Array, "s n"]
    ) -> Float[Array, "r n"]:
        """Compute the changes of the node momenta that forces cause, given δH."""
        force = self.transported.along(*_moves(stages, change))
        gained = stages.h * _weighted(stages.node_weights, force)
        return gained if self.node_gain is None else _times(self.node_gain, gained)

    def by_position(
        self, stages: StageEquations, change: Float[Array, "s n"]
    ) -> Float[Array, "r n"]:
        """Compute the changes of node residuals due to moved positions, given δH."""
        moved = stages.h * _weighted(stages.node_weights, change)
        moved = _times(self.node_position, moved)
        if self.node_xi is None:
            return moved
        xi = stages.h * _weighted(stages.coefficients("b")[None], change)
        return moved + _times(self.node_xi, jnp.broadcast_to(xi, moved.shape))

    def of_nodes(
        self,
        stages: StageEquations,
        residual: Float[Array, "r n"],
        change: Float[Array, "s n"],
    ) -> Float[Array, "r n"]:
        """Compute the δu that solve the equations of the nodes.

        The residual was evaluated at positions that include the `change` of the stage
        velocities, but with forces that do not include it.
        """
        return _times(self.node_inverse, self.by_force(stages, change) - residual)

    def response(
        self,
        stages: StageEquations,
        x: StageUnknowns,
        reaction: Float[Array, "s n"],
    ) -> StageResponses:
        """Compute the changes, divided by h, of stages and nodes due to reactions."""
        on_stages, on_nodes = momenta_of_forces(stages, x, reaction[..., None])
        on_stages, on_nodes = on_stages[..., 0], on_nodes[..., 0]
        velocity, momentum = self.of_stages(stages, on_stages)
        gained = on_nodes + self.by_force(stages, velocity)
        gained = gained - self.by_position(stages, velocity)
        return StageResponses(velocity, momentum, _times(self.node_inverse, gained))


def _moves(
    stages: StageEquations, velocity: Float[Array, "s n"]
) -> tuple[Array, Array, Array]:
    """Return the changes of H_i, Ξ_i and ξ for given changes of H_i."""
    a, b = stages.coefficients("a"), stages.coefficients("b")[None]
    return (
        velocity,
        stages.h * _weighted(a, velocity),
        stages.h * _weighted(b, velocity),
    )


def _weighted(
    weights: Float[Array, "r s"], z: Float[Array, "s n"]
) -> Float[Array, "r n"]:
    return small_einsum("ij,jn->in", weights, z)


def _times(
    matrices: Float[Array, "r k n"], z: Float[Array, "r n"]
) -> Float[Array, "r k"]:
    return small_einsum("ikn,in->ik", matrices, z)


def _products(
    left: Float[Array, "r k n"], right: Float[Array, "r n l"]
) -> Float[Array, "r k l"]:
    return small_einsum("ikn,inl->ikl", left, right)


def _block_product(
    matrix: Float[Array, "r k s n"], z: Float[Array, "s n"]
) -> Float[Array, "r k"]:
    # The loop computes the product row by row. Without the loop, the product would be
    # unrolled, and would be the largest part of the program.
    rows = matrix.reshape(-1, *matrix.shape[2:])
    found = jax.lax.map(lambda row: small_einsum("jn,jn->", row, z), rows)
    return found.reshape(matrix.shape[:2])


def slopes(
    function: Callable[..., PyTree[Array]], *args: Float[Array, "*r n"]
) -> tuple[PyTree[Array], tuple[PyTree[Array], ...]]:
    """Evaluate a function of rows, and differentiate it in each of its arguments.

    Row i of a result depends only on row i of each argument. Therefore one directional
    derivative serves for all rows. An argument with a single axis is shared by all
    rows.

    **Returns:** the values, and for each argument the derivatives, whose last axis
    lists the components of the argument.
    """
    value, push = jax.linearize(function, *args)
    sizes = [x.shape[-1] for x in args]
    ends = np.cumsum([0, *sizes])

    def along(unit):
        parts = [unit[first:last] for first, last in pairwise(ends)]
        return push(
            *(
                jnp.broadcast_to(part, x.shape)
                for part, x in zip(parts, args, strict=True)
            )
        )

    # `mapped` is a loop over the directions, so that the program has one copy of the
    # linearised function.
    found = mapped(along, jnp.eye(sum(sizes), dtype=args[0].dtype))
    # A derivative can be infinite or NaN, such as the derivative of |v| at rest. It is
    # then replaced by zero.
    found = jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, 0), found)

    def columns(first, last):
        return jax.tree.map(lambda x: jnp.moveaxis(x[first:last], 0, -1), found)

    return value, tuple(columns(*pair) for pair in pairwise(ends))


class _Path(NamedTuple):
    """The chart as a function of ξ, and the increments of stages and nodes."""

    chart: Callable[[Array], AbstractChart]
    xi: Float[Array, " n"]
    increments: Float[Array, "s n"]
    node_increments: Float[Array, "r n"]


def _path(stages: StageEquations, x: StageUnknowns) -> _Path:
    xi, chart, flat = stages.increment(x), stages.chart(x), stages.manifold.is_flat

    def moved(xi):
        return chart if flat else eqx.tree_at(lambda z: z.increment, chart, xi)

    at_stages, at_nodes = (
        stages.h * small_einsum("ij,jn->in", weights, x.velocity)
        for weights in (stages.coefficients("a"), stages.node_weights)
    )
    return _Path(moved, xi, at_stages, at_nodes)


def linearised_step(
    stages: StageEquations, x: StageUnknowns, *, has_impulse_slopes: bool = False
) -> LinearisedStep:
    """Linearise the equations of stages and nodes at the stages x.

    The impulse that keeps the invariants at the end of the step changes its direction
    with ξ and u. With `has_impulse_slopes` the result includes this effect, which is
    proportional to the impulse and therefore small.
    """
    h, path, flat = stages.h, _path(stages, x), stages.manifold.is_flat
    a_hat, b = stages.coefficients("a_hat"), stages.coefficients("b")[None]
    s, n = x.velocity.shape
    (w, f), momentum, force, transported, conjugate = _stage_slopes(stages, x, path)
    base = None if flat else _base_slopes(stages, x, path, w, f)

    def residual(velocity):
        moves = _moves(stages, velocity)
        by_force = force.along(*moves)
        change = momentum.along(*moves) - h * _weighted(a_hat, by_force)
        if base is None:
            return change
        sums = (h * _weighted(b, z) for z in (transported.along(*moves), by_force))
        return change - reduce(jnp.add, map(_times, base, (moves[2], *sums)))

    units = jnp.eye(s * n, dtype=stages.p.dtype).reshape(s * n, s, n)
    matrix = jnp.moveaxis(mapped(residual, units), 0, -1).reshape(s, n, s, n)
    inertia, gain, by_position, by_xi = _node_slopes(stages, x, path, w)
    mass_inverse = inverses(inertia)
    node_inverse, end_inverse = mass_inverse, mass_inverse[-1]
    if has_impulse_slopes and stages.invariants is not None:
        of_xi, of_u = _end_impulse_slopes(stages, x)
        node_inverse = inverses(inertia.at[-1].add(-of_u))
        if by_xi is None:
            by_position = by_position.at[-1].add(-of_xi)
        else:
            by_xi = by_xi.at[-1].add(-of_xi)
    return LinearisedStep(
        stages=inverse_by_blocks(matrix),
        transported=transported,
        conjugate=conjugate,
        node_inverse=node_inverse,
        end_inverse=end_inverse,
        node_gain=gain,
        node_position=by_position,
        node_xi=by_xi,
    )


def _stage_slopes(
    stages: StageEquations, x: StageUnknowns, path: _Path
) -> tuple[tuple[Array, Array], Slopes, Slopes, Slopes, Slopes | None]:
    """Differentiate Π, F, n and, for a Hamiltonian system, μ at the stages.

    The first result is the pair of the values n and F themselves.
    """
    system, args = stages.system, stages.args
    multipliers, xi = stages.multipliers(x), path.xi
    flat, hamiltonian = stages.manifold.is_flat, stages.hamiltonian

    def at(xi, increments):
        chart = path.chart(xi)
        y = chart.coordinates(increments)
        return chart, y, chart.positions(y)

    def dual(increments, velocity, u, xi):
        chart, y, q = at(xi, increments)
        if not hamiltonian:
            u = chart.body_velocities(y, velocity)
        w, p = jax.vmap(
            lambda t, q, u, lam: (
                total_force(system, t, q, u, lam, args),
                system.momentum(t, q, u, args),
            )
        )(stages.stage_times, q, u, multipliers)
        p, f = chart.to_chart(y, velocity, p, w)
        return p, f, chart.to_origin(y, w)

    def velocities(increments, u, xi):
        chart, y, q = at(xi, increments)
        v = jax.vmap(lambda t, q, u: system.velocity(t, q, u, args))(
            stages.stage_times, q, u
        )
        return chart.chart_velocities(y, v)

    given = [path.increments, x.velocity]
    given += [x.momentum] if hamiltonian else []
    given += [] if flat else [xi]

    def all_of(increments, velocity, *rest):
        u = rest[0] if hamiltonian else velocity
        at_xi = xi if flat else rest[-1]
        found = dual(increments, velocity, u, at_xi)
        return (*found, velocities(increments, u, at_xi)) if hamiltonian else found

    values, by = slopes(all_of, *given)
    forces = values[2], values[1]
    by_increment, by_velocity = by[:2]
    by_xi = [None] * len(by_velocity) if flat else by[-1]
    direct = [Slopes(*z) for z in zip(by_velocity, by_increment, by_xi, strict=True)]
    if not hamiltonian:
        momentum, force, transported = direct
        return forces, momentum, force, transported, None
    mass, of_velocity = inverses(by[2][3]), direct[3]
    conjugate = Slopes(
        mass,
        -_products(mass, of_velocity.by_increment),
        None if flat else -_products(mass, by[-1][3]),
    )
    momentum, force, transported = (
        slope.plus(by_momentum, conjugate)
        for slope, by_momentum in zip(direct[:3], by[2][:3], strict=True)
    )
    return forces, momentum, force, transported, conjugate


def _base_slopes(
    stages: StageEquations,
    x: StageUnknowns,
    path: _Path,
    transported: Float[Array, "s n"],
    force: Float[Array, "s n"],
) -> list[Array]:
    """Differentiate `base`, the term that all stage momenta Π_i have in common.

    The derivatives are with respect to ξ, to h Σ b_j n_j and to h Σ b_j F_j.
    """

    def base(xi, transported, force):
        chart = path.chart(xi)
        momentum = chart.momentum_at_origin(start_momentum(stages, x))
        return chart.base_momentum(momentum, transported, force)

    sums = [
        stages.h * small_einsum("s,sn->n", stages.coefficients("b"), z)
        for z in (transported, force)
    ]
    return [matrix[None] for matrix in slopes(base, path.xi, *sums)[1]]


def _node_slopes(
    stages: StageEquations,
    x: StageUnknowns,
    path: _Path,
    transported: Float[Array, "s n"],
) -> tuple[Array, Array | None, Array, Array | None]:
    """Differentiate the equations of the nodes in u, gained momenta, Ξ and ξ."""
    system, args, u = stages.system, stages.args, x.node_fibre_coordinate

    def momenta(increments, u, xi):
        chart = path.chart(xi)
        y = chart.coordinates(increments)
        return jax.vmap(lambda t, q, u: system.momentum(t, q, u, args))(
            stages.node_times, chart.positions(y), u
        )

    if stages.manifold.is_flat:
        _, (by_position, inertia) = slopes(
            lambda y, u: momenta(y, u, path.xi), path.node_increments, u
        )
        return inertia, None, by_position, None

    def residual(increments, u, gained, xi):
        chart = path.chart(xi)
        y = chart.coordinates(increments)
        start = chart.momentum_at_origin(start_momentum(stages, x))
        return momenta(increments, u, xi) - chart.from_origin(y, start[None] + gained)

    gained = stages.h * _weighted(stages.node_weights, transported)
    _, (by_position, inertia, by_gain, by_xi) = slopes(
        residual, path.node_increments, u, gained, path.xi
    )
    return inertia, -by_gain, by_position, by_xi


def _end_impulse_slopes(stages: StageEquations, x: StageUnknowns) -> tuple[Array, ...]:
    """Differentiate the impulse at the end of the step in ξ and in u at the end."""

    def impulse(xi, u):
        # The weights b_j have the sum 1, so that this change of velocities changes the
        # increment by xi.
        moved = x.velocity + xi[None] / stages.h
        nodes = jnp.concatenate([x.node_fibre_coordinate[:-1], u[None]])
        at = replace(x, velocity=moved, node_fibre_coordinate=nodes)
        return end_impulse(stages, at)

    u = x.node_fibre_coordinate[-1]
    return slopes(impulse, jnp.zeros_like(u), u)[1]


class ConstraintSlopes(eqx.Module):
    """The derivatives of all constraints at the nodes i >= 2, for given stages.

    The increments Ξ_i = h Σ a_ij H_j and ξ = h Σ b_j H_j determine the position of node
    i, and u_i is its fibre coordinate. `values` are the constraints on velocities,
    including the rates of holonomic constraints, and `positions` are the holonomic
    constraints.
    """

    values: tuple[Float[Array, "r l n"], ...]  # with respect to Ξ_i, ξ and u_i
    positions: tuple[Float[Array, "r k n"], ...]  # with respect to Ξ_i and ξ

    @classmethod
    def at(cls, stages: StageEquations, x: StageUnknowns) -> "ConstraintSlopes":
        """Differentiate the constraints at the nodes of the stages x."""
        path, u = _path(stages, x), x.node_fibre_coordinate
        system, args, times = stages.system, stages.args, stages.stage_times[1:]
        increments = path.increments[1:]
        if not stages.num_nonholonomic:
            u = jnp.broadcast_to(u, increments.shape)
        xi = jnp.broadcast_to(path.xi, increments.shape)

        def positions_of(increment, xi):
            chart = path.chart(xi)
            return chart.position(chart.coordinates(increment[None])[0])

        def values(increments, xi, u):
            return jax.vmap(
                lambda t, increment, xi, u: system.constraint(
                    t, positions_of(increment, xi), u, args
                )
            )(times, increments, xi, u)

        def positions(increments, xi):
            return jax.vmap(
                lambda t, increment, xi: system.position_constraint(
                    t, positions_of(increment, xi), args
                )
            )(times, increments, xi)

        of_positions = ()
        if stages.num_holonomic:
            of_positions = _rows(positions, increments, xi)
        return cls(_rows(values, increments, xi, u), of_positions)

    @property
    def jacobian(self) -> Float[Array, "r l n"]:
        """Return B_i = ∂Φ/∂u at the nodes."""
        return self.values[2]

    def along(
        self,
        stages: StageEquations,
        velocity: Float[Array, "s n"],
        at_nodes: Float[Array, "r n"],
    ) -> Float[Array, " e"]:
        """Compute the changes of the constraints for given changes of H and all u_i.

        If constraints are redundant, the changes are multiplied by the projector P of
        `Redundancy`.
        """
        h, m, k = stages.h, stages.num_nonholonomic, stages.num_holonomic
        increments = h * _weighted(stages.coefficients("a")[1:], velocity)
        xi = h * _weighted(stages.coefficients("b")[None], velocity)[0]

        def change(slopes, rows, nodes):
            by_increment = slopes[0][nodes, rows]
            moved = small_einsum("iln,in->il", by_increment, increments[nodes])
            if stages.manifold.is_flat:
                return moved
            return moved + small_einsum("iln,n->il", slopes[1][nodes, rows], xi)

        parts, kinds = [], []
        every = slice(None)
        if m:
            rows = slice(0, m)
            by_node = small_einsum("iln,in->il", self.jacobian[:, rows], at_nodes)
            parts.append(change(self.values, rows, every) + by_node)
            kinds.append(rows)
        if k:
            rows, last = slice(m, m + k), slice(-1, None)
            parts.append(change(self.positions, every, every) / h)
            by_node = small_einsum(
                "iln,in->il", self.jacobian[last, rows], at_nodes[last]
            )
            parts.append(change(self.values, rows, last) + by_node)
            kinds += [rows, rows]
        redundancy = stages.redundancy
        if redundancy is not None:
            parts = [
                small_einsum("ab,ib->ia", redundancy.projector[rows, rows], part)
                for rows, part in zip(kinds, parts, strict=True)
            ]
        return jnp.concatenate([x.reshape(-1) for x in parts])


def _rows(
    function: Callable[..., Float[Array, "r l"]], *args: Float[Array, "r n"]
) -> tuple[Float[Array, "r l n"], ...]:
    """Differentiate a function in each of its arguments by reverse mode.

    Row i of the value of `function` must depend only on row i of each argument.
    """
    value, pull = jax.vjp(function, *args)
    units = jnp.eye(value.shape[1], dtype=value.dtype)
    found = mapped(lambda unit: pull(jnp.broadcast_to(unit, value.shape)), units)
    return tuple(jnp.moveaxis(x, 0, 1) for x in found)


def inverse_of_schur(
    stages: StageEquations, schur: Float[Array, "c c"], num_kinematic: int
) -> Float[Array, "c c"]:
    """Invert the Schur complement of the multipliers, by blocks of constraints.

    The first `num_kinematic` unknowns form blocks of size m, the number of nonholonomic
    constraints. The other unknowns form blocks of size k, the number of holonomic
    constraints.
    """
    sizes = stages.num_nonholonomic, stages.num_holonomic

    def by_blocks(matrix, size):
        count = matrix.shape[0] // max(size, 1)
        blocks = matrix.reshape(count, size, count, size)
        return inverse_by_blocks(blocks).reshape(matrix.shape)

    def product(a, b):
        return small_einsum("ij,jk->ik", a, b)

    m = num_kinematic
    if m == 0:
        return by_blocks(schur, sizes[1])
    first = by_blocks(schur[:m, :m], sizes[0])
    if m == len(schur):
        return first
    left = product(schur[m:, :m], first)
    right = product(first, schur[:m, m:])
    last = by_blocks(schur[m:, m:] - product(left, schur[:m, m:]), sizes[1])
    lower = -product(last, left)
    upper = -product(right, last)
    top = jnp.concatenate([first - product(upper, left), upper], axis=1)
    return jnp.concatenate([top, jnp.concatenate([lower, last], axis=1)])


def reactions_at_stages(
    stages: StageEquations, x: StageUnknowns
) -> Float[Array, "s l n"]:
    """Compute the reactions at the stages, one row for each unit multiplier."""
    chart, y = stage_coordinates(stages, x)
    u = x.momentum
    if not stages.hamiltonian:
        u = chart.body_velocities(y, x.velocity)
    given = stages.stage_times, stage_positions(stages, chart, y), u
    covectors = jnp.moveaxis(_reactions(stages, *given), 0, 1)
    of_force = forces_by_multiplier(stages, x)
    return covectors if of_force is None else covectors + of_force


def reactions_at_end(stages: StageEquations, x: StageUnknowns) -> Float[Array, "l n"]:
    """Compute the reactions at the end of the step, a row for each unit multiplier."""
    time, u = stages.node_times[-1:], x.node_fibre_coordinate[-1:]
    end = end_position(stages, x)
    q = jax.tree.map(lambda leaf: leaf[None], end)
    covectors = _reactions(stages, time, q, u)[:, 0]
    if not stages.system.force_takes_multipliers:
        return covectors
    at_end = time[0], end, u[0], x.end_multiplier
    return covectors + force_by_multiplier(stages.system, *at_end, stages.args).T


def _reactions(
    stages: StageEquations, times: Array, q: PyTree[Array], u: Float[Array, "r n"]
) -> Float[Array, "l r n"]:
    def one(unit):
        return jax.vmap(
            lambda t, q, u: stages.system.reaction(t, q, u, unit, stages.args)
        )(times, q, u)

    return mapped(one, jnp.eye(stages.multiplier.shape[0], dtype=u.dtype))


def end_slopes(
    stages: StageEquations, x: StageUnknowns
) -> tuple[tuple[Array, Array], ...]:
    """Differentiate the equations of motion at the end in ξ and in u at the end."""
    given = _path(stages, x)

    def residual(xi, u):
        chart = given.chart(xi)
        return motion_residual(
            stages.system,
            stages.t + stages.h,
            chart.position(chart.ends[1] if not stages.manifold.is_flat else xi),
            u,
            x.end_acceleration,
            x.end_multiplier,
            stages.args,
        )

    found = slopes(residual, given.xi, x.node_fibre_coordinate[-1])[1]
    redundancy = stages.redundancy
    if redundancy is None:
        return found
    return tuple(
        (on_momentum, small_einsum("ab,bn->an", redundancy.projector, hidden))
        for on_momentum, hidden in found
    )
