"""A planar robot on two wheels, which are driven by motors."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractNonholonomicExample,
    coordinates,
    given_forces,
    parameter,
    require_positive,
    require_shape,
)


class TwoWheeledRobot(AbstractNonholonomicExample):
    """A robot with two driven wheels on one axle (a differential drive), on R⁵.

    L = m/2 |ċ|² + I/2 θ̇² + Σ (m_w/2 |ẇ|² + I_m/2 θ̇² + I_w/2 φ̇²),

    q = (x, y, θ, φ_R, φ_L): the middle r of the axle [m], the heading, and the angles
    of the right and of the left wheel [rad], which grow as the robot goes ahead. The
    centre of mass of the platform is c = r + d e. The sum is over the two wheels, with
    the centres w = r - b n (right) and r + b n (left) and the unit vectors e along the
    heading and n to its left. The wheels roll and do not slip sideways:

    Φ = (n·ṙ, e·ṙ + b θ̇ - ρ φ̇_R, e·ṙ - b θ̇ - ρ φ̇_L).

    The multipliers are the forces of the ground [N]: the force to the left on both
    wheels together, and the forward forces on the right and on the left wheel. The
    model has no castors.

    `args` is None or a pair: the torques of the motors on the right and on the left
    wheel [N m]. Without torques, the energy is conserved.

    **Parameters:** `mass` m of the platform [kg], its `inertia` I about its centre of
    mass [kg m²] and the `offset` d of this centre ahead of the axle [m]; `half_track`
    b, half of the distance between the wheels, and their `radius` ρ [m]; for each
    wheel, `wheel_mass` m_w [kg], and `axle_inertia` I_w about the axle and
    `wheel_inertia` I_m about a diameter [kg m²], both including the motor's rotor.

    **Source:** Yamamoto and Yun, *Coordinating locomotion and manipulation of a mobile
    manipulator* (1994); Dhaouadi and Abu Hatab, *Dynamic modelling of
    differential-drive mobile robots using Lagrange and Newton-Euler methodologies*
    (2013).

    !!! example

        >>> from nhjax.systems import TwoWheeledRobot
        >>> robot = TwoWheeledRobot.rolling(speed=1.0, turn_rate=0.5)
        >>> system, y0 = robot.system, robot.initial_state()
        >>> [round(x, 3) for x in y0.multiplier.tolist()]
        [13.945, 0.023, -0.053]
    """

    mass: Array = eqx.field(converter=parameter, default=30.0)
    inertia: Array = eqx.field(converter=parameter, default=15.625)
    offset: Array = eqx.field(converter=parameter, default=0.3)
    half_track: Array = eqx.field(converter=parameter, default=0.75)
    radius: Array = eqx.field(converter=parameter, default=0.15)
    wheel_mass: Array = eqx.field(converter=parameter, default=1.0)
    axle_inertia: Array = eqx.field(converter=parameter, default=0.005)
    wheel_inertia: Array = eqx.field(converter=parameter, default=0.0025)
    q0: Array = eqx.field(converter=coordinates, default=(0.0,) * 5, kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates,
        default=(0.6, 0.0, 0.4, (0.6 + 0.75 * 0.4) / 0.15, (0.6 - 0.75 * 0.4) / 0.15),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_shape((5,), q0=self.q0, v0=self.v0)
        require_positive(
            mass=self.mass,
            inertia=self.inertia,
            half_track=self.half_track,
            radius=self.radius,
            wheel_mass=self.wheel_mass,
            axle_inertia=self.axle_inertia,
            wheel_inertia=self.wheel_inertia,
        )

    @classmethod
    def rolling(
        cls,
        speed: ArrayLike = 0.6,
        turn_rate: ArrayLike = 0.4,
        heading: ArrayLike = 0.0,
        **parameters: Any,
    ) -> "TwoWheeledRobot":
        """Create a rolling robot; the middle of its axle moves at `speed` [m/s]."""
        robot = cls(**parameters)
        ahead, turn = parameter(speed), parameter(turn_rate)
        zero, angle = jnp.zeros_like(ahead), parameter(heading)
        right = (ahead + robot.half_track * turn) / robot.radius
        left = (ahead - robot.half_track * turn) / robot.radius
        dx, dy = ahead * jnp.cos(angle), ahead * jnp.sin(angle)
        parameters.update(
            q0=jnp.stack([zero, zero, angle, zero, zero]),
            v0=jnp.stack([dx, dy, turn, right, left]),
        )
        return cls(**parameters)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, nonholonomic=self.constraint, force=self.force
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, the kinetic energy of the platform and the wheels."""
        _, velocities = jax.jvp(self._centres, (q,), (v,))
        centre, right, left = (jnp.sum(velocity**2) for velocity in velocities)
        moving = self.mass * centre + self.wheel_mass * (right + left)
        turning = (self.inertia + 2 * self.wheel_inertia) * v[2] ** 2
        return 0.5 * (moving + turning + self.axle_inertia * (v[3] ** 2 + v[4] ** 2))

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute Φ, the velocities of slip of the wheels."""
        cos, sin = jnp.cos(q[2]), jnp.sin(q[2])
        ahead, aside = v[0] * cos + v[1] * sin, v[1] * cos - v[0] * sin
        swing = self.half_track * v[2]
        right = ahead + swing - self.radius * v[3]
        return jnp.stack([aside, right, ahead - swing - self.radius * v[4]])

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the generalised force of the motor torques in `args`."""
        what = "the torques of the motors on the right and on the left"
        torques = given_forces(args, (2,), v.dtype, what)
        return jnp.zeros_like(v).at[3:5].set(torques)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved without torques."""
        return {"energy": self.energy(t, q, v)}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Float[Array, "2"]]:
        """Compute the places of wheels, centre of mass and the middle of the axle."""
        centre, right, left = self._centres(q)
        return {
            "axle": q[:2],
            "centre": centre,
            "right_wheel": right,
            "left_wheel": left,
        }

    def _centres(self, q: Array) -> tuple[Array, Array, Array]:
        """Compute the positions of the centre of mass, right wheel and left wheel."""
        cos, sin = jnp.cos(q[2]), jnp.sin(q[2])
        aside = self.half_track * jnp.stack([-sin, cos])
        centre = q[:2] + self.offset * jnp.stack([cos, sin])
        return centre, q[:2] - aside, q[:2] + aside
