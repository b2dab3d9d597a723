"""The chart around the start of a step, on a vector space or on a Lie group."""

from abc import abstractmethod
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar
from .._manifold import AbstractLieGroup
from .._numerics import two_sum


# Vectors and covectors of the Lie algebra: one, and one for each stage or node.
Vector: TypeAlias = Float[Array, " n"]
Vectors: TypeAlias = Float[Array, "r n"]


class AbstractChart(eqx.Module):
    """The chart Ξ -> g_k τ(Ξ) of a manifold around g_k, in which a step is written.

    Its methods carry velocities and covectors at g_k τ(Ξ) to the chart and back (paper,
    section 6).
    """

    manifold: eqx.AbstractVar[AbstractLieGroup]
    origin: eqx.AbstractVar[PyTree[Array]]

    @abstractmethod
    def body_velocities(self, xi: Vectors, velocity: Vectors) -> Vectors:
        """Compute the body velocities dτ_Ξ H of the chart velocities H."""

    @abstractmethod
    def chart_velocities(self, xi: Vectors, body_velocity: Vectors) -> Vectors:
        """Compute the chart velocities dτ_Ξ⁻¹ η of the body velocities η."""

    @abstractmethod
    def to_chart(
        self, xi: Vectors, velocity: Vectors, momentum: Vectors, force: Vectors
    ) -> tuple[Vectors, Vectors]:
        """Compute (Π, F), the momenta and forces with respect to the coordinates Ξ.

        They are Π = dτ_Ξ^* μ and F = dτ_Ξ^* w + (ddτ_Ξ)^*(H, Π) for body momenta μ and
        body forces w. The second term of F is the derivative of ⟨μ, dτ_Ξ H⟩ along Ξ.
        """

    @abstractmethod
    def to_start(self, xi: Vectors, covector: Vectors) -> Vectors:
        """Compute Ad^*_{τ(Ξ)⁻¹} w: carry body covectors from g_k τ(Ξ) to g_k."""

    @abstractmethod
    def to_end(self, xi: Vector, covector: Vector) -> Vector:
        """Compute Ad^*_{τ(Ξ)} μ: carry a body covector from g_k to g_k τ(Ξ)."""

    @abstractmethod
    def carry(
        self, xi: Vector, momentum: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Apply Ad^*_{τ(ξ)} to a compensated sum; return a compensated sum.

        A compensated sum is a number and the rounding error it has accumulated.
        """

    @abstractmethod
    def base_momentum(
        self, xi: Vector, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Compute the constant term of the stage momenta Π^i = base + h Σ â_ij F^j.

        It is dτ_ξ^* μ_{k+1} - h Σ b_j F^j, with
        μ_{k+1} = Ad^*_{τ(ξ)}(μ_k + h Σ b_j n^j).

        **Arguments:**

        - `xi`: ξ, the increment of the whole step in the chart.
        - `momentum`: μ_k.
        - `transported`: h Σ b_j n^j.
        - `chart_force`: h Σ b_j F^j.
        """

    @abstractmethod
    def in_domain(self, xi: Vectors) -> BoolScalar:
        """Tell whether all Ξ^i lie where the retraction τ is invertible."""


class FlatChart(AbstractChart):
    """The chart of a vector space, on which dτ and Ad^* are the identity.

    Its methods return what they were given, so that the compiled program of a step is
    that of the paper's equations on a vector space.
    """

    manifold: AbstractLieGroup
    origin: PyTree[Array]

    def body_velocities(self, xi: Vectors, velocity: Vectors) -> Vectors:
        """Return the chart velocities H, which are the body velocities here."""
        return velocity

    def chart_velocities(self, xi: Vectors, body_velocity: Vectors) -> Vectors:
        """Return the body velocities η, which are the chart velocities here."""
        return body_velocity

    def to_chart(
        self, xi: Vectors, velocity: Vectors, momentum: Vectors, force: Vectors
    ) -> tuple[Vectors, Vectors]:
        """Return the momenta μ and the forces w unchanged."""
        return momentum, force

    def to_start(self, xi: Vectors, covector: Vectors) -> Vectors:
        """Return the covectors w unchanged."""
        return covector

    def to_end(self, xi: Vector, covector: Vector) -> Vector:
        """Return the covector μ unchanged."""
        return covector

    def carry(
        self, xi: Vector, momentum: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Return the compensated sum unchanged."""
        return momentum, compensation

    def base_momentum(
        self, xi: Vector, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Return μ_k, because the two sums are the same here and cancel."""
        return momentum

    def in_domain(self, xi: Vectors) -> BoolScalar:
        """Return True, because the chart is the whole space."""
        return jnp.asarray(True)


class CurvedChart(AbstractChart):
    """The chart of a Lie group around g_k that its retraction τ gives."""

    manifold: AbstractLieGroup
    origin: PyTree[Array]

    def body_velocities(self, xi: Vectors, velocity: Vectors) -> Vectors:
        """Compute the body velocities dτ_Ξ H of the chart velocities H."""
        return jax.vmap(self.manifold.dtau)(xi, velocity)

    def chart_velocities(self, xi: Vectors, body_velocity: Vectors) -> Vectors:
        """Compute the chart velocities dτ_Ξ⁻¹ η of the body velocities η."""
        return jax.vmap(self.manifold.dtau_inv)(xi, body_velocity)

    def to_chart(
        self, xi: Vectors, velocity: Vectors, momentum: Vectors, force: Vectors
    ) -> tuple[Vectors, Vectors]:
        """Compute (Π, F), the momenta and forces with respect to the coordinates Ξ."""

        def one(xi, velocity, momentum, force):
            _, pullback = jax.vjp(self.manifold.dtau, xi, velocity)
            curvature, chart_momentum = pullback(momentum)
            return chart_momentum, curvature + pullback(force)[1]

        return jax.vmap(one)(xi, velocity, momentum, force)

    def to_start(self, xi: Vectors, covector: Vectors) -> Vectors:
        """Compute Ad^*_{τ(Ξ)⁻¹} w: carry body covectors from g_k τ(Ξ) to g_k."""
        return jax.vmap(self.manifold.to_start)(xi, covector)

    def to_end(self, xi: Vector, covector: Vector) -> Vector:
        """Compute Ad^*_{τ(Ξ)} μ: carry a body covector from g_k to g_k τ(Ξ)."""
        return self.manifold.to_end(xi, covector)

    def carry(
        self, xi: Vector, momentum: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Apply Ad^*_{τ(ξ)} to a compensated sum; return a compensated sum.

        The rounding errors of plain products with Ad^* would add up over the steps, as
        those of plain sums do.
        """
        change = self.manifold.to_end_change(xi, momentum)
        return two_sum(momentum, change + self.manifold.to_end(xi, compensation))

    def base_momentum(
        self, xi: Vector, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Compute dτ_ξ^* μ_{k+1} - h Σ b_j F^j, the constant term of Π^i."""
        end = self.to_end(xi, momentum + transported)
        return self.manifold.dtau_dual(xi, end) - chart_force

    def in_domain(self, xi: Vectors) -> BoolScalar:
        """Tell whether all Ξ^i lie where the retraction τ is invertible."""
        return jnp.all(jax.vmap(self.manifold.in_chart)(xi))


def chart_at(manifold: AbstractLieGroup, origin: PyTree[Array]) -> AbstractChart:
    """Make the chart of a manifold around one of its elements."""
    kind = FlatChart if manifold.is_flat else CurvedChart
    return kind(manifold, origin)


def positions(chart: AbstractChart, xi: Vectors) -> PyTree[Array]:
    """Compute the positions g_k τ(Ξ^i), one for each row of Ξ."""
    return jax.vmap(lambda xi: chart.manifold.act(chart.origin, xi))(xi)
