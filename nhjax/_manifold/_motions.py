from abc import abstractmethod

from ._abstract import AbstractLieGroup, Vector


class AbstractMotionGroup(AbstractLieGroup):
    """Rotations or rigid motions, with a retraction that has τ(-ξ) = τ(ξ)⁻¹."""

    @abstractmethod
    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Ad_{τ(ξ)}^* μ - μ, without cancellation."""

    def to_end(self, xi: Vector, mu: Vector) -> Vector:
        """Ad_{τ(ξ)}^* μ."""
        return mu + self.to_end_change(xi, mu)

    def to_start(self, xi: Vector, mu: Vector) -> Vector:
        """Ad_{τ(-ξ)}^* μ."""
        return self.to_end(-xi, mu)
