"""The chart around the start of a step, on a vector space and on a curved group."""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar
from .._manifold import AbstractLieGroup
from .._numerics import two_sum


class AbstractChart(eqx.Module):
    """The chart Ξ -> g_k τ(Ξ) of a manifold around g_k, in which a step is written.

    Positions, velocities and covectors at g_k τ(Ξ) are carried to the chart and back
    (paper, section 6).
    """

    manifold: eqx.AbstractVar[AbstractLieGroup]
    origin: eqx.AbstractVar[PyTree[Array]]

    @abstractmethod
    def body_velocities(
        self, xi: Float[Array, "r n"], velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """dτ_Ξ H, the body velocities of the chart velocities H."""

    @abstractmethod
    def chart_velocities(
        self, xi: Float[Array, "r n"], body_velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """dτ_Ξ⁻¹ η, the chart velocities of the body velocities η."""

    @abstractmethod
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

    @abstractmethod
    def to_start(
        self, xi: Float[Array, "r n"], covector: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """Ad^*_{τ(Ξ)⁻¹} w, body covectors at g_k τ(Ξ) as body covectors at g_k."""

    @abstractmethod
    def to_end(
        self, xi: Float[Array, " n"], covector: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Ad^*_{τ(Ξ)} μ, a body covector at g_k as a body covector at g_k τ(Ξ)."""

    @abstractmethod
    def carry(
        self,
        xi: Float[Array, " n"],
        momentum: Float[Array, " n"],
        compensation: Float[Array, " n"],
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Ad^*_{τ(ξ)} of a compensated sum, as a compensated sum."""

    @abstractmethod
    def base_momentum(
        self,
        xi: Float[Array, " n"],
        momentum: Float[Array, " n"],
        transported: Float[Array, " n"],
        chart_force: Float[Array, " n"],
    ) -> Float[Array, " n"]:
        """What the sums h Σ â_ij F^j start from in the stage momenta Π^i.

        dτ_ξ^* μ_{k+1} - h Σ b_j F^j, with μ_{k+1} = Ad^*_{τ(ξ)}(μ_k + h Σ b_j n^j) and
        the two sums given.
        """

    @abstractmethod
    def in_domain(self, xi: Float[Array, "r n"]) -> BoolScalar:
        """Whether all Ξ^i lie where τ is invertible."""


class FlatChart(AbstractChart):
    """The chart of a vector space, where nothing is carried.

    What it returns is what it was given, so that the program of a step is that of the
    paper's equations on a vector space.
    """

    manifold: AbstractLieGroup
    origin: PyTree[Array]

    def body_velocities(
        self, xi: Float[Array, "r n"], velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """H itself."""
        return velocity

    def chart_velocities(
        self, xi: Float[Array, "r n"], body_velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """η itself."""
        return body_velocity

    def to_chart(
        self,
        xi: Float[Array, "r n"],
        velocity: Float[Array, "r n"],
        momentum: Float[Array, "r n"],
        force: Float[Array, "r n"],
    ) -> tuple[Float[Array, "r n"], Float[Array, "r n"]]:
        """(μ, w) themselves."""
        return momentum, force

    def to_start(
        self, xi: Float[Array, "r n"], covector: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """w itself."""
        return covector

    def to_end(
        self, xi: Float[Array, " n"], covector: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """μ itself."""
        return covector

    def carry(
        self,
        xi: Float[Array, " n"],
        momentum: Float[Array, " n"],
        compensation: Float[Array, " n"],
    ) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """The sum itself."""
        return momentum, compensation

    def base_momentum(
        self,
        xi: Float[Array, " n"],
        momentum: Float[Array, " n"],
        transported: Float[Array, " n"],
        chart_force: Float[Array, " n"],
    ) -> Float[Array, " n"]:
        """μ_k: the two sums are the same here, and cancel."""
        return momentum

    def in_domain(self, xi: Float[Array, "r n"]) -> BoolScalar:
        """True: the chart is the whole space."""
        return jnp.asarray(True)


class CurvedChart(AbstractChart):
    """The chart of a Lie group around g_k, by its retraction τ."""

    manifold: AbstractLieGroup
    origin: PyTree[Array]

    def body_velocities(
        self, xi: Float[Array, "r n"], velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """dτ_Ξ H, the body velocities of the chart velocities H."""
        return jax.vmap(self.manifold.dtau)(xi, velocity)

    def chart_velocities(
        self, xi: Float[Array, "r n"], body_velocity: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """dτ_Ξ⁻¹ η, the chart velocities of the body velocities η."""
        return jax.vmap(self.manifold.dtau_inv)(xi, body_velocity)

    def to_chart(
        self,
        xi: Float[Array, "r n"],
        velocity: Float[Array, "r n"],
        momentum: Float[Array, "r n"],
        force: Float[Array, "r n"],
    ) -> tuple[Float[Array, "r n"], Float[Array, "r n"]]:
        """(Π, F): momenta and forces with respect to the coordinates Ξ."""

        def one(xi, velocity, momentum, force):
            _, pullback = jax.vjp(self.manifold.dtau, xi, velocity)
            curvature, chart_momentum = pullback(momentum)
            return chart_momentum, curvature + pullback(force)[1]

        return jax.vmap(one)(xi, velocity, momentum, force)

    def to_start(
        self, xi: Float[Array, "r n"], covector: Float[Array, "r n"]
    ) -> Float[Array, "r n"]:
        """Ad^*_{τ(Ξ)⁻¹} w, body covectors at g_k τ(Ξ) as body covectors at g_k."""
        return jax.vmap(self.manifold.to_start)(xi, covector)

    def to_end(
        self, xi: Float[Array, " n"], covector: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Ad^*_{τ(Ξ)} μ, a body covector at g_k as a body covector at g_k τ(Ξ)."""
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
        change = self.manifold.to_end_change(xi, momentum)
        return two_sum(momentum, change + self.manifold.to_end(xi, compensation))

    def base_momentum(
        self,
        xi: Float[Array, " n"],
        momentum: Float[Array, " n"],
        transported: Float[Array, " n"],
        chart_force: Float[Array, " n"],
    ) -> Float[Array, " n"]:
        """dτ_ξ^* μ_{k+1} - h Σ b_j F^j."""
        end = self.to_end(xi, momentum + transported)
        return self.manifold.dtau_dual(xi, end) - chart_force

    def in_domain(self, xi: Float[Array, "r n"]) -> BoolScalar:
        """Whether all Ξ^i lie where τ is invertible."""
        return jnp.all(jax.vmap(self.manifold.in_chart)(xi))


def chart_at(manifold: AbstractLieGroup, origin: PyTree[Array]) -> AbstractChart:
    """The chart of a manifold around one of its elements."""
    kind = FlatChart if manifold.is_flat else CurvedChart
    return kind(manifold, origin)


def positions(chart: AbstractChart, xi: Float[Array, "r n"]) -> PyTree[Array]:
    """g_k τ(Ξ^i) for each row of Ξ."""
    return jax.vmap(lambda xi: chart.manifold.act(chart.origin, xi))(xi)
