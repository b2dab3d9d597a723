"""The pendulum-driven continuously variable transmission."""

import math

import equinox as eqx
import jax.numpy as jnp
import scipy
from jaxtyping import Array, ArrayLike

from .._custom_types import Args, FloatScalarLike
from ._base import AbstractConstrainedExample, coordinates, parameter


class ContinuouslyVariableTransmission(AbstractConstrainedExample):
    """The pendulum-driven continuously variable transmission (CVT).

    L = ½ (ẋ² + ẏ² + ż²) - ½ (x² + z² - 2 cos y + ε sin 2y),
    Φ = ż + sin(y) ẋ,  q = (x, y, z), in dimensionless units.

    The driver y is a pendulum, on which the passenger (x, z) does not act. The energy
    of the driver, E_d = ½ ẏ² - cos y + ½ ε sin 2y, and the energy of the passenger,
    E_p = ½ (ẋ² + ż² + x² + z²), are conserved separately.

    **Parameters:** `epsilon` ε >= 0, the perturbation of the pendulum. The class
    methods `low` and `high` create the system with the two sets of initial data of the
    paper: an oscillating driver (E_d = 4/5, E_p = 1; the default) and a rotating driver
    (E_d = 3, E_p = 1).

    **Source:** Modin and Verdier; Martín de Diego and Sato Martín de Almagro,
    *High-order geometric methods for nonholonomic mechanical systems*, second
    numerical experiment.

    !!! example

        >>> from nhjax.systems import ContinuouslyVariableTransmission as CVT
        >>> cvt = CVT.high(epsilon=0.0)
        >>> y0, (y, dy) = cvt.initial_state(), cvt.exact_driver(1.0)
        >>> round(float(y), 3), round(float(dy), 3)
        (2.51, 2.094)
    """

    epsilon: Array = eqx.field(converter=parameter, default=0.5)
    q0: Array = eqx.field(converter=coordinates, default=(1.0, 0.0, 1.0), kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates, default=(0.0, 0.6 * math.sqrt(10.0), 0.0), kw_only=True
    )

    @classmethod
    def low(cls, epsilon: ArrayLike = 0.5) -> "ContinuouslyVariableTransmission":
        """Create the example with the paper's low energy: the driver oscillates."""
        return cls(epsilon, v0=(0.0, 0.6 * math.sqrt(10.0), 0.0))

    @classmethod
    def high(cls, epsilon: ArrayLike = 0.5) -> "ContinuouslyVariableTransmission":
        """Create the example with the paper's high energy: the driver rotates."""
        return cls(epsilon, v0=(0.0, math.sqrt(8.0), 0.0))

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L(t, q, v).

        L = ½ (ẋ² + ẏ² + ż²) - ½ (x² + z² - 2 cos y + ε sin 2y).
        """
        springs = 0.5 * (q[0] ** 2 + q[2] ** 2)
        return 0.5 * (v @ v) - springs - self._driver_potential(q)

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = ż + sin(y) ẋ."""
        return v[2] + jnp.sin(q[1]) * v[0]

    def driver_energy(self, q: Array, v: Array) -> Array:
        """Compute the energy of the driver, E_d = ½ ẏ² - cos y + ½ ε sin 2y."""
        return 0.5 * v[1] ** 2 + self._driver_potential(q)

    def passenger_energy(self, q: Array, v: Array) -> Array:
        """Compute the energy of the passenger, E_p = ½ (ẋ² + ż² + x² + z²)."""
        return 0.5 * (v[0] ** 2 + v[2] ** 2 + q[0] ** 2 + q[2] ** 2)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, and the energies of driver and passenger."""
        return {
            "energy": self.energy(t, q, v),
            "driver_energy": self.driver_energy(q, v),
            "passenger_energy": self.passenger_energy(q, v),
        }

    def exact_driver(self, t: float) -> tuple[float, float]:
        """Compute (y, ẏ) at `t` for ε = 0, unless the pendulum rests upright.

        Let k² = (1 + E_d)/2, and let t0 be the time shift that fits the initial data.
        If the pendulum oscillates (k < 1), the solution is
        sin(y/2) = k sn(t + t0 | k²); if it rotates, y/2 = ±am(k(t + t0) | 1/k²).
        """
        if float(self.epsilon) != 0:
            raise ValueError(
                f"`epsilon` must be 0 for the exact driver, got {self.epsilon}."
            )
        half, rate = 0.5 * float(self.q0[1]), 0.5 * float(self.v0[1])
        modulus_squared = math.sin(half) ** 2 + rate**2
        modulus = math.sqrt(modulus_squared)
        turns = round(half / math.pi)
        half -= turns * math.pi
        if modulus_squared < 1:
            phase = math.atan2(math.sin(half), rate)
            start = scipy.special.ellipkinc(phase, modulus_squared)
            sn, cn, dn, _ = scipy.special.ellipj(t + start, modulus_squared)
            half, rate = math.atan2(modulus * sn, dn), modulus * cn
        else:
            direction = math.copysign(1.0, rate)
            start = scipy.special.ellipkinc(direction * half, 1 / modulus_squared)
            _, _, dn, am = scipy.special.ellipj(
                modulus * t + start, 1 / modulus_squared
            )
            half, rate = direction * am, direction * modulus * dn
        return float(2 * (half + turns * math.pi)), float(2 * rate)

    def _driver_potential(self, q: Array) -> Array:
        return 0.5 * self.epsilon * jnp.sin(2.0 * q[1]) - jnp.cos(q[1])
