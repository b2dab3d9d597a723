from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics import (
    block_tridiagonal_inverse,
    BlockTridiagonalInverse,
    couplings,
    inverse,
    Matrix,
    matvec,
    small_einsum,
    SparseMatrix,
    WeightedTranspose,
)
from .._system import Linearisation
from ._invariants import ImpulseWeights
from ._stage_equations import (
    constraint_jacobian,
    impulse_weights,
    sparse_constraint_jacobian,
    stage_velocities,
)
from ._stage_system import StageSystem
from ._unknowns import Stages


class LeadingStructure(eqx.Module):
    """The leading part of the linearised stage equations of one step, factorised.

    It serves as the Jacobian of simplified Newton. With N and K at the start of the
    step, B_i at the nodes of given stages, R the node rows of a_ij and δΛ the change of
    all multipliers, the unknowns change by

    δu_i = -N⁻¹ r_u + h Σ_j â_ij K⁻¹ B_jᵀ δΛ_j        (stages),
    δu_i = -N⁻¹ r_v + h Σ_j R_ij K⁻¹ B_jᵀ δΛ_j        (nodes),

    and the constraints require B_i δu_i = -r_Φ at the nodes, Σ_j a_ij B_i δu_j = -r_Γ
    at the positions, and B_s δu_s = -r for the tangency at the end of the step. These
    three give a Schur complement for the unknowns h δy of the closure and h δΛ of the
    holonomic constraints. For small h it is invertible by hypothesis H2 (for the
    symmetric closure by the sign of ν) and the compatibility condition.
    """

    momentum_inverse: Matrix
    reaction: Float[Array, "s n l"] | WeightedTranspose
    velocity_reaction: Float[Array, "s n l"] | WeightedTranspose
    schur_inverse: Float[Array, "c c"] | BlockTridiagonalInverse
    end: Linearisation
    impulses: ImpulseWeights | None = None

    def correct_stages(
        self, stages: StageSystem, x: Stages, residual: Float[Array, "s n"]
    ) -> Stages:
        """Compute u - N⁻¹ r_u for the stages, and the velocities that belong to it."""
        change = matvec(self.momentum_inverse, residual)
        if not stages.hamiltonian:
            return eqx.tree_at(lambda z: z.velocity, x, x.velocity - change)
        x = eqx.tree_at(lambda z: z.momentum, x, x.momentum - change)
        return eqx.tree_at(lambda z: z.velocity, x, stage_velocities(stages, x))

    def correct_nodes(self, x: Stages, residual: Float[Array, "r n"]) -> Stages:
        """Compute the fibre coordinates u - N⁻¹ r_v of the nodes."""
        node_fibre_coordinate = x.node_fibre_coordinate - matvec(
            self.momentum_inverse, residual
        )
        return eqx.tree_at(lambda z: z.node_fibre_coordinate, x, node_fibre_coordinate)

    def correct_multipliers(
        self,
        stages: StageSystem,
        x: Stages,
        kinematic: Float[Array, "r m"] | Float[Array, "0"],
        holonomic: Float[Array, "s k"] | Float[Array, "0"],
    ) -> Stages:
        """Change the free multipliers so that the linearised constraints hold."""
        residual = jnp.concatenate([kinematic.reshape(-1), holonomic.reshape(-1)])
        change = -matvec(self.schur_inverse, residual)
        h_dy = change[: x.closure.size].reshape(x.closure.shape)
        h_dholonomic = change[x.closure.size :].reshape(x.holonomic.shape)
        h_dlambda = stages.free_multipliers(h_dy, h_dholonomic)
        # This is h K⁻¹ Bᵀ δΛ; a division by h is needed for the multipliers alone.
        push = _pushed(self.reaction, h_dlambda)
        a_hat, momentum = stages.coefficients("a_hat"), x.momentum
        velocity_push = push
        if stages.hamiltonian:
            velocity_push = _pushed(self.velocity_reaction, h_dlambda)
            momentum = momentum + small_einsum("ij,jn->in", a_hat, push)
        return Stages(
            velocity=x.velocity + small_einsum("ij,jn->in", a_hat, velocity_push),
            momentum=momentum,
            node_fibre_coordinate=x.node_fibre_coordinate
            + small_einsum("ij,jn->in", stages.node_weights, push),
            closure=x.closure + h_dy / stages.h,
            holonomic=x.holonomic + h_dholonomic / stages.h,
            end_acceleration=x.end_acceleration,
            end_multiplier=x.end_multiplier,
            impulse=x.impulse,
        )

    def correct_end(
        self,
        stages: StageSystem,
        x: Stages,
        residual: tuple[Float[Array, " n"], Float[Array, " l"]],
    ) -> Stages:
        """Move the acceleration and λ_c at the end towards those of (q, u) there.

        The unknowns of the closure change with λ_c, so that to leading order the nodes
        stay as they are. Otherwise their constraints, which have just been solved,
        would not hold any more, and another sweep would be needed.
        """
        momentum_residual, hidden_residual = residual
        da, dlam = self.end.solve(-momentum_residual, -hidden_residual)
        dlam_closure = dlam[: stages.num_nonholonomic]
        response, on_stages = map(
            stages.closure_weights, ("response", "stage_response")
        )

        def pushed(u: Array, reaction: Array | WeightedTranspose) -> Array:
            last = reaction[-1]
            if isinstance(last, jax.Array):
                last = last[:, : stages.num_nonholonomic]
            return u + jnp.outer(on_stages, stages.h * matvec(last, dlam_closure))

        momentum = x.momentum
        if stages.hamiltonian:
            momentum = pushed(momentum, self.reaction)
        return eqx.tree_at(
            lambda z: (
                z.velocity,
                z.momentum,
                z.closure,
                z.end_acceleration,
                z.end_multiplier,
            ),
            x,
            (
                pushed(x.velocity, self.velocity_reaction),
                momentum,
                x.closure + jnp.outer(response, dlam_closure),
                x.end_acceleration + da,
                x.end_multiplier + dlam,
            ),
        )

    def correct_impulses(
        self, stages: StageSystem, x: Stages, error: Float[Array, " k"]
    ) -> Stages:
        """Change ε so that the linearised equations of the invariants hold.

        The stages and nodes change with it, for the reason that the end does with λ_c.
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
        fibre = x.node_fibre_coordinate + start[None]
        return replace(
            x,
            velocity=x.velocity + velocity[None],
            momentum=momentum,
            node_fibre_coordinate=jnp.concatenate([fibre[:-1], fibre[-1:] + end[None]]),
            impulse=x.impulse + change,
        )


def leading_structure(
    stages: StageSystem, x: Stages, lin: Linearisation
) -> LeadingStructure:
    """Factorise the leading structure, with N and K at the start and B_i at x."""
    structure = _without_impulses(stages, x, lin)
    if stages.kept is None:
        return structure
    return replace(structure, impulses=impulse_weights(stages, x))


def _without_impulses(
    stages: StageSystem, x: Stages, lin: Linearisation
) -> LeadingStructure:
    if not stages.constrained:
        n, nothing = stages.p.shape[0], jnp.zeros((0, 0), stages.p.dtype)
        reaction = jnp.zeros((stages.method.stages, n, 0), stages.p.dtype)
        return LeadingStructure(lin.momentum_inverse, reaction, reaction, nothing, lin)
    if isinstance(lin.jacobian, SparseMatrix):
        return _sparse(stages, x, lin, lin.jacobian)
    at_nodes = constraint_jacobian(stages, x)
    jacobian = jnp.concatenate([lin.dense[0][None], at_nodes])
    reaction = jnp.swapaxes(matvec(lin.metric_inverse, jacobian), 1, 2)
    rows, redundancy = jacobian[1:], stages.redundancy
    if redundancy is not None:
        rows = small_einsum("ab,ibn->ian", redundancy.projector, rows)
    blocks = small_einsum("ian,jnb->ijab", rows, reaction)
    schur, compliance = _schur(stages, blocks), blocks[-1, -1]
    if redundancy is not None:
        compliance = compliance + redundancy.rest
        schur = schur + redundancy.schur_rest(
            stages.method.stages, stages.num_nonholonomic
        )
    end = eqx.tree_at(
        lambda z: (z.jacobian, z.reaction, z.compliance_inverse),
        lin,
        (rows[-1], reaction[-1], inverse(compliance)),
    )
    return LeadingStructure(
        momentum_inverse=lin.momentum_inverse,
        reaction=reaction,
        velocity_reaction=(
            jnp.swapaxes(jacobian, 1, 2) if stages.hamiltonian else reaction
        ),
        schur_inverse=inverse(schur),
        end=end,
    )


def _pushed(
    reaction: Float[Array, "s n l"] | WeightedTranspose, multiplier: Float[Array, "s l"]
) -> Float[Array, "s n"]:
    if isinstance(reaction, WeightedTranspose):
        return reaction.apply(multiplier)
    return small_einsum("jnm,jm->jn", reaction, multiplier)


def _sparse(
    stages: StageSystem, x: Stages, lin: Linearisation, start: SparseMatrix
) -> LeadingStructure:
    """Do what `leading_structure` does, for constraints that share few coordinates."""
    pattern = start.pattern
    nodes = sparse_constraint_jacobian(stages, x, pattern)
    rows = SparseMatrix(jnp.concatenate([start.values[None], nodes.values]), pattern)
    products = couplings(rows[1:], rows, lin.metric_inverse)
    a, a_hat, b = (stages.coefficients(name) for name in ("a", "a_hat", "b"))
    if stages.num_nonholonomic:
        weights = a[1:, :, None] * stages.closure_weights("E")[None]
        schur = small_einsum("ijk,ijcbl->ikcbl", weights, products)
    else:
        weights = small_einsum("ik,kj->ij", a[1:], a_hat)
        on_positions = weights[:, :, None, None, None] * products
        tangency = b[:, None, None, None] * products[-1]
        schur = jnp.concatenate([on_positions, tangency[None]])
    reaction = WeightedTranspose(lin.metric_inverse, rows)
    end = eqx.tree_at(
        lambda z: (z.jacobian, z.reaction, z.compliance_inverse),
        lin,
        (
            rows[-1],
            reaction[-1],
            block_tridiagonal_inverse(products[-1:, -1:], pattern),
        ),
    )
    velocity_reaction = reaction
    if stages.hamiltonian:
        ones = jnp.ones_like(lin.metric_inverse)
        velocity_reaction = WeightedTranspose(ones, rows)
    return LeadingStructure(
        momentum_inverse=lin.momentum_inverse,
        reaction=reaction,
        velocity_reaction=velocity_reaction,
        schur_inverse=block_tridiagonal_inverse(schur, pattern),
        end=end,
    )


def _schur(stages: StageSystem, blocks: Float[Array, "r s l l"]) -> Float[Array, "c c"]:
    """Assemble the derivative of the constraints by h δy and h δΛ.

    `blocks` are the products B_i K⁻¹ B_jᵀ for i >= 2 and all j.
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
