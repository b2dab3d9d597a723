from abc import abstractmethod

from ._abstract import AbstractLieGroup, Element, Vector


class AbstractMotionGroup(AbstractLieGroup):
    """A group of rotations or rigid motions, whose retraction has τ(-ξ) = τ(ξ)⁻¹."""

    @abstractmethod
    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ - μ, without cancellation."""

    def to_end(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ as μ plus its change."""
        return mu + self.to_end_change(xi, mu)

    def to_start(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(-ξ)}^* μ, which is Ad_{τ(ξ)⁻¹}^* μ for these groups."""
        return self.to_end(-xi, mu)

    def to_start_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(-ξ)}^* μ - μ, without cancellation."""
        return self.to_end_change(-xi, mu)

    def act_back(self, g: Element, xi: Vector) -> Element:
        """Compute g τ(-ξ), which is g τ(ξ)⁻¹ for these groups."""
        return self.act(g, -xi)

    def advance_across(
        self, q: Element, xi: Vector, compensation: Element
    ) -> tuple[Element, Element]:
        """Compute g τ(ξ) τ(ξ), which is g τ(-ξ)⁻¹ τ(ξ) for these groups."""
        middle, compensation = self.advance(q, xi, compensation)
        return self.advance(middle, xi, compensation)

    def right_dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Compute dτ_{-ξ}^* μ, which is (Ad_{τ(ξ)} dτ_ξ)^* μ for these groups."""
        return self.dtau_dual(-xi, mu)
