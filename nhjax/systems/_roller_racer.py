"""The roller racer."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from ._base import (
    coordinates,
    given_forces,
    require_not_negative,
    require_positive,
    require_possible,
    require_shape,
)
from ._gait import AbstractGaitMachine, Sinusoid
from ._planar import direction, kinetic_energy


class RollerRacer(AbstractGaitMachine):
    """Two bodies with one axle each and a pivot, about which the rider swings them.

    L = m₁/2 |ṙ₁|² + I₁/2 θ̇² + m₂/2 |ṙ₂|² + I₂/2 (θ̇ + φ̇)²,
    Φ = (n₁ · ṙ₁, n₂ · ṙ₂),  r₂ = r₁ + d₁ e(θ) + d₂ e(θ + φ).

    Here q = (x, y, θ, φ): the position r₁ = (x, y) [m] of the axle of the seat, the
    heading θ [rad] of the seat, and the angle φ [rad] of the handlebar relative to the
    seat. The unit vector at the angle α is e(α); n₁ and n₂ are the unit vectors across
    the two bodies. The centres of mass lie at the axles, d₁ behind and d₂ ahead of the
    pivot. If d₁ cos φ + d₂ = 0, the constraints do not determine the turning rate.

    A `gait` prescribes φ by the holonomic constraint Γ = φ - gait(t). With `gait=None`
    the pivot moves freely under the torque [N m] in `args`, a scalar or `None`. The
    default gait is a sine, which accelerates the seat from rest.

    **Parameters:** `masses` (m₁, m₂) [kg], `inertias` (I₁, I₂) [kg m²], `distances`
    (d₁, d₂) [m]; `gait`, a function of time. The mass of the handlebar may be 0.

    **Source:** Krishnaprasad and Tsakiris, *Oscillations, SE(2)-snakes and motion
    control: a study of the Roller Racer* (2001); Bloch, *Nonholonomic Mechanics and
    Control* (2003).

    !!! example

        >>> from nhjax.systems import RollerRacer
        >>> racer = RollerRacer.driving(amplitude=0.6, rate=4.0)
        >>> system, y0 = racer.system, racer.initial_state()
        >>> round(float(y0.p[2]), 3)
        -0.42
    """

    masses: Array = eqx.field(converter=coordinates, default=(10.0, 1.0))
    inertias: Array = eqx.field(converter=coordinates, default=(1.0, 0.1))
    distances: Array = eqx.field(converter=coordinates, default=(0.6, 0.2))
    gait: Callable[[Array], Array] | None = eqx.field(
        default_factory=lambda: Sinusoid(0.6, 4.0, 0.0), kw_only=True
    )
    q0: Array = eqx.field(converter=coordinates, default=(0.0,) * 4, kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates, default=(0.0, 0.0, -0.6, 2.4), kw_only=True
    )

    def __check_init__(self) -> None:
        pairs = {"masses": self.masses, "inertias": self.inertias}
        require_shape((2,), **pairs, distances=self.distances)
        require_shape((4,), q0=self.q0, v0=self.v0)
        require_positive(masses=self.masses[:1], inertias=self.inertias)
        require_not_negative(masses=self.masses)

    @classmethod
    def rolling(
        cls,
        speed: ArrayLike,
        angle: ArrayLike = 0.0,
        angle_rate: ArrayLike = 0.0,
        **parameters: Any,
    ) -> "RollerRacer":
        """Create a racer at the origin with θ = 0, whose seat moves ahead at `speed`.

        The turning rate follows from the constraints. `parameters` are the parameters
        of the class; without a `gait` among them the pivot moves freely.
        """
        merged: dict[str, Any] = {"gait": None} | parameters
        behind, ahead = cls(**merged).distances
        phi, dphi = (jnp.asarray(x, behind.dtype) for x in (angle, angle_rate))
        velocity = jnp.asarray(speed, behind.dtype)
        turning = velocity * jnp.sin(phi) - ahead * dphi
        lever = behind * jnp.cos(phi) + ahead
        require_possible(
            jnp.abs(lever) > 1e-8 * (behind + ahead),
            f"`angle` = {phi} makes both axles meet in a point, about which the racer "
            "can turn at any rate: nothing determines its turning.",
        )
        turning = turning / lever
        zero = jnp.zeros_like(phi)
        q0 = jnp.stack([zero, zero, zero, phi])
        v0 = jnp.stack([velocity, zero, turning, dphi])
        merged.update(q0=q0, v0=v0)
        return cls(**merged)

    @classmethod
    def driving(
        cls,
        amplitude: ArrayLike,
        rate: ArrayLike,
        phase: ArrayLike = 0.0,
        speed: ArrayLike = 0.0,
        **parameters: Any,
    ) -> "RollerRacer":
        """Create a racer with the gait φ = amplitude sin(rate t + phase)."""
        gait = Sinusoid(amplitude, rate, phase)
        angle, angle_rate = gait.at_start()
        return cls.rolling(speed, angle, angle_rate, gait=gait, **parameters)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, which is the kinetic energy."""
        _, velocities = jax.jvp(self._axles, (q,), (v,))
        masses, inertias = self.masses.astype(v.dtype), self.inertias.astype(v.dtype)
        return kinetic_energy(masses, inertias, velocities, _headings(v))

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the sideways velocities of the two axles."""
        _, velocities = jax.jvp(self._axles, (q,), (v,))
        left = direction(_headings(q) + 0.5 * jnp.pi)
        return jnp.sum(left * velocities, axis=1)

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraint Γ = φ - gait(t)."""
        if self.gait is None:
            raise ValueError("The pivot of this racer moves freely: it has no `gait`.")
        return q[3] - self.gait(jnp.asarray(t, q.dtype))

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the force (0, 0, 0, τ), with the torque in `args`."""
        torque = given_forces(args, (), v.dtype, "a torque on the pivot")
        return jnp.zeros_like(v).at[3].set(torque)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved without torque.

        With a gait there are no conserved quantities.
        """
        return {} if self.gait is not None else {"energy": self.energy(t, q, v)}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of the two axles and of the pivot, each of shape (2,)."""
        seat, handlebar = self._axles(q)
        pivot = seat + self.distances[0].astype(q.dtype) * direction(q[2])
        return {"seat": seat, "pivot": pivot, "handlebar": handlebar}

    def _axles(self, q: Array) -> Float[Array, "2 2"]:
        arms = self.distances.astype(q.dtype)[:, None] * direction(_headings(q))
        return jnp.stack([q[:2], q[:2] + arms[0] + arms[1]])


def _headings(q: Float[Array, " 4"]) -> Float[Array, " 2"]:
    """Compute the angles of the two bodies in space from q, or their rates from v."""
    return jnp.stack([q[2], q[2] + q[3]])
