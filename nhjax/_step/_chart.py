"""The charts in which a step is written: of a vector space, and of a Lie group.

A chart y -> g_o τ(y) maps coordinates to positions by the retraction τ. It transports
velocities and covectors between its origin g_o and the other positions of a step
(paper, section 6).
"""

from abc import abstractmethod
from typing import TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar
from .._manifold import AbstractLieGroup
from .._numerics import two_sum


# Vectors and covectors of the Lie algebra: a single one, or a row for each stage or
# node.
Vector: TypeAlias = Float[Array, " n"]


Vectors: TypeAlias = Float[Array, "r n"]


class AbstractChart(eqx.Module):
    """The chart y -> g_o τ(y) of a manifold around its origin g_o, for one step.

    The methods transport velocities and covectors from g_o τ(y) to the chart and back
    (paper, section 6). A step starts at g_k, and ξ = h Σ b_j H^j is its increment, with
    the stage velocities H^j in the chart. The origin depends on the kind of chart, and
    for `MiddleChart` on ξ.
    """

    manifold: eqx.AbstractVar[AbstractLieGroup]

    @abstractmethod
    def coordinates(self, increment: Vectors) -> Vectors:
        """Compute the coordinates y of the points that increments Ξ reach from g_k.

        The end of the step is the point that the increment ξ reaches.
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
        """Compute (Π, F), the momenta and forces conjugate to the coordinates y.

        They are Π = dτ_y^* μ and F = dτ_y^* w + (ddτ_y)^*(H, Π) for body momenta μ and
        body forces w. The second term of F is the gradient of ⟨μ, dτ_y H⟩ with respect
        to y.
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

        The coefficients â_ij belong to the method.

        **Arguments:**

        - `momentum`: μ_k, carried to the origin.
        - `transported`: h Σ b_j n^j, the sum of the forces carried to the origin.
        - `chart_force`: h Σ b_j F^j, the sum of the forces in the chart.
        """

    @abstractmethod
    def advance(
        self, start: PyTree[Array], compensation: PyTree[Array]
    ) -> tuple[PyTree[Array], PyTree[Array]]:
        """Compute the end g_{k+1} of the step as a compensated sum.

        A compensated sum is a pair: a number and its accumulated rounding error. The
        `start` is g_k before wrapping; see `AbstractLieGroup.wrapped`.
        """

    @abstractmethod
    def advance_momentum(
        self, momentum: Vector, gained: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Compute μ_{k+1} as a compensated sum, from μ_k and h Σ b_j n^j."""

    @abstractmethod
    def in_domain(self, y: Vectors) -> BoolScalar:
        """Return whether all y lie where the retraction τ is invertible."""


class FlatChart(AbstractChart):
    """The chart of a vector space, on which dτ and Ad^* are the identity.

    Most methods return an argument unchanged. A step on a vector space therefore costs
    no more than the paper's equations for vector spaces.
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
        """Return μ_k, because `transported` and `chart_force` are equal and cancel."""
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


class AbstractCurvedChart(AbstractChart):
    """A chart y -> g_o τ(y) of a Lie group with the retraction τ, for any origin."""

    def body_velocities(self, y: Vectors, velocity: Vectors) -> Vectors:
        """Compute the body velocities dτ_y H of the chart velocities H."""
        return jax.vmap(self.manifold.dtau)(y, velocity)

    def chart_velocities(self, y: Vectors, body_velocity: Vectors) -> Vectors:
        """Compute the chart velocities dτ_y⁻¹ η of the body velocities η."""
        return jax.vmap(self.manifold.dtau_inv)(y, body_velocity)

    def to_chart(
        self, y: Vectors, velocity: Vectors, momentum: Vectors, force: Vectors
    ) -> tuple[Vectors, Vectors]:
        """Compute (Π, F), the momenta and forces conjugate to the coordinates y."""

        def one(y, velocity, momentum, force):
            _, pullback = jax.vjp(self.manifold.dtau, y, velocity)
            curvature, chart_momentum = pullback(momentum)
            return chart_momentum, curvature + pullback(force)[1]

        return jax.vmap(one)(y, velocity, momentum, force)

    def to_origin(self, y: Vectors, covector: Vectors) -> Vectors:
        """Compute Ad^*_{τ(y)⁻¹} w: carry body covectors from g_o τ(y) to g_o."""
        return jax.vmap(self.manifold.to_start)(y, covector)

    def from_origin(self, y: Vectors, covector: Vectors) -> Vectors:
        """Compute Ad^*_{τ(y)} μ: carry body covectors from g_o to g_o τ(y)."""
        return jax.vmap(self.manifold.to_end)(y, covector)

    def in_domain(self, y: Vectors) -> BoolScalar:
        """Return whether all y lie where the retraction τ is invertible."""
        return jnp.all(jax.vmap(self.manifold.in_chart)(y))

    def _carried(
        self, y: Vector, momentum: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Apply Ad^*_{τ(y)} to a compensated sum; return a compensated sum.

        Without compensation, the rounding errors would accumulate over the steps, as
        in plain sums.
        """
        change = self.manifold.to_end_change(y, momentum)
        return two_sum(momentum, change + self.manifold.to_end(y, compensation))


class StartChart(AbstractCurvedChart):
    """The chart around the start g_k of the step, which the paper uses."""

    manifold: AbstractLieGroup
    start: PyTree[Array]
    increment: Vector

    @property
    def origin(self) -> PyTree[Array]:
        """Return the origin of the chart, which is g_k."""
        return self.start

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """Return the coordinates 0 and ξ of both ends of the step."""
        return jnp.zeros_like(self.increment), self.increment

    def coordinates(self, increment: Vectors) -> Vectors:
        """Return the increments Ξ, since the origin is g_k."""
        return increment

    def momentum_at_origin(self, momentum: Vector) -> Vector:
        """Return μ_k unchanged, because the origin is the start of the step."""
        return momentum

    def base_momentum(
        self, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Compute dτ_ξ^* μ_{k+1} - h Σ b_j F^j, the constant term of Π^i.

        Here μ_{k+1} = Ad^*_{τ(ξ)} (μ_k + h Σ b_j n^j).
        """
        known = momentum + transported
        return self.manifold.right_dtau_dual(self.increment, known) - chart_force

    def advance(
        self, start: PyTree[Array], compensation: PyTree[Array]
    ) -> tuple[PyTree[Array], PyTree[Array]]:
        """Compute g_k τ(ξ) by compensated summation."""
        return self.manifold.advance(start, self.increment, compensation)

    def advance_momentum(
        self, momentum: Vector, gained: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Compute Ad^*_{τ(ξ)} (μ_k + h Σ b_j n^j) by compensated summation."""
        total = two_sum(momentum, gained + compensation)
        return self._carried(self.increment, *total)


class MiddleChart(AbstractCurvedChart):
    """The chart in which a step goes from the coordinates -ξ/2 to ξ/2.

    Its origin is g_o = g_k τ(-ξ/2)⁻¹, and the end of the step is g_o τ(ξ/2). The step
    back from the end has the same chart, so that symmetric methods stay symmetric.
    """

    manifold: AbstractLieGroup
    start: PyTree[Array]
    increment: Vector

    @property
    def _half(self) -> Vector:
        return 0.5 * self.increment

    @property
    def origin(self) -> PyTree[Array]:
        """Compute the origin of the chart, g_k τ(-ξ/2)⁻¹."""
        return self.manifold.act_back(self.start, -self._half)

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """Return the coordinates -ξ/2 and ξ/2 of both ends of the step."""
        return -self._half, self._half

    def coordinates(self, increment: Vectors) -> Vectors:
        """Compute the coordinates y = Ξ - ξ/2 that belong to the increments Ξ."""
        return increment - self._half[None]

    def momentum_at_origin(self, momentum: Vector) -> Vector:
        """Compute Ad^*_{τ(-ξ/2)⁻¹} μ_k."""
        return self.manifold.to_start(-self._half, momentum)

    def base_momentum(
        self, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Compute ½ (dτ_{-ξ/2}^* μ_k + dτ_{ξ/2}^* μ_{k+1} - h Σ b_j F^j).

        Both ends enter in the same way. With the momentum M at the origin,
        μ_k = Ad^*_{τ(-ξ/2)} M and μ_{k+1} = Ad^*_{τ(ξ/2)} (M + h Σ b_j n^j).
        """
        start = self.manifold.right_dtau_dual(-self._half, momentum)
        end = self.manifold.right_dtau_dual(self._half, momentum + transported)
        return 0.5 * (start + end - chart_force)

    def advance(
        self, start: PyTree[Array], compensation: PyTree[Array]
    ) -> tuple[PyTree[Array], PyTree[Array]]:
        """Compute g_k τ(-ξ/2)⁻¹ τ(ξ/2) by compensated summation."""
        return self.manifold.advance_across(start, self._half, compensation)

    def advance_momentum(
        self, momentum: Vector, gained: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Carry μ_k to the origin, add h Σ b_j n^j, and carry the sum to the end."""
        change = self.manifold.to_start_change(-self._half, momentum)
        known, error = two_sum(
            momentum, change + self.manifold.to_start(-self._half, compensation)
        )
        return self._carried(self._half, *two_sum(known, gained + error))


_CURVED = {"start": StartChart, "middle": MiddleChart}


def chart_of_step(
    manifold: AbstractLieGroup, chart: str, start: PyTree[Array], increment: Vector
) -> AbstractChart:
    """Build the chart of a step that starts from g_k.

    **Arguments:**

    - `chart`: the place of the origin, which is the field `chart` of the method.
    - `start`: g_k.
    - `increment`: ξ = h Σ b_j H^j, the increment of the whole step.
    """
    kind = FlatChart if manifold.is_flat else _CURVED[chart]
    return kind(manifold, start, increment)
