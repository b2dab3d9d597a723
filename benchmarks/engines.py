"""A comparison of the two engines for ensembles on a CPU (see `nhjax.engines`).

One engine computes members in the lanes of vectors; the other runs a kernel for each
member. For every system of the gallery, and every kind of output or derivative, both
engines compile the same ensemble, and their runs alternate. Each member has its own
step size. Times are processor times, the least of seven runs. Compile times are the
times of tracing, lowering and compiling. The table also has the largest difference
between the results of the engines, relative to the largest number of its array, and the
number of members whose numbers of iterations differ.

    taskset -c 0 python -m benchmarks.engines --kinds end rows
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import SaveAt, systems

from ._report import markdown_table, write


ENGINES = ("kernels", "lanes")
REPEATS = 7
ADJOINTS = {
    "direct": nhjax.DirectAdjoint(),
    "checkpoints": nhjax.RecursiveCheckpointAdjoint(),
    "reversible": nhjax.ReversibleAdjoint(),
}
KINDS = ("end", "rows", "dense", "jvp", *ADJOINTS)
# Most examples have time scales of about one. The examples below move faster, and have
# shorter runs.
FINAL_TIMES = {
    "AndrewsSqueezer": 0.01,
    "BallInBowl": 1.0,
    "CarAxis": 0.4,
    "FourBar": 0.2,
    "Rattleback": 0.2,
    "SliderCrank": 0.1,
    "SpatialSliderCrank": 0.2,
    "WhippleBicycle": 0.2,
}


def gallery() -> dict[str, Any]:
    """Return all examples with their default parameters, by name."""
    classes = {
        name: value
        for name, value in vars(systems).items()
        if isinstance(value, type) and hasattr(value, "lagrangian")
    }
    low = systems.ContinuouslyVariableTransmission.low
    return {
        name: low() if name == "ContinuouslyVariableTransmission" else value()
        for name, value in sorted(classes.items())
    }


def program(
    example: Any, kind: str, stages: int, num_steps: int
) -> Callable[[Any, Any], Any]:
    """Return a function of one member's initial state and step size.

    The function returns arrays, and the number of iterations of the run, which is -1
    if the run fails.
    """
    method = nhjax.LobattoIIIAB(stages)

    def run(y0, dt, **options):
        return nhjax.integrate(
            example.system,
            method,
            y0,
            dt=dt,
            num_steps=num_steps,
            throw=False,
            **options,
        )

    def sweeps(sol):
        solved = sol.result == nhjax.RESULTS.successful
        return jnp.where(solved, sol.stats["num_iterations"], -1)

    def values(y0, dt):
        if kind == "dense":
            sol = run(y0, dt, saveat=SaveAt(dense=True))
            ys = jax.vmap(sol.evaluate)(dt * jnp.linspace(0.5, num_steps - 0.5, 5))
        else:
            saveat = SaveAt(steps=True) if kind == "rows" else SaveAt(t1=True)
            sol = run(y0, dt, saveat=saveat)
            ys = sol.ys
        return ys, sweeps(sol)

    def pushed(y0, dt):
        def function(dt):
            sol = run(y0, dt)
            return sol.ys, sweeps(sol)

        (ys, count), (rates, _) = jax.jvp(function, (dt,), (jnp.ones_like(dt),))
        return (ys, rates), count

    def gradient(y0, dt):
        def loss(y0, dt):
            sol = run(y0, dt, adjoint=ADJOINTS[kind])
            return sum(jnp.sum(x**2) for x in jax.tree.leaves(sol.ys)), sweeps(sol)

        (value, count), slopes = jax.value_and_grad(loss, (0, 1), has_aux=True)(y0, dt)
        return (value, slopes), count

    if kind in ADJOINTS:
        return gradient
    return pushed if kind == "jvp" else values


def compiled(engine: str, function: Callable[..., Any], *args: Any):
    """Compile a function; return it with the processor time and the engine it uses."""
    os.environ["NHJAX_ENGINE"] = engine
    jax.clear_caches()
    start = time.process_time()
    ready = jax.jit(jax.vmap(function)).lower(*args).compile()
    seconds = time.process_time() - start
    uses = nhjax.engines(jax.vmap(function), *args)
    took = {use.engine for use in uses if use.members is not None}
    return ready, seconds, "/".join(sorted(took))


def fastest(functions: list[Callable[[], Any]]) -> list[float]:
    """Call the functions in turn; return the least processor time of each."""
    best = [np.inf] * len(functions)
    for _ in range(REPEATS):
        for k, function in enumerate(functions):
            start = time.process_time()
            jax.block_until_ready(function())
            best[k] = min(best[k], time.process_time() - start)
    return best


def difference(got: Any, expected: Any) -> float:
    """Return the largest difference, relative to the largest number of each array."""
    worst = 0.0
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        x, y = np.asarray(x), np.asarray(y)
        if x.size and x.dtype.kind == "f":
            size = np.max(np.abs(y)) or 1.0
            worst = max(worst, float(np.max(np.abs(x - y)) / size))
    return worst


def case(
    name: str, example: Any, kind: str, options: argparse.Namespace
) -> dict[str, Any]:
    """Measure both engines on one system and one kind of output."""
    members, steps = options.members, options.num_steps
    y0 = example.initial_state()
    y0 = jax.tree.map(lambda x: jnp.broadcast_to(x, (members, *x.shape)), y0)
    final_time = FINAL_TIMES.get(name) or options.final_time
    dt = jnp.linspace(0.8, 1.0, members) * final_time / steps
    function = program(example, kind, options.stages, steps)
    ready, seconds, took = zip(
        *[compiled(engine, function, y0, dt) for engine in ENGINES], strict=True
    )
    results = [run(y0, dt) for run in ready]
    if any(np.any(np.asarray(counts) < 0) for _, counts in results):
        raise RuntimeError(f"Runs of {name} to t = {final_time} failed.")
    times = fastest([lambda run=run: run(y0, dt) for run in ready])
    (kernels, counts), (lanes, lane_counts) = results
    return {
        "system": name,
        "kind": kind,
        "final_time": final_time,
        "engines": took,
        "compile": seconds,
        "microseconds": [1e6 * x / members / steps for x in times],
        "ratio": times[1] / times[0],
        "difference": difference(lanes, kernels),
        "different_counts": int(np.sum(np.asarray(counts) != np.asarray(lane_counts))),
    }


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", default=list(gallery()))
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument("--stages", type=int, default=3)
    parser.add_argument("--members", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=40)
    parser.add_argument("--final-time", type=float, default=2.0)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, data = [], []
    for name in options.systems:
        for kind in options.kinds:
            x = case(name, gallery()[name], kind, options)
            data.append(x)
            rows.append(
                [name, kind, x["engines"][1]]
                + [f"{t:.2f}" for t in x["microseconds"]]
                + [f"{x['ratio']:.2f}"]
                + [f"{t:.1f}" for t in x["compile"]]
                + [f"{x['difference']:.1e}", str(x["different_counts"])]
            )
            print(*rows[-1], sep="\t", flush=True)
    header = ["system", "kind", "engine", "kernels [µs/step]", "lanes [µs/step]"]
    header += ["ratio", "compile kernels [s]", "compile lanes [s]"]
    header += ["difference", "other counts"]
    text = (
        f"{options.members} members, s = {options.stages}, {options.num_steps} steps "
        f"to t = {options.final_time:g} at most, less for fast systems.\n\n"
        f"{markdown_table(header, rows)}"
    )
    write("engines", "Ensembles by engine", text, {"rows": data})


if __name__ == "__main__":
    main()
