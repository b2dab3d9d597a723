"""The cost of a first call: processor time to trace, lower and compile a run.

The table also has the time of a later call of the same program.

Vectorised programs (the engine `lanes`) are compiled to native code while JAX lowers
them; the column "of which LLVM" is the part of this time that LLVM needs, and the
rest is Python. The bicycle has eight coordinates and five constraints, written as a
user would write them. Each program is compiled by two processes, one after the other,
which share a directory for JAX's compilation cache, empty at first: the first
process stores its compiled programs there, and the second process loads them.

    python -m benchmarks.compile_time
"""

import argparse
import itertools
import json
import tempfile
import time
from collections.abc import Callable
from typing import Any, TypeVar
from unittest import mock

import jax
import jax.numpy as jnp

import nhjax
from nhjax import systems
from nhjax.lanes._native import object_code

from ._examples import wheeled_inverted_pendulum
from ._report import from_fresh_process, least_time, markdown_table, write


T = TypeVar("T")
NUM_STEPS = 20
KINDS = ("run", "ensemble", "gradient")


def cases() -> list[tuple[str, Any, nhjax.State, int, str]]:
    """Return the name, system, state, number of stages and kind of each program."""
    chaotic, top = systems.ChaoticSystem(), systems.HeavyTopSE3()
    riding = systems.WhippleBicycle.running(speed=5.0, lean_rate=0.5)
    upright = riding.initial_state()
    found = [
        ("chaotic", chaotic.system, chaotic.initial_state(), s, kind)
        for s in (3, 8)
        for kind in KINDS
    ]
    found += [
        ("heavy top on SE(3)", top.system, top.initial_state(), 3, kind)
        for kind in KINDS
    ]
    found += [("bicycle", riding.system, upright, 3, kind) for kind in KINDS]
    return [
        *found,
        *(
            ("bicycle", riding.system, upright, s, kind)
            for s in (4, 6, 8)
            for kind in ("run", "gradient")
        ),
    ]


def program(system: Any, stages: int, kind: str) -> Callable[[Any, Any], Any]:
    """Return the function to compile, which takes a state and a step size.

    For an ensemble it takes a state and an array of step sizes.
    """

    def run(y0, dt):
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=dt,
            num_steps=NUM_STEPS,
            throw=False,
        ).ys

    def loss(y0, dt):
        return sum(jnp.sum(leaf**2) for leaf in jax.tree.leaves(run(y0, dt)))

    functions = {
        "run": run,
        "ensemble": jax.vmap(run, in_axes=(None, 0)),
        "gradient": jax.grad(loss, argnums=(0, 1)),
    }
    return functions[kind]


def compiled(function: Callable[..., Any], *args: Any) -> tuple[Any, list[float]]:
    """Return a compiled program, and the seconds to trace, lower and compile it."""
    times = [time.process_time()]
    traced = jax.jit(function).trace(*args)
    times.append(time.process_time())
    lowered = traced.lower()
    times.append(time.process_time())
    program = lowered.compile()
    times.append(time.process_time())
    return program, [after - before for before, after in itertools.pairwise(times)]


def with_llvm_timed(call: Callable[[], T]) -> tuple[T, float]:
    """Return the result of a call, and the seconds of it that LLVM needs."""
    seconds = 0.0

    def timed(*args: Any) -> bytes:
        nonlocal seconds
        start = time.process_time()
        code = object_code(*args)
        seconds += time.process_time() - start
        return code

    with mock.patch("nhjax.lanes._program.object_code", timed):
        return call(), seconds


def plain_calls() -> list[tuple[str, float]]:
    """Measure first calls, in seconds, as a user of a small machine would make them."""
    system, q, v, gains = wheeled_inverted_pendulum()
    method = nhjax.LobattoIIIAB(3)
    found = []

    def timed(name, call):
        start = time.process_time()
        result = jax.block_until_ready(call())
        found.append((name, time.process_time() - start))
        return result

    def run(num_steps, gains=gains, **options):
        return nhjax.integrate(
            system, method, y0, dt=0.001, num_steps=num_steps, args=gains, **options
        ).ys

    def end(gains):
        return jnp.sum(run(100, gains).q ** 2)

    def start():
        return nhjax.initial_state(system, q, v, args=gains, project=True)

    y0 = timed("`initial_state`", start)
    timed("`integrate`, 100 steps", lambda: run(100))
    steps = nhjax.SaveAt(steps=True)
    timed("150 steps, each saved", lambda: run(150, saveat=steps))
    timed(
        "250 steps, every fifth saved", lambda: run(250, saveat=nhjax.SaveAt(steps=5))
    )
    timed("gradient", lambda: jax.grad(end)(gains))
    timed(
        "`check_system`",
        lambda: nhjax.check_system(system, q, y0.v, args=gains).mass_condition,
    )
    return [*found, ("all", sum(seconds for _, seconds in found))]


def measure(index: int) -> None:
    """Print the times of one of the cases, in this process."""
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    _, system, y0, stages, kind = cases()[index]
    dt = jnp.full((8,), 0.05) if kind == "ensemble" else jnp.asarray(0.05)
    (ready, parts), llvm = with_llvm_timed(
        lambda: compiled(program(system, stages, kind), y0, dt)
    )
    later = least_time(lambda: ready(y0, dt), 15)
    print(json.dumps({"parts": parts, "llvm": llvm, "later": later}))


def in_process(index: int, directory: str) -> dict[str, Any]:
    """Return the times of one of the cases, in a process of its own."""
    return from_fresh_process(
        *("compile_time", "--case", str(index)),
        environment={"JAX_COMPILATION_CACHE_DIR": directory},
    )


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", nargs="+", help="a part of the names")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--case", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.case is not None:
        measure(given.case)
        return
    jax.config.update("jax_enable_x64", True)
    jax.jit(jnp.sin).lower(0.1).compile()
    calls = [] if given.systems else plain_calls()
    rows, data = [], []
    for index, (name, _, _, stages, kind) in enumerate(cases()):
        if (given.systems and name not in given.systems) or kind not in given.kinds:
            continue
        with tempfile.TemporaryDirectory() as directory:
            first, second = (in_process(index, directory) for _ in range(2))
        later, llvm = first["later"], first["llvm"]
        first, second = first["parts"], second["parts"]
        ratio = sum(second) / sum(first)
        shown = (*first[:2], llvm, first[2], sum(first), sum(second))
        times = [f"{x:.1f}" for x in shown]
        row = [name, str(stages), kind, *times, f"{ratio:.2f}", f"{1e3 * later:.2g}"]
        print(*row, sep="\t", flush=True)
        rows.append(row)
        case = {"system": name, "stages": stages, "kind": kind}
        data.append(
            {
                **case,
                "seconds": first,
                "llvm": llvm,
                "second_process": second,
                "later": later,
            }
        )
    parts = ["trace", "lower", "of which LLVM", "compile", "all"]
    parts += ["all, second process", "ratio"]
    text = (
        f"Seconds of the processor, for programs of {NUM_STEPS} steps; the last column "
        "is the least time of a later call.\n\n"
        + markdown_table(
            ["system", "stages", "program", *parts, "later call, ms"], rows
        )
    )
    listed = [[name, f"{seconds:.2f}"] for name, seconds in calls]
    text += (
        "\n\nPlain calls for a wheeled inverted pendulum with feedback (six "
        "coordinates, three constraints), one after the other:\n\n"
    ) + markdown_table(["call", "seconds"], listed)
    results = {"rows": data, "plain calls": dict(calls)}
    write("compile_time", "Time of the first call", text, results)


if __name__ == "__main__":
    main()
