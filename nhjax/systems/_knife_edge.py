"""The knife edge on a slope."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from ._base import (
    AbstractConstrainedExample,
    coordinates,
    parameter,
    require_nonzero,
    require_positive,
)


class KnifeEdge(AbstractConstrainedExample):
    """A knife edge (skate) on an inclined plane, x downhill.

    L = m/2 (ẋ² + ẏ²) + I/2 θ̇² + mGx,  Φ = -sin θ ẋ + cos θ ẏ,  q = (x, y, θ).

    The heading turns uniformly. The edge does not slide down the slope, but drifts
    across the slope at the mean speed G/(2θ̇).

    **Parameters:** `mass` m [kg], `inertia` I about the contact [kg m²], `gravity`
    G, the component of gravity along the slope [m/s²].

    **Source:** Neimark and Fufaev, *Dynamics of Nonholonomic Systems* (1972); Bloch,
    *Nonholonomic Mechanics and Control* (2003), chapter 1.

    !!! example

        >>> from nhjax.systems import KnifeEdge
        >>> edge = KnifeEdge(gravity=2.0)
        >>> y0, (q, v, multiplier) = edge.initial_state(), edge.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [0.764, 0.612, 1.2]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    inertia: Array = eqx.field(converter=parameter, default=0.5)
    gravity: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(converter=coordinates, default=(0.1, -0.2, 0.4), kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates,
        default=(0.3 * math.cos(0.4), 0.3 * math.sin(0.4), 0.8),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, inertia=self.inertia)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m/2 (ẋ² + ẏ²) + I/2 θ̇² + mGx."""
        translation = 0.5 * self.mass * (v[0] ** 2 + v[1] ** 2)
        rotation = 0.5 * self.inertia * v[2] ** 2
        return translation + rotation + self.mass * self.gravity * q[0]

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = -sin θ ẋ + cos θ ẏ."""
        return jnp.cos(q[2]) * v[1] - jnp.sin(q[2]) * v[0]

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, the turning rate θ̇, and uθ̇ - G sin θ.

        Here u is the speed of the edge.
        """
        speed = v[0] * jnp.cos(q[2]) + v[1] * jnp.sin(q[2])
        return {
            "energy": self.energy(t, q, v),
            "heading_rate": v[2],
            "drift": speed * v[2] - self.gravity * jnp.sin(q[2]),
        }

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for consistent initial data with θ̇ != 0."""
        (x0, y0, heading0), (dx0, dy0, omega) = self._consistent_data()
        m, gravity = float(self.mass), float(self.gravity)
        require_nonzero("v0[2]", omega, "the knife edge moves along a straight line")
        cos0, sin0 = math.cos(heading0), math.sin(heading0)
        # The speed along the edge is u = mean + swing sin θ.
        swing = gravity / omega
        mean = dx0 * cos0 + dy0 * sin0 - swing * sin0
        heading = heading0 + omega * t
        cos, sin = math.cos(heading), math.sin(heading)
        u = mean + swing * sin
        x = x0 + (mean * (sin - sin0) + 0.5 * swing * (sin**2 - sin0**2)) / omega
        y = y0 - mean * (cos - cos0) / omega
        y += 0.5 * swing * (t - (sin * cos - sin0 * cos0) / omega)
        multiplier = m * (omega * u + gravity * sin)
        return (
            np.array([x, y, heading]),
            np.array([u * cos, u * sin, omega]),
            np.array([multiplier]),
        )
