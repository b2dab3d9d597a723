"""Iterations and time per step of machines, with the default and the full Jacobian.

For each machine `SimplifiedNewton` without the fallback runs 20 steps, once with the
default Jacobian, which omits some terms, and once with `jacobian="full"`. The table has
the iterations and the time of a step, the processor time of the first call, and the
largest step size with which all steps are solved, found to within a factor of 1.2.
`benchmarks.machines` measures the first calls of all machines with default options.

A second table compares `Newton` with `SimplifiedNewton(jacobian="full")` on some of the
machines. A third table compares the times of runs whose steps are just small enough
for an error of 1e-6 at the end.

    python -m benchmarks.iterations
    python -m benchmarks.iterations --only newton
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems

from ._report import end_of, least_time, markdown_table, RESULTS, write


NUM_STEPS = 20
REPEATS = 20
# The rows of the table with Newton's method: names and numbers of stages.
BY_NEWTON = (
    ("NonholonomicParticle", 3),
    ("FourBar", 3),
    ("BallInBowl", 3),
    ("Rattleback", 3),
    ("RollingTorus", 3),
    ("bicycle, 4.6 m/s", 4),
)
# The largest step is searched for up to this multiple of the step of the case.
LARGEST_FACTOR = 32
STEP_RATIO = 1.2
RADIUS, LENGTH, TRACK = 0.1, 0.35, 0.5
# The runs of the third table: their length, the largest error at the end, the number of
# members in a batch, and the factor between the tried numbers of steps.
DURATION, LARGEST_ERROR, MEMBERS, COUNT_RATIO = 20.0, 1e-6, 64, 1.25


class Case(NamedTuple):
    """A machine, its start and arguments, the number of stages and the step size."""

    name: str
    system: Any
    y0: nhjax.State
    args: Any
    stages: int
    dt: float


def balancing_robot() -> tuple[Any, nhjax.State, Any]:
    """An inverted pendulum on two wheels, balanced by motors with feedback."""

    def centre(q):
        ahead = LENGTH * jnp.sin(q[3])
        x, y = q[0] + ahead * jnp.cos(q[2]), q[1] + ahead * jnp.sin(q[2])
        return jnp.stack([x, y, LENGTH * jnp.cos(q[3])])

    def lagrangian(t, q, v, args):
        _, velocity = jax.jvp(centre, (q,), (v,))
        spin = jnp.stack([-v[2] * jnp.sin(q[3]), v[3], v[2] * jnp.cos(q[3])])
        moments = jnp.array([0.05, 0.04, 0.03])
        kinetic = 3.0 * velocity @ velocity + 0.5 * spin @ (moments * spin)
        kinetic += 0.75 * (v[0] ** 2 + v[1] ** 2) + 0.05 * v[2] ** 2
        kinetic += 0.001 * (v[4] ** 2 + v[5] ** 2)
        return kinetic - 9.81 * 6.0 * centre(q)[2]

    def rolling(t, q, v, args):
        across = v[1] * jnp.cos(q[2]) - v[0] * jnp.sin(q[2])
        along = v[0] * jnp.cos(q[2]) + v[1] * jnp.sin(q[2])
        turning = v[2] - RADIUS / TRACK * (v[5] - v[4])
        return jnp.stack([across, along - RADIUS / 2 * (v[4] + v[5]), turning])

    def motors(t, q, v, args):
        speed = RADIUS / 2 * (v[4] + v[5])
        torque = args[0] * q[3] + args[1] * v[3] + args[2] * speed
        zero = jnp.zeros_like(torque)
        return jnp.stack([zero, zero, zero, -2 * torque, torque + 0.1, torque - 0.1])

    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=rolling, force=motors)
    args = jnp.array([60.0, 12.0, 4.0])
    q = jnp.array([0, 0, 0.1, 0.05, 0, 0])
    v = jnp.array([0, 0, 0, 0, 0.5, 0.5])
    return system, nhjax.initial_state(system, q, v, args=args, project=True), args


def cases() -> Iterator[Case]:
    """Machines with their stages and steps, and two textbook systems."""
    robot = balancing_robot()
    for dt in (0.01, 0.05):
        yield Case("balancing robot", *robot, 3, dt)
    bicycles = {
        "bicycle, 4.6 m/s": systems.WhippleBicycle.running(4.6, lean_rate=0.5),
        "bicycle, 8 m/s": systems.WhippleBicycle.running(8.0, lean_rate=0.05),
    }
    others = [
        (systems.FourBar(), 0.02),
        (systems.BallInBowl(), 0.05),
        (systems.Rattleback(), 0.01),
        (systems.RollingTorus(), 0.1),
        (systems.NonholonomicParticle(), 0.1),
        (systems.ChaoticSystem(), 0.1),
    ]
    for example, dt in others:
        y0, name = example.initial_state(), type(example).__name__
        yield Case(name, example.system, y0, None, 3, dt)
    for name, example in bicycles.items():
        for stages, dt in ((3, 0.05), (4, 0.1)):
            yield Case(name, example.system, example.initial_state(), None, stages, dt)


def timed(case: Case, solver: Any) -> tuple[Callable[..., Any], dict[str, Any]]:
    """Run a case with a solver; return the program, its iterations and its times."""

    @jax.jit
    def run(y0, dt):
        return nhjax.integrate(
            case.system,
            nhjax.LobattoIIIAB(case.stages),
            y0,
            dt=dt,
            num_steps=NUM_STEPS,
            args=case.args,
            stage_solver=solver,
            throw=False,
        )

    begin = time.process_time()
    sol = jax.block_until_ready(run(case.y0, jnp.asarray(case.dt)))
    first_call = time.process_time() - begin
    best = np.inf
    for _ in range(REPEATS):
        begin = time.perf_counter()
        jax.block_until_ready(run(case.y0, jnp.asarray(case.dt)))
        best = min(best, time.perf_counter() - begin)
    steps = int(sol.stats["num_steps"])
    return run, {
        "solved": bool(sol.result == nhjax.RESULTS.successful),
        "iterations": float(sol.stats["num_iterations"]) / max(steps, 1),
        "us": best / NUM_STEPS * 1e6,
        "first_call": first_call,
    }


def simplified(jacobian: Any) -> nhjax.SimplifiedNewton:
    """Create the solver with a choice of the Jacobian."""
    return nhjax.SimplifiedNewton(jacobian=jacobian, fallback=False)


def measured(case: Case, solver: Any) -> dict[str, Any]:
    """Run a case with a solver, and search for the largest step."""
    run, found = timed(case, solver)

    def is_solved(dt):
        return run(case.y0, jnp.asarray(dt)).result == nhjax.RESULTS.successful

    # The search reduces the step until it is solved. Then it increases the step until
    # the next larger step is not solved.
    largest, most = case.dt, LARGEST_FACTOR * case.dt
    while not is_solved(largest) and largest > case.dt / LARGEST_FACTOR:
        largest /= STEP_RATIO
    while largest * STEP_RATIO <= most and is_solved(largest * STEP_RATIO):
        largest *= STEP_RATIO
    return found | {"largest": largest}


def machines_table(names: list[str] | None) -> list[dict[str, Any]]:
    """Measure the default and the full Jacobian on all machines."""
    data = []
    for case in cases():
        if names and not any(name in case.name for name in names):
            continue
        found = [measured(case, simplified(jacobian)) for jacobian in (None, "full")]
        about = {"name": case.name, "stages": case.stages, "dt": case.dt}
        data.append(about | dict(zip(("default", "full"), found, strict=True)))
        print(data[-1], flush=True)
        jax.clear_caches()
    return data


def newton_table(names: list[str] | None) -> list[dict[str, Any]]:
    """Measure Newton's method and the full Jacobian on some machines."""
    data = []
    solvers = {"newton": nhjax.Newton(), "full": simplified("full")}
    for case in cases():
        if (case.name, case.stages) not in BY_NEWTON:
            continue
        if names and not any(name in case.name for name in names):
            continue
        about = {"name": case.name, "stages": case.stages, "dt": case.dt}
        about |= {name: measured(case, solver) for name, solver in solvers.items()}
        data.append(about)
        print(about, flush=True)
        jax.clear_caches()
    return data


def machines_for_errors() -> Iterator[tuple[str, Any, nhjax.State, int]]:
    """Machines of the third table, with the first number of steps to try."""
    bicycle = systems.WhippleBicycle.running(4.6, lean_rate=0.5)
    torus, bars = systems.RollingTorus(), systems.FourBar()
    stone = systems.Rattleback.spinning(5.0, (0.5, 0.5))
    yield "bicycle, 4.6 m/s", bicycle.system, bicycle.initial_state(), 100
    yield "RollingTorus", torus.system, torus.initial_state(), 100
    yield "FourBar", bars.system, bars.initial_state(), 300
    yield "Rattleback", stone.system, stone.initial_state(), 4000


def errors_table(names: list[str] | None) -> list[dict[str, Any]]:
    """Measure times to a given error with the default and the full Jacobian."""
    data = []
    for name, system, y0, first in machines_for_errors():
        if names and not any(part in name for part in names):
            continue
        fine = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(6),
            y0,
            t1=DURATION,
            stepsize_controller=nhjax.PIDController(1e-12, 1e-13),
            stage_solver=simplified("full"),
            max_steps=10**6,
        )
        exact = end_of(fine)
        found = {
            key: time_to_error(system, y0, first, exact, jacobian)
            for key, jacobian in (("default", None), ("full", "full"))
        }
        data.append({"name": name, **found})
        print(data[-1], flush=True)
        jax.clear_caches()
    return data


def time_to_error(
    system: Any, y0: nhjax.State, first: int, exact: np.ndarray, jacobian: Any
) -> dict[str, Any]:
    """Find the number of constant steps with the given error, and time such runs."""
    solver = simplified(jacobian)

    def integrate(y0, dt, count):
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(4),
            y0,
            dt=dt,
            num_steps=count,
            stage_solver=solver,
            throw=False,
        )

    run, batch = jax.jit(integrate), jax.jit(jax.vmap(integrate, (0, None, None)))
    starts = jax.tree.map(lambda x: jnp.broadcast_to(x, (MEMBERS, *x.shape)), y0)
    count = first
    while True:
        count = round(COUNT_RATIO * count)
        given = jnp.asarray(DURATION / count), jnp.asarray(count)
        sol = run(y0, *given)
        error = np.max(np.abs(end_of(sol) - exact))
        if error <= LARGEST_ERROR * np.max(np.abs(exact)):
            break
    # A batch takes only the first steps of a long run.
    num_first = min(count, 500)
    few = given[0], jnp.asarray(num_first)
    jax.block_until_ready(batch(starts, *few))
    return {
        "steps": count,
        "iterations": float(sol.stats["num_iterations"]) / count,
        "single": least_time(lambda: run(y0, *given), 5),
        "batch": least_time(lambda: batch(starts, *few), 3) * count / num_first,
    }


def pair(row: dict[str, Any], names: tuple[str, str], key: str, digits: str) -> str:
    """Format a quantity of two solvers; a run that is not solved is shown as failed."""
    shown = [
        format(row[name][key], digits)
        if row[name]["solved"] or key in ("first_call", "largest")
        else "fails"
        for name in names
    ]
    return " / ".join(shown)


def report(data: dict[str, list[dict[str, Any]]]) -> str:
    """Write both tables."""
    header = [
        "machine",
        "s",
        "h",
        "iterations a step",
        "time of a step, µs",
        "first call, s",
    ]
    columns = (("iterations", ".1f"), ("us", ".1f"), ("first_call", ".1f"))

    def cells(row, names):
        found = [row["name"], str(row["stages"]), f"{row['dt']:g}"]
        return found + [pair(row, names, *column) for column in columns]

    of_machines, by_newton = ("default", "full"), ("newton", "full")
    rows = [
        [*cells(row, of_machines), pair(row, of_machines, "largest", ".2g")]
        for row in data["rows"]
    ]
    text = (
        f"Default / full Jacobian, {NUM_STEPS} steps. Times of a step are the least of "
        f"{REPEATS} runs; first calls are times of the processor. Largest steps are "
        f"searched up to {LARGEST_FACTOR} h.\n\n"
    )
    text += markdown_table([*header, "largest step"], rows)
    rows = [
        [
            *cells(row, by_newton),
            f"{row['newton']['us'] / row['full']['us']:.1f}",
            pair(row, by_newton, "largest", ".2g"),
        ]
        for row in data["newton"]
    ]
    text += "\n\n## Newton's method\n\n`Newton()` / full Jacobian, measured alike.\n\n"
    text += markdown_table([*header, "ratio of the times", "largest step"], rows)
    text += (
        f"\n\n## Times to an error of {LARGEST_ERROR:g}\n\n"
        f"Default / full Jacobian, four stages, {DURATION:g} s, the fewest steps with "
        "this error at the end relative to the state, and the ratio of the times of "
        f"one run, and of {MEMBERS} equal members.\n\n"
    )
    both = "default", "full"
    rows = []
    for row in data["errors"]:
        line = [row["name"]]
        for key, scale, digits in (
            ("steps", 1, ".0f"),
            ("iterations", 1, ".1f"),
            ("single", 1e3, ".1f"),
            ("batch", 1e3, ".1f"),
        ):
            line.append(" / ".join(format(scale * row[x][key], digits) for x in both))
        line += [
            f"{row['full'][key] / row['default'][key]:.2f}"
            for key in ("single", "batch")
        ]
        rows.append(line)
    header = ["machine", "steps", "iterations a step", "one run, ms"]
    header += [f"{MEMBERS} members, ms", "ratio, one run", f"ratio, {MEMBERS} members"]
    return text + markdown_table(header, rows)


def main() -> None:
    """Print and save the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", help="a part of the names")
    tables = {"rows": machines_table, "newton": newton_table, "errors": errors_table}
    parser.add_argument(
        "--only", choices=tables, help="measure one table, and keep the others as saved"
    )
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    data = {}
    for name, table in tables.items():
        if given.only in (None, name):
            data[name] = table(given.systems)
        else:
            data[name] = json.loads((RESULTS / "iterations.json").read_text())[name]
    write("iterations", "Iterations of machines", report(data), data)


if __name__ == "__main__":
    main()
