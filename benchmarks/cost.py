"""Compile time and cost per step of the chaotic system, one trajectory and a batch.

Compile time is the time of the first call of `integrate`, which traces and compiles,
minus the time of a later call; it is the median of three. Run times are medians of
seven. The ratios compare times of the same run of this benchmark. Absolute times are
not comparable between machines.
"""

import argparse
import time

import equinox as eqx
import jax
import numpy as np

import nhjax
from nhjax import systems

from ._report import markdown_table, write


COMPILATIONS, REPEATS = 3, 7


def timed(function, *args) -> tuple[float, float]:
    """Return the compile time and the run time of a function, in seconds.

    The compile time is the time of a first call minus the time of a later call.
    """

    def once() -> float:
        start = time.perf_counter()
        jax.block_until_ready(eqx.filter(function(*args), eqx.is_array))
        return time.perf_counter() - start

    firsts = []
    for _ in range(COMPILATIONS):
        jax.clear_caches()
        firsts.append(once())
    run = float(np.median([once() for _ in range(REPEATS)]))
    return float(np.median(firsts)) - run, run


def measure(
    stages: int, solver: nhjax.AbstractStageSolver, members: int, num_steps: int
) -> tuple[float, float, float, float]:
    """Measure one trajectory and a batch.

    Returns the compile time in seconds and the time in µs per step of one trajectory,
    then the compile time of the batch and its time in µs per step and trajectory.
    """
    chaotic = systems.ChaoticSystem()
    system, method = chaotic.system, nhjax.LobattoIIIAB(stages)
    q, v = chaotic.ensemble(members)
    y0 = jax.vmap(lambda q, v: nhjax.initial_state(system, q, v))(q, v)

    def run(y0):
        return nhjax.integrate(
            system,
            method,
            y0,
            dt=0.1,
            num_steps=num_steps,
            stage_solver=solver,
            throw=False,
        )

    one = jax.tree.map(lambda x: x[0], y0)
    compile_one, run_one = timed(eqx.filter_jit(run), one)
    compile_all, run_all = timed(eqx.filter_jit(jax.vmap(run)), y0)
    per_step = 1e6 / num_steps
    return (
        compile_one,
        run_one * per_step,
        compile_all,
        run_all * per_step / q.shape[0],
    )


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stages", type=int, nargs="+", default=[2, 3, 4, 5, 6, 8])
    parser.add_argument("--members", type=int, default=100)
    parser.add_argument("--num-steps", type=int, default=200)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    solvers = (nhjax.SimplifiedNewton(), nhjax.Newton())
    # The first compilation of a process also starts the compiler, and is not measured.
    measure(2, solvers[0], 1, 2)
    rows, data = [], []
    for solver in solvers:
        base = None
        for stages in options.stages:
            figures = measure(stages, solver, options.members, options.num_steps)
            base = figures if base is None else base
            name = type(solver).__name__
            data.append({"solver": name, "stages": stages, "figures": figures})
            rows.append([name, str(stages)])
            for k, x in enumerate(figures):
                rows[-1].append(f"{x:.2f}")
                if k in (0, 2):
                    rows[-1].append(f"{x / base[k]:.2f}")
            print(*rows[-1], sep="\t", flush=True)
    header = ["solver", "s", "compile one [s]", "ratio to first", "one [µs/step]"]
    header += ["compile batch [s]", "ratio to first", "batch [µs/step/trajectory]"]
    text = f"Batch of {options.members + 1}.\n\n" + markdown_table(header, rows)
    write("cost", "Compile time and cost per step", text, {"rows": data})


if __name__ == "__main__":
    main()
