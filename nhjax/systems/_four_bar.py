"""The four-bar linkage."""

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
from ._planar import direction, kinetic_energy


class FourBar(AbstractExample):
    """A crank, a coupler and a rocker that close a loop with the ground.

    L = Σ (m_k/2 |ċ_k|² + I_k/2 θ̇_k² - m_k g y_k),
    Φ = l₁ e(θ₁) + l₂ e(θ₂) - l₃ e(θ₃) - (l₄, 0),  Q = (M, 0, 0).

    Here q = (θ₁, θ₂, θ₃), the angles of crank, coupler and rocker from the horizontal
    [rad], and e(θ) = (cos θ, sin θ). The crank turns about the origin, the rocker about
    (l₄, 0). Each bar is uniform, with the moment of inertia I = m l²/12 about its
    centre c, which is at the height y. The default is a crank-rocker, whose crank makes
    full turns, with bars of 1 kg/m.

    **Parameters:** `lengths` (l₁, l₂, l₃, l₄) [m], where l₄ is the distance between the
    two fixed joints; `masses` (m₁, m₂, m₃) [kg]; `gravity` g [m/s²]; `torque` M on the
    crank [N m].

    **Source:** García de Jalón and Bayo, *Kinematic and Dynamic Simulation of Multibody
    Systems* (1994); for `parallelogram`, the problem "N four-bar mechanism" of
    González, Dopico, Lugrís and Cuadrado, *A benchmarking system for MBS simulation
    software* (2006), and of the IFToMM library of benchmark problems.

    !!! example

        >>> from nhjax.systems import FourBar
        >>> linkage = FourBar.turning(angle=0.3, rate=20.0)
        >>> system, y0 = linkage.system, FourBar.parallelogram().initial_state()
        >>> round(float(y0.multiplier[1]), 3)
        4.405
    """

    lengths: Array = eqx.field(converter=coordinates, default=(0.1, 0.4, 0.3, 0.4))
    masses: Array = eqx.field(converter=coordinates, default=(0.1, 0.4, 0.3))
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    torque: Array = eqx.field(converter=parameter, default=0.0)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(math.pi, math.atan2(3, 4), math.atan2(4, -3)),
        kw_only=True,
    )
    v0: Array = eqx.field(converter=coordinates, default=(20.0, 4.0, 4.0), kw_only=True)

    def __check_init__(self) -> None:
        require_shape((4,), lengths=self.lengths)
        require_shape((3,), masses=self.masses)
        require_positive(lengths=self.lengths, masses=self.masses)

    @classmethod
    def turning(cls, angle: ArrayLike, rate: ArrayLike, **parameters: Any) -> "FourBar":
        """Create a linkage whose crank is at `angle` and turns at `rate`.

        The coupler is on the left of the line from the crank's end to (l₄, 0).
        `parameters` are the parameters of the class.
        """
        first, second, third, ground = cls(**parameters).lengths
        theta, dtheta = parameter(angle), parameter(rate)
        # Solve the triangle of the crank's end and the two ends of the rocker.
        side = jnp.stack([ground, jnp.zeros_like(ground)]) - first * direction(theta)
        square = side @ side
        distance = jnp.sqrt(square)
        cosine = (square + second**2 - third**2) / (2 * distance * second)
        require_possible(
            abs(cosine) < 1, f"`angle` {angle} leaves the bars too short to close."
        )
        coupler = jnp.arctan2(side[1], side[0]) + jnp.arccos(cosine)
        arm = second * direction(coupler) - side
        rocker = jnp.arctan2(arm[1], arm[0])
        closing = first * dtheta / jnp.sin(coupler - rocker)
        dcoupler = closing * jnp.sin(rocker - theta) / second
        drocker = closing * jnp.sin(coupler - theta) / third
        q0 = jnp.stack([theta, coupler, rocker])
        v0 = jnp.stack([dtheta, dcoupler, drocker])
        return cls(**(parameters | {"q0": q0, "v0": v0}))

    @classmethod
    def parallelogram(cls) -> "FourBar":
        """Create the benchmark of the source: one loop of bars of 1 m and 1 kg each.

        At the start the crank is upright, and its end moves to the right at 1 m/s. When
        all bars are horizontal, first after 0.71 s, the constraints are dependent, and
        the loop may fold.
        """
        q0, v0 = (0.5 * math.pi, 0.0, 0.5 * math.pi), (-1.0, 0.0, -1.0)
        return cls((1.0,) * 4, (1.0,) * 3, q0=q0, v0=v0)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, holonomic=self.holonomic, force=self.force
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, kinetic minus potential energy."""
        centres, velocities = jax.jvp(self._centres, (q,), (v,))
        masses, lengths = self.masses.astype(q.dtype), self.lengths.astype(q.dtype)
        inertias = masses * lengths[:3] ** 2 / 12
        kinetic = kinetic_energy(masses, inertias, velocities, v)
        return kinetic - self.gravity * (masses @ centres[:, 1])

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Φ = l₁ e(θ₁) + l₂ e(θ₂) - l₃ e(θ₃) - (l₄, 0)."""
        crank, coupler, rocker = self._bars(q)
        return crank + coupler - rocker - self._ground(q)

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the force Q = (M, 0, 0)."""
        return jnp.zeros_like(v).at[0].set(self.torque.astype(v.dtype))

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the conserved difference of the energy and the torque's work M θ₁."""
        return {"energy_less_work": self.energy(t, q, v) - self.torque * q[0]}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of the four joints of the loop, each of shape (2,)."""
        crank, coupler, _ = self._bars(q)
        ground = self._ground(q)
        joints = {"O": jnp.zeros_like(ground), "A": crank, "B": crank + coupler}
        return joints | {"C": ground}

    def _bars(self, q: Array) -> Float[Array, "3 2"]:
        return self.lengths[:3, None].astype(q.dtype) * direction(q)

    def _ground(self, q: Array) -> Float[Array, " 2"]:
        return jnp.stack([self.lengths[3].astype(q.dtype), jnp.zeros_like(q[0])])

    def _centres(self, q: Array) -> Float[Array, "3 2"]:
        crank, coupler, rocker = self._bars(q)
        return jnp.stack(
            [0.5 * crank, crank + 0.5 * coupler, self._ground(q) + 0.5 * rocker]
        )
