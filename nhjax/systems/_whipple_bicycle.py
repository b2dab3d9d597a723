"""The Whipple bicycle, with nonholonomic constraints and a holonomic constraint."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Args, FloatScalarLike
from .._errors import ShapeError
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
from ._frames import (
    about_axis,
    about_x,
    about_y,
    about_z,
    angular_velocity,
    contact_point,
    contact_velocity,
    down,
    Frame,
)


_ANGLES = ("yaw", "lean", "pitch", "steer", "rear_wheel", "front_wheel")


class WhippleBicycle(AbstractNonholonomicExample):
    """A bicycle of four rigid bodies that rolls on two thin wheels.

    L = Σ ½ m |ċ|² + ½ ωᵀ I ω + m g c_z.

    The sum is over the rear wheel, the rear frame with its rider, the front frame and
    the front wheel, each with mass m, centre of mass c, angular velocity ω and inertia
    I. The axes are the axes of the source: x forward, y to the right, z down.

    q = (x, y, ψ, φ, θ, δ, θ_R, θ_F): the contact point of the rear wheel [m], yaw, lean
    (to the right), pitch of the rear frame, steer (to the right) and the angles of the
    wheels relative to their frames [rad]; a wheel that rolls forward has a negative
    rate. Lean is `q[3]` and steer is `q[5]`; the names of the coordinates are x, y,
    yaw, lean, pitch, steer, rear_wheel and front_wheel. In a plot of (x, y), a turn to
    the right looks like a turn to the left, because y points to the right.

    With these coordinates, the rear wheel always touches the ground. The holonomic
    constraint is the depth of the front wheel's lowest point below the ground. Φ
    contains the horizontal velocities, in space, of the points of both wheels that
    touch the ground. The multipliers are forces of the ground: the x and y components
    on the rear wheel, the x and y components on the front wheel, and the z component on
    the front wheel.

    `WhippleBicycle.running(speed, lean=, lean_rate=, steer=, steer_rate=)` creates a
    bicycle that rolls. These arguments are zero by default, except `speed`, which is
    4.6 m/s. `steering` gives the torque on the steer axis: `SteerTorque()` reads the
    torque from `args`, and `LeanToSteer(lean_gain=0.0, lean_rate_gain=20.0)` is a rider
    who steers into the fall. You may also pass your own function of (t, q, v, args).
    With None, the default, the bicycle is uncontrolled, and its energy is conserved. If
    the torque depends on `args`, pass `args` to `initial_state` too.

    The model has no stop for the handlebar. When the bicycle falls, its velocities
    therefore grow without bound, until no step size is small enough. End the run with
    an `Event` before |lean| reaches 0.8 rad or |steer| reaches 1 rad.

    **Parameters:** `wheelbase` w, `trail` c [m], `tilt` λ of the steer axis [rad],
    `gravity` g [m/s²]. For the wheels: `rear_radius`, `front_radius` [m],
    `rear_wheel_mass`, `front_wheel_mass` [kg], `rear_wheel_inertia` and
    `front_wheel_inertia` (xx, yy) [kg m²] about a diameter and the axle. For the
    frames: `rear_frame_mass`, `front_frame_mass` [kg], `rear_frame_centre` and
    `front_frame_centre` (x, z) [m] from the rear contact in the upright bicycle, and
    `rear_frame_inertia` and `front_frame_inertia` (xx, yy, zz, xz) [kg m²] about the
    centre of the frame.

    **Source:** Meijaard, Papadopoulos, Ruina and Schwab, *Linearized dynamics equations
    for the balance and steer of a bicycle*, Proc. R. Soc. A 463 (2007), table 1, whose
    values are the default; Basu-Mandal, Chatterjee and Papadopoulos, *Hands-free
    circular motions of a benchmark bicycle*, the same volume.

    !!! example

        >>> from nhjax.systems import WhippleBicycle
        >>> bicycle = WhippleBicycle.running(speed=5.0, lean_rate=0.3)
        >>> system, y0 = bicycle.system, bicycle.initial_state()
        >>> round(float(y0.multiplier[4]), 1)
        -306.8
    """

    wheelbase: Array = eqx.field(converter=parameter, default=1.02)
    trail: Array = eqx.field(converter=parameter, default=0.08)
    tilt: Array = eqx.field(converter=parameter, default=math.pi / 10)
    gravity: Array = eqx.field(converter=parameter, default=9.81)
    rear_radius: Array = eqx.field(converter=parameter, default=0.3)
    rear_wheel_mass: Array = eqx.field(converter=parameter, default=2.0)
    rear_wheel_inertia: Array = eqx.field(converter=coordinates, default=(0.0603, 0.12))
    rear_frame_mass: Array = eqx.field(converter=parameter, default=85.0)
    rear_frame_centre: Array = eqx.field(converter=coordinates, default=(0.3, -0.9))
    rear_frame_inertia: Array = eqx.field(
        converter=coordinates, default=(9.2, 11.0, 2.8, 2.4)
    )
    front_frame_mass: Array = eqx.field(converter=parameter, default=4.0)
    front_frame_centre: Array = eqx.field(converter=coordinates, default=(0.9, -0.7))
    front_frame_inertia: Array = eqx.field(
        converter=coordinates, default=(0.05892, 0.06, 0.00708, -0.00756)
    )
    front_radius: Array = eqx.field(converter=parameter, default=0.35)
    front_wheel_mass: Array = eqx.field(converter=parameter, default=3.0)
    front_wheel_inertia: Array = eqx.field(
        converter=coordinates, default=(0.1405, 0.28)
    )
    steering: Callable[..., Any] | None = eqx.field(default=None, kw_only=True)
    q0: Array = eqx.field(converter=coordinates, default=(0.0,) * 8, kw_only=True)
    v0: Array = eqx.field(
        converter=coordinates,
        default=(4.6, 0.0, 0.0, 0.5, 0.0, 0.0, -4.6 / 0.3, -4.6 / 0.35),
        kw_only=True,
    )

    def __check_init__(self) -> None:
        require_shape((8,), q0=self.q0, v0=self.v0)
        for end in ("rear", "front"):
            wheel, frame = f"{end}_wheel_inertia", f"{end}_frame_inertia"
            centre = f"{end}_frame_centre"
            require_shape(
                (2,), **{name: getattr(self, name) for name in (wheel, centre)}
            )
            require_shape((4,), **{frame: getattr(self, frame)})
            names = (f"{end}_radius", f"{end}_wheel_mass", f"{end}_frame_mass", wheel)
            require_positive(**{name: getattr(self, name) for name in names})
            require_positive(**{frame: getattr(self, frame)[:3]})
        require_positive(wheelbase=self.wheelbase, gravity=self.gravity)
        if self.steering is not None and not callable(self.steering):
            raise TypeError(
                "WhippleBicycle: `steering` must be a function of (t, q, v, args) that "
                f"returns a torque, or None, got {self.steering!r}."
            )

    @classmethod
    def running(
        cls,
        speed: ArrayLike = 4.6,
        lean_rate: ArrayLike = 0.0,
        steer_rate: ArrayLike = 0.0,
        *,
        lean: ArrayLike = 0.0,
        steer: ArrayLike = 0.0,
        **parameters: Any,
    ) -> "WhippleBicycle":
        """Create a bicycle that rolls, with the given lean, steer and their rates.

        `speed` is the radius of the rear wheel times the rate at which the wheel turns.
        Pitch and all other rates follow from the constraints.
        """
        given = (lean, steer, lean_rate, steer_rate, speed)
        bicycle = cls(**parameters)
        q0, v0, touches = _rolling_start(bicycle, *(parameter(x) for x in given))
        require_possible(
            touches,
            "No pitch was found at which both wheels touch the ground with `lean` = "
            f"{lean} and `steer` = {steer}.",
        )
        parameters.update(q0=q0, v0=v0)
        return cls(**parameters)

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate; its pytree leaves are the parameters."""
        return LagrangianSystem(
            self.lagrangian,
            nonholonomic=self.constraint,
            holonomic=self.holonomic,
            force=None if self.steering is None else self.force,
            coordinates=("x", "y", *_ANGLES),
        )

    def lagrangian(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the Lagrangian as a sum over the four bodies."""
        frames, rates = jax.jvp(lambda q: _frames(self, q), (q,), (v,))
        value = jnp.zeros_like(v[0])
        spins = (v[6], value, value, v[7])
        for body, i, spin in zip(_bodies(self, q), (0, 0, 1, 1), spins, strict=True):
            mass, centre, inertia = body
            velocity = rates[i].move(centre)
            x, y, z = angular_velocity(frames[i], rates[i], spin)
            turning = inertia @ jnp.stack([x * x, y * y, z * z, 2 * x * z])
            kinetic = 0.5 * (mass * (velocity @ velocity) + turning)
            # z points down, so that the term m g z is positive in L.
            value = value + kinetic + mass * self.gravity * frames[i].move(centre)[2]
        return value

    def constraint(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute Φ, the horizontal velocities of the points that touch the ground."""
        frames, rates = jax.jvp(lambda q: _frames(self, q), (q,), (v,))
        each = zip(_wheels(self, q), frames, rates, v[6:], strict=True)
        velocities = [contact_velocity(*wheel, *moving)[:2] for wheel, *moving in each]
        return jnp.concatenate(velocities)

    def holonomic(self, t: FloatScalarLike, q: Array, args: Args) -> Array:
        """Compute the depth of the front wheel's lowest point below the ground."""
        return contact_point(*_wheels(self, q)[1], _frames(self, q)[1])[2:]

    def force(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the generalised force of the torque on the steer axis."""
        force = jnp.zeros_like(v)
        if self.steering is None:
            return force
        torque = jnp.asarray(self.steering(t, q, v, args), force.dtype)
        if torque.shape != ():
            raise ShapeError(
                "WhippleBicycle: `steering(t, q, v, args)` must return one torque of "
                f"shape (), got shape {torque.shape}."
            )
        return force.at[5].set(torque)

    def invariants(self, t: FloatScalarLike, q: Array, v: Array) -> dict[str, Array]:
        """Compute the energy, which is conserved if `steering` is None."""
        return {"energy": self.energy(t, q, v)} if self.steering is None else {}

    def points(self, t: FloatScalarLike, q: Array) -> dict[str, Float[Array, "3"]]:
        """Compute points for drawing, with z upwards and y to the left.

        `head` is the point of the steer axis at the height of the rear frame's centre.
        """
        rear, front = _frames(self, q)
        rear_wheel, front_wheel = _wheels(self, q)
        _, rear_frame, front_frame, _ = _bodies(self, q)
        foot, height = self.wheelbase + self.trail, rear_frame.centre[2]
        points = {
            "rear_contact": contact_point(*rear_wheel, rear),
            "rear_hub": rear.move(rear_wheel.hub),
            "rear_frame": rear.move(rear_frame.centre),
            "head": rear.move(_in_plane(q, foot + height * jnp.tan(self.tilt), height)),
            "front_frame": front.move(front_frame.centre),
            "front_hub": front.move(front_wheel.hub),
            "front_contact": contact_point(*front_wheel, front),
        }
        upwards = jnp.asarray([1, -1, -1], q.dtype)
        return {name: upwards * point for name, point in points.items()}


class _Body(NamedTuple):
    mass: Array
    centre: Float[Array, "3"]
    inertia: Float[Array, "4"]  # xx, yy, zz, xz


class _Wheel(NamedTuple):
    hub: Float[Array, "3"]
    radius: Array


def _bodies(bicycle: WhippleBicycle, q: Array) -> list[_Body]:
    """Return the rear wheel, the rear frame, the front frame and the front wheel."""

    def of_wheel(inertia):
        xx, yy = inertia
        return jnp.stack([xx, yy, xx, jnp.zeros_like(xx)])

    own = bicycle
    (rear_hub, _), (front_hub, _) = _wheels(own, q)
    centres = (own.rear_frame_centre, own.front_frame_centre)
    rear_centre, front_centre = (_in_plane(q, *centre) for centre in centres)
    bodies = (
        (own.rear_wheel_mass, rear_hub, of_wheel(own.rear_wheel_inertia)),
        (own.rear_frame_mass, rear_centre, own.rear_frame_inertia),
        (own.front_frame_mass, front_centre, own.front_frame_inertia),
        (own.front_wheel_mass, front_hub, of_wheel(own.front_wheel_inertia)),
    )
    return [_Body(mass, at, inertia.astype(q.dtype)) for mass, at, inertia in bodies]


def _wheels(bicycle: WhippleBicycle, q: Array) -> tuple[_Wheel, _Wheel]:
    """Return the hub and radius of both wheels of the upright bicycle, rear first."""
    rear, front = bicycle.rear_radius, bicycle.front_radius
    hub = _in_plane(q, jnp.zeros_like(rear), -rear)
    return _Wheel(hub, rear), _Wheel(_in_plane(q, bicycle.wheelbase, -front), front)


def _frames(bicycle: WhippleBicycle, q: Array) -> tuple[Frame, Frame]:
    """Compute the rigid motions of both frames from the upright bicycle to `q`."""
    x, y, yaw, lean, pitch, steer = q[:6]
    rotation = about_z(yaw) @ about_x(lean) @ about_y(pitch)
    hub, radius = _wheels(bicycle, q)[0]
    contact = jnp.stack([x, y, jnp.zeros_like(x)])
    rear = Frame(rotation, contact - radius * down(rotation) - rotation @ hub)
    tilt, reach = bicycle.tilt, bicycle.wheelbase + bicycle.trail
    turned = rotation @ about_axis(_in_plane(q, jnp.sin(tilt), jnp.cos(tilt)), steer)
    # The points of the steer axis, such as its foot, belong to both frames.
    foot = _in_plane(q, reach, jnp.zeros_like(reach))
    return rear, Frame(turned, rear.move(foot) - turned @ foot)


def _in_plane(q: Array, x: Array, z: Array) -> Float[Array, "3"]:
    """Return (x, 0, z), a point of the plane in which the upright bicycle lies."""
    return jnp.stack([x, jnp.zeros_like(x), z]).astype(q.dtype)


class SteerTorque(eqx.Module):
    """The torque of a rider on the handlebar: `args`, in N m, positive to the right.

    If `args` is None, the torque is zero.

    !!! example

        >>> from nhjax.systems import SteerTorque, WhippleBicycle
        >>> bicycle = WhippleBicycle(steering=SteerTorque())
        >>> float(bicycle.force(0.0, bicycle.q0, bicycle.v0, 1.5)[5])
        1.5
    """

    def __call__(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Return the torque `args`, or zero if `args` is None."""
        return given_forces(args, (), v.dtype, "a torque on the steer axis")


class LeanToSteer(eqx.Module):
    """A rider who steers into the fall with the torque K φ + D φ̇, where φ is the lean.

    **Parameters:** `lean_gain` K [N m/rad] and `lean_rate_gain` D [N m s/rad]. The
    default gains keep the default `WhippleBicycle` upright at 2 to 6 m/s.

    **Source:** Schwab, Kooijman and Meijaard, *Some recent developments in bicycle
    dynamics and control* (2008).

    !!! example

        >>> from nhjax.systems import LeanToSteer, WhippleBicycle
        >>> bicycle = WhippleBicycle(steering=LeanToSteer(lean_rate_gain=10.0))
        >>> y0 = bicycle.initial_state()
        >>> round(float(y0.multiplier[4]), 1)
        -302.2
    """

    lean_gain: Array = eqx.field(converter=parameter, default=0.0)
    lean_rate_gain: Array = eqx.field(converter=parameter, default=20.0)

    def __call__(self, t: FloatScalarLike, q: Array, v: Array, args: Args) -> Array:
        """Compute the torque K φ + D φ̇."""
        return self.lean_gain * q[3] + self.lean_rate_gain * v[3]


@eqx.filter_jit
def _rolling_start(
    bicycle: Any,
    lean: Array,
    steer: Array,
    lean_rate: Array,
    steer_rate: Array,
    speed: Array,
) -> tuple[Array, Array, Array]:
    """Compute q0 by Newton's method for the pitch, and v0 by a linear solve.

    The third result is whether both wheels touch the ground.
    """

    def at(pitch):
        angles = jnp.stack([lean, pitch, steer])
        return jnp.concatenate([jnp.zeros(3), angles, jnp.zeros(2)])

    def depth(pitch):
        return bicycle.holonomic(0.0, at(pitch), None)[0]

    def improve(_, pitch):
        value, slope = jax.jvp(depth, (pitch,), (jnp.ones_like(pitch),))
        return pitch - value / slope

    q0 = at(jax.lax.fori_loop(0, 12, improve, jnp.zeros_like(lean)))

    def slip(v):
        _, sinking = jax.jvp(lambda q: bicycle.holonomic(0.0, q, None), (q0,), (v,))
        return jnp.concatenate([bicycle.constraint(0.0, q0, v, None), sinking])

    roll_rate = -speed / bicycle.rear_radius
    given = jnp.stack([lean_rate, steer_rate, roll_rate])
    free, bound = jnp.asarray([3, 5, 6]), jnp.asarray([0, 1, 2, 4, 7])
    v0 = jnp.zeros(8).at[free].set(given)
    slopes = jax.jacfwd(slip)(v0)
    v0 = v0.at[bound].set(jnp.linalg.solve(slopes[:, bound], -slip(v0)))
    near = jnp.abs(depth(q0[4])) < 1e-3 * bicycle.front_radius
    return q0, v0, near & (jnp.abs(q0[4]) < 0.5 * jnp.pi)
