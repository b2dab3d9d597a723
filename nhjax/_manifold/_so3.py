import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

from .._custom_types import BoolScalar, FloatScalar
from .._numerics import two_sum
from ._abstract import check_shape
from ._motions import AbstractMotionGroup
from ._quaternion import (
    conjugate,
    cross,
    cross_matrix,
    dot,
    multiply,
    multiply_vector,
    Quaternion,
    rotate,
    rotation_change,
    rotation_matrix,
    Vector3,
)
from ._retraction import AbstractRetraction, Cayley, check_retraction


class SO3(AbstractMotionGroup):
    """The rotations of space: a unit quaternion, with the body angular velocity ω.

    dq/dt = q ∘ (0, ω/2); `matrix(q)` takes body to space coordinates. The quaternion
    is the paper's g = (w, x, y, z). q and -q are the same rotation: `local` of either
    is the shorter vector.

    **Arguments:**

    - `retraction`: `Cayley()` or `Exponential()`.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> nhjax.SO3().retract(jnp.array([2.0, 0.0, 0.0])) ** 2
        Array([0.5, 0.5, 0. , 0. ], dtype=...)
    """

    retraction: AbstractRetraction = Cayley()

    def __check_init__(self):
        check_retraction("SO3", self.retraction)

    @property
    def dim(self) -> int:
        """3."""
        return 3

    def identity(self, dtype: DTypeLike | None = None) -> Quaternion:
        """(1, 0, 0, 0)."""
        return jnp.array([1.0, 0.0, 0.0, 0.0], dtype)

    def check(self, q: Quaternion, name: str = "q") -> Quaternion:
        """`q`, or a `ShapeError` if it is not of shape (4,)."""
        return check_shape(q, (4,), "SO3", name)

    def in_chart(self, xi: Vector3) -> BoolScalar:
        """Whether the rotation τ(ω) is short of the end of the chart."""
        return self.retraction.in_chart(dot(xi, xi))

    def distance_to_group(self, q: Quaternion) -> FloatScalar:
        """| |q| - 1 |."""
        return jnp.abs(jnp.sqrt(dot(q, q)) - 1)

    def normalise(self, q: Quaternion) -> Quaternion:
        """q / |q|."""
        return q / jnp.sqrt(dot(q, q))

    def compose(self, g: Quaternion, h: Quaternion) -> Quaternion:
        """The product of quaternions."""
        return multiply(g, h)

    def inverse(self, g: Quaternion) -> Quaternion:
        """The conjugate quaternion."""
        return conjugate(g)

    def retract(self, xi: Vector3) -> Quaternion:
        """τ(ω)."""
        return self._increment(xi) + self.identity(xi.dtype)

    def _increment(self, xi):
        """τ(ω) - 1, without cancellation."""
        w, ratio = self.retraction.half_rotation(dot(xi, xi))
        return jnp.concatenate([w[None], ratio * xi])

    def local(self, g: Quaternion) -> Vector3:
        """The shortest ω with the rotation τ(ω) = g."""
        return self.retraction.rotation_vector(g[0], g[1:])

    def advance(
        self, q: Quaternion, xi: Vector3, compensation: Quaternion
    ) -> tuple[Quaternion, Quaternion]:
        """q + q ∘ (τ(ω) - 1) by compensated summation, of norm 1 to rounding."""
        total, error = two_sum(q, multiply(q, self._increment(xi)) + compensation)
        # One Newton step for the norm, on sum and error together: what rounding adds
        # to the norm in one step is gone in the next, and the rotation is not touched.
        correction = 0.5 * (1 - dot(total, total)) - dot(total, error)
        return total, error + correction * total

    def matrix(self, g: Quaternion) -> Float[Array, "3 3"]:
        """The rotation matrix."""
        return rotation_matrix(g)

    def hat(self, xi: Vector3) -> Float[Array, "3 3"]:
        """The matrix of ω ×."""
        return cross_matrix(xi)

    def tangent(self, g: Quaternion, eta: Vector3) -> Quaternion:
        """q ∘ (0, η/2)."""
        return 0.5 * multiply_vector(g, eta)

    def dtau(self, xi: Vector3, eta: Vector3) -> Vector3:
        """dτ_ω η = α η - β ω × η + γ (ω·η) ω."""
        alpha, beta, gamma = self.retraction.dtau_coefficients(dot(xi, xi))
        return alpha * eta - beta * cross(xi, eta) + gamma * dot(xi, eta) * xi

    def dtau_inv(self, xi: Vector3, eta: Vector3) -> Vector3:
        """dτ_ω⁻¹ η = α η + ½ ω × η + γ (ω·η) ω."""
        alpha, gamma = self.retraction.dtau_inv_coefficients(dot(xi, xi))
        return alpha * eta + 0.5 * cross(xi, eta) + gamma * dot(xi, eta) * xi

    def dtau_dual(self, xi: Vector3, mu: Vector3) -> Vector3:
        """dτ_ω^* = dτ_{-ω}."""
        return self.dtau(-xi, mu)

    def dtau_inv_dual(self, xi: Vector3, mu: Vector3) -> Vector3:
        """(dτ_ω⁻¹)^* = dτ_{-ω}⁻¹."""
        return self.dtau_inv(-xi, mu)

    def Ad(self, g: Quaternion, eta: Vector3) -> Vector3:
        """R(g) η."""
        return rotate(g, eta)

    def Ad_dual(self, g: Quaternion, mu: Vector3) -> Vector3:
        """R(g)ᵀ μ."""
        return rotate(conjugate(g), mu)

    def to_end_change(self, xi: Vector3, mu: Vector3) -> Vector3:
        """R(τ(ξ))ᵀ μ - μ, without cancellation."""
        return rotation_change(conjugate(self.retract(xi)), mu)

    def ad(self, xi: Vector3, eta: Vector3) -> Vector3:
        """ξ × η."""
        return cross(xi, eta)

    def ad_dual(self, xi: Vector3, mu: Vector3) -> Vector3:
        """μ × ξ."""
        return cross(mu, xi)
