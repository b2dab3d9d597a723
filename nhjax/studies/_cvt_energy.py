"""Long-term energies of the continuously variable transmission."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from .._integrate import integrate, raise_failures, SaveAt
from .._method import LobattoIIIAB
from .._step import Newton
from ..systems import ContinuouslyVariableTransmission
from ._arguments import (
    ArgumentError,
    check_distinct,
    check_positive,
    check_stages,
    check_step_sizes,
)
from ._result import (
    AbstractStudyResult,
    compile_and_run,
    draw_envelope,
    format_table,
    largest_by_fifths,
    meter,
    Timing,
)


if TYPE_CHECKING:
    from matplotlib.figure import Figure


ENERGIES = ("total", "driver", "passenger")
REGIMES = {
    "low": ContinuouslyVariableTransmission.low,
    "high": ContinuouslyVariableTransmission.high,
}


@dataclasses.dataclass(frozen=True)
class CVTRun:
    """The energies of one run of k steps, at every step.

    - `energies`: shape (k + 1, 3): total, driver and passenger.
    - `timing`: the times to compile and to run one program, which runs all regimes with
      this s and h in one `jax.vmap`.
    """

    regime: str
    stages: int
    dt: float
    times: np.ndarray
    energies: np.ndarray
    max_multiplier_defect: float
    timing: Timing

    @property
    def key(self) -> str:
        """Return the prefix of the names of the run's arrays."""
        return f"{self.regime}_s{self.stages}_h{self.dt:.6g}"

    def deviations(self) -> np.ndarray:
        """Return the energies minus their initial values."""
        return self.energies - self.energies[0]

    def by_fifths(self) -> list[float]:
        """Return max |E - E0| of the total energy over each fifth of the run."""
        return largest_by_fifths(self.deviations()[1:, 0])

    def ranges(self) -> dict[str, tuple[float, float]]:
        """Return the minimum and the maximum deviation of each energy."""
        low, high = self.deviations().min(axis=0), self.deviations().max(axis=0)
        return {
            name: (float(low[i]), float(high[i])) for i, name in enumerate(ENERGIES)
        }


@dataclasses.dataclass(frozen=True)
class CVTEnergy(AbstractStudyResult):
    """Energies of the transmission, for each regime, s and h."""

    name: ClassVar[str] = "cvt-energy"

    final_time: float
    closure: str
    epsilon: float
    short_time: float
    runs: list[CVTRun]

    def parameters(self) -> dict[str, Any]:
        """Return every parameter of the computation, including initial data."""
        regimes = dict.fromkeys(run.regime for run in self.runs)
        examples = {name: REGIMES[name](self.epsilon) for name in regimes}
        return {
            "regimes": list(regimes),
            "stages": list(dict.fromkeys(run.stages for run in self.runs)),
            "dt": list(dict.fromkeys(run.dt for run in self.runs)),
            "final_time": self.final_time,
            "closure": self.closure,
            "stage_solver": "Newton",
            "epsilon": self.epsilon,
            "short_time": self.short_time,
            "system": "ContinuouslyVariableTransmission",
            "initial_data": {
                name: {"q0": np.asarray(cvt.q0), "v0": np.asarray(cvt.v0)}
                for name, cvt in examples.items()
            },
        }

    def summary(self) -> dict[str, Any]:
        """Return a summary of the results, with timings."""
        return {
            "runs": [
                {
                    "regime": run.regime,
                    "stages": run.stages,
                    "dt": run.dt,
                    "num_steps": len(run.times) - 1,
                    "last_time": run.times[-1],
                    "max_energy_error_by_fifths": run.by_fifths(),
                    "ranges": run.ranges(),
                    "max_multiplier_defect": run.max_multiplier_defect,
                    **dataclasses.asdict(run.timing),
                }
                for run in self.runs
            ]
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the data behind the figures, by name."""
        data = {}
        for run in self.runs:
            data[f"{run.key}_times"] = run.times
            data[f"{run.key}_energies"] = run.energies
        return data

    def table(self) -> str:
        """Format a table: energy errors in each fifth of a run, and energy ranges."""
        header = ["regime", "s", "h"]
        header += [f"max|E-E0| {i}/5" for i in range(1, 6)]
        header += ["range of ΔE_d", "range of ΔE_p", "run s"]
        rows = []
        for run in self.runs:
            ranges = run.ranges()
            rows.append(
                [run.regime, str(run.stages), f"{run.dt:.6g}"]
                + [f"{x:.2e}" for x in run.by_fifths()]
                + [
                    f"[{low:.3g}, {high:.3g}]"
                    for low, high in (ranges["driver"], ranges["passenger"])
                ]
                + [f"{run.timing.run_seconds:.2f}"]
            )
        return format_table(header, rows)

    def verdict(self) -> str:
        """State in which runs the energy error grows."""
        grown = []
        for run in self.runs:
            fifths = run.by_fifths()
            if (growth := max(fifths) / fifths[0]) > 1.2:
                name = f"{run.regime}, s = {run.stages}, h = {run.dt:.4g}"
                grown.append(f"{name} ({growth:.1f}-fold)")
        if not grown:
            return "the energy error does not grow after the first fifth of any run"
        return f"the energy error grows after the first fifth in: {'; '.join(grown)}"

    def figures(self) -> "dict[str, Figure]":
        """Draw short-term and long-term energy errors of each regime and step size."""
        cases = dict.fromkeys((run.regime, run.dt) for run in self.runs)
        return {
            f"{self.name}-{regime}-h{h:.4g}": self._figure(regime, h)
            for regime, h in cases
        }

    def _figure(self, regime: str, h: float) -> "Figure":
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10, 8), layout="constrained")
        axes = figure.subplots(3, 2, sharex="col", sharey="row")
        runs = [run for run in self.runs if (run.regime, run.dt) == (regime, h)]
        # Draw the least accurate run first, so that it does not hide the others.
        for i, run in enumerate(sorted(runs, key=lambda run: run.stages)):
            style = {"color": f"C{i}", "label": f"s = {run.stages}"}
            short = run.times <= self.short_time
            for row, deviation in zip(axes, run.deviations().T, strict=True):
                for ax, part in zip(row, (short, slice(None)), strict=True):
                    draw_envelope(ax, run.times[part], deviation[part], **style)
        for row, name in zip(axes, ENERGIES, strict=True):
            row[0].set_ylabel(f"{name} energy, $E - E_0$")
        for ax, title in zip(axes[0], ("short term", "long term"), strict=True):
            ax.set_title(title)
        for ax in axes[-1]:
            ax.set_xlabel("time $t$")
        axes[0, 1].legend(loc="upper right")
        figure.suptitle(
            f"CVT, {regime} energy, $h$ = {h:.4g}, $\\epsilon$ = {self.epsilon:g}, "
            f"{self.closure} closure"
        )
        return figure


def cvt_energy(
    *,
    regimes: Sequence[str] = ("low", "high"),
    stages: Sequence[int] = (2,),
    dt: Sequence[float] = (0.1, math.pi / 10),
    final_time: float = 5000.0,
    closure: str = "propagated",
    epsilon: float = 0.5,
    short_time: float = 100.0,
    progress: bool = False,
) -> CVTEnergy:
    """Compute the energies of the CVT, of its driver and of its passenger in long runs.

    This is the second experiment of the paper, on a continuously variable transmission
    (CVT). The driver is a pendulum, which oscillates at low energy and rotates at high
    energy. In the exact motion, the energies of the driver and of the passenger are
    conserved separately.

    **Arguments:**

    - `regimes`: the energies of the driver: `"low"`, `"high"` or both.
    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h.
    - `final_time`: the length of each run, rounded to a whole number of steps.
    - `closure`: the closure of the multipliers, as for `nhjax.LobattoIIIAB`; by default
        the closure of the paper.
    - `epsilon`: the perturbation ε of the pendulum's potential.
    - `short_time`: the length of the time interval in the figures of short-term errors.
    - `progress`: whether to show a progress bar for each s and h on the standard error
        stream.

    **Returns:** a `CVTEnergy`.

    **Raises:** `ArgumentError` for invalid arguments, and `nhjax.IntegrationError` if a
    step cannot be solved.
    """
    check_distinct("regimes", regimes)
    for regime in regimes:
        if regime not in REGIMES:
            raise ArgumentError(
                "regimes", f"must be among {list(REGIMES)}, got {regime!r}"
            )
    check_stages(stages)
    check_step_sizes(dt)
    check_positive("final_time", final_time)
    check_positive("short_time", short_time)
    if not (math.isfinite(epsilon) and epsilon >= 0):
        raise ArgumentError("epsilon", f"must be at least 0, got {epsilon:g}")
    for h in dt:
        if final_time < 5 * h:
            raise ArgumentError("final_time", f"must hold 5 steps of {h:g}")
    runs = []
    for s in stages:
        for h in dt:
            method = LobattoIIIAB(s, closure)
            runs += _runs(regimes, method, h, final_time, epsilon, progress)
    runs.sort(key=lambda run: regimes.index(run.regime))
    return CVTEnergy(
        final_time=final_time,
        closure=closure,
        epsilon=epsilon,
        short_time=short_time,
        runs=runs,
    )


def _runs(
    regimes: Sequence[str],
    method: LobattoIIIAB,
    h: float,
    final_time: float,
    epsilon: float,
    progress: bool,
) -> list[CVTRun]:
    """Run all regimes in one `jax.vmap`."""
    cvt = ContinuouslyVariableTransmission(epsilon)
    system = cvt.system

    def energies(t, y, args):
        parts = cvt.driver_energy(y.q, y.v), cvt.passenger_energy(y.q, y.v)
        return jnp.stack([system.energy(t, y, args), *parts])

    def run(y0):
        return integrate(
            system,
            method,
            y0,
            dt=h,
            num_steps=round(final_time / h),
            saveat=SaveAt(t0=True, steps=True, fn=energies),
            # For the rotating driver, h = π/10 is a large step, which needs Newton's
            # method.
            stage_solver=Newton(),
            throw=False,
            progress_meter=meter(progress, f"s = {method.stages}, h = {h:.4g}"),
        )

    starts = [REGIMES[regime](epsilon).initial_state() for regime in regimes]
    y0 = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    sol, timing = compile_and_run(jax.vmap(run), y0)
    raise_failures(sol)
    ts, ys, stats = jax.tree.map(np.asarray, (sol.ts, sol.ys, sol.stats))
    defect = stats["max_multiplier_defect"]
    return [
        CVTRun(regime, method.stages, h, ts[i], ys[i], float(defect[i]), timing)
        for i, regime in enumerate(regimes)
    ]
