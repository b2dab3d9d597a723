import jax
import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

from .._custom_types import BoolScalar, FloatScalar
from .._numerics import two_sum
from ._abstract import check_shape
from ._homogeneous import homogeneous
from ._motions import AbstractMotionGroup
from ._quaternion import cross, dot, rotate, rotation_change, Vector3
from ._retraction import AbstractRetraction, Cayley, check_retraction, Exponential
from ._so3 import SO3


Pose = Float[Array, "7"]
Vector = Float[Array, "6"]


class SE3(AbstractMotionGroup):
    """The group SE(3) of rigid motions of space.

    An element is a unit quaternion q followed by a translation x, in one array of shape
    (7,). The body velocity is (v, ω), with dx/dt = R(q) v and dq/dt = q ∘ (0, ω/2).

    **Arguments:**

    - `retraction`: `Cayley()` or `Exponential()`.

    !!! example

        >>> import nhjax
        >>> nhjax.SE3().identity()
        Array([1., 0., 0., 0., 0., 0., 0.], dtype=...)
    """

    retraction: AbstractRetraction = Cayley()

    def __check_init__(self):
        check_retraction("SE3", self.retraction)

    @property
    def dim(self) -> int:
        """Return the dimension 6 of the group."""
        return 6

    @property
    def _rotations(self) -> SO3:
        return SO3(self.retraction)

    def identity(self, dtype: DTypeLike | None = None) -> Pose:
        """Return the identity (1, 0, 0, 0, 0, 0, 0)."""
        return jnp.array([1.0] + 6 * [0.0], dtype)

    def check(self, q: Pose, name: str = "q") -> Pose:
        """Return `q`, or raise a `ShapeError` if it is not of shape (7,)."""
        return check_shape(q, (7,), "SE3", name)

    def in_chart(self, xi: Vector) -> BoolScalar:
        """Tell whether the rotation of τ(ξ) stays inside of the chart."""
        return self._rotations.in_chart(xi[3:])

    def distance_to_group(self, q: Pose) -> FloatScalar:
        """Compute | |q| - 1 |, the deviation of the quaternion's norm from 1."""
        return self._rotations.distance_to_group(q[:4])

    def normalise(self, q: Pose) -> Pose:
        """Return `q` with its quaternion scaled to norm 1."""
        return jnp.concatenate([self._rotations.normalise(q[:4]), q[4:]])

    def compose(self, g: Pose, h: Pose) -> Pose:
        """Compute the product (q ∘ q', x + R(q) x') of (q, x) and (q', x')."""
        rotation = self._rotations.compose(g[:4], h[:4])
        return jnp.concatenate([rotation, g[4:] + rotate(g[:4], h[4:])])

    def inverse(self, g: Pose) -> Pose:
        """Compute the inverse (q*, -R(q)ᵀ x) of (q, x)."""
        rotation = self._rotations.inverse(g[:4])
        return jnp.concatenate([rotation, rotate(rotation, -g[4:])])

    def retract(self, xi: Vector) -> Pose:
        """Compute the motion τ(ξ)."""
        rotation = self._rotations.retract(xi[3:])
        return jnp.concatenate([rotation, self._translation(xi)])

    def _translation(self, xi):
        v, omega = xi[:3], xi[3:]
        if isinstance(self.retraction, Exponential):
            return self._rotations.dtau(-omega, v)
        return self._solve(-omega, v)

    def _solve(self, omega, v):
        """Compute (I + ω^/2)⁻¹ v, of which Cayley's map is made."""
        alpha, _, _ = self.retraction.dtau_coefficients(dot(omega, omega))
        return alpha * self._rotations.dtau_inv(-omega, v)

    def local(self, g: Pose) -> Vector:
        """Compute the ξ with τ(ξ) = g that has the shorter rotation vector."""
        omega, x = self._rotations.local(g[:4]), g[4:]
        if isinstance(self.retraction, Exponential):
            v = self._rotations.dtau_inv(-omega, x)
        else:
            v = x - 0.5 * cross(omega, x)
        return jnp.concatenate([v, omega])

    def advance(self, q: Pose, xi: Vector, compensation: Pose) -> tuple[Pose, Pose]:
        """Compute g τ(ξ) by compensated summation.

        The quaternion has norm 1 up to rounding.
        """
        step = rotate(q[:4], self._translation(xi))
        x, x_error = two_sum(q[4:], step + compensation[4:])
        rotation, error = self._rotations.advance(q[:4], xi[3:], compensation[:4])
        return jnp.concatenate([rotation, x]), jnp.concatenate([error, x_error])

    def matrix(self, g: Pose) -> Float[Array, "4 4"]:
        """Return the matrix of the motion in homogeneous coordinates."""
        return homogeneous(self._rotations.matrix(g[:4]), g[4:], 1.0)

    def hat(self, xi: Vector) -> Float[Array, "4 4"]:
        """Return the matrix [[ω^, v], [0, 0]] of ξ = (v, ω)."""
        return homogeneous(self._rotations.hat(xi[3:]), xi[:3], 0.0)

    def tangent(self, g: Pose, eta: Vector) -> Pose:
        """Compute the tangent (q ∘ (0, ω/2), R(q) v) at g of η = (v, ω)."""
        rotation = self._rotations.tangent(g[:4], eta[3:])
        return jnp.concatenate([rotation, rotate(g[:4], eta[:3])])

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ξ η, the left-trivialised tangent of τ."""
        if isinstance(self.retraction, Exponential):
            return _dual_part(self._rotations.dtau, xi, eta)
        sigma = self._rotations.dtau(xi[3:], eta[3:])
        u = self._solve(xi[3:], eta[:3]) + 0.5 * cross(sigma, xi[:3])
        return jnp.concatenate([u, sigma])

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ξ⁻¹ η, the inverse of the left-trivialised tangent."""
        if isinstance(self.retraction, Exponential):
            return _dual_part(self._rotations.dtau_inv, xi, eta)
        y = eta[:3] - 0.5 * cross(eta[3:], xi[:3])
        sigma = self._rotations.dtau_inv(xi[3:], eta[3:])
        return jnp.concatenate([y + 0.5 * cross(xi[3:], y), sigma])

    def Ad(self, g: Pose, eta: Vector) -> Vector:
        """Compute Ad_g η = (R u + x × R σ, R σ) of η = (u, σ)."""
        sigma = rotate(g[:4], eta[3:])
        u = rotate(g[:4], eta[:3]) + cross(g[4:], sigma)
        return jnp.concatenate([u, sigma])

    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ - μ, without cancellation.

        It is (Rᵀ m, Rᵀ (σ + m × x)) - μ for μ = (m, σ) and τ(ξ) = (R, x).
        """
        m, sigma = mu[:3], mu[3:]
        back = self._rotations.inverse(self._rotations.retract(xi[3:]))
        moment = rotate(back, cross(m, self._translation(xi)))
        turned = rotation_change(back, sigma)
        return jnp.concatenate([rotation_change(back, m), turned + moment])

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Compute [ξ, η] = (ω × u + v × σ, ω × σ) of ξ = (v, ω), η = (u, σ)."""
        return _dual_part(self._rotations.ad, xi, eta)


def _dual_part(function, xi: Vector, eta: Vector) -> Vector:
    """Extend a map of so(3) that is built from brackets to a map of se(3).

    A vector ξ = (v, ω) is the dual number ω + ε v with ε² = 0, so that a map built from
    brackets alone extends by its derivative: f(ω + ε v, σ + ε u) = f + ε Df (v, u).
    """
    value: Vector3
    slope: Vector3
    value, slope = jax.jvp(function, (xi[3:], eta[3:]), (xi[:3], eta[:3]))
    return jnp.concatenate([slope, value])
