"""The factors of the stage Jacobian, and the simplified Newton update that uses them.

The stage equations r(x) = 0 are solved by iterations `x -> x - J⁻¹ r(x)`. Simplified
Newton inverts a part of the Jacobian J once a step, in `factorise_stage_jacobian`: the
mass matrix and the Schur complement of the constraints at the start of the step, with
or without the terms of order h of `FirstOrderTerms`. With `FullFactors` it inverts all
of J at the starting values. Each `simplified_newton_update` then evaluates the stage
equations once and multiplies by these factors. The factors are stored as inverses,
because all matrices are tiny: a triangular solve inside an iteration costs far more
than a product.

The end of the file has the norms by which iterations measure their updates.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import FloatScalar
from .._numerics import (
    block_tridiagonal_inverse,
    compressed_products,
    DenseMatrix,
    DiagonalMatrix,
    inverse,
    InverseMatrix,
    mapped,
    max_norm,
    ReactionMatrix,
    small_einsum,
    SparsityPattern,
    SquareMatrix,
    UpdateNorms,
)
from .._system import Linearisation
from ._equations import (
    constraint_jacobian,
    constraint_values,
    end_residual,
    Evaluation,
    forces_by_multiplier,
    invariant_correction,
    invariant_errors,
    is_in_chart,
    momenta_of_forces,
    node_residual,
    sparse_constraint_jacobian,
    stage_forces,
    stage_velocities,
    StageEquations,
    StageResiduals,
    StageUnknowns,
)
from ._first_order import (
    first_order_terms,
    FirstOrderTerms,
    forces_have_slopes,
    JacobianName,
    uses_first_order_terms,
)
from ._full_jacobian import (
    ConstraintSlopes,
    end_slopes,
    inverse_of_schur,
    linearised_step,
    LinearisedStep,
    reactions_at_end,
    reactions_at_stages,
    StageResponses,
)
from ._invariants import InvariantCorrection


def simplified_newton_update(
    stages: StageEquations, factors: "StageJacobianFactors", x: StageUnknowns
) -> tuple[StageUnknowns, Evaluation]:
    """Compute the iterate after x, and return it with the evaluated residuals.

    Each residual is evaluated with the unknowns corrected so far (Gauss-Seidel). This
    costs the same as evaluating all residuals at x, and converges faster.
    """
    forces = stage_forces(stages, x)
    x_next = factors.correct_stages(stages, x, forces.residual)
    r_nodes = node_residual(stages, x_next, forces.force)
    change = x_next.velocity - x.velocity
    x_next = factors.correct_nodes(stages, x_next, r_nodes, change)
    if stages.invariants is not None:
        # The impulses are corrected first, so that the constraints are evaluated with
        # the corrected velocities. In the other order, the multipliers would ignore
        # this correction, along which the reactions do work. In a system nearly at rest
        # this work is not negligible.
        error = invariant_errors(stages, x_next)
        x_next = factors.correct_impulses(stages, x_next, error)
    if factors.full is not None:
        x_next = factors.full.correct_multipliers(stages, x_next)
        return x_next, Evaluation(forces, r_nodes, jnp.asarray(False))
    if stages.constrained:
        kinematic, holonomic = constraint_values(stages, x_next)
        x_next = factors.correct_multipliers(stages, x_next, kinematic, holonomic)
    if stages.end_multiplier_is_unknown:
        # λ_c at the end depends on v_{k+1} at zeroth order in h, so that it must be
        # corrected with the new velocity. Otherwise the errors of λ_c and v_{k+1} add
        # to each other, and an iteration reduces them only by the square root of the
        # usual factor.
        x_next = factors.correct_end(stages, x_next, end_residual(stages, x_next))
    return x_next, Evaluation(forces, r_nodes, jnp.asarray(False))


class MultiplierResponses(NamedTuple):
    """The changes of stages and nodes per unit change of each multiplier unknown.

    The last axis lists these unknowns: h δy and h δΛ, the changes of `closure` and
    `holonomic` in `StageUnknowns` times h. The responses are stored only if the terms
    of order h are used; they then give the Schur complement.
    """

    velocity: Float[Array, "s n c"]
    node_fibre_coordinate: Float[Array, "r n c"]


Linearised = Callable[[StageUnknowns], StageResiduals]


class FullFactors(eqx.Module):
    """The factors of the Jacobian of all stage equations.

    The unknowns for the multipliers are h δy and h δΛ, the changes of `closure` and
    `holonomic` in `StageUnknowns` times h. With the symmetric closure there is also
    h δλ_c, where λ_c is the continuous multiplier at the end of the step. A change
    h δλ_c includes the change of y that leaves the nodes unchanged to leading order.
    """

    step: LinearisedStep
    responses: StageResponses | None
    schur_inverse: Float[Array, "c c"]
    end: Linearisation
    end_slopes: tuple[tuple[Array, Array], ...] | None  # with respect to ξ and u
    slopes: ConstraintSlopes | None
    unknowns: StageUnknowns

    def correct_stages(
        self, stages: StageEquations, x: StageUnknowns, residual: Float[Array, "s n"]
    ) -> StageUnknowns:
        """Correct the stages: solve their linearised equations at fixed multipliers."""
        velocity, momentum = self.step.of_stages(stages, residual)
        moved = replace(x, velocity=x.velocity - velocity)
        if not stages.hamiltonian:
            return moved
        moved = replace(moved, momentum=x.momentum - momentum)
        return replace(moved, velocity=stage_velocities(stages, moved))

    def correct_multipliers(
        self, stages: StageEquations, x: StageUnknowns
    ) -> StageUnknowns:
        """Change the multipliers so that the linearised constraints hold.

        With the symmetric closure, the linearised equations of motion at the end of the
        step then hold too.
        """
        if self.responses is None:
            return x
        residuals = [value.reshape(-1) for value in constraint_values(stages, x)]
        m = stages.num_nonholonomic
        acceleration, multiplier = x.end_acceleration, x.end_multiplier
        first = m * (self.end_slopes is not None)
        if self.end_slopes is not None:
            on_momentum, hidden = end_residual(stages, x)
            da, dlam = self.end.solve(-on_momentum, -hidden)
            acceleration, multiplier = acceleration + da, multiplier + dlam
            residuals = [-stages.h * dlam[:m], *residuals]
        change = -small_einsum(
            "kc,c->k", self.schur_inverse, jnp.concatenate(residuals)
        )
        last = first + x.closure.size
        h_dy = change[first:last].reshape(x.closure.shape)
        h_dholonomic = change[last:].reshape(x.holonomic.shape)
        velocity, momentum, at_nodes = (
            small_einsum("inc,c->in", response, change) for response in self.responses
        )
        dy = h_dy / stages.h
        if self.end_slopes is not None:
            dlam_c = change[:m] / stages.h
            dy = dy + jnp.outer(stages.closure_weights("response"), dlam_c)
            da, dlam_end = self.end_change(stages, velocity, at_nodes[-1])
            acceleration, multiplier = acceleration + da, multiplier + dlam_end
        return replace(
            x,
            velocity=x.velocity + velocity,
            momentum=x.momentum + momentum,
            node_fibre_coordinate=x.node_fibre_coordinate + at_nodes,
            closure=x.closure + dy,
            holonomic=x.holonomic + h_dholonomic / stages.h,
            end_acceleration=acceleration,
            end_multiplier=multiplier,
        )

    def solve(
        self, stages: StageEquations, push: Linearised, r: StageResiduals
    ) -> StageUnknowns:
        """Solve the linearised equations J dx = r with constant impulses.

        `push` multiplies by J at the `unknowns` of these factors.
        """
        h, m = stages.h, stages.num_nonholonomic
        momentum = jnp.zeros_like(r.momentum)[:, :0]
        if r.velocity is not None:
            # A change of the stage momenta μ, computed with the matrix (∂v/∂μ)⁻¹,
            # cancels the residuals of the velocities.
            assert self.step.conjugate is not None
            matrices = self.step.conjugate.by_velocity
            momentum = -small_einsum("ikn,in->ik", matrices, r.velocity)
            zero = jax.tree.map(jnp.zeros_like, self.unknowns)
            changed = push(replace(zero, momentum=momentum))
            r = jax.tree.map(jnp.subtract, r, changed)
        velocity, conjugate = self.step.of_stages(stages, r.momentum)
        momentum = momentum + conjugate
        at_nodes = self.step.by_position(stages, velocity) - r.node
        at_nodes = self.step.of_nodes(stages, at_nodes, velocity)
        dx = replace(
            jax.tree.map(jnp.zeros_like, self.unknowns),
            velocity=velocity,
            momentum=momentum,
            node_fibre_coordinate=at_nodes,
        )
        if self.responses is None:
            return dx
        assert self.slopes is not None
        wanted = jnp.concatenate([r.kinematic.reshape(-1), r.holonomic.reshape(-1)])
        wanted = wanted - self.slopes.along(stages, velocity, at_nodes)
        first, of_end = 0, None
        if r.end is not None:
            first = m
            of_end = self.end_change(stages, velocity, at_nodes[-1], r.end)
            wanted = jnp.concatenate([h * of_end[1][:m], wanted])
        change = small_einsum("kc,c->k", self.schur_inverse, wanted)
        last = first + dx.closure.size
        moved = [small_einsum("inc,c->in", z, change) for z in self.responses]
        dy = change[first:last].reshape(dx.closure.shape) / h
        dx = replace(
            dx,
            velocity=velocity + moved[0],
            momentum=momentum + moved[1],
            node_fibre_coordinate=at_nodes + moved[2],
            closure=dy,
            holonomic=change[last:].reshape(dx.holonomic.shape) / h,
        )
        if of_end is None:
            return dx
        by_moves = self.end_change(stages, moved[0], moved[2][-1])
        return replace(
            dx,
            closure=dy + jnp.outer(stages.closure_weights("response"), change[:m] / h),
            end_acceleration=of_end[0] + by_moves[0],
            end_multiplier=of_end[1] + by_moves[1],
        )

    def end_change(
        self,
        stages: StageEquations,
        velocity: Float[Array, "s n"],
        u: Float[Array, " n"],
        residual: tuple[Float[Array, " n"], Float[Array, " l"]] | None = None,
    ) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
        """Compute the changes of acceleration and λ_c at the end of the step.

        The stage velocities change by `velocity`, and the fibre coordinate at the end
        changes by `u`. The residuals of the equations of motion at the end change by
        `residual`, or by zero if it is None.
        """
        assert self.end_slopes is not None
        b = stages.coefficients("b")
        xi = stages.h * small_einsum("s,sn->n", b, velocity)
        found = _end_change(self.end, self.end_slopes, xi, u)
        if residual is None:
            return found
        of_residual = self.end.solve(*residual)
        return found[0] + of_residual[0], found[1] + of_residual[1]


class NewtonFactors(eqx.Module):
    """The factors of the Jacobian of all equations of a step at given unknowns.

    If the run keeps invariants, the impulses are eliminated last. Row k of `impulses`
    is a change of all unknowns with a unit impulse for invariant k. This change leaves
    all residuals unchanged, except the residuals of the equations for the impulses. The
    changes of these residuals form a matrix, whose inverse is `schur_inverse`. Without
    invariants `impulses` and `schur_inverse` are None.
    """

    full: FullFactors
    impulses: StageUnknowns | None
    schur_inverse: Float[Array, "k k"] | None

    @classmethod
    def at(
        cls,
        stages: StageEquations,
        x: StageUnknowns,
        lin: Linearisation,
        push: Linearised,
    ) -> "NewtonFactors":
        """Factorise the Jacobian J at the unknowns x; `push` multiplies by J."""
        full = full_factors(stages, x, lin, has_impulse_slopes=True)
        if stages.invariants is None:
            return cls(full, None, None)

        def along(unit):
            dx = replace(jax.tree.map(jnp.zeros_like, x), impulse=unit)
            others = full.solve(stages, push, push(dx))
            dx = replace(jax.tree.map(jnp.negative, others), impulse=unit)
            return dx, push(dx).impulse

        units = jnp.eye(x.impulse.shape[0], dtype=stages.p.dtype)
        impulses, rows = mapped(along, units)
        return cls(full, impulses, inverse(rows.T))

    def solve(
        self, stages: StageEquations, push: Linearised, r: StageResiduals
    ) -> StageUnknowns:
        """Solve the linearised equations J dx = r."""
        dx = self.full.solve(stages, push, r)
        if self.impulses is None:
            return dx
        assert self.schur_inverse is not None
        changed = push(dx).impulse
        assert r.impulse is not None
        assert changed is not None
        left = r.impulse - changed
        impulse = small_einsum("kl,l->k", self.schur_inverse, left)

        def with_impulses(z, columns):
            weights = impulse.reshape(-1, *[1] * z.ndim)
            return z + jnp.sum(weights * columns, axis=0)

        return jax.tree.map(with_impulses, dx, self.impulses)


class StageJacobianFactors(eqx.Module):
    """A part of the Jacobian of the stage equations of one step, factorised.

    `Linearisation` defines N, K and B. With N and K at the start of the step, B_i at
    the nodes of given stages, R_ij the `node_rows` of a_ij, the residuals r and the
    change δΛ of all multipliers, the fibre coordinates change by

    δu_i = -N⁻¹ r_u + h Σ_j â_ij K⁻¹ B_jᵀ δΛ_j        (stages),
    δu_i = -N⁻¹ r_v + h Σ_j R_ij K⁻¹ B_jᵀ δΛ_j        (nodes).

    The constraints require B_i δu_i = -r_Φ at the nodes, Σ_j a_ij B_i δu_j = -r_Γ at
    the positions, and B_s δu_s = -r for the rate of the holonomic constraints at the
    end of the step. These three conditions give a Schur complement for the unknowns
    h δy of the closure and h δΛ of the holonomic constraints. For small h this matrix
    is invertible by hypothesis H2 and the compatibility condition. The symmetric
    closure adds ±ν, with an unknown ν, to the last multiplier. The matrix is invertible
    for only one of these signs; see `docs/closures.md`.

    With `first_order`, the terms of order h are added to N⁻¹ r. The changes that
    multipliers cause are then stored as `responses`, which include these terms.
    With `full`, the factors of the full Jacobian replace all other fields except
    `impulses`.
    """

    momentum_inverse: SquareMatrix
    reaction: ReactionMatrix
    velocity_reaction: ReactionMatrix
    schur_inverse: InverseMatrix
    end: Linearisation
    impulses: InvariantCorrection | None = None
    first_order: FirstOrderTerms | None = None
    responses: MultiplierResponses | None = None
    full: FullFactors | None = None

    def correct_stages(
        self, stages: StageEquations, x: StageUnknowns, residual: Float[Array, "s n"]
    ) -> StageUnknowns:
        """Return x with u - N⁻¹ r_u at the stages, and the resulting velocities."""
        if self.full is not None:
            return self.full.correct_stages(stages, x, residual)
        change = self.momentum_inverse.matvec(residual)
        if self.first_order is not None:
            change = self.first_order.of_stages(stages, change)
        if not stages.hamiltonian:
            return eqx.tree_at(lambda z: z.velocity, x, x.velocity - change)
        x = eqx.tree_at(lambda z: z.momentum, x, x.momentum - change)
        return eqx.tree_at(lambda z: z.velocity, x, stage_velocities(stages, x))

    def correct_nodes(
        self,
        stages: StageEquations,
        x: StageUnknowns,
        residual: Float[Array, "r n"],
        change: Float[Array, "s n"],
    ) -> StageUnknowns:
        """Return x with the fibre coordinates u - N⁻¹ r_v at the nodes.

        The residual was evaluated at positions that include the `change` of the stage
        velocities, but with forces that do not. The terms of order h, and the full
        factors, add the effect of this change on the forces.
        """
        if self.full is not None:
            du = self.full.step.of_nodes(stages, residual, change)
            return replace(x, node_fibre_coordinate=x.node_fibre_coordinate + du)
        du = -self.momentum_inverse.matvec(residual)
        if self.first_order is not None:
            du = self.first_order.of_nodes(du)
            du = du + self.first_order.by_force(stages, change)
        at_nodes = x.node_fibre_coordinate + du
        return eqx.tree_at(lambda z: z.node_fibre_coordinate, x, at_nodes)

    def correct_multipliers(
        self,
        stages: StageEquations,
        x: StageUnknowns,
        kinematic: Float[Array, "r m"] | Float[Array, "0"],
        holonomic: Float[Array, "s k"] | Float[Array, "0"],
    ) -> StageUnknowns:
        """Change the free multipliers so that the linearised constraints hold."""
        residual = jnp.concatenate([kinematic.reshape(-1), holonomic.reshape(-1)])
        change = -self.schur_inverse.matvec(residual)
        h_dy = change[: x.closure.size].reshape(x.closure.shape)
        h_dholonomic = change[x.closure.size :].reshape(x.holonomic.shape)
        if self.responses is not None:
            velocity, at_nodes = self.responses
            return replace(
                x,
                velocity=x.velocity + small_einsum("inc,c->in", velocity, change),
                node_fibre_coordinate=x.node_fibre_coordinate
                + small_einsum("inc,c->in", at_nodes, change),
                closure=x.closure + h_dy / stages.h,
                holonomic=x.holonomic + h_dholonomic / stages.h,
            )
        h_dlambda = stages.free_multipliers(h_dy, h_dholonomic)
        # `push` is h K⁻¹ Bᵀ δΛ; only the multipliers need a division by h.
        push = self.reaction.matvec(h_dlambda)
        a_hat, momentum = stages.coefficients("a_hat"), x.momentum
        velocity_push = push
        if stages.hamiltonian:
            velocity_push = self.velocity_reaction.matvec(h_dlambda)
            momentum = momentum + small_einsum("ij,jn->in", a_hat, push)
        return replace(
            x,
            velocity=x.velocity + small_einsum("ij,jn->in", a_hat, velocity_push),
            momentum=momentum,
            node_fibre_coordinate=x.node_fibre_coordinate
            + small_einsum("ij,jn->in", stages.node_weights, push),
            closure=x.closure + h_dy / stages.h,
            holonomic=x.holonomic + h_dholonomic / stages.h,
        )

    def correct_end(
        self,
        stages: StageEquations,
        x: StageUnknowns,
        residual: tuple[Float[Array, " n"], Float[Array, " l"]],
    ) -> StageUnknowns:
        """Correct the acceleration and λ_c at the end of the step.

        The unknowns of the closure change with λ_c, so that the nodes stay the same to
        leading order. Otherwise the nodes would violate their constraints again, and
        this would cost another iteration.
        """
        momentum_residual, hidden_residual = residual
        da, dlam = self.end.solve(-momentum_residual, -hidden_residual)
        m = stages.num_nonholonomic
        dlam_closure = dlam[:m]
        response, on_stages = map(
            stages.closure_weights, ("response", "stage_response")
        )

        def pushed(u: Array, reaction: ReactionMatrix) -> Array:
            last = reaction[-1].first_columns(m)
            return u + jnp.outer(on_stages, stages.h * last.matvec(dlam_closure))

        momentum = x.momentum
        if stages.hamiltonian:
            momentum = pushed(momentum, self.reaction)
        return replace(
            x,
            velocity=pushed(x.velocity, self.velocity_reaction),
            momentum=momentum,
            closure=x.closure + jnp.outer(response, dlam_closure),
            end_acceleration=x.end_acceleration + da,
            end_multiplier=x.end_multiplier + dlam,
        )

    def correct_impulses(
        self, stages: StageEquations, x: StageUnknowns, error: Float[Array, " k"]
    ) -> StageUnknowns:
        """Change impulses ε so that the linearised equations of the invariants hold.

        The stages and nodes change with ε, so that their momentum equations, which have
        just been solved, still hold to leading order.
        """
        weights = self.impulses
        assert weights is not None
        change = weights.change(x.impulse, error)
        start, velocity, end = (
            small_einsum("k,kn->n", change, direction)
            for direction in (weights.start, weights.velocity, weights.end)
        )
        momentum = x.momentum
        if stages.hamiltonian:
            momentum = momentum + start[None]
        at_nodes = x.node_fibre_coordinate + start[None]
        return replace(
            x,
            velocity=x.velocity + velocity[None],
            momentum=momentum,
            node_fibre_coordinate=jnp.concatenate(
                [at_nodes[:-1], at_nodes[-1:] + end[None]]
            ),
            impulse=x.impulse + change,
        )


# The factors.


def factorise_stage_jacobian(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    jacobian: JacobianName,
) -> StageJacobianFactors:
    """Factorise the stage Jacobian, with N, K at the start of the step and B_i at x.

    `StageJacobianFactors` explains N, K and B_i. `jacobian` selects the part of the
    Jacobian, as for `SimplifiedNewton`. With `"full"`, all derivatives are taken at x.
    """
    factors = _factors_without_impulses(stages, x, lin, jacobian)
    if stages.invariants is None:
        return factors
    return replace(factors, impulses=invariant_correction(stages, x))


def _factors_without_impulses(
    stages: StageEquations, x: StageUnknowns, lin: Linearisation, jacobian: JacobianName
) -> StageJacobianFactors:
    if jacobian == "full":
        return _with_full_factors(stages, x, lin)
    terms = None
    if uses_first_order_terms(stages, lin, jacobian):
        terms = first_order_terms(stages, x, lin)
    if not stages.constrained:
        n, dtype = stages.p.shape[0], stages.p.dtype
        reaction = DenseMatrix(jnp.zeros((stages.method.stages, n, 0), dtype))
        schur_inverse = DenseMatrix(jnp.zeros((0, 0), dtype))
        given = lin.momentum_inverse, reaction, reaction, schur_inverse, lin
        return StageJacobianFactors(*given, first_order=terms)
    if lin.jacobian.pattern is not None:
        return _sparse_factors(stages, x, lin, lin.jacobian.pattern)
    at_nodes = constraint_jacobian(stages, x)
    rows = jnp.concatenate([lin.jacobian.as_matrix()[None], at_nodes])
    if terms is not None:
        return _first_order_factors(stages, x, lin, rows, terms)
    return _dense_factors(stages, x, lin, rows)


def _dense_factors(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    jacobian: Float[Array, "s l n"],
) -> StageJacobianFactors:
    """Compute the factors from the Jacobians B of the constraints at all stages."""
    reaction = (
        DenseMatrix(jacobian).weighted_transpose(lin.fibre_hessian_inverse).entries
    )
    of_force = forces_by_multiplier(stages, x)
    if of_force is not None:
        pushed = lin.momentum_inverse.matvec(of_force)
        reaction = reaction + jnp.swapaxes(pushed, 1, 2)
    rows, redundancy = jacobian[1:], stages.redundancy
    if redundancy is not None:
        rows = small_einsum("ab,ibn->ian", redundancy.projector, rows)
    blocks = small_einsum("ian,jnb->ijab", rows, reaction)
    schur, delassus = _schur_complement(stages, blocks), blocks[-1, -1]
    if redundancy is not None:
        delassus = delassus + redundancy.rest
        schur = schur + redundancy.schur_rest(
            stages.method.stages, stages.num_nonholonomic
        )
    velocity_reaction = reaction
    if stages.hamiltonian:
        velocity_reaction = jnp.swapaxes(jacobian, 1, 2)
        if of_force is not None:
            hessian = inverse(lin.fibre_hessian_inverse.as_matrix())
            by_force = small_einsum("kn,iln->ikl", hessian, of_force)
            velocity_reaction = velocity_reaction + by_force
    return StageJacobianFactors(
        momentum_inverse=lin.momentum_inverse,
        reaction=DenseMatrix(reaction),
        velocity_reaction=DenseMatrix(velocity_reaction),
        schur_inverse=DenseMatrix(inverse(schur)),
        end=replace(
            lin,
            jacobian=DenseMatrix(rows[-1]),
            reaction=DenseMatrix(reaction[-1]),
            delassus_inverse=DenseMatrix(inverse(delassus)),
        ),
    )


def _schur_complement(
    stages: StageEquations, blocks: Float[Array, "r s l l"]
) -> Float[Array, "c c"]:
    """Assemble the derivative of the constraints with respect to h y and h Λ.

    y and Λ are `closure` and `holonomic` of `StageUnknowns`. `blocks` are the products
    B_i K⁻¹ B_jᵀ for i >= 2 and all j.
    """
    m, k, s = stages.num_nonholonomic, stages.num_holonomic, stages.method.stages
    a, a_hat, b = (stages.coefficients(name) for name in ("a", "a_hat", "b"))
    rows = []
    if m:
        nodes = small_einsum("ij,ijab->iajb", a[1:], blocks[:, :, :m])
        rows.append(nodes.reshape((s - 1) * m, s, m + k))
    if k:
        positions = small_einsum(
            "ij,ijab->iajb", small_einsum("ik,kj->ij", a[1:], a_hat), blocks[:, :, m:]
        )
        rows.append(positions.reshape((s - 1) * k, s, m + k))
        rows.append(small_einsum("j,jab->ajb", b, blocks[-1, :, m:]))
    change = jnp.concatenate(rows)
    columns = []
    if m:
        closure = small_einsum(
            "cjb,jl->clb", change[:, :, :m], stages.closure_weights("E")
        )
        columns.append(closure.reshape(change.shape[0], -1))
    if k:
        columns.append(change[:, :, m:].reshape(change.shape[0], -1))
    return jnp.concatenate(columns, axis=1)


def _sparse_factors(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    pattern: SparsityPattern,
) -> StageJacobianFactors:
    """Compute the factors as sparse matrices with the given `pattern`."""
    nodes = sparse_constraint_jacobian(stages, x, pattern)
    rows = nodes.stacked_after(lin.jacobian)
    reaction = rows.weighted_transpose(lin.fibre_hessian_inverse)
    products = compressed_products(rows[1:], reaction)
    a, a_hat, b = (stages.coefficients(name) for name in ("a", "a_hat", "b"))
    if stages.num_nonholonomic:
        weights = a[1:, :, None] * stages.closure_weights("E")[None]
        schur = small_einsum("ijk,ijcbl->ikcbl", weights, products)
    else:
        weights = small_einsum("ik,kj->ij", a[1:], a_hat)
        on_positions = weights[:, :, None, None, None] * products
        on_rate = b[:, None, None, None] * products[-1]
        schur = jnp.concatenate([on_positions, on_rate[None]])
    end = replace(
        lin,
        jacobian=rows[-1],
        reaction=reaction[-1],
        delassus_inverse=block_tridiagonal_inverse(products[-1:, -1:], pattern),
    )
    velocity_reaction = reaction
    if stages.hamiltonian:
        ones = DiagonalMatrix(jnp.ones_like(stages.p))
        velocity_reaction = rows.weighted_transpose(ones)
    return StageJacobianFactors(
        momentum_inverse=lin.momentum_inverse,
        reaction=reaction,
        velocity_reaction=velocity_reaction,
        schur_inverse=block_tridiagonal_inverse(schur, pattern),
        end=end,
    )


def _first_order_factors(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    jacobian: Float[Array, "s l n"],
    terms: FirstOrderTerms,
) -> StageJacobianFactors:
    """Compute the factors with the terms of order h."""
    of_force, covectors = forces_by_multiplier(stages, x), jacobian
    if of_force is not None:
        covectors = jacobian + of_force
    reaction = DenseMatrix(covectors).weighted_transpose(lin.fibre_hessian_inverse)
    momenta = momenta_of_forces(stages, x, _reactions(stages, covectors))
    on_stages, on_nodes = (
        jnp.swapaxes(lin.momentum_inverse.matvec(jnp.swapaxes(p, 1, 2)), 1, 2)
        for p in momenta
    )
    velocity = terms.of_stages(stages, on_stages)
    at_nodes = terms.of_nodes(on_nodes) + terms.by_force(stages, velocity)
    at_nodes = at_nodes + terms.by_position(stages, velocity)

    def constraints(velocity, at_nodes):
        moved = replace(x, velocity=velocity, node_fibre_coordinate=at_nodes)
        return jnp.concatenate(
            [value.reshape(-1) for value in constraint_values(stages, moved)]
        )

    _, push = jax.linearize(constraints, x.velocity, x.node_fibre_coordinate)
    schur = jax.vmap(push, in_axes=2, out_axes=1)(velocity, at_nodes)
    return StageJacobianFactors(
        momentum_inverse=lin.momentum_inverse,
        reaction=reaction,
        velocity_reaction=reaction,
        schur_inverse=DenseMatrix(inverse(schur)),
        end=_with_mass_at_end(lin, terms, jacobian[-1], covectors[-1]),
        first_order=terms,
        responses=MultiplierResponses(velocity, at_nodes),
    )


class ForceSlopeError(ValueError):
    """The full Jacobian needs a derivative that a force does not have."""


def _with_full_factors(
    stages: StageEquations, x: StageUnknowns, lin: Linearisation
) -> StageJacobianFactors:
    if not forces_have_slopes(stages):
        raise ForceSlopeError(
            '`SimplifiedNewton(jacobian="full")` needs derivatives of forces in forward'
            " mode, which callbacks and functions with a rule for reverse mode only do "
            'not have; use "leading" or None.'
        )
    s, n, dtype = stages.method.stages, stages.p.shape[0], stages.p.dtype
    reaction = DenseMatrix(jnp.zeros((s, n, 0), dtype))
    none = DenseMatrix(jnp.zeros((0, 0), dtype))
    given = lin.momentum_inverse, reaction, reaction, none, lin
    return StageJacobianFactors(*given, full=full_factors(stages, x, lin))


def full_factors(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    *,
    has_impulse_slopes: bool = False,
) -> FullFactors:
    """Compute the factors of the Jacobian of all equations at the stages x.

    `has_impulse_slopes` is passed on to `linearised_step`.
    """
    step = linearised_step(stages, x, has_impulse_slopes=has_impulse_slopes)
    s, dtype = stages.method.stages, stages.p.dtype
    h, m, redundancy = stages.h, stages.num_nonholonomic, stages.redundancy
    if not stages.constrained:
        return FullFactors(step, None, jnp.zeros((0, 0), dtype), lin, None, None, x)
    slopes = ConstraintSlopes.at(stages, x)
    covectors = reactions_at_stages(stages, x)
    pushes = _reactions(stages, covectors)
    end, end_by = lin, None
    if stages.end_multiplier_is_unknown:
        end = _end_of_full(stages, x, lin, step, slopes.jacobian[-1])
        end_by = end_slopes(stages, x)
        weights = small_einsum(
            "sr,r->s", stages.closure_weights("E"), stages.closure_weights("response")
        ) + stages.closure_weights("end")
        of_end = weights[:, None, None] * jnp.swapaxes(covectors[:, :m], 1, 2)
        pushes = jnp.concatenate([of_end, pushes], axis=2)

    def column(push):
        response = step.response(stages, x, push)
        at_nodes = response.node_fibre_coordinate
        change = slopes.along(stages, response.velocity, at_nodes)
        if end_by is None:
            return response, change
        b = stages.coefficients("b")
        xi = h * small_einsum("s,sn->n", b, response.velocity)
        _, dlam = _end_change(end, end_by, xi, at_nodes[-1])
        return response, jnp.concatenate([-h * dlam[:m], change])

    # `mapped` loops over the multipliers, so that the program stays short.
    forces = jnp.moveaxis(pushes, 2, 0)
    found, columns = mapped(column, forces)
    responses = jax.tree.map(lambda z: jnp.moveaxis(z, 0, -1), found)
    schur, num_end = columns.T, m * (end_by is not None)
    if redundancy is not None:
        rest = redundancy.schur_rest(s, m)
        schur = schur + jnp.pad(rest, ((num_end, 0), (num_end, 0)))
    if end_by is not None:
        free = schur.shape[0] - m
        schur = schur + jnp.pad(jnp.eye(m, dtype=dtype), ((0, free), (0, free)))
    schur_inverse = inverse_of_schur(stages, schur, num_end + x.closure.size)
    return FullFactors(step, responses, schur_inverse, end, end_by, slopes, x)


def _end_change(
    end: Linearisation,
    end_slopes: tuple[tuple[Array, Array], ...],
    xi: Float[Array, " n"],
    u: Float[Array, " n"],
) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
    """Compute how acceleration and λ_c at the end change with ξ and u.

    ξ is the increment of the step, and u the fibre coordinate at its end.
    """
    by_moves = (
        small_einsum("kn,n->k", by_xi, xi) + small_einsum("kn,n->k", by_u, u)
        for by_xi, by_u in zip(*end_slopes, strict=True)
    )
    return end.solve(*(-part for part in by_moves))


def _end_of_full(
    stages: StageEquations,
    x: StageUnknowns,
    lin: Linearisation,
    step: LinearisedStep,
    jacobian: Float[Array, "l n"],
) -> Linearisation:
    """Return a linearisation with the matrices at the end of the step."""
    at_end = reactions_at_end(stages, x)
    reaction = small_einsum("kn,ln->kl", step.end_inverse, at_end)
    rows, rest, redundancy = jacobian, 0.0, stages.redundancy
    if redundancy is not None:
        rows = small_einsum("ab,bn->an", redundancy.projector, jacobian)
        rest = redundancy.rest
    inverse_mass = lin.fibre_hessian_inverse
    if not stages.hamiltonian:
        inverse_mass = DenseMatrix(step.end_inverse)
    delassus = small_einsum("kn,nl->kl", rows, reaction) + rest
    return replace(
        lin,
        fibre_hessian_inverse=inverse_mass,
        jacobian=DenseMatrix(rows),
        reaction=DenseMatrix(reaction),
        delassus_inverse=DenseMatrix(inverse(delassus)),
    )


def _reactions(
    stages: StageEquations, jacobian: Float[Array, "s l n"]
) -> Float[Array, "s n c"]:
    """Compute the reactions at the stages for unit values of the multiplier unknowns.

    The unknowns are `closure` and `holonomic` of `StageUnknowns`.
    """
    m, one = stages.num_nonholonomic, jnp.eye(len(jacobian), dtype=jacobian.dtype)
    weights = stages.closure_weights("E")
    parts = [
        small_einsum("jmn,jr->jnrm", jacobian[:, :m], weights),
        small_einsum("jkn,ji->jnik", jacobian[:, m:], one),
    ]
    columns = [x.reshape(*x.shape[:2], x.shape[2] * x.shape[3]) for x in parts]
    return jnp.concatenate(columns, axis=2)


def _with_mass_at_end(
    lin: Linearisation,
    terms: FirstOrderTerms,
    jacobian: Float[Array, "l n"],
    covectors: Float[Array, "l n"],
) -> Linearisation:
    """Return a linearisation with mass matrix and constraints at the end of the step.

    With the matrices at the start, u̇ and λ_c at the end would converge no faster than
    without the terms of order h.
    """
    at_start = lin.momentum_inverse.as_matrix()
    change = small_einsum("kl,ln->kn", terms.node_inertia[-1], at_start)
    at_end = at_start - change
    reaction = small_einsum("kn,ln->kl", at_end, covectors)
    delassus = small_einsum("kn,nl->kl", jacobian, reaction)
    return replace(
        lin,
        fibre_hessian_inverse=DenseMatrix(at_end),
        jacobian=DenseMatrix(jacobian),
        reaction=DenseMatrix(reaction),
        delassus_inverse=DenseMatrix(inverse(delassus)),
    )


# The norms of updates.


def update_norms(
    stages: StageEquations, x: StageUnknowns, x_next: StageUnknowns, lin: Linearisation
) -> UpdateNorms:
    """Measure an increment and the fibre coordinates of the next iterate.

    The increment is measured at all stages and nodes, but the size of the coordinates
    only at the end of the step: this is enough for a scale, and takes less time.
    """
    increment = increment_size(stages, x, x_next, lin)
    return UpdateNorms(increment, max_norm(x_next.node_fibre_coordinate[-1]))


def fibre_coordinate_size(stages: StageEquations, x: StageUnknowns) -> FloatScalar:
    """Return the smaller of the max norms of the stage and node fibre coordinates.

    While an iteration is far from a solution, one of the two norms can be much larger
    than the other, and is then not a useful size.
    """
    u = x.momentum if stages.hamiltonian else x.velocity
    return jnp.minimum(max_norm(u), max_norm(x.node_fibre_coordinate))


def increment_size(
    stages: StageEquations, x: StageUnknowns, x_next: StageUnknowns, lin: Linearisation
) -> FloatScalar:
    """Measure an increment by its largest change of fibre coordinates.

    The size is infinite once the iterates have left the chart.
    """
    changes = [
        x_next.node_fibre_coordinate - x.node_fibre_coordinate,
        x_next.velocity - x.velocity,
    ]
    if stages.hamiltonian:
        changes[1] = lin.fibre_hessian_inverse.matvec(changes[1])
        changes.append(x_next.momentum - x.momentum)
    if stages.constrained:
        # Multipliers are measured by their effect h N⁻¹ R δΛ on u (N⁻¹ R is
        # `lin.reaction`), separately from the changes of u itself: Λ can still be wrong
        # where the stages and nodes happen to be right.
        before, after = map(stages.multiplier_change, (x, x_next))
        # With one constraint, the matrix has one column. Its largest entry gives the
        # same norm for less work.
        reaction = lin.reaction.max_norm_equivalent()
        changes.append(stages.h * reaction.matvec(after - before))
    size = max_norm(*changes)
    if stages.manifold.is_flat:
        return size
    return jnp.where(is_in_chart(stages, x_next), size, jnp.inf)
