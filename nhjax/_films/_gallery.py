"""The looks of the gallery's machines."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .. import systems
from .._manifold import SO3
from ._looks import (
    about,
    along,
    AXLE_ALONG_Z,
    ball,
    banded_ball,
    between,
    BLUE,
    body,
    bowl,
    box,
    cylinder,
    DARK,
    flat,
    frame,
    GREY,
    half_ellipsoid,
    link,
    Looks,
    mesh,
    model,
    ORANGE,
    PALE,
    Pose,
    RED,
    ring,
    rod,
    spoked_wheel,
    upright,
    wheel,
)


def looks_of(machine: Any) -> Looks | None:
    """Return the looks of a machine of the gallery, or None if it has none."""
    for kind in type(machine).__mro__:
        if kind in _LOOKS:
            return _LOOKS[kind](machine)
    return None


def names() -> list[str]:
    """Return the names of the machines that have looks."""
    return sorted(kind.__name__ for kind in _LOOKS)


def _bicycle(machine: systems.WhippleBicycle) -> Looks:
    size, tilt = float(machine.wheelbase), float(machine.tilt)
    foot = size + float(machine.trail)
    rear, front = float(machine.rear_radius), float(machine.front_radius)
    tube = 0.017 * size

    def on_axis(height):
        return np.array([foot - height * math.tan(tilt), 0.0, height])

    def bars(hub, color, radius, *pairs):
        """Return bars between points of the upright bicycle, relative to a hub."""
        return [rod(a - hub, b - hub, radius, color) for a, b in pairs]

    def at(x, y, z):
        return size * np.array([x, y, z])

    rear_hub, front_hub = np.array([0, 0, rear]), np.array([size, 0, front])
    crank, saddle = at(0.40, 0, 0.27), at(0.20, 0, 0.88)
    upper, lower = on_axis(0.86 * size), on_axis(0.72 * size)
    left, right = np.diag([1.0, 1.0, 1.0]), np.diag([1.0, -1.0, 1.0])
    frame_bars = bars(
        rear_hub,
        BLUE,
        tube,
        *((rear_hub, crank), (crank, saddle), (rear_hub, saddle - at(-0.02, 0, 0.1))),
        *((crank, lower), (saddle - at(-0.03, 0, 0.12), upper), (lower, upper)),
    )
    hip, shoulder, hand = at(0.20, 0.08, 0.95), at(0.46, 0.16, 1.40), at(0.74, 0.22, 1)
    knee, pedal = at(0.52, 0.10, 0.72), at(0.40, 0.09, 0.24)
    elbow = at(0.62, 0.24, 1.16)
    rider = [
        box(at(0.11, 0.05, 0.02), DARK, saddle - rear_hub),
        rod(
            (hip + right @ hip) / 2 - rear_hub,
            (shoulder + right @ shoulder) / 2 - rear_hub,
            0.13 * size,
            RED,
        ),
        ball(0.11 * size, PALE, at(0.55, 0, 1.64) - rear_hub),
    ]
    for side in (left, right):
        limbs = [side @ x for x in (hip, knee, pedal, shoulder, elbow, hand)]
        rider += bars(rear_hub, DARK, 0.06 * size, limbs[:2], limbs[1:3])
        rider += bars(rear_hub, PALE, 0.045 * size, limbs[3:5], limbs[4:6])
    crown, stem, grip = on_axis(2 * front + 0.06), on_axis(0.98 * size), at(0, 0.26, 0)
    aside = at(0, 0.05, 0)
    fork = bars(
        front_hub,
        GREY,
        tube,
        *((crown, stem), (stem - grip, stem + grip), (crown - aside, crown + aside)),
        *((crown + side, front_hub + side) for side in (aside, -aside)),
    )
    axis = jnp.array([math.sin(tilt), 0.0, -math.cos(tilt)])

    def poses(t, q, args):
        points = machine.points(t, q)
        # In the coordinates of the bicycle z points down. Here z points up, so that
        # rotations about y and z have the opposite sign.
        rotation = about("z", -q[2]) @ about("x", q[3]) @ about("y", -q[4])
        steered = rotation @ _about(axis.astype(q.dtype), q[5])
        return {
            "frame": (points["rear_hub"], rotation),
            "rear wheel": (points["rear_hub"], rotation @ about("y", -q[6])),
            "fork": (points["front_hub"], steered),
            "front wheel": (points["front_hub"], steered @ about("y", -q[7])),
        }

    return Looks(
        model(
            body("frame", *frame_bars, *rider),
            body("rear wheel", spoked_wheel(rear, 0.018 * size)),
            body("fork", *fork),
            body("front wheel", spoked_wheel(front, 0.018 * size)),
        ),
        poses,
        _trails(machine, "rear_contact", "front_contact"),
    )


def _two_wheeled_robot(machine: systems.TwoWheeledRobot) -> Looks:
    radius, track = float(machine.radius), float(machine.half_track)
    front = max(2 * float(machine.offset), radius)
    deck = 0.02 * track
    length = 0.6 * front + radius
    platform = body(
        "platform",
        box((length, 0.86 * track, 2 * deck), BLUE, (0.4 * front, 0, 0.4 * radius)),
        box((0.2 * length, 0.2 * track, 2 * deck), ORANGE, (front, 0, 0.5 * radius)),
        cylinder((0, -track, 0), (0, track, 0), 0.15 * radius),
        ball(0.4 * radius, GREY, (0.9 * front, 0, -0.6 * radius)),
    )

    def poses(t, q, args):
        points, heading = machine.points(t, q), about("z", q[2])
        return {
            "platform": (flat(q[:2], radius), heading),
            "right": (flat(points["right_wheel"], radius), heading @ about("y", q[3])),
            "left": (flat(points["left_wheel"], radius), heading @ about("y", q[4])),
        }

    wheels = (body(name, wheel(radius, 0.15 * radius)) for name in ("right", "left"))
    return Looks(
        model(platform, *wheels), poses, _trails(machine, "right_wheel", "left_wheel")
    )


def _car(machine: systems.CarWithTrailers) -> Looks:
    base = float(machine.wheelbase)
    radius, track = 0.12 * base, 0.28 * base
    # The rotation angles of the wheels are not coordinates of the car. Therefore the
    # wheels have no marks that would show their rotation.
    axle = "".join(
        cylinder((0, y - w, 0), (0, y + w, 0), radius, DARK)
        for y, w in ((track, 0.04 * base), (-track, 0.04 * base))
    )
    beam = cylinder((0, -track, 0), (0, track, 0), 0.02 * base)
    middle, long = 0.5 * base, 0.78 * base
    bodies = [
        body(
            "car",
            box((long, 0.31 * base, 0.10 * base), BLUE, (middle, 0, 0.11 * base)),
            box(
                (0.42 * base, 0.27 * base, 0.09 * base),
                PALE,
                (0.4 * base, 0, 0.3 * base),
            ),
            axle,
        ),
        body("front", axle, beam),
    ]
    lengths = np.broadcast_to(np.asarray(machine.trailer_length), machine.num_trailers)
    for i, length in enumerate(lengths.tolist()):
        half = 0.4 * min(length, base)
        bodies.append(
            body(
                f"trailer {i + 1}",
                box((half, 0.3 * base, 0.1 * base), ORANGE, (0, 0, 0.14 * base)),
                rod((0, 0, 0), (length, 0, 0), 0.02 * base),
                axle,
            )
        )

    def poses(t, q, args):
        points = machine.points(t, q)
        heading = about("z", q[2])
        placed = {
            "car": (flat(points["rear_axle"], radius), heading),
            "front": (flat(points["front_axle"], radius), about("z", q[2] + q[3])),
        }
        for i in range(machine.num_trailers):
            place = flat(points[f"axle_{i + 1}"], radius)
            placed[f"trailer {i + 1}"] = (place, about("z", q[4 + i]))
        return placed

    ends = ("rear_axle", f"axle_{machine.num_trailers}")
    return Looks(
        model(*bodies), poses, _trails(machine, *ends[: 1 + (machine.num_trailers > 0)])
    )


def _axle(track: float, radius: float) -> str:
    """Return an axle along y with two wheels, which have no marks."""
    width = 0.3 * radius
    ends = (
        cylinder((0, y - width, 0), (0, y + width, 0), radius, DARK)
        for y in (track, -track)
    )
    return cylinder((0, -track, 0), (0, track, 0), 0.25 * radius) + "".join(ends)


def _snakeboard(machine: systems.Snakeboard) -> Looks:
    half = float(machine.half_length)
    radius, deck = 0.16 * half, 0.30 * half
    board = body(
        "board",
        box((0.75 * half, 0.12 * half, 0.05 * half), BLUE, (0, 0, deck)),
        cylinder((half, 0, deck), (half, 0, 1.2 * deck), 0.3 * half, BLUE),
        cylinder((-half, 0, deck), (-half, 0, 1.2 * deck), 0.3 * half, BLUE),
    )
    rotor = body(
        "rotor",
        box((0.9 * half, 0.07 * half, 0.05 * half), ORANGE, (0, 0, 1.8 * deck)),
        ball(0.12 * half, ORANGE, (0.9 * half, 0, 1.8 * deck)),
        ball(0.12 * half, ORANGE, (-0.9 * half, 0, 1.8 * deck)),
        cylinder((0, 0, deck), (0, 0, 1.8 * deck), 0.06 * half),
    )
    axles = (body(x, _axle(0.4 * half, radius)) for x in ("rear", "front"))

    def poses(t, q, args):
        points = machine.points(t, q)
        return {
            "board": (flat(q[:2]), about("z", q[2])),
            "rotor": (flat(q[:2]), about("z", q[2] + q[3])),
            "rear": (flat(points["rear"], radius), about("z", q[2] + q[4])),
            "front": (flat(points["front"], radius), about("z", q[2] + q[5])),
        }

    return Looks(model(board, rotor, *axles), poses, _trails(machine, "centre"))


def _roller_racer(machine: systems.RollerRacer) -> Looks:
    seat, bar = np.asarray(machine.distances).tolist()
    size = seat + bar
    radius, deck = 0.07 * size, 0.05 * size
    bodies = (
        body(
            "seat",
            _axle(0.3 * size, radius),
            box((0.18 * size, 0.2 * size, 0.03 * size), BLUE, (0, 0, deck + radius)),
            rod((0, 0, deck), (seat, 0, deck), 0.035 * size, BLUE),
        ),
        body(
            "handlebar",
            _axle(0.22 * size, radius),
            rod((-bar, 0, deck), (0, 0, deck), 0.03 * size, ORANGE),
            rod((-bar, 0, deck), (-bar, 0, 5 * deck), 0.025 * size, ORANGE),
            rod(
                (-bar, -0.25 * size, 5 * deck),
                (-bar, 0.25 * size, 5 * deck),
                0.025 * size,
                ORANGE,
            ),
        ),
    )

    def poses(t, q, args):
        points = machine.points(t, q)
        return {
            "seat": (flat(points["seat"], radius), about("z", q[2])),
            "handlebar": (flat(points["handlebar"], radius), about("z", q[2] + q[3])),
        }

    return Looks(model(*bodies), poses, _trails(machine, "seat"))


def _skate(size: float, *others: str) -> str:
    """Return a blade along x on the ground, and the other shapes of its body."""
    blade = box((0.16 * size, 0.008 * size, 0.05 * size), GREY, (0, 0, 0.05 * size))
    return blade + "".join(others)


def _on_blade(name: str, text: str) -> Looks:
    """Return the looks of a body that moves in the plane, with q = (x, y, heading)."""

    def poses(t, q, args):
        return {name: (flat(q[:2]), about("z", q[2]))}

    return Looks(model(body(name, text)), poses, lambda t, q, args: flat(q[:2])[None])


def _sleigh(machine: systems.ChaplyginSleigh) -> Looks:
    offset = float(machine.offset)
    size = 2 * abs(offset) or 0.5
    plate = 0.14 * size
    return _on_blade(
        "sleigh",
        _skate(
            size,
            box((0.45 * size, 0.3 * size, 0.03 * size), BLUE, (offset, 0, plate)),
            cylinder((offset, 0, plate), (offset, 0, 1.5 * plate), 0.1 * size, ORANGE),
            *(
                ball(0.06 * size, DARK, (offset + 0.35 * size, y * size, 0.06 * size))
                for y in (0.25, -0.25)
            ),
        ),
    )


def _knife_edge(machine: systems.KnifeEdge) -> Looks:
    size = 0.6
    sole = box((0.16 * size, 0.05 * size, 0.02 * size), BLUE, (0, 0, 0.12 * size))
    toe = box((0.04 * size, 0.05 * size, 0.03 * size), ORANGE, (0.12 * size, 0, 0.1))
    return _on_blade("edge", _skate(size, sole, toe))


def _unicycle(machine: Any) -> Looks:
    radius = 0.15
    seat = 1.9 * radius
    looks = _on_blade(
        "unicycle",
        # The rotation angle of the wheel is not a coordinate. Therefore the wheel has
        # no mark that would show its rotation.
        frame(
            ring(0.92 * radius, 0.08 * radius, DARK),
            cylinder((0, -0.02, 0), (0, 0.02, 0), 0.85 * radius, GREY),
            pos=(0, 0, radius),
        )
        + rod((0, 0, radius), (0, 0, seat), 0.012, BLUE)
        + box((0.08, 0.03, 0.012), ORANGE, (0, 0, seat)),
    )
    post = cylinder((0, 0, 0), (0, 0, radius), 0.02, RED)
    return _with(looks, mjcf=looks.mjcf.replace("<worldbody>", f"<worldbody>{post}"))


def _rod_sleigh(machine: systems.RodSleigh) -> Looks:
    length, angle = float(machine.length), float(machine.angle)
    size, height = 0.8 * length, 0.12 * length
    masses = np.cbrt([float(machine.mass1), float(machine.mass2)])
    radii = (0.1 * length * masses / masses.max()).tolist()
    shapes = body(
        "sleigh",
        frame(_skate(size), turn=f"euler='0 0 {angle}'"),
        rod((0, 0, height), (length, 0, height), 0.03 * length, GREY),
        ball(radii[0], BLUE, (0, 0, height)),
        ball(radii[1], ORANGE, (length, 0, height)),
        ball(0.4 * height, DARK, (length, 0, 0.4 * height)),
    )

    def poses(t, q, args):
        direction = q[2:] - q[:2]
        heading = jnp.arctan2(direction[1], direction[0])
        return {"sleigh": (flat(q[:2]), about("z", heading))}

    def trails(t, q, args):
        return jnp.stack([flat(q[:2]), flat(q[2:])])

    return Looks(model(shapes), poses, trails)


def _rolling_disc(machine: Any) -> Looks:
    radius = float(machine.radius)

    def poses(t, q, args):
        if isinstance(q, tuple):
            (x, y, heading), (roll,) = q
        else:
            x, y, roll, heading = q
        place = flat(jnp.stack([x, y]), radius)
        return {"disc": (place, about("z", heading) @ about("y", roll))}

    def trails(t, q, args):
        place = q[0] if isinstance(q, tuple) else q
        return flat(place[:2])[None]

    return Looks(model(body("disc", wheel(radius, 0.05 * radius))), poses, trails)


def _rolling(machine: Any, *geoms: str, assets: str = "") -> Looks:
    """Return the looks of a rigid body with q = (quaternion, position)."""

    def poses(t, q, args):
        return {"body": (q[4:], SO3().matrix(q[:4]))}

    return Looks(
        model(body("body", *geoms), assets=assets),
        poses,
        lambda t, q, args: machine.contact_point(q)[None],
    )


def _rattleback(machine: systems.Rattleback) -> Looks:
    a, b, c = np.asarray(machine.semiaxes).tolist()
    depth = float(machine.depth)
    stone = frame(
        mesh("stone", BLUE),
        f"<geom type='ellipsoid' size='{0.99 * a} {0.99 * b} {0.06 * c}' "
        f"rgba='{PALE}'/>",
        box((0.35 * a, 0.05 * b, 0.08 * c), ORANGE, (0.45 * a, 0, 0)),
        cylinder((0.78 * a, 0, 0), (0.78 * a, 0, 0.08 * c), 0.18 * b, ORANGE),
        pos=(0, 0, depth),
    )
    looks = _rolling(machine, stone, assets=half_ellipsoid("stone", (a, b, c)))
    return _with(looks, elevation=-28.0)


def _torus(machine: systems.RollingTorus) -> Looks:
    radius, tube = float(machine.radius), float(machine.tube_radius)
    if tube == 0:
        return _rolling(
            machine, frame(wheel(radius, 0.012 * radius), turn=AXLE_ALONG_Z)
        )
    spokes = [
        rod(
            (0, 0, 0),
            (radius * math.cos(x), 0, radius * math.sin(x)),
            0.3 * tube,
            color,
        )
        for x, color in zip(
            np.arange(6) * math.pi / 3, (ORANGE, *(GREY,) * 5), strict=True
        )
    ]
    return _rolling(
        machine, frame(ring(radius, tube, BLUE, 48), *spokes, turn=AXLE_ALONG_Z)
    )


def _chaplygin_sphere(machine: systems.ChaplyginSphere) -> Looks:
    return _rolling(machine, banded_ball(float(machine.radius)))


def _chaplygin_top(machine: systems.ChaplyginTop) -> Looks:
    radius, offset = float(machine.radius), float(machine.offset)
    pole = cylinder(
        (0, 0, offset), (0, 0, offset + 1.01 * radius), 0.2 * radius, ORANGE
    )
    ball_here = frame(banded_ball(radius), pos=(0, 0, offset))
    return _rolling(machine, ball_here, pole)


def _ball_in_bowl(machine: systems.BallInBowl) -> Looks:
    radius, curvature = float(machine.radius), float(machine.curvature)
    start = float(np.linalg.norm(np.asarray(machine.q0[1])[:2]))
    reach = max(1.4 * start, 4 * radius)
    if machine.shape == "sphere" and curvature:
        reach = min(reach, 0.97 / curvature)
    # The centre of the ball moves on the surface z(r). The bowl is the parallel surface
    # at the distance `radius` below this surface.
    r = np.linspace(0, reach, 200)
    if machine.shape == "sphere" and curvature:
        z = (1 - np.sqrt(1 - (curvature * r) ** 2)) / curvature
        slope = curvature * r / np.sqrt(1 - (curvature * r) ** 2)
    else:
        z, slope = 0.5 * curvature * r**2, curvature * r
    scale = radius / np.sqrt(1 + slope**2)
    out, low = r + scale * slope, z - scale
    even = np.linspace(0, out[-1], 20)
    heights = np.interp(even, out, low)
    rim = [
        ball(
            0.25 * radius, color, (edge * math.cos(x), edge * math.sin(x), heights[-1])
        )
        for edge in (even[-1],)
        for x, color in zip(
            np.arange(8) * math.pi / 4, (ORANGE, *(GREY,) * 7), strict=True
        )
    ]
    shapes = model(
        body("ball", banded_ball(radius)),
        body("bowl", mesh("bowl", PALE), *rim),
        assets=bowl("bowl", heights.tolist(), float(even[-1])),
    )

    def poses(t, q, args):
        turn = about("z", machine.rate.astype(q[1].dtype) * t)
        return {
            "ball": (q[1], SO3().matrix(q[0])),
            "bowl": (jnp.zeros_like(q[1]), turn),
        }

    def trails(t, q, args):
        return machine.points(t, q)["contact"][None]

    return Looks(shapes, poses, trails, ground=None, elevation=-40.0)


def _turntable_ball(machine: systems.TurntableBall) -> Looks:
    radius = float(machine.radius)
    reach = 5 * radius
    spokes = (
        frame(
            box(
                (0.48 * reach, 0.03 * radius, 0.002 * radius),
                color,
                (0.5 * reach, 0, 0),
            ),
            turn=f"euler='0 0 {k * math.pi / 3}'",
        )
        for k, color in enumerate((ORANGE, *(GREY,) * 5))
    )
    table = cylinder((0, 0, -0.12 * radius), (0, 0, 0), reach, PALE)

    def poses(t, q, args):
        turn = about("z", machine.rate.astype(q[1].dtype) * t)
        return {
            "ball": (flat(q[1], radius), SO3().matrix(q[0])),
            "table": (jnp.zeros(3, q[1].dtype), turn),
        }

    return Looks(
        model(body("ball", banded_ball(radius)), body("table", table, *spokes)),
        poses,
        lambda t, q, args: flat(q[1])[None],
        ground=-0.12 * radius,
        elevation=-35.0,
    )


def _attitude(name: str, *geoms: str, **options: Any) -> Looks:
    """Return the looks of a body that turns about the origin; q is its attitude."""

    def poses(t, q, args):
        return {name: (jnp.zeros(3, q.dtype), SO3().matrix(q[:4]))}

    return Looks(model(body(name, *geoms)), poses, **options)


def _box_of(moments: Any) -> tuple[str, list[float]]:
    """Return a marked box for ratios of moments of inertia, and its half lengths."""
    own = np.asarray(moments, float)
    squares = np.maximum(own.sum() / 2 - own, 0.02 * own.sum())
    half = (0.4 * np.sqrt(squares / squares.max())).tolist()
    marks = "".join(
        cylinder((0, 0, 0), (np.eye(3)[k] * half[k] * 1.02).tolist(), 0.05, color)
        for k, color in enumerate((RED, ORANGE, PALE))
    )
    return box(half, BLUE) + marks, half


def _rigid_body(machine: systems.FreeRigidBody) -> Looks:
    return _attitude("body", _box_of(machine.moments)[0], ground=None)


def _suslov(machine: systems.Suslov) -> Looks:
    shape, half = _box_of(machine.moments)
    # The bar shows the axis about which the body cannot turn.
    needle = rod((0, 0, -1.5 * half[2]), (0, 0, 1.5 * half[2]), 0.015, GREY)
    return _attitude("body", shape, needle, ground=None)


def _veselova(machine: systems.Veselova) -> Looks:
    shape, half = _box_of(jnp.diagonal(machine.inertia))
    looks = _attitude("body", shape, ground=None)
    reach = 2 * max(half)
    axis = rod((0, 0, -reach), (0, 0, reach), 0.012, GREY)
    return _with(looks, mjcf=looks.mjcf.replace("<worldbody>", f"<worldbody>{axis}"))


def _heavy_top(machine: Any) -> Looks:
    centre = np.asarray(machine.centre, float)
    size = float(np.linalg.norm(centre)) or 1.0
    tip = (1.5 * centre).tolist()
    axis = centre / size
    top = (
        cylinder((0.92 * centre).tolist(), (1.08 * centre).tolist(), 0.6 * size, BLUE),
        rod((0, 0, 0), tip, 0.05 * size, GREY),
        frame(
            box((0.28 * size, 0.05 * size, 0.01 * size), ORANGE, (0.3 * size, 0, 0)),
            pos=(centre + 0.08 * size * axis).tolist(),
            turn="zaxis='{} {} {}'".format(*axis.tolist()),
        ),
    )
    looks = _attitude("top", *top, ground=-1.2 * size)
    post = cylinder((0, 0, -1.2 * size), (0, 0, -0.05 * size), 0.05 * size, DARK)

    def trails(t, q, args):
        return (SO3().matrix(q[:4]) @ jnp.asarray(tip, q.dtype))[None]

    return _with(
        looks,
        mjcf=looks.mjcf.replace("<worldbody>", f"<worldbody>{post}"),
        trails=trails,
    )


def _particle(machine: Any) -> Looks:
    size = 0.08 * (float(jnp.max(jnp.abs(machine.q0))) or 1.0)

    def poses(t, q, args):
        return {"particle": (q, jnp.eye(3, dtype=q.dtype))}

    return Looks(
        model(body("particle", ball(size, ORANGE))),
        poses,
        lambda t, q, args: q[None],
        ground=None,
    )


def _beads(machine: Any) -> Looks:
    """Show each coordinate as the position of a bead on its own bar along x."""
    count = int(machine.q0.shape[0])
    size = 0.5 * (float(jnp.max(jnp.abs(machine.q0))) or 1.0)
    apart = size * (np.arange(count) - 0.5 * (count - 1))

    def poses(t, q, args):
        turn = jnp.eye(3, dtype=q.dtype)
        places = [
            jnp.stack([x, y, 0 * x])
            for x, y in zip(q, jnp.asarray(apart, q.dtype), strict=True)
        ]
        return {f"bead {i}": (x, turn) for i, x in enumerate(places)}

    bars = [rod((-3 * size, y, 0), (3 * size, y, 0), 0.06 * size) for y in apart]
    beads = [
        body(f"bead {i}", ball(0.25 * size, ORANGE if i == 0 else BLUE))
        for i in range(count)
    ]
    return Looks(model(*beads, *bars), poses, ground=None, elevation=-35.0)


def _transmission(machine: systems.ContinuouslyVariableTransmission) -> Looks:
    """Show the driver as a pendulum, and the passenger on a blade the driver steers."""
    pivot, top, foot = np.array([[0, 1.5, 1.2], [0, 1.7, 1.2], [0, 1.7, 0]])

    def poses(t, q, args):
        x, y, z = q
        # The passenger moves along (1, -sin y) in the plane of the coordinates x and z.
        heading = -jnp.arctan(jnp.sin(y))
        return {
            "driver": (jnp.asarray(pivot, q.dtype), about("y", -y)),
            "passenger": (jnp.stack([x, z, 0 * x]), about("z", heading)),
        }

    return Looks(
        model(
            body(
                "driver",
                rod((0, 0, 0), (0, 0, -1), 0.03),
                ball(0.14, ORANGE, (0, 0, -1)),
            ),
            body(
                "passenger",
                box((0.3, 0.02, 0.1), GREY, (0, 0, 0.1)),
                ball(0.14, BLUE, (0, 0, 0.34)),
            ),
            rod(pivot, top, 0.05, DARK),
            rod(top, foot, 0.05, DARK),
        ),
        poses,
        lambda t, q, args: jnp.stack([q[0], q[2], 0 * q[0]])[None],
        azimuth=75.0,
        elevation=-25.0,
    )


def _linkage(
    points: Callable[..., Mapping[str, Array]],
    start: Array,
    rods: Iterable[tuple[str, str]],
    *,
    masses: Mapping[str, float] | None = None,
    boxes: Iterable[str] = (),
    fixed: Iterable[str] = (),
    trails: tuple[str, ...] = (),
    **options: Any,
) -> Looks:
    """Return the looks of bars between points, with balls and boxes at some points.

    Points with two coordinates are drawn in a vertical plane. `masses` maps the names
    of points to the radii of their balls, divided by the length of the longest bar;
    `boxes` are the names of sliders; `fixed` are the names of points at rest.
    """

    def in_space(t, q):
        return {
            name: upright(x) if x.shape == (2,) else x
            for name, x in points(t, q).items()
        }

    at = {name: np.asarray(x, float) for name, x in in_space(0.0, start).items()}
    pairs = list(rods)
    lengths = [float(np.linalg.norm(at[b] - at[a])) for a, b in pairs]
    size = max(lengths)
    colors = (BLUE, ORANGE, GREY, RED)
    parts = [
        body(f"{a} {b}", link(length, 0.035 * size, colors[k % 4]))
        for k, ((a, b), length) in enumerate(zip(pairs, lengths, strict=True))
    ]
    balls = {} if masses is None else masses
    parts += [body(x, ball(share * size, DARK)) for x, share in balls.items()]
    parts += [body(x, box((0.16 * size, 0.1 * size, 0.1 * size), DARK)) for x in boxes]
    still = [
        cylinder(
            (at[x] - [0, 0.08 * size, 0]).tolist(),
            (at[x] + [0, 0.08 * size, 0]).tolist(),
            0.06 * size,
            DARK,
        )
        for x in fixed
    ]

    def poses(t, q, args):
        here = in_space(t, q)
        placed: dict[str, Pose] = {
            f"{a} {b}": between(here[a], here[b]) for a, b in pairs
        }
        for name in (*balls, *boxes):
            placed[name] = (here[name], jnp.eye(3, dtype=here[name].dtype))
        return placed

    def paths(t, q, args):
        here = in_space(t, q)
        return jnp.stack([here[name] for name in trails])

    # The camera looks at the plane along its normal, slightly from above.
    given: dict[str, Any] = {"ground": None, "azimuth": 90.0, "elevation": -8.0}
    given |= options
    return Looks(model(*parts, *still), poses, paths if trails else None, **given)


def _four_bar(machine: systems.FourBar) -> Looks:
    bars = (("O", "A"), ("A", "B"), ("C", "B"))
    return _linkage(machine.points, machine.q0, bars, fixed="OC", trails=("B",))


def _slider_crank(machine: Any) -> Looks:
    options: dict[str, Any] = {"fixed": ("axle",)}
    if isinstance(machine, systems.SpatialSliderCrank):
        options = {"azimuth": 60.0, "elevation": -20.0}
    return _linkage(
        machine.points,
        machine.q0,
        (("axle", "pin"), ("pin", "slider")),
        boxes=("slider",),
        trails=("pin",),
        **options,
    )


def _pendulum_chain(machine: systems.PendulumChain) -> Looks:
    names = ["pivot", *(f"mass_{k + 1}" for k in range(machine.num_links))]
    return _linkage(
        machine.points,
        machine.q0,
        pairwise(names),
        masses=dict.fromkeys(names[1:], 0.1),
        fixed=("pivot",),
        trails=(names[-1],),
    )


def _double_pendulum(machine: systems.DoublePendulum) -> Looks:
    def points(t, q):
        return {"pivot": jnp.zeros_like(q[:2]), "first": q[:2], "second": q[2:]}

    return _linkage(
        points,
        machine.q0,
        (("pivot", "first"), ("first", "second")),
        masses={"first": 0.1, "second": 0.1},
        fixed=("pivot",),
        trails=("second",),
    )


def _spherical_pendulum(machine: systems.SphericalPendulum) -> Looks:
    def points(t, q):
        return {"pivot": jnp.zeros_like(q), "mass": q}

    return _linkage(
        points,
        machine.q0,
        (("pivot", "mass"),),
        masses={"mass": 0.1},
        fixed=("pivot",),
        trails=("mass",),
        elevation=-20.0,
    )


def _squeezer(machine: systems.AndrewsSqueezer) -> Looks:
    bars = ("O K1", "K1 P", "B P", "B D", "A K5", "K5 P", "A K7", "K7 P")
    pairs = [(a, b) for a, b in map(str.split, bars)]
    return _linkage(machine.points, machine.q0, pairs, fixed="OABC", trails=("P",))


def _governor(machine: systems.FlyballGovernor) -> Looks:
    pairs = []
    for k in "12":
        pairs += [(f"hinge_{k}", f"ball_{k}"), (f"middle_{k}", f"slider_{k}")]
    pairs += [("hinge_1", "hinge_2"), ("slider_1", "slider_2")]
    looks = _linkage(
        machine.points,
        machine.q0,
        pairs,
        masses={"ball_1": 0.12, "ball_2": 0.12},
        trails=("ball_1",),
        elevation=-15.0,
    )
    shaft = cylinder((0, 0, -0.2), (0, 0, 1.05 * float(machine.height)), 0.02, DARK)
    return _with(looks, mjcf=looks.mjcf.replace("<worldbody>", f"<worldbody>{shaft}"))


def _car_axis(machine: systems.CarAxis) -> Looks:
    length, rest = float(machine.length), float(machine.rest_length)
    tube = 0.03 * length
    # A spring is drawn as a piston in a cylinder, so that its length can change.
    parts = [body("axle", link(length, tube, BLUE))]
    for side in ("left", "right"):
        parts += [
            body(
                f"{side} piston", cylinder((0, 0, 0), (0, 0, 0.75 * rest), 0.6 * tube)
            ),
            body(
                f"{side} cylinder",
                cylinder((0, 0, 0), (0, 0, 0.5 * rest), 1.2 * tube, ORANGE),
            ),
            body(
                f"{side} wheel",
                cylinder((0, -tube, 0), (0, tube, 0), 0.12 * length, DARK),
            ),
        ]

    def poses(t, q, args):
        points = {name: upright(x) for name, x in machine.points(t, q).items()}
        placed = {"axle": between(points["left_end"], points["right_end"])}
        for side in ("left", "right"):
            foot, end = points[f"{side}_wheel"], points[f"{side}_end"]
            placed[f"{side} piston"] = (end, along(foot - end))
            placed[f"{side} cylinder"] = (foot, along(end - foot))
            placed[f"{side} wheel"] = (foot, jnp.eye(3, dtype=q.dtype))
        return placed

    def trails(t, q, args):
        points = machine.points(t, q)
        return jnp.stack([upright(points[f"{x}_end"]) for x in ("left", "right")])

    return Looks(
        model(*parts), poses, trails, ground=None, azimuth=90.0, elevation=-8.0
    )


def _trails(machine: Any, *names: str) -> Callable[..., Array]:
    """Return a `trails` function for named points; points (x, y) lie on the ground."""

    def trails(t, q, args):
        points = machine.points(t, q)
        places = (points[name] for name in names)
        return jnp.stack([flat(x) if x.shape == (2,) else x for x in places])

    return trails


def _about(axis: Array, angle: Array) -> Array:
    """Compute the matrix of the rotation by an angle about a unit vector."""
    half = 0.5 * angle
    return SO3().matrix(jnp.append(jnp.cos(half)[None], jnp.sin(half) * axis))


def _with(looks: Looks, **changes: Any) -> Looks:
    return replace(looks, **changes)


_LOOKS: dict[type, Callable[[Any], Looks]] = {
    systems.AndrewsSqueezer: _squeezer,
    systems.Appell: _particle,
    systems.BallInBowl: _ball_in_bowl,
    systems.CarAxis: _car_axis,
    systems.CarWithTrailers: _car,
    systems.ChaoticSystem: _beads,
    systems.ChaplyginSleigh: _sleigh,
    systems.ChaplyginSphere: _chaplygin_sphere,
    systems.ChaplyginTop: _chaplygin_top,
    systems.ContinuouslyVariableTransmission: _transmission,
    systems.DoublePendulum: _double_pendulum,
    systems.FlyballGovernor: _governor,
    systems.FourBar: _four_bar,
    systems.FreeRigidBody: _rigid_body,
    systems.HarmonicOscillator: _beads,
    systems.HeavyTop: _heavy_top,
    systems.HeavyTopSE3: _heavy_top,
    systems.KnifeEdge: _knife_edge,
    systems.NonholonomicParticle: _particle,
    systems.PendulumChain: _pendulum_chain,
    systems.Rattleback: _rattleback,
    systems.RodSleigh: _rod_sleigh,
    systems.RollerRacer: _roller_racer,
    systems.RollingDisc: _rolling_disc,
    systems.RollingTorus: _torus,
    systems.SliderCrank: _slider_crank,
    systems.Snakeboard: _snakeboard,
    systems.SpatialSliderCrank: _slider_crank,
    systems.SphericalPendulum: _spherical_pendulum,
    systems.Suslov: _suslov,
    systems.TurntableBall: _turntable_ball,
    systems.TwoWheeledRobot: _two_wheeled_robot,
    systems.Unicycle: _unicycle,
    systems.UnicycleInCoordinates: _unicycle,
    systems.Veselova: _veselova,
    systems.VerticalRollingDisc: _rolling_disc,
    systems.WhippleBicycle: _bicycle,
}
