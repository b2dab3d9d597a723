"""Andrews' squeezing mechanism."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractExample,
    coordinates,
    parameter,
    require_positive,
    require_shape,
)
from ._planar import kinetic_energy, turned


class AndrewsSqueezer(AbstractExample):
    """Seven rigid bodies in a plane that form three loops and are driven by a motor.

    L = Σ (m_k/2 |ċ_k|² + I_k/2 ω_k²) - c₀/2 (|D - C| - l₀)²,
    Φ = (P₂ - P₃, P₂ - P₄, P₂ - P₆),  Q = (M, 0, 0, 0, 0, 0, 0).

    Here q = (β, θ, γ, φ, δ, Ω, ε) [rad]. The bodies K1 to K7 have the angles β, β + θ,
    γ, φ + δ, δ, Ω + ε and ε, which change at the rates ω_k. Each body turns about its
    inner joint: K1 about the origin O, K2 about the end of K1, K3 about B, K5 and K7
    about A, K4 about the end of K5, K6 about the end of K7. The points c_k are the
    centres of mass. The points P_k are the outer ends; the outer ends of K2, K3, K4 and
    K6 meet in one joint P. A spring connects the point D of K3 with the fixed point C.
    A motor turns K1 with the torque M, so that K1 reaches nearly 11 000 revolutions a
    minute within 0.03 s.

    **Parameters:** `masses` m_k [kg] and `inertias` I_k about the centres [kg m²], of
    shape (7,); `arms` and `centres`, the vectors from the inner joint to the outer end
    and to the centre of mass, of shape (7, 2), in the frames of the bodies [m]; the
    points `A`, `B`, `C` in space, and `hook`, the vector from B to D in the frame of K3
    [m]; `stiffness` c₀ [N/m] and `rest_length` l₀ [m] of the spring; `torque` M [N m].

    **Source:** Schiehlen, *Multibody Systems Handbook* (1990); Hairer and Wanner,
    *Solving Ordinary Differential Equations II*, section VII.7; Mazzia and Magherini,
    *Test Set for Initial Value Problem Solvers* (2008), problem "andrews".

    !!! example

        >>> from nhjax.systems import AndrewsSqueezer
        >>> squeezer = AndrewsSqueezer(torque=0.033)
        >>> system, y0 = squeezer.system, squeezer.initial_state()
        >>> round(float(y0.multiplier[0]), 3)
        -98.567
    """

    masses: Array = eqx.field(
        converter=coordinates,
        default=(0.04325, 0.00365, 0.02373, 0.00706, 0.0705, 0.00706, 0.05498),
    )
    inertias: Array = eqx.field(
        converter=coordinates,
        default=(
            *(2.194e-6, 4.41e-7, 5.255e-6, 5.667e-7),
            *(1.169e-5, 5.667e-7, 1.912e-5),
        ),
    )
    arms: Array = eqx.field(
        converter=coordinates,
        default=(
            *((0.007, 0.0), (-0.028, 0.0), (0.0, -0.035), (0.0, -0.02)),
            *((0.04, 0.0), (0.02, 0.0), (0.0, -0.04)),
        ),
    )
    centres: Array = eqx.field(
        converter=coordinates,
        default=(
            *((0.00092, 0.0), (-0.0115, 0.0), (0.01043, -0.01874), (0.0, -0.00579)),
            *((0.02308, 0.00916), (0.00579, 0.0), (-0.00449, -0.01228)),
        ),
    )
    A: Array = eqx.field(converter=coordinates, default=(-0.06934, -0.00227))
    B: Array = eqx.field(converter=coordinates, default=(-0.03635, 0.03273))
    C: Array = eqx.field(converter=coordinates, default=(0.014, 0.072))
    hook: Array = eqx.field(converter=coordinates, default=(0.02, -0.018))
    stiffness: Array = eqx.field(converter=parameter, default=4530.0)
    rest_length: Array = eqx.field(converter=parameter, default=0.07785)
    torque: Array = eqx.field(converter=parameter, default=0.033)
    q0: Array = eqx.field(
        converter=coordinates,
        default=(
            *(-0.0617138900142764496358948458001, 0.0),
            *(0.455279819163070380255912382449, 0.222668390165885884674473185609),
            *(0.487364979543842550225598953530, -0.222668390165885884674473185609),
            1.23054744454982119249735015568,
        ),
        kw_only=True,
    )
    v0: Array = eqx.field(converter=coordinates, default=(0.0,) * 7, kw_only=True)

    def __check_init__(self) -> None:
        require_shape((7,), masses=self.masses, inertias=self.inertias)
        require_shape((7, 2), arms=self.arms, centres=self.centres)
        require_shape((2,), A=self.A, B=self.B, C=self.C, hook=self.hook)
        require_positive(
            masses=self.masses,
            inertias=self.inertias,
            stiffness=self.stiffness,
            rest_length=self.rest_length,
        )

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, holonomic=self.holonomic, force=self.force
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian L = Σ (m/2 |ċ|² + I/2 ω²) - c₀/2 (|D - C| - l₀)²."""
        _, velocities = jax.jvp(self._centres, (q,), (v,))
        masses, inertias = self.masses.astype(v.dtype), self.inertias.astype(v.dtype)
        kinetic = kinetic_energy(masses, inertias, velocities, _body_angles(v))
        spring = self._hook(q) - self.C.astype(q.dtype)
        stretch = jnp.sqrt(spring @ spring) - self.rest_length
        return kinetic - 0.5 * self.stiffness * stretch**2

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Φ = (P₂ - P₃, P₂ - P₄, P₂ - P₆)."""
        _, ends = self._joints(q)
        return jnp.concatenate([ends[1] - ends[k] for k in (2, 3, 5)])

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the force Q = (M, 0, 0, 0, 0, 0, 0) of the motor."""
        return jnp.zeros_like(v).at[0].set(self.torque.astype(v.dtype))

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the conserved difference of the energy and the motor's work M β."""
        return {"energy_less_work": self.energy(t, q, v) - self.torque * q[0]}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of the joints and of the spring's ends, of shape (2,)."""
        inner, ends = self._joints(q)
        A, B, C = (x.astype(q.dtype) for x in (self.A, self.B, self.C))
        joints = {"O": inner[0], "A": A, "B": B, "C": C, "D": self._hook(q)}
        joints |= {f"K{k + 1}": ends[k] for k in (0, 4, 6)}
        return joints | {"P": ends[1]}

    def _joints(self, q: Array) -> tuple[Float[Array, "7 2"], Float[Array, "7 2"]]:
        """Compute the places of the inner joints and outer ends of all bodies."""
        arms = turned(_body_angles(q), self.arms.astype(q.dtype))
        A, B = self.A.astype(q.dtype), self.B.astype(q.dtype)
        origin = jnp.zeros_like(A)
        inner = jnp.stack([origin, arms[0], B, A + arms[4], A, A + arms[6], A])
        return inner, inner + arms

    def _centres(self, q: Array) -> Float[Array, "7 2"]:
        inner, _ = self._joints(q)
        return inner + turned(_body_angles(q), self.centres.astype(q.dtype))

    def _hook(self, q: Array) -> Float[Array, " 2"]:
        return self.B.astype(q.dtype) + turned(q[2], self.hook.astype(q.dtype))


def _body_angles(q: Float[Array, " 7"]) -> Float[Array, " 7"]:
    """Compute the angles of K1 to K7 in space from q, or their rates from v."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    return jnp.stack(
        [beta, beta + theta, gamma, phi + delta, delta, omega + epsilon, epsilon]
    )
