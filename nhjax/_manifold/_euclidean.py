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
        """The dimension n."""
        return self.n

    @property
    def is_flat(self) -> bool:
        """True: dτ and Ad are identities."""
        return True

    def identity(self, dtype: DTypeLike | None = None) -> Point:
        """The zero vector."""
        return jnp.zeros(self.n, dtype)

    def check(self, q: Point, name: str = "q") -> Point:
        """`q`, or a `ShapeError` if it is not of shape (n,)."""
        return check_shape(q, (self.n,), f"Euclidean({self.n})", name)

    def compose(self, g: Point, h: Point) -> Point:
        """The sum g + h."""
        return g + h

    def inverse(self, g: Point) -> Point:
        """-g."""
        return -g

    def retract(self, xi: Vector) -> Point:
        """ξ."""
        return xi

    def local(self, g: Point) -> Vector:
        """g."""
        return g

    def advance(self, q: Point, xi: Vector, compensation: Point) -> tuple[Point, Point]:
        """The point q + ξ by compensated summation."""
        return two_sum(q, xi + compensation)

    def matrix(self, g: Point) -> Float[Array, "n+1 n+1"]:
        """The translation by g, in homogeneous coordinates."""
        return homogeneous(jnp.eye(self.n, dtype=g.dtype), g, 1.0)

    def hat(self, xi: Vector) -> Float[Array, "n+1 n+1"]:
        """ξ as the last column of a matrix."""
        return homogeneous(jnp.zeros((self.n, self.n), xi.dtype), xi, 0.0)

    def tangent(self, g: Point, eta: Vector) -> Point:
        """η."""
        return eta

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """η."""
        return eta

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """η."""
        return eta

    def ddtau(self, xi: Vector, eta: Vector, delta: Vector) -> Vector:
        """Zero."""
        return jnp.zeros_like(eta)

    def dtau_dual(self, xi: Vector, mu: Vector) -> Vector:
        """μ."""
        return mu

    def dtau_inv_dual(self, xi: Vector, mu: Vector) -> Vector:
        """μ."""
        return mu

    def ddtau_dual(self, xi: Vector, eta: Vector, mu: Vector) -> Vector:
        """Zero."""
        return jnp.zeros_like(mu)

    def Ad(self, g: Point, eta: Vector) -> Vector:
        """η."""
        return eta

    def Ad_dual(self, g: Point, mu: Vector) -> Vector:
        """μ."""
        return mu

    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """0."""
        return jnp.zeros_like(mu)

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Zero."""
        return jnp.zeros_like(eta)

    def ad_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Zero."""
        return jnp.zeros_like(mu)
