"""The nonholonomic particle in a harmonic potential."""

import math

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from ._base import (
    AbstractConstrainedExample,
    coordinates,
    integral,
    parameter,
    require_positive,
)


class NonholonomicParticle(AbstractConstrainedExample):
    """A particle in space, bound by springs to the z axis.

    L = m/2 (ẋ² + ẏ² + ż²) - k/2 (x² + y²),  Φ = ż - y ẋ,  q = (x, y, z).

    The coordinate y (the driver) is a harmonic oscillator, which x and z (the
    passenger) do not influence. In the rescaled time s with ds = ν dt/√(1 + y²) and
    ν² = k/m, the coordinate x is a harmonic oscillator, too.

    **Parameters:** `mass` m [kg], `stiffness` k [N/m]; lengths are in metres, and the
    factor y in Φ stands for y times 1 m⁻¹.

    **Source:** Martín de Diego and Sato Martín de Almagro, *High-order geometric
    methods for nonholonomic mechanical systems*, first numerical experiment (there
    m = k = 1).

    !!! example

        >>> from nhjax.systems import NonholonomicParticle
        >>> particle = NonholonomicParticle(stiffness=4.0)
        >>> y0, (q, v, multiplier) = particle.initial_state(), particle.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [-0.089, 0.193, -0.203]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    stiffness: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(converter=coordinates, default=(1.0, 0.3, 0.2), kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates, default=(0.4, 0.7, 0.3 * 0.4), kw_only=True
    )

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, stiffness=self.stiffness)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m/2 (ẋ² + ẏ² + ż²) - k/2 (x² + y²)."""
        potential = 0.5 * self.stiffness * (q[0] ** 2 + q[1] ** 2)
        return 0.5 * self.mass * (v @ v) - potential

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = ż - y ẋ."""
        return v[2] - q[1] * v[0]

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for every consistent (`q0`, `v0`)."""
        (x0, y0, z0), (dx0, dy0, _) = self._consistent_data()
        mass, stiffness = float(self.mass), float(self.stiffness)
        nu = math.sqrt(stiffness / mass)
        amplitude = math.hypot(y0, dy0 / nu)
        phase = math.atan2(y0, dy0 / nu)
        start = scipy.special.ellipkinc(phase, -(amplitude**2))
        dx_ds0 = math.sqrt(1 + y0**2) * dx0 / nu

        def planar_motion(times):
            y = amplitude * np.sin(nu * times + phase)
            s = scipy.special.ellipkinc(nu * times + phase, -(amplitude**2)) - start
            x = x0 * np.cos(s) + dx_ds0 * np.sin(s)
            dx = nu * (dx_ds0 * np.cos(s) - x0 * np.sin(s)) / np.sqrt(1 + y**2)
            return x, y, dx

        def climb(times):
            _, y, dx = planar_motion(times)
            return y * dx

        x, y, dx = planar_motion(np.float64(t))
        dy = nu * amplitude * math.cos(nu * t + phase)
        z = z0 + integral(climb, t, nu * (1 + amplitude))
        multiplier = (mass * dx * dy - stiffness * x * y) / (1 + y**2)
        return np.array([x, y, z]), np.array([dx, dy, y * dx]), np.array([multiplier])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energies: total, of driver y, and of passenger (x, z)."""
        driver = 0.5 * (self.mass * v[1] ** 2 + self.stiffness * q[1] ** 2)
        passenger = 0.5 * self.mass * (v[0] ** 2 + v[2] ** 2)
        passenger = passenger + 0.5 * self.stiffness * q[0] ** 2
        return {
            "energy": self.energy(t, q, v),
            "driver_energy": driver,
            "passenger_energy": passenger,
        }
