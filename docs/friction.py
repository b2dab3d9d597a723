"""Draws the pictures of docs/friction.md from the runs of that page.

`python docs/friction.py` writes docs/friction/*.png.
"""

import re
from pathlib import Path
from typing import Any

import jax
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

import nhjax
from nhjax import plot


DOCS = Path(__file__).parent
PICTURES = DOCS / "friction"


def runs() -> dict[str, Any]:
    """Run the code of the page, and return its variables."""
    text = (DOCS / "friction.md").read_text(encoding="utf-8")
    variables: dict[str, Any] = {}
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S):
        exec(compile(block, "friction.md", "exec"), variables)
    return variables


def draw_scooter(page: dict[str, Any], speeds: Any, loads: Any) -> None:
    """Draw speeds and loads, before and after the front wheel slips."""
    radius = page["radius"]
    for sol, contacts in (
        (page["braking"], page["contacts"]),
        (page["locking"], page["sliding"]),
    ):
        speeds.plot(sol.ts, sol.ys.v[:, 0], "C0", label="scooter")
        speeds.plot(sol.ts, radius * sol.ys.v[:, 4], "C1", label="rim of the front")
        force = jax.vmap(contacts.forces)(sol.ts, sol.ys)
        for k, name in enumerate(("front", "rear")):
            loads.plot(sol.ts, force[name][:, 2], f"C{k + 2}", label=f"{name} wheel")
    for ax in (speeds, loads):
        ax.axvline(float(page["t_slip"]), color="0.5", linestyle=":")
        ax.set_xlabel("time [s]")
        handles, labels = ax.get_legend_handles_labels()
        ax.legend(handles[:2], labels[:2])
    speeds.set_ylabel("speed [m/s]")
    loads.set_ylabel("normal force [N]")


def draw_ball(page: dict[str, Any], places: Any, speeds: Any) -> None:
    """Draw the position of the ball, and the two speeds that become equal."""
    sol = page["spinning"]
    matrices = jax.vmap(nhjax.SO3().matrix)(sol.ys.q[:, :4])
    velocity = np.einsum("tij,tj->ti", matrices, sol.ys.v[:, :3])
    spin = np.einsum("tij,tj->ti", matrices, sol.ys.v[:, 3:])
    places.plot(sol.ts, sol.ys.q[:, 4])
    places.set_ylabel("position [m]")
    speeds.plot(sol.ts, velocity[:, 0], label="velocity")
    speeds.plot(sol.ts, 0.03 * spin[:, 1], label="radius times spin")
    speeds.set_ylabel("speed [m/s]")
    speeds.legend()
    for ax in (places, speeds):
        ax.set_xlabel("time [s]")


def draw_car(page: dict[str, Any], paths: Any, loads: Any) -> None:
    """Draw outlines of the car along both paths, and the loads on its tyres."""
    for k, (name, sol) in enumerate(page["drives"].items()):
        colour = f"C{k}"
        q = np.asarray(sol.ys.q)
        label = {"rolling": "no brake", "braked": "hand brake at 1 s"}[name]
        paths.plot(q[:, 0], q[:, 1], colour, label=label)
        for x in q[::4]:
            _outline(paths, x[:2], x[3], 3.6, 1.6, colour)
        if name == "braked":
            for tyre, load in zip(("front", "rear"), sol.ys.multiplier.T, strict=True):
                loads.plot(sol.ts, load, label=f"{tyre} tyre")
    paths.set_aspect("equal")
    paths.set_xlabel("$x$ [m]")
    paths.set_ylabel("$y$ [m]")
    loads.set_xlabel("time [s]")
    loads.set_ylabel("normal force [N]")
    for ax in (paths, loads):
        ax.legend()


def draw_platform(page: dict[str, Any], path: Any, rates: Any) -> None:
    """Draw outlines of the platform, and the rates of its wheels."""
    sol = page["sideways"]
    q = np.asarray(sol.ys.q)
    path.plot(q[:, 0], q[:, 1], "C0")
    for x in q[::10]:
        _outline(path, x[:2], x[2], 0.5, 0.4, "C0")
        ahead = 0.25 * np.array([np.cos(x[2]), np.sin(x[2])])
        path.annotate("", x[:2] + ahead, x[:2], arrowprops={"arrowstyle": "->"})
    path.set_aspect("equal")
    path.set_xlabel("$x$ [m]")
    path.set_ylabel("$y$ [m]")
    for k, side in ((0, "front left, rear right"), (1, "front right, rear left")):
        rates.plot(sol.ts, sol.ys.v[:, 3 + k], label=side)
    rates.set_xlabel("time [s]")
    rates.set_ylabel("rate of the wheel [rad/s]")
    rates.legend()


def _outline(
    ax: Any, centre: Any, heading: float, length: float, width: float, colour: str
) -> None:
    """Draw a rectangle whose front is thicker."""
    c, s = np.cos(heading), np.sin(heading)
    turn = np.array([[c, -s], [s, c]])
    ends = 0.5 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [length, width]
    corners = centre + ends @ turn.T
    ax.add_patch(Polygon(corners, facecolor="none", edgecolor=colour, linewidth=0.7))
    front = corners[[0, 3]].T
    ax.plot(*front, colour, linewidth=2)


def main() -> None:
    """Run the page and write the pictures."""
    matplotlib.use("Agg")
    page = runs()
    plot.style()
    PICTURES.mkdir(exist_ok=True)
    for name, draw in (
        ("scooter", draw_scooter),
        ("ball", draw_ball),
        ("car", draw_car),
        ("platform", draw_platform),
    ):
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        draw(page, *figure.subplots(1, 2))
        figure.savefig(PICTURES / f"{name}.png", dpi=90)


if __name__ == "__main__":
    main()
