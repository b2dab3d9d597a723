"""Pictures and animations of the machines of the gallery.

    python docs/machines.py                      writes docs/machines.png
    python docs/machines.py --animate Rattleback writes docs/Rattleback.gif

A picture shows the paths of some points over the run, and the rods between points at a
few times. The benchmarks use `machines` too.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image, ImageSequence

import nhjax
from nhjax import systems
from nhjax.systems import Rattleback, RollingTorus, WhippleBicycle


DOCS = Path(__file__).parent
TIMES_SHOWN = 7
FRAME_RATE = 16


class Machine(NamedTuple):
    """A machine of the gallery, with a run and the parts to draw.

    - `rods`: the names of points that are connected, one after the other.
    - `traced`: the names of points whose paths are drawn.
    - `wheels`: for each wheel that an animation shows, the names of its hub, of a point
        of its rim, and of another point in its plane.
    - `follow`: the name of a point that stays in the centre of an animation.
    """

    example: Any
    duration: float
    num_steps: int
    rods: tuple[str, ...]
    traced: tuple[str, ...]
    wheels: tuple[tuple[str, str, str], ...] = ()
    follow: str | None = None

    @property
    def name(self) -> str:
        """The name of its class."""
        return type(self.example).__name__


def machines() -> tuple[Machine, ...]:
    """All machines, with data of JAX's default precision."""
    return (
        Machine(
            WhippleBicycle.running(5.0, lean_rate=0.3),
            4.0,
            200,
            ("rear_contact", "rear_hub", "rear_frame", "head", "front_hub"),
            ("rear_contact", "front_contact"),
            (
                ("rear_hub", "rear_contact", "rear_frame"),
                ("front_hub", "front_contact", "head"),
            ),
            "rear_hub",
        ),
        Machine(
            systems.CarWithTrailers(num_trailers=2),
            8.0,
            200,
            ("front_axle", "rear_axle", "hitch_1", "axle_1", "hitch_2", "axle_2"),
            ("rear_axle", "axle_2"),
        ),
        Machine(
            systems.TwoWheeledRobot(),
            6.0,
            200,
            ("left_wheel", "axle", "centre", "axle", "right_wheel"),
            ("centre",),
        ),
        Machine(
            systems.Snakeboard(),
            12.0,
            300,
            ("rear", "centre", "front"),
            ("centre",),
        ),
        Machine(
            systems.RollerRacer(),
            12.0,
            300,
            ("seat", "pivot", "handlebar"),
            ("seat",),
        ),
        Machine(
            Rattleback.spinning(5.0, (0.5, 0.5)),
            2.0,
            500,
            ("back", "centre_of_mass", "front"),
            ("contact",),
        ),
        Machine(
            RollingTorus(), 4.0, 300, ("contact", "centre", "rim"), ("contact", "rim")
        ),
        Machine(
            systems.ChaplyginSphere(),
            6.0,
            300,
            ("pole_1", "centre", "pole_2"),
            ("contact",),
        ),
        Machine(
            systems.ChaplyginTop(),
            4.0,
            300,
            ("contact", "centre", "pole"),
            ("contact",),
        ),
        Machine(systems.BallInBowl(), 8.0, 400, ("centre", "pole"), ("contact",)),
        Machine(systems.SliderCrank(), 2.0, 200, ("axle", "pin", "slider"), ("pin",)),
        Machine(systems.FourBar(), 3.0, 200, ("O", "A", "B", "C"), ("A", "B")),
        Machine(
            systems.AndrewsSqueezer(),
            0.03,
            600,
            ("O", "P", "B", "D", "A", "C"),
            ("P", "D"),
        ),
        Machine(
            systems.CarAxis(),
            3.0,
            300,
            ("left_wheel", "left_end", "right_end", "right_wheel"),
            ("left_end", "right_end"),
        ),
        Machine(
            systems.PendulumChain(num_links=5),
            4.0,
            400,
            ("pivot", *(f"mass_{k}" for k in range(1, 6))),
            ("mass_5",),
        ),
        Machine(
            systems.SpatialSliderCrank(), 2.0, 300, ("axle", "pin", "slider"), ("pin",)
        ),
        Machine(
            systems.FlyballGovernor(),
            1.0,
            300,
            ("ball_1", "middle_1", "slider_1", "slider_2", "middle_2", "ball_2"),
            ("ball_1",),
        ),
    )


def run(machine: Machine) -> dict[str, np.ndarray]:
    """The points of a machine along its run, each of shape (times, 2) or (times, 3)."""
    example = machine.example

    def points(t, y, args):
        return example.points(t, y.q)

    sol = nhjax.integrate(
        example.system,
        nhjax.LobattoIIIAB(3),
        example.initial_state(),
        dt=machine.duration / machine.num_steps,
        num_steps=machine.num_steps,
        saveat=nhjax.SaveAt(t0=True, steps=True, fn=points),
    )
    return jax.tree.map(np.asarray, sol.ys)


def draw(figure: Figure, place: tuple[int, int, int], machine: Machine) -> None:
    """Draw the paths of a machine, and the machine at some times."""
    points = run(machine)
    ax = axes_for(figure, place, points)
    for name in machine.traced:
        ax.plot(*points[name].T, color="C0")
    shown = np.linspace(0, machine.num_steps, TIMES_SHOWN).astype(int)
    for k, shade in zip(shown, np.linspace(0.75, 0.0, TIMES_SHOWN), strict=True):
        rods = np.array([points[name][k] for name in machine.rods])
        ax.plot(*rods.T, "o-", color=str(shade), linewidth=1.0, markersize=2)
    ax.set_title(machine.name)


def axes_for(
    figure: Figure, place: tuple[int, int, int], points: dict[str, np.ndarray]
) -> Axes:
    """Axes of equal units for points of the plane or of space."""
    everything = np.concatenate(list(points.values()))
    if everything.shape[1] == 2:
        ax = figure.add_subplot(*place, aspect="equal", adjustable="datalim")
    else:
        ax = figure.add_subplot(*place, projection="3d")
        low, high = everything.min(axis=0), everything.max(axis=0)
        size, middle = np.max(high - low), (high + low) / 2
        ax.set_box_aspect((1, 1, 1))  # pyright: ignore[reportArgumentType]
        for axis, centre in zip("xyz", middle, strict=True):
            limits = (centre - size / 2, centre + size / 2)
            getattr(ax, f"set_{axis}lim")(*limits)
    ax.tick_params(labelsize=6)
    return ax


def circle(points: dict[str, np.ndarray], wheel: tuple[str, str, str]) -> np.ndarray:
    """The rim of a wheel along the run, of shape (times, corners, 3)."""
    hub, rim, other = (points[name] for name in wheel)
    spoke, inwards = rim - hub, other - hub
    radius = np.linalg.norm(spoke, axis=1, keepdims=True)
    along = np.sum(spoke * inwards, axis=1, keepdims=True) / radius**2
    across = inwards - along * spoke
    across *= radius / np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.linspace(0, 2 * np.pi, 41)[:, None]
    return (
        hub[:, None] + np.cos(angle) * spoke[:, None] + np.sin(angle) * across[:, None]
    )


def animate(machine: Machine, path: Path, seconds: float = 3.0) -> None:
    """Write an animation of a machine, with the given length in seconds."""
    points = run(machine)
    ts = np.linspace(0, machine.duration, machine.num_steps + 1)
    rims = {" ".join(wheel): circle(points, wheel) for wheel in machine.wheels}
    spatial = points[machine.rods[0]].shape[1] == 3
    figure = Figure(figsize=(4, 4), layout="constrained")
    ax = figure.add_subplot(projection="3d" if spatial else None)
    ax.tick_params(labelsize=6)
    animation = nhjax.plot.animate(
        ts,
        points | rims,
        [machine.rods],
        traced=machine.traced,
        follow=machine.follow,
        speed=machine.duration / seconds,
        frame_rate=FRAME_RATE,
        ax=ax,
    )
    animation.save(path, writer=PillowWriter(fps=FRAME_RATE), dpi=80)
    # A palette of few colours halves the size of the file.
    with Image.open(path) as pictures:
        first, *others = [
            picture.convert("RGB").quantize(8, dither=Image.Dither.NONE)
            for picture in ImageSequence.Iterator(pictures)
        ]
    duration = 1000 // FRAME_RATE
    first.save(path, save_all=True, append_images=others, duration=duration, loop=0)


def main() -> None:
    """Write the picture of all machines, or the animation of one."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--animate", help="the name of a machine's class")
    name = parser.parse_args().animate
    jax.config.update("jax_enable_x64", True)
    nhjax.plot.style()
    gallery = machines()
    if name:
        (machine,) = (machine for machine in gallery if machine.name == name)
        animate(machine, DOCS / f"{name}.gif")
        return
    columns = 4
    rows = -(-len(gallery) // columns)
    figure = Figure(figsize=(3 * columns, 2.8 * rows), layout="constrained")
    for place, machine in enumerate(gallery, 1):
        draw(figure, (rows, columns, place), machine)
        jax.clear_caches()
    figure.savefig(DOCS / "machines.png", dpi=80)


if __name__ == "__main__":
    main()
