"""The bicycle of the IFToMM benchmark problems: the largest accepted steps, and times.

The bicycle of Meijaard et al. (2007) runs uncontrolled for 20 s, in three
manoeuvres: M1 at 4 m/s with a roll rate of 0.05 rad/s, M2 at 4.6 m/s with 0.5 rad/s,
and M3 at 8 m/s with 0.05 rad/s. A solution is accepted if its energy varies by less
than a thousandth of a percent of the energy at the start, 100 (max E - min E) / E_0
< 1e-3, evaluated after each step. The height in the energy is measured from the ground.

For each manoeuvre and number of stages, the table has the smallest number of steps that
is accepted, its error at the end and its time, with the full Jacobian and with the
default one. The error is the largest error of a coordinate or a velocity, relative to
the largest value that it has during the run. The reference is a run with more stages
and small steps.

    python -m benchmarks.bicycle
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems

from ._report import markdown_table, number, write


DURATION = 20.0
LARGEST_DRIFT = 1e-3
STAGES = (2, 3, 4)
# The steps of the reference are so small that the default Jacobian suffices.
REFERENCE_STAGES, REFERENCE_STEPS = 5, 4000
REPEATS = 20
# Larger numbers of steps are not tried.
MOST_STEPS = 2**14
# The time of the program Exudyn for M2 on an i9-7940X, published by its authors.
EXUDYN_SECONDS = 0.596


class Manoeuvre(NamedTuple):
    """The name of a manoeuvre, its speed in m/s and its roll rate in rad/s."""

    name: str
    speed: float
    lean_rate: float

    def start(self) -> nhjax.State:
        """Return the upright bicycle that rolls."""
        given = self.speed, self.lean_rate
        return systems.WhippleBicycle.running(*given).initial_state()


MANOEUVRES = (
    Manoeuvre("M1", 4.0, 0.05),
    Manoeuvre("M2", 4.6, 0.5),
    Manoeuvre("M3", 8.0, 0.05),
)


class Run(NamedTuple):
    """The times, states and energies after each step, and whether all were solved."""

    states: np.ndarray
    energies: np.ndarray
    solved: bool
    iterations: float

    @property
    def drift(self) -> float:
        """Return how much the energy varies, in percent of the energy at the start."""
        if not self.solved:
            return np.inf
        return 100 * np.ptp(self.energies) / self.energies[0]

    @property
    def is_accepted(self) -> bool:
        """Return whether the benchmark accepts the solution."""
        return self.drift < LARGEST_DRIFT

    def error(self, reference: "Run") -> float:
        """Return the error at the end, relative to the sizes during the reference."""
        sizes = np.max(np.abs(reference.states), axis=0)
        return np.max(np.abs(self.states[-1] - reference.states[-1]) / sizes)


class Integrator:
    """Runs of the bicycle with one method and solver, which share a program."""

    def __init__(self, stages: int, jacobian: Any):
        self.system = systems.WhippleBicycle.running().system
        self.method = nhjax.LobattoIIIAB(stages)
        self.solver = nhjax.SimplifiedNewton(jacobian=jacobian, fallback=False)

        @jax.jit
        @jax.vmap
        def energies(t, y):
            return self.system.energy(t, y, None)

        self.energies = energies

    def solution(self, y0: nhjax.State, num_steps: int) -> nhjax.Solution:
        """Integrate for the time of the benchmark, and save each step."""
        sol = nhjax.integrate(
            self.system,
            self.method,
            y0,
            dt=DURATION / num_steps,
            num_steps=num_steps,
            saveat=nhjax.SaveAt(t0=True, steps=True),
            stage_solver=self.solver,
            throw=False,
        )
        return jax.block_until_ready(sol)

    def run(self, y0: nhjax.State, num_steps: int) -> Run:
        """Integrate, and compute the energy after each step."""
        sol = self.solution(y0, num_steps)
        return Run(
            np.asarray(jnp.concatenate([sol.ys.q, sol.ys.v], axis=1)),
            np.asarray(self.energies(sol.ts, sol.ys)),
            bool(sol.result == nhjax.RESULTS.successful),
            float(sol.stats["num_iterations"]) / num_steps,
        )

    def seconds(self, y0: nhjax.State, num_steps: int) -> float:
        """Return the least time of some runs, after compilation."""
        best = np.inf
        for _ in range(REPEATS):
            begin = time.perf_counter()
            self.solution(y0, num_steps)
            best = min(best, time.perf_counter() - begin)
        return best


def fewest_steps(is_accepted: Callable[[int], bool], most: int) -> int | None:
    """Find the smallest accepted number of steps, or None if it exceeds `most`.

    The number is doubled until it is accepted, and then bisected.
    """
    refused, accepted = 4, 8
    while not is_accepted(accepted):
        refused, accepted = accepted, 2 * accepted
        if accepted > most:
            return None
    while accepted - refused > 1:
        middle = (accepted + refused) // 2
        if is_accepted(middle):
            accepted = middle
        else:
            refused = middle
    return accepted


def measured(
    integrator: Integrator, y0: nhjax.State, reference: Run
) -> dict[str, Any] | None:
    """Measure the accepted run with the fewest steps."""
    steps = fewest_steps(lambda n: integrator.run(y0, n).is_accepted, MOST_STEPS)
    if steps is None:
        return None
    run = integrator.run(y0, steps)
    return {
        "steps": steps,
        "dt": DURATION / steps,
        "drift": run.drift,
        "error": run.error(reference),
        "iterations": run.iterations,
        "seconds": integrator.seconds(y0, steps),
    }


def main() -> None:
    """Print and save the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)
    starts = {one.name: one.start() for one in MANOEUVRES}
    fine = Integrator(REFERENCE_STAGES, None)
    references = {name: fine.run(y0, REFERENCE_STEPS) for name, y0 in starts.items()}
    for name, one in references.items():
        print("reference", name, one.solved, one.drift, flush=True)
    jax.clear_caches()
    rows, data = [], []
    for stages in STAGES:
        for jacobian in ("full", None):
            integrator = Integrator(stages, jacobian)
            begin = time.perf_counter()
            integrator.solution(starts["M2"], 8)
            first_call = time.perf_counter() - begin
            for name, y0 in starts.items():
                found = measured(integrator, y0, references[name])
                about = {"name": name, "stages": stages}
                about |= {"jacobian": jacobian or "default", "first_call": first_call}
                data.append(about | (found or {"steps": None}))
                print(data[-1], flush=True)
            jax.clear_caches()
    for row in sorted(data, key=lambda row: (row["name"], row["stages"])):
        cells = [row["name"], str(row["stages"]), row["jacobian"]]
        if row["steps"] is None:
            cells += ["none", *[""] * 5]
        else:
            cells += [str(row["steps"]), f"{row['dt']:.3g}", number(row["drift"])]
            cells += [number(row["error"]), f"{row['iterations']:.1f}"]
            cells += [f"{1e3 * row['seconds']:.1f}"]
        rows.append([*cells, f"{row['first_call']:.0f}"])
    header = [
        "manoeuvre",
        "s",
        "Jacobian",
        "steps",
        "h, s",
        "energy varies, %",
        "error at the end",
        "iterations a step",
        "time, ms",
        "first call, s",
    ]
    fastest = min(
        (row for row in data if row["name"] == "M2" and row["steps"]),
        key=lambda row: row["seconds"],
    )
    text = (
        f"Runs of {DURATION:g} s with the fewest steps that the benchmark accepts, on "
        f"one core, or none if that takes more than {MOST_STEPS} steps. Times are the "
        f"least of {REPEATS} runs, with each step saved; first calls are times on the "
        "clock, and the three manoeuvres share their program.\n\n"
        + markdown_table(header, rows)
        + "\n\nThe fastest accepted run of M2 takes "
        f"{1e3 * fastest['seconds']:.0f} ms. Exudyn publishes {EXUDYN_SECONDS} s for "
        "M2, on another machine (i9-7940X)."
    )
    write("bicycle", "The bicycle of the IFToMM benchmark", text, {"rows": data})


if __name__ == "__main__":
    main()
