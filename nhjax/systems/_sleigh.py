"""The Chaplygin sleigh."""

import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._custom_types import Args, FloatScalarLike
from ._base import (
    AbstractConstrainedExample,
    coordinates,
    integral,
    parameter,
    require_nonzero,
    require_positive,
)


class ChaplyginSleigh(AbstractConstrainedExample):
    """A rigid body on a horizontal plane, supported by a blade and smooth slides.

    L = m/2 [(ẋ - aθ̇ sin θ)² + (ẏ + aθ̇ cos θ)²] + J/2 θ̇²,
    Φ = -sin θ ẋ + cos θ ẏ,  q = (x, y, θ).

    Here (x, y) is the contact of the blade, so that the mass matrix depends on θ. With
    the speed u along the blade and I = J + ma², the equations of motion are u̇ = aθ̇²
    and Iθ̈ = -mauθ̇. Therefore, if a ≠ 0, every motion that turns tends to a straight
    motion with the centre of mass in front.

    **Parameters:** `mass` m [kg], `inertia` J about the centre of mass [kg m²],
    `offset` a of the centre of mass ahead of the blade [m].

    **Source:** Chaplygin (1911); Neimark and Fufaev, *Dynamics of Nonholonomic
    Systems* (1972).

    !!! example

        >>> from nhjax.systems import ChaplyginSleigh
        >>> sleigh = ChaplyginSleigh(offset=0.2)
        >>> y0, (q, v, multiplier) = sleigh.initial_state(), sleigh.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [-0.245, -0.116, 1.146]
    """

    mass: Array = eqx.field(converter=parameter, default=1.0)
    inertia: Array = eqx.field(converter=parameter, default=0.1)
    offset: Array = eqx.field(converter=parameter, default=0.3)
    q0: Array = eqx.field(converter=coordinates, default=(0.0, 0.0, 0.0), kw_only=True)
    v0: Array = eqx.field(converter=coordinates, default=(-0.4, 0.0, 0.9), kw_only=True)

    def __check_init__(self) -> None:
        require_positive(mass=self.mass, inertia=self.inertia)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L(t, q, v).

        L = m/2 [(ẋ - aθ̇ sin θ)² + (ẏ + aθ̇ cos θ)²] + J/2 θ̇².
        """
        swing = self.offset * v[2]
        centre_vx = v[0] - swing * jnp.sin(q[2])
        centre_vy = v[1] + swing * jnp.cos(q[2])
        rotation = 0.5 * self.inertia * v[2] ** 2
        return 0.5 * self.mass * (centre_vx**2 + centre_vy**2) + rotation

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = -sin θ ẋ + cos θ ẏ."""
        return jnp.cos(q[2]) * v[1] - jnp.sin(q[2]) * v[0]

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for consistent data with θ̇ != 0 and `offset` != 0.

        u = √(2E/m) tanh τ and θ̇ = ±√(2E/I) sech τ with τ = κt + c, κ = a√(2Em)/I, the
        energy E and a constant c. The heading is an elementary function of time, and
        (x, y) is an integral over time.
        """
        (x0, y0, heading0), (dx0, dy0, omega0) = self._consistent_data()
        m, a = float(self.mass), float(self.offset)
        inertia = float(self.inertia) + m * a**2
        require_nonzero("offset", a, "the sleigh moves uniformly")
        require_nonzero("v0[2]", omega0, "the sleigh moves along a straight line")
        u0 = dx0 * math.cos(heading0) + dy0 * math.sin(heading0)
        twice_energy = m * u0**2 + inertia * omega0**2
        top_speed = math.sqrt(twice_energy / m)
        top_rate = math.copysign(math.sqrt(twice_energy / inertia), omega0)
        kappa = a * math.sqrt(twice_energy * m) / inertia
        start = math.asinh(u0 * math.sqrt(m / inertia) / abs(omega0))
        heading_start = heading0 - top_rate / kappa * _gudermannian(start)

        def blade_motion(times):
            tau = kappa * times + start
            heading = heading_start + top_rate / kappa * _gudermannian(tau)
            return heading, top_speed * np.tanh(tau), top_rate * _sech(tau)

        def contact_velocity(times):
            heading, u, _ = blade_motion(times)
            return np.stack([u * np.cos(heading), u * np.sin(heading)])

        heading, u, omega = blade_motion(np.float64(t))
        dx, dy = contact_velocity(np.float64(t))
        x, y = integral(contact_velocity, t, abs(kappa) + abs(top_rate))
        multiplier = m * (1 - m * a**2 / inertia) * u * omega
        return (
            np.array([x0 + x, y0 + y, heading]),
            np.array([dx, dy, omega]),
            np.array([multiplier]),
        )


def _gudermannian(x):
    return 2 * np.arctan(np.tanh(0.5 * x))


def _sech(x):
    # Use exp(-|x|), because cosh would overflow in a long motion.
    decay = np.exp(-np.abs(x))
    return 2 * decay / (1 + decay**2)
