"""A sleigh of two point masses, with a nonholonomic and a holonomic constraint."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractNonholonomicExample,
    coordinates,
    parameter,
    require_consistent,
    require_positive,
)
from ._planar import direction
from ._sleigh import ChaplyginSleigh


class RodSleigh(AbstractNonholonomicExample):
    """Two point masses on a rigid rod, with a blade under the first one, on R⁴.

    L = m₁/2 |ṙ₁|² + m₂/2 |ṙ₂|²,  q = (x₁, y₁, x₂, y₂).

    The nonholonomic constraint is Φ = n·ṙ₁, and the holonomic constraint is
    Φ_hol = |r₂ - r₁|² - l². The blade makes the angle β with the rod; its normal n is
    (r₂ - r₁)/l turned by β + π/2. For β = 0 the system is the `ChaplyginSleigh`. For
    other angles n is not orthogonal to the rod, so that the reactions of the two
    constraints are coupled.

    A shift of the blade along n does not change the velocities that Φ allows. Therefore
    the body moves like a `ChaplyginSleigh` whose blade is at the foot of the
    perpendicular from the centre of mass to the line through the contact along n.

    **Parameters:** `mass1` m₁ and `mass2` m₂ [kg], `length` l [m], `angle` β [rad].

    **Source:** Chaplygin (1911), for β = 0. Other angles serve to test systems with
    both kinds of constraints.

    !!! example

        >>> from nhjax.systems import RodSleigh
        >>> sleigh = RodSleigh.sliding(speed=0.7, turn_rate=1.1, angle=0.3, length=2.0)
        >>> q, v, multiplier = sleigh.exact(1.0)
        >>> [round(x, 3) for x in q.tolist()]
        [0.694, 0.721, 2.018, 2.221]
    """

    mass1: Array = eqx.field(converter=parameter, default=1.0)
    mass2: Array = eqx.field(converter=parameter, default=0.5)
    length: Array = eqx.field(converter=parameter, default=1.0)
    angle: Array = eqx.field(converter=parameter, default=0.4)
    q0: Array = eqx.field(
        converter=coordinates, default=(0.0, 0.0, 1.0, 0.0), kw_only=True
    )
    v0: Array = eqx.field(
        converter=coordinates,
        default=(
            -0.4 * math.cos(0.4),
            -0.4 * math.sin(0.4),
            -0.4 * math.cos(0.4),
            0.9 - 0.4 * math.sin(0.4),
        ),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_positive(mass1=self.mass1, mass2=self.mass2, length=self.length)

    @classmethod
    def sliding(
        cls,
        speed: ArrayLike,
        turn_rate: ArrayLike,
        position: ArrayLike | tuple[float, float] = (0.0, 0.0),
        rod: ArrayLike = 0.0,
        *,
        mass1: ArrayLike = 1.0,
        mass2: ArrayLike = 0.5,
        length: ArrayLike = 1.0,
        angle: ArrayLike = 0.4,
    ) -> "RodSleigh":
        """Create a sleigh that slides along its blade with `speed` while it turns.

        `position` is the position of the blade, and `rod` is the angle of the rod.
        """
        length, rod_angle = parameter(length), parameter(rod)
        heading = rod_angle + parameter(angle)
        first = coordinates(position)
        along = length * direction(rod_angle)
        across = length * direction(rod_angle + 0.5 * math.pi)
        slide = parameter(speed) * direction(heading)
        return cls(
            mass1,
            mass2,
            length,
            angle,
            q0=jnp.concatenate([first, first + along]),
            v0=jnp.concatenate([slide, slide + parameter(turn_rate) * across]),
        )

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, nonholonomic=self.constraint, holonomic=self.holonomic
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = m₁/2 |ṙ₁|² + m₂/2 |ṙ₂|²."""
        first = 0.5 * self.mass1 * (v[:2] @ v[:2])
        return first + 0.5 * self.mass2 * (v[2:] @ v[2:])

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the constraint Φ = n·ṙ₁."""
        dx, dy = (q[2:] - q[:2]) / self.length
        cos, sin = jnp.cos(self.angle), jnp.sin(self.angle)
        # The blade points along (c, s).
        c, s = cos * dx - sin * dy, sin * dx + cos * dy
        return c * v[1] - s * v[0]

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the holonomic constraint Φ_hol = |r₂ - r₁|² - l²."""
        rod = q[2:] - q[:2]
        return rod @ rod - self.length**2

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved."""
        return {"energy": self.energy(t, q, v)}

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) at `t`, for consistent data, a turning rod and cos β != 0.

        λ has the nonholonomic multiplier first, then the holonomic multiplier. Motion
        and multipliers are computed from the exact solution of `equivalent_sleigh`.
        """
        self._consistent_data()
        tangency = jax.jvp(
            lambda q: self.holonomic(0.0, q, None), (self.q0,), (self.v0,)
        )
        require_consistent("q0", tangency[0], self.q0)
        require_consistent("v0", tangency[1], self.v0)
        sleigh, beta = self.equivalent_sleigh(), float(self.angle)
        if abs(math.cos(beta)) < 1e-8:
            raise ValueError(
                f"`angle` must not be a right angle, got {beta}: steady turning."
            )
        if float(sleigh.v0[2]) == 0:
            raise ValueError("`v0` must turn the rod: the sleigh goes straight.")
        (x, y, heading), (dx, dy, omega), (blade_force,) = sleigh.exact(t)
        m1, m2, length = float(self.mass1), float(self.mass2), float(self.length)
        along = np.array([math.cos(heading), math.sin(heading)])
        normal = np.array([-along[1], along[0]])
        rod = length * (math.cos(beta) * along - math.sin(beta) * normal)
        shift = float(self._shift())
        first = np.array([x, y]) - shift * normal
        slide = np.array([dx, dy]) + shift * omega * along
        second_slide = slide + omega * np.array([-rod[1], rod[0]])
        # Only the rod exerts a force on the second mass, so that the acceleration of
        # this mass gives the holonomic multiplier.
        tension = blade_force * math.sin(beta) / length + m1 * omega**2
        return (
            np.concatenate([first, first + rod]),
            np.concatenate([slide, second_slide]),
            np.array([blade_force, -0.5 * m2 / (m1 + m2) * tension]),
        )

    def equivalent_sleigh(self) -> ChaplyginSleigh:
        """Create a sleigh with the same motion, whose contact is moved along n."""
        rod, swing = self.q0[2:] - self.q0[:2], self.v0[2:] - self.v0[:2]
        heading = jnp.arctan2(rod[1], rod[0]) + self.angle
        turn_rate = (rod[0] * swing[1] - rod[1] * swing[0]) / self.length**2
        along, normal = direction(heading), direction(heading + 0.5 * math.pi)
        mass, shift = self.mass1 + self.mass2, self._shift()
        speed = self.v0[:2] @ along - shift * turn_rate
        return ChaplyginSleigh(
            mass,
            self.mass1 * self.mass2 / mass * self.length**2,
            self.mass2 / mass * self.length * jnp.cos(self.angle),
            q0=jnp.concatenate([self.q0[:2] + shift * normal, heading[None]]),
            v0=jnp.concatenate([speed * along, turn_rate[None]]),
        )

    def _shift(self) -> Array:
        """Compute the signed distance of the centre of mass from the blade, along n."""
        offset = self.mass2 / (self.mass1 + self.mass2) * self.length
        return -offset * jnp.sin(self.angle)
