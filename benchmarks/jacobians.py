"""Iterations a step with the Jacobian of simplified Newton, and with fuller ones.

`SimplifiedNewton` inverts the leading part of the Jacobian of the stage equations, with
the mass matrix at the start of the step, or this with the terms of order h. Beside it
are the exact Jacobian at the starting values, kept for the whole step, which is the
most that one factorisation a step can do, and the exact Jacobian of every iterate
(`Newton`). Runs that fail are shown with the number of steps that they made.

A second table has the time of a step with the terms of order h over that without, of
one trajectory and of a batch, run in turn, and that of compiling.

    python -m benchmarks.jacobians
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import nhjax
from nhjax import systems
from nhjax._numerics import iterate, NOISE_UNITS
from nhjax._step._solvers import fibre_coordinate_scale
from nhjax._step._stage_iteration import sizes

from ._report import markdown_table, write


NUM_STEPS = 20
MEMBERS, REPEATS = 64, 60
CASES = [
    ("Unicycle", 3, 0.1),
    ("Unicycle", 5, 0.25),
    ("Unicycle", 8, 0.5),
    ("Suslov", 3, 0.1),
    ("Veselova", 3, 0.1),
    ("HeavyTop", 3, 0.1),
    ("HeavyTopSE3", 3, 0.1),
    ("TurntableBall", 3, 0.1),
    ("ChaplyginSleigh", 3, 0.1),
    ("ChaplyginSleigh", 5, 0.5),
    ("RollingDisc", 3, 0.1),
    ("CarWithTrailers", 3, 0.1),
    ("TwoWheeledRobot", 3, 0.1),
    ("RollingTorus", 3, 0.1),
    ("ChaoticSystem", 3, 0.1),
    ("NonholonomicParticle", 3, 0.1),
]


class ExactAtStart(nhjax.AbstractStageSolver):
    """Newton's method with the exact Jacobian at the starting values of the step."""

    max_iterations: int = eqx.field(static=True, default=100)
    tolerance: float = 0.0

    def solve(self, stages, x0, lin, skip):
        """Solve the stage equations from `x0`."""
        z0, unravel = ravel_pytree(x0)
        jacobian = jax.jacfwd(lambda z: nhjax.stage_residual(stages, unravel(z))[0])
        jacobian_inverse = jnp.linalg.inv(jacobian(z0))

        def sweep(x):
            residual, evaluation = nhjax.stage_residual(stages, x)
            x_next = unravel(ravel_pytree(x)[0] - jacobian_inverse @ residual)
            return x_next, sizes(stages, x, x_next, lin), evaluation

        scale = fibre_coordinate_scale(stages, x0, lin)
        return iterate(
            sweep,
            x0,
            scale.size,
            max_iterations=self.max_iterations,
            tolerance=self.tolerance,
            round_off=scale.round_off,
            noise_units=NOISE_UNITS,
            skip=skip,
        )

    def frozen_newton_map(self, stages, lin, x):
        """Make the iteration of `nhjax.Newton`, which has the same solution."""
        return nhjax.Newton().frozen_newton_map(stages, lin, x)


LEADING = nhjax.SimplifiedNewton(fallback=False, jacobian="leading")
FIRST_ORDER = nhjax.SimplifiedNewton(fallback=False, jacobian="first_order")
SOLVERS = {
    "leading part": LEADING,
    "with terms of order h": FIRST_ORDER,
    "exact at the start": ExactAtStart(),
    "exact": nhjax.Newton(),
}


def integrated(
    name: str, stages: int, dt: float, solver: nhjax.AbstractStageSolver
) -> tuple[Callable[[nhjax.State], nhjax.Solution], nhjax.State]:
    """The function from a state to a run, and the state."""
    example = getattr(systems, name)()

    def run(y0):
        return nhjax.integrate(
            example.system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=dt,
            num_steps=NUM_STEPS,
            stage_solver=solver,
            saveat=nhjax.SaveAt(t1=True),
            throw=False,
        )

    return run, example.initial_state()


def iterations(
    name: str, stages: int, dt: float, solver: nhjax.AbstractStageSolver
) -> tuple[int, float]:
    """The number of steps that a run makes, and the iterations of each on average."""
    run, y0 = integrated(name, stages, dt, solver)
    stats = jax.jit(run)(y0).stats
    steps = int(stats["num_steps"])
    return steps, int(stats["num_iterations"]) / max(steps, 1)


class Programs(NamedTuple):
    """Compiled runs of one trajectory and of a batch, and seconds of compiling."""

    one: Callable[[], Any]
    batch: Callable[[], Any]
    compiling: float


def programs(
    name: str, stages: int, dt: float, solver: nhjax.AbstractStageSolver
) -> Programs:
    """Compile a run, for one trajectory and for a batch."""
    run, y0 = integrated(name, stages, dt, solver)
    members = jax.tree.map(lambda x: jnp.broadcast_to(x, (MEMBERS, *x.shape)), y0)
    one = jax.jit(run).lower(y0).compile()
    start = time.process_time()
    batch = jax.jit(jax.vmap(run)).lower(members).compile()
    compiling = time.process_time() - start
    return Programs(lambda: one(y0), lambda: batch(members), compiling)


def ratios(name: str, stages: int, dt: float) -> dict[str, float]:
    """Times with the terms of order h over those without, run in turn."""
    both = [programs(name, stages, dt, solver) for solver in (FIRST_ORDER, LEADING)]
    seconds: dict[tuple[str, int], list[float]] = {}
    for _ in range(REPEATS):
        for k, compiled in enumerate(both):
            for kind in ("one", "batch"):
                start = time.perf_counter()
                jax.block_until_ready(getattr(compiled, kind)().ys.p)
                took = time.perf_counter() - start
                seconds.setdefault((kind, k), []).append(took)
    # Other programs on the machine make runs longer, never shorter.
    quick = {key: float(np.quantile(times, 0.2)) for key, times in seconds.items()}
    found = {kind: quick[kind, 0] / quick[kind, 1] for kind in ("one", "batch")}
    return found | {"compiling": both[0].compiling / both[1].compiling}


def main() -> None:
    """Print and save the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, data = [], []
    for name, stages, dt in CASES:
        row = [name, str(stages), f"{dt:g}"]
        for kind, solver in SOLVERS.items():
            steps, mean = iterations(name, stages, dt, solver)
            solved = steps == NUM_STEPS
            row.append(f"{mean:.1f}" if solved else f"fails after {steps} steps")
            data.append(
                {"system": name, "stages": stages, "dt": dt, "jacobian": kind}
                | {"num_steps": steps, "iterations": mean}
            )
        rows.append(row)
    times, measured = [], []
    for name, stages, dt in CASES:
        if iterations(name, stages, dt, LEADING)[0] < NUM_STEPS:
            # A run that fails is no measure of time.
            continue
        found = ratios(name, stages, dt)
        measured.append({"system": name, "stages": stages, "dt": dt} | found)
        columns = [f"{found[key]:.2f}" for key in ("one", "batch", "compiling")]
        times.append([name, str(stages), f"{dt:g}", *columns])
    header = ["system", "s", "h"]
    text = (
        f"Iterations a step, mean of {NUM_STEPS} steps.\n\n"
        f"{markdown_table([*header, *SOLVERS], rows)}\n\n"
        "Times with the terms of order h over those without: a step of one trajectory, "
        f"one of {MEMBERS} members, and compiling the latter.\n\n"
        f"{markdown_table([*header, 'one', 'batch', 'compiling'], times)}"
    )
    data = {"rows": data, "times": measured}
    write("jacobians", "Jacobians of the stage equations", text, data)


if __name__ == "__main__":
    main()
