"""What a step costs against the number of constraints, for a chain and for a star.

A chain of pendula has n holonomic constraints, each of which shares coordinates with
two others: C = B M⁻¹ Bᵀ is tridiagonal. The masses of a star hang on rods from one
body, so that C is full. Times are those of the processor on one core, the least of
five runs, compiling apart; slopes are those in logarithms from the line before, and
from the first to the last. `--smoke` takes a minute.
"""

import argparse
import math
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems

from ._report import markdown_table, write


H, STAGES, REPEATS = 1e-3, 3, 5


def chain(n: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """A chain of n links at rest, whose rods point in slightly different directions."""
    angles = tuple(0.5 + 0.3 * np.sin(np.arange(n)))
    example = systems.PendulumChain.swinging(angles)
    return example.system, example.initial_state()


def star(n: int) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """A free body with n masses on rods, which turn about it."""

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


def measure(system: nhjax.LagrangianSystem, start: nhjax.State) -> dict[str, Any]:
    """Compile time, time of a step and iterations."""
    n = start.multiplier.shape[0]
    num_steps = max(10, min(2000, 40_000 // n**2))

    def run(y0: nhjax.State) -> Any:
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(STAGES),
            y0,
            dt=H,
            num_steps=num_steps,
            throw=False,
        )
        return sol.ys, sol.stats["num_iterations"], sol.stats["num_steps"]

    before = time.process_time()
    program = jax.jit(run).lower(start).compile()
    compiled = time.process_time() - before
    _, iterations, done = jax.block_until_ready(program(start))
    times = []
    for _ in range(REPEATS):
        before = time.process_time()
        jax.block_until_ready(program(start))
        times.append(time.process_time() - before)
    if int(done) != num_steps:
        raise RuntimeError(f"A step fails for {n} constraints.")
    return {
        "n": n,
        "compile": compiled,
        "step": 1e6 * min(times) / num_steps,
        "iterations": float(iterations) / num_steps,
        "engine": nhjax.engines(run, start)[-1].engine,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The figures of a family."""
    lines = []
    for k, row in enumerate(rows):
        line = [str(row["n"]), f"{row['compile']:.1f}", f"{row['step']:.1f}"]
        line.append(f"{slope(rows[k - 1], row):.2f}" if k else "")
        lines.append([*line, f"{row['iterations']:.2f}", row["engine"]])
    header = ["n", "compile [s]", "step [µs]", "slope", "iterations / step", "engine"]
    overall = f"From the first line to the last: {slope(rows[0], rows[-1]):.2f}."
    return f"{markdown_table(header, lines)}\n\n{overall}"


def slope(first: dict[str, Any], last: dict[str, Any]) -> float:
    """The slope between two lines in logarithms."""
    return math.log(last["step"] / first["step"]) / math.log(last["n"] / first["n"])


def main() -> None:
    """Print and save the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--smoke", action="store_true", help="little, and not saved")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    # The first compilation of a process pays for starting the compiler.
    jax.jit(jnp.sin).lower(1.0).compile()
    sizes = [4, 10] if options.smoke else [10, 20, 30, 60, 100]
    families = {"chain": chain, "star": star}
    rows = {
        name: [measure(*family(n)) for n in sizes] for name, family in families.items()
    }
    sections = [f"s = {STAGES}, h = {H}, time of the processor."]
    sections += [f"{name}:\n\n{table(found)}" for name, found in rows.items()]
    text = "\n\n".join(sections)
    if options.smoke:
        print(text)
        return
    write("constraints", "How the cost of a step grows with constraints", text, rows)


if __name__ == "__main__":
    main()
