"""The effect of conserving the energy by `invariants`: its error, cost, side effects.

Each system is run with each number of stages, without invariants ("plain") and with the
energy as an invariant ("kept"). The tables have:

- the largest relative error of the energy at saved steps of a run;
- the iterations and the time of a step with the invariant, relative to plain steps;
- the largest violation of a constraint;
- the change of other quantities that the system conserves;
- for the chaotic ensemble, the distribution of positions. It is described by the mean
  of ‖q‖² over time and members, and the difference of these means between kept and
  plain runs, both with standard errors over members. The table also has the
  Kolmogorov-Smirnov distance between ‖q‖² of kept and plain runs, and for comparison
  the distance between two halves of the plain members.
"""

import argparse
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems

from ._examples import suslov_in_a_potential
from ._report import markdown_table, number, write


STEP, SAVED = 0.1, 2000
# Samples of chaotic motion are used after this time, because earlier samples still
# depend on the initial states.
FORGOTTEN = 1000.0


class Case(NamedTuple):
    """A system, its initial states, and its conserved quantities besides the energy."""

    name: str
    system: Any
    y0: nhjax.State
    others: Any


def _chaotic(members: int) -> Case:
    chaotic = systems.ChaoticSystem()
    q0, v0 = chaotic.ensemble(members - 1)
    y0 = jax.vmap(lambda q, v: nhjax.initial_state(chaotic.system, q, v))(q0, v0)
    return Case("chaotic", chaotic.system, y0, lambda q, v: (q @ q)[None])


def _single(name: str, system: Any, y0: nhjax.State, others: Any) -> Case:
    return Case(name, system, jax.tree.map(lambda x: x[None], y0), others)


def _cases(members: int) -> list[Case]:
    cvt = systems.ContinuouslyVariableTransmission.low()

    def energies(q, v):
        return jnp.stack([cvt.driver_energy(q, v), cvt.passenger_energy(q, v)])

    suslov, start = suslov_in_a_potential()
    free, heavy = systems.Veselova(weight=(0.0, 0.0, 0.0)), systems.Veselova()
    return [
        _chaotic(members),
        _single("CVT", cvt.system, cvt.initial_state(), energies),
        _single("Suslov in a potential", suslov, start, lambda q, v: jnp.zeros(0)),
        _single(
            "Veselova", heavy.system, heavy.initial_state(), lambda q, v: jnp.zeros(0)
        ),
        _single(
            "Veselova, no weight",
            free.system,
            free.initial_state(),
            free.horizontal_momentum,
        ),
    ]


class Run(NamedTuple):
    """The measured quantities of one system, with or without an invariant."""

    energy: float
    spread: float
    violation: float
    iterations: float
    microseconds: float
    others: list[float]
    samples: np.ndarray


def measure(
    case: Case, stages: int, duration: float, kept: Any, fallback: bool = False
) -> Run:
    """Run one system with the invariants `kept`."""
    num_steps = round(duration / STEP)
    every = max(1, num_steps // SAVED)
    system = case.system

    def saved(t, y, args):
        return system.energy(t, y, args), case.others(y.q, y.v)

    @jax.jit
    @jax.vmap
    def run(y0):
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages),
            y0,
            dt=STEP,
            num_steps=num_steps,
            saveat=nhjax.SaveAt(t0=True, steps=every, fn=saved),
            invariants=kept,
            stage_solver=nhjax.SimplifiedNewton(fallback=fallback),
        )

    compiled = run.lower(case.y0).compile()
    start = time.process_time()
    sol = jax.block_until_ready(compiled(case.y0))
    spent = time.process_time() - start
    energies, others = map(np.asarray, sol.ys)
    scale = max(abs(energies[0, 0]), float(0.5 * case.y0.p[0] @ case.y0.v[0]))
    errors = (energies - energies[:, :1]) / scale
    taken = num_steps * errors.shape[0]
    changes = np.max(np.abs(others - others[:, :1]), axis=(0, 1))
    samples = np.zeros((errors.shape[0], 0))
    if case.name == "chaotic":
        samples = others[:, np.asarray(sol.ts)[0] > min(FORGOTTEN, duration / 2), 0]
    return Run(
        float(np.max(np.abs(errors))),
        float(np.sqrt(np.mean(errors[:, -1] ** 2))),
        float(np.max(sol.stats["max_constraint_violation"])),
        float(np.sum(sol.stats["num_iterations"])) / taken,
        1e6 * spent / taken,
        [float(x) for x in changes],
        samples,
    )


def _mean(samples: np.ndarray) -> tuple[float, float]:
    """Compute the mean over time and members, and its standard error over members."""
    means = np.mean(samples, axis=1)
    return float(np.mean(means)), float(np.std(means) / np.sqrt(len(means)))


def _distance(x: np.ndarray, y: np.ndarray) -> float:
    """Compute the Kolmogorov-Smirnov distance of two sets of samples."""
    at = np.sort(np.concatenate([x.ravel(), y.ravel()]))
    ranks = (np.searchsorted(np.sort(z.ravel()), at, "right") / z.size for z in (x, y))
    return float(np.max(np.abs(np.subtract(*ranks))))


def row(case: Case, stages: int, duration: float) -> dict[str, Any]:
    """Compare runs with and without conserved energy."""
    plain, kept = (measure(case, stages, duration, x) for x in (None, "energy"))
    found: dict[str, Any] = {
        "system": case.name,
        "duration": duration,
        "stages": stages,
        "energy": [plain.energy, kept.energy],
        "violation": [plain.violation, kept.violation],
        "iterations": [plain.iterations, kept.iterations],
        "microseconds": [plain.microseconds, kept.microseconds],
    }
    if case.name == "chaotic":
        halves = plain.samples[::2], plain.samples[1::2]
        found |= {
            "members": len(plain.samples),
            "energy at the end, rms": [plain.spread, kept.spread],
            "mean of ‖q‖²": _mean(plain.samples),
            "difference of means": _mean(kept.samples - plain.samples),
            "KS of the two ways": _distance(plain.samples, kept.samples),
            "KS of two halves": _distance(*halves),
        }
    elif plain.others:
        found["others"] = [plain.others, kept.others]
    return found


def both_energies_of_the_cvt(stages: int, duration: float) -> dict[str, Any]:
    """Conserve the energies of driver and passenger separately.

    The fallback is needed: when the passenger is nearly at rest and the driver is not,
    `SimplifiedNewton` converges very slowly.
    """
    case = next(case for case in _cases(2) if case.name == "CVT")

    def kept(t, q, v, args):
        return case.others(q, v)

    run = measure(case, stages, duration, kept, fallback=True)
    return {"stages": stages, "others": run.others, "iterations": run.iterations}


def _table(rows: list[dict[str, Any]]) -> str:
    header = ["system", "t", "s", "energy: plain", "kept", "sweeps: plain", "kept"]
    header += ["time: kept / plain", "violation: plain", "kept"]
    table = []
    for x in rows:
        first, second = x["microseconds"]
        table.append(
            [
                x["system"],
                f"{x['duration']:g}",
                str(x["stages"]),
                *map(number, x["energy"]),
                *(f"{n:.2f}" for n in x["iterations"]),
                f"{second / first:.2f}",
                *map(number, x["violation"]),
            ]
        )
    return markdown_table(header, table)


def _chaotic_table(rows: list[dict[str, Any]]) -> str:
    header = ["t", "s", "members", "energy at the end, rms: plain", "kept"]
    header += ["mean of ‖q‖²: plain", "kept - plain"]
    header += ["KS of the two ways", "of two halves"]
    table = []
    for x in (x for x in rows if x["system"] == "chaotic"):
        means = x["mean of ‖q‖²"], x["difference of means"]
        table.append(
            [
                f"{x['duration']:g}",
                str(x["stages"]),
                str(x["members"]),
                *map(number, x["energy at the end, rms"]),
                *(f"{mean:.4f} ± {error:.4f}" for mean, error in means),
                f"{x['KS of the two ways']:.4f}",
                f"{x['KS of two halves']:.4f}",
            ]
        )
    return markdown_table(header, table)


def _others_table(rows: list[dict[str, Any]], both: list[dict[str, Any]]) -> str:
    header = ["system", "t", "s", "largest changes: plain", "energy kept", "both kept"]
    kept = {x["stages"]: x["others"] for x in both}
    table = []
    for x in (x for x in rows if "others" in x):
        is_first = x["duration"] == rows[0]["duration"]
        third = kept[x["stages"]] if x["system"] == "CVT" and is_first else []
        cells = [", ".join(map(number, values)) for values in (*x["others"], third)]
        table.append([x["system"], f"{x['duration']:g}", str(x["stages"]), *cells])
    return markdown_table(header, table)


def main() -> None:
    """Measure all systems, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=1e4, help="t of all systems")
    parser.add_argument("--long", type=float, default=1e5, help="t of a second round")
    parser.add_argument("--members", type=int, default=96, help="of the ensemble")
    parser.add_argument("--fewer", type=int, default=24, help="members, second round")
    parser.add_argument("--quick", action="store_true", help="t = 50 and two stages")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rounds = {asked.duration: asked.members, asked.long: asked.fewer}
    rounds = {50.0: 4} if asked.quick else rounds
    chosen = (2,) if asked.quick else (2, 3, 4)
    first = next(iter(rounds))
    both = [both_energies_of_the_cvt(stages, first) for stages in chosen]
    rows = [
        row(case, stages, duration)
        for duration, members in rounds.items()
        for case in _cases(members)
        for stages in chosen
    ]
    text = "\n\n".join(
        [
            _table(rows),
            "The chaotic ensemble:",
            _chaotic_table(rows),
            "Energies of driver and passenger (CVT), horizontal momentum (Veselova):",
            _others_table(rows, both),
        ]
    )
    title = f"The energy kept, h = {STEP}"
    write("invariants", title, text, {"rows": rows, "both energies of the CVT": both})


if __name__ == "__main__":
    main()
