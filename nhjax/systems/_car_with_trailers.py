"""A car with trailers in the plane."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, DTypeLike, Float

from .._custom_types import Args, FloatScalarLike
from .._system import LagrangianSystem
from ._base import (
    AbstractNonholonomicExample,
    coordinates,
    given_forces,
    parameter,
    require_positive,
    require_possible,
    require_shape,
)
from ._planar import direction


class CarWithTrailers(AbstractNonholonomicExample):
    """A car that pulls n trailers, each with one axle, on R⁴⁺ⁿ.

    L = Σ (m_i/2 |ċ_i|² + I_i/2 θ̇_i²) + J/2 (θ̇₀ + δ̇)².

    The sum is over the car (i = 0) and its trailers, with the centres of mass c_i. The
    coordinates are q = (x, y, θ₀, δ, θ₁ ... θₙ): the middle of the rear axle [m], the
    heading of the car, the steer angle of the front wheels relative to the car, and the
    headings of the trailers [rad]. The wheels do not slip sideways. With the unit
    vectors e(θ) along a heading θ and n(θ) to its left, the constraints are

    Φ = (n(θ₀)·ṙ₀, n(θ₀ + δ)·ṙ_front, n(θ₁)·ṙ₁ ... n(θₙ)·ṙₙ).

    The car has the wheelbase L, the rear axle r₀ and the front axle
    r_front = r₀ + L e(θ₀). The axles of the trailers are
    r_i = r_{i-1} - h_i e(θ_{i-1}) - d_i e(θ_i). The multipliers are the forces of the
    ground on the axles, to the left of the wheels.

    `args` is None or a pair: the force that drives the car at the rear axle [N] and
    the torque that steers the front wheels [N m]. Without the torque, the momentum
    J (θ̇₀ + δ̇) is conserved. Without the force and the torque, the energy is conserved
    too. `turning` creates a car that turns steadily.

    **Parameters:** `num_trailers` n, static. For the car: `wheelbase` L; `centre`, the
    distance of the centre of mass ahead of the rear axle [m]; `mass` [kg]; `inertia`
    about the centre, and `steer_inertia` J of the front wheels about the vertical
    [kg m²]. For the trailers: `trailer_length` d from hitch to axle; `trailer_hitch` h,
    the distance of the hitch behind the axle of the vehicle in front; `trailer_centre`,
    the distance of the centre of mass ahead of the axle [m]; `trailer_mass` [kg];
    `trailer_inertia` about the centre [kg m²]. Each parameter of the trailers is one
    number for all, or an array of n numbers. The default values do not describe a
    particular car. The default `v0` is consistent at `q0`, with a speed of 5 m/s.

    **Source:** Laumond, *Controllability of a multibody mobile robot* (1993), and
    Rouchon, Fliess, Lévine and Martin, *Flatness and motion planning: the car with n
    trailers* (1993), for the kinematics.

    !!! example

        >>> from nhjax.systems import CarWithTrailers
        >>> car = CarWithTrailers(num_trailers=3)
        >>> system, y0 = car.system, car.initial_state()
        >>> [round(x, 1) for x in y0.multiplier.tolist()]
        [2599.5, 2119.3, -1049.3, 419.9, -99.9]
    """

    num_trailers: int = eqx.field(static=True, default=1)
    wheelbase: Array = eqx.field(converter=parameter, default=2.7)
    centre: Array = eqx.field(converter=parameter, default=1.4)
    mass: Array = eqx.field(converter=parameter, default=1500.0)
    inertia: Array = eqx.field(converter=parameter, default=2500.0)
    steer_inertia: Array = eqx.field(converter=parameter, default=10.0)
    trailer_length: Array = eqx.field(converter=coordinates, default=3.0)
    trailer_hitch: Array = eqx.field(converter=coordinates, default=1.0)
    trailer_centre: Array = eqx.field(converter=coordinates, default=0.3)
    trailer_mass: Array = eqx.field(converter=coordinates, default=700.0)
    trailer_inertia: Array = eqx.field(converter=coordinates, default=800.0)
    q0: Array = eqx.field(converter=coordinates, default=None, kw_only=True)
    v0: Array = eqx.field(converter=coordinates, default=None, kw_only=True)

    def __post_init__(self) -> None:
        # Equinox applies the converters of the fields only after this method, so that
        # this method converts `q0` itself.
        if self.num_trailers < 0:
            raise ValueError(
                f"`num_trailers` must not be negative, got {self.num_trailers}."
            )
        if self.q0 is None:
            self.q0 = jnp.zeros(4 + self.num_trailers).at[3].set(0.3)
        self.q0 = coordinates(self.q0)
        require_shape((4 + self.num_trailers,), q0=self.q0)
        for name in ("length", "hitch", "centre", "mass", "inertia"):
            _of_trailers(self, f"trailer_{name}", self.q0.dtype)
        if self.v0 is None:
            self.v0 = self.velocity(self.q0, 5.0)

    def __check_init__(self) -> None:
        require_shape((4 + self.num_trailers,), v0=self.v0)
        require_positive(
            wheelbase=self.wheelbase,
            mass=self.mass,
            inertia=self.inertia,
            steer_inertia=self.steer_inertia,
            trailer_length=self.trailer_length,
            trailer_mass=self.trailer_mass,
            trailer_inertia=self.trailer_inertia,
        )

    @classmethod
    def turning(
        cls,
        num_trailers: int = 1,
        speed: ArrayLike = 5.0,
        steer: ArrayLike = 0.3,
        **parameters: Any,
    ) -> "CarWithTrailers":
        """Create a car on a circle, with the trailers in their steady positions.

        `speed` is the speed of the rear axle. All headings turn at the same constant
        rate, and the angles between them stay constant.
        """
        car = cls(num_trailers, **parameters)
        speed, steer = parameter(speed), parameter(steer)
        curvature, share = jnp.tan(steer) / car.wheelbase, jnp.ones_like(steer)
        headings = [jnp.zeros_like(steer)]
        for length, hitch in _hitches(car, steer.dtype):
            # `share` is the speed of the vehicle in front over the speed of the car.
            # The trailer turns at the car's rate if the angle satisfies
            # share · sin - hitch · curvature · cos = length · curvature.
            swing = hitch * curvature
            sine = length * curvature / jnp.hypot(share, swing)
            require_possible(
                jnp.abs(sine) < 1,
                f"`steer` = {steer} is too sharp: a trailer of length {length} cannot "
                "follow the car on so narrow a circle.",
            )
            angle = jnp.arctan2(swing, share) + jnp.arcsin(sine)
            share = share * jnp.cos(angle) + swing * jnp.sin(angle)
            headings.append(headings[-1] - angle)
        ahead = [jnp.zeros_like(steer)] * 2 + [headings[0], steer]
        q0 = coordinates(jnp.stack([*ahead, *headings[1:]]))
        parameters.update(q0=q0, v0=car.velocity(q0, speed))
        return cls(num_trailers, **parameters)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian, nonholonomic=self.constraint, force=self.force
        )

    def velocity(
        self, q: Array, speed: ArrayLike, steer_rate: ArrayLike = 0.0
    ) -> Array:
        """Compute the consistent velocity for a given speed of the rear axle.

        Let v and θ̇ be the speed and the turning rate of the vehicle in front of a
        trailer, and β the heading of this vehicle minus the heading of the trailer. The
        trailer turns at the rate (v sin β - h θ̇ cos β)/d, and has the speed
        v cos β + h θ̇ sin β.
        """
        along, steering = (jnp.asarray(x, q.dtype) for x in (speed, steer_rate))
        heading, steer = q[2], q[3]
        rate = along * jnp.tan(steer) / self.wheelbase
        rates = [along * jnp.cos(heading), along * jnp.sin(heading), rate, steering]
        for i, (length, hitch) in enumerate(_hitches(self, q.dtype)):
            angle, heading = heading - q[4 + i], q[4 + i]
            cos, sin, swing = jnp.cos(angle), jnp.sin(angle), hitch * rate
            rate = (along * sin - swing * cos) / length
            along = along * cos + swing * sin
            rates.append(rate)
        return jnp.stack(rates).astype(q.dtype)

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian, the kinetic energy of all bodies."""
        _, velocities = jax.jvp(lambda q: _centres(self, q), (q,), (v,))
        turning = self.inertia * v[2] ** 2 + self.steer_inertia * (v[2] + v[3]) ** 2
        value = 0.5 * (self.mass * jnp.sum(velocities[0] ** 2) + turning)
        masses = _of_trailers(self, "trailer_mass", q.dtype)
        inertias = _of_trailers(self, "trailer_inertia", q.dtype)
        for i, (mass, inertia) in enumerate(zip(masses, inertias, strict=True)):
            speed = jnp.sum(velocities[1 + i] ** 2)
            value = value + 0.5 * (mass * speed + inertia * v[4 + i] ** 2)
        return value

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute Φ, the sideways velocities of the axles, positive to the left."""
        _, velocities = jax.jvp(lambda q: _axles(self, q), (q,), (v,))
        headings = [q[2], q[2] + q[3], *q[4:]]
        slips = [
            velocity[1] * jnp.cos(heading) - velocity[0] * jnp.sin(heading)
            for velocity, heading in zip(velocities, headings, strict=True)
        ]
        return jnp.stack(slips)

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the generalised force of the drive and the torque in `args`."""
        what = "the driving force and the torque on the steering"
        drive, torque = given_forces(args, (2,), v.dtype, what)
        force = jnp.zeros_like(v)
        return force.at[:2].set(drive * direction(q[2])).at[3].set(torque)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy and the momentum of the front wheels, J (θ̇₀ + δ̇).

        Both are conserved without driving force and torque.
        """
        return {
            "energy": self.energy(t, q, v),
            "steer_momentum": self.steer_inertia * (v[2] + v[3]),
        }

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Float[Array, "2"]]:
        """Compute the positions of axles, centres of mass and hitches, by name."""
        rear, front, *axles = _axles(self, q)
        centre, *centres = _centres(self, q)
        points = {"rear_axle": rear, "front_axle": front, "centre": centre}
        for i, (length, _) in enumerate(_hitches(self, q.dtype)):
            points[f"axle_{i + 1}"], points[f"centre_{i + 1}"] = axles[i], centres[i]
            points[f"hitch_{i + 1}"] = axles[i] + length * direction(q[4 + i])
        return points


def _axles(car: CarWithTrailers, q: Array) -> list[Float[Array, "2"]]:
    """Compute the positions of the car's two axles and of each trailer's axle."""
    axle, along = q[:2], direction(q[2])
    axles = [axle, axle + car.wheelbase * along]
    for i, (length, hitch) in enumerate(_hitches(car, q.dtype)):
        behind = direction(q[4 + i])
        axle = axle - hitch * along - length * behind
        axles.append(axle)
        along = behind
    return axles


def _centres(car: CarWithTrailers, q: Array) -> list[Float[Array, "2"]]:
    """Compute the centres of mass of the car and of the trailers."""
    rear, _, *axles = _axles(car, q)
    ahead = [car.centre, *_of_trailers(car, "trailer_centre", q.dtype)]
    each = zip([rear, *axles], ahead, [q[2], *q[4:]], strict=True)
    return [axle + distance * direction(heading) for axle, distance, heading in each]


def _hitches(car: CarWithTrailers, dtype: DTypeLike) -> list[tuple[Array, Array]]:
    """Return `trailer_length` and `trailer_hitch` of each trailer."""
    lengths, hitches = (
        _of_trailers(car, name, dtype) for name in ("trailer_length", "trailer_hitch")
    )
    return list(zip(lengths, hitches, strict=True))


def _of_trailers(car: CarWithTrailers, name: str, dtype: DTypeLike) -> list[Array]:
    """Return a parameter of the trailers as a list, one value for each trailer."""
    value = coordinates(getattr(car, name)).astype(dtype)
    if value.shape == ():
        return [value] * car.num_trailers
    require_shape((car.num_trailers,), **{name: value})
    return list(value)
