"""The two charts of a step on a group: reversal, energy over long runs, and cost.

The origin of the chart is at the start of the step, as in the paper, or in its middle.
For each system, retraction, number of stages and chart, this benchmark measures:

- the distance from the initial state after 50 steps of h and 50 steps of -h;
- the largest relative error of the energy in the first tenth of a long run and in the
  whole run, which distinguishes a drift from an oscillation;
- the iterations per step, and the time of a step relative to its time with the chart at
  the start.
"""

import argparse
import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import systems
from nhjax._manifold import AbstractRetraction

from ._examples import of_the_gallery, suslov_in_a_potential
from ._report import markdown_table, number, write


STEP, THERE_AND_BACK = 0.1, 50
CHARTS = ("start", "middle")
RETRACTIONS = {"cay": nhjax.Cayley(), "exp": nhjax.Exponential()}


def _uneven_ball(retraction: AbstractRetraction) -> systems.TurntableBall:
    """Create a ball with three different moments of inertia on a table at rest.

    The table does not turn, so that the energy is conserved.
    """
    return systems.TurntableBall.rolling(
        (0.5, -0.2),
        (0.4, 0.3),
        0.7,
        moments=(0.3, 0.4, 0.5),
        rate=0.0,
        retraction=retraction,
    )


SYSTEMS = {
    "Suslov in a potential": suslov_in_a_potential,
    "Suslov": of_the_gallery(systems.Suslov),
    "Veselova": of_the_gallery(systems.Veselova),
    "heavy top": of_the_gallery(systems.HeavyTop),
    "unicycle": of_the_gallery(systems.Unicycle),
    "uneven ball": of_the_gallery(_uneven_ball),
}


class Row(NamedTuple):
    """The measured quantities for one chart of one system."""

    system: str
    retraction: str
    stages: int
    chart: str
    there_and_back: float
    energy_early: float
    energy: float
    iterations: float
    microseconds: float


def measure(
    name: str, retraction: str, stages: int, chart: str, duration: float
) -> Row:
    """Run one system with one chart."""
    system, y0 = SYSTEMS[name](retraction=RETRACTIONS[retraction])
    method = nhjax.LobattoIIIAB(stages, chart=chart)
    num_steps = round(duration / STEP)
    every = max(1, num_steps // 2000)

    def energy(t, y, args):
        return y.p @ y.v - system.lagrangian(t, y.q, y.v, args)

    @jax.jit
    def run(y0, dt):
        return nhjax.integrate(
            system,
            method,
            y0,
            dt=dt,
            num_steps=num_steps,
            saveat=nhjax.SaveAt(t0=True, steps=every, fn=energy),
            throw=False,
        )

    @jax.jit
    def short(y0, dt):
        options = {"num_steps": THERE_AND_BACK, "throw": False}
        ys = nhjax.integrate(system, method, y0, dt=dt, **options).ys
        return jax.tree.map(lambda x: x[-1], ys)

    dt = jnp.asarray(STEP)
    back = short(short(y0, dt), -dt)
    change = jax.tree.map(lambda x, y: np.max(np.abs(x - y), initial=0.0), back, y0)
    sol = jax.block_until_ready(run(y0, dt))
    start = time.process_time()
    jax.block_until_ready(run(y0, dt))
    spent = time.process_time() - start
    values = np.asarray(sol.ys)
    # The energy of a motion may be near zero. The scale of its errors is therefore the
    # larger of the energy and the kinetic energy.
    scale = max(abs(values[0]), float(0.5 * y0.p @ y0.v))
    errors = np.abs(values - values[0]) / scale
    return Row(
        name,
        retraction,
        stages,
        chart,
        max(jax.tree.leaves((change.q, change.v))),
        float(np.max(errors[: len(errors) // 10])),
        float(np.max(errors)),
        float(sol.stats["num_iterations"]) / num_steps,
        1e6 * spent / num_steps,
    )


def main() -> None:
    """Measure all systems, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=1e4, help="t of long runs")
    parser.add_argument("--quick", action="store_true", help="t = 100 and two stages")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    duration = 100.0 if asked.quick else asked.duration
    rows = [
        measure(name, retraction, stages, chart, duration)
        for name in SYSTEMS
        for retraction in RETRACTIONS
        for stages in ((2,) if asked.quick else (2, 3, 4))
        for chart in CHARTS
    ]
    header = ["system", "τ", "s", "h, then -h: start", "middle", "energy: start"]
    header += ["middle", "middle / start", "first tenth: start", "middle"]
    header += ["iterations: start", "middle", "time: middle / start"]
    table = []
    for paper, middle in zip(rows[::2], rows[1::2], strict=True):
        table.append(
            [
                paper.system,
                paper.retraction,
                str(paper.stages),
                number(paper.there_and_back),
                number(middle.there_and_back),
                number(paper.energy),
                number(middle.energy),
                f"{middle.energy / paper.energy:.2f}",
                number(paper.energy_early),
                number(middle.energy_early),
                f"{paper.iterations:.1f}",
                f"{middle.iterations:.1f}",
                f"{middle.microseconds / paper.microseconds:.2f}",
            ]
        )
    title = f"Two charts on a group, h = {STEP}, t = {duration:g}"
    data = {"rows": [row._asdict() for row in rows]}
    write("charts", title, markdown_table(header, table), data)


if __name__ == "__main__":
    main()
