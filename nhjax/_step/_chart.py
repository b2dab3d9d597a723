"""The chart in which a step is written: what it must do, and that of a vector space."""

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
    """The chart y -> g_o τ(y) of a manifold around its origin g_o, for one step.

    Its methods carry velocities and covectors at g_o τ(y) to the chart and back (paper,
    section 6). Where the origin lies depends on the chart, and on the increment ξ of
    the step.
    """

    manifold: eqx.AbstractVar[AbstractLieGroup]

    @abstractmethod
    def coordinates(self, increment: Vectors) -> Vectors:
        """Compute the coordinates y of the points that increments Ξ from g_k lead to.

        The increment ξ itself leads to the end of the step.
        """

    @property
    @abstractmethod
    def origin(self) -> PyTree[Array]:
        """Compute g_o, the origin of the chart."""

    @property
    @abstractmethod
    def ends(self) -> tuple[Vector, Vector]:
        """Compute the coordinates of the start and of the end of the step."""

    def position(self, y: Vector) -> PyTree[Array]:
        """Compute the position g_o τ(y)."""
        return self.manifold.act(self.origin, y)

    def positions(self, y: Vectors) -> PyTree[Array]:
        """Compute the positions g_o τ(y), one for each row of y."""
        return jax.vmap(self.position)(y)

    @abstractmethod
    def body_velocities(self, y: Vectors, velocity: Vectors) -> Vectors:
        """Compute the body velocities dτ_y H of the chart velocities H."""

    @abstractmethod
    def chart_velocities(self, y: Vectors, body_velocity: Vectors) -> Vectors:
        """Compute the chart velocities dτ_y⁻¹ η of the body velocities η."""

    @abstractmethod
    def to_chart(
        self, y: Vectors, velocity: Vectors, momentum: Vectors, force: Vectors
    ) -> tuple[Vectors, Vectors]:
        """Compute (Π, F), the momenta and forces with respect to the coordinates y.

        They are Π = dτ_y^* μ and F = dτ_y^* w + (ddτ_y)^*(H, Π) for body momenta μ and
        body forces w. The second term of F is the derivative of ⟨μ, dτ_y H⟩ along y.
        """

    @abstractmethod
    def to_origin(self, y: Vectors, covector: Vectors) -> Vectors:
        """Compute Ad^*_{τ(y)⁻¹} w: carry body covectors from g_o τ(y) to g_o."""

    @abstractmethod
    def from_origin(self, y: Vectors, covector: Vectors) -> Vectors:
        """Compute Ad^*_{τ(y)} μ: carry body covectors from g_o to g_o τ(y)."""

    @abstractmethod
    def momentum_at_origin(self, momentum: Vector) -> Vector:
        """Carry the body momentum μ_k from g_k to g_o."""

    @abstractmethod
    def base_momentum(
        self, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Compute the constant term of the stage momenta Π^i = base + h Σ â_ij F^j.

        **Arguments:**

        - `momentum`: μ_k, carried to the origin.
        - `transported`: h Σ b_j n^j, the sum of the forces carried to the origin.
        - `chart_force`: h Σ b_j F^j, that of the forces in the chart.
        """

    @abstractmethod
    def advance(
        self, start: PyTree[Array], compensation: PyTree[Array]
    ) -> tuple[PyTree[Array], PyTree[Array]]:
        """Compute the end g_{k+1} of the step and the rounding error of the sum.

        A compensated sum is a number and the rounding error it has accumulated. The
        `start` is g_k as it was before it was wrapped; see `AbstractLieGroup.wrapped`.
        """

    @abstractmethod
    def advance_momentum(
        self, momentum: Vector, gained: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Compute μ_{k+1} as a compensated sum, from μ_k and h Σ b_j n^j."""

    @abstractmethod
    def in_domain(self, y: Vectors) -> BoolScalar:
        """Tell whether all y lie where the retraction τ is invertible."""


class FlatChart(AbstractChart):
    """The chart of a vector space, on which dτ and Ad^* are the identity.

    Its methods return what they were given, so that the compiled program of a step is
    that of the paper's equations on a vector space.
    """

    manifold: AbstractLieGroup
    start: PyTree[Array]
    increment: Vector

    @property
    def origin(self) -> PyTree[Array]:
        """Return the origin of the chart, which is q_k."""
        return self.start

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """Return the coordinates 0 and ξ of both ends of the step."""
        return jnp.zeros_like(self.increment), self.increment

    def coordinates(self, increment: Vectors) -> Vectors:
        """Return the increments Ξ, since the origin is q_k."""
        return increment

    def body_velocities(self, y: Vectors, velocity: Vectors) -> Vectors:
        """Return the chart velocities H, which are the body velocities here."""
        return velocity

    def chart_velocities(self, y: Vectors, body_velocity: Vectors) -> Vectors:
        """Return the body velocities η, which are the chart velocities here."""
        return body_velocity

    def to_chart(
        self, y: Vectors, velocity: Vectors, momentum: Vectors, force: Vectors
    ) -> tuple[Vectors, Vectors]:
        """Return the momenta μ and the forces w unchanged."""
        return momentum, force

    def to_origin(self, y: Vectors, covector: Vectors) -> Vectors:
        """Return the covectors w unchanged."""
        return covector

    def from_origin(self, y: Vectors, covector: Vectors) -> Vectors:
        """Return the covectors μ unchanged."""
        return covector

    def momentum_at_origin(self, momentum: Vector) -> Vector:
        """Return the momentum unchanged."""
        return momentum

    def base_momentum(
        self, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Return μ_k, because the two sums are the same here and cancel."""
        return momentum

    def advance(
        self, start: PyTree[Array], compensation: PyTree[Array]
    ) -> tuple[PyTree[Array], PyTree[Array]]:
        """Compute q_k + ξ by compensated summation."""
        return self.manifold.advance(start, self.increment, compensation)

    def advance_momentum(
        self, momentum: Vector, gained: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Compute the sum of μ_k and h Σ b_j n^j by compensated summation."""
        return two_sum(momentum, gained + compensation)

    def in_domain(self, y: Vectors) -> BoolScalar:
        """Return True, because the chart is the whole space."""
        return jnp.asarray(True)
