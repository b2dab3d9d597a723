"""The charts of a Lie group in which a step can be written, by its retraction."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._custom_types import BoolScalar
from .._manifold import AbstractLieGroup
from .._numerics import two_sum
from ._chart import AbstractChart, FlatChart, Vector, Vectors


class AbstractCurvedChart(AbstractChart):
    """A chart y -> g_o τ(y) of a Lie group by its retraction τ, wherever g_o lies."""

    def body_velocities(self, y: Vectors, velocity: Vectors) -> Vectors:
        """Compute the body velocities dτ_y H of the chart velocities H."""
        return jax.vmap(self.manifold.dtau)(y, velocity)

    def chart_velocities(self, y: Vectors, body_velocity: Vectors) -> Vectors:
        """Compute the chart velocities dτ_y⁻¹ η of the body velocities η."""
        return jax.vmap(self.manifold.dtau_inv)(y, body_velocity)

    def to_chart(
        self, y: Vectors, velocity: Vectors, momentum: Vectors, force: Vectors
    ) -> tuple[Vectors, Vectors]:
        """Compute (Π, F), the momenta and forces with respect to the coordinates y."""

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
        """Tell whether all y lie where the retraction τ is invertible."""
        return jnp.all(jax.vmap(self.manifold.in_chart)(y))

    def _carried(
        self, y: Vector, momentum: Vector, compensation: Vector
    ) -> tuple[Vector, Vector]:
        """Apply Ad^*_{τ(y)} to a compensated sum; return a compensated sum.

        The rounding errors of plain products with Ad^* would add up over the steps, as
        those of plain sums do.
        """
        change = self.manifold.to_end_change(y, momentum)
        return two_sum(momentum, change + self.manifold.to_end(y, compensation))


class StartChart(AbstractCurvedChart):
    """The chart around the start g_k of the step, that of the paper."""

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
        """Return the momentum μ_k, which is given at the origin."""
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
    """The chart in whose coordinates a step leads from -ξ/2 to ξ/2.

    Its origin is g_o = g_k τ(-ξ/2)⁻¹, and the end of the step is g_o τ(ξ/2). Seen from
    the end, a step back has the same chart, so that symmetric methods stay symmetric.
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
        """Compute the coordinates y = Ξ - ξ/2 of the stages."""
        return increment - self._half[None]

    def momentum_at_origin(self, momentum: Vector) -> Vector:
        """Compute Ad^*_{τ(-ξ/2)⁻¹} μ_k."""
        return self.manifold.to_start(-self._half, momentum)

    def base_momentum(
        self, momentum: Vector, transported: Vector, chart_force: Vector
    ) -> Vector:
        """Compute ½ (dτ_{-ξ/2}^* μ_k + dτ_{ξ/2}^* μ_{k+1} - h Σ b_j F^j).

        Both ends enter alike. With the momentum M at the origin these are
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
    """Make the chart of a step from g_k.

    **Arguments:**

    - `chart`: where the origin of the chart lies, the field `chart` of the method.
    - `start`: g_k.
    - `increment`: ξ = h Σ b_j H^j, the increment of the whole step.
    """
    kind = FlatChart if manifold.is_flat else _CURVED[chart]
    return kind(manifold, start, increment)
