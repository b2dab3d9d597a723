from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._numerics import (
    BlockTridiagonalInverse,
    Matrix,
    matvec,
    small_einsum,
    WeightedTranspose,
)
from .._system import Linearisation
from ._equations import stage_velocities, StageEquations, StageUnknowns
from ._first_order import FirstOrderTerms
from ._invariants import InvariantCorrection


class Responses(NamedTuple):
    """The changes of stages and nodes with h δy of the closure and h δΛ, one a column.

    Where terms of order h are in the Jacobian they are kept, since they are needed for
    the Schur complement as well.
    """

    velocity: Float[Array, "s n c"]
    node_fibre_coordinate: Float[Array, "r n c"]


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

    With `first_order` N⁻¹ r is followed by the terms of order h, and the changes with
    the multipliers are the `responses`, in which these terms are too.
    """

    momentum_inverse: Matrix
    reaction: Float[Array, "s n l"] | WeightedTranspose
    velocity_reaction: Float[Array, "s n l"] | WeightedTranspose
    schur_inverse: Float[Array, "c c"] | BlockTridiagonalInverse
    end: Linearisation
    impulses: InvariantCorrection | None = None
    first_order: FirstOrderTerms | None = None
    responses: Responses | None = None

    def correct_stages(
        self, stages: StageEquations, x: StageUnknowns, residual: Float[Array, "s n"]
    ) -> StageUnknowns:
        """Compute u - N⁻¹ r_u for the stages, and the velocities that belong to it."""
        change = matvec(self.momentum_inverse, residual)
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
        """Compute the fibre coordinates u - N⁻¹ r_v of the nodes.

        The residual knows the new stage velocities by the positions alone, and not yet
        their `change` by the forces.
        """
        du = -matvec(self.momentum_inverse, residual)
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
        change = -matvec(self.schur_inverse, residual)
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
        # This is h K⁻¹ Bᵀ δΛ; a division by h is needed for the multipliers alone.
        push = _pushed(self.reaction, h_dlambda)
        a_hat, momentum = stages.coefficients("a_hat"), x.momentum
        velocity_push = push
        if stages.hamiltonian:
            velocity_push = _pushed(self.velocity_reaction, h_dlambda)
            momentum = momentum + small_einsum("ij,jn->in", a_hat, push)
        return StageUnknowns(
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
        stages: StageEquations,
        x: StageUnknowns,
        residual: tuple[Float[Array, " n"], Float[Array, " l"]],
    ) -> StageUnknowns:
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
        self, stages: StageEquations, x: StageUnknowns, error: Float[Array, " k"]
    ) -> StageUnknowns:
        """Change ε so that the linearised equations of the invariants hold.

        The stages and nodes change with ε, so that to leading order their momentum
        equations, which have just been solved, still hold.
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


def _pushed(
    reaction: Float[Array, "s n l"] | WeightedTranspose, multiplier: Float[Array, "s l"]
) -> Float[Array, "s n"]:
    if isinstance(reaction, WeightedTranspose):
        return reaction.matvec(multiplier)
    return small_einsum("jnm,jm->jn", reaction, multiplier)
