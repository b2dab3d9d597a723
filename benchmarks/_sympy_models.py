"""Rolling bodies written in SymPy, as models for `from_sympy`.

The frames and parameters are taken from SymPy's tests and from PyDy's examples. In
addition, the position of each body has coordinates here, and rolling is a constraint.
"""

import math
from typing import Any

import sympy
from sympy import symbols
from sympy.physics.mechanics import (
    cross,
    dot,
    dynamicsymbols,
    inertia,
    kinetic_energy,
    Point,
    ReferenceFrame,
    RigidBody,
)

import nhjax


def particle() -> nhjax.SymPyModel:
    """Create the nonholonomic particle of the gallery, with the stiffness as `k`."""
    x, y, z = dynamicsymbols("x y z")
    speeds = [q.diff() for q in (x, y, z)]
    k = symbols("k")
    kinetic = sum(u**2 for u in speeds) / 2
    return nhjax.from_sympy(
        kinetic - k * (x**2 + y**2) / 2,
        [x, y, z],
        nonholonomic=speeds[2] - y * speeds[0],
        parameters={k: 1.0},
    )


def rolling_disc() -> nhjax.SymPyModel:
    """Create PyDy's rolling disc (examples/rollingdisc).

    The z axis points down, and the angles are yaw, lean and spin. PyDy's model has no
    coordinates for the contact, because its velocities satisfy the rolling conditions
    by their definition. Here x and y are coordinates.
    """
    x, y, yaw, lean, spin = dynamicsymbols("x y q0 q1 q2")
    r, m, g, across, axial = symbols("r m g I J")
    ground = ReferenceFrame("N")
    heading = ground.orientnew("A", "Axis", [yaw, ground.z])
    plane = heading.orientnew("B", "Axis", [lean, heading.x])
    disc = plane.orientnew("C", "Axis", [spin, plane.y])
    turn = disc.ang_vel_in(ground)
    up = -r * plane.z
    velocity = x.diff() * ground.x + y.diff() * ground.y
    velocity += cross(plane.ang_vel_in(ground), up)
    centre = Point("O")
    centre.set_vel(ground, velocity)
    body = RigidBody(
        "disc", centre, disc, m, (inertia(plane, across, axial, across), centre)
    )
    slip = velocity + cross(turn, -up)
    return nhjax.from_sympy(
        kinetic_energy(ground, body) + m * g * dot(up, ground.z),
        [x, y, yaw, lean, spin],
        nonholonomic=[dot(slip, heading.x), dot(slip, heading.y)],
        parameters={r: 0.5, m: 2.0, g: 9.81, across: 0.13, axial: 0.24},
    )


def rattleback() -> nhjax.SymPyModel:
    """Create PyDy's rattleback (examples/rattleback, the ellipsoid).

    The z axis points down. The coordinates are yaw, lean and pitch, and the position of
    the centre of mass. The parameters are from Kane and Levinson (1982), as in PyDy's
    simulation.
    """
    angles, place = dynamicsymbols("q0 q1 q2"), dynamicsymbols("x y z")
    a, b, c, f, m, g, s = symbols("a b c f m g s")
    xx, yy, zz, xy = symbols("Ixx Iyy Izz Ixy")
    ground = ReferenceFrame("N")
    heading = ground.orientnew("Y", "Axis", [angles[0], ground.z])
    leaning = heading.orientnew("L", "Axis", [angles[1], heading.x])
    stone = leaning.orientnew("R", "Axis", [angles[2], leaning.y])
    turn = stone.ang_vel_in(ground)
    centre = Point("centre of mass")
    velocity = sum(
        (q.diff() * e for q, e in zip(place, ground, strict=True)), 0 * ground.x
    )
    centre.set_vel(ground, velocity)
    body = RigidBody(
        "stone", centre, stone, m, (inertia(stone, xx, yy, zz, xy), centre)
    )
    down = [dot(e, ground.z) for e in stone]
    axes = [n**2 * z for n, z in zip((a, b, c), down, strict=True)]
    size = sympy.sqrt(sum(n * z for n, z in zip(axes, down, strict=True)))
    contact = sum(
        (n / size * e for n, e in zip(axes, stone, strict=True)), -f * stone.z
    )
    slip = velocity + cross(turn, contact)
    return nhjax.from_sympy(
        kinetic_energy(ground, body) + m * g * place[2],
        [*angles, *place],
        nonholonomic=[dot(slip, heading.x), dot(slip, heading.y)],
        holonomic=place[2] + dot(contact, ground.z),
        forces=[(stone, -s * turn)],
        frame=ground,
        parameters={a: 0.2, b: 0.03, c: 0.02, f: 0.01, m: 1.0, g: 9.81, s: 1e-4}
        | {xx: 2e-4, yy: 1.6e-3, zz: 1.7e-3, xy: -2e-5},
    )


def bicycle_parameters() -> dict[str, float]:
    """Return the parameters of Meijaard et al. (2007) for SymPy's `test_kane3.py`.

    In SymPy's model the steer axis is an axis of the frame of the bicycle, and lengths
    are measured along and across the steer axis. Products of inertia have the opposite
    signs.
    """
    rear, front, trail, base = 0.3, 0.35, 0.08, 1.02
    tilt = 0.5 * math.pi - math.pi / 10
    sin, cos = math.sin(tilt), math.cos(tilt)
    offset = front * cos - trail * sin
    length = base * cos - (front - rear) * sin
    above, behind = 0.7 - front, base - 0.9
    reach, angle = math.hypot(above, behind), math.atan2(behind, above)
    height = 0.9 - rear - 0.3 / sin * cos
    return {
        "rear_radius": rear,
        "front_radius": front,
        "tilt": tilt,
        "offset": offset,
        "fork_length": length,
        "frame_length": base * sin - (offset - (front - rear) * cos),
        "frame_across": height * sin,
        "frame_along": 0.3 / sin + height * cos,
        "fork_across": reach * math.cos(0.5 * math.pi - tilt - angle) - length,
        "fork_along": offset + reach * math.sin(0.5 * math.pi - tilt - angle),
        "g": 9.81,
    }


def bicycle() -> nhjax.SymPyModel:
    """Create the bicycle of SymPy's `test_kane3.py`, with all eight coordinates.

    The z axis points up. SymPy's model has no coordinates for the position of the
    bicycle and the turns of its wheels, and its velocities satisfy the rolling
    conditions of the rear wheel by their definition.
    """
    x, y, yaw, lean, pitch, steer, rear_turn, front_turn = coordinates = dynamicsymbols(
        "x y q1 q2 q4 q5 q3 q6"
    )
    values = bicycle_parameters()
    of = {name: sympy.Symbol(name) for name in values}
    ground = ReferenceFrame("N")
    heading = ground.orientnew("Y", "Axis", [yaw, ground.z])
    rolled = heading.orientnew("R", "Axis", [lean, heading.x])
    frame = rolled.orientnew("Frame", "Axis", [pitch + of["tilt"], rolled.y])
    level_frame = frame.orientnew("TempFrame", "Axis", [-of["tilt"], frame.y])
    fork = frame.orientnew("Fork", "Axis", [steer, frame.x])
    level_fork = fork.orientnew("TempFork", "Axis", [-of["tilt"], fork.y])
    rear_wheel = frame.orientnew("WR", "Axis", [rear_turn, frame.y])
    front_wheel = fork.orientnew("WF", "Axis", [front_turn, fork.y])

    # Positions of points relative to the contact point of the rear wheel.
    to_rear = of["rear_radius"] * rolled.z
    joint = to_rear + of["frame_length"] * frame.z
    to_frame = to_rear - of["frame_across"] * frame.x + of["frame_along"] * frame.z
    to_fork = joint - of["fork_across"] * fork.x + of["fork_along"] * fork.z
    to_front = joint + of["fork_length"] * fork.x + of["offset"] * fork.z
    axle: Any = fork.y
    downward = (dot(axle, heading.z) * axle - heading.z).normalize()
    below = of["front_radius"] * downward

    at_contact = x.diff() * ground.x + y.diff() * ground.y
    to_all: dict[str, Any] = {
        "rear wheel": (to_rear, rear_wheel, (frame, 0.0603, 0.12, 0.0603, 0.0), 2),
        "frame": (to_frame, frame, (level_frame, 9.2, 11.0, 2.8, -2.4), 85),
        "fork": (to_fork, fork, (level_fork, 0.05892, 0.06, 0.00708, 0.00756), 4),
        "front wheel": (to_front, front_wheel, (fork, 0.1405, 0.28, 0.1405, 0.0), 3),
    }
    lagrangian: Any = 0
    velocities = {}
    for name, (position, turning, (axes, xx, yy, zz, zx), mass) in to_all.items():
        centre = Point(name)
        velocities[name] = at_contact + position.dt(ground)
        centre.set_vel(ground, velocities[name])
        moments = inertia(axes, xx, yy, zz, izx=zx), centre
        body = RigidBody(name, centre, turning, mass, moments)
        lagrangian += kinetic_energy(ground, body)
        lagrangian -= mass * of["g"] * dot(position, ground.z)
    rear_slip = velocities["rear wheel"] + cross(
        rear_wheel.ang_vel_in(ground), -to_rear
    )
    front_slip = velocities["front wheel"] + cross(
        front_wheel.ang_vel_in(ground), below
    )
    return nhjax.from_sympy(
        lagrangian,
        coordinates,
        nonholonomic=[
            dot(slip, axis)
            for slip in (rear_slip, front_slip)
            for axis in (heading.x, heading.y)
        ],
        holonomic=dot(to_front + below, ground.z),
        parameters=values,
    )
