"""Machines over a long time: the balance of energy and work, and the constraints.

Each machine of the gallery runs with three stages for 1000 s, except for Andrews'
squeezer, which runs for 1 s. The balance of energy and work is

    E(t) - E(0) = ∫ F·v + λᵀB v - ∂L/∂t dt.

The integrand is the power of forces, of moving constraints and of the explicit time
dependence of L. It is integrated along the run by a spline of degree 7. The table has
the largest residual of this balance in the first tenth of the run and in the whole run,
relative to the largest kinetic energy. If the column of powers has "none", the
integrand vanishes, and the balance is the conservation of energy.

    python -m benchmarks.long_runs
"""

import argparse
import time
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy.interpolate import make_interp_spline

import nhjax
from docs.machines import machines
from nhjax import systems

from ._report import markdown_table, number, write


DURATION = 1000.0
STAGES = 3
# The duration of the squeezer is shorter, because the constant torque of its motor
# accelerates it without limit.
SHORTER = {"AndrewsSqueezer": 1.0}
# The machines below need smaller steps than their pictures in the gallery. For example,
# gaits accelerate their machines to 9 and 60 m/s, and the crank turns by 0.6 rad in a
# step of its picture. Other machines use the step of their picture.
FINER = {
    "Snakeboard": 0.01,
    "RollerRacer": 0.0025,
    "Rattleback": 0.001,
    "SliderCrank": 0.001,
    "FourBar": 0.005,
    "AndrewsSqueezer": 2e-5,
    "CarAxis": 0.005,
}
# The number of saved energies of a conservative run. Other runs save each step.
SAMPLES = 20_000
# The source of the work on each machine that is not conservative.
POWERED = {
    "Snakeboard": "gait",
    "RollerRacer": "gait",
    "AndrewsSqueezer": "motor",
    "CarAxis": "road",
    "BallInBowl": "turning bowl",
}


class Case(NamedTuple):
    """A machine, the step and the duration of its run, and the source of work on it."""

    name: str
    example: Any
    dt: float
    duration: float
    power: str = ""


def cases() -> list[Case]:
    """Return the machines of the gallery, and variants of them with forces."""
    found = [
        Case(
            machine.name,
            machine.example,
            FINER.get(machine.name, machine.duration / machine.num_steps),
            SHORTER.get(machine.name, DURATION),
            POWERED.get(machine.name, ""),
        )
        for machine in machines()
    ]
    rider = systems.WhippleBicycle.running(
        3.0, lean_rate=0.3, steering=systems.LeanToSteer()
    )
    (stone,) = (case for case in found if case.name == "Rattleback")
    # The rattleback also runs with larger steps. The step of its picture is too large
    # for such a long run.
    found += [stone._replace(dt=dt) for dt in (0.002, 0.004)]
    damped = systems.Rattleback.spinning(5.0, (0.5, 0.5), damping=1e-4)
    found.insert(1, Case("WhippleBicycle, steered", rider, 0.02, DURATION, "rider"))
    found.append(
        Case("Rattleback, damped", damped, FINER["Rattleback"], DURATION, "damping")
    )
    return found


def balance(case: Case) -> dict[str, Any]:
    """Run a machine, and return its row of the table."""
    system, y0 = case.example.system, case.example.initial_state()
    num_steps = round(case.duration / case.dt)
    every = 1 if case.power else max(1, num_steps // SAMPLES)

    def run():
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(STAGES),
            y0,
            dt=case.dt,
            num_steps=num_steps,
            saveat=nhjax.SaveAt(t0=True, steps=every),
        )

    # The first call compiles. If the first solver fails, it also compiles the second.
    jax.block_until_ready(run())
    start = time.process_time()
    sol = jax.block_until_ready(run())
    spent = time.process_time() - start

    @jax.jit
    @jax.vmap
    def energies(t, y):
        return system.energy(t, y, None), 0.5 * y.p @ y.v

    energy, kinetic = map(np.asarray, energies(sol.ts, sol.ys))
    if case.power:
        rates = np.asarray(jax.jit(jax.vmap(_power(system)))(sol.ts, sol.ys))
        work = make_interp_spline(np.asarray(sol.ts), rates, k=7).antiderivative()
        energy = energy - (work(sol.ts) - work(0.0))
    errors = np.abs(energy - energy[0]) / np.max(kinetic)
    return {
        "machine": case.name,
        "power": case.power or "none",
        "dt": case.dt,
        "duration": case.duration,
        "first tenth": np.max(errors[: len(errors) // 10 + 1]),
        "all": np.max(errors),
        "violation": float(sol.stats["max_constraint_violation"]),
        "by Newton": int(sol.stats["num_newton_steps"]),
        "seconds": spent,
    }


def _power(system: Any) -> Any:
    def power(t, y):
        reaction = nhjax.motion(system, t, y).reaction
        force = 0.0 if system.force is None else system.force(t, y.q, y.v, None)
        lost = jax.grad(system.lagrangian)(t, y.q, y.v, None)
        return (reaction + force) @ y.v - lost

    return power


def main() -> None:
    """Print and save the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--machines", nargs="+", help="a part of the names")
    names = parser.parse_args().machines
    jax.config.update("jax_enable_x64", True)
    data = []
    for case in cases():
        if names and case.name not in names:
            continue
        data.append(balance(case))
        print(*data[-1].values(), sep="\t", flush=True)
        jax.clear_caches()
    header = [
        "machine", "power of", "dt, s", "duration, s", "energy, first tenth",
        "energy, all", "constraints", "steps by Newton", "CPU s",
    ]  # fmt: skip
    rows = [
        [
            row["machine"],
            row["power"],
            f"{row['dt']:.3g}",
            f"{row['duration']:g}",
            *(number(row[key]) for key in ("first tenth", "all", "violation")),
            str(row["by Newton"]),
            f"{row['seconds']:.1f}",
        ]
        for row in data
    ]
    text = (
        "The largest error of the balance of energy and work in the first tenth of a "
        "run with three stages and in all of it, relative to the largest kinetic "
        "energy; the largest violation of a constraint, in its own unit; how many "
        "steps simplified Newton left to Newton; and seconds of the processor to run, "
        "without compiling.\n\n"
    )
    text += markdown_table(header, rows)
    write("long_runs", "Machines over a long time", text, {"rows": data})


if __name__ == "__main__":
    main()
