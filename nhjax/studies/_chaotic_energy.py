"""The mean squared energy error of an ensemble of chaotic motions."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._ensemble import ensemble, EnsembleOutcome, Maximum, Mean, Variance
from .._errors import IntegrationError
from .._initial import initial_state
from .._integrate import integrate, SaveAt
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
from ._result import (
    AbstractStudyResult,
    format_slope,
    format_table,
    meter,
    slopes,
    Timing,
)


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


TIMES = (10.0, 50.0, 100.0, 200.0)
# The mean squared energy error μ(E, k) is averaged over an interval that extends this
# far on each side of a time, because the value of μ at one step fluctuates with the
# fast motion of the system.
WINDOW = 5.0
# The largest number of members that run at a time, and the largest number of bytes of
# their saved energies, so that memory does not grow with the number of members.
CHUNK, CHUNK_BYTES = 1000, 2**26
# The powers of h by which the figure of the paper divides μ.
PAPER_POWERS = {2: 4, 3: 10}


@dataclasses.dataclass(frozen=True)
class ChaoticRun:
    """The run of the ensemble with one method and one step size.

    - `mu`, `mu_error`: the mean squared energy error μ(E, k) at the saved times, and
        its standard error σ/√N over the N members.
    - `windows`, `windows_error`: the mean squared error averaged over a window around
        each reported time, and its standard error.
    """

    stages: int
    dt: float
    times: np.ndarray
    mu: np.ndarray
    mu_error: np.ndarray
    windows: np.ndarray
    windows_error: np.ndarray
    mean_iterations: float
    max_constraint_violation: float
    timing: Timing


@dataclasses.dataclass(frozen=True)
class ChaoticEnergy(AbstractStudyResult):
    """The runs of a chaotic-energy study, with decreasing h for each s."""

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
        """Return the runs with `s` stages, with decreasing step size h."""
        return [run for run in self.runs if run.stages == s]

    def slopes(self, s: int) -> np.ndarray:
        """Return log-log slopes of the window means, of shape (step sizes, times).

        The first row is NaN, because there is no larger step size to compare with.
        """
        means = np.stack([run.windows for run in self.of_stages(s)])
        return slopes(self.dt, means)

    def parameters(self) -> dict[str, Any]:
        """Return every parameter of the computation, including initial data."""
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
        """Return a summary of the results, with timings."""
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
        """Format a table of μ/h^{4(s-1)} and of the slopes of μ at the times."""
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
        """State with which power of h the mean squared error scales."""
        powers = {s: self.slopes(s)[-1] for s in self.stages}
        if not all(np.all(np.isfinite(x)) for x in powers.values()):
            return "no power of h can be observed: it takes two step sizes"
        found = ", ".join(
            f"h^{np.mean(x):.1f} for s = {s} (4(s - 1) = {4 * (s - 1)})"
            for s, x in powers.items()
        )
        return f"μ scales as {found}, averaged over the times"

    def figures(self) -> "dict[str, Figure]":
        """Draw μ against time, divided by h^{4(s-1)} and by the paper's power of h."""
        title = f"J = {self.members}, {self.closure} closure"
        return {self.name: _figure(self.runs, title)}


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

    This is the third experiment of the paper: J + 1 motions of a system with 7
    coordinates, all with the same initial energy E_0. Let E_jk be the energy of member
    j at step k. The mean of (E_jk - E_0)² over the ensemble, μ(E, k), scales as
    h^{4(s-1)}. Every motion is chaotic, so that only statistics of the ensemble can be
    compared, not single motions. Members run in chunks, and statistics are updated
    after each chunk, so that memory does not grow with J. The error bar of μ is its
    standard error.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h, each of which must divide `final_time`.
    - `final_time`: the length of each run.
    - `members`: the number J of the paper; the ensemble has J + 1 members.
    - `closure`: the closure of the multipliers, as for `nhjax.LobattoIIIAB`; by default
        the closure of the paper.
    - `times`: the times at which to report μ, averaged over a window of ±5. The default
        times are 10, 50, 100 and 200, without times beyond the end of the run. For a
        run that is shorter than 10, the default is its final time.
    - `save_every`: the number of steps between saved energies.
    - `progress`: whether to show a progress bar for each run on the standard error
        stream.

    **Returns:** a `ChaoticEnergy`.

    **Raises:** `ArgumentError` for invalid arguments, and `nhjax.IntegrationError` if a
    step cannot be solved.
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
            raise ArgumentError(
                "dt" if save_every == 1 else "save_every",
                f"must leave at most {WINDOW:g} units of time between samples, but "
                f"{save_every} steps of {h:g} take {save_every * h:g}",
            )
    runs = [
        _run(case, members, times, progress)
        for case in (
            _Case(LobattoIIIAB(s, closure), h, n, save_every)
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


class _Case(NamedTuple):
    """The method, step size, length and output of one run of the ensemble."""

    method: LobattoIIIAB
    h: float
    num_steps: int
    save_every: int


def _program(
    case: _Case, members: int, every: int, weights: np.ndarray
) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return two functions: one runs a member, the other computes its initial data."""
    chaotic = ChaoticSystem()

    def member(j: Array) -> tuple[Array, Array]:
        angle = j.astype(float) * (0.5 * math.pi / members)
        return (
            chaotic.q0.at[0].set(jnp.cos(angle)),
            chaotic.v0.at[1].set(jnp.sin(angle)),
        )

    def run(start: tuple[Array, Array]) -> dict[str, Any]:
        sol = integrate(
            chaotic.system,
            case.method,
            initial_state(chaotic.system, *start),
            dt=case.h,
            num_steps=case.num_steps,
            saveat=SaveAt(t0=True, steps=every, fn=chaotic.system.energy),
            throw=False,
        )
        squares = (sol.ys - sol.ys[0]) ** 2
        windows = jnp.asarray(weights) @ squares
        return {"sol": sol, "μ": {"each": squares, "windows": windows}}

    return run, member


def _run(
    case: _Case, members: int, times: Sequence[float], progress: bool
) -> ChaoticRun:
    """Run the ensemble, and average over a window around each of `times`."""
    every = min(case.save_every, case.num_steps)
    # `integrate` also computes times as products of the step number and h.
    ts = case.h * np.arange(0, case.num_steps + 1, every)
    weights = np.abs(ts - np.asarray(times)[:, None]) <= WINDOW + 1e-9
    weights = weights / np.sum(weights, axis=1, keepdims=True)
    run, member = _program(case, members, every, weights)
    size = max(1, min(members + 1, CHUNK, CHUNK_BYTES // ts.nbytes))
    name = f"s = {case.method.stages}, h = {case.h:.4g}"

    def outcome(count: int, shown: bool) -> EnsembleOutcome:
        return ensemble(
            run,
            member,
            num_members=count,
            chunk_size=size,
            reduce=_REDUCTIONS,
            progress_meter=meter(shown, name, "member"),
        )

    start = time.perf_counter()
    # This call compiles the program, and runs one chunk.
    outcome(size, False)
    compiled = time.perf_counter()
    whole = outcome(members + 1, progress)
    timing = Timing(compiled - start, time.perf_counter() - compiled)
    failures = whole.failures()
    if failures:
        j, k, reason = failures[0]
        raise IntegrationError(
            f"Integration failed in {len(failures)} of {members + 1} members, first in "
            f"member {j}, step {k}: {reason}"
        )
    found = jax.tree.map(np.asarray, whole.statistics)
    errors = jax.tree.map(lambda x: np.sqrt(x / (members + 1)), found["variance"])
    return ChaoticRun(
        stages=case.method.stages,
        dt=case.h,
        times=ts,
        mu=found["mean"]["each"],
        mu_error=errors["each"],
        windows=found["mean"]["windows"],
        windows_error=errors["windows"],
        mean_iterations=float(found["iterations"]) / case.num_steps,
        max_constraint_violation=float(found["violation"]),
        timing=timing,
    )


_REDUCTIONS = {
    "mean": Mean(of=lambda value: value["μ"]),
    "variance": Variance(of=lambda value: value["μ"]),
    "iterations": Mean(of=lambda value: value["sol"].stats["num_iterations"]),
    "violation": Maximum(
        of=lambda value: value["sol"].stats["max_constraint_violation"]
    ),
}


def _figure(runs: list[ChaoticRun], title: str) -> "Figure":
    """Draw μ against time with standard errors, in a column for each s.

    In the upper row μ is divided by h^{4(s-1)}, and in the lower row by the power of h
    in the paper's figure.
    """
    from matplotlib.figure import Figure

    stages = list(dict.fromkeys(run.stages for run in runs))
    figure = Figure(figsize=(1 + 4 * len(stages), 7), layout="constrained")
    axes = figure.subplots(2, len(stages), sharex=True, squeeze=False)
    for (ours, paper), s in zip(axes.T, stages, strict=True):
        chosen = [run for run in runs if run.stages == s]
        _panel(ours, chosen, 4 * (s - 1))
        ours.set_title(f"s = {s}")
        if s in PAPER_POWERS:
            _panel(paper, chosen, PAPER_POWERS[s])
        else:
            paper.set_axis_off()
            paper.text(
                0.5, 0.5, "not in the paper", ha="center", transform=paper.transAxes
            )
    axes[0, 0].legend(loc="lower right")
    figure.suptitle(
        f"Mean squared energy error of the chaotic ensemble, {title}\n"
        "above: divided by $h^{4(s-1)}$, the measured power; below: divided by the "
        "power of the paper's figure"
    )
    return figure


def _panel(ax: "Axes", runs: list[ChaoticRun], power: int) -> None:
    # The error starts from zero. The lower limit of the axis ignores the first tenth of
    # the run, whose small errors would compress the curves.
    levels = []
    for i, run in enumerate(runs):
        h, times = run.dt, run.times
        scaled, spread = run.mu / h**power, _smoothed(run.mu_error) / h**power
        levels += [np.min(scaled[len(scaled) // 10 :]), np.max(scaled[1:])]
        ax.plot(times, scaled, linewidth=0.4, alpha=0.35, color=f"C{i}")
        mean = _smoothed(scaled)
        ax.plot(times, mean, color=f"C{i}", linewidth=1.5, label=f"$h$ = {h:g}")
        # The band is the standard error at a single time: errors at neighbouring times
        # are correlated, so that the running mean is not more accurate.
        ax.fill_between(
            times, mean - spread, mean + spread, color=f"C{i}", alpha=0.2, linewidth=0
        )
    ax.set_yscale("log")
    ax.set_ylim(min(levels) / 1.5, max(levels) * 1.5)
    ax.set_xlabel("time $t$")
    ax.set_ylabel(f"$\\mu(E, k) / h^{{{power}}}$")
    ax.tick_params(labelbottom=True)


def _smoothed(x: np.ndarray) -> np.ndarray:
    """Compute running means over a fortieth of the run."""
    width = max(1, len(x) // 40)
    kernel = np.ones(width)
    return np.convolve(x, kernel, "same") / np.convolve(np.ones(len(x)), kernel, "same")
