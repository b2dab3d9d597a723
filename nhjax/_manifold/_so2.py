import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

from .._custom_types import BoolScalar
from .._numerics import two_sum
from ._abstract import AbstractLieGroup, check_shape
from ._plane import turn
from ._retraction import AbstractRetraction, Cayley, check_retraction, Exponential


Angle = Float[Array, "1"]
Vector = Float[Array, "1"]


class SO2(AbstractLieGroup):
    """The rotations of the plane: an angle θ, with angular velocity ω = dθ/dt.

    The angle is a lift, never wrapped to one turn: it counts the turns, and is the same
    array of shape (1,) as a coordinate of `Euclidean(1)`. With `Exponential()` the two
    groups are one; with `Cayley()` a step turns by 2 arctan(ω/2).

    **Arguments:**

    - `retraction`: `Cayley()` or `Exponential()`.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> nhjax.SO2().compose(jnp.array([0.5]), jnp.array([2.0]))
        Array([2.5], dtype=...)
    """

    retraction: AbstractRetraction = Cayley()

    def __check_init__(self):
        check_retraction("SO2", self.retraction)

    @property
    def dim(self) -> int:
        """1."""
        return 1

    @property
    def is_flat(self) -> bool:
        """Whether dτ = 1: with the exponential map."""
        return isinstance(self.retraction, Exponential)

    def identity(self, dtype: DTypeLike | None = None) -> Angle:
        """The angle 0."""
        return jnp.zeros(1, dtype)

    def check(self, q: Angle, name: str = "q") -> Angle:
        """`q`, or a `ShapeError` if it is not of shape (1,)."""
        return check_shape(q, (1,), "SO2", name)

    def in_chart(self, xi: Vector) -> BoolScalar:
        """Whether the rotation is short of the end of Cayley's chart."""
        if self.is_flat:
            return jnp.asarray(True)
        return self.retraction.in_chart(xi[0] ** 2)

    def compose(self, g: Angle, h: Angle) -> Angle:
        """The sum of the angles."""
        return g + h

    def inverse(self, g: Angle) -> Angle:
        """-θ."""
        return -g

    def retract(self, xi: Vector) -> Angle:
        """The angle of τ(ω)."""
        return self.retraction.angle(xi)

    def local(self, g: Angle) -> Vector:
        """The ω with τ(ω) = θ."""
        return self.retraction.rate(g)

    def advance(self, q: Angle, xi: Vector, compensation: Angle) -> tuple[Angle, Angle]:
        """g τ(ω) by compensated summation."""
        return two_sum(q, self.retract(xi) + compensation)

    def matrix(self, g: Angle) -> Float[Array, "2 2"]:
        """The rotation matrix."""
        basis = jnp.eye(2, dtype=g.dtype)
        return jnp.cos(g[0]) * basis + jnp.sin(g[0]) * turn(basis)

    def hat(self, xi: Vector) -> Float[Array, "2 2"]:
        """[[0, -ω], [ω, 0]]."""
        return xi[0] * turn(jnp.eye(2, dtype=xi.dtype))

    def tangent(self, g: Angle, eta: Vector) -> Angle:
        """η."""
        return eta

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """dτ_ω η."""
        if self.is_flat:
            return eta
        alpha, _, _ = self.retraction.dtau_coefficients(xi[0] ** 2)
        return alpha * eta

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """dτ_ω⁻¹ η."""
        if self.is_flat:
            return eta
        s = xi[0] ** 2
        alpha, gamma = self.retraction.dtau_inv_coefficients(s)
        return (alpha + gamma * s) * eta

    def Ad(self, g: Angle, eta: Vector) -> Vector:
        """η."""
        return eta

    def Ad_dual(self, g: Angle, mu: Vector) -> Vector:
        """μ."""
        return mu

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Zero."""
        return jnp.zeros_like(eta)

    def ad_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Zero."""
        return jnp.zeros_like(mu)
