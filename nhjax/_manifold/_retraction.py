from abc import abstractmethod
from math import pi, tan

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import BoolScalar, FloatScalar
from ._series import arctan_ratio, stumpff


# How far, in radians of rotation, the chart stays away from where τ is singular.
_MARGIN = 0.05


class AbstractRetraction(eqx.Module):
    """A retraction τ: 𝔤 -> G with τ(0) = e and dτ_0 = I.

    A retraction is given by its scalar functions of the rotation vector ω or of
    s = |ω|². The groups' formulas are made of them, so that those of the plane are
    those of space.

    - the rotation by τ(ω): `angle`, `rate`, `plane_rotation`, `half_rotation`,
      `rotation_vector`;
    - dτ_ω η = α η - β ω × η + γ (ω·η) ω: `dtau_coefficients`;
    - dτ_ω⁻¹ η = α η + ½ ω × η + γ (ω·η) ω: `dtau_inv_coefficients`.
    """

    @abstractmethod
    def angle(self, omega: Array) -> Array:
        """The angle of the plane rotation τ(ω)."""

    @abstractmethod
    def rate(self, angle: Array) -> Array:
        """The ω whose plane rotation has this angle."""

    @abstractmethod
    def plane_rotation(self, omega: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """cos φ - 1, without cancellation, and sin φ of the angle φ of τ(ω)."""

    @abstractmethod
    def half_rotation(self, s: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """cos(φ/2) - 1, without cancellation, and sin(φ/2)/|ω| of the angle φ."""

    @abstractmethod
    def rotation_vector(
        self, w: FloatScalar, v: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """The shortest ω that gives the rotation of the unit quaternion (w, v)."""

    @abstractmethod
    def dtau_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar, FloatScalar, FloatScalar | float]:
        """α, β and γ of dτ."""

    @abstractmethod
    def dtau_inv_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar | float, FloatScalar | float]:
        """α and γ of dτ⁻¹."""

    @abstractmethod
    def in_chart(self, s: FloatScalar) -> BoolScalar:
        """Whether the rotation is well inside the domain where τ is invertible."""


class Cayley(AbstractRetraction):
    """The Cayley map τ(ξ) = (I - ξ^/2)⁻¹ (I + ξ^/2) of the group's matrices.

    It needs no transcendental function, and its derivatives are rational. A rotation
    by |ω| becomes one by 2 arctan(|ω|/2), so that the chart ends at the angle π.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> turn = nhjax.SO2(retraction=nhjax.Cayley()).retract(jnp.array([2.0]))
        >>> round(4 * float(turn[0]) / 3.141593, 5)
        2.0
    """

    def angle(self, omega: Array) -> Array:
        """2 arctan(ω/2)."""
        return 2 * jnp.arctan(0.5 * omega)

    def rate(self, angle: Array) -> Array:
        """2 tan(θ/2)."""
        return 2 * jnp.tan(0.5 * angle)

    def plane_rotation(self, omega: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """-ω²/2 and ω, both over 1 + ω²/4."""
        sin = omega / (1 + 0.25 * omega**2)
        return -0.5 * omega * sin, sin

    def half_rotation(self, s: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """1/r - 1 and 1/(2r) with r² = 1 + s/4."""
        r = jnp.sqrt(1 + 0.25 * s)
        return -0.25 * s / (r * (1 + r)), 0.5 / r

    def rotation_vector(
        self, w: FloatScalar, v: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """2v/w."""
        return 2 * v / w

    def dtau_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar, FloatScalar, FloatScalar | float]:
        """α = 1/(1 + s/4), β = α/2, γ = 0."""
        alpha = 1 / (1 + 0.25 * s)
        return alpha, 0.5 * alpha, 0.0

    def dtau_inv_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar | float, FloatScalar | float]:
        """α = 1, γ = 1/4."""
        return 1.0, 0.25

    def in_chart(self, s: FloatScalar) -> BoolScalar:
        """Whether 2 arctan(√s/2) is less than π by a margin."""
        return s < (2 * tan((pi - _MARGIN) / 2)) ** 2


class Exponential(AbstractRetraction):
    """The exponential map τ(ξ) = exp(ξ^).

    The chart ends where dτ becomes singular, at rotations by 2π.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> group = nhjax.SO2(retraction=nhjax.Exponential())
        >>> [round(float(x), 6) for x in group.retract(jnp.array([0.3]))]
        [0.3]
    """

    def angle(self, omega: Array) -> Array:
        """ω."""
        return omega

    def rate(self, angle: Array) -> Array:
        """θ."""
        return angle

    def plane_rotation(self, omega: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """-2 sin²(ω/2) and sin ω."""
        return -2 * jnp.sin(0.5 * omega) ** 2, jnp.sin(omega)

    def half_rotation(self, s: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """cos(√s/2) - 1 and sin(√s/2)/√s."""
        u = 0.25 * s
        c = stumpff(u, 3)
        return -u * c[2], 0.5 * c[1]

    def rotation_vector(
        self, w: FloatScalar, v: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """2 arctan(|v|/w) v/|v|, by the tangent of half the angle."""
        # Of q and -q, which are one rotation, the one with the shorter vector.
        sign = jnp.where(w < 0, -1.0, 1.0).astype(w.dtype)
        v, w = sign * v, 1 + sign * w
        return 4 * arctan_ratio(jnp.sum(v**2) / w**2) / w * v

    def dtau_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar, FloatScalar, FloatScalar | float]:
        """Stumpff's c_1, c_2, c_3."""
        c = stumpff(s, 4)
        return c[1], c[2], c[3]

    def dtau_inv_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar | float, FloatScalar | float]:
        """α = (θ/2) cot(θ/2) and γ = (1 - α)/θ², θ² = s."""
        c = stumpff(0.25 * s, 4)
        # 1 - α without cancellation: c_1 - c_0 = θ²/4 (c_2 - c_3) at θ²/4.
        return c[0] / c[1], 0.25 * (c[2] - c[3]) / c[1]

    def in_chart(self, s: FloatScalar) -> BoolScalar:
        """Whether √s is less than 2π by a margin."""
        return s < (2 * pi - _MARGIN) ** 2


def check_retraction(group: str, retraction: object) -> None:
    """Raise unless `retraction` is one that the groups have formulas for."""
    if type(retraction) in (Cayley, Exponential):
        return
    allowed = "Cayley() and Exponential()"
    if isinstance(retraction, AbstractRetraction):
        raise ValueError(
            f"{group}: `retraction` is {retraction!r}, but {group} has formulas for "
            f"{allowed} only. For another retraction subclass `AbstractLieGroup`."
        )
    hint = ""
    if isinstance(retraction, type) and issubclass(retraction, AbstractRetraction):
        hint = " It is the class; call it to make an instance."
    raise TypeError(
        f"{group}: `retraction` must be one of {allowed}, got {retraction!r}.{hint}"
    )
