"""The gallery: a picture of each system, and the page that shows them.

`python docs/gallery.py` runs every system, draws docs/gallery/NAME.png and writes
docs/gallery.md, whose text comes from the docstrings. `--text` writes only the page,
and names select the pictures to draw. docs/machines.py draws the machines that have
points.
"""

import argparse
import inspect
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import nhjax
from docs import machines
from nhjax import systems


DOCS = Path(__file__).parent
PICTURES = DOCS / "gallery"

Drawn = Callable[[Any, np.ndarray], np.ndarray]


class Picture(NamedTuple):
    """The picture of a system without rods: a path in the plane or in space.

    `path(q, v)` takes arrays with time first, and returns two or three numbers for each
    time; `axes` are their names.
    """

    example: Any
    duration: float
    num_steps: int
    path: Drawn
    axes: tuple[str, ...]
    caption: str


def _entries(*indices: int) -> Drawn:
    return lambda q, v: q[:, list(indices)]


def _velocities(q: Any, v: np.ndarray) -> np.ndarray:
    return v[:, :3]


def _third_axis(q: Any, v: np.ndarray) -> np.ndarray:
    """The third axis of the body in space, from the quaternion of the attitude."""
    quaternion = q[:, :4]
    return np.stack([np.asarray(nhjax.SO3().matrix(g))[:, 2] for g in quaternion])


PLANE, SPACE, TURNING = ("x", "y"), ("x", "y", "z"), ("ω₁", "ω₂", "ω₃")


def pictures() -> tuple[Picture, ...]:
    """The pictures of all systems that are not machines."""
    s = systems
    tip = "the path of the third body axis in space"
    return (
        Picture(
            s.NonholonomicParticle(), 40, 800, _entries(0, 1, 2), SPACE, "its path"
        ),
        Picture(s.KnifeEdge(), 20, 800, _entries(0, 1), PLANE, "the path of the edge"),
        Picture(
            s.ChaplyginSleigh(), 12, 600, _entries(0, 1), PLANE, "the path of the blade"
        ),
        Picture(
            s.VerticalRollingDisc(), 8, 200, _entries(0, 1), PLANE, "where it touches"
        ),
        Picture(
            s.RollingDisc(), 8, 200, lambda q, v: q[0][:, :2], PLANE, "where it touches"
        ),
        Picture(s.Unicycle(), 60, 1200, _entries(0, 1), PLANE, "its path"),
        Picture(s.UnicycleInCoordinates(), 60, 1200, _entries(0, 1), PLANE, "its path"),
        Picture(
            s.ContinuouslyVariableTransmission.low(0.5),
            100,
            2000,
            _entries(0, 2),
            ("x", "z"),
            "the passenger, for ε = ½",
        ),
        Picture(
            s.ChaoticSystem(), 60, 1200, _entries(0, 1), ("x", "y₁"), "two coordinates"
        ),
        Picture(s.Appell(), 2, 50, _entries(0, 1, 2), SPACE, "its path"),
        Picture(s.RodSleigh(), 12, 600, _entries(0, 1), PLANE, "the path of the blade"),
        Picture(
            s.HarmonicOscillator(),
            20,
            400,
            lambda q, v: np.stack([q[:, 0], v[:, 0]], axis=1),
            ("q", "v"),
            "position and velocity",
        ),
        Picture(s.SphericalPendulum(), 30, 900, _entries(0, 1, 2), SPACE, "its path"),
        Picture(
            s.DoublePendulum(), 20, 800, _entries(2, 3), PLANE, "the path of the end"
        ),
        Picture(
            s.FreeRigidBody(), 30, 600, _velocities, TURNING, "the angular velocity"
        ),
        Picture(s.HeavyTop(), 12, 2400, _third_axis, SPACE, tip),
        Picture(
            s.HeavyTopSE3(), 12, 2400, _third_axis, SPACE, f"{tip}, as of `HeavyTop`"
        ),
        Picture(s.Suslov(), 20, 600, _third_axis, SPACE, tip),
        Picture(s.Veselova(), 30, 900, _third_axis, SPACE, tip),
        Picture(
            s.TurntableBall(),
            30,
            900,
            lambda q, v: q[1],
            PLANE,
            "the path of its centre",
        ),
    )


def draw_path(picture: Picture) -> Figure:
    """Run a system and draw its path."""
    example = picture.example
    sol = nhjax.integrate(
        example.system,
        nhjax.LobattoIIIAB(4),
        example.initial_state(),
        dt=picture.duration / picture.num_steps,
        num_steps=picture.num_steps,
        saveat=nhjax.SaveAt(t0=True, steps=True),
    )
    q = jax.tree.map(np.asarray, sol.ys.q)
    path = picture.path(q, np.asarray(sol.ys.v))
    figure = Figure(figsize=(3.6, 2.8), layout="constrained")
    ax: Axes = figure.add_subplot(projection="3d" if path.shape[1] == 3 else None)
    ax.plot(*path.T, linewidth=0.8, color="tab:blue")
    ax.plot(*path[:1].T, "o", color="black", markersize=3)
    for letter, name in zip("xyz", picture.axes, strict=False):
        getattr(ax, f"set_{letter}label")(name, fontsize=8)
    if picture.axes == PLANE:
        ax.set_aspect("equal", adjustable="datalim")
    ax.tick_params(labelsize=6)
    return figure


def draw_machine(machine: machines.Machine) -> Figure:
    """Draw a machine at some times, without its name."""
    figure = Figure(figsize=(3.6, 2.8), layout="constrained")
    machines.draw(figure, (1, 1, 1), machine)
    figure.axes[0].set_title("")
    return figure


def save(figure: Figure, name: str) -> None:
    """Write a picture with 32 colours: lines and letters need few more."""
    file = io.BytesIO()
    figure.savefig(file, dpi=120)
    image = Image.open(file).convert("RGB").quantize(32)
    PICTURES.mkdir(exist_ok=True)
    image.save(PICTURES / f"{name}.png", optimize=True)


OPENING = """\
# Gallery

`nhjax.systems` has {count} systems, each with parameters, initial data, invariants and
its source. Many have an exact solution. `python docs/gallery.py` draws these pictures.
This code draws one of them:

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

Parameters are arguments of the class, `ChaplyginSleigh(offset=0.2)`, and gradients
reach them. A dot marks the start. Textbook systems come first, then machines;
[Real machines](machines.md) describes how the machines are tested.
"""


def page() -> str:
    """The text of docs/gallery.md."""
    drawn = [(picture.example, picture.caption) for picture in pictures()]
    for machine in machines.machines():
        traced = " and ".join(name.replace("_", " ") for name in machine.traced)
        drawn.append(
            (machine.example, f"the machine at some times, and the path of: {traced}")
        )
    parts = [OPENING.format(count=len(drawn))]
    for example, caption in drawn:
        name = type(example).__name__
        parts.append(
            f"## {name}\n\n![{caption}](gallery/{name}.png)\n\n"
            f"{_described(example)}\n\n"
            f"*`nhjax.systems.{name}`; in the picture, {caption}.*\n"
        )
    return "\n".join(parts)


def _described(example: Any) -> str:
    """The part of a docstring before the parameters, and the source."""
    text = inspect.getdoc(type(example)) or ""
    before, _, after = text.partition("**Parameters:**")
    source = next(
        part for part in after.split("\n\n") if part.startswith("**Source:**")
    )
    return "\n\n".join([*before.strip().split("\n\n")[:3], source.strip()])


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
    figures: list[tuple[Any, Callable[[Any], Figure]]]
    figures = [(picture, draw_path) for picture in pictures()]
    figures += [(machine, draw_machine) for machine in machines.machines()]
    for drawn, draw in figures:
        name = type(drawn.example).__name__
        if not options.names or name in options.names:
            save(draw(drawn), name)
            jax.clear_caches()


if __name__ == "__main__":
    main()
