"""The spatial slider-crank mechanism."""

import math
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
    require_shape,
)


class SpatialSliderCrank(AbstractExample):
    """A crank that drives a slider, which runs parallel to the axle of the crank.

    L = J/2 θ̇² + m_r/2 |ċ|² + A/2 ω₁² + B/2 (ω₂² + ω₃²) + m_s/2 ẋ² - m_r g c_z
    - m_c g r/2 cos θ,

    Φ = s - l e(α, β) - p(θ),  e = (cos β, sin α sin β, -cos α sin β),
    p = (0, y₀ - r sin θ, z₀ + r cos θ),  s = (x, 0, 0).

    Here q = (θ, α, β, x): the angle of the crank about its axle, the two angles of the
    universal joint at the slider [rad], and the place of the slider [m]. The axle is
    parallel to the x-axis. The rod has the angular velocity
    ω = (α̇ cos β, β̇, α̇ sin β) in its own axes, of which the first is e. The rod ends
    in a spherical joint at the pin p of the crank. The centre of the rod is c, and
    J = I_c + m_c r²/4 is the moment of inertia of the crank about its axle.

    **Parameters:** `crank_length` r, `rod_length` l, `axle` (y₀, z₀) [m]; `crank_mass`
    m_c, `rod_mass` m_r, `slider_mass` m_s [kg]; `crank_inertia` I_c about the middle of
    the crank, `rod_inertias` (A, B) along and across the rod [kg m²]; `gravity` g
    [m/s²].

    **Source:** Haug, *Computer Aided Kinematics and Dynamics of Mechanical Systems*
    (1989), section 12.2; the problem "spatial rigid slider-crank mechanism" of the
    IFToMM library of computational benchmark problems.

    !!! example

        >>> from nhjax.systems import SpatialSliderCrank
        >>> machine = SpatialSliderCrank.turning(angle=0.3, rate=6.0)
        >>> system, y0 = machine.system, machine.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [1.552, -0.377, 0.617]
    """

    crank_length: Array = eqx.field(converter=parameter, default=0.08)
    rod_length: Array = eqx.field(converter=parameter, default=0.3)
    axle: Array = eqx.field(converter=coordinates, default=(0.1, 0.12))
    crank_mass: Array = eqx.field(converter=parameter, default=0.12)
    rod_mass: Array = eqx.field(converter=parameter, default=0.5)
    slider_mass: Array = eqx.field(converter=parameter, default=2.0)
    crank_inertia: Array = eqx.field(converter=parameter, default=1e-4)
    rod_inertias: Array = eqx.field(converter=coordinates, default=(4e-4, 4e-3))
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(0.0, -math.atan(0.5), math.acos(2 / 3), 0.2),
        kw_only=True,
    )
    v0: Array = eqx.field(
        converter=coordinates,
        default=(6.0, 1.92, -2.4 / math.sqrt(5), 0.24),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_shape((2,), axle=self.axle, rod_inertias=self.rod_inertias)
        require_positive(
            crank_length=self.crank_length,
            rod_length=self.rod_length,
            crank_mass=self.crank_mass,
            rod_mass=self.rod_mass,
            slider_mass=self.slider_mass,
            crank_inertia=self.crank_inertia,
            rod_inertias=self.rod_inertias,
        )

    @classmethod
    def turning(
        cls, angle: ArrayLike, rate: ArrayLike, **parameters: Any
    ) -> "SpatialSliderCrank":
        """Create a mechanism whose crank is at `angle` and turns at `rate`.

        The slider is at x > 0. `parameters` are the parameters of the class.
        """
        machine = cls(**parameters)
        length = machine.rod_length.astype(machine.axle.dtype)
        theta, dtheta = (jnp.asarray(x, length.dtype) for x in (angle, rate))

        def closed(theta):
            pin = machine._pin(theta)
            square = length**2 - pin @ pin
            tilt = jnp.arctan2(-pin[1], pin[2])
            swing = jnp.arctan2(jnp.hypot(pin[1], pin[2]), jnp.sqrt(square))
            return jnp.stack([theta, tilt, swing, jnp.sqrt(square)])

        q0, v0 = jax.jvp(closed, (theta,), (dtheta,))
        require_possible(
            jnp.isfinite(q0),
            f"`angle` {angle} leaves the rod too short for the slider.",
        )
        merged: dict[str, Any] = dict(parameters)
        merged.update(q0=q0, v0=v0)
        return cls(**merged)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(self.lagrangian, holonomic=self.holonomic)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, kinetic minus potential energy."""
        centre, velocity = jax.jvp(self._rod_centre, (q,), (v,))
        rates = jnp.stack([v[1] * jnp.cos(q[2]), v[2], v[1] * jnp.sin(q[2])])
        axial, transverse = self.rod_inertias.astype(v.dtype)
        inertias = jnp.stack([axial, transverse, transverse])
        crank = self.crank_inertia + 0.25 * self.crank_mass * self.crank_length**2
        rod = self.rod_mass * (velocity @ velocity) + inertias @ rates**2
        kinetic = 0.5 * (crank * v[0] ** 2 + rod + self.slider_mass * v[3] ** 2)
        crank_height = 0.5 * self.crank_length * jnp.cos(q[0])
        weight = self.rod_mass * centre[2] + self.crank_mass * crank_height
        return kinetic - self.gravity * weight

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Φ = s - l e - p: the rod ends at the crank's pin."""
        return _along(q[3]) - self._rod(q) - self._pin(q[0])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of the axle, pin and slider, each of shape (3,)."""
        pin = self._pin(q[0])
        axle = jnp.concatenate([jnp.zeros_like(pin[:1]), self.axle.astype(q.dtype)])
        return {"axle": axle, "pin": pin, "slider": _along(q[3])}

    def _pin(self, theta: Array) -> Float[Array, " 3"]:
        y, z = self.axle.astype(theta.dtype)
        arm = self.crank_length * jnp.stack([jnp.sin(theta), jnp.cos(theta)])
        return jnp.stack([jnp.zeros_like(theta), y - arm[0], z + arm[1]])

    def _rod(self, q: Array) -> Float[Array, " 3"]:
        """Compute the vector l e from the pin to the slider."""
        across = jnp.sin(q[2])
        y, z = jnp.sin(q[1]) * across, -jnp.cos(q[1]) * across
        return self.rod_length * jnp.stack([jnp.cos(q[2]), y, z])

    def _rod_centre(self, q: Array) -> Float[Array, " 3"]:
        return _along(q[3]) - 0.5 * self._rod(q)


def _along(x: Array) -> Float[Array, " 3"]:
    """Create the point at x on the x-axis."""
    return jnp.stack([x, jnp.zeros_like(x), jnp.zeros_like(x)])
