"""The groups of the plane, SO(2) and SE(2), with angles that count turns.

An angle is never wrapped to one turn when it is stored. Inside a step, a pose of SE(2)
also contains the cosine and sine of its angle (`FramedPose`), so that trigonometric
functions are not evaluated again at every stage.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, DTypeLike, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._numerics import two_sum
from ._group import (
    AbstractLieGroup,
    AbstractMotionGroup,
    check_shape,
    Element,
    homogeneous,
)
from ._product import ProductGroup
from ._retraction import AbstractRetraction, Cayley, check_retraction, Exponential


Angle = Float[Array, "1"]
Rate = Float[Array, "1"]
Pose = Float[Array, "3"]
Twist = Float[Array, "3"]


class SO2(AbstractLieGroup):
    """The group SO(2) of rotations of the plane. An element is an angle θ.

    The velocity is ω = dθ/dt. The angle is an array of shape (1,), like an element of
    `Euclidean(1)`. It is never wrapped to one turn, so that it counts the turns. Inside
    a step, however, the functions of the system receive the equivalent angle between -π
    and π, whose sine and cosine lose no digits after many turns. These functions must
    therefore have the period 2π.

    Otherwise, the group with `Exponential()` is the same as `Euclidean(1)`. With
    `Cayley()` the retraction rotates by 2 arctan(ω/2).

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
        """Return whether dτ = 1, which holds for the exponential map."""
        return isinstance(self.retraction, Exponential)

    def identity(self, dtype: DTypeLike | None = None) -> Angle:
        """Return the identity, the angle 0."""
        return jnp.zeros(1, dtype)

    def check(self, q: Angle, name: str = "q") -> Angle:
        """Return `q`, or raise a `ShapeError` if it is not of shape (1,)."""
        return check_shape(q, (1,), "SO2", name, "an angle")

    def in_chart(self, xi: Rate) -> BoolScalar:
        """Return whether the rotation is in the chart; True for the exponential map."""
        if self.is_flat:
            return jnp.asarray(True)
        return self.retraction.in_chart(xi[0] ** 2)

    def compose(self, g: Angle, h: Angle) -> Angle:
        """Compute the sum of the angles, the angle of the product of the rotations."""
        return g + h

    def inverse(self, g: Angle) -> Angle:
        """Compute -θ, the angle of the inverse rotation."""
        return -g

    def retract(self, xi: Rate) -> Angle:
        """Compute the angle of the rotation τ(ω)."""
        return self.retraction.angle(xi)

    def local(self, g: Angle) -> Rate:
        """Compute the rate ω for which τ(ω) has the angle θ."""
        return self.retraction.rate(g)

    def wrapped(self, q: Angle, compensation: Angle) -> Angle:
        """Return the equivalent angle between -π and π."""
        return wrapped_angle(q, compensation)

    def advance(self, q: Angle, xi: Rate, compensation: Angle) -> tuple[Angle, Angle]:
        """Compute g τ(ω) by compensated summation."""
        return two_sum(q, self.retract(xi) + compensation)

    def advance_across(
        self, q: Angle, xi: Rate, compensation: Angle
    ) -> tuple[Angle, Angle]:
        """Compute g τ(ω)², which is g τ(-ω)⁻¹ τ(ω), by compensated summation."""
        return two_sum(q, 2 * self.retract(xi) + compensation)

    def matrix(self, g: Angle) -> Float[Array, "2 2"]:
        """Return the rotation matrix of the angle."""
        basis = jnp.eye(2, dtype=g.dtype)
        return jnp.cos(g[0]) * basis + jnp.sin(g[0]) * quarter_turn(basis)

    def hat(self, xi: Rate) -> Float[Array, "2 2"]:
        """Return the matrix [[0, -ω], [ω, 0]] of an angular velocity ω."""
        return xi[0] * quarter_turn(jnp.eye(2, dtype=xi.dtype))

    def tangent(self, g: Angle, eta: Rate) -> Angle:
        """Return η, because the tangent of θ -> θ + θ' is the identity."""
        return eta

    def dtau(self, xi: Rate, eta: Rate) -> Rate:
        """Compute dτ_ω η, the left-trivialised tangent of τ."""
        if self.is_flat:
            return eta
        alpha, _, _ = self.retraction.dtau_coefficients(xi[0] ** 2)
        return alpha * eta

    def dtau_inv(self, xi: Rate, eta: Rate) -> Rate:
        """Compute dτ_ω⁻¹ η, the inverse of the left-trivialised tangent."""
        if self.is_flat:
            return eta
        s = xi[0] ** 2
        alpha, gamma = self.retraction.dtau_inv_coefficients(s)
        return (alpha + gamma * s) * eta

    def Ad(self, g: Angle, eta: Rate) -> Rate:
        """Return η, because the group is commutative."""
        return eta

    def Ad_dual(self, g: Angle, mu: Rate) -> Rate:
        """Return μ, because the group is commutative."""
        return mu

    def ad(self, xi: Rate, eta: Rate) -> Rate:
        """Return zero, because the group is commutative."""
        return jnp.zeros_like(eta)

    def ad_dual(self, xi: Rate, mu: Rate) -> Rate:
        """Return zero, because the group is commutative."""
        return jnp.zeros_like(mu)


class SE2(AbstractMotionGroup):
    """The group SE(2) of rigid motions of the plane, with elements (x, y, θ).

    The body velocity is (v1, v2, ω), with d(x, y)/dt = R(θ) (v1, v2) and dθ/dt = ω. As
    on `SO2`, the angle is never wrapped to one turn, and the functions of a system must
    be 2π-periodic in the angle.

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
        return check_shape(q, (3,), "SE2", name, "(x, y, angle)")

    def in_chart(self, xi: Twist) -> BoolScalar:
        """Return whether the rotation of τ(ξ) is inside the chart."""
        return self.retraction.in_chart(xi[2] ** 2)

    def compose(self, g: Pose, h: Pose) -> Pose:
        """Compute the product (x + R(θ) x', θ + θ') of (x, θ) and (x', θ')."""
        return g + _rotate_move(g, h)

    def act(self, g: Element, xi: Twist) -> Element:
        """Compute g τ(ξ), as a `FramedPose` if g is one."""
        if not isinstance(g, FramedPose):
            return super().act(g, xi)
        cos_minus_1, sin = self.retraction.plane_rotation(xi[2])
        return FramedPose(
            g.pose + _rotate_move(g, self.retract(xi)),
            g.cos + (cos_minus_1 * g.cos - sin * g.sin),
            g.sin + (cos_minus_1 * g.sin + sin * g.cos),
        )

    def inverse(self, g: Pose) -> Pose:
        """Compute the inverse (-R(θ)ᵀ x, -θ) of (x, θ)."""
        return jnp.concatenate([rotate(-g[2], -g[:2]), -g[2:]])

    def retract(self, xi: Twist) -> Pose:
        """Compute the motion τ(ξ)."""
        return jnp.concatenate([self._translation(xi), self.retraction.angle(xi[2:])])

    def _translation(self, xi: Twist) -> Float[Array, "2"]:
        v, omega = xi[:2], xi[2]
        alpha, beta, _ = self.retraction.dtau_coefficients(omega**2)
        return alpha * v + beta * omega * quarter_turn(v)

    def local(self, g: Pose) -> Twist:
        """Compute the vector ξ with τ(ξ) = g."""
        rate = self.retraction.rate(g[2:])
        omega = rate[0]
        alpha, _ = self.retraction.dtau_inv_coefficients(omega**2)
        v = alpha * g[:2] - 0.5 * omega * quarter_turn(g[:2])
        return jnp.concatenate([v, rate])

    def wrapped(self, q: Pose, compensation: Pose) -> Pose:
        """Return the pose with the equivalent angle between -π and π."""
        return jnp.concatenate([q[:2], wrapped_angle(q[2:], compensation[2:])])

    def advance(self, q: Pose, xi: Twist, compensation: Pose) -> tuple[Pose, Pose]:
        """Compute g τ(ξ) by compensated summation."""
        direction = self.wrapped(q, compensation)
        return two_sum(q, _rotate_move(direction, self.retract(xi)) + compensation)

    def matrix(self, g: Pose) -> Float[Array, "3 3"]:
        """Return the matrix of the motion in homogeneous coordinates."""
        rotation = SO2(self.retraction).matrix(g[2:])
        return homogeneous(rotation, g[:2], 1.0)

    def hat(self, xi: Twist) -> Float[Array, "3 3"]:
        """Return the matrix [[ω J, v], [0, 0]] of ξ = (v, ω)."""
        return homogeneous(SO2(self.retraction).hat(xi[2:]), xi[:2], 0.0)

    def tangent(self, g: Element, eta: Twist) -> Element:
        """Compute the tangent (R(θ) v, ω) of η = (v, ω) at g = (x, θ).

        If g is a `FramedPose`, so is the tangent, with the derivatives -ω sin θ of the
        cosine and ω cos θ of the sine.
        """
        rate = _rotate_move(g, eta)
        if not isinstance(g, FramedPose):
            return rate
        return FramedPose(rate, -eta[2] * g.sin, eta[2] * g.cos)

    def dtau(self, xi: Twist, eta: Twist) -> Twist:
        """Compute dτ_ξ η = α η - β [ξ, η] + γ ωσ ξ for ξ = (v, ω), η = (u, σ)."""
        v, omega = xi[:2], xi[2]
        u, sigma = eta[:2], eta[2]
        s = omega**2
        alpha, beta, gamma = self.retraction.dtau_coefficients(s)
        bracket = omega * quarter_turn(u) - sigma * quarter_turn(v)
        linear = alpha * u - beta * bracket + gamma * omega * sigma * v
        return jnp.concatenate([linear, (alpha + gamma * s) * eta[2:]])

    def dtau_inv(self, xi: Twist, eta: Twist) -> Twist:
        """Compute dτ_ξ⁻¹ η = α η + ½ [ξ, η] + γ ωσ ξ for ξ = (v, ω), η = (u, σ)."""
        v, omega = xi[:2], xi[2]
        u, sigma = eta[:2], eta[2]
        s = omega**2
        alpha, gamma = self.retraction.dtau_inv_coefficients(s)
        bracket = omega * quarter_turn(u) - sigma * quarter_turn(v)
        linear = alpha * u + 0.5 * bracket + gamma * omega * sigma * v
        return jnp.concatenate([linear, (alpha + gamma * s) * eta[2:]])

    def Ad(self, g: Pose, eta: Twist) -> Twist:
        """Compute Ad_g η = (R(θ) u - σ J x, σ) for g = (x, θ) and η = (u, σ)."""
        linear = rotate(g[2], eta[:2]) - eta[2] * quarter_turn(g[:2])
        return jnp.concatenate([linear, eta[2:]])

    def to_end_change(self, xi: Twist, mu: Twist) -> Twist:
        """Compute Ad_{τ(ξ)}^* μ - μ, without cancellation.

        It is (R(θ)ᵀ m - m, -m·J x) for μ = (m, σ) and τ(ξ) = (x, θ).
        """
        # With the Cayley map, this formula needs neither the angle nor trigonometric
        # functions.
        cos_minus_1, sin = self.retraction.plane_rotation(xi[2])
        moment = jnp.sum(quarter_turn(self._translation(xi)) * mu[:2])
        turned = cos_minus_1 * mu[:2] - sin * quarter_turn(mu[:2])
        return jnp.concatenate([turned, -moment[None]])

    def ad(self, xi: Twist, eta: Twist) -> Twist:
        """Compute [ξ, η] = (ω J u - σ J v, 0) for ξ = (v, ω) and η = (u, σ)."""
        linear = xi[2] * quarter_turn(eta[:2]) - eta[2] * quarter_turn(xi[:2])
        return jnp.concatenate([linear, jnp.zeros_like(eta[2:])])


class FramedPose(eqx.Module):
    """A pose (x, y, θ) together with cos θ and sin θ, the frame of the body.

    It replaces a pose inside a step to avoid trigonometric functions. The retraction
    gives the cosine and sine of the angle between two poses. The frame of the second
    pose then follows from the frame of the first pose by products.
    """

    pose: Float[Array, "3"]
    cos: FloatScalar
    sin: FloatScalar

    def rotate(self, v: Float[Array, "2"]) -> Float[Array, "2"]:
        """Rotate a vector from the frame of the body to the frame of the plane."""
        return self.cos * v + self.sin * quarter_turn(v)


def framed(group: AbstractLieGroup, q: PyTree[Array]) -> PyTree[Array]:
    """Return an element with its planar poses replaced by framed poses.

    The methods `act`, `act_back` and `tangent` of the group accept such an element. An
    element without planar poses is returned unchanged.
    """
    # Subclasses are excluded: their own methods may not support framed poses.
    if type(group) is SE2:
        return FramedPose(q, jnp.cos(q[2]), jnp.sin(q[2]))
    if type(group) is ProductGroup:
        return tuple(map(framed, group.factors, q))
    return q


def is_framed(q: Any) -> bool:
    """Return whether `q` is a `FramedPose`."""
    return isinstance(q, FramedPose)


def unframed(q: PyTree[Array]) -> PyTree[Array]:
    """Return an element with its framed poses replaced by plain poses.

    The user's functions are called with plain elements.
    """
    return jax.tree.map(lambda x: x.pose if is_framed(x) else x, q, is_leaf=is_framed)


def _rotate_move(g: Pose | FramedPose, move: Pose | Twist) -> Pose:
    """Rotate the first two entries of `move` from the frame of g to the plane."""
    v = move[:2]
    turned = g.rotate(v) if isinstance(g, FramedPose) else rotate(g[2], v)
    return jnp.concatenate([turned, move[2:]])


# math.tau plus this number is 2π to 32 digits.
_TAU_REST = 2.4492935982947064e-16


def quarter_turn(v: Float[Array, "2 ..."]) -> Float[Array, "2 ..."]:
    """Compute J v: rotate a vector, or the columns of a matrix, by π/2."""
    return jnp.concatenate([-v[1:], v[:1]])


def rotate(angle: Float[Array, ""], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """Rotate a vector v of the plane by an angle."""
    return jnp.cos(angle) * v + jnp.sin(angle) * quarter_turn(v)


def wrapped_angle(
    angle: Float[Array, "1"], compensation: Float[Array, "1"]
) -> Float[Array, "1"]:
    """Return angle + compensation - 2πk, with the integer k nearest to angle / 2π.

    The result is accurate to the round-off of one turn if k fits into half of the bits
    of the mantissa. 2π is split into three parts, and k times each part is subtracted.
    The first two parts have so few bits that these products are exact (Cody and Waite,
    *Software Manual for the Elementary Functions*, 1980).
    """
    dtype = np.dtype(angle.dtype)
    bits = jnp.finfo(dtype).nmant + 1
    turns = jnp.round(angle * (1 / math.tau))
    for part in _parts_of_a_turn(bits - bits // 2):
        angle = angle - turns * jnp.asarray(part, dtype)
    return angle + compensation


def _parts_of_a_turn(bits: int) -> tuple[float, float, float]:
    """Split 2π into two numbers with `bits` bits each and a remainder."""
    rest, parts = math.tau, []
    for _ in range(2):
        mantissa, exponent = math.frexp(rest)
        parts.append(math.ldexp(round(math.ldexp(mantissa, bits)), exponent - bits))
        rest -= parts[-1]
    return parts[0], parts[1], rest + _TAU_REST
