import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

from .._custom_types import BoolScalar
from .._numerics import two_sum
from ._abstract import AbstractLieGroup, check_shape
from ._plane import turn, wrapped_angle
from ._retraction import AbstractRetraction, Cayley, check_retraction, Exponential


Angle = Float[Array, "1"]
Vector = Float[Array, "1"]


class SO2(AbstractLieGroup):
    """The group SO(2) of rotations of the plane, with an angle θ for an element.

    The velocity is ω = dθ/dt. The angle is never wrapped to one turn, so that it counts
    the turns: it is an array of shape (1,), as an element of `Euclidean(1)` is. Inside
    of a step the functions of the system are given the angle of the first turn, whose
    sine and cosine lose no digits after many turns: they must have the period 2π.

    With `Exponential()` the group is else the same as `Euclidean(1)`; with `Cayley()`
    the retraction turns by 2 arctan(ω/2).

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
        """Return the dimension 1 of the group."""
        return 1

    @property
    def is_flat(self) -> bool:
        """Tell whether dτ = 1, which is so with the exponential map."""
        return isinstance(self.retraction, Exponential)

    def identity(self, dtype: DTypeLike | None = None) -> Angle:
        """Return the identity, which is the angle 0."""
        return jnp.zeros(1, dtype)

    def check(self, q: Angle, name: str = "q") -> Angle:
        """Return `q`, or raise a `ShapeError` if it is not of shape (1,)."""
        return check_shape(q, (1,), "SO2", name)

    def in_chart(self, xi: Vector) -> BoolScalar:
        """Tell whether the rotation stays inside of the chart, if that has an end."""
        if self.is_flat:
            return jnp.asarray(True)
        return self.retraction.in_chart(xi[0] ** 2)

    def compose(self, g: Angle, h: Angle) -> Angle:
        """Compute the sum of the angles, the product of the rotations."""
        return g + h

    def inverse(self, g: Angle) -> Angle:
        """Compute the inverse rotation, which has the angle -θ."""
        return -g

    def retract(self, xi: Vector) -> Angle:
        """Compute the angle of the rotation τ(ω)."""
        return self.retraction.angle(xi)

    def local(self, g: Angle) -> Vector:
        """Compute the ω for which τ(ω) has the angle θ."""
        return self.retraction.rate(g)

    def wrapped(self, q: Angle, compensation: Angle) -> Angle:
        """Return the angle of the first turn, between -π and π."""
        return wrapped_angle(q, compensation)

    def advance(self, q: Angle, xi: Vector, compensation: Angle) -> tuple[Angle, Angle]:
        """Compute g τ(ω) by compensated summation."""
        return two_sum(q, self.retract(xi) + compensation)

    def advance_across(
        self, q: Angle, xi: Vector, compensation: Angle
    ) -> tuple[Angle, Angle]:
        """Compute g τ(ω)², which is g τ(-ω)⁻¹ τ(ω), by compensated summation."""
        return two_sum(q, 2 * self.retract(xi) + compensation)

    def matrix(self, g: Angle) -> Float[Array, "2 2"]:
        """Return the rotation matrix of the angle."""
        basis = jnp.eye(2, dtype=g.dtype)
        return jnp.cos(g[0]) * basis + jnp.sin(g[0]) * turn(basis)

    def hat(self, xi: Vector) -> Float[Array, "2 2"]:
        """Return the matrix [[0, -ω], [ω, 0]] of an angular velocity ω."""
        return xi[0] * turn(jnp.eye(2, dtype=xi.dtype))

    def tangent(self, g: Angle, eta: Vector) -> Angle:
        """Return η, which is the rate of the angle."""
        return eta

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ω η, the left-trivialised tangent of τ."""
        if self.is_flat:
            return eta
        alpha, _, _ = self.retraction.dtau_coefficients(xi[0] ** 2)
        return alpha * eta

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ω⁻¹ η, the inverse of the left-trivialised tangent."""
        if self.is_flat:
            return eta
        s = xi[0] ** 2
        alpha, gamma = self.retraction.dtau_inv_coefficients(s)
        return (alpha + gamma * s) * eta

    def Ad(self, g: Angle, eta: Vector) -> Vector:
        """Return η, because the group is commutative."""
        return eta

    def Ad_dual(self, g: Angle, mu: Vector) -> Vector:
        """Return μ, because the group is commutative."""
        return mu

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Return zero, because the group is commutative."""
        return jnp.zeros_like(eta)

    def ad_dual(self, xi: Vector, mu: Vector) -> Vector:
        """Return zero, because the group is commutative."""
        return jnp.zeros_like(mu)
