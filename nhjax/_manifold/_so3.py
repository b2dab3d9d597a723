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
    """The group SO(3) of rotations of space, with a unit quaternion for an element.

    The velocity is the body angular velocity ω, with dq/dt = q ∘ (0, ω/2); `matrix(q)`
    takes body to space coordinates. The quaternion is the paper's g = (w, x, y, z). The
    quaternions q and -q are the same rotation: `local` of either is the shorter vector.

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
        """Return the dimension 3 of the group."""
        return 3

    def identity(self, dtype: DTypeLike | None = None) -> Quaternion:
        """Return the identity (1, 0, 0, 0)."""
        return jnp.array([1.0, 0.0, 0.0, 0.0], dtype)

    def check(self, q: Quaternion, name: str = "q") -> Quaternion:
        """Return `q`, or raise a `ShapeError` if it is not of shape (4,)."""
        return check_shape(q, (4,), "SO3", name)

    def in_chart(self, xi: Vector3) -> BoolScalar:
        """Tell whether the rotation τ(ω) stays inside of the chart."""
        return self.retraction.in_chart(dot(xi, xi))

    def distance_to_group(self, q: Quaternion) -> FloatScalar:
        """Compute | |q| - 1 |, the deviation of the norm from 1."""
        return jnp.abs(jnp.sqrt(dot(q, q)) - 1)

    def normalise(self, q: Quaternion) -> Quaternion:
        """Return q / |q|, the quaternion scaled to norm 1."""
        return q / jnp.sqrt(dot(q, q))

    def compose(self, g: Quaternion, h: Quaternion) -> Quaternion:
        """Compute the product of two quaternions."""
        return multiply(g, h)

    def inverse(self, g: Quaternion) -> Quaternion:
        """Compute the conjugate quaternion, which is the inverse."""
        return conjugate(g)

    def retract(self, xi: Vector3) -> Quaternion:
        """Compute the unit quaternion τ(ω)."""
        return self._increment(xi) + self.identity(xi.dtype)

    def _increment(self, xi):
        """Compute τ(ω) - 1, without cancellation."""
        w, ratio = self.retraction.half_rotation(dot(xi, xi))
        return jnp.concatenate([w[None], ratio * xi])

    def local(self, g: Quaternion) -> Vector3:
        """Compute the shortest ω for which τ(ω) is the rotation g."""
        return self.retraction.rotation_vector(g[0], g[1:])

    def advance(
        self, q: Quaternion, xi: Vector3, compensation: Quaternion
    ) -> tuple[Quaternion, Quaternion]:
        """Compute q ∘ τ(ω) as q + q ∘ (τ(ω) - 1) by compensated summation.

        The result has norm 1 up to rounding.
        """
        total, error = two_sum(q, multiply(q, self._increment(xi)) + compensation)
        # This is one Newton step for the norm, applied to sum and error together: what
        # rounding adds to the norm in one step is removed in the next, and the rotation
        # is not changed.
        correction = 0.5 * (1 - dot(total, total)) - dot(total, error)
        return total, error + correction * total

    def matrix(self, g: Quaternion) -> Float[Array, "3 3"]:
        """Return the rotation matrix of the quaternion."""
        return rotation_matrix(g)

    def hat(self, xi: Vector3) -> Float[Array, "3 3"]:
        """Return the matrix of the linear map x -> ω × x."""
        return cross_matrix(xi)

    def tangent(self, g: Quaternion, eta: Vector3) -> Quaternion:
        """Compute the tangent q ∘ (0, η/2) at q."""
        return 0.5 * multiply_vector(g, eta)

    def dtau(self, xi: Vector3, eta: Vector3) -> Vector3:
        """Compute dτ_ω η = α η - β ω × η + γ (ω·η) ω."""
        alpha, beta, gamma = self.retraction.dtau_coefficients(dot(xi, xi))
        return alpha * eta - beta * cross(xi, eta) + gamma * dot(xi, eta) * xi

    def dtau_inv(self, xi: Vector3, eta: Vector3) -> Vector3:
        """Compute dτ_ω⁻¹ η = α η + ½ ω × η + γ (ω·η) ω."""
        alpha, gamma = self.retraction.dtau_inv_coefficients(dot(xi, xi))
        return alpha * eta + 0.5 * cross(xi, eta) + gamma * dot(xi, eta) * xi

    def dtau_dual(self, xi: Vector3, mu: Vector3) -> Vector3:
        """Compute dτ_ω^* μ, by dτ_ω^* = dτ_{-ω}."""
        return self.dtau(-xi, mu)

    def dtau_inv_dual(self, xi: Vector3, mu: Vector3) -> Vector3:
        """Compute (dτ_ω⁻¹)^* μ, by (dτ_ω⁻¹)^* = dτ_{-ω}⁻¹."""
        return self.dtau_inv(-xi, mu)

    def Ad(self, g: Quaternion, eta: Vector3) -> Vector3:
        """Compute Ad_g η = R(g) η."""
        return rotate(g, eta)

    def Ad_dual(self, g: Quaternion, mu: Vector3) -> Vector3:
        """Compute Ad_g^* μ = R(g)ᵀ μ."""
        return rotate(conjugate(g), mu)

    def to_end_change(self, xi: Vector3, mu: Vector3) -> Vector3:
        """Compute Ad_{τ(ξ)}^* μ - μ = R(τ(ξ))ᵀ μ - μ, without cancellation."""
        return rotation_change(conjugate(self.retract(xi)), mu)

    def ad(self, xi: Vector3, eta: Vector3) -> Vector3:
        """Compute the bracket [ξ, η] = ξ × η."""
        return cross(xi, eta)

    def ad_dual(self, xi: Vector3, mu: Vector3) -> Vector3:
        """Compute ad_ξ^* μ = μ × ξ."""
        return cross(mu, xi)
