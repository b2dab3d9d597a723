"""The spherical pendulum."""

import math
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, ArrayLike

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    on_host,
    parameter,
    require_consistent,
    require_positive,
)
from ._linear_flow import linear_flow


class SphericalPendulum(AbstractExample):
    """A point mass in R³ on a rod, whose fixed length is a holonomic constraint.

    L = m/2 (ẋ² + ẏ² + ż²) - m g z,  Φ = x² + y² + z² - l²,  q = (x, y, z).

    The height is an elliptic function of time.

    **Parameters:** `mass` m [kg], `length` l [m], `gravity` g [m/s²].

    **Source:** Lagrange (1788); Whittaker, *Analytical Dynamics*, section 55.

    !!! example

        >>> from nhjax.systems import SphericalPendulum
        >>> pendulum = SphericalPendulum.swinging(
        ...     angle=0.5, azimuth_rate=1.2, gravity=9.81)
        >>> q, v, multiplier = pendulum.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [-0.477, -0.04, -0.878]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    length: Array = eqx.field(converter=parameter, default=1.0)
    gravity: Array = eqx.field(converter=parameter, default=1.0)
    q0: Array = eqx.field(converter=coordinates, default=(0.6, 0.0, -0.8), kw_only=True)
    v0: Array = eqx.field(converter=coordinates, default=(0.4, 0.5, 0.3), kw_only=True)

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, length=self.length, gravity=self.gravity)

    @classmethod
    def swinging(
        cls,
        angle: ArrayLike,
        azimuth: ArrayLike = 0.0,
        angle_rate: ArrayLike = 0.0,
        azimuth_rate: ArrayLike = 0.0,
        *,
        mass: ArrayLike = 1.0,
        length: ArrayLike = 1.0,
        gravity: ArrayLike = 1.0,
    ) -> "SphericalPendulum":
        """Create a pendulum at `angle` to the downward vertical and at `azimuth`."""
        sin, cos = jnp.sin(parameter(angle)), jnp.cos(parameter(angle))
        east, north = jnp.cos(parameter(azimuth)), jnp.sin(parameter(azimuth))
        swing, turn = cos * parameter(angle_rate), sin * parameter(azimuth_rate)
        fall = sin * parameter(angle_rate)
        q0 = jnp.stack([sin * east, sin * north, -cos])
        v0 = jnp.stack([swing * east - turn * north, swing * north + turn * east, fall])
        scale = parameter(length)
        return cls(mass, length, gravity, q0=scale * q0, v0=scale * v0)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, holonomic=self.holonomic)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m/2 (ẋ² + ẏ² + ż²) - m g z."""
        return 0.5 * self.mass * (v @ v) - self.mass * self.gravity * q[2]

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraint Φ = x² + y² + z² - l²."""
        return q @ q - self.length**2

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, and the vertical angular momentum."""
        return {
            "energy": self.energy(t, q, v),
            "vertical_momentum": self.mass * (q[0] * v[1] - q[1] * v[0]),
        }

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for every consistent (`q0`, `v0`).

        The height z = z₁ + (z₂ - z₁) sn², with Jacobi's elliptic function sn, has the
        smallest and largest values z₁ and z₂, and determines the multiplier λ. Then x
        and y satisfy the same linear equation, m ẍ = 2λx, which is solved to round-off.
        """
        require_consistent("q0", self.holonomic(0.0, self.q0, None), self.q0)
        require_consistent("v0", self.q0 @ self.v0, self.v0)
        q0, v0 = on_host((self.q0, self.v0))
        m, length, g = float(self.mass), float(self.length), float(self.gravity)
        energy = 0.5 * (v0 @ v0) + g * q0[2]
        height = _height(q0, v0, length, g)

        def matrix(times):
            # The tension of the rod gives 2λ/m = (3gz - 2E)/l², with the energy mE.
            stiffness = (3 * g * height(times)[0] - 2 * energy) / length**2
            zero, one = np.zeros_like(stiffness), np.ones_like(stiffness)
            return np.moveaxis(np.array([[zero, one], [stiffness, zero]]), -1, 0)

        rate = math.sqrt(2 * (abs(energy) + g * length)) / length
        rate += math.sqrt(g / length)
        (x, y), (dx, dy) = linear_flow(matrix, np.stack([q0[:2], v0[:2]]), t, rate)
        z, dz = height(np.asarray(t))
        multiplier = 0.5 * m * (3 * g * z - 2 * energy) / length**2
        return np.array([x, y, z]), np.array([dx, dy, dz]), np.array([multiplier])


def _height(
    q0: np.ndarray, v0: np.ndarray, length: float, g: float
) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Create the function that computes (z, ż) at given times.

    l²ż² is a cubic in z with the leading coefficient 2g and the roots z₁ <= z₂ <= z₃.
    The cubic is written in powers of z - z₀, where z₀ is the height at time 0, so that
    roots near z₀ lose no digits.
    """
    z0, dz0 = q0[2], v0[2]
    kinetic, radius_squared = 0.5 * (v0 @ v0), q0[0] ** 2 + q0[1] ** 2
    quadratic = 4 * g * z0 - 2 * kinetic
    linear = -4 * kinetic * z0 - 2 * g * radius_squared
    roots = np.roots([2 * g, quadratic, linear, (length * dz0) ** 2])
    low, high, beyond = np.sort(roots.real)
    low, high = min(low, 0.0), max(high, 0.0)
    modulus = (high - low) / (beyond - low)
    sigma = math.sqrt(0.5 * g * (beyond - low)) / length
    phase = math.atan2(math.sqrt(-low), math.copysign(math.sqrt(high), dz0))
    start = scipy.special.ellipkinc(phase, modulus)

    def height(times):
        sn, cn, dn, _ = scipy.special.ellipj(sigma * times + start, modulus)
        rise = high - low
        return z0 + low + rise * sn**2, 2 * rise * sigma * sn * cn * dn

    return height
