"""The bicycle of the gallery in coordinates, and written on two groups.

On SO(3) x R⁵ its q are the attitude of the rear frame and (x, y, δ, θ_R, θ_F), where
the rear wheel touches the ground as in coordinates; on SE(3) x R³ they are the pose of
the rear frame with its origin in the rear hub and (δ, θ_R, θ_F), and that the rear
wheel touches the ground is a second holonomic constraint. Accelerations of the three
forms are compared at a general state, then what a first call and a step of three stages
cost, and the error of the rates of steer and wheels after two seconds.

    python -m benchmarks.bicycle_forms
"""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import nhjax
from nhjax.systems import WhippleBicycle
from nhjax.systems._frames import about_axis, about_x, about_y, about_z, down

from ._report import markdown_table, number, write
from .compile_time import compiled, program


SPACE = nhjax.SO3()
DOWN, AXLE = jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 1.0, 0.0])
DT, NUM_STEPS, SECONDS = 0.02, 20_000, 2.0


class Motion(NamedTuple):
    """How a bicycle moves: vectors in the axes of the rear frame, from its hub.

    - `vertical`, downwards; `hub`, `turning`: the velocities of hub and frame.
    - `depth`: how far below the ground the hub is.
    - `steer`, `rates`: δ and the rates of δ and of both wheels.
    """

    vertical: Any
    hub: Any
    turning: Any
    depth: Any
    steer: Any
    rates: Any


class Bodies:
    """The four bodies and two wheels of a bicycle, seen from the rear hub."""

    def __init__(self, bicycle: WhippleBicycle):
        rear, front = float(bicycle.rear_radius), float(bicycle.front_radius)
        tilt, gravity = float(bicycle.tilt), float(bicycle.gravity)
        self.radii, self.gravity = (rear, front), gravity
        self.axis = jnp.array([np.sin(tilt), 0.0, np.cos(tilt)])

        def seen(x, z):
            return np.array([float(x), 0.0, float(z) + rear])

        self.foot = seen(bicycle.wheelbase + bicycle.trail, 0.0)
        self.front_hub = seen(bicycle.wheelbase, -front)

        def wheel(inertia):
            xx, yy = inertia
            return np.array([xx, yy, xx, 0.0])

        b = bicycle
        # Mass, centre and inertia (xx, yy, zz, xz) of the wheel and of the frame.
        self.rear = (
            (b.rear_wheel_mass, np.zeros(3), wheel(b.rear_wheel_inertia)),
            (b.rear_frame_mass, seen(*b.rear_frame_centre), b.rear_frame_inertia),
        )
        self.front = (
            (b.front_wheel_mass, self.front_hub, wheel(b.front_wheel_inertia)),
            (b.front_frame_mass, seen(*b.front_frame_centre), b.front_frame_inertia),
        )

    def steered(self, steer):
        """The matrix from the axes of the front frame to those of the rear frame."""
        return about_axis(self.axis, steer)

    def of_front(self, motion: Motion):
        """The matrix to the rear axes; the velocities of foot and frame, in front."""
        turned = self.steered(motion.steer)
        foot = turned.T @ (motion.hub + jnp.cross(motion.turning, self.foot))
        return turned, foot, turned.T @ motion.turning + motion.rates[0] * self.axis

    def lagrangian(self, motion: Motion):
        """The Lagrangian, a sum over the bodies."""
        turned, foot, turning = self.of_front(motion)
        total, (_, *spins) = 0.0, motion.rates
        for (mass, centre, inertia), spin in zip(self.rear, (spins[0], 0), strict=True):
            velocity = motion.hub + jnp.cross(motion.turning, centre)
            total += _kinetic(mass, velocity, inertia, motion.turning + spin * AXLE)
            total += mass * self.gravity * (motion.vertical @ centre + motion.depth)
        for (mass, centre, inertia), spin in zip(
            self.front, (spins[1], 0), strict=True
        ):
            arm = centre - self.foot
            velocity = foot + jnp.cross(turning, arm)
            total += _kinetic(mass, velocity, inertia, turning + spin * AXLE)
            depth = motion.vertical @ (self.foot + turned @ arm) + motion.depth
            total += mass * self.gravity * depth
        return total

    def slips(self, motion: Motion):
        """The velocities of the points that touch the ground, in the rear axes."""
        turned, foot, turning = self.of_front(motion)
        _, rear_spin, front_spin = motion.rates
        rear = self.radii[0] * _lowest(motion.vertical)
        front = self.radii[1] * _lowest(turned.T @ motion.vertical)
        hub = foot + jnp.cross(turning, self.front_hub - self.foot)
        slip = hub + jnp.cross(turning + front_spin * AXLE, front)
        turning = motion.turning + rear_spin * AXLE
        return motion.hub + jnp.cross(turning, rear), turned @ slip

    def depths(self, vertical, steer):
        """How far below the rear hub the lowest points of both wheels are."""
        turned = self.steered(steer)
        below = turned.T @ vertical
        hub = vertical @ (self.foot + turned @ (self.front_hub - self.foot))
        rear = self.radii[0] * (vertical @ _lowest(vertical))
        return rear, hub + self.radii[1] * (below @ _lowest(below))


def _kinetic(mass, velocity, inertia, turning):
    x, y, z = turning
    turns = inertia @ jnp.stack([x * x, y * y, z * z, 2 * x * z])
    return 0.5 * (mass * (velocity @ velocity) + turns)


def _lowest(vertical):
    """The direction from a hub to the lowest point of its wheel, in its frame."""
    below = vertical - vertical[1] * AXLE
    return below / jnp.sqrt(below @ below)


def _system(bodies, manifold, motion_of, holonomic):
    def slips(t, q, v, args):
        attitude = q[0][:4]
        each = bodies.slips(motion_of(q, v))
        return jnp.concatenate([SPACE.Ad(attitude, slip)[:2] for slip in each])

    return nhjax.LagrangianSystem(
        lambda t, q, v, args: bodies.lagrangian(motion_of(q, v)),
        nonholonomic=slips,
        holonomic=holonomic,
        manifold=manifold,
    )


def on_se3(bodies: Bodies) -> Any:
    """The bicycle on SE(3) x R³."""

    def motion_of(q, v):
        pose, joints = q
        vertical = SPACE.Ad_dual(pose[:4], DOWN)
        return Motion(vertical, v[:3], v[3:6], pose[6], joints[0], v[6:])

    def holonomic(t, q, args):
        pose, joints = q
        vertical = SPACE.Ad_dual(pose[:4], DOWN)
        return pose[6] + jnp.stack(bodies.depths(vertical, joints[0]))

    manifold = nhjax.ProductGroup(nhjax.SE3(), nhjax.Euclidean(3))
    return _system(bodies, manifold, motion_of, holonomic)


def on_so3(bodies: Bodies) -> Any:
    """The bicycle on SO(3) x R⁵."""
    radius = bodies.radii[0]

    def motion_of(q, v):
        attitude, others = q
        vertical, turning = SPACE.Ad_dual(attitude, DOWN), v[:3]
        # The wheel touches the ground at `radius` times the lowest direction.
        lowest, change = jax.jvp(_lowest, (vertical,), (jnp.cross(vertical, turning),))
        contact = SPACE.Ad_dual(attitude, jnp.stack([v[3], v[4], jnp.zeros_like(v[3])]))
        hub = contact - radius * (change + jnp.cross(turning, lowest))
        depth = -radius * (vertical @ lowest)
        return Motion(vertical, hub, turning, depth, others[2], v[5:])

    def holonomic(t, q, args):
        rear, front = bodies.depths(SPACE.Ad_dual(q[0], DOWN), q[1][2])
        return front - rear

    manifold = nhjax.ProductGroup(SPACE, nhjax.Euclidean(5))
    return _system(bodies, manifold, motion_of, holonomic)


def forms() -> dict[str, tuple[Any, Any, Any]]:
    """The systems, and (q, v) of one motion; the last velocities are always those of
    steer and wheels.
    """
    bicycle = WhippleBicycle.running(
        4.6, lean_rate=0.5, steer_rate=-0.2, lean=0.1, steer=0.15
    )
    q, v, bodies = bicycle.q0, bicycle.v0, Bodies(bicycle)

    def pose(q):
        rotation = about_z(q[2]) @ about_x(q[3]) @ about_y(q[4])
        contact = jnp.stack([q[0], q[1], jnp.zeros_like(q[0])])
        return rotation, contact - bodies.radii[0] * down(rotation)

    (rotation, hub), (rate, velocity) = jax.jvp(pose, (q,), (v,))
    skew = rotation.T @ rate
    turning = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    # A copy, since SciPy 1.14 takes no array that cannot be written.
    xyzw = Rotation.from_matrix(np.array(rotation)).as_quat()
    attitude = jnp.asarray(np.roll(xyzw, 1))
    on_pose = (jnp.concatenate([attitude, hub]), q[5:])
    on_attitude = (attitude, jnp.concatenate([q[:2], q[5:]]))
    twist = jnp.concatenate([rotation.T @ velocity, turning, v[5:]])
    rates = jnp.concatenate([turning, v[:2], v[5:]])
    return {
        "coordinates": (bicycle.system, q, v),
        "SO(3) x R⁵": (on_so3(bodies), on_attitude, rates),
        "SE(3) x R³": (on_se3(bodies), on_pose, twist),
    }


def microseconds(system: Any, y0: nhjax.State) -> float:
    """Time of a step, the best of several runs."""

    @jax.jit
    def run(y0):
        method = nhjax.LobattoIIIAB(3)
        return nhjax.integrate(system, method, y0, dt=DT, num_steps=NUM_STEPS).ys

    jax.block_until_ready(run(y0))
    spent = []
    for _ in range(5):
        start = time.process_time()
        jax.block_until_ready(run(y0))
        spent.append(time.process_time() - start)
    return 1e6 * min(spent) / NUM_STEPS


def rates_at_end(system: Any, y0: nhjax.State, stages: int, dt: float) -> np.ndarray:
    """The rates of steer and wheels after some seconds."""
    method, num_steps = nhjax.LobattoIIIAB(stages), round(SECONDS / dt)
    return np.asarray(
        nhjax.integrate(system, method, y0, dt=dt, num_steps=num_steps).ys.v[0, -3:]
    )


def main() -> None:
    """Print and save the table."""
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    found = {
        name: (system, nhjax.initial_state(system, q, v))
        for name, (system, q, v) in forms().items()
    }
    accelerations = {
        name: np.asarray(nhjax.motion(system, 0.0, y0).acceleration[-3:])
        for name, (system, y0) in found.items()
    }
    expected, data = accelerations["coordinates"], []
    exact = rates_at_end(*found["coordinates"], stages=5, dt=DT / 2)
    for name, (system, y0) in found.items():
        spent = [
            sum(compiled(program(system, 3, kind), y0, jnp.asarray(DT))[1])
            for kind in ("run", "gradient")
        ]
        error = np.max(np.abs(rates_at_end(system, y0, 3, DT) - exact))
        off = np.max(np.abs(accelerations[name] - expected)) / np.max(np.abs(expected))
        data.append(
            {
                "form": name,
                "accelerations": off,
                "run": spent[0],
                "gradient": spent[1],
                "step": microseconds(system, y0),
                "error": error,
            }
        )
        print(*data[-1].values(), sep="\t", flush=True)
    header = ["form", "accelerations", "run", "gradient", "µs a step", "error"]
    rows = []
    for form, off, run, gradient, step, error in (row.values() for row in data):
        spent = (f"{x:.1f}" for x in (run, gradient, step))
        rows.append([form, number(off), *spent, number(error)])
    text = (
        "The relative difference of the accelerations of steer and wheels from those "
        "in coordinates; seconds of the processor to trace and compile a run with "
        "three stages and its gradient; its time for a step; and the error of the "
        f"rates of steer and wheels [1/s] after {SECONDS:g} s with dt = {DT}.\n\n"
    )
    text += markdown_table(header, rows)
    title = "The bicycle in coordinates and on groups"
    write("bicycle_forms", title, text, {"rows": data})


if __name__ == "__main__":
    main()
