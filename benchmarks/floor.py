"""A comparison of nhjax with the same algorithm written by hand in C++.

`floor.cpp` solves the chaotic system, s = 3, like `SimplifiedNewton`: with the same
unknowns, starting values, factorised structure, order of corrections and stopping rule.
Its derivatives are written by hand. Quantities that do not change during the iterations
are computed once. A second version iterates 2, 4 or 8 trajectories at once, in the
lanes of a vector, until the slowest of them has converged. The C++
program counts iterations, but no other statistics.

Both programs run on one core, if the platform can pin a process to a core. The table
also has nhjax on all cores. Times are medians of seven measurements, with C++ and
nhjax in turn; each measurement is the second of two successive runs. Both programs must
end in the same states. `--smoke` takes a minute.
"""

import argparse
import contextlib
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nhjax
from nhjax import systems

from ._report import markdown_table, number, write


H, STAGES, REPEATS, AGREE_AT = 0.1, 3, 7, 20.0
FLAGS = ["-O3", "-march=native", "-std=c++17"]
SOURCE = Path(__file__).with_suffix(".cpp")
LANES = (1, 2, 4, 8)
STATE = 21  # the number of entries of q, v and p together


class Case(NamedTuple):
    """A number of trajectories that run together, and their steps."""

    name: str
    members: int
    num_steps: int
    lanes: tuple[int, ...]


class Run(NamedTuple):
    """Seconds of a run, iterations of each trajectory, and the states at the end."""

    seconds: float
    iterations: np.ndarray
    ends: np.ndarray


def compiled(folder: Path) -> tuple[list[str], Path] | None:
    """Compile the C++ program; return the command and the program.

    Returns None if there is no C++ compiler.
    """
    for name in ("c++", "g++", "clang++"):
        compiler = shutil.which(name)
        if compiler is None:
            continue
        program = folder / "floor"
        command = [compiler, *FLAGS, str(SOURCE), "-o", str(program)]
        if subprocess.run(command, check=False).returncode == 0:
            return [name, *FLAGS], program
    return None


def initial_data(members: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Return the system and the initial states of a case."""
    chaotic = systems.ChaoticSystem()
    q, v = chaotic.ensemble(max(members - 1, 2))
    if members == 1:
        q, v = q[1:2], v[1:2]
    system = chaotic.system
    return system, jax.vmap(lambda q, v: nhjax.initial_state(system, q, v))(q, v)


@contextlib.contextmanager
def one_core(pinned: bool) -> Iterator[None]:
    """Run processes that start in this context on one core, the last one.

    Without `pinned`, or if the platform cannot pin processes, there is no effect.
    """
    if not (pinned and hasattr(os, "sched_setaffinity")):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def serve() -> None:
    """Run the case of each input line, in a process that keeps compiled programs."""
    programs: dict[tuple[int, int], tuple[Callable[..., Any], nhjax.State]] = {}
    for line in sys.stdin:
        members, num_steps, path = json.loads(line)
        key = (members, num_steps)
        if key not in programs:
            programs[key] = batch(members, num_steps)
        program, start = programs[key]
        jax.block_until_ready(program(start))
        before = time.perf_counter()
        ends, iterations = jax.block_until_ready(program(start))
        seconds = time.perf_counter() - before
        rows = np.asarray(iterations).reshape(-1, 1)
        np.save(path, np.hstack([np.asarray(ends).reshape(-1, STATE), rows]))
        print(seconds, flush=True)


def batch(members: int, num_steps: int) -> tuple[Callable[..., Any], nhjax.State]:
    """Return the compiled run of a case and its initial states.

    For one trajectory there is no batch axis.
    """
    system, start = initial_data(members)

    def run(y0: nhjax.State) -> tuple[Array, Array]:
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(STAGES),
            y0,
            dt=H,
            num_steps=num_steps,
            throw=False,
        )
        end = jax.tree.map(lambda leaf: leaf[-1], sol.ys)
        return jnp.concatenate([end.q, end.v, end.p]), sol.stats["num_iterations"]

    if members == 1:
        return jax.jit(run), jax.tree.map(lambda leaf: leaf[0], start)
    return jax.jit(jax.vmap(run)), start


class Worker:
    """A process that runs nhjax, on one core or on all."""

    def __init__(self, folder: Path, pinned: bool):
        """Start the process, which keeps its compiled programs until it is closed."""
        self.path = folder / f"end-{int(pinned)}.npy"
        with one_core(pinned):
            self.process = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.floor", "--serve"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )

    def run(self, members: int, num_steps: int) -> Run:
        """Run a case twice, and return the second run."""
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None
        assert stdout is not None
        print(json.dumps([members, num_steps, str(self.path)]), file=stdin, flush=True)
        reply = stdout.readline()
        if not reply:
            raise RuntimeError("The process that runs nhjax has ended.")
        rows = np.load(self.path)
        return Run(float(reply), rows[:, STATE], rows[:, :STATE])

    def close(self) -> None:
        """End the process."""
        self.process.communicate()


class Program:
    """The compiled C++ program."""

    def __init__(self, path: Path, folder: Path):
        """Store the path of the program, and the folder of its input and output."""
        self.path, self.folder = path, folder

    def run(self, members: int, num_steps: int, lanes: int) -> tuple[Run, float]:
        """Run a case twice; return the second run, and the mean of a maximum.

        The maximum is the largest number of iterations of all trajectories in a step;
        its mean is over the steps.
        """
        start, end = self.folder / f"start-{members}.bin", self.folder / "end.bin"
        if not start.exists():
            _, y0 = initial_data(members)
            np.concatenate([y0.q, y0.v], axis=1).tofile(start)
        counts = [str(lanes), str(num_steps), str(H), "2"]
        with one_core(True):
            done = subprocess.run(
                [str(self.path), *counts, str(start), str(end)],
                stdout=subprocess.PIPE,
                check=True,
                text=True,
            )
        numbers = np.fromfile(end)
        rows = numbers[: members * (STATE + 1)].reshape(members, STATE + 1)
        seconds = float(done.stdout.split()[-1])
        most = float(np.mean(numbers[rows.size :]))
        return Run(seconds, rows[:, STATE], rows[:, :STATE]), most


def measure(
    cases: list[Case], workers: dict[str, Worker], program: Program | None
) -> list[dict[str, Any]]:
    """Measure all cases with all programs."""
    times: list[dict[str, list[float]]] = [{} for _ in cases]
    iterations: list[dict[str, float]] = [{} for _ in cases]
    most = [0.0 for _ in cases]

    def keep(k: int, key: str, run: Run) -> None:
        case = cases[k]
        per_step = 1e6 / (case.num_steps * case.members)
        times[k].setdefault(key, []).append(run.seconds * per_step)
        iterations[k][key] = float(np.mean(run.iterations)) / case.num_steps

    for _ in range(REPEATS):
        for k, case in enumerate(cases):
            for key, worker in workers.items():
                keep(k, key, worker.run(case.members, case.num_steps))
            if program is None:
                continue
            for lanes in case.lanes:
                run, most[k] = program.run(case.members, case.num_steps, lanes)
                keep(k, f"C++, {lanes}", run)
    rows = []
    for k, case in enumerate(cases):
        medians = {key: statistics.median(kept) for key, kept in times[k].items()}
        row: dict[str, Any] = case._asdict() | {"micros": medians}
        row |= {"times": times[k], "iterations": iterations[k]}
        if program is not None:
            floors = [key for key in medians if key not in workers]
            best = min(floors, key=medians.__getitem__)
            row |= {"best": best, "most_iterations": most[k]}
            row["difference"] = difference(case, workers, program)
        rows.append(row)
    return rows


def difference(case: Case, workers: dict[str, Worker], program: Program) -> float:
    """Return the largest difference between states of C++ and nhjax at one time."""
    num_steps = round(AGREE_AT / H)
    ends = next(iter(workers.values())).run(case.members, num_steps).ends
    others = [program.run(case.members, num_steps, lanes)[0] for lanes in case.lanes]
    return max(float(np.max(np.abs(other.ends - ends))) for other in others)


def report(rows: list[dict[str, Any]]) -> str:
    """Write the tables."""
    lines, against = [], []
    for row in rows:
        micros, iterations = row["micros"], row["iterations"]
        for key, value in micros.items():
            lines.append([row["name"], key, f"{value:.3f}", f"{iterations[key]:.2f}"])
        if "best" not in row:
            continue
        floor, name = micros[row["best"]], row["best"]
        for key in micros:
            if key.startswith("C++"):
                continue
            fastest = min(row["times"][key]) / min(row["times"][name])
            line = [row["name"], key, name, f"{micros[key] / floor:.1f}"]
            line += [f"{fastest:.1f}", f"{iterations[key]:.2f}"]
            line += [f"{iterations[name]:.2f}", f"{row['most_iterations']:.1f}"]
            against.append([*line, number(row["difference"])])
    header = ["case", "program", "µs/step/trajectory", "iterations/step"]
    sections = [markdown_table(header, lines)]
    if not against:
        sections.append("There is no C++ compiler here: nhjax's figures alone.")
        return "\n\n".join(sections)
    header = ["case", "nhjax on", "over", "ratio", "fastest"]
    header += [
        "iterations, nhjax",
        "C++",
        "most in a batch",
        f"difference at T = {AGREE_AT:.0f}",
    ]
    sections.append(markdown_table(header, against))
    sections.append(
        "`C++, k`: k trajectories at once, one in each lane of a vector, which iterate "
        "until the slowest of the k has converged, as those of nhjax do. "
        "`most in a batch` is the mean over the steps of the iterations of the slowest "
        "of all. `ratio` is that of the medians, `fastest` that of the fastest of "
        "seven, which what else runs on the machine disturbs less."
    )
    return "\n\n".join(sections)


def main() -> None:
    """Print and save the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, default=1000)
    parser.add_argument("--num-steps", type=int, default=1000, help="one trajectory")
    parser.add_argument("--batch-steps", type=int, default=200, help="the ensemble")
    parser.add_argument("--smoke", action="store_true", help="little, and not saved")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # Programs are compared on one core of a CPU, even if the machine has a GPU.
    jax.config.update("jax_platforms", "cpu")
    if options.serve:
        serve()
        return
    members, one_steps, batch_steps = (
        (20, 20, 20)
        if options.smoke
        else (options.members, options.num_steps, options.batch_steps)
    )
    cases = [
        Case("one", 1, one_steps, (1,)),
        Case(f"{members}", members, batch_steps, LANES),
    ]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        build = compiled(folder)
        program = None if build is None else Program(build[1], folder)
        names = {"one core": True, "all cores": False}
        if not hasattr(os, "sched_setaffinity"):
            names = {"all cores": False}
        workers = {key: Worker(folder, pinned) for key, pinned in names.items()}
        try:
            rows = measure(cases, workers, program)
        finally:
            for worker in workers.values():
                worker.close()
    command = "" if build is None else " ".join(build[0])
    steps = f"{one_steps} steps of one trajectory, {batch_steps} of {members}"
    text = f"Chaotic system, n = 7, s = {STAGES}, h = {H}; {steps}. {command}"
    text = "\n\n".join([text.strip(), report(rows)])
    if options.smoke:
        print(text)
        return
    write("floor", "nhjax over C++ by hand", text, {"compiler": command, "rows": rows})


if __name__ == "__main__":
    main()
