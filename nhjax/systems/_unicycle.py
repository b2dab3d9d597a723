"""The unicycle on a spring, on SE(2) and in coordinates."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, SE2
from ._base import (
    AbstractConstrainedExample,
    AbstractConstrainedGroupExample,
    coordinates,
    parameter,
    require_positive,
)


class Unicycle(AbstractConstrainedGroupExample):
    """A vertical disc (a unicycle) that a spring binds to the origin, on SE(2).

    ℓ = m/2 (v₁² + v₂²) + I/2 ω² - k/2 (x² + y²),  φ = v₂.

    Here q = (x, y, θ), and the body velocity is (v₁, v₂, ω): v₁ along the heading, v₂
    to its left. The heading turns uniformly.

    **Parameters:** `mass` m [kg], `inertia` I about the vertical [kg m²], `spring` k
    [N/m]; `retraction`, the retraction of SE(2).

    **Source:** Martín de Diego and Sato Martín de Almagro, *High-order geometric
    methods for nonholonomic mechanical systems*, fourth numerical experiment (there
    k = 1).

    !!! example

        >>> from nhjax.systems import Unicycle
        >>> unicycle = Unicycle(spring=2.0)
        >>> y0, (q, v, multiplier) = unicycle.initial_state(), unicycle.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [0.747, -0.155, 1.1]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    inertia: Array = eqx.field(converter=parameter, default=0.5)
    spring: Array = eqx.field(converter=parameter, default=1.0)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: Array = eqx.field(converter=coordinates, default=(1.0, 0.2, 0.3), kw_only=True)
    v0: Array = eqx.field(converter=coordinates, default=(0.5, 0.0, 0.8), kw_only=True)

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, inertia=self.inertia, spring=self.spring)

    @property
    def manifold(self) -> SE2:
        """Return the group SE(2) with the retraction of the example."""
        return SE2(self.retraction)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian ℓ = m/2 (v₁² + v₂²) + I/2 ω² - k/2 (x² + y²)."""
        return _lagrangian(self, q, v)

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint φ = v₂."""
        return v[1]

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, the turning rate ω, and kY - mωv₁.

        Here Y = y cos θ - x sin θ.
        """
        sideways = q[1] * jnp.cos(q[2]) - q[0] * jnp.sin(q[2])
        return {
            "energy": self.energy(t, q, v),
            "heading_rate": v[2],
            "sideways_balance": self.spring * sideways - self.mass * v[2] * v[0],
        }

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for every consistent (`q0`, `v0`).

        In the body frame the contact (X, Y) obeys Ẋ = v₁ + ωY, Ẏ = -ωX, v̇₁ = -kX/m.
        """
        (x0, y0, heading0), (u0, _, omega) = self._consistent_data()
        m, k = float(self.mass), float(self.spring)
        nu = math.sqrt(omega**2 + k / m)
        cos0, sin0 = math.cos(heading0), math.sin(heading0)
        ahead0, left0 = x0 * cos0 + y0 * sin0, y0 * cos0 - x0 * sin0
        cos, sin = math.cos(nu * t), math.sin(nu * t) / nu
        one_minus_cos = 2 * math.sin(0.5 * nu * t) ** 2 / nu**2
        rate0 = u0 + omega * left0
        travel = ahead0 * sin + rate0 * one_minus_cos
        ahead, left = ahead0 * cos + rate0 * sin, left0 - omega * travel
        u = u0 - k * travel / m
        heading = heading0 + omega * t
        cos, sin = math.cos(heading), math.sin(heading)
        return (
            np.array([ahead * cos - left * sin, ahead * sin + left * cos, heading]),
            np.array([u, 0.0, omega]),
            np.array([m * omega * u + k * left]),
        )

    def in_coordinates(self) -> "UnicycleInCoordinates":
        """Return the same unicycle, with the same motion, on R³."""
        return UnicycleInCoordinates(
            self.mass,
            self.inertia,
            self.spring,
            q0=self.q0,
            v0=_turn(self.v0, self.q0[2]),
        )


class UnicycleInCoordinates(AbstractConstrainedExample):
    """The unicycle on a spring in plain coordinates, on R³.

    L = m/2 (ẋ² + ẏ²) + I/2 θ̇² - k/2 (x² + y²),  Φ = ẏ cos θ - ẋ sin θ,  q = (x, y, θ).

    The exact motion and multiplier are the same as for `Unicycle`, but the
    discretisation errors differ.

    **Parameters:** `mass` m [kg], `inertia` I about the vertical [kg m²], `spring` k
    [N/m].

    **Source:** as for `Unicycle`.

    !!! example

        >>> from nhjax.systems import Unicycle
        >>> unicycle = Unicycle(spring=2.0).in_coordinates()
        >>> y0, (q, v, multiplier) = unicycle.initial_state(), unicycle.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [0.747, -0.155, 1.1]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    inertia: Array = eqx.field(converter=parameter, default=0.5)
    spring: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(converter=coordinates, default=(1.0, 0.2, 0.3), kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates,
        default=(0.5 * math.cos(0.3), 0.5 * math.sin(0.3), 0.8),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, inertia=self.inertia, spring=self.spring)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m/2 (ẋ² + ẏ²) + I/2 θ̇² - k/2 (x² + y²)."""
        return _lagrangian(self, q, v)

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = ẏ cos θ - ẋ sin θ."""
        return v[1] * jnp.cos(q[2]) - v[0] * jnp.sin(q[2])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the conserved quantities of `Unicycle`."""
        return self.on_group().invariants(t, q, _turn(v, -q[2]))

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for every consistent (`q0`, `v0`)."""
        self._consistent_data()
        q, (u, _, omega), multiplier = self.on_group().exact(t)
        return q, np.array([u * math.cos(q[2]), u * math.sin(q[2]), omega]), multiplier

    def on_group(self) -> Unicycle:
        """Return the same unicycle, with the same motion, on SE(2)."""
        return Unicycle(
            self.mass,
            self.inertia,
            self.spring,
            q0=self.q0,
            v0=_turn(self.v0, -self.q0[2]),
        )


def _lagrangian(
    unicycle: Unicycle | UnicycleInCoordinates, q: Array, v: Array
) -> Array:
    # The kinetic energy is the same function of the body velocity and of (ẋ, ẏ, θ̇), so
    # that both classes share it.
    translation = 0.5 * unicycle.mass * (v[0] ** 2 + v[1] ** 2)
    rotation = 0.5 * unicycle.inertia * v[2] ** 2
    return translation + rotation - 0.5 * unicycle.spring * (q[0] ** 2 + q[1] ** 2)


def _turn(v: Array, angle: Array) -> Array:
    """Turn the planar velocity `v` = (v₁, v₂, ω) by `angle`."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([v[0] * cos - v[1] * sin, v[0] * sin + v[1] * cos, v[2]])
