"""First integrals of the homogeneous ball on a turntable."""

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from .._integrate import integrate, raise_failures, SaveAt
from .._method import LobattoIIIAB
from .._step import Newton
from ..systems import TurntableBall
from ._arguments import (
    ArgumentError,
    check_choice,
    check_stages,
    check_step_sizes,
    RETRACTIONS,
    whole_steps,
)
from ._result import (
    AbstractStudyResult,
    compile_and_run,
    draw_envelope,
    format_slope,
    format_table,
    initial_data,
    largest_by_fifths,
    meter,
    slopes,
    system_parameters,
    Timing,
)


if TYPE_CHECKING:
    from matplotlib.figure import Figure


# The labels of the linear integrals in tables and in figures.
LINEAR_INTEGRALS = {
    "ω_ζ": r"$\omega_\zeta$",
    "rω_ξ-Ωx/(1+a)": r"$r\omega_\xi - \Omega x/(1 + a)$",
    "rω_η-Ωy/(1+a)": r"$r\omega_\eta - \Omega y/(1 + a)$",
}
MOVING_ENERGY = "moving energy"
# Errors of the moving energy and of the position up to these values are round-off.
ENERGY_FLOOR, POSITION_FLOOR = 4e-15, 1e-13


@dataclasses.dataclass(frozen=True)
class BallRun:
    """The measurements of one run of k steps.

    - `integrals`: shape (k + 1, 4), the three linear first integrals and the moving
        energy.
    - `positions`: the horizontal position (x, y) of the ball, of shape (k + 1, 2).
    - `circle_deviation`: the distance from the exact position at the time at which the
        run with the smallest step ends.
    - `timing`: the times to compile and to run one program, which runs all step sizes
      with this s in one `jax.vmap`.
    """

    stages: int
    dt: float
    times: np.ndarray
    integrals: np.ndarray
    positions: np.ndarray
    circle_deviation: float
    mean_iterations: float
    max_constraint_violation: float
    timing: Timing

    def deviations(self) -> np.ndarray:
        """Return the values of the first integrals minus their initial values."""
        return self.integrals - self.integrals[0]

    def largest_linear_errors(self) -> np.ndarray:
        """Return the largest deviation of each linear integral, of shape (3,)."""
        return np.max(np.abs(self.deviations()[:, :3]), axis=0)

    def energy_by_fifths(self) -> list[float]:
        """Return the moving energy's largest deviation in each fifth of the run."""
        return largest_by_fifths(self.deviations()[1:, 3])


@dataclasses.dataclass(frozen=True)
class BallInvariants(AbstractStudyResult):
    """The runs of a ball-invariants study, with decreasing h for each s."""

    name: ClassVar[str] = "ball-invariants"

    stages: tuple[int, ...]
    dt: tuple[float, ...]
    num_steps: int
    closure: str
    example: TurntableBall
    runs: list[BallRun]

    @property
    def final_time(self) -> float:
        """Return the duration of the shortest run."""
        return self.num_steps * min(self.dt)

    def of_stages(self, s: int) -> list[BallRun]:
        """Return the runs with `s` stages, with decreasing step size h."""
        return [run for run in self.runs if run.stages == s]

    def energy_slopes(self, s: int) -> np.ndarray:
        """Return the observed orders of the largest error of the moving energy."""
        errors = [max(run.energy_by_fifths()) for run in self.of_stages(s)]
        return slopes(self.dt, np.array(errors), floor=ENERGY_FLOOR)

    def circle_slopes(self, s: int) -> np.ndarray:
        """Return the observed orders of the distance from the exact position."""
        errors = [run.circle_deviation for run in self.of_stages(s)]
        return slopes(self.dt, np.array(errors), floor=POSITION_FLOOR)

    def parameters(self) -> dict[str, Any]:
        """Return every parameter of the computation, including initial data."""
        return {
            "stages": self.stages,
            "dt": self.dt,
            "num_steps": self.num_steps,
            "final_time": self.final_time,
            "last_times": [self.num_steps * h for h in self.dt],
            "closure": self.closure,
            "stage_solver": "Newton",
            "system": "TurntableBall",
            "system_parameters": system_parameters(self.example),
            "initial_data": initial_data(self.example),
            "integrals": [*LINEAR_INTEGRALS, MOVING_ENERGY],
        }

    def summary(self) -> dict[str, Any]:
        """Return a summary of the results, with timings."""
        entries = []
        for s in self.stages:
            for run, energy_slope, circle_slope in self._with_slopes(s):
                entry = {
                    "stages": s,
                    "dt": run.dt,
                    "max_linear_integral_errors": run.largest_linear_errors(),
                    "max_moving_energy_error_by_fifths": run.energy_by_fifths(),
                    "moving_energy_slope": energy_slope,
                    "circle_deviation": run.circle_deviation,
                    "circle_deviation_slope": circle_slope,
                    "expected_slope": 2 * s - 2,
                    "mean_iterations": run.mean_iterations,
                    "max_constraint_violation": run.max_constraint_violation,
                    **dataclasses.asdict(run.timing),
                }
                entries.append(entry)
        return {"circle_deviation_at": self.final_time, "runs": entries}

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the data behind the figures, by name."""
        data = {}
        for run in self.runs:
            key = f"s{run.stages}_h{run.dt:.6g}"
            data[f"{key}_times"] = run.times
            data[f"{key}_integrals"] = run.integrals
            data[f"{key}_positions"] = run.positions
        return data

    def table(self) -> str:
        """Format a table of the largest errors of each run, and of observed orders."""
        header = ["s", "h"]
        header += [f"|Δ({name})|" for name in LINEAR_INTEGRALS]
        header += ["|ΔE_m| 1/5", "|ΔE_m| 5/5", "slope"]
        header += [f"|z-z_exact| t={self.final_time:g}", "slope (2s-2)", "run s"]
        rows = []
        for s in self.stages:
            for run, energy_slope, circle_slope in self._with_slopes(s):
                first, *_, last = run.energy_by_fifths()
                rows.append(
                    [str(s), f"{run.dt:.6g}"]
                    + [f"{x:.1e}" for x in run.largest_linear_errors()]
                    + [f"{first:.2e}", f"{last:.2e}", format_slope(energy_slope)]
                    + [f"{run.circle_deviation:.2e}"]
                    + [f"{format_slope(circle_slope)} ({2 * s - 2})"]
                    + [f"{run.timing.run_seconds:.2f}"]
                )
        note = "E_m: the moving energy; the largest errors in the first and last fifth."
        return f"{format_table(header, rows)}\n\n{note}"

    def verdict(self) -> str:
        """State how well the linear integrals and the moving energy are conserved."""
        linear = max(float(np.max(run.largest_linear_errors())) for run in self.runs)
        fifths = [run.energy_by_fifths() for run in self.runs]
        growth = max(max(x) / max(x[0], ENERGY_FLOOR) for x in fifths)
        energy = f"grows {growth:.1f}-fold" if growth > 1.2 else "does not drift"
        return (
            f"the linear integrals are conserved to {linear:.0e}; the moving energy "
            f"{energy}"
        )

    def figures(self) -> "dict[str, Figure]":
        """Draw the errors of the four integrals against time, one figure for each s."""
        return {f"{self.name}-s{s}": self._figure(s) for s in self.stages}

    def _with_slopes(self, s: int) -> "zip[tuple[BallRun, float, float]]":
        runs = self.of_stages(s)
        return zip(runs, self.energy_slopes(s), self.circle_slopes(s), strict=True)

    def _figure(self, s: int) -> "Figure":
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10, 8), layout="constrained")
        axes = figure.subplots(2, 2, sharex=True).flat
        labels = [*LINEAR_INTEGRALS.values(), MOVING_ENERGY]
        for i, (ax, label) in enumerate(zip(axes, labels, strict=True)):
            # The errors of the moving energy differ by orders of magnitude between step
            # sizes, so that they need a logarithmic axis.
            logarithmic = label == MOVING_ENERGY
            # Draw the largest step first, so that it does not hide the others.
            for k, run in enumerate(self.of_stages(s)):
                error = run.deviations()[:, i]
                error = np.abs(error) if logarithmic else error
                style = {"color": f"C{k}", "label": f"$h$ = {run.dt:g}"}
                draw_envelope(ax, run.times, error, **style)
            if logarithmic:
                ax.set_yscale("log")
                ax.set_ylim(bottom=1e-16)
            ax.set_ylabel(f"error of {label}")
            ax.set_xlabel("time $t$")
        figure.legend(
            *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6
        )
        figure.suptitle(
            f"Homogeneous ball on a turntable, s = {s}, {self.closure} closure, "
            f"{type(self.example.retraction).__name__} retraction"
        )
        return figure


def ball_invariants(
    *,
    stages: Sequence[int] = (2, 3, 4),
    dt: Sequence[float] = (0.4, 0.3, 0.2, 0.1),
    num_steps: int = 1200,
    closure: str = "propagated",
    retraction: str = "cayley",
    progress: bool = False,
) -> BallInvariants:
    """Compute the first integrals of the homogeneous ball on a turntable.

    This is the fifth experiment of the paper. For one step size, s = 3 and the Cayley
    map, the paper plots the errors of the four first integrals against time. Three of
    the integrals are linear. They are conserved to the tolerance of the nonlinear
    solver, which is 1e-12 in the paper and round-off here. The error of the fourth
    integral, the moving energy, oscillates like the energy error of a holonomic system.
    In addition, this study measures whether the error of the moving energy stays
    bounded, the order of this error, and the distance of the ball from its exact
    position on a circle. The paper does not state the data of its example; this study
    uses the data of `nhjax.systems.TurntableBall`, a solid ball whose constraints are
    written in terms of the spatial angular velocity.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h.
    - `num_steps`: the number of steps of every run, at least 5. Positions are compared
        at the time at which the run with the smallest step ends. This time must be a
        whole number of steps of every other step size.
    - `closure`: the closure of the multipliers, as for `nhjax.LobattoIIIAB`; by default
        the closure of the paper.
    - `retraction`: `"cayley"`, as in the paper, or `"exponential"`.
    - `progress`: whether to show a progress bar for each s on the standard error
        stream.

    **Returns:** a `BallInvariants`.

    **Raises:** `ArgumentError` for invalid arguments, and `nhjax.IntegrationError` if a
    step cannot be solved.
    """
    check_stages(stages)
    check_step_sizes(dt)
    check_choice("retraction", retraction, RETRACTIONS)
    if num_steps < 5:
        raise ArgumentError("num_steps", f"must be at least 5, got {num_steps}")
    dt = tuple(sorted(dt, reverse=True))
    final_time = num_steps * min(dt)
    compared = [whole_steps(final_time, h) for h in dt]
    ball = TurntableBall(retraction=RETRACTIONS[retraction])
    (_, position), _, _ = ball.exact(final_time)
    runs = []
    for s in stages:
        method = LobattoIIIAB(s, closure, chart="start")  # as in the paper
        runs += _runs(ball, method, dt, num_steps, compared, position, progress)
    return BallInvariants(
        stages=tuple(stages),
        dt=dt,
        num_steps=num_steps,
        closure=closure,
        example=ball,
        runs=runs,
    )


def _runs(
    ball: TurntableBall,
    method: LobattoIIIAB,
    dt: tuple[float, ...],
    num_steps: int,
    compared: list[int],
    position: np.ndarray,
    progress: bool,
) -> list[BallRun]:
    """Run all step sizes in one `jax.vmap`."""
    y0 = ball.initial_state()

    def observe(t, y, args):
        energy = ball.invariants(t, y.q, y.v)["moving_energy"]
        return jnp.append(ball.first_integrals(y.q, y.v), energy), y.q[1]

    def run(h):
        return integrate(
            ball.system,
            method,
            y0,
            dt=h,
            num_steps=num_steps,
            saveat=SaveAt(t0=True, steps=True, fn=observe),
            # Newton's method is used: the ball turns by up to half a radian per step.
            stage_solver=Newton(),
            throw=False,
            progress_meter=meter(progress, f"s = {method.stages}"),
        )

    sol, timing = compile_and_run(jax.vmap(run), jnp.array(dt))
    raise_failures(sol)
    ts, (integrals, positions), stats = jax.tree.map(
        np.asarray, (sol.ts, sol.ys, sol.stats)
    )
    return [
        BallRun(
            stages=method.stages,
            dt=h,
            times=ts[i],
            integrals=integrals[i],
            positions=positions[i],
            circle_deviation=float(np.linalg.norm(positions[i, k] - position)),
            mean_iterations=float(stats["num_iterations"][i]) / num_steps,
            max_constraint_violation=float(stats["max_constraint_violation"][i]),
            timing=timing,
        )
        for i, (h, k) in enumerate(zip(dt, compared, strict=True))
    ]
