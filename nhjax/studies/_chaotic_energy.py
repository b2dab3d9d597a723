"""The mean squared energy error of an ensemble of chaotic motions."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, TYPE_CHECKING

import numpy as np

from .._method import LobattoIIIAB
from ..systems import ChaoticSystem
from ._arguments import (
    ArgumentError,
    check_at_least_one,
    check_distinct,
    check_positive,
    check_stages,
    check_step_sizes,
    whole_steps,
)
from ._chaotic_figure import chaotic_figure
from ._chaotic_run import Case, chaotic_run, ChaoticRun, WINDOW
from ._result import AbstractStudyResult
from ._table import format_slope, format_table, slopes


if TYPE_CHECKING:
    from matplotlib.figure import Figure


TIMES = (10.0, 50.0, 100.0, 200.0)


@dataclasses.dataclass(frozen=True)
class ChaoticEnergy(AbstractStudyResult):
    """The runs of a chaotic-energy study, h falling for each s."""

    name: ClassVar[str] = "chaotic-energy"

    stages: tuple[int, ...]
    dt: tuple[float, ...]
    final_time: float
    members: int
    closure: str
    times: tuple[float, ...]
    save_every: int
    runs: list[ChaoticRun]

    def of_stages(self, s: int) -> list[ChaoticRun]:
        """Return the runs with `s` stages, with falling step size h."""
        return [run for run in self.runs if run.stages == s]

    def slopes(self, s: int) -> np.ndarray:
        """Return log-log slopes of the window means, of shape (step sizes, times).

        The first row is NaN: there is no larger step to compare with.
        """
        means = np.stack([run.windows for run in self.of_stages(s)])
        return slopes(self.dt, means)

    def parameters(self) -> dict[str, Any]:
        """Return every parameter of the computation, initial data included."""
        return {
            "stages": self.stages,
            "dt": self.dt,
            "num_steps": [whole_steps(self.final_time, h) for h in self.dt],
            "final_time": self.final_time,
            "members": self.members,
            "closure": self.closure,
            "stage_solver": "SimplifiedNewton",
            "times": self.times,
            "window": WINDOW,
            "save_every": self.save_every,
            "system": "ChaoticSystem",
            "system_parameters": {"m": ChaoticSystem().m},
            "initial_data": {
                "J": self.members,
                "j": f"0..{self.members}",
                "q0": "(cos(jπ/2J), 0.6, 0.4, 0.2, 1, 1, 1)",
                "v0": "(0, sin(jπ/2J), 0, 0, 0, 0, 0)",
                "E0": 3.06,
                "multiplier": "continuous, from the hidden constraint",
            },
        }

    def summary(self) -> dict[str, Any]:
        """Return the results in short, with timings."""
        entries = []
        for s in self.stages:
            for run, slope in zip(self.of_stages(s), self.slopes(s), strict=True):
                means = run.windows
                entry = {
                    "stages": s,
                    "dt": run.dt,
                    "mu": means,
                    "mu_error": run.windows_error,
                    "mu_over_h^{4(s-1)}": means / run.dt ** (4 * (s - 1)),
                    "slopes": slope,
                    "expected_slope": 4 * (s - 1),
                    "mean_iterations": run.mean_iterations,
                    "max_constraint_violation": run.max_constraint_violation,
                    **dataclasses.asdict(run.timing),
                }
                entries.append(entry)
        return {
            "times": self.times,
            "runs": entries,
            "compile_seconds": sum(run.timing.compile_seconds for run in self.runs),
            "run_seconds": sum(run.timing.run_seconds for run in self.runs),
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the data behind the figure, by name."""
        data = {}
        for run in self.runs:
            key = f"s{run.stages}_h{run.dt:.6g}"
            data[f"{key}_times"] = run.times
            data[f"{key}_mu"] = run.mu
            data[f"{key}_mu_error"] = run.mu_error
        return data

    def table(self) -> str:
        """Write a table of μ/h^{4(s-1)} and the slopes of μ at the times."""
        header = ["s", "h", "4(s-1)"]
        header += [f"μ/h^4(s-1) t={t:g} ± error" for t in self.times]
        header += [f"slope t={t:g}" for t in self.times]
        header += ["compile s", "run s"]
        rows = []
        for s in self.stages:
            for run, slope in zip(self.of_stages(s), self.slopes(s), strict=True):
                power = 4 * (s - 1)
                scaled = run.windows / run.dt**power
                errors = run.windows_error / run.dt**power
                pairs = zip(scaled, errors, strict=True)
                values = [f"{x:.3g} ± {y:.1g}" for x, y in pairs]
                rows.append(
                    [str(s), f"{run.dt:.6g}", str(power)]
                    + values
                    + [format_slope(x) for x in slope]
                    + [f"{run.timing.compile_seconds:.2f}"]
                    + [f"{run.timing.run_seconds:.2f}"]
                )
        return format_table(header, rows)

    def verdict(self) -> str:
        """Say with which power of h the mean squared error goes."""
        powers = {s: self.slopes(s)[-1] for s in self.stages}
        if not all(np.all(np.isfinite(x)) for x in powers.values()):
            return "no power of h can be seen: it takes two step sizes"
        found = ", ".join(
            f"h^{np.mean(x):.1f} for s = {s} (4(s - 1) = {4 * (s - 1)})"
            for s, x in powers.items()
        )
        return f"μ goes as {found}, averaged over the times"

    def figures(self) -> "dict[str, Figure]":
        """Draw μ against time in both normalisations, ours and the paper's."""
        curves = [
            (run.stages, run.dt, run.times, run.mu, run.mu_error) for run in self.runs
        ]
        title = f"J = {self.members}, {self.closure} closure"
        return {self.name: chaotic_figure(curves, title)}


def chaotic_energy(
    *,
    stages: Sequence[int] = (2, 3, 4),
    dt: Sequence[float] = (0.1, 0.2),
    final_time: float = 200.0,
    members: int = 100,
    closure: str = "propagated",
    times: Sequence[float] | None = None,
    save_every: int = 1,
    progress: bool = False,
) -> ChaoticEnergy:
    """Compute the mean squared energy error of an ensemble of the chaotic system.

    The paper's third experiment, J + 1 motions of a system with 7 degrees of freedom on
    one energy surface. μ(E, k), the mean of (E_jk - E_0)² over the ensemble at step k,
    is found to go as h^{4(s-1)}. Every motion is chaotic: only such statistics can be
    compared. Members run in chunks and statistics are collected on the way, so that
    memory does not grow with J; μ has an error bar, its standard error.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h, each of which must divide `final_time`.
    - `final_time`: the length of each run.
    - `members`: the paper's J.
    - `closure`: of the multipliers, as for `nhjax.LobattoIIIAB`; the paper's by
        default.
    - `times`: when to report μ, as means over a window of ±5; 10, 50, 100 and 200 as
        far as the run goes (its end if it is shorter) by default.
    - `save_every`: save energies after every this many steps.
    - `progress`: show a bar for each run on the standard error stream.

    **Returns:** a `ChaoticEnergy`.

    **Raises:** `ArgumentError` for arguments that cannot be right, and
    `nhjax.IntegrationError` if a step cannot be solved.
    """
    check_stages(stages)
    check_step_sizes(dt)
    check_positive("final_time", final_time)
    check_at_least_one("members", members)
    check_at_least_one("save_every", save_every)
    if times is None:
        times = [t for t in TIMES if t <= final_time] or [final_time]
    check_distinct("times", times)
    for t in times:
        if not 0 < t <= final_time:
            raise ArgumentError("times", f"must lie within the run, got {t:g}")
    dt = tuple(sorted(dt, reverse=True))
    num_steps = {h: whole_steps(final_time, h) for h in dt}
    for h in dt:
        if save_every * h > WINDOW:
            name, value = ("dt", h) if save_every == 1 else ("save_every", save_every)
            raise ArgumentError(
                name, f"must leave samples in a window of ±{WINDOW:g}, got {value:g}"
            )
    runs = [
        chaotic_run(case, members, times, progress)
        for case in (
            Case(LobattoIIIAB(s, closure), h, n, save_every)
            for s in stages
            for h, n in num_steps.items()
        )
    ]
    return ChaoticEnergy(
        stages=tuple(stages),
        dt=dt,
        final_time=final_time,
        members=members,
        closure=closure,
        times=tuple(times),
        save_every=save_every,
        runs=runs,
    )
