import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._manifold import AbstractLieGroup
from .._numerics import two_sum


class Chart(eqx.Module):
    """The chart Ξ -> g_k τ(Ξ) of a group around g_k, in which a step is written.

    Positions, velocities and covectors at g_k τ(Ξ) are carried to the chart and back
    (paper, section 6). On a flat manifold nothing is carried: the program is that of a
    vector space.
    """

    manifold: AbstractLieGroup
    origin: PyTree[Array]

    def positions(self, xi: Float[Array, "r n"]) -> PyTree[Array]:
        """g_k τ(Ξ^i)."""
        return jax.vmap(lambda xi: self.manifold.act(self.origin, xi))(xi)

    def body_velocities(
        self, xi: Float[Array, "r n"], velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """dτ_Ξ H, the body velocities of the chart velocities H."""
        if self.manifold.is_flat:
            return velocity
        return jax.vmap(self.manifold.dtau)(xi, velocity)

    def chart_velocities(
        self, xi: Float[Array, "r n"], body_velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """dτ_Ξ⁻¹ η, the chart velocities of the body velocities η."""
        if self.manifold.is_flat:
            return body_velocity
        return jax.vmap(self.manifold.dtau_inv)(xi, body_velocity)

    def to_chart(
        self,
        xi: Float[Array, "r n"],
        velocity: Float[Array, "r n"],
        momentum: Float[Array, "r n"],
        force: Float[Array, "r n"],
    ) -> tuple[Float[Array, "r n"], Float[Array, "r n"]]:
        """(Π, F): momenta and forces with respect to the coordinates Ξ.

        Π = dτ_Ξ^* μ, and F = dτ_Ξ^* w + (ddτ_Ξ)^*(H, Π), in which the second term is
        the derivative of ⟨μ, dτ_Ξ H⟩ along Ξ.
        """
        if self.manifold.is_flat:
            return momentum, force

        def one(xi, velocity, momentum, force):
            _, pullback = jax.vjp(self.manifold.dtau, xi, velocity)
            curvature, chart_momentum = pullback(momentum)
            return chart_momentum, curvature + pullback(force)[1]

        return jax.vmap(one)(xi, velocity, momentum, force)

    def to_start(
        self, xi: Float[Array, "r n"], covector: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """Ad^*_{τ(Ξ)⁻¹} w, body covectors at g_k τ(Ξ) as body covectors at g_k."""
        if self.manifold.is_flat:
            return covector

        return jax.vmap(self.manifold.to_start)(xi, covector)

    def to_end(
        self, xi: Float[Array, " n"], covector: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Ad^*_{τ(Ξ)} μ, a body covector at g_k as a body covector at g_k τ(Ξ)."""
        if self.manifold.is_flat:
            return covector
        return self.manifold.to_end(xi, covector)

    def carry(
        self,
        xi: Float[Array, " n"],
        momentum: Float[Array, " n"],
        compensation: Float[Array, " n"],
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Ad^*_{τ(ξ)} of a compensated sum, as a compensated sum.

        The rounding of plain products with Ad^* would add up over the steps as that of
        plain sums does.
        """
        if self.manifold.is_flat:
            return momentum, compensation
        change = self.manifold.to_end_change(xi, momentum)
        return two_sum(momentum, change + self.manifold.to_end(xi, compensation))

    def base_momentum(
        self,
        xi: Float[Array, " n"],
        momentum: Float[Array, " n"],
        transported: Float[Array, " n"],
        chart_force: Float[Array, " n"],
    ) -> Float[Array, " n"]:
        """What the sums h Σ â_ij F^j start from in the stage momenta Π^i.

        dτ_ξ^* μ_{k+1} - h Σ b_j F^j, with μ_{k+1} = Ad^*_{τ(ξ)}(μ_k + h Σ b_j n^j) and
        the two sums given; on a flat manifold both are the same and μ_k is left.
        """
        if self.manifold.is_flat:
            return momentum
        end = self.to_end(xi, momentum + transported)
        return self.manifold.dtau_dual(xi, end) - chart_force

    def in_domain(self, xi: Float[Array, "r n"]) -> Array:
        """Whether all Ξ^i lie where τ is invertible."""
        if self.manifold.is_flat:
            return jnp.asarray(True)
        return jnp.all(jax.vmap(self.manifold.in_chart)(xi))
