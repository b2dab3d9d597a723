from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._custom_types import Args, FloatScalar


if TYPE_CHECKING:
    from ._system import LagrangianSystem


class Linearisation(eqx.Module):
    """What is known of the equations of motion at one state (t, q, v).

    With M = D2D2L and B = D2Φ the motion satisfies

    M a - Bᵀ λ = D1L + F - D1D2L v - ∂t D2L,    B a = -∂t Φ - D1Φ v,

    so that C λ with C = B M⁻¹ Bᵀ is known: C is the paper's compatibility matrix C^{ab}
    (section 3). The same M⁻¹, B and C⁻¹ are the leading structure of the stage system.
    Inverses are formed once and multiplied with afterwards: the matrices are tiny, and
    a triangular solve inside an iteration costs far more than a product.
    """

    mass_inverse: Float[Array, "n n"]
    jacobian: Float[Array, "m n"]
    reaction: Float[Array, "n m"]
    compliance_inverse: Float[Array, "m m"]
    acceleration: Float[Array, " n"]
    multiplier: Float[Array, " m"]
    violation: Float[Array, " m"]

    @property
    def is_singular(self) -> Bool[Array, ""]:
        """Whether M or C could not be inverted."""
        return ~(
            jnp.all(jnp.isfinite(self.mass_inverse))
            & jnp.all(jnp.isfinite(self.compliance_inverse))
        )

    def solve(
        self, momentum_residual: Float[Array, " n"], hidden_residual: Float[Array, " m"]
    ) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """(a, λ) with M a - Bᵀ λ = `momentum_residual`, B a = `hidden_residual`."""
        free = self.mass_inverse @ momentum_residual
        multiplier = self.compliance_inverse @ (hidden_residual - self.jacobian @ free)
        return free + self.reaction @ multiplier, multiplier


def _momentum_and_constraint(
    system: "LagrangianSystem", args: Args
) -> Callable[..., tuple[Array, Array]]:
    """(D2L, Φ), whose derivatives are all that the equations of motion need."""
    return lambda t, q, v: (
        system.momentum(t, q, v, args),
        system.constraint(t, q, v, args),
    )


def motion_residual(
    system: "LagrangianSystem",
    t: FloatScalar,
    q: Array,
    v: Float[Array, " n"],
    acceleration: Float[Array, " n"],
    multiplier: Float[Array, " m"],
    args: Args,
) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """Residuals of the equations of motion and of the hidden constraint.

    d/dt D2L - D1L - F - λᵀ D2Φ and dΦ/dt along (q̇, v̇) = (v, a). They vanish at the
    continuous multiplier λ = λ_c(q, v).
    """
    _, (p_dot, phi_dot) = jax.jvp(
        _momentum_and_constraint(system, args),
        (t, q, v),
        (jnp.ones_like(t), v, acceleration),
    )
    w, _ = system.force_and_momentum(t, q, v, multiplier, args)
    return p_dot - w, phi_dot


def linearise(
    system: "LagrangianSystem",
    t: FloatScalar,
    q: Array,
    v: Float[Array, " n"],
    args: Args,
) -> Linearisation:
    """M⁻¹, B, C⁻¹, the acceleration and the continuous multiplier at (t, q, v)."""
    (_, violation), push = jax.linearize(
        _momentum_and_constraint(system, args), t, q, v
    )
    zero_t, zero_q, zero_v = jnp.zeros_like(t), jnp.zeros_like(q), jnp.zeros_like(v)
    mass, jacobian_t = jax.vmap(lambda e: push(zero_t, zero_q, e))(
        jnp.eye(v.shape[0], dtype=v.dtype)
    )
    p_dot, phi_dot = push(jnp.ones_like(t), v, zero_v)
    # M is symmetric; row i of `mass` is M e_i.
    mass_inverse = inverse(mass)
    reaction = mass_inverse @ jacobian_t
    compliance = jacobian_t.T @ reaction
    lin = Linearisation(
        mass_inverse=mass_inverse,
        jacobian=jacobian_t.T,
        reaction=reaction,
        compliance_inverse=inverse(compliance),
        acceleration=zero_v,
        multiplier=jnp.zeros_like(violation),
        violation=violation,
    )
    acceleration, multiplier = lin.solve(
        system.free_force(t, q, v, args) - p_dot, -phi_dot
    )
    return eqx.tree_at(
        lambda x: (x.acceleration, x.multiplier), lin, (acceleration, multiplier)
    )


def inverse(matrix: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """The inverse of a tiny matrix; not finite where there is none."""
    # One constraint is by far the commonest case, none the cheapest.
    if matrix.shape[0] == 0:
        return matrix
    if matrix.shape[0] == 1:
        return 1 / matrix
    return jnp.linalg.inv(matrix)
