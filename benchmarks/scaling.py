"""The cost of a step as a function of sizes, one axis for each varied size.

The axes are the number of stages s, the number of coordinates n, the number of
constraints, the size of a batch, and the number of steps. The system is the chaotic
system with n = 2m + 1 coordinates. In three other families of systems, only the number
of constraints is varied: skates with a diagonal mass matrix, a chain of pendula (each
link shares coordinates with two others, so that C = B M⁻¹ Bᵀ is tridiagonal), and a
star of rods on one body (C is full).

Compile time is separate from run time. Run times are medians of seven. The runs of one
axis are interleaved, so that other load on the machine affects all of them. The table
also has the smallest of the seven times, which shows the noise.

Exponents are slopes in logarithms: the slope from the first to the last point of the
range, and the slope of a fit to all points. The table also has the iterations per step,
because the cost of a step depends on their number. `--smoke` takes a minute.
"""

import argparse
import math
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure

import nhjax
from nhjax import systems

from ._report import markdown_table, RESULTS, write


H, STAGES, REPEATS = 0.1, 3, 7


class Problem(NamedTuple):
    """One point of an axis: a system, its method, and the number of steps."""

    size: int
    system: nhjax.LagrangianSystem
    start: nhjax.State
    stages: int = STAGES
    members: int = 1
    num_steps: int = 200
    h: float = H


class Axis(NamedTuple):
    """A size that is varied, with one problem for each of its values."""

    name: str
    label: str
    problems: list[Problem]
    fitted_from: int


def chaotic(m: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create the chaotic system, with a start whose frequencies do not grow with m.

    At the start, q_2..q_{m+1} are from 0.6 to 0.2, as for m = 3. The gallery starts
    from m/5..1/5, which would raise the frequencies for larger m, and therefore the
    number of iterations.
    """
    q = np.array(systems.ChaoticSystem(m).q0)
    q[1 : m + 1] = np.linspace(0.6, 0.2, m)
    example = systems.ChaoticSystem(m, q0=q)
    return example.system, example.initial_state()


def members_of(count: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Return the chaotic system and `count` members of the paper's ensemble.

    A single member has no batch axis.
    """
    example = systems.ChaoticSystem()
    if count == 1:
        return example.system, example.initial_state()
    q, v = example.ensemble(count - 1)
    start = jax.vmap(lambda q, v: nhjax.initial_state(example.system, q, v))
    return example.system, start(q, v)


def skates(n: int, k: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create a system with a diagonal mass matrix and k <= n / 2 constraints.

    L = ½ Σ μ_i v_i² - ½ |q|² and Φ_a = v_a - q_{n/2+a} v_{n/2+a+1}. The constraints are
    like constraints of skates, each of which steers the next.
    """
    half = n // 2
    masses = np.linspace(1.0, 2.0, n)

    def lagrangian(t, q, v, args):
        return 0.5 * (v @ (masses * v)) - 0.5 * (q @ q)

    def constraint(t, q, v, args):
        second, following = q[half:], jnp.roll(v[half:], -1)
        return v[:k] - second[:k] * following[:k]

    q, v = np.cos(np.arange(n)), 0.5 * np.sin(2.0 * np.arange(n))
    v[:k] = q[half : half + k] * np.roll(v[half:], -1)[:k]
    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=constraint)
    return system, nhjax.initial_state(system, jnp.asarray(q), jnp.asarray(v))


def chain(n: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create a chain of n links at rest, with rods in slightly different directions."""
    angles = tuple(0.5 + 0.3 * np.sin(np.arange(n)))
    example = systems.PendulumChain.swinging(angles)
    return example.system, example.initial_state()


def star(n: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create a free body with n masses on rods, which turn about the body."""

    def lagrangian(t, q, v, args):
        return 0.5 * v @ v - 9.81 * jnp.sum(q[1::2])

    def rods(t, q, args):
        places = q.reshape(-1, 2)
        return jnp.sum((places[1:] - places[:1]) ** 2, axis=1) - 1.0

    angles = np.linspace(0.1, 3.0, n)
    cos, sin = np.cos(angles), np.sin(angles)
    q = np.concatenate([np.zeros(2), np.stack([cos, sin], 1).reshape(-1)])
    v = np.concatenate([np.zeros(2), np.stack([-sin, cos], 1).reshape(-1)])
    system = nhjax.LagrangianSystem(lagrangian, holonomic=rods)
    return system, nhjax.initial_state(system, jnp.asarray(q), jnp.asarray(v))


def axes(smoke: bool) -> list[Axis]:
    """Return the axes that are measured."""
    stages = [2, 3] if smoke else list(range(2, 9))
    masses = [3, 5] if smoke else [2, 3, 5, 10, 20, 35, 50]
    constraints = [1, 2] if smoke else [1, 2, 5, 10, 20]
    links = [10, 20] if smoke else [10, 20, 30, 60, 100]
    batches = [1, 10] if smoke else [1, 10, 100, 10**3, 10**4, 10**5]
    steps = [5, 10] if smoke else [10, 100, 10**3, 10**4, 10**5]
    num_steps = 10 if smoke else 200
    n = 2 * max(constraints)
    return [
        Axis(
            "s",
            "number of stages s",
            [Problem(s, *chaotic(3), stages=s, num_steps=num_steps) for s in stages],
            fitted_from=2,
        ),
        Axis(
            "n",
            "number of coordinates n",
            [Problem(2 * m + 1, *chaotic(m), num_steps=num_steps) for m in masses],
            fitted_from=7,
        ),
        Axis(
            "k",
            f"number of constraints, n = {n}",
            [Problem(k, *skates(n, k), num_steps=num_steps) for k in constraints],
            fitted_from=1,
        ),
        *(
            Axis(
                name,
                label,
                [
                    Problem(
                        n, *family(n), num_steps=max(10, 20 * num_steps // n), h=1e-3
                    )
                    for n in links
                ],
                fitted_from=10,
            )
            for name, label, family in (
                ("chain", "links of a chain, C tridiagonal", chain),
                ("star", "rods of a star, C full", star),
            )
        ),
        Axis(
            "batch",
            "members of a batch",
            [
                Problem(
                    count,
                    *members_of(count),
                    members=count,
                    # The largest batches take few steps, to finish within minutes.
                    num_steps=max(min(num_steps, 2 * 10**5 // count), 3),
                )
                for count in batches
            ],
            fitted_from=1,
        ),
        Axis(
            "N",
            "number of steps N",
            [Problem(count, *chaotic(3), num_steps=count) for count in steps],
            # In shorter runs, the overhead of a call would dominate.
            fitted_from=steps[0] if smoke else 10**3,
        ),
    ]


def run(problem: Problem) -> Callable[[nhjax.State], tuple[Any, Array]]:
    """Return the run of a problem, as a function of the initial state."""

    def one(y0: nhjax.State) -> tuple[Any, Array]:
        sol = nhjax.integrate(
            problem.system,
            nhjax.LobattoIIIAB(problem.stages),
            y0,
            dt=problem.h,
            num_steps=problem.num_steps,
            throw=False,
        )
        counts = sol.stats["num_iterations"], sol.stats["num_steps"]
        return sol.ys, jnp.stack(counts)

    return one if problem.members == 1 else jax.vmap(one)


def measure(axis: Axis) -> list[dict[str, Any]]:
    """Measure the compile time, time and iterations of each problem of an axis."""
    programs, rows = [], []
    for problem in axis.problems:
        jax.clear_caches()
        before = time.perf_counter()
        program = jax.jit(run(problem)).lower(problem.start).compile()
        row = {"size": problem.size, "compile": time.perf_counter() - before}
        _, counts = jax.block_until_ready(program(problem.start))
        iterations, num_steps = np.asarray(counts).reshape(-1, 2).T
        if np.any(num_steps != problem.num_steps):
            raise RuntimeError(f"A step fails for {axis.name} = {problem.size}.")
        row["iterations"] = float(np.mean(iterations / num_steps))
        programs.append(program)
        rows.append(row | {"num_steps": problem.num_steps, "times": []})
    for _ in range(REPEATS):
        for problem, program, row in zip(axis.problems, programs, rows, strict=True):
            before = time.perf_counter()
            jax.block_until_ready(program(problem.start))
            row["times"].append(time.perf_counter() - before)
    for problem, row in zip(axis.problems, rows, strict=True):
        seconds = statistics.median(row["times"])
        row["step"] = 1e6 * seconds / problem.num_steps
        row["least"] = 1e6 * min(row["times"]) / problem.num_steps
        row["sweep"] = row["step"] / row["iterations"]
    return rows


def exponents(axis: Axis, rows: list[dict[str, Any]], key: str) -> dict[str, float]:
    """Compute the slope from the first to the last point, and the slope of a fit."""
    used = [row for row in rows if row["size"] >= axis.fitted_from]
    x = np.log([row["size"] for row in used])
    y = np.log([row[key] for row in used])
    return {
        "ends": float((y[-1] - y[0]) / (x[-1] - x[0])),
        "fitted": float(np.polyfit(x, y, 1)[0]),
    }


def table(axis: Axis, rows: list[dict[str, Any]]) -> str:
    """Write the table of an axis; a local slope is the slope from the line above."""
    lines = []
    for k, row in enumerate(rows):
        before = rows[k - 1]
        slope = (
            math.log(row["step"] / before["step"])
            / math.log(row["size"] / before["size"])
            if k
            else math.nan
        )
        line = [str(row["size"]), str(row["num_steps"]), f"{row['compile']:.2f}"]
        line += [f"{row['step']:.1f}", f"{row['least']:.1f}"]
        line.append(f"{slope:.2f}" if k else "")
        if axis.name == "batch":
            line.append(f"{row['step'] / row['size']:.2f}")
        lines.append([*line, f"{row['iterations']:.2f}", f"{row['sweep']:.2f}"])
    header = [axis.name, "steps", "compile [s]", "step [µs]", "least", "local slope"]
    if axis.name == "batch":
        header.append("step / member [µs]")
    header += ["iterations / step", "step / iteration [µs]"]
    return markdown_table(header, lines)


def summary(measured: list[tuple[Axis, list[dict[str, Any]]]]) -> str:
    """Write the table of exponents."""
    lines = []
    for axis, rows in measured:
        line = [axis.name, f"{axis.fitted_from} to {rows[-1]['size']}"]
        for key in ("step", "least"):
            line += [f"{slope:.2f}" for slope in exponents(axis, rows, key).values()]
        lines.append([*line, f"{exponents(axis, rows, 'compile')['fitted']:.2f}"])
    header = ["axis", "range", "ends", "fitted", "ends, least", "fitted, least"]
    return markdown_table([*header, "compile time, fitted"], lines)


def draw(measured: list[tuple[Axis, list[dict[str, Any]]]], path: Path) -> None:
    """Plot the time of a step along each axis, and the compile times of all axes."""
    figure = Figure(figsize=(14, 6), layout="constrained")
    panels = figure.subplots(2, 4).ravel()
    for k, (ax, (axis, rows)) in enumerate(zip(panels, measured, strict=False)):
        x = np.array([row["size"] for row in rows], float)
        y = np.array([row["step"] for row in rows])
        least = [row["least"] for row in rows]
        ax.loglog(x, least, ":", color=f"C{k}", linewidth=1)
        ax.loglog(x, y, "o-", color=f"C{k}", markersize=4, linewidth=1)
        slope = exponents(axis, rows, "step")["fitted"]
        ax.set_title(f"exponent {slope:.2f}", fontsize="medium")
        ax.set_xlabel(axis.label)
        ax.set_ylabel("µs per step")
        panels[-1].semilogx(
            x / x[0],
            [row["compile"] for row in rows],
            "o-",
            color=f"C{k}",
            markersize=4,
            linewidth=1,
            label=axis.name,
        )
    panels[-1].set_xlabel("size over the smallest")
    panels[-1].set_ylabel("compile time [s]")
    panels[-1].set_ylim(bottom=0)
    panels[-1].legend(fontsize="small")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print and save the tables and the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--axes", nargs="+", help="some alone, and not saved")
    parser.add_argument("--smoke", action="store_true", help="little, and not saved")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # The first compilation of a process also starts the compiler, and is not measured.
    jax.jit(jnp.sin).lower(1.0).compile()
    measured = []
    for axis in axes(options.smoke):
        if options.axes is None or axis.name in options.axes:
            measured.append((axis, measure(axis)))
            print(table(*measured[-1]), end="\n\n", flush=True)
    sections = [f"Chaotic system, s = {STAGES}, h = {H}, but for what varies."]
    sections.append(summary(measured))
    sections += [f"{axis.label}:\n\n{table(axis, rows)}" for axis, rows in measured]
    text = "\n\n".join(sections)
    if options.smoke or options.axes is not None:
        print(text)
        return
    data = {
        axis.name: {
            "rows": rows,
            **{
                key: exponents(axis, rows, key)
                for key in ("step", "least", "sweep", "compile")
            },
        }
        for axis, rows in measured
    }
    write("scaling", "How the cost of a step grows", text, data)
    draw(measured, RESULTS / "scaling.png")


if __name__ == "__main__":
    main()
