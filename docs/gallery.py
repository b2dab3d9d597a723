"""The gallery: a picture of each system, and the page that shows them.

`python docs/gallery.py` runs every system, draws docs/gallery/NAME.png and writes
docs/gallery.md. Names select the pictures to draw, and `--text` writes only the page.
The page takes text and formulas from the docstrings of the systems, and the code of
the models from their source. docs/machines.py lists the machines that have a method
`points`.
"""

import argparse
import ast
import dataclasses
import inspect
import io
import re
import textwrap
import unicodedata
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from PIL import Image

import nhjax
from docs import machines
from nhjax import systems


DOCS = Path(__file__).parent
PICTURES = DOCS / "gallery"
MODEL_LINES = 40


# --- Runs -----------------------------------------------------------------------------


class Run(NamedTuple):
    """A system and its motion, as arrays whose first axis is time."""

    example: Any
    ts: np.ndarray
    q: Any
    v: np.ndarray
    multiplier: np.ndarray

    def over_time(self, function: Callable[..., Any]) -> Any:
        """Compute a function of (t, q, v) at all times."""
        values = jax.jit(jax.vmap(function))(self.ts, self.q, self.v)
        return jax.tree.map(np.asarray, values)

    def points(self) -> dict[str, np.ndarray]:
        """Compute the points of a machine."""
        return self.over_time(lambda t, q, v: self.example.points(t, q))

    def invariants(self) -> dict[str, np.ndarray]:
        """Compute the conserved quantities."""
        return self.over_time(self.example.invariants)

    def drifts(self) -> dict[str, np.ndarray]:
        """Compute the changes of the conserved quantities since the start."""
        found = self.invariants()
        return {name.replace("_", " "): x - x[0] for name, x in found.items()}


def run(example: Any, duration: float, num_steps: int, stages: int = 4) -> Run:
    """Run a system from its initial data."""
    sol = nhjax.integrate(
        example.system,
        nhjax.LobattoIIIAB(stages),
        example.initial_state(),
        dt=duration / num_steps,
        num_steps=num_steps,
        saveat=nhjax.SaveAt(t0=True, steps=True),
    )
    ts, y = jax.tree.map(np.asarray, (sol.ts, sol.ys))
    return Run(example, ts, y.q, y.v, y.multiplier)


# --- How a picture is drawn -----------------------------------------------------------


class Curve(NamedTuple):
    """A curve over time in the lower panel; a dashed curve is for comparison."""

    label: str
    values: np.ndarray
    dashed: bool = False
    right: bool = False


Lines = list[np.ndarray]


class Picture(NamedTuple):
    """The picture of a system: an upper panel with paths, a lower panel with curves.

    - `paths(run)`: the lines in the upper panel, each of shape (times, 2) or
        (times, 3); `axes` are the names of these coordinates.
    - `outline(run, k)`: the lines that show the body at the step k; `shown` is the
        number of steps at which they are drawn.
    - `curves(run)`: the curves of the lower panel; `units` is the label of its left
        axis, and `right_units` the label of its right axis, if it has one.
    - `above`, `below`: captions that say what the two panels show.
    """

    example: Any
    duration: float
    num_steps: int
    paths: Callable[[Run], Lines]
    above: str
    curves: Callable[[Run], list[Curve]]
    units: str
    below: str
    outline: Callable[[Run, int], Lines] | None = None
    shown: int = machines.TIMES_SHOWN
    axes: tuple[str, ...] = ("x", "y", "z")
    ground: bool = False
    downhill: bool = False
    log: bool = False
    right_units: str | None = None
    film: str | None = None

    @property
    def name(self) -> str:
        """The name of the system's class."""
        return type(self.example).__name__


def _entries(*indices: int) -> Callable[[Run], Lines]:
    return lambda run: [run.q[:, list(indices)]]


def _velocities(*indices: int, labels: tuple[str, ...]) -> Callable[[Run], list[Curve]]:
    return lambda run: [
        Curve(label, run.v[:, i]) for label, i in zip(labels, indices, strict=True)
    ]


def _multipliers(*labels: str) -> Callable[[Run], list[Curve]]:
    return lambda run: [
        Curve(label, run.multiplier[:, i]) for i, label in enumerate(labels)
    ]


def _drifts(*names: str) -> Callable[[Run], list[Curve]]:
    def curves(run: Run) -> list[Curve]:
        found = run.drifts()
        return [Curve(name, found[name]) for name in names or found]

    return curves


def _bar(place: np.ndarray, angle: float, back: float, ahead: float) -> np.ndarray:
    """A line at an angle, from `back` behind a point in the plane to `ahead` of it."""
    along = np.array([np.cos(angle), np.sin(angle)])
    return place + np.outer([-back, ahead], along)


def _headed(
    length: float, column: int = 2, back: float | None = None
) -> Callable[[Run, int], Lines]:
    """A bar along the heading, such as a blade seen from above."""

    def outline(run: Run, k: int) -> Lines:
        behind = length if back is None else back
        return [_bar(run.q[k, :2], run.q[k, column], behind, length)]

    return outline


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    return np.asarray(nhjax.SO3().matrix(jnp.asarray(quaternion)))


def _third_axis(run: Run) -> Lines:
    """The path of the tip of the third axis of the body in space."""
    return [run.over_time(lambda t, q, v: nhjax.SO3().matrix(q[:4])[:, 2])]


def _axis_from_origin(run: Run, k: int) -> Lines:
    tip = _rotation(run.q[k][:4])[:, 2]
    return [np.array([np.zeros(3), tip])]


ANGLES = np.linspace(0, 2 * np.pi, 49)
ROUND = np.stack([np.cos(ANGLES), np.sin(ANGLES), np.zeros_like(ANGLES)], axis=1)


def _great_circles(radius: float, middle: tuple[float, ...] = (0, 0, 0)) -> Lines:
    return [radius * np.roll(ROUND, k, axis=1) + np.array(middle) for k in range(3)]


def _ellipsoid(example: Any) -> Lines:
    """The lower half of a rattleback, in body axes."""
    a, b, c = np.asarray(example.semiaxes)
    middle = np.array([0, 0, float(example.depth)])
    half = -np.abs(np.sin(ANGLES[:25]))
    cos, zero = np.cos(ANGLES[:25]), np.zeros(25)
    return [
        ROUND * (a, b, 0) + middle,
        np.stack([a * cos, zero, c * half], axis=1) + middle,
        np.stack([zero, b * cos, c * half], axis=1) + middle,
    ]


def _body(curves: Callable[[Any], Lines]) -> Callable[[Run, int], Lines]:
    """Draw curves that are fixed in a body on SE(3), SO(3) x R³ or SO(3) x R²."""

    def outline(run: Run, k: int) -> Lines:
        if isinstance(run.q, tuple):
            quaternion, place = run.q[0][k], run.q[1][k]
        else:
            quaternion, place = run.q[k, :4], run.q[k, 4:]
        if place.shape == (2,):
            place = np.append(place, float(run.example.radius))
        turn = _rotation(quaternion)
        return [curve @ turn.T + place for curve in curves(run.example)]

    return outline


def _contacts(run: Run) -> Lines:
    return [run.points()["contact"]]


def _sphere(example: Any) -> Lines:
    return _great_circles(float(example.radius))


def _ball_and_bowl(run_: Run, k: int) -> Lines:
    """The ball, and at the start the bowl: two sections and the rim."""
    ball = _body(_sphere)(run_, k)
    if k:
        return ball
    bowl, across = run_.example.bowl, np.linspace(-0.8, 0.8, 41)
    places = np.stack([across, 0 * across, bowl.height(across**2)], axis=1)
    normals = np.asarray(jax.vmap(bowl.normal)(places))
    section = places - float(run_.example.radius) * normals
    rim = ROUND * (section[-1, 0], section[-1, 0], 0) + (0, 0, section[-1, 2])
    return [*ball, section, section[:, [1, 0, 2]], rim]


# Colours of Okabe and Ito, which the colour-blind can tell apart.
BLUE, RED, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"


def style() -> dict[Any, Any]:
    """The settings of matplotlib for all pictures of the gallery."""
    return {
        "axes.grid": True,
        "axes.labelsize": 8,
        "axes.linewidth": 0.6,
        "axes.prop_cycle": cycler(color=[BLUE, RED, GREEN, PURPLE]),
        "axes.spines.right": False,
        "axes.spines.top": False,
        "axes.titlesize": 8,
        "font.size": 8,
        "grid.color": "0.9",
        "grid.linewidth": 0.5,
        "legend.fontsize": 7,
        "legend.frameon": False,
        "legend.handlelength": 1.4,
        "lines.linewidth": 1.0,
        "lines.markersize": 3,
        "savefig.dpi": 150,
        "xtick.labelsize": 7,
        "xtick.major.width": 0.6,
        "ytick.labelsize": 7,
        "ytick.major.width": 0.6,
    }


def draw(picture: Picture) -> Figure:
    """Run a system and draw its picture."""
    done = run(picture.example, picture.duration, picture.num_steps)
    with matplotlib.rc_context(style()):
        figure = Figure(figsize=(3.6, 4.7), layout="constrained")
        parts: Any = figure.subfigures(2, 1, height_ratios=(3, 2))
        above, below = parts
        _draw_paths(above, picture, done)
        _draw_curves(below.add_subplot(), picture, done)
        figure.canvas.draw()
    return figure


def _draw_paths(figure: Any, picture: Picture, done: Run) -> None:
    paths = picture.paths(done)
    spatial = paths[0].shape[1] == 3
    ax = figure.add_subplot(projection="3d" if spatial else None)
    for path in paths:
        ax.plot(*path.T, color=BLUE)
        ax.plot(*path[:1].T, "o", color="black")
    everything = [np.concatenate(paths)]
    if picture.outline is not None:
        steps = np.linspace(0, picture.num_steps, picture.shown).astype(int)
        shades = np.linspace(0.7, 0.0, picture.shown)
        for k, shade in zip(steps, shades, strict=True):
            for line in picture.outline(done, k):
                ax.plot(*line.T, color=str(shade), linewidth=0.8)
                everything.append(line)
    letters = "xyz"[: paths[0].shape[1]]
    for letter, name in zip(letters, picture.axes, strict=False):
        getattr(ax, f"set_{letter}label")(name)
    if spatial:
        _set_space(ax, np.concatenate(everything), picture.ground)
    else:
        ax.set_aspect("equal", adjustable="datalim")
    if picture.downhill:
        ax.invert_yaxis()


def _set_space(ax: Any, points: np.ndarray, ground: bool) -> None:
    """Give the three axes equal units, and draw the ground."""
    low, high = points.min(axis=0), points.max(axis=0)
    margin = 0.04 * np.max(high - low)
    low, high = low - margin, high + margin
    # No side is drawn much shorter than the others.
    short = np.maximum(0.4 * np.max(high - low) - (high - low), 0)
    low, high = low - 0.5 * short, high + 0.5 * short
    if ground:
        low[2], high[2] = 0.0, high[2] - low[2] if low[2] > 0 else high[2]
        (x0, y0, _), (x1, y1, _) = low, high
        plane = [(x0, y0, 0), (x1, y0, 0), (x1, y1, 0), (x0, y1, 0)]
        ax.add_collection3d(Poly3DCollection([plane], facecolor="0.8", alpha=0.4))
    for letter, *limits in zip("xyz", low, high, strict=True):
        getattr(ax, f"set_{letter}lim")(*limits)
        axis = getattr(ax, f"{letter}axis")
        is_long = limits[1] - limits[0] > 0.5 * np.max(high - low)
        axis.set_major_locator(MaxNLocator(3 if is_long else 2))
        axis.pane.set_visible(False)
    # matplotlib draws the third axis at the right corner. Its name is at its upper end.
    ax.text(high[0], high[1], high[2], f" {ax.get_zlabel()}", va="bottom")
    ax.set_zlabel("")
    # Without this zoom, a long box would be drawn too small, and a high box too large.
    size = high - low
    zoom = 0.87 if size[2] == np.max(size) else 1.05
    stretch = max(np.max(size) / np.linalg.norm(size) - 0.7, 0)
    ax.set_box_aspect(size, zoom=zoom + 0.4 * stretch)
    ax.tick_params(pad=-2)
    ax.tick_params(axis="z", pad=1)
    for letter in "xy":
        getattr(ax, f"{letter}axis").labelpad = -4


def _draw_curves(ax: Axes, picture: Picture, done: Run) -> None:
    curves = picture.curves(done)
    right = ax.twinx() if picture.right_units else None
    colours = iter((BLUE, RED, GREEN, PURPLE))
    drawn = []
    for curve in curves:
        look: dict[str, Any] = {
            "linestyle": "--" if curve.dashed else "-",
            "color": next(colours),
        }
        if len(curve.values) < 40:
            look["marker"] = "o"
        on = right if curve.right and right else ax
        ts = np.linspace(done.ts[0], done.ts[-1], len(curve.values))
        drawn += on.plot(ts, curve.values, label=curve.label, **look)
    dimensionless = "dimensionless" in (type(picture.example).__doc__ or "")
    ax.set_xlabel("t" if dimensionless else "t [s]")
    ax.set_ylabel(picture.units)
    if picture.log:
        ax.set_yscale("log")
    if right is not None:
        right.set_ylabel(picture.right_units or "")
        right.spines["right"].set_visible(True)
        right.grid(False)
    if len(drawn) > 1:
        ax.legend(
            handles=drawn,
            loc="lower center",
            bbox_to_anchor=(0.5, 1.0),
            ncols=min(len(drawn), 4),
            borderaxespad=0.2,
            columnspacing=1.0,
        )


def save(figure: Figure, name: str) -> None:
    """Write a picture with 64 colours, which are enough for lines and letters."""
    file = io.BytesIO()
    figure.savefig(file, dpi=style()["savefig.dpi"])
    image = Image.open(file).convert("RGB").quantize(64, dither=Image.Dither.NONE)
    PICTURES.mkdir(exist_ok=True)
    image.save(PICTURES / f"{name}.png", optimize=True)


# --- The pictures ---------------------------------------------------------------------


def _distance_to_neighbour(index: int) -> Callable[[Run], list[Curve]]:
    """The distance to a run whose start differs by 1e-8 in one coordinate."""

    def curves(run_: Run) -> list[Curve]:
        q0 = run_.example.q0.at[index].add(1e-8)
        other = dataclasses.replace(run_.example, q0=q0)
        again = run(other, float(run_.ts[-1]), len(run_.ts) - 1)
        distance = np.linalg.norm(again.q - run_.q, axis=1)
        return [Curve("", distance[1:])]

    return curves


def _distance_of_pendula(run_: Run) -> list[Curve]:
    other = systems.DoublePendulum.swinging((2.0 + 1e-8, 2.5))
    again = run(other, float(run_.ts[-1]), len(run_.ts) - 1)
    return [Curve("", np.linalg.norm(again.q - run_.q, axis=1))]


def _errors(run_: Run) -> np.ndarray:
    """The distance of (x, y) from the exact solution."""
    exact = np.array([run_.example.exact(float(t))[0][:2] for t in run_.ts])
    return np.linalg.norm(run_.q[:, :2] - exact, axis=1)


def _knife_edge(run_: Run) -> list[Curve]:
    edge = run_.example
    mean = 0.5 * float(edge.gravity) / run_.v[:, 2] * run_.ts
    return [
        Curve("x, down the slope", run_.q[:, 0]),
        Curve("y, across", run_.q[:, 1]),
        Curve("G t / 2θ̇", run_.q[0, 1] + mean, dashed=True),
    ]


def _along(run_: Run, heading: int = 2) -> np.ndarray:
    """The speed along the heading."""
    angle = run_.q[:, heading]
    return run_.v[:, 0] * np.cos(angle) + run_.v[:, 1] * np.sin(angle)


def _speed_and_turning(run_: Run) -> list[Curve]:
    return [Curve("u [m/s]", _along(run_)), Curve("θ̇ [rad/s]", run_.v[:, 2])]


def _unicycle_forms(run_: Run) -> list[Curve]:
    group = run_.example.on_group()
    on_group = run(group, float(run_.ts[-1]), len(run_.ts) - 1)
    return [
        Curve("in coordinates", _errors(run_)[1:]),
        Curve("on SE(2)", _errors(on_group)[1:]),
    ]


def _unicycle_energies(run_: Run) -> list[Curve]:
    spring = 0.5 * float(run_.example.spring) * np.sum(run_.q[:, :2] ** 2, axis=1)
    total = run_.invariants()["energy"]
    return [
        Curve("kinetic", total - spring),
        Curve("of the spring", spring),
        Curve("total", total),
    ]


def _fall(run_: Run) -> list[Curve]:
    body = run_.example
    free = run_.v[0, 2] - float(body.gravity) * run_.ts
    return [Curve("Appell", run_.v[:, 2]), Curve("free fall", free, dashed=True)]


def _two_stages(run_: Run) -> list[Curve]:
    """The energy with two stages; this run returns to its start after 12 steps."""
    number = 12
    size = 2 * np.sin(np.pi / number)
    coarse = run(run_.example, 2 * number * size, 2 * number, stages=2)
    return [
        Curve("4 stages", run_.drifts()["energy"]),
        Curve("2 stages, 12 steps a turn", coarse.drifts()["energy"]),
    ]


def _exact_height(run_: Run) -> list[Curve]:
    exact = [run_.example.exact(float(t))[0][2] for t in run_.ts]
    return [
        Curve("z", run_.q[:, 2]),
        Curve("elliptic function", np.array(exact), dashed=True),
    ]


def _precession(run_: Run) -> list[Curve]:
    (axis,) = _third_axis(run_)
    azimuth = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0]))
    return [
        Curve("tilt", np.degrees(np.arccos(axis[:, 2]))),
        Curve("azimuth", np.degrees(azimuth - azimuth[0]), right=True),
    ]


def _horizontal_momentum(run_: Run) -> list[Curve]:
    light = dataclasses.replace(run_.example, weight=(0.0, 0.0, 0.0))
    light_run = run(light, float(run_.ts[-1]), len(run_.ts) - 1)

    def size(of: Run) -> np.ndarray:
        momentum = of.over_time(lambda t, q, v: light.horizontal_momentum(q, v))
        return np.linalg.norm(momentum, axis=1)

    return [Curve("with weight", size(run_)), Curve("without", size(light_run))]


def _moving_energy(run_: Run) -> list[Curve]:
    energy = run_.over_time(run_.example.energy)
    moving = run_.invariants()["moving_energy"]
    return [Curve("energy", energy), Curve("moving energy", moving)]


def _lean_and_steer(run_: Run) -> list[Curve]:
    return [
        Curve("lean φ", np.degrees(run_.q[:, 3])),
        Curve("steer δ", np.degrees(run_.q[:, 5])),
    ]


def _hitch_angles(run_: Run) -> list[Curve]:
    q = run_.q
    return [
        Curve("steer δ", np.degrees(q[:, 3])),
        Curve("θ₀ - θ₁", np.degrees(q[:, 2] - q[:, 4])),
        Curve("θ₁ - θ₂", np.degrees(q[:, 4] - q[:, 5])),
    ]


def _driven(joint: int, label: str) -> Callable[[Run], list[Curve]]:
    return lambda run_: [
        Curve("speed", _along(run_)),
        Curve(label, run_.q[:, joint], right=True),
    ]


def _momentum_of_sphere(run_: Run) -> list[Curve]:
    found = run_.invariants()
    momentum = [found[f"contact_momentum_{x}"] for x in "xyz"]
    size = np.linalg.norm(momentum, axis=0)
    turning = [Curve(f"ω{i}", run_.v[:, 3 + k]) for k, i in enumerate("₁₂₃")]
    return [*turning, Curve("|K|", size, dashed=True)]


def _routh(run_: Run) -> list[Curve]:
    def integrals(t: Any, q: Any, v: Any) -> Any:
        jellett, routh = run_.example.integrals_of_routh(q, v)
        return {
            "Jellett": jellett,
            "Routh": routh,
            "energy": run_.example.energy(t, q, v),
        }

    found = run_.over_time(integrals)
    return [Curve(name, x / x[0] - 1) for name, x in found.items()]


def _disc(run_: Run) -> list[Curve]:
    (axle,) = _third_axis(run_)
    tilt = np.degrees(np.arccos(axle[:, 2]))
    return [Curve("tilt of the axle", tilt), Curve("ω₃", run_.v[:, 5], right=True)]


def _energies(run_: Run) -> list[Curve]:
    chain = run_.example
    total = run_.invariants()["energy"]
    weights = np.asarray(chain.masses) * float(chain.gravity)
    potential = run_.q[:, 1::2] @ weights
    low = potential.min()
    return [
        Curve("kinetic", total - potential),
        Curve("potential", potential - low),
        Curve("sum", total - low),
    ]


def _heights(run_: Run) -> list[Curve]:
    points = run_.points()
    return [
        Curve("left end", points["left_end"][:, 1]),
        Curve("right end", points["right_end"][:, 1]),
        Curve("road", points["right_wheel"][:, 1], dashed=True),
    ]


def _governor(run_: Run) -> list[Curve]:
    return [
        Curve("height of the slider", run_.q[:, 3]),
        Curve("rate of the shaft", run_.v[:, 0], right=True),
    ]


def _machine(name: str, **changes: Any) -> Picture:
    """The picture of a machine, with the run and the points of docs/machines.py."""
    (machine,) = (m for m in machines.machines() if m.name == name)

    def paths(run_: Run) -> Lines:
        points = run_.points()
        return [points[name] for name in machine.traced]

    def outline(run_: Run, k: int) -> Lines:
        at = Run(run_.example, *(x[k : k + 1] for x in run_[1:]))
        points = at.points()
        lines = [np.array([points[name][0] for name in machine.rods])]
        return lines + [machines.circle(points, wheel)[0] for wheel in machine.wheels]

    # Names that end in a single letter or digit get no article.
    names = [x.replace("_", " ") for x in machine.traced]
    names = [x if re.search(r"\b[A-Z0-9]$", x) else f"the {x}" for x in names]
    traced = f"path{'s' * (len(names) > 1)} of {' and '.join(names)}"
    given: dict[str, Any] = {
        "example": machine.example,
        "duration": machine.duration,
        "num_steps": machine.num_steps,
        "paths": paths,
        "outline": outline,
        "above": f"the machine at some times, and the {traced}",
    }
    return Picture(**(given | changes))


def _papers_experiments() -> list[Picture]:
    s = systems
    return [
        Picture(
            s.NonholonomicParticle(),
            *(40, 800),
            _entries(0, 1, 2),
            "the path of the particle around the z axis",
            _drifts("driver energy", "passenger energy"),
            "change [J]",
            "the energies of driver and passenger oscillate by the error of the "
            "method, and do not drift",
        ),
        Picture(
            s.ContinuouslyVariableTransmission.low(0.5),
            *(100, 2000),
            _entries(0, 2),
            "the path of the passenger, for ε = ½",
            _drifts("driver energy", "passenger energy"),
            "change",
            "both energies oscillate by the error of the method, and do not drift",
            axes=("x", "z"),
        ),
        Picture(
            s.ChaoticSystem(),
            *(100, 2000),
            _entries(0, 1),
            "the first two coordinates",
            _distance_to_neighbour(1),
            "distance",
            "a second motion starts 1e-8 away; the distance between the two motions "
            "grows exponentially, as is typical of chaos",
            axes=("q₁", "q₂"),
            log=True,
        ),
        Picture(
            s.Unicycle(),
            *(60, 1200),
            _entries(0, 1),
            "the path of the contact",
            _unicycle_energies,
            "energy [J]",
            "kinetic energy and energy of the spring change; their sum is constant",
            _headed(0.12),
            12,
        ),
        Picture(
            s.UnicycleInCoordinates(),
            *(60, 1200),
            _entries(0, 1),
            "the path of the contact",
            _unicycle_forms,
            "error of (x, y) [m]",
            "with the same steps, the errors of both forms have the same size, but are "
            "not equal",
            _headed(0.12),
            12,
            log=True,
        ),
        Picture(
            s.TurntableBall(),
            *(30, 900),
            lambda run_: [np.pad(run_.q[1], ((0, 0), (0, 1)))],
            "three great circles of the ball at two times, and the path of the "
            "contact, which is a circle",
            _moving_energy,
            "energy per mass [J/kg]",
            "the table does work on the ball, but the moving energy is constant",
            _body(_sphere),
            2,
            ground=True,
        ),
    ]


def _textbook_systems() -> list[Picture]:
    s = systems
    return [
        Picture(
            s.KnifeEdge(),
            *(20, 800),
            _entries(1, 0),
            "the slope, with the path of the edge and the edge at some times",
            _knife_edge,
            "position [m]",
            "the edge does not slide down the slope, but drifts across the slope at "
            "the mean speed G/(2θ̇)",
            lambda run_, k: [line[:, ::-1] for line in _headed(0.3)(run_, k)],
            21,
            axes=("y, across the slope [m]", "x, downhill [m]"),
            downhill=True,
        ),
        Picture(
            s.ChaplyginSleigh(),
            *(7, 350),
            _entries(0, 1),
            "the path of the blade, and the line from the blade to the centre of mass",
            _speed_and_turning,
            "u, θ̇",
            "the sleigh slides backwards at first; then it turns around and tends to "
            "straight motion, although energy is conserved",
            _headed(0.3, back=0.0),
            13,
        ),
        Picture(
            s.RodSleigh(),
            *(12, 600),
            _entries(0, 1),
            "the path of the blade, and the rod at some times",
            _multipliers("blade λ", "rod ν"),
            "multipliers [N, N/m]",
            "the reactions of blade and rod decay as the motion becomes straight",
            lambda run_, k: [run_.q[k].reshape(2, 2)],
            13,
        ),
        Picture(
            s.VerticalRollingDisc(),
            *(8, 200),
            _entries(0, 1),
            "the disc from above at some times, and the circle on which it touches the "
            "ground",
            _multipliers("λ in x", "λ in y"),
            "force of the ground [N]",
            "the centripetal force turns with the heading",
            _headed(0.5, column=3),
            9,
        ),
        Picture(
            s.RollingDisc(),
            *(8, 200),
            lambda run_: [run_.q[0][:, :2]],
            "the disc from above at some times, and the circle on which it touches the "
            "ground",
            _multipliers("λ along the heading", "λ to the left"),
            "force of the ground [N]",
            "the components of the centripetal force along the axes of the body are "
            "constant",
            lambda run_, k: [_bar(run_.q[0][k, :2], run_.q[0][k, 2], 0.5, 0.5)],
            9,
        ),
        Picture(
            s.Appell(),
            *(2, 50),
            _entries(0, 1, 2),
            "the path is a straight line",
            _fall,
            "ż [m/s]",
            "the constraint slows the fall",
        ),
        Picture(
            s.HarmonicOscillator(),
            *(4 * np.pi, 400),
            lambda run_: [np.stack([run_.q[:, 0], run_.v[:, 0]], axis=1)],
            "position and velocity",
            _two_stages,
            "change of energy [J]",
            "with two stages and long steps the energy oscillates, and the motion "
            "returns to its start after 12 steps",
            axes=("q [m]", "v [m/s]"),
        ),
        Picture(
            s.SphericalPendulum(),
            *(30, 900),
            _entries(0, 1, 2),
            "the path of the mass, and the rod at some times",
            _exact_height,
            "z [m]",
            "the height, and its exact solution",
            lambda run_, k: [np.array([np.zeros(3), run_.q[k]])],
        ),
        Picture(
            s.DoublePendulum.swinging((2.0, 2.5)),
            *(40, 2000),
            _entries(2, 3),
            "the path of the end, and the rods at some times",
            _distance_of_pendula,
            "distance [m]",
            "a second pendulum starts 1e-8 rad away; the distance between the two "
            "pendula grows exponentially, as is typical of chaos",
            lambda run_, k: [np.concatenate([np.zeros(2), run_.q[k]]).reshape(3, 2)],
            4,
            log=True,
        ),
    ]


def _rigid_bodies() -> list[Picture]:
    s = systems
    tip = "the path of the tip of the third body axis, and this axis at some times"
    omega = ("ω₁", "ω₂", "ω₃")
    return [
        Picture(
            s.FreeRigidBody(v0=(0.02, 1.0, 0.02)),
            *(60, 1200),
            lambda run_: [run_.v],
            "the angular velocity in body axes",
            _velocities(0, 1, 2, labels=omega),
            "ω [1/s]",
            "the body spins about the principal axis of the middle moment of inertia; "
            "this rotation is unstable, so that the body flips over again and again",
            axes=omega,
        ),
        Picture(
            s.HeavyTop(),
            *(12, 2400),
            _third_axis,
            tip,
            _precession,
            "tilt [degrees]",
            "the tilt oscillates (nutation), and the azimuth grows (precession)",
            _axis_from_origin,
            right_units="azimuth [degrees]",
        ),
        Picture(
            s.HeavyTopSE3(),
            *(12, 2400),
            _third_axis,
            f"{tip}, as for `HeavyTop`",
            _multipliers("x", "y", "z"),
            "force of the pivot [N]",
            "the multiplier is the force that holds the pivot",
            _axis_from_origin,
        ),
        Picture(
            s.Suslov(v0=(-0.32, -0.77, 0.0)),
            *(30, 900),
            _third_axis,
            tip,
            _velocities(0, 1, labels=omega[:2]),
            "ω [1/s]",
            "the rotation reverses and tends to a steady rotation, although energy is "
            "conserved",
            _axis_from_origin,
        ),
        Picture(
            s.Veselova(),
            *(30, 900),
            _third_axis,
            tip,
            _horizontal_momentum,
            "|(R J ω)₁₂| [N m s]",
            "the horizontal angular momentum is constant only without weight",
            _axis_from_origin,
        ),
        _machine(
            "ChaplyginSphere",
            example=s.ChaplyginSphere(moments=(0.2, 0.45, 0.6)).rolling(
                (0.8, 0.6, 0.0, 0.0), (0.5, 1.2, 1.0)
            ),
            duration=8.0,
            curves=_momentum_of_sphere,
            units="ω [1/s], K [N m s]",
            below="the angular velocity in body axes changes, but the size of the "
            "angular momentum K about the contact is constant",
            outline=_body(_sphere),
            shown=3,
            ground=True,
            above="three great circles of the sphere at some times, and the path of "
            "the contact",
        ),
        _machine(
            "ChaplyginTop",
            curves=_routh,
            units="relative change",
            below="energy and the integrals of Jellett and Routh are constant up to "
            "1e-13",
            outline=_body(
                lambda top: _great_circles(float(top.radius), (0, 0, float(top.offset)))
            ),
            shown=3,
            ground=True,
            above="three great circles of the sphere at some times, and the path of "
            "the contact",
        ),
        _machine(
            "Rattleback",
            duration=5.0,
            num_steps=1500,
            curves=_velocities(5, labels=("ω₃",)),
            units="spin ω₃ [1/s]",
            below="the stone stops its spin and turns the other way",
            outline=_body(_ellipsoid),
            shown=3,
            ground=True,
            above="the stone at some times, and the path of the contact",
            film="A rattleback that reverses its spin",
        ),
        _machine(
            "RollingTorus",
            curves=_disc,
            units="tilt [degrees]",
            right_units="ω₃ [1/s]",
            below="the tilt of the disc oscillates, and its rate ω₃ about the axle "
            "varies with the tilt",
            outline=_body(lambda disc: [float(disc.radius) * ROUND]),
            ground=True,
            above="the disc at some times, and the paths of the contact and of a point "
            "of the rim",
        ),
        _machine(
            "BallInBowl",
            curves=_moving_energy,
            units="energy [J]",
            below="the bowl does work on the ball, but the moving energy is constant",
            outline=_ball_and_bowl,
            above="the bowl, the ball at some times, and the path of the contact",
        ),
    ]


def _machines() -> list[Picture]:
    return [
        _machine(
            "WhippleBicycle",
            duration=2.5,
            num_steps=125,
            curves=_lean_and_steer,
            units="angle [degrees]",
            below="the uncontrolled bicycle steers into the fall, and becomes upright "
            "again",
            ground=True,
            shown=5,
            film="A bicycle that leans, steers and rights itself",
        ),
        _machine(
            "CarWithTrailers",
            curves=_hitch_angles,
            units="angle [degrees]",
            below="the angles at the two hitches tend to constant values: the car and "
            "its trailers go round in circles",
        ),
        _machine(
            "TwoWheeledRobot",
            duration=15.0,
            num_steps=500,
            curves=_speed_and_turning,
            units="u, θ̇",
            below="without torques, the robot stops turning and goes straight ahead",
        ),
        _machine(
            "Snakeboard",
            duration=24.0,
            num_steps=600,
            curves=_driven(3, "rotor ψ"),
            units="speed along the board [m/s]",
            right_units="rotor ψ [rad]",
            below="the rotor and the axles swing, and the board accelerates from rest, "
            "backwards",
        ),
        _machine(
            "RollerRacer",
            curves=_driven(3, "handlebar φ"),
            units="speed of the seat [m/s]",
            right_units="handlebar φ [rad]",
            below="the handlebar swings, and the racer accelerates backwards from "
            "rest, so that the seat goes in front of the handlebar",
        ),
        _machine(
            "SliderCrank",
            duration=0.3,
            num_steps=120,
            curves=_velocities(0, labels=("θ̇",)),
            units="crank θ̇ [rad/s]",
            below="the crank is slow when the slider is fast",
        ),
        _machine(
            "FourBar",
            duration=1.0,
            num_steps=200,
            curves=lambda run_: [
                Curve("rocker", np.degrees(run_.q[:, 2])),
                Curve("crank", run_.v[:, 0], right=True),
            ],
            units="rocker θ₃ [degrees]",
            right_units="crank θ̇₁ [rad/s]",
            below="the crank makes full turns at a varying rate, and the rocker swings",
        ),
        _machine(
            "AndrewsSqueezer",
            curves=lambda run_: [Curve("K1", run_.v[:, 0] * 30 / np.pi)],
            units="K1 [rev/min]",
            below="the motor accelerates K1 to nearly 11 000 revolutions a minute",
        ),
        _machine(
            "CarAxis",
            curves=_heights,
            units="height [m]",
            below="the right end follows the road and swings on its spring; the left "
            "end stays at nearly the same height",
        ),
        _machine(
            "PendulumChain",
            curves=_energies,
            units="energy [J]",
            below="kinetic and potential energy are exchanged; the sum is constant",
        ),
        _machine(
            "SpatialSliderCrank",
            curves=lambda run_: [
                Curve("slider", run_.q[:, 3]),
                Curve("crank", run_.v[:, 0], right=True),
            ],
            units="slider x [m]",
            right_units="crank θ̇ [rad/s]",
            below="the crank turns at a varying rate and moves the slider to and fro",
        ),
        _machine(
            "FlyballGovernor",
            curves=_governor,
            units="slider s [m]",
            right_units="shaft φ̇ [rad/s]",
            below="when the balls rise and lift the slider, the shaft slows down",
        ),
    ]


def groups() -> dict[str, list[Picture]]:
    """The pictures of all systems, in groups."""
    return {
        "Experiments of the paper": _papers_experiments(),
        "Textbook systems": _textbook_systems(),
        "Rigid bodies on groups": _rigid_bodies(),
        "Machines": _machines(),
    }


def pictures() -> list[Picture]:
    """The pictures of all systems."""
    return [picture for group in groups().values() for picture in group]


# --- Formulas -------------------------------------------------------------------------


GREEK = dict(
    zip(
        "αβγδεζηθικλμνξπρστφχψωΓΔΘΛΞΠΦΨΩℓ",
        (
            *("alpha", "beta", "gamma", "delta", "varepsilon", "zeta", "eta", "theta"),
            *("iota", "kappa", "lambda", "mu", "nu", "xi", "pi", "rho", "sigma", "tau"),
            *("varphi", "chi", "psi", "omega", "Gamma", "Delta", "Theta", "Lambda"),
            *("Xi", "Pi", "Phi", "Psi", "Omega", "ell"),
        ),
        strict=True,
    )
)
OPERATORS = {
    **{"+": "+", "-": "-", "=": "=", "<": "<", ">=": r"\ge ", ",": r",\;"},
    **{"·": r"\cdot ", "×": r"\times ", "±": r"\pm ", "∓": r"\mp "},
    "...": r"\ldots ",
}
DOTS = {"\u0307": "dot", "\u0308": "ddot"}
LOWERED = str.maketrans("₀₁₂₃₄₅₆₇₈₉ₙᵢₖ", "0123456789nik")
RAISED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻ᵀⁿ", "0123456789+-Tn")
FUNCTIONS = ("sin", "cos", "tan", "diag")
# English words of two and three letters; other letter groups of this length are
# products of symbols.
WORDS = re.compile(
    "in|of|is|it|to|by|at|on|an|as|or|so|if|no|and|the|for|are|its|has|one|two|all|not",
    re.IGNORECASE,
)
# A formula does not end in an operator, or in a unit such as `[kg m²]`.
NO_END = re.compile(r"[\s,.;:=+\-·×/(]$|\s\[[A-Za-z1/² ]+\]$")
OPENING = re.compile(r"[LℓΦφΓ]\w* = ")


class Unreadable(ValueError):
    """A formula that has a character or a word that is not mathematics."""


class _Reader:
    """A reader of formulas in the notation of the docstrings.

    It is a recursive-descent parser. The factors of a product stand side by side, with
    or without spaces. The numerator of a fraction is the whole product before its bar.
    """

    def __init__(self, text: str):
        self.text = unicodedata.normalize("NFD", text)
        self.at = 0

    def looking(self, pattern: str) -> re.Match[str] | None:
        """Match a pattern at the current position."""
        return re.compile(pattern).match(self.text, self.at)

    def take(self, pattern: str) -> str | None:
        """Return the text that matches a pattern, and move past this text."""
        match = self.looking(pattern)
        if match is None:
            return None
        self.at = match.end()
        return match[0]

    def formula(self, closing: str = "") -> str:
        """Read sums of products up to a closing bracket, or up to the end."""
        parts: list[str] = []
        factors: list[str] = []
        while True:
            self.take(r"\s+")
            if self.at == len(self.text) or (closing and self.looking(closing)):
                return "".join([*parts, _product(factors)])
            if self.take("/"):
                self.take(r"\s+")
                above, below = _bare(_product(factors)), _bare(self.factor())
                factors = [rf"\frac{{{above}}}{{{below}}}"]
            elif found := self.take(r"\.\.\.|>=|[-+=,<·×±∓]"):
                parts += [_product(factors), OPERATORS[found]]
                factors = []
            elif self.take("Σ"):
                parts += [_product(factors), r"\sum", self.limits(), " "]
                factors = []
            else:
                factors.append(self.factor())

    def factor(self) -> str:
        """Read a number, a symbol, a function or a bracket."""
        if self.take("½"):
            return r"\tfrac{1}{2}"
        if number := self.take(r"\d+(\.\d+)?"):
            return number
        if words := self.take(r"\{[^}]*\}"):
            return rf"\text{{ {words[1:-1]}}}"
        if self.take("√"):
            return (
                rf"\sqrt{{{self.inside() if self.looking('[(]') else self.factor()}}}"
            )
        if self.take("∇"):
            return rf"\nabla {self.factor()}"
        if self.looking(r"[(\[]"):
            opening = self.text[self.at]
            closing = {"(": ")", "[": "]"}[opening]
            return rf"\left{opening}{self.inside()}\right{closing}{self.scripts()}"
        if self.take(r"\|"):
            inside = self.formula(r"\|")
            self.take(r"\|")
            return rf"\left|{inside}\right|{self.scripts()}"
        if name := self.take(rf"({'|'.join(FUNCTIONS)})(?![A-Za-z])"):
            return self.applied(name)
        if name := self.take(r"[a-z]{4,}(?=\()"):
            return rf"\operatorname{{{name}}}{self.factor()}"
        if word := self.take(r"(?<=\()[a-z]{4,}(?=,)"):
            return rf"\text{{{word}}}"
        word = self.looking(r"[A-Za-z]{2,}")
        if word and (len(word[0]) > 3 or WORDS.fullmatch(word[0])):
            raise Unreadable(f"{word[0]!r} in {self.text!r}")
        return self.symbol()

    def inside(self) -> str:
        """Read a bracket, and return its content."""
        self.at += 1
        inside = self.formula(r"[)\]]")
        if not self.take(r"[)\]]"):
            raise Unreadable(f"a bracket is open in {self.text!r}")
        return inside

    def applied(self, name: str) -> str:
        """Read a function's argument: a bracket, or factors up to the next space."""
        shown = rf"\operatorname{{{name}}}" if name == "diag" else rf"\{name}"
        shown += self.scripts()
        self.take(r"\s+")
        if self.looking(r"\("):
            return rf"{shown}{self.factor()}\,"
        argument = [self.factor()]
        while self.looking(r"[^\s+\-=,·×/)|\].:;]"):
            argument.append(self.factor())
        return rf"{shown} {_product(argument)}\,"

    def symbol(self) -> str:
        """Read one letter with its dots, subscripts and superscripts."""
        letter = self.take(r"[A-Za-z]|[" + "".join(GREEK) + "]")
        if letter is None:
            raise Unreadable(f"{self.text[self.at :][:9]!r} in {self.text!r}")
        shown = rf"\{GREEK[letter]} " if letter in GREEK else letter
        if dots := self.take("[\u0307\u0308]"):
            shown = rf"\{DOTS[dots]}{{{shown.strip()}}}"
        return shown + self.scripts()

    def scripts(self) -> str:
        """Read subscripts and superscripts, in either order."""
        below = above = ""
        while True:
            if found := self.take("[₀-₉ₙᵢₖ]+"):
                below = found.translate(LOWERED)
            elif found := self.take("[⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻ᵀⁿ]+"):
                above = found.translate(RAISED).replace("T", r"\top ")
            elif self.looking("_[{]"):
                self.at += 2
                below = self.formula("[}]")
                self.at += 1
            elif found := self.take("_[A-Za-z]{2,}"):
                below = rf"\mathrm{{{found[1:]}}}"
            elif found := self.take(r"_[A-Za-z0-9" + "".join(GREEK) + "]"):
                below = rf"\{GREEK[found[1]]}" if found[1] in GREEK else found[1]
            else:
                return (f"_{{{below}}}" if below else "") + (
                    f"^{{{above}}}" if above else ""
                )

    def limits(self) -> str:
        """Read the limits of a sum: `_{i=1..m}` or `_{k=1,2}`."""
        found = self.take(r"_\{[^}]*\}")
        if found is None:
            return ""
        low, _, high = found[2:-1].partition("..")
        lower = _Reader(low).formula().replace(r"\;", "")
        return f"_{{{lower}}}" + (f"^{{{high}}}" if high else "")


def _bare(product: str) -> str:
    """Remove brackets that enclose a whole numerator or denominator."""
    inside = product.removeprefix(r"\left(").removesuffix(r"\right)")
    is_bracket = len(inside) == len(product) - 13 and "\\left" not in inside
    return inside if is_bracket and "," not in inside else product


def _product(factors: list[str]) -> str:
    # The small gap after a function's argument is needed only before another factor.
    return " ".join(factors).removesuffix(r"\,")


def latex(formula: str) -> str:
    """Convert a formula of a docstring, such as `m/2 (ẋ² + ẏ²)`, to LaTeX."""
    reader = _Reader(formula)
    found = reader.formula().replace(r",\;\right", r",\right")
    return re.sub(r" +", " ", found).strip()


def _leading_formula(text: str) -> tuple[str, str]:
    """Split a text into the longest formula with which it begins, and the rest."""
    ends = [m.start() for m in re.finditer(r"(?=[\s,.;:]|$)", text)]
    for end in reversed(ends):
        head = text[:end]
        if _depth(head) == 0 and not NO_END.search(head):
            outside = re.sub(r"\((?:[^()]|\([^()]*\))*\)|\{[^}]*\}", "", head)
            if "," in outside and "..." not in outside:
                continue
            try:
                latex(head)
            except Unreadable:
                continue
            return head, text[end:]
    raise Unreadable(text)


def _depth(text: str) -> int:
    return len(re.findall(r"[(\[{]", text)) - len(re.findall(r"[)\]}]", text))


def _pieces(paragraph: str) -> Iterator[tuple[str, str]]:
    """Yield the equations of a paragraph, each with the text that follows it."""
    # Two spaces, or a line break, separate equations after a comma.
    pieces = [""]
    for part in re.split(r"(?<=,)(?:  +|\n)", paragraph):
        whole = pieces[-1] + (" " if pieces[-1] else "") + part
        if pieces[-1] and (_depth(pieces[-1]) == 0):
            pieces.append(part)
        else:
            pieces[-1] = whole
    for piece in pieces:
        yield _leading_formula(" ".join(piece.split()))


def _block(formula: str) -> str:
    """The LaTeX of an equation, in several lines if it is long."""
    left, _, right = formula.partition(" = ")
    long = len(formula) > 80
    if long and right.startswith("(") and _depth(right[1:-1]) == 0:
        rows = _split(right[1:-1], r",\s+")
        return (
            rf"{latex(left)} = \begin{{pmatrix}} "
            + r" \\ ".join(latex(row) for row in rows)
            + r" \end{pmatrix}"
        )
    if len(formula) > 95:
        terms = _split(formula, r" (?=[+-] )")
        first, second = terms[0], ""
        for term in terms[1:]:
            if len(first) + len(term) < 0.62 * len(formula) and not second:
                first += f" {term}"
            else:
                second += f" {term}"
        rows = [latex(first), rf"\quad {latex(second)}"]
        return r"\begin{array}{l} " + r" \\ ".join(rows) + r" \end{array}"
    return latex(formula)


def _split(text: str, pattern: str) -> list[str]:
    """Split a text where a pattern is outside of brackets."""
    parts = [""]
    at = 0
    for match in re.finditer(pattern, text):
        if _depth(text[: match.start()]) == 0:
            parts[-1] = text[at : match.start()]
            parts.append("")
            at = match.end()
    return [*parts[:-1], text[at:]]


def display(paragraph: str) -> tuple[str, str]:
    """Return the typeset equations at the start of a paragraph, and the other text."""
    rows: list[list[str]] = []
    rest = ""
    for formula, after in _pieces(paragraph):
        if rest:
            raise Unreadable(f"{rest!r} in {paragraph!r}")
        rest = after.lstrip(" ,") if after.strip(" ,.") else ""
        if " = " not in formula:
            rest = formula + after
            continue
        # A sum may go on after words: `½ I ω² over all bodies, + ½ J δ̇²,`.
        if goes_on := re.fullmatch(r"(.*), ([+-] .*),", rest):
            formula, rest = f"{formula} {{{goes_on[1]}, }} {goes_on[2]}", ""
        together = sum(map(len, rows[-1])) + len(formula) if rows else 0
        if rows and not rows[-1][0].startswith(("L", "ℓ")) and together < 65:
            rows[-1].append(formula)
        else:
            rows.append([formula])
    blocks = [r",\qquad ".join(map(_block, row)) for row in rows]
    return "\n\n".join(f"$${block}$$" for block in blocks), rest


MATHY = re.compile(rf"(?:{'|'.join(FUNCTIONS)})|(?!.*[A-Za-z]{{3}})[^`*\"]+")


def inline(text: str) -> str:
    """Typeset the equations within a text, which have an equals sign between spaces."""
    done = ""
    while " = " in text:
        before, after = text.split(" = ", 1)
        words = before.split(" ")
        number = 0
        while number < len(words) and _is_mathematics(words[-number - 1], number):
            number += 1
        left = " ".join(words[len(words) - number :]).lstrip("+-·/ ")
        start = len(before) - len(left)
        for k in range(start, len(before)):
            if _depth(before[k:]) > 0:
                start = k + 1
        try:
            formula, _ = _leading_formula(_balanced(f"{before[start:]} = {after}"))
        except Unreadable:
            formula = ""
        if not number or " = " not in formula:
            done, text = f"{done}{before} = ", after
            continue
        whole = f"{before[start:]} = {after}"
        # Lines must not be broken at the spaces of a formula.
        typeset = latex(formula).replace(" ", "\0")
        done, text = f"{done}{before[:start]}${typeset}$", whole[len(formula) :]
    return done + text


def _balanced(text: str) -> str:
    """Cut a text before the first closing bracket without an opening bracket."""
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter in "([") - (letter in ")]")
        if depth < 0:
            return text[:k]
    return text


def _is_mathematics(word: str, behind: int) -> bool:
    """Whether a word is part of a formula of which `behind` more words follow."""
    if word in ("a", "A", "I"):
        return behind == 0
    plain = re.sub(r"_[A-Za-z]+", "", word)
    if not word or WORDS.fullmatch(word) or not MATHY.fullmatch(plain):
        return False
    return not word.endswith((",", ":", ";", "."))


# --- The page -------------------------------------------------------------------------


INTRODUCTION = """\
# Gallery

`nhjax.systems` has {count} mechanical systems. Each system has parameters, initial
data, invariants and a reference to its source, and many have an exact solution. For
each system this page shows a picture, the Lagrangian and the constraints, an
interesting feature of the motion, and the code of the model. In the formulas, $L$ is a
Lagrangian and $\\Phi$ are constraints in coordinates. On Lie groups, $\\ell$ is a
Lagrangian and $\\varphi$ are constraints in body velocities, and $\\Phi$ are holonomic
constraints.

| group | systems |
|---|---|
{table}

[Real machines](machines.md) describes how the machines are tested. [Films](films.md)
shows how to make films of runs. `python docs/gallery.py` draws the pictures of this
page. This code draws the path of one system:

```python
import jax

jax.config.update("jax_enable_x64", True)
import nhjax

sleigh = nhjax.systems.ChaplyginSleigh()
sol = nhjax.integrate(
    sleigh.system,
    nhjax.LobattoIIIAB(stages=4),
    sleigh.initial_state(),
    dt=0.02,
    num_steps=600,
    saveat=nhjax.SaveAt(t0=True, steps=True),
)
ax = nhjax.plot.trajectory(sol, (0, 1), names=("x", "y"))
```

Parameters are arguments of the class, as in `ChaplyginSleigh(offset=0.2)`, and JAX can
differentiate with respect to them. In the pictures a dot marks the start of a path. If
a system is drawn at several times, later times are darker.
"""


def page() -> str:
    """The text of docs/gallery.md."""
    found = groups()
    rows = []
    for title, members in found.items():
        links = ", ".join(f"[{x.name}](#{x.name.lower()})" for x in members)
        rows.append(f"| {title} | {links} |")
    parts = [INTRODUCTION.format(count=len(pictures()), table="\n".join(rows))]
    parts += [_section(picture) for members in found.values() for picture in members]
    return "\n".join(parts)


def _section(picture: Picture) -> str:
    """The part of the page about one system."""
    name = picture.name
    paragraphs, source = described(picture.example)
    last = max((k for k, x in enumerate(paragraphs) if x.startswith("$$")), default=0)
    # A short text after the last formula stays with this formula.
    if re.match(r"[a-z].{,60}$", "".join(paragraphs[last + 1 : last + 2])):
        last += 1
    below = picture.below[0].upper() + picture.below[1:]
    above = picture.above[0].upper() + picture.above[1:]
    parts = [f"## {name}", *paragraphs[: last + 1]]
    if picture.film:
        film = {"WhippleBicycle": "bicycle"}.get(name, name.lower())
        parts.append(f"![{picture.film}](films/{film}.gif)")
    parts += [
        f"![{above}](gallery/{name}.png)",
        *paragraphs[last + 1 :],
        _filled(f"**Picture:** {above}."),
        _filled(f"**Plot:** {below}."),
        source,
        _model(picture.example),
    ]
    return "\n\n".join(parts) + "\n"


def _filled(text: str) -> str:
    """Wrap a paragraph, but not within formulas."""
    lines = textwrap.wrap(text, 110, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines).replace("\0", " ")


def described(example: Any) -> tuple[list[str], str]:
    """The typeset paragraphs of a docstring before the parameters, and its source."""
    text = inspect.getdoc(type(example)) or ""
    before, _, after = text.partition("**Parameters:**")
    source = next(x for x in after.split("\n\n") if x.startswith("**Source:**"))
    paragraphs: list[str] = []
    for paragraph in before.strip().split("\n\n"):
        if OPENING.match(paragraph):
            formulas, paragraph = display(paragraph)
            paragraphs.append(formulas)
        if paragraph.startswith("- "):
            paragraphs.append(paragraph)
        elif paragraph:
            paragraphs.append(_filled(inline(" ".join(paragraph.split()))))
    return paragraphs, _filled(" ".join(source.split()))


def _model(example: Any) -> str:
    """The code that models a system, in a block that is folded at first."""
    kind = type(example)
    lines = "\n\n".join(model(example))
    path = Path(inspect.getfile(kind))
    place = path.relative_to(DOCS.parent).as_posix()
    return (
        '<details markdown="1" style="clear: both">\n'
        "<summary>How it is modelled</summary>\n\n"
        f"```py\n{lines}\n```\n\n"
        f"This is part of `nhjax.systems.{kind.__name__}`, in `{place}`.\n\n"
        "</details>"
    )


def model(example: Any) -> list[str]:
    """The source code of a system's functions, and of the functions that they call."""
    kind = type(example)
    system = example.system
    used = [
        name
        for name, field in (
            ("lagrangian", "lagrangian"),
            ("constraint", "nonholonomic"),
            ("holonomic", "holonomic"),
            ("force", "force"),
        )
        if getattr(system, field) is not None
    ]
    members = [_member(kind, name) for name in used]
    sources = [_source(member) for member in members if member is not None]
    waiting = [member for member in members if member is not None]
    seen = set(waiting)
    while waiting:
        for helper in _helpers(kind, waiting.pop(0)):
            source = _source(helper)
            longer = sum(x.count("\n") + 2 for x in [*sources, source]) - 1
            if helper not in seen and longer <= MODEL_LINES:
                sources.append(source)
                waiting.append(helper)
            seen.add(helper)
    return sources


def _member(kind: type, name: str) -> Any:
    """A method or property of a class, as a function, or None if `_base` defines it."""
    member = inspect.getattr_static(kind, name, None)
    member = member.fget if isinstance(member, property) else member
    is_own = inspect.isfunction(member) and not member.__module__.endswith("._base")
    return member if is_own else None


def _helpers(kind: type, function: Any) -> Iterator[Any]:
    """The functions of nhjax.systems that a function calls, in order."""
    for node in ast.walk(ast.parse(_source(function))):
        found = None
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.value.id == "self":
                found = _member(kind, node.attr)
        elif isinstance(node, ast.Name):
            found = function.__globals__.get(node.id)
        is_helper = inspect.isfunction(found) and found.__module__.startswith(
            "nhjax.systems"
        )
        if is_helper and not found.__module__.endswith("._base"):
            yield found


def _source(function: Any) -> str:
    return textwrap.dedent(inspect.getsource(function)).rstrip()


def main() -> None:
    """Draw the pictures and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--text", action="store_true", help="write only the page")
    parser.add_argument("names", nargs="*", help="draw only these pictures")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    (DOCS / "gallery.md").write_text(page(), encoding="utf-8")
    if options.text:
        return
    for picture in pictures():
        if not options.names or picture.name in options.names:
            save(draw(picture), picture.name)
            jax.clear_caches()


if __name__ == "__main__":
    main()
