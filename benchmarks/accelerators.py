"""Ensembles on an accelerator, compared with the processor of the same machine.

Each ensemble is one compiled `jax.vmap(integrate)`. The table has the time per step and
member on both devices. It also has the largest difference between the final positions
on both devices, relative to the largest position. In the chaotic system, differences of
round-off grow. Times are the least of three calls; compile time is separate.

    python -m benchmarks.accelerators
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems

from ._report import least_time, markdown_table, number, write


NUM_STEPS, ROUNDS = 50, 3
EXPLAINED = f"""\
Time of a step and member, {NUM_STEPS} steps a call, of the ensemble with a tolerance as
many as its members take; in pairs: the accelerator's, the processor's. `apart`: the
largest difference between the final positions of both."""


class Ensemble(NamedTuple):
    """A system, a method with its step size, and the initial state of each member."""

    name: str
    system: nhjax.LagrangianSystem
    method: nhjax.LobattoIIIAB
    h: float
    start: Callable[[int], nhjax.State]
    stage_solver: nhjax.AbstractStageSolver
    controller: nhjax.AbstractStepSizeController = nhjax.ConstantStepSize()


def ensembles(dtype: Any) -> list[Ensemble]:
    """Return the ensembles that are measured."""
    chaotic = systems.ChaoticSystem()
    bicycle = systems.WhippleBicycle.running(lean_rate=0.5)
    default, lobatto = nhjax.SimplifiedNewton(), nhjax.LobattoIIIAB

    def from_circle(members):
        q, v = chaotic.ensemble(max(members - 1, 1), dtype)
        start = jax.vmap(lambda q, v: nhjax.initial_state(chaotic.system, q, v))(q, v)
        return jax.tree.map(lambda x: x[:members], start)

    def running(members):
        y0 = jax.tree.map(lambda x: jnp.asarray(x, dtype), bicycle.initial_state())
        # Scaling all velocities, here to 95 to 105 percent, keeps the constraints
        # satisfied, because they are linear in v.
        scales = jnp.linspace(0.95, 1.05, members, dtype=dtype)
        return jax.vmap(
            lambda scale: nhjax.initial_state(bicycle.system, y0.q, scale * y0.v)
        )(scales)

    small = chaotic.system, lobatto(2), 0.1, from_circle
    return [
        Ensemble("chaotic system, s = 2", *small, default),
        Ensemble("the same by `Newton()`", *small, nhjax.Newton()),
        Ensemble(
            "chaotic, s = 4", chaotic.system, lobatto(4), 0.1, from_circle, default
        ),
        Ensemble(
            "chaotic, s = 4, rtol = 1e-6",
            *(chaotic.system, lobatto(4), 0.1, from_circle, default),
            nhjax.PIDController(1e-6, 1e-6),
        ),
        Ensemble("bicycle, s = 3", bicycle.system, lobatto(3), 0.02, running, default),
    ]


def program(ensemble: Ensemble) -> Any:
    """Return the compiled ensemble, a function of the initial states.

    For each member it returns the final positions, whether the run succeeded, and the
    numbers of iterations and steps.
    """
    steps: dict[str, Any] = {"dt": ensemble.h, "num_steps": NUM_STEPS}
    if not isinstance(ensemble.controller, nhjax.ConstantStepSize):
        steps = {"t1": NUM_STEPS * ensemble.h, "max_steps": 10 * NUM_STEPS}

    def run(y0):
        sol = nhjax.integrate(
            ensemble.system,
            ensemble.method,
            y0,
            **steps,
            stepsize_controller=ensemble.controller,
            saveat=nhjax.SaveAt(t1=True),
            stage_solver=ensemble.stage_solver,
            throw=False,
        )
        good = sol.result == nhjax.RESULTS.successful
        rejected = sol.stats.get("num_rejected_steps", 0)
        count = sol.stats["num_steps"] + rejected
        return sol.ys.q[-1], good, sol.stats["num_iterations"], count

    return jax.jit(jax.vmap(run))


def measure(ensemble: Ensemble, members: int) -> dict[str, Any]:
    """Measure an ensemble on the default device and on the processor."""
    devices = {"accelerator": jax.devices()[0], "cpu": jax.devices("cpu")[0]}
    found: dict[str, Any] = {"name": ensemble.name, "members": members}
    positions = {}
    for name, device in devices.items():
        with jax.default_device(device):
            start = jax.device_put(ensemble.start(members), device)
            before = time.perf_counter()
            compiled = program(ensemble).lower(start).compile()
            found[f"{name}, compile"] = time.perf_counter() - before
            q, good, iterations, count = jax.block_until_ready(compiled(start))
            seconds = least_time(partial(compiled, start), ROUNDS)
        found[name] = 1e6 * seconds / float(np.sum(count))
        found[f"{name}, failed"] = int(members - np.sum(good))
        found[f"{name}, iterations"] = float(np.sum(iterations) / np.sum(count))
        positions[name] = np.asarray(q)
    apart = np.abs(positions["accelerator"] - positions["cpu"]).max()
    found["apart"] = float(apart / np.abs(positions["cpu"]).max())
    return found


def table(rows: list[dict[str, Any]]) -> str:
    """Write the table of all ensembles."""
    lines = [
        [
            row["name"],
            row["dtype"],
            str(row["members"]),
            f"{row['accelerator']:.4f}",
            f"{row['cpu']:.4f}",
            f"{row['cpu'] / row['accelerator']:.2f}",
            f"{row['accelerator, iterations']:.1f}, {row['cpu, iterations']:.1f}",
            f"{row['accelerator, failed']}, {row['cpu, failed']}",
            number(row["apart"]),
            f"{row['accelerator, compile']:.1f}, {row['cpu, compile']:.1f}",
        ]
        for row in rows
    ]
    header = ["ensemble", "dtype", "members", "accelerator [µs]", "processor [µs]"]
    header += ["processor / accelerator", "iterations a step", "failed", "apart"]
    return markdown_table([*header, "compile [s]"], lines)


def main() -> None:
    """Measure, and write the table after each row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--members", type=int, nargs="+", default=[1, 1000, 100_000])
    parser.add_argument("--only", nargs="+", help="words of the names of ensembles")
    parser.add_argument("--smoke", action="store_true", help="little, and not saved")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for dtype in ("float64", "float32"):
        for ensemble in ensembles(dtype):
            if options.only and not any(x in ensemble.name for x in options.only):
                continue
            for members in [3] if options.smoke else options.members:
                rows.append({"dtype": dtype, **measure(ensemble, members)})
                text = f"{EXPLAINED}\n\n{table(rows)}"
                if options.smoke:
                    print(text, flush=True)
                else:
                    write(
                        "accelerators",
                        "Ensembles on an accelerator",
                        text,
                        {"rows": rows},
                    )


if __name__ == "__main__":
    main()
