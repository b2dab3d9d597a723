"""Iterations and time a step of machines, with the default and the full Jacobian.

For each machine `SimplifiedNewton` without the fallback runs some steps, once with the
default part of the Jacobian and once with `jacobian="full"`. The table has the
iterations and the time of a step, the time of the processor of the first call, and the
largest step at which the run is solved, up to a factor 1.2. `benchmarks.machines` has
another quantity, the first calls of all machines with default options.

    python -m benchmarks.iterations
"""

import argparse
import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems

from ._report import markdown_table, write


NUM_STEPS = 20
REPEATS = 20
# Steps are searched up to this factor of the given one.
LARGEST_FACTOR = 32
STEP_RATIO = 1.2
RADIUS, LENGTH, TRACK = 0.1, 0.35, 0.5


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


def measured(case: Case, jacobian: Any) -> dict[str, Any]:
    """Run a case with a choice of the Jacobian."""
    solver = nhjax.SimplifiedNewton(jacobian=jacobian, fallback=False)

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

    def is_solved(dt):
        return run(case.y0, jnp.asarray(dt)).result == nhjax.RESULTS.successful

    solved = bool(is_solved(case.dt))
    steps = int(sol.stats["num_steps"])
    # The search goes up from a step that is solved, to the first that is not.
    largest, most = case.dt, LARGEST_FACTOR * case.dt
    while not is_solved(largest) and largest > case.dt / LARGEST_FACTOR:
        largest /= STEP_RATIO
    while largest * STEP_RATIO <= most and is_solved(largest * STEP_RATIO):
        largest *= STEP_RATIO
    return {
        "solved": solved,
        "iterations": float(sol.stats["num_iterations"]) / max(steps, 1),
        "us": best / NUM_STEPS * 1e6,
        "first_call": first_call,
        "largest": largest,
    }


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", help="a part of the names")
    names = parser.parse_args().systems
    jax.config.update("jax_enable_x64", True)
    rows, data = [], []
    for case in cases():
        if names and not any(name in case.name for name in names):
            continue
        found = [measured(case, jacobian) for jacobian in (None, "full")]
        cells = [
            " / ".join(one[key] if one["solved"] else "fails" for one in text)
            for key in ("iterations", "us")
            for text in [[{"solved": x["solved"], key: f"{x[key]:.1f}"} for x in found]]
        ]
        cells.append(" / ".join(f"{one['first_call']:.1f}" for one in found))
        cells.append(" / ".join(f"{one['largest']:.2g}" for one in found))
        row = [case.name, str(case.stages), f"{case.dt:g}", *cells]
        print(*row, sep="\t", flush=True)
        rows.append(row)
        about = {"name": case.name, "stages": case.stages, "dt": case.dt}
        data.append(about | dict(zip(("default", "full"), found, strict=True)))
        jax.clear_caches()
    header = [
        "machine",
        "s",
        "h",
        "iterations a step",
        "time of a step, µs",
        "first call, s",
        "largest step",
    ]
    text = (
        f"Default / full Jacobian, {NUM_STEPS} steps. Times of a step are the least of "
        f"{REPEATS} runs; first calls are times of the processor. Largest steps are "
        f"searched up to {LARGEST_FACTOR} h.\n\n"
    )
    text += markdown_table(header, rows)
    write("iterations", "Iterations of machines", text, {"rows": data})


if __name__ == "__main__":
    main()
