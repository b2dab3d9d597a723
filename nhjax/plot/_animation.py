"""Animations of machines, drawn from the points and outlines of their parts."""

from collections.abc import Mapping, Sequence
from typing import Any, TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ..diagnostics import real_array
from ._style import grey, new_axes, styled


if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes


@styled
def animate(
    ts: Float[np.ndarray, " times"],
    points: Mapping[str, Float[np.ndarray, "times ..."]],
    rods: Sequence[Sequence[str]] = (),
    *,
    wheels: Sequence[Sequence[str]] = (),
    traced: Sequence[str] = (),
    ground: float | None = None,
    follow: str | None = None,
    speed: float = 1.0,
    frame_rate: float = 25.0,
    ax: "Axes | None" = None,
) -> "FuncAnimation":
    """Animate a machine in the plane or in space, by default in real time.

    Positions are interpolated linearly between the saved times, so that the frame rate
    is constant for any step sizes. Save the animation with
    `animation.save("motion.gif")`, or with `animation.save("motion.mp4")` if FFmpeg is
    installed. The axes have equal units. For shapes with light and shadows, use
    `nhjax.render`.

    **Arguments:**

    - `ts`: the saved times of one trajectory.
    - `points`: a dictionary from names to saved positions. A point has shape (times, 2)
        or (times, 3). The outline of a body has shape (times, corners, 2) or (times,
        corners, 3), and is filled. The machines of `nhjax.systems` have a method
        `points`. To save its points during a run, use
        `SaveAt(fn=lambda t, y, args: machine.points(t, y.q))`. To compute the points
        from saved states, use `jax.vmap(machine.points)(sol.ts, sol.ys.q)`.
    - `rods`: chains of points that are connected by lines, each a tuple of names such
        as `("hub", "end")`.
    - `wheels`: for each wheel the names of its hub and of a point of its rim, and in
        space also of another point of its axle. Wheels are filled, with a line from the
        hub to the point of the rim. If this point is fixed in the wheel, the line shows
        how the wheel turns.
    - `traced`: the names of points whose past paths are drawn.
    - `ground`: the height of the ground in the picture. The default, None, draws no
        ground.
    - `follow`: the name of a point that stays in the centre of the picture. By default
        the picture does not move.
    - `speed`: the number of seconds of the motion in one second of the animation.
    - `frame_rate`: the number of frames per second.
    - `ax`: the axes to draw into; points in space need a 3d projection.

    **Returns:** an animation of matplotlib. Keep it in a variable until it is saved or
    shown, because matplotlib stops an animation that is garbage-collected.

    **Raises:** `ValueError` if shapes do not match, a name is not in `points`,
    positions are not finite, `ts` is not monotonic, or `speed` or `frame_rate` is not
    positive.

    !!! example

        >>> import nhjax
        >>> robot = nhjax.systems.TwoWheeledRobot()
        >>> sol = nhjax.integrate(robot.system, nhjax.LobattoIIIAB(2),
        ...     robot.initial_state(), dt=0.05, num_steps=20, saveat=nhjax.SaveAt(
        ...     t0=True, steps=True, fn=lambda t, y, args: robot.points(t, y.q)))
        >>> rods = [("left_wheel", "centre", "right_wheel")]
        >>> animation = nhjax.plot.animate(
        ...     sol.ts, sol.ys, rods, traced=["centre"], frame_rate=5)
        >>> page = animation.to_jshtml()
    """
    times = _times(ts)
    moving = _positions(points, times.size)
    for chain in rods:
        for name in chain:
            _check_point("rods", name, moving)
    for wheel in wheels:
        for name in wheel:
            _check_point("wheels", name, moving)
    for name in traced:
        _check_point("traced", name, moving)
    if follow is not None:
        _check_point("follow", follow, moving)
    if not (speed > 0 and frame_rate > 0):
        raise ValueError(
            "`speed` and `frame_rate` must be positive, got "
            f"{speed!r} and {frame_rate!r}."
        )

    from matplotlib.animation import FuncAnimation

    shown = _frame_times(times, speed / frame_rate)
    frames = {name: _at(shown, times, x) for name, x in moving.items()}
    spatial = next(iter(frames.values())).shape[-1] == 3
    if any(len(wheel) != 2 + spatial for wheel in wheels):
        raise ValueError(
            f"`wheels` must have {2 + spatial} names each: the hub, a point of the rim"
            f"{', and another point of the axle' if spatial else ''}, got {wheels!r}."
        )
    frames |= {_rim(wheel): _circle(frames, wheel) for wheel in wheels}
    ax = new_axes(ax, projection="3d" if spatial else None)
    centres, reach = _window(frames, follow)
    sides = [reach, reach]
    if spatial:
        sides.append(_height(frames, centres, reach, ground))
    bodies = [name for name, x in frames.items() if x.ndim == 3]
    dark = [_rim(wheel) for wheel in wheels]
    fills = [_filled(ax, grey(0.35 if x in dark else 0.8), spatial) for x in bodies]
    marks = [ax.plot(*_no_data(spatial), color="C1", linewidth=2.5)[0] for _ in wheels]
    floor = None if ground is None else _ground(ax, ground, reach, spatial)
    lines: list[Any] = [
        *(
            ax.plot(*_no_data(spatial), color=grey(0.25), linewidth=1.5)[0]
            for _ in bodies
        ),
        *(ax.plot(*_no_data(spatial), "o-", color=grey(0.1), ms=3)[0] for _ in rods),
        *(ax.plot(*_no_data(spatial), color="C0", lw=1)[0] for _ in traced),
    ]

    def show(frame: int) -> list[Any]:
        drawn = [frames[name][frame] for name in bodies]
        drawn += [np.array([frames[name][frame] for name in chain]) for chain in rods]
        drawn += [frames[name][: frame + 1] for name in traced]
        for line, path in zip(lines, drawn, strict=True):
            _draw(line, path, spatial)
        for mark, (hub, rim, *_) in zip(marks, wheels, strict=True):
            path = np.array([frames[hub][frame], frames[rim][frame]])
            _draw(mark, path, spatial)
        for fill, name in zip(fills, bodies, strict=True):
            corners = frames[name][frame]
            fill.set_verts([corners]) if spatial else fill.set_xy(corners)
        if floor is not None:
            floor(centres[frame])
        _set_limits(ax, centres[frame], sides)
        return [*lines, *marks, *fills]

    if spatial:
        ax.set_box_aspect(tuple(sides))  # pyright: ignore[reportArgumentType]
        # Without `computed_zorder`, lines and marks are in front of filled bodies.
        axes: Any = ax
        axes.computed_zorder = False
    else:
        ax.set_aspect("equal", adjustable="box")
    show(0)
    figure: Any = ax.figure
    interval = 1000 / frame_rate
    return FuncAnimation(figure, show, frames=len(shown), interval=interval)


def _times(ts: Any) -> np.ndarray:
    times = real_array("ts", ts)
    if times.ndim != 1 or times.size < 2:
        raise ValueError(
            "`ts` must be two or more times of one trajectory, got shape "
            f"{times.shape}. For a batch, select one member."
        )
    if not (np.all(np.diff(times) > 0) or np.all(np.diff(times) < 0)):
        raise ValueError("`ts` must increase or decrease monotonically.")
    return times


def _positions(points: Any, count: int) -> dict[str, np.ndarray]:
    if not isinstance(points, Mapping) or not points:
        raise TypeError(
            "`points` must be positions by name, for instance the result of the "
            f"method `points` of a machine, got {type(points).__name__}."
        )
    moving = {name: np.asarray(x, float) for name, x in points.items()}
    dimensions = {x.shape[-1] if x.ndim else 0 for x in moving.values()}
    if dimensions not in ({2}, {3}) or not all(
        x.ndim in (2, 3) and len(x) == count for x in moving.values()
    ):
        raise ValueError(
            f"`points` must be arrays of shape ({count}, 2), ({count}, corners, 2), or "
            "all with 3 in place of 2 for points in space, got shapes "
            f"{ {name: x.shape for name, x in moving.items()} }."
        )
    for name, x in moving.items():
        if not np.all(np.isfinite(x)):
            raise ValueError(
                f"`points[{name!r}]` has numbers that are not finite. If the run has "
                "failed, animate the part before the failure."
            )
    return moving


def _check_point(argument: str, name: Any, moving: dict[str, np.ndarray]) -> None:
    names = [name for name, x in moving.items() if x.ndim == 2]
    if name not in names:
        raise ValueError(
            f"`{argument}` must name points, which are {', '.join(names)}, "
            f"got {name!r}."
            + (" It is a list of chains: [('a', 'b')]." if argument == "rods" else "")
        )


def _frame_times(times: np.ndarray, spacing: float) -> np.ndarray:
    """Return the times of the frames, equally spaced from the first saved time on."""
    duration = abs(times[-1] - times[0])
    # The last frame is at most half the spacing of frames away from the last saved
    # time.
    shown = spacing * np.arange(round(duration / spacing) + 1)
    return times[0] + np.sign(times[-1] - times[0]) * np.minimum(shown, duration)


def _at(shown: np.ndarray, times: np.ndarray, positions: np.ndarray) -> np.ndarray:
    # `numpy.interp` needs increasing times, so that decreasing times are negated.
    forwards = 1 if times[-1] > times[0] else -1
    columns = positions.reshape(len(times), -1).T
    values = [np.interp(forwards * shown, forwards * times, x) for x in columns]
    return np.stack(values, axis=1).reshape(len(shown), *positions.shape[1:])


def _window(
    frames: dict[str, np.ndarray], follow: str | None
) -> tuple[np.ndarray, float]:
    """Compute the centre of the picture in each frame, and half the picture's width."""
    everything = np.concatenate(
        [x.reshape(len(x), -1, x.shape[-1]) for x in frames.values()], axis=1
    )
    if follow is None:
        low, high = (f(everything, axis=(0, 1)) for f in (np.min, np.max))
        centres = np.broadcast_to((low + high) / 2, (len(everything), low.size))
    else:
        centres = frames[follow]
    reach = np.max(np.abs(everything - centres[:, None]))
    # For a single point at rest the computed width is zero, and 1 is used instead.
    return centres, 1.05 * float(reach) or 1.0


def _height(
    frames: dict[str, np.ndarray],
    centres: np.ndarray,
    reach: float,
    ground: float | None,
) -> float:
    """Compute half a 3D picture's height: 0.5 to 1 times `reach`, half its width."""
    heights = [x[..., 2].reshape(len(x), -1) for x in frames.values()]
    if ground is not None:
        heights.append(np.full((len(centres), 1), ground))
    largest = np.max(np.abs(np.concatenate(heights, axis=1) - centres[:, 2:]))
    return float(np.clip(1.05 * largest, 0.5 * reach, reach))


def _set_limits(ax: "Axes", centre: np.ndarray, sides: Sequence[float]) -> None:
    for axis, middle, side in zip("xyz", centre, sides, strict=False):
        getattr(ax, f"set_{axis}lim")(middle - side, middle + side)


def _draw(line: Any, path: np.ndarray, spatial: bool) -> None:
    line.set_data(*path.T[:2])
    if spatial:
        line.set_3d_properties(path.T[2])


def _rim(wheel: Sequence[str]) -> str:
    return " ".join(wheel)


def _circle(frames: Mapping[str, np.ndarray], wheel: Sequence[str]) -> np.ndarray:
    """Compute the rim of a wheel, of shape (frames, corners, 2) or (.., 3)."""
    hub, rim, *rest = (frames[name] for name in wheel)
    spoke = rim - hub
    if rest:
        axle = rest[0] - hub
        axle = axle / np.linalg.norm(axle, axis=1, keepdims=True)
        across = np.cross(axle, spoke)
    else:
        across = np.stack([-spoke[:, 1], spoke[:, 0]], axis=1)
    angle = np.linspace(0, 2 * np.pi, 49)[:, None]
    return (
        hub[:, None] + np.cos(angle) * spoke[:, None] + np.sin(angle) * across[:, None]
    )


def _filled(ax: "Axes", color: str, spatial: bool) -> Any:
    """Add a polygon whose corners are set when a frame is shown."""
    if spatial:
        from mpl_toolkits.mplot3d.art3d import Poly3DCollection

        polygon = Poly3DCollection([np.zeros((3, 3))], facecolor=color, zorder=1.5)
        axes: Any = ax
        return axes.add_collection3d(polygon, autolim=False)
    from matplotlib.patches import Polygon

    return ax.add_patch(Polygon(np.zeros((3, 2)), facecolor=color, zorder=1.5))


def _ground(ax: "Axes", height: float, reach: float, spatial: bool) -> Any:
    """Add the ground; return a function that redraws it around the picture's centre.

    The grid lines keep their places in space while the picture moves.
    """
    if not spatial:
        ax.axhspan(height - 100 * reach, height, color=grey(0.88), zorder=0)
        ax.axhline(height, color=grey(0.5), linewidth=1, zorder=0.5)
        return lambda centre: None
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    axes: Any = ax
    grid = Line3DCollection(
        np.zeros((1, 2, 3)), colors=grey(0.75), linewidths=0.6, zorder=0
    )
    axes.add_collection3d(grid, autolim=False)
    cell = reach / 4

    def move(centre: np.ndarray) -> None:
        lines = []
        for axis in (0, 1):
            low, high = centre[axis] - reach, centre[axis] + reach
            places = cell * np.arange(np.ceil(low / cell), np.floor(high / cell) + 1)
            ends = np.empty((len(places), 2, 3))
            ends[:, :, axis] = places[:, None]
            ends[:, :, 1 - axis] = centre[1 - axis] + reach * np.array([-1, 1])
            ends[:, :, 2] = height
            lines.append(ends)
        grid.set_segments([*np.concatenate(lines)])

    return move


def _no_data(spatial: bool) -> list[list[float]]:
    return [[]] * (3 if spatial else 2)
