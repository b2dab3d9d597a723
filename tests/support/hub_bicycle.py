"""A bicycle in the coordinates of its rear hub, with both wheels held on the ground.

q = (x, y, z, yaw, lean, pitch, steer, rear and front wheel angle): the rear hub and the
angles of the rear frame R = R_z(yaw) R_x(lean) R_y(pitch), z upwards. The contact of
the wheels gives two holonomic constraints, and their rolling four nonholonomic ones.
"""

import jax
import jax.numpy as jnp
import numpy as np

import nhjax


REAR_RADIUS, FRONT_RADIUS = 0.32, 0.34
BASE, HEAD_ANGLE = 1.05, 0.31
MASSES = {"rear wheel": 2.1, "frame": 84.0, "fork": 3.7, "front wheel": 2.9}
GRAVITY = 9.81
UP = jnp.array([0.0, 0.0, 1.0])
AXLE = jnp.array([0.0, 1.0, 0.0])
STEER_AXIS = jnp.array([-np.sin(HEAD_ANGLE), 0.0, np.cos(HEAD_ANGLE)])
# A point of the steer axis, seen from the rear hub in the frame.
HEAD = jnp.array([0.72, 0.0, 0.45])


def turn(axis, angle):
    """Make the rotation matrix about an axis of length one."""
    x, y, z = axis
    hat = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return jnp.eye(3) + jnp.sin(angle) * hat + (1 - jnp.cos(angle)) * hat @ hat


def attitudes(q):
    """Compute the rotations of the frame and of the fork."""
    frame = turn(UP, q[3]) @ turn((1.0, 0.0, 0.0), q[4]) @ turn(AXLE, q[5])
    return frame, frame @ turn(STEER_AXIS, q[6])


def front_hub(q):
    """Compute where the front hub is."""
    frame, fork = attitudes(q)
    straight = jnp.array([BASE, 0.0, FRONT_RADIUS - REAR_RADIUS]) - HEAD
    return q[:3] + frame @ HEAD + fork @ straight


def bodies(q):
    """List (centre of mass, attitude, mass, inertia) of the four bodies."""
    frame, fork = attitudes(q)
    front = front_hub(q)
    straight = jnp.array([BASE, 0.0, FRONT_RADIUS - REAR_RADIUS])
    of_fork = front + fork @ (jnp.array([0.9, 0.0, 0.38]) - straight)
    of_frame = q[:3] + frame @ jnp.array([0.31, 0.0, 0.58])
    return [
        (q[:3], frame @ turn(AXLE, q[7]), "rear wheel", (0.06, 0.12, 0.06)),
        (of_frame, frame, "frame", (9.1, 10.8, 2.9)),
        (of_fork, fork, "fork", (0.06, 0.06, 0.008)),
        (front, fork @ turn(AXLE, q[8]), "front wheel", (0.14, 0.28, 0.14)),
    ]


def lagrangian(t, q, v, args):
    """Compute kinetic less potential energy."""
    total = 0.0
    rates = jax.jvp(lambda q: [(c, R) for c, R, *_ in bodies(q)], (q,), (v,))[1]
    for body, (velocity, dR) in zip(bodies(q), rates, strict=True):
        centre, R, name, inertia = body
        m, spin = MASSES[name], R.T @ dR
        rate = jnp.array([spin[2, 1], spin[0, 2], spin[1, 0]])
        turning = rate @ (jnp.array(inertia) * rate)
        total = total + 0.5 * m * velocity @ velocity + 0.5 * turning
        total = total - m * GRAVITY * centre[2]
    return total


def wheels(q):
    """List (hub, axle direction, attitude, radius) of both wheels."""
    frame, fork = attitudes(q)
    return [
        (q[:3], frame @ AXLE, frame @ turn(AXLE, q[7]), REAR_RADIUS),
        (front_hub(q), fork @ AXLE, fork @ turn(AXLE, q[8]), FRONT_RADIUS),
    ]


def clearance(t, q, args):
    """Compute how high the lowest points of both wheels are."""
    return jnp.stack(
        [hub[2] - r * jnp.sqrt(1 - axle[2] ** 2) for hub, axle, _, r in wheels(q)]
    )


def slip(t, q, v, args):
    """Compute the horizontal velocities of the points of both wheels on the ground."""
    rates = jax.jvp(lambda q: [(hub, R) for hub, _, R, _ in wheels(q)], (q,), (v,))[1]
    slips = []
    for (_, axle, R, r), (velocity, dR) in zip(wheels(q), rates, strict=True):
        upwards = UP - axle[2] * axle
        arm = -r * upwards / jnp.sqrt(1 - axle[2] ** 2)
        slips.append((velocity + dR @ (R.T @ arm))[:2])
    return jnp.concatenate(slips)


def make_system():
    """Make the system of the bicycle."""
    return nhjax.LagrangianSystem(lagrangian, nonholonomic=slip, holonomic=clearance)


def upright(lean, speed):
    """Make a guess, to be projected, of a state that rolls straight on with a lean."""
    q = jnp.zeros(9).at[2].set(REAR_RADIUS * jnp.cos(lean)).at[4].set(lean)
    v = jnp.zeros(9).at[0].set(speed)
    v = v.at[7].set(speed / REAR_RADIUS).at[8].set(speed / FRONT_RADIUS)
    return q, v
