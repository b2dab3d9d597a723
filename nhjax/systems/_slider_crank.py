"""The slider-crank mechanism of piston engines, in a plane."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    parameter,
    require_positive,
    require_possible,
)
from ._planar import direction, kinetic_energy


class SliderCrank(AbstractExample):
    """A crank that drives a slider through a connecting rod, in a vertical plane.

    L = Σ (m_k/2 |ċ_k|² + I_k/2 ω_k² - m_k g y_k) + m_s/2 ẋ²,
    Φ = (r cos θ + l cos φ - x, r sin θ + l sin φ - e),  Q = (M, 0, 0).

    Here Q is the generalised force, and q = (θ, φ, x): the angles of the crank and of
    the rod from the horizontal [rad], and the place of the slider [m], which runs along
    y = e. Crank and rod are uniform bars: a bar of length l has I = m l²/12 about its
    centre c, at the height y.

    **Parameters:** `crank_length` r, `rod_length` l, `offset` e [m]; `crank_mass`,
    `rod_mass`, `slider_mass` m_s [kg]; `gravity` g [m/s²]; `torque` M on the crank
    [N m].

    **Source:** Haug, *Computer Aided Kinematics and Dynamics of Mechanical Systems*
    (1989), with the lengths and masses of its section 12.2; García de Jalón and Bayo,
    *Kinematic and Dynamic Simulation of Multibody Systems* (1994).

    !!! example

        >>> from nhjax.systems import SliderCrank
        >>> engine = SliderCrank.turning(angle=0.3, rate=50.0, torque=0.2)
        >>> system, y0 = engine.system, engine.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [185.331, -49.506]
    """

    crank_length: Array = eqx.field(converter=parameter, default=0.08)
    rod_length: Array = eqx.field(converter=parameter, default=0.3)
    offset: Array = eqx.field(converter=parameter, default=0.0)
    crank_mass: Array = eqx.field(converter=parameter, default=0.12)
    rod_mass: Array = eqx.field(converter=parameter, default=0.5)
    slider_mass: Array = eqx.field(converter=parameter, default=2.0)
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    torque: Array = eqx.field(converter=parameter, default=0.0)
    q0: Array = eqx.field(converter=coordinates, default=(0.0, 0.0, 0.38), kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates, default=(60.0, -16.0, 0.0), kw_only=True
    )

    def __check_init__(self) -> None:
        require_positive(
            crank_length=self.crank_length,
            rod_length=self.rod_length,
            crank_mass=self.crank_mass,
            rod_mass=self.rod_mass,
            slider_mass=self.slider_mass,
        )

    @classmethod
    def turning(
        cls, angle: ArrayLike, rate: ArrayLike, **parameters: Any
    ) -> "SliderCrank":
        """Create a mechanism whose crank is at `angle` and turns at `rate`.

        The slider is at a larger x than the pin of the crank. `parameters` are the
        parameters of the class.
        """
        engine = cls(**parameters)
        theta, dtheta = parameter(angle), parameter(rate)
        crank, rod = engine.crank_length, engine.rod_length
        sine = (engine.offset - crank * jnp.sin(theta)) / rod
        require_possible(
            abs(sine) < 1, f"`angle` {angle} leaves the rod too short for the slider."
        )
        phi = jnp.arcsin(sine)
        dphi = -crank * jnp.cos(theta) * dtheta / (rod * jnp.cos(phi))
        x = crank * jnp.cos(theta) + rod * jnp.cos(phi)
        dx = -crank * jnp.sin(theta) * dtheta - rod * sine * dphi
        q0, v0 = jnp.stack([theta, phi, x]), jnp.stack([dtheta, dphi, dx])
        return cls(**(parameters | {"q0": q0, "v0": v0}))

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, holonomic=self.holonomic, force=self.force
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, kinetic minus potential energy."""
        centres, velocities = jax.jvp(self._centres, (q,), (v,))
        lengths = jnp.stack([self.crank_length, self.rod_length]).astype(q.dtype)
        masses = jnp.stack([self.crank_mass, self.rod_mass]).astype(q.dtype)
        bars = kinetic_energy(masses, masses * lengths**2 / 12, velocities, v[:2])
        slider = 0.5 * self.slider_mass * v[2] ** 2
        return bars + slider - self.gravity * (masses @ centres[:, 1])

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints, which connect the rod to the slider."""
        return self._pin(q) + self._rod(q) - self._slider(q)

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the force Q = (M, 0, 0)."""
        return jnp.zeros_like(v).at[0].set(self.torque.astype(v.dtype))

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the conserved difference of the energy and the torque's work M θ."""
        return {"energy_less_work": self.energy(t, q, v) - self.torque * q[0]}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of the axle, pin and slider, each of shape (2,)."""
        pin = self._pin(q)
        return {"axle": jnp.zeros_like(pin), "pin": pin, "slider": self._slider(q)}

    def _pin(self, q: Array) -> Float[Array, " 2"]:
        return self.crank_length * direction(q[0])

    def _rod(self, q: Array) -> Float[Array, " 2"]:
        return self.rod_length * direction(q[1])

    def _slider(self, q: Array) -> Float[Array, " 2"]:
        return jnp.stack([q[2], self.offset.astype(q.dtype)])

    def _centres(self, q: Array) -> Float[Array, "2 2"]:
        pin = self._pin(q)
        return jnp.stack([0.5 * pin, pin + 0.5 * self._rod(q)])
