"""The groups of the plane: SO(2), SE(2), and poses that carry their sine and cosine."""

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

    def in_chart(self, xi: Rate) -> BoolScalar:
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

    def retract(self, xi: Rate) -> Angle:
        """Compute the angle of the rotation τ(ω)."""
        return self.retraction.angle(xi)

    def local(self, g: Angle) -> Rate:
        """Compute the ω for which τ(ω) has the angle θ."""
        return self.retraction.rate(g)

    def wrapped(self, q: Angle, compensation: Angle) -> Angle:
        """Return the angle of the first turn, between -π and π."""
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
        return jnp.cos(g[0]) * basis + jnp.sin(g[0]) * turn(basis)

    def hat(self, xi: Rate) -> Float[Array, "2 2"]:
        """Return the matrix [[0, -ω], [ω, 0]] of an angular velocity ω."""
        return xi[0] * turn(jnp.eye(2, dtype=xi.dtype))

    def tangent(self, g: Angle, eta: Rate) -> Angle:
        """Return η, which is the rate of the angle."""
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

    def in_chart(self, xi: Twist) -> BoolScalar:
        """Tell whether the rotation of τ(ξ) stays inside of the chart."""
        return self.retraction.in_chart(xi[2] ** 2)

    def compose(self, g: Pose, h: Pose) -> Pose:
        """Compute the product (x + R(θ) x', θ + θ') of (x, θ) and (x', θ')."""
        return g + _moved(g, h)

    def act(self, g: Element, xi: Twist) -> Element:
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

    def retract(self, xi: Twist) -> Pose:
        """Compute the motion τ(ξ)."""
        return jnp.concatenate([self._translation(xi), self.retraction.angle(xi[2:])])

    def _translation(self, xi: Twist) -> Float[Array, "2"]:
        v, omega = xi[:2], xi[2]
        alpha, beta, _ = self.retraction.dtau_coefficients(omega**2)
        return alpha * v + beta * omega * turn(v)

    def local(self, g: Pose) -> Twist:
        """Compute the ξ with τ(ξ) = g."""
        rate = self.retraction.rate(g[2:])
        omega = rate[0]
        alpha, _ = self.retraction.dtau_inv_coefficients(omega**2)
        v = alpha * g[:2] - 0.5 * omega * turn(g[:2])
        return jnp.concatenate([v, rate])

    def wrapped(self, q: Pose, compensation: Pose) -> Pose:
        """Return the pose with its angle reduced to one turn, between -π and π."""
        return jnp.concatenate([q[:2], wrapped_angle(q[2:], compensation[2:])])

    def advance(self, q: Pose, xi: Twist, compensation: Pose) -> tuple[Pose, Pose]:
        """Compute g τ(ξ) by compensated summation."""
        direction = self.wrapped(q, compensation)
        return two_sum(q, _moved(direction, self.retract(xi)) + compensation)

    def matrix(self, g: Pose) -> Float[Array, "3 3"]:
        """Return the matrix of the motion in homogeneous coordinates."""
        rotation = SO2(self.retraction).matrix(g[2:])
        return homogeneous(rotation, g[:2], 1.0)

    def hat(self, xi: Twist) -> Float[Array, "3 3"]:
        """Return the matrix [[ω J, v], [0, 0]] of ξ = (v, ω)."""
        return homogeneous(SO2(self.retraction).hat(xi[2:]), xi[:2], 0.0)

    def tangent(self, g: Element, eta: Twist) -> Element:
        """Compute the tangent (R(θ) v, ω) at g = (x, θ) of η = (v, ω).

        The frame, if there is one, changes by -ω sin θ and ω cos θ.
        """
        rate = _moved(g, eta)
        if not isinstance(g, FramedPose):
            return rate
        return FramedPose(rate, -eta[2] * g.sin, eta[2] * g.cos)

    def dtau(self, xi: Twist, eta: Twist) -> Twist:
        """Compute dτ_ξ η, by the formula of `SO3` for motions of the plane."""
        v, omega = xi[:2], xi[2]
        u, sigma = eta[:2], eta[2]
        s = omega**2
        alpha, beta, gamma = self.retraction.dtau_coefficients(s)
        bracket = omega * turn(u) - sigma * turn(v)
        linear = alpha * u - beta * bracket + gamma * omega * sigma * v
        return jnp.concatenate([linear, (alpha + gamma * s) * eta[2:]])

    def dtau_inv(self, xi: Twist, eta: Twist) -> Twist:
        """Compute dτ_ξ⁻¹ η, by the formula of `SO3` for motions of the plane."""
        v, omega = xi[:2], xi[2]
        u, sigma = eta[:2], eta[2]
        s = omega**2
        alpha, gamma = self.retraction.dtau_inv_coefficients(s)
        bracket = omega * turn(u) - sigma * turn(v)
        linear = alpha * u + 0.5 * bracket + gamma * omega * sigma * v
        return jnp.concatenate([linear, (alpha + gamma * s) * eta[2:]])

    def Ad(self, g: Pose, eta: Twist) -> Twist:
        """Compute Ad_g η = (R(θ) u - σ J x, σ) of η = (u, σ)."""
        linear = rotate(g[2], eta[:2]) - eta[2] * turn(g[:2])
        return jnp.concatenate([linear, eta[2:]])

    def to_end_change(self, xi: Twist, mu: Twist) -> Twist:
        """Compute Ad_{τ(ξ)}^* μ - μ, without cancellation.

        It is (R(θ)ᵀ m - m, -m·J x) for μ = (m, σ) and τ(ξ) = (x, θ).
        """
        # With Cayley's map neither the angle nor trigonometric functions are needed.
        less, sin = self.retraction.plane_rotation(xi[2])
        moment = jnp.sum(turn(self._translation(xi)) * mu[:2])
        turned = less * mu[:2] - sin * turn(mu[:2])
        return jnp.concatenate([turned, -moment[None]])

    def ad(self, xi: Twist, eta: Twist) -> Twist:
        """Compute [ξ, η] = (ω J u - σ J v, 0) of ξ = (v, ω) and η = (u, σ)."""
        linear = xi[2] * turn(eta[:2]) - eta[2] * turn(xi[:2])
        return jnp.concatenate([linear, jnp.zeros_like(eta[2:])])


class FramedPose(eqx.Module):
    """A pose (x, y, θ) with cos θ and sin θ, which tell the frame of the body.

    In the place of a pose it saves trigonometric functions: from the frame at one pose
    that at another follows by products, since the retraction gives the sine and cosine
    of the angle between them.
    """

    pose: Float[Array, "3"]
    cos: FloatScalar
    sin: FloatScalar

    def rotate(self, v: Float[Array, "2"]) -> Float[Array, "2"]:
        """Turn a vector from the frame of the body to that of the plane."""
        return self.cos * v + self.sin * turn(v)


def framed(group: AbstractLieGroup, q: PyTree[Array]) -> PyTree[Array]:
    """Return an element with the frames of those parts that are poses of the plane.

    The methods `act`, `act_back` and `tangent` of the group take it in the place of the
    element. Where no part is such a pose it is the element itself.
    """
    # A subclass may have methods of its own, which know nothing of frames.
    if type(group) is SE2:
        return FramedPose(q, jnp.cos(q[2]), jnp.sin(q[2]))
    if type(group) is ProductGroup:
        return tuple(map(framed, group.factors, q))
    return q


def is_framed(q: Any) -> bool:
    """Tell whether this is a pose with its frame."""
    return isinstance(q, FramedPose)


def unframed(q: PyTree[Array]) -> PyTree[Array]:
    """Return an element of a group without the frames of the poses that it is made of.

    These are the elements that functions of a user are called with.
    """
    return jax.tree.map(lambda x: x.pose if is_framed(x) else x, q, is_leaf=is_framed)


def _moved(g: Pose | FramedPose, move: Pose | Twist) -> Pose:
    """Turn the first two numbers of a move from the frame of the body g."""
    v = move[:2]
    turned = g.rotate(v) if isinstance(g, FramedPose) else rotate(g[2], v)
    return jnp.concatenate([turned, move[2:]])


# 2π is math.tau plus this, to 32 digits.
_TAU_REST = 2.4492935982947064e-16


def turn(v: Float[Array, "2 ..."]) -> Float[Array, "2 ..."]:
    """Compute J v, a vector of the plane (or the columns of a matrix) turned by π/2."""
    return jnp.concatenate([-v[1:], v[:1]])


def rotate(angle: Float[Array, ""], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """Turn a vector v of the plane by an angle."""
    return jnp.cos(angle) * v + jnp.sin(angle) * turn(v)


def wrapped_angle(
    angle: Float[Array, "1"], compensation: Float[Array, "1"]
) -> Float[Array, "1"]:
    """Compute angle + compensation - 2πk for the whole k that brings it near zero.

    It is accurate to the round-off of one turn for as many turns as half of the bits of
    a number can count: 2πk is subtracted in parts so short that k times them is exact
    (Cody and Waite, *Software Manual for the Elementary Functions*, 1980).
    """
    dtype = np.dtype(angle.dtype)
    bits = jnp.finfo(dtype).nmant + 1
    turns = jnp.round(angle * (1 / math.tau))
    for part in _parts_of_a_turn(bits - bits // 2):
        angle = angle - turns * jnp.asarray(part, dtype)
    return angle + compensation


def _parts_of_a_turn(bits: int) -> tuple[float, float, float]:
    """Split 2π into two numbers of so many bits and the rest."""
    rest, parts = math.tau, []
    for _ in range(2):
        mantissa, exponent = math.frexp(rest)
        parts.append(math.ldexp(round(math.ldexp(mantissa, bits)), exponent - bits))
        rest -= parts[-1]
    return parts[0], parts[1], rest + _TAU_REST
