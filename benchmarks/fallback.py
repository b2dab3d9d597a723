"""The cost of `SimplifiedNewton(fallback=True)` in runs that never use the fallback.

Each system of the gallery is run with three stages, once with
`SimplifiedNewton(fallback=False)` and once with `fallback=True`. The steps are so small
that the run without the fallback solves all of them. With `fallback=True`, Newton's
method is therefore compiled, but never used. The table has the time to trace, lower and
compile each of the two runs, and the time of a step.

    python -m benchmarks.fallback
"""

import argparse
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import nhjax

from ._report import least_time, markdown_table, number, write
from .near_rest import examples


NUM_STEPS, DT, REPEATS = 200, 1e-3, 5
KINDS = ("compile", "step")


def measure(example: Any) -> dict[str, float]:
    """Measure one system with and without the fallback."""
    system, y0 = example.system, example.initial_state()
    found: dict[str, float] = {}
    dt = jnp.asarray(DT)
    for name, fallback in (("without", False), ("with", True)):
        solver = nhjax.SimplifiedNewton(fallback=fallback)

        def run(y0: nhjax.State, dt: Any, solver: Any = solver) -> Any:
            return nhjax.integrate(
                system,
                nhjax.LobattoIIIAB(3),
                y0,
                dt=dt,
                num_steps=NUM_STEPS,
                throw=False,
                stage_solver=solver,
            )

        start = time.process_time()
        compiled = jax.jit(run).lower(y0, dt).compile()
        found[f"compile {name}"] = time.process_time() - start
        # Andrews' squeezer needs shorter steps than the other systems.
        while not fallback and int(compiled(y0, dt).stats["num_steps"]) < NUM_STEPS:
            dt = dt / 10
        sol = compiled(y0, dt)
        seconds = least_time(partial(compiled, y0, dt), REPEATS)
        assert int(sol.stats["num_newton_steps"]) == 0
        steps = max(int(sol.stats["num_steps"]), 1)
        found[f"step {name}"] = 1e6 * seconds / steps
        jax.clear_caches()
    return found


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", help="names of systems")
    wanted = parser.parse_args().systems
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    rows, data = [], []
    for name, make in examples().items():
        if wanted and name not in wanted:
            continue
        row = measure(make())
        ratios = [row[f"{kind} with"] / row[f"{kind} without"] for kind in KINDS]
        print(name, row, flush=True)
        data.append({"system": name} | row)
        rows.append(
            [
                name,
                number(row["compile without"]),
                number(row["compile with"]),
                f"{ratios[0]:.1f}",
                number(row["step without"]),
                number(row["step with"]),
                f"{ratios[1]:.1f}",
            ]
        )
    compile_ratio, step_ratio = (
        float(np.median([row[f"{k} with"] / row[f"{k} without"] for row in data]))
        for k in KINDS
    )
    summary = (
        f"The median ratio is {compile_ratio:.1f} of compile times and "
        f"{step_ratio:.1f} of the times of a step."
    )
    header = ["system", "compile [s]", "with fallback [s]", "ratio"]
    header += ["step [µs]", "with fallback [µs]", "ratio"]
    parts = [(__doc__ or "").strip(), summary, markdown_table(header, rows)]
    text = "\n\n".join(parts)
    write("fallback", "Cost of the fallback to Newton's method", text, {"rows": data})


if __name__ == "__main__":
    main()
