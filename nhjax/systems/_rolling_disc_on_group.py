"""The vertical rolling disc on SE(2) x SO(2)."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from .._manifold import AbstractRetraction, Cayley, ProductGroup, SE2, SO2
from ._base import (
    AbstractConstrainedGroupExample,
    coordinates,
    pair,
    parameter,
    require_nonzero,
    require_positive,
)
from ._rolling_disc import VerticalRollingDisc


class RollingDisc(AbstractConstrainedGroupExample):
    """The `VerticalRollingDisc` on SE(2) x SO(2), as a left-invariant system.

    ℓ = m/2 (v₁² + v₂²) + J/2 ω² + I/2 ψ̇²,  φ = (v₁ - Rψ̇, v₂).

    Here q = ((x, y, φ), (ψ,)), where this φ is the heading and ψ the roll angle, and
    v = (v₁, v₂, ω, ψ̇): v₁ along the heading, v₂ to its left, ω the heading rate. All
    four velocities are constant.

    **Parameters:** `mass` m [kg], `roll_inertia` I about the axle and
    `heading_inertia` J about the vertical [kg m²], `radius` R [m]; `retraction`, the
    retraction of SE(2) and of SO(2).

    **Source:** Bloch, *Nonholonomic Mechanics and Control* (2003), chapter 1.

    !!! example

        >>> from nhjax.systems import RollingDisc
        >>> disc = RollingDisc(radius=0.5, v0=(0.5, 0.0, 0.3, 1.0))
        >>> y0, (q, v, multiplier) = disc.initial_state(), disc.exact(1.0)
        >>> [round(x, 3) for x in multiplier.tolist()]
        [0.0, 0.15]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    roll_inertia: Array = eqx.field(converter=parameter, default=0.5)
    heading_inertia: Array = eqx.field(converter=parameter, default=0.25)
    radius: Array = eqx.field(converter=parameter, default=1.0)
    retraction: AbstractRetraction = eqx.field(default=Cayley(), kw_only=True)
    q0: tuple[Array, Array] = eqx.field(
        converter=pair, default=((0.2, -0.1, 0.0), (0.0,)), kw_only=True
    )
    v0: Array = eqx.field(
        converter=coordinates, default=(1.3, 0.0, 0.7, 1.3), kw_only=True
    )

    def __check_init__(self) -> None:
        require_positive(
            mass=self.mass,
            roll_inertia=self.roll_inertia,
            heading_inertia=self.heading_inertia,
            radius=self.radius,
        )

    @property
    def manifold(self) -> ProductGroup:
        """Return the group SE(2) x SO(2) with the retraction of the example."""
        return ProductGroup(SE2(self.retraction), SO2(self.retraction))

    def lagrangian(
        self, t: FloatScalarLike, q: tuple[Array, Array], v: Array, args: Args
    ) -> Array:
        """Compute the Lagrangian ℓ = m/2 (v₁² + v₂²) + J/2 ω² + I/2 ψ̇²."""
        translation = 0.5 * self.mass * (v[0] ** 2 + v[1] ** 2)
        heading = 0.5 * self.heading_inertia * v[2] ** 2
        return translation + heading + 0.5 * self.roll_inertia * v[3] ** 2

    def constraint(
        self, t: FloatScalarLike, q: tuple[Array, Array], v: Array, args: Args
    ) -> Array:
        """Compute the constraints φ = (v₁ - Rψ̇, v₂)."""
        return jnp.stack([v[0] - self.radius * v[3], v[1]])

    def invariants(
        self, t: FloatScalarLike, q: tuple[Array, Array], v: Array
    ) -> dict[str, Array]:
        """Compute the conserved quantities of `VerticalRollingDisc`."""
        return self.in_coordinates().invariants(t, *_in_coordinates(q, v))

    def exact(
        self, t: float
    ) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for consistent data with ω != 0."""
        _, v = self._consistent_data()
        require_nonzero("v0[2]", v[2], "the disc moves along a straight line")
        (x, y, roll, heading), _, (pull_x, pull_y) = self.in_coordinates().exact(t)
        cos, sin = math.cos(heading), math.sin(heading)
        return (
            (np.array([x, y, heading]), np.array([roll])),
            v,
            np.array([pull_x * cos + pull_y * sin, pull_y * cos - pull_x * sin]),
        )

    def in_coordinates(self) -> VerticalRollingDisc:
        """Return the same disc, with the same motion, on R⁴."""
        q0, v0 = _in_coordinates(self.q0, self.v0)
        return VerticalRollingDisc(
            self.mass,
            self.roll_inertia,
            self.heading_inertia,
            self.radius,
            q0=q0,
            v0=v0,
        )


def _in_coordinates(q: tuple[Array, Array], v: Array) -> tuple[Array, Array]:
    """Compute the coordinates (x, y, ψ, φ) and their rates."""
    (x, y, heading), (roll,) = q
    ahead, left, heading_rate, roll_rate = v
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    dx, dy = ahead * cos - left * sin, ahead * sin + left * cos
    return (
        jnp.stack([x, y, roll, heading]),
        jnp.stack([dx, dy, roll_rate, heading_rate]),
    )
