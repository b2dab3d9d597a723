"""The cost of a gradient: time, memory and compile time of every adjoint.

A scalar function of the final state is differentiated with respect to the initial
state, dt and the parameters of the system. Times are given as ratios to the time of the
run without gradient; both are measured in turn in one process. Times are medians of
seven, or of three for more than 10⁴ steps. Processor times, which add up all threads,
depend less on other load of the machine. Each system and number of steps has its own
process. `temp` is the memory that the compiled program allocates. `resident` is the
peak of resident memory minus the resident memory before the run (on Linux only).
`--smoke` takes one minute, a full run about ten.
"""

import argparse
import functools
import gc
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.figure import Figure

import nhjax
from nhjax import systems

from ._examples import of_the_gallery, suslov_in_a_potential
from ._report import from_fresh_process, markdown_table, number, RESULTS, write


SAVED_SYSTEM, SAVED_LENGTHS = "sleigh", [10**2, 10**3, 10**4]
DT, REPEATS, LONG, REPEATS_OF_LONG = 0.1, 7, 10**4, 3
# With these settings freed memory is returned to the system at once. Otherwise it would
# count as memory of the next run.
MALLOC = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}


EXAMPLES = {
    "chaotic": of_the_gallery(systems.ChaoticSystem),
    "sleigh": of_the_gallery(systems.ChaplyginSleigh),
    "CVT": of_the_gallery(systems.ContinuouslyVariableTransmission),
    "Suslov": of_the_gallery(systems.Suslov),
    # Create this system only once: new functions would make a different system.
    "Suslov in a potential": functools.cache(suslov_in_a_potential),
    "heavy top": of_the_gallery(systems.HeavyTop),
}
ADJOINTS = {
    "direct": nhjax.DirectAdjoint(),
    "checkpoints": nhjax.RecursiveCheckpointAdjoint(),
    "reversible": nhjax.ReversibleAdjoint(),
}


def problem(
    name: str,
    stages: int,
    num_steps: int,
    adjoint: str = "direct",
    every: int | None = None,
) -> tuple[Callable[..., Array], tuple]:
    """Return a loss function, and its arguments: the state, the step and parameters.

    The loss is the sum of the squares of q and v at the end. With `every`, it is the
    sum over the states after each `every` steps.
    """
    saveat = nhjax.SaveAt(t1=every is None, steps=every or 0)
    system, y0 = EXAMPLES[name]()
    parameters, fixed = eqx.partition(system, eqx.is_inexact_array)

    def loss(y0, dt, parameters):
        sol = nhjax.integrate(
            eqx.combine(parameters, fixed),
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=dt,
            num_steps=num_steps,
            adjoint=ADJOINTS[adjoint],
            saveat=saveat,
            throw=False,
        )
        squares = [jnp.sum(x**2) for x in (sol.ys.v, *jax.tree.leaves(sol.ys.q))]
        return jnp.sum(jnp.stack(squares))

    return loss, (y0, jnp.asarray(DT), parameters)


def gradient(loss: Callable[..., Array]) -> Callable:
    """Return the value of a loss and its gradient with respect to all arguments."""
    return jax.value_and_grad(loss, argnums=(0, 1, 2))


def compiled(function: Callable, args: tuple) -> tuple[Any, float]:
    """Return the compiled function, and the seconds to trace and compile it."""
    jax.clear_caches()
    start = time.perf_counter()
    program = jax.jit(function).lower(*args).compile()
    return program, time.perf_counter() - start


def seconds(function: Callable, args: tuple) -> tuple[float, float]:
    """Measure the wall time of one run, and its processor time of all cores."""
    start, processors = time.perf_counter(), time.process_time()
    jax.block_until_ready(function(*args))
    return time.perf_counter() - start, time.process_time() - processors


def both_medians(
    runs: dict[str, tuple[Callable, tuple]], repeats: int
) -> dict[str, tuple[float, ...]]:
    """Return the median wall time and processor time of each run, measured in turn."""
    times = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            times[name].append(seconds(*run))
    return {
        name: tuple(statistics.median(kind) for kind in zip(*values, strict=True))
        for name, values in times.items()
    }


def medians(runs: dict[str, tuple[Callable, tuple]], repeats: int) -> dict[str, float]:
    """Return the median wall time of each run, measured in turn."""
    return {name: both[0] for name, both in both_medians(runs, repeats).items()}


def resident(function: Callable, args: tuple) -> int | None:
    """Return by how many bytes resident memory grows in a call, or None if unknown."""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    gc.collect()

    def kilobytes(name: str) -> int:
        lines = status.read_text().splitlines()
        return int(next(x for x in lines if x.startswith(name)).split()[1])

    Path("/proc/self/clear_refs").write_text("5")  # This resets the peak.
    before = kilobytes("VmRSS")
    jax.block_until_ready(function(*args))
    return 1024 * max(kilobytes("VmHWM") - before, 0)


def case(name: str, stages: int, num_steps: int, adjoints: list[str]) -> dict[str, Any]:
    """Measure all adjoints for one system and number of steps."""
    loss, args = problem(name, stages, num_steps)
    functions = {"forward": loss}
    for adjoint in adjoints:
        functions[adjoint] = gradient(problem(name, stages, num_steps, adjoint)[0])
    # The first compilation of a process also starts the compiler, and is not measured.
    compiled(jnp.sin, (args[1],))
    rows, runs, gradients = {}, {}, {}
    for key, function in functions.items():
        program, compile_seconds = compiled(function, args)
        runs[key] = (program, args)
        rows[key] = {
            "compile": compile_seconds,
            "temp": program.memory_analysis().temp_size_in_bytes,
        }
    for key, (program, _) in runs.items():
        # Memory is measured in the second run, because during the first run the
        # compiler may still free memory.
        outcome = jax.block_until_ready(program(*args))
        rows[key]["resident"] = resident(program, args)
        if key != "forward":
            gradients[key] = outcome[1][0]
    repeats = REPEATS if num_steps <= LONG else REPEATS_OF_LONG
    for key, (by_clock, by_processors) in both_medians(runs, repeats).items():
        rows[key] |= {"seconds": by_clock, "processor_seconds": by_processors}
    for key, value in gradients.items():
        rows[key]["error"] = difference(value, gradients["direct"])
    return {"system": name, "num_steps": num_steps, "stages": stages, "rows": rows}


def difference(tree, reference) -> float:
    """Return the largest difference, relative to the largest entry of `reference`."""
    a, b = (
        np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])
        for tree in (tree, reference)
    )
    return float(np.max(np.abs(a - b)) / np.max(np.abs(b)))


def apart(kind: str, *args: Any) -> Any:
    """Run `kind`, one of PARTS, in its own process, and return the result."""
    part = json.dumps([kind, *args])
    return from_fresh_process("gradients", "--part", part, environment=MALLOC)


def compilation(name: str, stages: list[int]) -> list[tuple[int, float, float]]:
    """Measure the seconds to compile the run and the gradient for each s."""
    compiled(gradient(problem(name, 2, 2)[0]), problem(name, 2, 2)[1])
    rows = []
    for s in stages:
        loss, args = problem(name, s, 1000)
        rows.append((s, compiled(loss, args)[1], compiled(gradient(loss), args)[1]))
    return rows


def modes(name: str, stages: int, num_steps: int) -> dict[str, float]:
    """Measure forward mode and reverse mode, as ratios to the time of the run.

    The end (q, v) is differentiated with respect to v0. In products of its derivative
    with tangents, dt varies too. The row "reverse gradient" differentiates the loss.
    """
    system, y0 = EXAMPLES[name]()

    def end(v, dt):
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages),
            eqx.tree_at(
                lambda y: (y.v, y.p),
                y0,
                (v, system.momentum(0.0, y0.q, v, None)),
            ),
            dt=dt,
            num_steps=num_steps,
            throw=False,
        )
        return jnp.concatenate([sol.ys.q[-1], sol.ys.v[-1]])

    def push(v, dt, *tangents):
        return jax.jvp(end, (v, dt), tangents)

    def push_five(v, dt, *tangents):
        return jax.vmap(lambda *tangents: push(v, dt, *tangents))(*tangents)

    point = (y0.v, jnp.asarray(DT))
    n = y0.v.shape[0]
    one = (jnp.ones(n), jnp.asarray(1.0))
    rng = np.random.default_rng(0)
    five = (jnp.asarray(rng.normal(size=(5, n))), jnp.ones(5))

    def loss(v, dt):
        return jnp.sum(end(v, dt) ** 2)

    _, linear = jax.linearize(jax.jit(end), *point)
    runs = {
        "run": (jax.jit(end), point),
        "jvp": (jax.jit(push), point + one),
        "jvp of 5 tangents": (jax.jit(push_five), point + five),
        f"jacfwd, {n} inputs": (jax.jit(jax.jacfwd(end)), point),
        f"jacrev, {2 * n} outputs": (jax.jit(jax.jacrev(end)), point),
        "reverse gradient": (jax.jit(jax.value_and_grad(loss)), point),
        "a product with jax.linearize's map": (jax.jit(linear), one),
    }
    for run in runs.values():
        seconds(*run)
    times = medians(runs, REPEATS)
    return {key: value / times["run"] for key, value in times.items()}


def batch(stages: int, num_steps: int, members: int) -> dict[str, float]:
    """Measure the run and the gradient of one trajectory and of a batch."""
    loss, (_, dt, parameters) = problem("chaotic", stages, num_steps)
    q, v = systems.ChaoticSystem().ensemble(members - 1)
    system = systems.ChaoticSystem().system
    every = jax.vmap(lambda q, v: nhjax.initial_state(system, q, v))(q, v)
    first = jax.tree.map(lambda x: x[0], every)
    runs = {}
    for key, function in {"run": loss, "gradient": gradient(loss)}.items():
        batched = jax.vmap(function, in_axes=(0, None, None))
        runs[key] = (jax.jit(function), (first, dt, parameters))
        runs[f"batch of {key}s"] = (jax.jit(batched), (every, dt, parameters))
    for run in runs.values():
        seconds(*run)
    times = medians(runs, REPEATS)
    times["members"] = members
    return times


def saved(name: str, stages: int, lengths: list[int]) -> list[dict[str, Any]]:
    """Measure the microseconds per step of gradients of losses of all saved states.

    The loss depends on the state after each step, or after each tenth step. The rows
    also have the time for a loss of the last state.
    """
    rows = []
    for num_steps in lengths:
        runs = {}
        for key, every in (("last", None), ("each", 1), ("each tenth", 10)):
            loss, args = problem(name, stages, num_steps, every=every)
            runs[key] = (jax.jit(gradient(loss)), args)
            seconds(*runs[key])
        times = medians(runs, REPEATS)
        microseconds = {key: 1e6 * x / num_steps for key, x in times.items()}
        rows.append({"num_steps": num_steps} | microseconds)
    return rows


PARTS = {
    "case": case,
    "compilation": compilation,
    "modes": modes,
    "batch": batch,
    "saved": saved,
}


def case_table(cases: list[dict[str, Any]]) -> str:
    """Write the table of relative times and memory of all systems and step numbers."""
    rows = []
    for entry in cases:
        forward = entry["rows"]["forward"]
        for key, row in entry["rows"].items():
            if key == "forward":
                continue
            rows.append(
                [
                    entry["system"],
                    str(entry["num_steps"]),
                    key,
                    f"{1e6 * forward['seconds'] / entry['num_steps']:.1f}",
                    f"{row['seconds'] / forward['seconds']:.2f}",
                    f"{row['processor_seconds'] / forward['processor_seconds']:.2f}",
                    f"{row['compile'] / forward['compile']:.2f}",
                    megabytes(row["temp"]),
                    megabytes(row["resident"]),
                    # JSON has no NaN.
                    "nan" if row["error"] is None else number(row["error"]),
                ]
            )
    header = ["system", "N", "adjoint", "run [µs/step]", "gradient / run"]
    header += ["processor time / run's"]
    header += ["compile / run's", "temp [MB]", "resident [MB]", "difference"]
    return markdown_table(header, rows)


def megabytes(size: int | None) -> str:
    """Format a size in MB, if it is known."""
    return "" if size is None else f"{size / 1e6:.2f}"


def draw(cases: list[dict[str, Any]], path: Path) -> None:
    """Plot time and memory against the number of steps."""
    figure = Figure(figsize=(9, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    names = list(dict.fromkeys(entry["system"] for entry in cases))
    markers = dict(zip(names, "osd^vx", strict=False))
    keys = list(cases[0]["rows"])
    steps = np.array(sorted({entry["num_steps"] for entry in cases}), float)
    for k, key in enumerate(keys):
        for name in names:
            mine = [entry for entry in cases if entry["system"] == name]
            x = [entry["num_steps"] for entry in mine]
            style = {"color": f"C{k}", "marker": markers[name], "markersize": 4}
            label = key if name == names[0] else None
            times = [entry["rows"][key]["seconds"] for entry in mine]
            left.loglog(x, times, label=label, linewidth=1, **style)
            memory = [entry["rows"][key]["temp"] / 1e6 for entry in mine]
            right.loglog(x, memory, linewidth=1, **style)
    first = cases[0]["rows"]
    for power, key, name in ((1, "direct", "N"), (0.5, "checkpoints", "√N")):
        if key in first:
            line = 2 * first[key]["temp"] / 1e6 * (steps / steps[0]) ** power
            right.loglog(steps, line, "k:", linewidth=1)
            right.annotate(name, (steps[-1], line[-1]))
    for name in names:
        right.plot([], [], color="0.4", marker=markers[name], label=name)
    for ax, label in ((left, "seconds"), (right, "temporary memory [MB]")):
        ax.set_xlabel("number of steps N")
        ax.set_ylabel(label)
        ax.legend(fontsize="small")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Print and save the tables and the figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", default=list(EXAMPLES))
    parser.add_argument("--stages", type=int, default=3)
    parser.add_argument("--num-steps", type=int, nargs="+", default=[100, 10**3, 10**4])
    parser.add_argument("--longest", type=int, default=10**5, help="first system alone")
    parser.add_argument("--adjoints", nargs="+", default=list(ADJOINTS))
    parser.add_argument("--members", type=int, default=101)
    parser.add_argument("--smoke", action="store_true", help="little, and not saved")
    parser.add_argument(
        "--only-saved",
        action="store_true",
        help="measure the gradients of saved states, and keep the other tables",
    )
    parser.add_argument("--part", help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.part is not None:
        kind, *args = json.loads(options.part)
        print(json.dumps(PARTS[kind](*args)))
        return
    s, compile_stages, steps = options.stages, list(range(2, 9)), 1000
    pairs = [(name, n) for name in options.systems for n in options.num_steps]
    if options.longest not in options.num_steps:
        pairs.insert(len(options.num_steps), (options.systems[0], options.longest))
    if options.smoke:
        pairs, compile_stages, steps = [("CVT", 20)], [2, 3], 20
    if options.only_saved:
        data = json.loads((RESULTS / "gradients.json").read_text(encoding="utf-8"))
    else:
        data = measure_but_saved(options, pairs, compile_stages, steps)
    lengths = [20] if options.smoke else SAVED_LENGTHS
    data["saved"] = apart("saved", SAVED_SYSTEM, s, lengths)
    text = report(data, s, steps, pairs[0][0], options.members)
    if options.smoke:
        print(text)
        return
    write("gradients", "Cost of gradients", text, data)
    draw(data["cases"], RESULTS / "gradients.png")


def measure_but_saved(
    options: argparse.Namespace,
    pairs: list[tuple[str, int]],
    compile_stages: list[int],
    steps: int,
) -> dict[str, Any]:
    """Measure all parts except the gradients of saved states."""
    s, cases = options.stages, []
    for name, num_steps in pairs:
        cases.append(apart("case", name, s, num_steps, options.adjoints))
        print(*case_table(cases[-1:]).splitlines()[2:], sep="\n", flush=True)
    first = pairs[0][0]
    return {
        "cases": cases,
        "compilation": apart("compilation", first, compile_stages),
        "modes": apart("modes", first, s, steps),
        "batch": apart("batch", s, min(steps, 200), options.members),
    }


def report(data: dict[str, Any], s: int, steps: int, first: str, members: int) -> str:
    """Return all tables as text."""
    compilations, ratios, batches = (data[k] for k in ("compilation", "modes", "batch"))
    sections = [f"s = {s}, dt = {DT}.", case_table(data["cases"])]
    rows = [
        [str(k), f"{a:.2f}", f"{b:.2f}", f"{b / a:.2f}"] for k, a, b in compilations
    ]
    header = ["s", "compile run [s]", "compile gradient [s]", "ratio"]
    sections += [f"{first}, direct:", markdown_table(header, rows)]
    rows = [[key, f"{value:.2f}"] for key, value in ratios.items()]
    title = f"{first}, direct, N = {steps}: time over that of the run"
    sections += [title, markdown_table(["what", "ratio"], rows)]
    rows = [
        [key, f"{batches[f'batch of {key}s'] / batches[key]:.1f}"]
        for key in ("run", "gradient")
    ]
    title = f"chaotic, direct: a batch of {members} over one"
    sections += [title, markdown_table(["what", "ratio"], rows)]
    keys = [key for key in data["saved"][0] if key != "num_steps"]
    rows = [
        [str(row["num_steps"]), *(f"{row[key]:.2f}" for key in keys)]
        for row in data["saved"]
    ]
    title = f"{SAVED_SYSTEM}, direct: microseconds a step, by the states in the loss"
    return "\n\n".join([*sections, title, markdown_table(["N", *keys], rows)])


if __name__ == "__main__":
    main()
