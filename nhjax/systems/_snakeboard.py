"""The snakeboard."""

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
    parameter,
    require_positive,
    require_possible,
    require_shape,
)
from ._gait import AbstractGaitMachine, Sinusoid
from ._planar import direction


class Snakeboard(AbstractGaitMachine):
    """A board on two steered axles, propelled by a rotor and by the steering.

    L = m/2 (ẋ² + ẏ²) + J/2 θ̇² + J_r/2 (θ̇ + ψ̇)² + J_w/2 ((θ̇ + φ̇_b)² + (θ̇ + φ̇_f)²),
    Φ = (-sin(θ + φ_b) ẋ + cos(θ + φ_b) ẏ - l cos φ_b θ̇,
         -sin(θ + φ_f) ẋ + cos(θ + φ_f) ẏ + l cos φ_f θ̇).

    Here q = (x, y, θ, ψ, φ_b, φ_f): the centre [m] and heading [rad] of the board, and
    the angles of rotor, rear and front axle relative to the board [rad]. The axles are
    at the distance l behind and ahead of the centre, and do not slip sideways. If
    φ_b = φ_f = π/2, the constraints are dependent.

    A `gait` prescribes the joint angles by constraints Γ = (ψ, φ_b, φ_f) - gait(t).
    With `gait=None` the joints move freely under the torques (τ_ψ, τ_b, τ_f) [N m] in
    `args`, which has shape (3,) or is `None`. In the default gait, the rotor and the
    steering oscillate at the same frequency. This gait drives the board from rest along
    its axis. With other ratios of the frequencies, the board turns in place or moves
    sideways (parking gait).

    **Parameters:** `mass` m [kg]; `inertia` J of the board, `rotor_inertia` J_r and
    `axle_inertia` J_w about the vertical [kg m²]; `half_length` l [m]; `gait`, a
    function of time.

    **Source:** Lewis, Ostrowski, Murray and Burdick, *Nonholonomic mechanics and
    locomotion: the snakeboard example* (1994); Bloch, Krishnaprasad, Marsden and
    Murray, *Nonholonomic mechanical systems with symmetry* (1996).

    !!! example

        >>> from nhjax.systems import Snakeboard
        >>> board = Snakeboard.driving((0.7, 0.3, -0.3), (1.0, 1.0, 1.0))
        >>> system, y0 = board.system, board.initial_state()
        >>> round(float(y0.p[2]), 3)
        0.05
    """

    mass: Array = eqx.field(converter=parameter, default=6.0)
    inertia: Array = eqx.field(converter=parameter, default=0.016)
    rotor_inertia: Array = eqx.field(converter=parameter, default=0.072)
    axle_inertia: Array = eqx.field(converter=parameter, default=0.0013)
    half_length: Array = eqx.field(converter=parameter, default=0.2)
    gait: Callable[[Array], Array] | None = eqx.field(
        default_factory=lambda: Sinusoid(
            (0.7, 0.3, -0.3), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
        ),
        kw_only=True,
    )
    q0: Array = eqx.field(converter=coordinates, default=(0.0,) * 6, kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates, default=(0.0, 0.0, 0.0, 0.7, 0.3, -0.3), kw_only=True
    )

    def __check_init__(self) -> None:
        require_positive(
            mass=self.mass,
            inertia=self.inertia,
            rotor_inertia=self.rotor_inertia,
            axle_inertia=self.axle_inertia,
            half_length=self.half_length,
        )
        require_shape((6,), q0=self.q0, v0=self.v0)

    @classmethod
    def rolling(
        cls,
        speed: ArrayLike,
        joints: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
        joint_rates: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
        **parameters: Any,
    ) -> "Snakeboard":
        """Create a board at the origin with θ = 0, whose centre moves ahead at `speed`.

        The sideways velocity and turning rate follow from the constraints. `joints` are
        (ψ, φ_b, φ_f), and `parameters` the parameters of the class; without a `gait`
        among them the joints move freely.
        """
        merged: dict[str, Any] = {"gait": None} | parameters
        board, angles = cls(**merged), coordinates(joints)
        require_possible(
            jnp.abs(jnp.cos(angles[1:])) > 1e-8,
            f"`joints` = {angles} set an axle along the board, with which it cannot "
            "move ahead.",
        )
        rear, front = jnp.tan(angles[1]), jnp.tan(angles[2])
        ahead = jnp.asarray(speed, angles.dtype)
        turning = ahead * (front - rear) / (2 * board.half_length)
        body = jnp.stack([ahead, 0.5 * ahead * (rear + front), turning])
        q0 = jnp.concatenate([jnp.zeros_like(body), angles])
        v0 = jnp.concatenate([body, coordinates(joint_rates)])
        merged.update(q0=q0, v0=v0)
        return cls(**merged)

    @classmethod
    def driving(
        cls,
        amplitudes: ArrayLike | tuple[float, ...],
        rates: ArrayLike | tuple[float, ...],
        phases: ArrayLike | tuple[float, ...] = (0.0, 0.0, 0.0),
        speed: ArrayLike = 0.0,
        **parameters: Any,
    ) -> "Snakeboard":
        """Create a board with gait (ψ, φ_b, φ_f) = amplitudes sin(rates t + phases).

        The board starts at t = 0 at the origin, and its centre moves ahead at `speed`.
        """
        gait = Sinusoid(amplitudes, rates, phases)
        joints, joint_rates = gait.at_start()
        return cls.rolling(speed, joints, joint_rates, gait=gait, **parameters)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, which is the kinetic energy."""
        turning, (rotor, rear, front) = v[2], v[2] + v[3:]
        spinning = self.inertia * turning**2 + self.rotor_inertia * rotor**2
        steering = self.axle_inertia * (rear**2 + front**2)
        return 0.5 * (self.mass * (v[:2] @ v[:2]) + spinning + steering)

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the sideways velocities of the rear and the front axle."""
        _, velocities = jax.jvp(self._axles, (q,), (v,))
        left = direction(q[2] + q[4:] + 0.5 * jnp.pi)
        return jnp.sum(left * velocities, axis=1)

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the constraints Γ = (ψ, φ_b, φ_f) - gait(t)."""
        if self.gait is None:
            raise ValueError("The joints of this snakeboard move freely: no `gait`.")
        return q[3:] - self.gait(jnp.asarray(t, q.dtype))

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the force (0, 0, 0, τ_ψ, τ_b, τ_f), with the torques in `args`."""
        torques = given_forces(args, (3,), v.dtype, "the torques on the joints")
        return jnp.concatenate([jnp.zeros_like(v[:3]), torques])

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy and the momenta of the joints.

        They are conserved if the joints move freely and without torques. With a gait
        there are no conserved quantities.
        """
        if self.gait is not None:
            return {}
        rotor, rear, front = v[2] + v[3:]
        return {
            "energy": self.energy(t, q, v),
            "rotor_momentum": self.rotor_inertia * rotor,
            "rear_momentum": self.axle_inertia * rear,
            "front_momentum": self.axle_inertia * front,
        }

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Array]:
        """Compute the places of centre, axles and a rotor end, each of shape (2,)."""
        rear, front = self._axles(q)
        rotor = q[:2] + self.half_length * direction(q[2] + q[3])
        return {"centre": q[:2], "rear": rear, "front": front, "rotor_end": rotor}

    def _axles(self, q: Array) -> Float[Array, "2 2"]:
        board = self.half_length * direction(q[2])
        return jnp.stack([q[:2] - board, q[:2] + board])
