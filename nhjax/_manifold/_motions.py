from abc import abstractmethod

from ._abstract import AbstractLieGroup, Vector


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
