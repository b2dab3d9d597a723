import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

from .._numerics import two_sum
from ._abstract import AbstractLieGroup, check_shape
from ._homogeneous import homogeneous


Point = Float[Array, " n"]
Vector = Float[Array, " n"]


class Euclidean(AbstractLieGroup):
    """The vector space R^n: the abelian group whose retraction is the identity.

    **Arguments:**

    - `n`: the number of coordinates.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> plane = nhjax.Euclidean(2)
        >>> plane.compose(jnp.array([1.0, 2.0]), jnp.array([3.0, 4.0])).tolist()
        [4.0, 6.0]
    """

    n: int = eqx.field(static=True)

    def __check_init__(self):
        if isinstance(self.n, bool) or not isinstance(self.n, int) or self.n < 1:
            raise ValueError(f"Euclidean: `n` must be an int >= 1, got {self.n!r}.")

    @property
    def dim(self) -> int:
        """Return the dimension n of the space."""
        return self.n

    @property
    def is_flat(self) -> bool:
        """Return True, because dτ and Ad are identities here."""
        return True

    def identity(self, dtype: DTypeLike | None = None) -> Point:
        """Return the zero vector, which is the identity of the group."""
        return jnp.zeros(self.n, dtype)

    def check(self, q: Point, name: str = "q") -> Point:
        """Return `q`, or raise a `ShapeError` if it is not of shape (n,)."""
        return check_shape(q, (self.n,), f"Euclidean({self.n})", name)

    def compose(self, g: Point, h: Point) -> Point:
        """Compute the sum g + h, which is the product of the group."""
        return g + h

    def inverse(self, g: Point) -> Point:
        """Compute -g, the inverse of g in the group."""
        return -g

    def retract(self, xi: Vector) -> Point:
        """Return ξ, because the retraction is the identity."""
        return xi

    def local(self, g: Point) -> Vector:
        """Return g, because the retraction is the identity."""
        return g

    def advance(self, q: Point, xi: Vector, compensation: Point) -> tuple[Point, Point]:
        """Compute the point q + ξ by compensated summation."""
        return two_sum(q, xi + compensation)

    def advance_across(
        self, q: Point, xi: Vector, compensation: Point
    ) -> tuple[Point, Point]:
        """Compute the point q + 2 ξ by compensated summation."""
        return self.advance(q, 2 * xi, compensation)

    def matrix(self, g: Point) -> Float[Array, "n+1 n+1"]:
        """Return the matrix of the translation by g in homogeneous coordinates."""
        return homogeneous(jnp.eye(self.n, dtype=g.dtype), g, 1.0)

    def hat(self, xi: Vector) -> Float[Array, "n+1 n+1"]:
        """Return the matrix of ξ, which has ξ as its last column."""
        return homogeneous(jnp.zeros((self.n, self.n), xi.dtype), xi, 0.0)

    def tangent(self, g: Point, eta: Vector) -> Point:
        """Return η, because the tangent of a translation is the identity."""
        return eta

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """Return η, because dτ is the identity."""
        return eta

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """Return η, because dτ⁻¹ is the identity."""
        return eta

    def ddtau(self, xi: Vector, eta: Vector, delta: Vector) -> Vector:
        """Return zero, because dτ is constant."""
        return jnp.zeros_like(eta)

    def dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Return μ, because dτ is the identity."""
        return mu

    def dtau_inv_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Return μ, because dτ⁻¹ is the identity."""
        return mu

    def ddtau_dual(self, xi: Vector, eta: Vector, mu: Vector) -> Vector:
        """Return zero, because dτ is constant."""
        return jnp.zeros_like(mu)

    def Ad(self, g: Point, eta: Vector) -> Vector:
        """Return η, because the group is commutative."""
        return eta

    def Ad_dual(self, g: Point, mu: Vector) -> Vector:
        """Return μ, because the group is commutative."""
        return mu

    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Return zero, because Ad^* is the identity."""
        return jnp.zeros_like(mu)

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Return zero, because the group is commutative."""
        return jnp.zeros_like(eta)

    def ad_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Return zero, because the group is commutative."""
        return jnp.zeros_like(mu)
