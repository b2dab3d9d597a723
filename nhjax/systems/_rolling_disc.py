"""The vertical rolling disc."""

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


class VerticalRollingDisc(AbstractConstrainedExample):
    """A disc that stays upright and rolls without slipping on a horizontal plane.

    L = m/2 (ẋ² + ẏ²) + I/2 ψ̇² + J/2 φ̇²,
    Φ = (ẋ - Rψ̇ cos φ, ẏ - Rψ̇ sin φ),  q = (x, y, ψ, φ).

    Here (x, y) is the contact, ψ the roll angle, and φ the heading. The rates ψ̇ and φ̇
    are constant, and the contact moves on a circle of radius Rψ̇/φ̇.

    **Parameters:** `mass` m [kg], `roll_inertia` I about the axle and
    `heading_inertia` J about the vertical [kg m²], `radius` R [m].

    **Source:** Bloch, *Nonholonomic Mechanics and Control* (2003), chapter 1.

    !!! example

        >>> from nhjax.systems import VerticalRollingDisc
        >>> disc = VerticalRollingDisc(radius=0.5, v0=(0.5, 0.0, 1.0, 0.3))
        >>> y0, (q, v, multiplier) = disc.initial_state(), disc.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [0.693, -0.026, 1.0, 0.3]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    roll_inertia: Array = eqx.field(converter=parameter, default=0.5)
    heading_inertia: Array = eqx.field(converter=parameter, default=0.25)
    radius: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(
        converter=coordinates, default=(0.2, -0.1, 0.0, 0.0), kw_only=True
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(1.3, 0.0, 1.3, 0.7), kw_only=True
    )

    def __check_init__(self) -> None:
        require_positive(
            mass=self.mass,
            roll_inertia=self.roll_inertia,
            heading_inertia=self.heading_inertia,
            radius=self.radius,
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m/2 (ẋ² + ẏ²) + I/2 ψ̇² + J/2 φ̇²."""
        translation = 0.5 * self.mass * (v[0] ** 2 + v[1] ** 2)
        roll = 0.5 * self.roll_inertia * v[2] ** 2
        return translation + roll + 0.5 * self.heading_inertia * v[3] ** 2

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraints Φ = (ẋ - Rψ̇ cos φ, ẏ - Rψ̇ sin φ)."""
        speed = self.radius * v[2]
        return jnp.stack([v[0] - speed * jnp.cos(q[3]), v[1] - speed * jnp.sin(q[3])])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, both rates, and φ̇ times the centre of the circle.

        The circle is the path of the contact.
        """
        speed = self.radius * v[2]
        return {
            "energy": self.energy(t, q, v),
            "roll_rate": v[2],
            "heading_rate": v[3],
            "centre_x": v[3] * q[0] - speed * jnp.sin(q[3]),
            "centre_y": v[3] * q[1] + speed * jnp.cos(q[3]),
        }

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for consistent data with φ̇ != 0."""
        (x0, y0, roll0, heading0), (_, _, roll_rate, omega) = self._consistent_data()
        require_nonzero("v0[3]", omega, "the disc moves along a straight line")
        speed = float(self.radius) * roll_rate
        orbit = speed / omega
        heading = heading0 + omega * t
        cos, sin = math.cos(heading), math.sin(heading)
        x = x0 + orbit * (sin - math.sin(heading0))
        y = y0 - orbit * (cos - math.cos(heading0))
        reaction = float(self.mass) * omega * speed
        return (
            np.array([x, y, roll0 + roll_rate * t, heading]),
            np.array([speed * cos, speed * sin, roll_rate, omega]),
            np.array([-reaction * sin, reaction * cos]),
        )
