"""A comparison of the closures of the multiplier on systems of the gallery, s = 2..5.

For each closure, the table has the order of (q, v), the symmetry defect (the distance
from the start after 50 steps of h and 50 steps of -h), the largest energy error in the
first and the last fifth of a long run, and the largest |Λ^s - λ_c| of the long run.
"""

import argparse
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems
from nhjax.systems._base import AbstractConstrainedExample

from ._reference import reference
from ._report import markdown_table, number, write


CLOSURES = ("propagated", "consistent", "symmetric")


class Case(NamedTuple):
    """A system, the time of its order test, and the step and time of its long run."""

    name: str
    example: AbstractConstrainedExample
    order_time: float
    dt: float
    long_time: float


def cases() -> list[Case]:
    """Return constrained systems of the gallery."""
    cvt = systems.ContinuouslyVariableTransmission
    return [
        Case("particle", systems.NonholonomicParticle(), 3.0, 0.1, 2000.0),
        Case("CVT low", cvt.low(), 2.0, 0.1, 2000.0),
        Case("CVT high", cvt.high(), 2.0, 0.1, 2000.0),
        Case("chaotic", systems.ChaoticSystem(), 2.0, 0.1, 1000.0),
        Case("sleigh", systems.ChaplyginSleigh(), 1.6, 0.1, 200.0),
        Case("knife edge", systems.KnifeEdge(), 3.0, 0.1, 1000.0),
        Case("rolling disc", systems.VerticalRollingDisc(), 3.0, 0.1, 1000.0),
        # λ ~ 1/ż is singular where ż passes zero. The run ends before this time.
        Case("Appell", systems.Appell(), 1.0, 0.01, 1.0),
    ]


class Measured(NamedTuple):
    """One row of the table."""

    order: float
    end_error: float
    symmetry_defect: float
    energy_first: float
    energy_last: float
    multiplier_defect: float
    steps: int


def measure(case: Case, stages: int, closure: str, length: float) -> Measured:
    """Measure one system with one number of stages and one closure."""
    method = nhjax.LobattoIIIAB(stages, closure)
    system, y0 = case.example.system, case.example.initial_state()
    order, end_error = observed_order(case, system, method, y0)
    defect = _symmetry_defect(system, method, y0, case.dt)
    first, last, lam, steps = long_run(
        system, method, y0, case.dt, length * case.long_time
    )
    return Measured(order, end_error, defect, first, last, lam, steps)


def observed_order(case, system, method, y0) -> tuple[float, float]:
    t = case.order_time
    try:
        q, v, *_ = case.example.exact(t)  # pyright: ignore[reportAttributeAccessIssue]
    except AttributeError:
        q, v = reference(system, y0, t)
    # These step sizes are so large that errors are above round-off. `Newton` is used,
    # because it converges for such step sizes.
    counts = {2: (32, 64, 128), 3: (16, 32, 64), 4: (8, 16, 32), 5: (6, 12, 24)}
    counts = counts[method.stages]

    # One program runs all step sizes with the same number of steps, so that runs with
    # larger steps continue beyond t.
    @jax.vmap
    def run(dt):
        return nhjax.integrate(
            system,
            method,
            y0,
            dt=dt,
            num_steps=counts[-1],
            saveat=nhjax.SaveAt(steps=True),
            stage_solver=nhjax.Newton(),
            throw=False,
        ).ys

    ys = eqx.filter_jit(run)(t / jnp.asarray(counts, float))
    errors = []
    for lane, count in enumerate(counts):
        dq, dv = ys.q[lane, count - 1] - q, ys.v[lane, count - 1] - v
        errors.append(float(max(jnp.max(jnp.abs(dq)), jnp.max(jnp.abs(dv)))))
    if errors[-1] < 1e-13:
        # Errors at round-off show no order. Use the two larger step sizes instead, if
        # their errors are above round-off.
        errors = errors[:-1]
    if errors[-1] < 1e-13:
        return np.nan, float(errors[-1])
    return float(np.log2(errors[-2] / errors[-1])), float(errors[-1])


def _symmetry_defect(system, method, y0, dt) -> float:
    def run(y, dt):
        sol = nhjax.integrate(system, method, y, dt=dt, num_steps=50)
        return jax.tree.map(lambda x: x[-1], sol.ys)

    back = run(run(y0, dt), -dt)
    return float(max(jnp.max(jnp.abs(back.q - y0.q)), jnp.max(jnp.abs(back.p - y0.p))))


def long_run(system, method, y0, dt, time) -> tuple[float, float, float, int]:
    sol = nhjax.integrate(
        system,
        method,
        y0,
        dt=dt,
        num_steps=round(time / dt),
        saveat=nhjax.SaveAt(steps=True, fn=system.energy),
        throw=False,
    )
    error = np.abs(np.asarray(sol.ys) - float(system.energy(0.0, y0)))
    steps = int(sol.stats["num_steps"])
    fifth = len(error) // 5
    last = np.max(error[-fifth:]) if steps == len(error) else np.nan
    lam = float(sol.stats["max_multiplier_defect"])
    return float(np.max(error[:fifth])), float(last), lam, steps


def _ensemble(stages: int, closure: str, members: int) -> tuple[float, float]:
    """Return mean squared energy errors of the chaotic ensemble near T = 10 and 200."""
    chaotic = systems.ChaoticSystem()
    system, method = chaotic.system, nhjax.LobattoIIIAB(stages, closure)
    q, v = chaotic.ensemble(members)

    @jax.jit
    @jax.vmap
    def energies(q, v):
        y0 = nhjax.initial_state(system, q, v)
        saveat = nhjax.SaveAt(steps=True, fn=system.energy)
        return nhjax.integrate(
            system, method, y0, dt=0.1, num_steps=2000, saveat=saveat
        ).ys

    mu = np.mean((np.asarray(energies(q, v)) - 3.06) ** 2, axis=0)
    return float(np.mean(mu[80:120])), float(np.mean(mu[-40:]))


def verdict(rows: list[tuple[str, int, str, Measured]]) -> tuple[str, str]:
    """Choose the closure with the smallest worst ratio of energy errors.

    The ratio is the energy error of a closure in the last fifth of a run, divided by
    the smallest such error of all closures.
    """
    worst: dict[str, float] = dict.fromkeys(CLOSURES, 1.0)
    for name, stages in {(row[0], row[1]) for row in rows}:
        last = {r[2]: r[3].energy_last for r in rows if r[:2] == (name, stages)}
        # Errors below 1e-13 are round-off, and their ratios would be meaningless.
        last = {k: np.inf if np.isnan(x) else max(x, 1e-13) for k, x in last.items()}
        best = min(last.values())
        for closure, x in last.items():
            worst[closure] = max(worst[closure], x / best)
    choice = min(worst, key=lambda closure: worst[closure])
    listed = ", ".join(f"{k}: {number(x)}" for k, x in worst.items())
    text = (
        "Largest ratio of a closure's last-fifth energy error to that of the best "
        f"closure in the same row: {listed}.\n\nThe default that follows: **{choice}**."
    )
    return choice, text


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stages", type=int, nargs="+", default=[2, 3, 4, 5])
    parser.add_argument(
        "--length", type=float, default=1.0, help="scales the long runs"
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows, lines = [], []
    for case in cases():
        for stages in options.stages:
            for closure in CLOSURES:
                m = measure(case, stages, closure, options.length)
                rows.append((case.name, stages, closure, m))
                lines.append(
                    [
                        case.name,
                        str(stages),
                        closure,
                        f"{m.order:.2f}",
                        number(m.end_error),
                        number(m.symmetry_defect),
                        number(m.energy_first),
                        number(m.energy_last),
                        number(m.multiplier_defect),
                        str(m.steps),
                    ]
                )
                print(*lines[-1], sep="\t", flush=True)
            # Each compiled program uses memory maps, and a process can have only a
            # limited number of them.
            jax.clear_caches()
    header = ["system", "s", "closure", "order", "error", "there and back"]
    header += ["energy, first fifth", "energy, last fifth", "|Λ^s - λ_c|", "steps"]
    ensemble = [
        (stages, closure, *_ensemble(stages, closure, 20))
        for stages in options.stages[:3]
        for closure in CLOSURES
    ]
    choice, text = verdict(rows)
    body = "\n\n".join(
        [
            "An order of nan means that the error is at round-off; an energy of nan "
            "that the run could not be finished (`steps` says how far it came).",
            markdown_table(header, lines),
            text,
            "Mean squared energy error of the chaotic ensemble (J = 20, h = 0.1):",
            markdown_table(
                ["s", "closure", "T = 10", "T = 200"],
                [[str(s), c, number(a), number(b)] for s, c, a, b in ensemble],
            ),
        ]
    )
    data = {
        "rows": [
            {"system": n, "stages": s, "closure": c, **m._asdict()}
            for n, s, c, m in rows
        ],
        "ensemble": ensemble,
        "default": choice,
    }
    write("closures", "The closures of the multiplier", body, data)


if __name__ == "__main__":
    main()
