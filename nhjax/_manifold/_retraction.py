"""The retractions of groups of rotations and rigid motions, and their scalar functions.

All scalar functions are smooth at the angle zero. Instead of the length of a vector,
they take its square, so that no square root is differentiated at zero.
"""

from abc import abstractmethod
from functools import partial
from math import factorial, pi, tan

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import BoolScalar, FloatScalar


# The chart ends at this distance from the singularity of τ, in radians of rotation.
_MARGIN = 0.05


class AbstractRetraction(eqx.Module):
    """A retraction τ: 𝔤 -> G with τ(0) = e and dτ_0 = I, for groups of motions.

    A retraction consists of scalar functions of the rotation vector ω or of s = |ω|².
    The planar and the spatial groups build all their formulas from these functions.

    - `angle`, `rate`, `plane_rotation`, `half_rotation` and `rotation_vector` describe
      the rotation τ(ω);
    - `dtau_coefficients` returns α, β, γ in dτ_ω η = α η - β ω × η + γ (ω·η) ω;
    - `dtau_inv_coefficients` returns α, γ in dτ_ω⁻¹ η = α η + ½ ω × η + γ (ω·η) ω.
    """

    @abstractmethod
    def angle(self, omega: Array) -> Array:
        """Compute the angle of the plane rotation τ(ω)."""

    @abstractmethod
    def rate(self, angle: Array) -> Array:
        """Compute the rate ω for which the plane rotation τ(ω) has this angle."""

    @abstractmethod
    def plane_rotation(self, omega: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """Compute cos φ - 1 and sin φ of the angle φ of τ(ω), without cancellation."""

    @abstractmethod
    def half_rotation(self, s: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """Compute cos(φ/2) - 1 and sin(φ/2)/|ω| of the angle φ of τ(ω).

        The difference is computed without cancellation.
        """

    @abstractmethod
    def rotation_vector(
        self, w: FloatScalar, v: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """Compute the shortest ω whose rotation τ(ω) is the quaternion (w, v)."""

    @abstractmethod
    def dtau_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar, FloatScalar, FloatScalar | float]:
        """Compute the coefficients α, β and γ of dτ."""

    @abstractmethod
    def dtau_inv_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar | float, FloatScalar | float]:
        """Compute the coefficients α and γ of dτ⁻¹."""

    @abstractmethod
    def in_chart(self, s: FloatScalar) -> BoolScalar:
        """Return whether τ is invertible where |ω|² = s, with a margin."""


class Cayley(AbstractRetraction):
    """The Cayley map τ(ξ) = (I - ξ^/2)⁻¹ (I + ξ^/2) of the group's matrices.

    For SO(3) and SE(3) it uses only rational functions and square roots. The vector ω
    gives a rotation by the angle 2 arctan(|ω|/2), so that the chart ends at the angle
    π.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> turn = nhjax.SO2(retraction=nhjax.Cayley()).retract(jnp.array([2.0]))
        >>> round(4 * float(turn[0]) / 3.141593, 5)
        2.0
    """

    def angle(self, omega: Array) -> Array:
        """Compute the angle 2 arctan(ω/2)."""
        return 2 * jnp.arctan(0.5 * omega)

    def rate(self, angle: Array) -> Array:
        """Compute the rate ω = 2 tan(θ/2) of an angle θ."""
        return 2 * jnp.tan(0.5 * angle)

    def plane_rotation(self, omega: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """Compute cos φ - 1 = -ω²/2 / (1 + ω²/4) and sin φ = ω / (1 + ω²/4)."""
        sin = omega / (1 + 0.25 * omega**2)
        return -0.5 * omega * sin, sin

    def half_rotation(self, s: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """Compute cos(φ/2) - 1 = 1/r - 1 and sin(φ/2)/|ω| = 1/(2r), r² = 1 + s/4."""
        r = jnp.sqrt(1 + 0.25 * s)
        return -0.25 * s / (r * (1 + r)), 0.5 / r

    def rotation_vector(
        self, w: FloatScalar, v: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """Compute ω = 2v/w for the quaternion (w, v)."""
        return 2 * v / w

    def dtau_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar, FloatScalar, FloatScalar | float]:
        """Compute the coefficients α = 1/(1 + s/4), β = α/2 and γ = 0 of dτ."""
        alpha = 1 / (1 + 0.25 * s)
        return alpha, 0.5 * alpha, 0.0

    def dtau_inv_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar | float, FloatScalar | float]:
        """Return the coefficients α = 1 and γ = 1/4 of dτ⁻¹."""
        return 1.0, 0.25

    def in_chart(self, s: FloatScalar) -> BoolScalar:
        """Return whether the angle 2 arctan(√s/2) is less than π by a margin."""
        return s < (2 * tan((pi - _MARGIN) / 2)) ** 2


class Exponential(AbstractRetraction):
    """The exponential map τ(ξ) = exp(ξ^).

    The chart ends at rotations by 2π, where dτ becomes singular.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> group = nhjax.SO2(retraction=nhjax.Exponential())
        >>> [round(float(x), 6) for x in group.retract(jnp.array([0.3]))]
        [0.3]
    """

    def angle(self, omega: Array) -> Array:
        """Return ω, because the angle is ω."""
        return omega

    def rate(self, angle: Array) -> Array:
        """Return the angle θ, because ω = θ."""
        return angle

    def plane_rotation(self, omega: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """Compute cos ω - 1 = -2 sin²(ω/2) and sin ω."""
        return -2 * jnp.sin(0.5 * omega) ** 2, jnp.sin(omega)

    def half_rotation(self, s: FloatScalar) -> tuple[FloatScalar, FloatScalar]:
        """Compute cos(√s/2) - 1 and sin(√s/2)/√s, without cancellation."""
        u = 0.25 * s
        c = stumpff(u, 3)
        return -u * c[2], 0.5 * c[1]

    def rotation_vector(
        self, w: FloatScalar, v: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """Compute ω = 2 arctan(|v|/w) v/|v|, from tan(|ω|/4) = |v|/(1 + w)."""
        # The quaternions q and -q are the same rotation. Use the one with shorter ω.
        sign = jnp.where(w < 0, -1.0, 1.0).astype(w.dtype)
        v, w = sign * v, 1 + sign * w
        return 4 * arctan_ratio(jnp.sum(v**2) / w**2) / w * v

    def dtau_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar, FloatScalar, FloatScalar | float]:
        """Compute the coefficients of dτ, the Stumpff functions c_1, c_2 and c_3."""
        c = stumpff(s, 4)
        return c[1], c[2], c[3]

    def dtau_inv_coefficients(
        self, s: FloatScalar
    ) -> tuple[FloatScalar | float, FloatScalar | float]:
        """Compute α = (θ/2) cot(θ/2) and γ = (1 - α)/θ² of dτ⁻¹, with θ² = s."""
        c = stumpff(0.25 * s, 4)
        # For values c_k at θ²/4, the identity c_1 - c_0 = θ²/4 (c_2 - c_3) avoids
        # cancellation in 1 - α.
        return c[0] / c[1], 0.25 * (c[2] - c[3]) / c[1]

    def in_chart(self, s: FloatScalar) -> BoolScalar:
        """Return whether the angle √s is less than 2π by a margin."""
        return s < (2 * pi - _MARGIN) ** 2


def check_retraction(group: str, retraction: object) -> None:
    """Raise if the groups have no formulas for `retraction`."""
    if type(retraction) in (Cayley, Exponential):
        return
    allowed = "Cayley() and Exponential()"
    if isinstance(retraction, AbstractRetraction):
        raise ValueError(
            f"{group}: `retraction` is {retraction!r}, but {group} has formulas for "
            f"{allowed} only. For another retraction, subclass `AbstractLieGroup`."
        )
    hint = ""
    if isinstance(retraction, type) and issubclass(retraction, AbstractRetraction):
        hint = " It is a class; call it to create an instance."
    raise TypeError(
        f"{group}: `retraction` must be one of {allowed}, got {retraction!r}.{hint}"
    )


# The series is used for s below this value. Above this value the recursion is equally
# accurate, because it divides its rounding errors by s.
_SWITCH = 2.0

# The first omitted term of the series is at most 2e-18, for c_0 at s = `_SWITCH`.
_NUM_TERMS = 11


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def stumpff(s: FloatScalar, n: int) -> Float[Array, " n"]:
    """Compute the Stumpff functions c_k(s) = Σ_j (-s)^j / (2j + k)! for k < n.

    For s = θ² >= 0 these functions are c_0 = cos θ, c_1 = sin θ / θ,
    c_2 = (1 - cos θ)/θ² and c_3 = (θ - sin θ)/θ³. Their derivatives
    2 c_k' = k c_{k+2} - c_{k+1} belong to the same family. The custom derivative rule
    uses this identity, so that derivatives are as accurate as values.
    """
    small = s < _SWITCH
    series = _horner(_coefficients(n, s.dtype), jnp.where(small, s, 0.0))
    return jnp.where(small, series, _recursion(jnp.where(small, _SWITCH, s), n))


@stumpff.defjvp
def _(n, primals, tangents):
    (s,), (ds,) = primals, tangents
    c = stumpff(s, n + 2)
    slope = 0.5 * (np.arange(n, dtype=s.dtype) * c[2:] - c[1:-1])
    return c[:n], slope * ds


def _coefficients(n, dtype):
    return [
        np.array([(-1) ** j / factorial(2 * j + k) for k in range(n)], dtype)
        for j in range(_NUM_TERMS)
    ]


def _recursion(s, n):
    """Compute c_0 by cos, c_1 by sin, and c_k by s c_k = 1/(k-2)! - c_{k-2}, k >= 2."""
    theta = jnp.sqrt(s)
    c = [jnp.cos(theta), jnp.sin(theta) / theta]
    for k in range(2, n):
        c.append((1 / factorial(k - 2) - c[k - 2]) / s)
    return jnp.stack(c[:n])


def _horner(coefficients, x):
    *lower, total = coefficients
    for c in reversed(lower):
        total = c + x * total
    return total


def arctan_ratio(x: FloatScalar) -> FloatScalar:
    """Compute arctan(√x)/√x for 0 <= x <= 1.

    Halving the angle arctan(√x) twice reduces √x to at most tan(π/16), where one short
    series is accurate. There is no branch, so that derivatives of all orders exist.
    """
    scale = 1.0
    for _ in range(2):
        half = 1 + jnp.sqrt(1 + x)
        scale = scale * 2 / half
        x = x / half**2
    return scale * _horner([(-1) ** j / (2 * j + 1) for j in range(15)], x)
