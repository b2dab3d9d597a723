"""The Whipple bicycle, which rolls on both wheels: both kinds of constraints.

The benchmark bicycle of Meijaard, Papadopoulos, Ruina and Schwab, "Linearized dynamics
equations for the balance and steer of a bicycle", Proc. R. Soc. A 463 (2007), with its
axes: x forward, y to the right, z down. At v = 5 m/s the eigenvalues about straight
upright running are -0.775341882195845 ± 4.46486771378823 i (weave),
-0.322866429004087 (capsize) and -14.0783896927982 (castering).

q = (x, y, yaw, lean, pitch, steer, rear, front), with (x, y) where the rear wheel
touches the ground, pitch that of the rear frame in its own plane, and the angles of the
wheels relative to their frames; a wheel that rolls forward has a negative rate. That
the rear wheel touches the ground is built in; that the front one does ties the pitch to
lean and steer.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

import nhjax


GRAVITY = 9.81
WHEELBASE = 1.02
TRAIL = 0.08
TILT = math.pi / 10
REAR_RADIUS, FRONT_RADIUS = 0.3, 0.35
REAR_HUB = (0.0, 0.0, -REAR_RADIUS)
FRONT_HUB = (WHEELBASE, 0.0, -FRONT_RADIUS)
# Where the steer axis meets the ground.
AXIS_FOOT = (WHEELBASE + TRAIL, 0.0, 0.0)


class Body(NamedTuple):
    """A rigid body: its mass, and centre and inertia in the upright bicycle.

    Inertia about the centre: (xx, yy, zz, xz); the plane y = 0 is one of symmetry.
    """

    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float, float]


REAR_WHEEL = Body(2.0, REAR_HUB, (0.0603, 0.12, 0.0603, 0.0))
REAR_FRAME = Body(85.0, (0.3, 0.0, -0.9), (9.2, 11.0, 2.8, 2.4))
FRONT_FRAME = Body(4.0, (0.9, 0.0, -0.7), (0.05892, 0.06, 0.00708, -0.00756))
FRONT_WHEEL = Body(3.0, FRONT_HUB, (0.1405, 0.28, 0.1405, 0.0))


class Frame(NamedTuple):
    """A rigid motion: what is at c in the upright bicycle goes to origin + rotation c.

    A rate of it has the same two parts.
    """

    rotation: Array
    origin: Array

    def move(self, point: tuple[float, float, float]) -> Array:
        """Where a point goes, or how fast for a rate."""
        return self.origin + self.rotation @ jnp.asarray(point)


class Frames(NamedTuple):
    """The two frames, each with its wheel on it."""

    rear: Frame
    front: Frame


def bicycle(
    speed: float = 4.6, lean_rate: float = 0.5, lean: float = 0.0, steer: float = 0.0
) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """The bicycle, and a consistent state of it near straight upright running.

    Without lean and steer the lean rate is free, and the state has it exactly;
    elsewhere it is the nearest state that the constraints permit.
    """
    system = whipple_bicycle()
    q = jnp.asarray([0.0, 0.0, 0.0, lean, 0.0, steer, 0.0, 0.0])
    wheels = [-speed / REAR_RADIUS, -speed / FRONT_RADIUS]
    v = jnp.asarray([speed, 0.0, 0.0, lean_rate, 0.0, 0.0, *wheels])
    return system, nhjax.initial_state(system, q, v, project=True)


def whipple_bicycle() -> nhjax.LagrangianSystem:
    """The benchmark bicycle, without rider control."""
    return nhjax.LagrangianSystem(
        _lagrangian, nonholonomic=_slip, holonomic=_front_clearance
    )


def _lagrangian(t, q, v, args):
    frames, rates = jax.jvp(_frames, (q,), (v,))
    bodies = (
        (REAR_WHEEL, frames.rear, rates.rear, v[6]),
        (REAR_FRAME, frames.rear, rates.rear, 0.0),
        (FRONT_FRAME, frames.front, rates.front, 0.0),
        (FRONT_WHEEL, frames.front, rates.front, v[7]),
    )
    return sum((_body_lagrangian(*body) for body in bodies), jnp.zeros_like(v[0]))


def _body_lagrangian(body: Body, frame: Frame, rate: Frame, spin: Array | float):
    velocity = rate.move(body.centre)
    x, y, z = _angular_velocity(frame, rate, spin)
    xx, yy, zz, xz = body.inertia
    turning = xx * x**2 + yy * y**2 + zz * z**2 + 2 * xz * x * z
    # Down is positive, so a body gains energy as z grows.
    weight = body.mass * GRAVITY * frame.move(body.centre)[2]
    return 0.5 * (body.mass * velocity @ velocity + turning) + weight


def _slip(t, q, v, args):
    """The horizontal velocities of the points of both wheels that touch the ground."""
    frames, rates = jax.jvp(_frames, (q,), (v,))
    rear = _contact_velocity(REAR_HUB, REAR_RADIUS, frames.rear, rates.rear, v[6])
    front = _contact_velocity(FRONT_HUB, FRONT_RADIUS, frames.front, rates.front, v[7])
    # The vertical one of the front wheel vanishes by the holonomic constraint.
    return jnp.concatenate([rear[:2], front[:2]])


def _contact_velocity(hub, radius: float, frame: Frame, rate: Frame, spin: Array):
    turning = frame.rotation @ _angular_velocity(frame, rate, spin)
    return rate.move(hub) + jnp.cross(turning, radius * _down(frame.rotation))


def _front_clearance(t, q, args):
    """How far below the ground the front wheel's lowest point is."""
    front = _frames(q).front
    lowest = front.move(FRONT_HUB) + FRONT_RADIUS * _down(front.rotation)
    return lowest[2:]


def _angular_velocity(frame: Frame, rate: Frame, spin: Array | float) -> Array:
    """That of a body that turns about the axle of its frame, in the frame's axes."""
    skew = frame.rotation.T @ rate.rotation
    return jnp.stack([skew[2, 1], skew[0, 2] + spin, skew[1, 0]])


def _down(rotation: Array) -> Array:
    """The direction from the hub of a wheel to its lowest point."""
    axle = rotation[:, 1]
    below = jnp.asarray([0.0, 0.0, 1.0]) - axle[2] * axle
    return below / jnp.sqrt(below @ below)


def _frames(q: Array) -> Frames:
    x, y, yaw, lean, pitch, steer = q[:6]
    rotation = _about_z(yaw) @ _about_x(lean) @ _about_y(pitch)
    contact = jnp.stack([x, y, jnp.zeros_like(x)])
    hub = contact - REAR_RADIUS * _down(rotation)
    rear = Frame(rotation, hub - rotation @ jnp.asarray(REAR_HUB))
    tilt = _about_y(jnp.asarray(TILT, q.dtype))
    turned = rotation @ (tilt @ _about_z(steer) @ tilt.T)
    # The points of the steer axis belong to both frames.
    front = Frame(turned, rear.move(AXIS_FOOT) - turned @ jnp.asarray(AXIS_FOOT))
    return Frames(rear, front)


def _about_x(angle: Array) -> Array:
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([one, zero, zero, zero, c, -s, zero, s, c]).reshape(3, 3)


def _about_y(angle: Array) -> Array:
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([c, zero, s, zero, one, zero, -s, zero, c]).reshape(3, 3)


def _about_z(angle: Array) -> Array:
    c, s = jnp.cos(angle), jnp.sin(angle)
    one, zero = jnp.ones_like(c), jnp.zeros_like(c)
    return jnp.stack([c, -s, zero, s, c, zero, zero, zero, one]).reshape(3, 3)
