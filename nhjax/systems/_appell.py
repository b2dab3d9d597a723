"""Appell's system: a constraint nonlinear in the velocities."""

import equinox as eqx
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


class Appell(AbstractConstrainedExample):
    """A falling particle whose horizontal speed is κ times its vertical speed.

    L = m/2 (ẋ² + ẏ² + ż²) - mgz,  Φ = ½ (ẋ² + ẏ² - κ²ż²),  q = (x, y, z).

    Φ is homogeneous and nonlinear in the velocities. By Chetaev's rule the reaction is
    λ D2Φ, with the derivative D2Φ of Φ with respect to the velocities. The particle
    falls along a straight line with the vertical acceleration g/(1 + κ²). At ż = 0 the
    constraint is singular, because D2Φ is zero there.

    **Parameters:** `mass` m [kg], `gravity` g [m/s²], `ratio` κ [1].

    **Source:** Appell (1911); Neimark and Fufaev, *Dynamics of Nonholonomic Systems*
    (1972).

    !!! example

        >>> from nhjax.systems import Appell
        >>> appell = Appell(gravity=9.81)
        >>> y0, (q, v, multiplier) = appell.initial_state(), appell.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [1.577, 2.17, -4.624]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    gravity: Array = eqx.field(converter=parameter, default=1.0)
    ratio: Array = eqx.field(converter=parameter, default=0.5)
    q0: Array = eqx.field(converter=coordinates, default=(0.1, 0.2, 0.3), kw_only=True)
    v0: Array = eqx.field(converter=coordinates, default=(0.3, 0.4, -1.0), kw_only=True)

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, ratio=self.ratio)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m/2 (ẋ² + ẏ² + ż²) - mgz."""
        return 0.5 * self.mass * (v @ v) - self.mass * self.gravity * q[2]

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = ½ (ẋ² + ẏ² - κ²ż²)."""
        return 0.5 * (v[0] ** 2 + v[1] ** 2 - self.ratio**2 * v[2] ** 2)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, and the direction of motion ẋ/ż, ẏ/ż."""
        return {
            "energy": self.energy(t, q, v),
            "slope_x": v[0] / v[2],
            "slope_y": v[1] / v[2],
        }

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t` for consistent data, as long as ż keeps its sign."""
        q0, v0 = self._consistent_data()
        require_nonzero("v0[2]", v0[2], "the constraint is singular there")
        weight = float(self.mass) * float(self.gravity)
        inertia = 1 + float(self.ratio) ** 2
        acceleration = -float(self.gravity) / inertia
        dz = v0[2] + acceleration * t
        if dz * v0[2] <= 0:
            raise ValueError(
                f"`t` = {t} is beyond the singular instant "
                f"{-v0[2] / acceleration}, where the vertical velocity vanishes."
            )
        direction = v0 / v0[2]
        q = q0 + direction * (v0[2] * t + 0.5 * acceleration * t**2)
        return q, direction * dz, np.array([-weight / (inertia * dz)])
