"""The looks of a machine: shapes in MJCF, and the poses of the bodies they belong to.

The functions after the class `Looks` write the shapes and compute the poses of the
gallery's machines. In these functions, a wheel has its axle along the y axis of its
body, and a body that lies between two points has its z axis along the line between
them.
"""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._manifold import AbstractLieGroup


Numbers: TypeAlias = Sequence[float] | np.ndarray
Pose: TypeAlias = tuple[Float[Array, "3"], Float[Array, "3 3"]]


class Looks(eqx.Module):
    """The shapes of a machine, and a function that places them.

    `nhjax.render` and `nhjax.view` accept a `Looks` in place of a machine. The machines
    of `nhjax.systems` and the robots of `from_mujoco` do not need a `Looks`.

    - `mjcf`: the shapes, as the text of an MJCF model. Its bodies are children of
        `<worldbody>`, have names and have no joints. Geoms (shapes) that are direct
        children of `<worldbody>` do not move.
    - `poses`: a function of (t, q, args) that returns a dictionary from the names of
        the bodies to pairs: the position [m], of shape (3,), and the matrix of the
        rotation from the body to space, of shape (3, 3). z points upwards. `args` is
        always None.
    - `trails`: a function of (t, q, args) that returns points [m], of shape (k, 3),
        whose paths are drawn, such as the contacts of wheels; None draws no paths.
    - `ground`: the height of the ground [m]. With None the ground is just below all
        shapes.
    - `azimuth`, `elevation`: the default direction of the camera [degrees]. With
        azimuth 90 the camera looks along y, and with negative elevations it looks down.
    - `manifold`: the manifold of the configurations, for the interpolation between
        saved states. The default is R^n.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> ball = nhjax.Looks(
        ...     '''<mujoco><worldbody>
        ...     <body name="ball"><geom size="0.1" rgba="0.9 0.3 0.1 1"/></body>
        ...     </worldbody></mujoco>''',
        ...     lambda t, q, args: {"ball": (q, jnp.eye(3))}, ground=None)
    """

    mjcf: str = eqx.field(static=True)
    poses: Callable[..., dict[str, Any]]
    trails: Callable[..., Any] | None = None
    ground: float | None = eqx.field(default=0.0, static=True)
    azimuth: float = eqx.field(default=120.0, static=True)
    elevation: float = eqx.field(default=-20.0, static=True)
    manifold: AbstractLieGroup | None = None


BLUE = "0.16 0.42 0.68 1"
DARK = "0.13 0.13 0.15 1"
GREY = "0.62 0.64 0.67 1"
ORANGE = "0.98 0.58 0.10 1"
PALE = "0.90 0.88 0.82 1"
RED = "0.80 0.22 0.17 1"


def model(*parts: str, assets: str = "") -> str:
    """Return an MJCF model of bodies, and of geoms that do not move."""
    return (
        "<mujoco><compiler angle='radian'/>"
        f"<asset>{assets}</asset><worldbody>{''.join(parts)}</worldbody></mujoco>"
    )


def body(name: str, *geoms: str) -> str:
    """Return the MJCF element of a body with geoms."""
    return f"<body name='{name}'>{''.join(geoms)}</body>"


def frame(*geoms: str, pos: Numbers = (0, 0, 0), turn: str = "") -> str:
    """Return geoms in a frame; `turn` is its rotation, such as `euler='0 0 1'`."""
    return f"<frame pos='{_text(pos)}' {turn}>{''.join(geoms)}</frame>"


# The argument `turn` of `frame` that turns the axle of a wheel from y to z of its body.
AXLE_ALONG_Z = f"euler='{-math.pi / 2} 0 0'"


def ball(radius: float, color: str = BLUE, pos: Numbers = (0, 0, 0)) -> str:
    """Return a sphere."""
    return f"<geom type='sphere' size='{radius}' pos='{_text(pos)}' rgba='{color}'/>"


def banded_ball(radius: float, color: str = BLUE, band: str = PALE) -> str:
    """Return a sphere with three bands along great circles, which show its rolling."""
    half = f"{math.pi / 2}"
    turns = ("", f"euler='{half} 0 0'", f"euler='0 {half} 0'")
    size = f"{1.004 * radius} {0.07 * radius}"
    bands = (
        f"<geom type='cylinder' size='{size}' rgba='{band}' {turn}/>" for turn in turns
    )
    return ball(radius, color) + "".join(bands)


def box(size: Numbers, color: str = BLUE, pos: Numbers = (0, 0, 0)) -> str:
    """Return a box with the given half lengths."""
    return f"<geom type='box' size='{_text(size)}' pos='{_text(pos)}' rgba='{color}'/>"


def rod(start: Numbers, end: Numbers, radius: float, color: str = GREY) -> str:
    """Return a round bar with round ends."""
    return _between("capsule", start, end, radius, color)


def cylinder(start: Numbers, end: Numbers, radius: float, color: str = GREY) -> str:
    """Return a round bar with flat ends."""
    return _between("cylinder", start, end, radius, color)


def link(length: float, radius: float, color: str = GREY) -> str:
    """Return a round bar from the origin along z."""
    return rod((0, 0, 0), (0, 0, length), radius, color)


def ring(radius: float, tube: float, color: str = DARK, num: int = 40) -> str:
    """Return a torus with its axis along y, made of round bars."""
    angles = 2 * np.pi * np.arange(num + 1) / num
    rim = radius * np.stack([np.cos(angles), 0 * angles, np.sin(angles)], axis=1)
    return "".join(rod(a.tolist(), b.tolist(), tube, color) for a, b in pairwise(rim))


def spoked_wheel(radius: float, tyre: float, num: int = 12) -> str:
    """Return a thin wheel with its axle along y; two of its spokes are marked."""
    rim, spokes = radius - tyre, []
    for k, angle in enumerate(2 * np.pi * np.arange(num) / num):
        is_mark = k in (0, num // 2)
        end = ((rim * math.cos(angle)), 0.0, (rim * math.sin(angle)))
        thickness = (0.6 if is_mark else 0.22) * tyre
        spokes.append(rod((0, 0, 0), end, thickness, ORANGE if is_mark else GREY))
    width = 1.8 * tyre
    hub = cylinder((0, -width, 0), (0, width, 0), 1.6 * tyre, GREY)
    return ring(rim, tyre, DARK) + hub + "".join(spokes)


def wheel(radius: float, half_width: float) -> str:
    """Return a solid wheel with its axle along y, and a mark on both faces."""
    face, mark = 1.02 * half_width, 1.04 * half_width
    return (
        cylinder((0, -half_width, 0), (0, half_width, 0), radius, DARK)
        + cylinder((0, -face, 0), (0, face, 0), 0.7 * radius, GREY)
        + box((0.68 * radius, mark, 0.07 * radius), ORANGE)
        + box((0.07 * radius, 0.99 * mark, 0.68 * radius), ORANGE)
    )


def half_ellipsoid(name: str, semiaxes: Numbers) -> str:
    """Return the asset of the lower half of an ellipsoid, as a mesh."""
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    down = np.linspace(0, np.pi / 2, 13)[:-1]
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    rings = np.cos(down)[:, None, None] * circle
    depth = np.broadcast_to(-np.sin(down)[:, None, None], (*rings.shape[:2], 1))
    points = np.concatenate([rings, depth], axis=2).reshape(-1, 3)
    points = np.concatenate([points, [[0, 0, -1.0]]]) * np.asarray(semiaxes)
    return f"<mesh name='{name}' vertex='{_text(points.ravel())}'/>"


def bowl(name: str, heights: Numbers, radius: float) -> str:
    """Return the asset of a surface of revolution, as a mesh with two sides.

    `heights` are the heights of the surface at equally spaced distances from the axis,
    from 0 to `radius`.
    """
    num = 48
    turn = 2 * np.pi * np.arange(num) / num
    out = np.linspace(0, radius, len(heights))[1:]
    circles = out[:, None, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    lift = np.broadcast_to(np.asarray(heights)[1:, None, None], (*circles.shape[:2], 1))
    points = np.concatenate([circles, lift], axis=2).reshape(-1, 3)
    points = np.concatenate([points, [[0, 0, heights[0]]]])
    last, faces = len(points) - 1, []
    for k in range(num):
        following = (k + 1) % num
        faces.append((last, k, following))
        for i in range(len(out) - 1):
            a, b = i * num + k, i * num + following
            faces += [(a, a + num, b + num), (a, b + num, b)]
    inside = np.asarray(faces)
    # The other side of the surface has its own vertices, because its normals are
    # opposite.
    outside = inside[:, ::-1] + len(points)
    thick = points - [0, 0, 0.01 * radius]
    vertices = np.concatenate([points, thick])
    return (
        f"<mesh name='{name}' inertia='shell' vertex='{_text(vertices.ravel())}' "
        f"face='{_text(np.concatenate([inside, outside]).ravel())}'/>"
    )


def mesh(name: str, color: str) -> str:
    """Return a geom that shows a mesh."""
    return f"<geom type='mesh' mesh='{name}' rgba='{color}'/>"


def between(start: Array, end: Array) -> Pose:
    """Return the pose of a body at `start` whose z axis points to `end`."""
    return start, along(end - start)


def along(direction: Array) -> Float[Array, "3 3"]:
    """Return a rotation whose third axis has the given direction."""
    z = direction / jnp.sqrt(direction @ direction)
    # The coordinate axis with the largest angle to the direction is never parallel to
    # the direction.
    aside = jnp.eye(3, dtype=z.dtype)[jnp.argmin(jnp.abs(z))]
    x = jnp.cross(aside, z)
    x = x / jnp.sqrt(x @ x)
    return jnp.stack([x, jnp.cross(z, x), z], axis=1)


def about(axis: str, angle: Any) -> Float[Array, "3 3"]:
    """Return the rotation matrix for an angle about "x", "y" or "z"."""
    angle = jnp.asarray(angle)
    k = "xyz".index(axis)
    i, j = (k + 1) % 3, (k + 2) % 3
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    turn = jnp.zeros((3, 3), angle.dtype).at[k, k].set(1)
    return turn.at[i, i].set(cos).at[j, j].set(cos).at[i, j].set(-sin).at[j, i].set(sin)


def flat(point: Array, height: Any = 0.0) -> Float[Array, "3"]:
    """Return the point (x, y, height) in space for a point (x, y) of the plane."""
    return jnp.append(point, jnp.asarray(height, point.dtype))


def upright(point: Array) -> Float[Array, "3"]:
    """Return the point (x, 0, z) in space for a point (x, z) of a vertical plane."""
    return jnp.stack([point[0], jnp.zeros_like(point[0]), point[1]])


def _between(kind: str, start: Numbers, end: Numbers, radius: float, color: str) -> str:
    return (
        f"<geom type='{kind}' size='{radius}' fromto='{_text(start)} {_text(end)}' "
        f"rgba='{color}'/>"
    )


def _text(numbers: Any) -> str:
    return " ".join(f"{float(x):.9g}" if x % 1 else str(int(x)) for x in numbers)
