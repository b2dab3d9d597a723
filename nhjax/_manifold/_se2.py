import jax.numpy as jnp
from jaxtyping import Array, DTypeLike, Float

from .._custom_types import BoolScalar
from .._numerics import two_sum
from ._abstract import check_shape, Element
from ._framed_pose import FramedPose
from ._homogeneous import homogeneous
from ._motions import AbstractMotionGroup
from ._plane import rotate, turn, wrapped_angle
from ._retraction import AbstractRetraction, Cayley, check_retraction
from ._so2 import SO2


Pose = Float[Array, "3"]
Vector = Float[Array, "3"]


class SE2(AbstractMotionGroup):
    """The group SE(2) of rigid motions of the plane, with elements (x, y, θ).

    The body velocity is (v1, v2, ω), with d(x, y)/dt = R(θ) (v1, v2) and dθ/dt = ω. The
    angle is never wrapped to one turn, and the functions of a system must have the
    period 2π in it, as on `SO2`.

    **Arguments:**

    - `retraction`: `Cayley()` or `Exponential()`.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> nhjax.SE2().tangent(jnp.zeros(3), jnp.array([1.0, 0.0, 2.0]))
        Array([1., 0., 2.], dtype=...)
    """

    retraction: AbstractRetraction = Cayley()

    def __check_init__(self):
        check_retraction("SE2", self.retraction)

    @property
    def dim(self) -> int:
        """Return the dimension 3 of the group."""
        return 3

    def identity(self, dtype: DTypeLike | None = None) -> Pose:
        """Return the identity (0, 0, 0)."""
        return jnp.zeros(3, dtype)

    def check(self, q: Pose, name: str = "q") -> Pose:
        """Return `q`, or raise a `ShapeError` if it is not of shape (3,)."""
        return check_shape(q, (3,), "SE2", name)

    def in_chart(self, xi: Vector) -> BoolScalar:
        """Tell whether the rotation of τ(ξ) stays inside of the chart."""
        return self.retraction.in_chart(xi[2] ** 2)

    def compose(self, g: Pose, h: Pose) -> Pose:
        """Compute the product (x + R(θ) x', θ + θ') of (x, θ) and (x', θ')."""
        return g + _moved(g, h)

    def act(self, g: Element, xi: Vector) -> Element:
        """Compute g τ(ξ), with its frame if g has one.

        Inside of a step poses are given with their frames, the cosine and sine of θ.
        """
        if not isinstance(g, FramedPose):
            return super().act(g, xi)
        less, sin = self.retraction.plane_rotation(xi[2])
        return FramedPose(
            g.pose + _moved(g, self.retract(xi)),
            g.cos + (less * g.cos - sin * g.sin),
            g.sin + (less * g.sin + sin * g.cos),
        )

    def inverse(self, g: Pose) -> Pose:
        """Compute the inverse (-R(θ)ᵀ x, -θ) of (x, θ)."""
        return jnp.concatenate([rotate(-g[2], -g[:2]), -g[2:]])

    def retract(self, xi: Vector) -> Pose:
        """Compute the motion τ(ξ)."""
        return jnp.concatenate([self._translation(xi), self.retraction.angle(xi[2:])])

    def _translation(self, xi: Vector) -> Float[Array, "2"]:
        v, omega = xi[:2], xi[2]
        alpha, beta, _ = self.retraction.dtau_coefficients(omega**2)
        return alpha * v + beta * omega * turn(v)

    def local(self, g: Pose) -> Vector:
        """Compute the ξ with τ(ξ) = g."""
        rate = self.retraction.rate(g[2:])
        omega = rate[0]
        alpha, _ = self.retraction.dtau_inv_coefficients(omega**2)
        v = alpha * g[:2] - 0.5 * omega * turn(g[:2])
        return jnp.concatenate([v, rate])

    def wrapped(self, q: Pose, compensation: Pose) -> Pose:
        """Return the pose with its angle reduced to one turn, between -π and π."""
        return jnp.concatenate([q[:2], wrapped_angle(q[2:], compensation[2:])])

    def advance(self, q: Pose, xi: Vector, compensation: Pose) -> tuple[Pose, Pose]:
        """Compute g τ(ξ) by compensated summation."""
        direction = self.wrapped(q, compensation)
        return two_sum(q, _moved(direction, self.retract(xi)) + compensation)

    def matrix(self, g: Pose) -> Float[Array, "3 3"]:
        """Return the matrix of the motion in homogeneous coordinates."""
        rotation = SO2(self.retraction).matrix(g[2:])
        return homogeneous(rotation, g[:2], 1.0)

    def hat(self, xi: Vector) -> Float[Array, "3 3"]:
        """Return the matrix [[ω J, v], [0, 0]] of ξ = (v, ω)."""
        return homogeneous(SO2(self.retraction).hat(xi[2:]), xi[:2], 0.0)

    def tangent(self, g: Element, eta: Vector) -> Element:
        """Compute the tangent (R(θ) v, ω) at g = (x, θ) of η = (v, ω).

        The frame, if there is one, changes by -ω sin θ and ω cos θ.
        """
        rate = _moved(g, eta)
        if not isinstance(g, FramedPose):
            return rate
        return FramedPose(rate, -eta[2] * g.sin, eta[2] * g.cos)

    def dtau(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ξ η, by the formula of `SO3` for motions of the plane."""
        v, omega = xi[:2], xi[2]
        u, sigma = eta[:2], eta[2]
        s = omega**2
        alpha, beta, gamma = self.retraction.dtau_coefficients(s)
        bracket = omega * turn(u) - sigma * turn(v)
        linear = alpha * u - beta * bracket + gamma * omega * sigma * v
        return jnp.concatenate([linear, (alpha + gamma * s) * eta[2:]])

    def dtau_inv(self, xi: Vector, eta: Vector) -> Vector:
        """Compute dτ_ξ⁻¹ η, by the formula of `SO3` for motions of the plane."""
        v, omega = xi[:2], xi[2]
        u, sigma = eta[:2], eta[2]
        s = omega**2
        alpha, gamma = self.retraction.dtau_inv_coefficients(s)
        bracket = omega * turn(u) - sigma * turn(v)
        linear = alpha * u + 0.5 * bracket + gamma * omega * sigma * v
        return jnp.concatenate([linear, (alpha + gamma * s) * eta[2:]])

    def Ad(self, g: Pose, eta: Vector) -> Vector:
        """Compute Ad_g η = (R(θ) u - σ J x, σ) of η = (u, σ)."""
        linear = rotate(g[2], eta[:2]) - eta[2] * turn(g[:2])
        return jnp.concatenate([linear, eta[2:]])

    def to_end_change(self, xi: Vector, mu: Vector) -> Vector:
        """Compute Ad_{τ(ξ)}^* μ - μ, without cancellation.

        It is (R(θ)ᵀ m - m, -m·J x) for μ = (m, σ) and τ(ξ) = (x, θ).
        """
        # With Cayley's map neither the angle nor trigonometric functions are needed.
        less, sin = self.retraction.plane_rotation(xi[2])
        moment = jnp.sum(turn(self._translation(xi)) * mu[:2])
        turned = less * mu[:2] - sin * turn(mu[:2])
        return jnp.concatenate([turned, -moment[None]])

    def ad(self, xi: Vector, eta: Vector) -> Vector:
        """Compute [ξ, η] = (ω J u - σ J v, 0) of ξ = (v, ω) and η = (u, σ)."""
        linear = xi[2] * turn(eta[:2]) - eta[2] * turn(xi[:2])
        return jnp.concatenate([linear, jnp.zeros_like(eta[2:])])


def _moved(g: Pose | FramedPose, move: Pose | Vector) -> Pose:
    """Turn the first two numbers of a move from the frame of the body g."""
    v = move[:2]
    turned = g.rotate(v) if isinstance(g, FramedPose) else rotate(g[2], v)
    return jnp.concatenate([turned, move[2:]])
