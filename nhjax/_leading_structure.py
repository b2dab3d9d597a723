import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._linearisation import inverse, Linearisation
from ._stages import Stages, StageSystem


class LeadingStructure(eqx.Module):
    """The leading structure of the linearised stage equations of one step.

    With M at the start of the step, B_i at the nodes as they are foreseen there, R the
    node rows of a_ij and δΛ = E δy,

    δV_i = -M⁻¹ r_V + h Σ_j â_ij M⁻¹ B_jᵀ δΛ_j,
    δv_i = -M⁻¹ r_v + h Σ_j R_ij M⁻¹ B_jᵀ δΛ_j,    B_i δv_i = -r_Φ.

    The last two give a Schur complement for h δy, of size (s-1) m. It is invertible for
    small h by hypothesis H2 (for the symmetric closure by the sign of ν) and the
    compatibility condition.
    """

    mass_inverse: Float[Array, "n n"]
    reaction: Float[Array, "s n m"]
    schur_inverse: Float[Array, "k k"]
    end: Linearisation

    def correct_stages(self, x: Stages, residual: Float[Array, "s n"]) -> Stages:
        """V - M⁻¹ r_V."""
        velocity = x.velocity - residual @ self.mass_inverse.T
        return eqx.tree_at(lambda z: z.velocity, x, velocity)

    def correct_nodes(self, x: Stages, residual: Float[Array, "r n"]) -> Stages:
        """v - M⁻¹ r_v."""
        node_velocity = x.node_velocity - residual @ self.mass_inverse.T
        return eqx.tree_at(lambda z: z.node_velocity, x, node_velocity)

    def correct_multipliers(
        self, stages: StageSystem, x: Stages, constraint: Float[Array, "r m"]
    ) -> Stages:
        """Change the free multipliers so that the constraints hold at the nodes."""
        h_dy = -(self.schur_inverse @ constraint.reshape(-1)).reshape(constraint.shape)
        # h M⁻¹ Bᵀ δΛ; h is divided out only where y itself is wanted.
        push = jnp.einsum("jnm,jm->jn", self.reaction, stages.closure("E") @ h_dy)
        return Stages(
            x.velocity + stages.coefficients("a_hat") @ push,
            x.node_velocity + stages.node_weights @ push,
            x.closure + h_dy / stages.h,
            x.end_acceleration,
            x.end_multiplier,
        )

    def correct_end(
        self, x: Stages, residual: tuple[Float[Array, " n"], Float[Array, " m"]]
    ) -> Stages:
        """Move the acceleration and λ_c at the end towards those of (q, v) there."""
        momentum_residual, hidden_residual = residual
        da, dlam = self.end.solve(-momentum_residual, -hidden_residual)
        return eqx.tree_at(
            lambda z: (z.end_acceleration, z.end_multiplier),
            x,
            (x.end_acceleration + da, x.end_multiplier + dlam),
        )


def leading_structure(
    stages: StageSystem, x0: Stages, lin: Linearisation
) -> LeadingStructure:
    """Factorise the leading structure at the starting values of a step."""
    if not stages.constrained:
        n, nothing = stages.p.shape[0], jnp.zeros((0, 0), stages.p.dtype)
        reaction = jnp.zeros((stages.method.stages, n, 0), stages.p.dtype)
        return LeadingStructure(lin.mass_inverse, reaction, nothing, lin)
    jacobian = jnp.concatenate([lin.jacobian[None], stages.node_jacobian(x0)])
    reaction = jnp.einsum("kn,jmn->jkm", lin.mass_inverse, jacobian)
    blocks = jnp.einsum("ian,jnb->ijab", jacobian[1:], reaction)
    schur = jnp.einsum(
        "ij,jl,ijab->ialb", stages.node_weights, stages.closure("E"), blocks
    )
    size = schur.shape[0] * schur.shape[1]
    end = eqx.tree_at(
        lambda z: (z.jacobian, z.reaction, z.compliance_inverse),
        lin,
        (jacobian[-1], reaction[-1], inverse(blocks[-1, -1])),
    )
    return LeadingStructure(
        lin.mass_inverse, reaction, inverse(schur.reshape(size, size)), end
    )
