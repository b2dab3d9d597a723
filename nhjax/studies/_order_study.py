"""Orders of convergence on any system that has an exact solution."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, TYPE_CHECKING, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from .. import plot
from .._errors import IntegrationError
from .._integrate import integrate, SaveAt
from .._method import LobattoIIIAB
from .._step import Newton
from .._system import continuous_multiplier, LagrangianSystem, State
from ._arguments import check_positive, check_stages, check_step_sizes, whole_steps
from ._result import AbstractStudyResult, initial_data, system_parameters, Timing
from ._run import compile_and_run
from ._table import format_slope, format_table, order_verdict, slopes, SYMBOLS


if TYPE_CHECKING:
    from matplotlib.figure import Figure


class ExactExample(Protocol):
    """An example of the gallery with an exact solution."""

    @property
    def system(self) -> LagrangianSystem:
        """Return the system to integrate."""
        ...

    def initial_state(self) -> State:
        """Return the initial state."""
        ...

    def exact(self, t: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute (q, v, λ) of the exact solution at time `t`."""
        ...


@dataclasses.dataclass(frozen=True)
class AbstractOrderStudy(AbstractStudyResult):
    """The result of a study of orders: relative errors at the final time.

    - `errors`: shape (stages, step sizes, quantities). Of the two multipliers the first
        is that which the method reports, the second the continuous λ_c(q, p).
    - `timings`: one for each number of stages.
    """

    quantities: ClassVar[tuple[str, ...]]

    stages: tuple[int, ...]
    dt: tuple[float, ...]
    final_time: float
    closure: str
    example: ExactExample
    errors: np.ndarray
    timings: list[Timing]

    def slopes(self) -> np.ndarray:
        """Return observed orders, shaped as `errors`; NaN where round-off rules."""
        # The errors of a run to T = 3 level off below 1e-14.
        return np.stack([slopes(self.dt, e, floor=1e-13) for e in self.errors])

    def orders(self) -> np.ndarray:
        """Return the order at the smallest step sizes whose errors exceed round-off.

        The shape is (stages, quantities).
        """
        observed = self.slopes()
        last = np.full(observed.shape[::2], np.nan)
        for j in range(observed.shape[1]):
            last = np.where(np.isfinite(observed[:, j]), observed[:, j], last)
        return last

    def parameters(self) -> dict[str, Any]:
        """Return every parameter of the computation, initial data included."""
        return {
            "stages": self.stages,
            "dt": self.dt,
            "num_steps": [whole_steps(self.final_time, h) for h in self.dt],
            "final_time": self.final_time,
            "closure": self.closure,
            "stage_solver": "Newton",
            "system": type(self.example).__name__,
            "system_parameters": system_parameters(self.example),
            "initial_data": initial_data(self.example),
            "error": "|x - x_exact| / |x_exact| at the final time, Euclidean norms",
        }

    def summary(self) -> dict[str, Any]:
        """Return the results in short, with timings."""
        orders = self.orders()
        return {
            "quantities": self.quantities,
            "runs": [
                {
                    "stages": s,
                    "expected_orders": self._expected(s),
                    "observed_orders": orders[i],
                    "relative_errors": self.errors[i],
                    "slopes": self.slopes()[i],
                    **dataclasses.asdict(self.timings[i]),
                }
                for i, s in enumerate(self.stages)
            ],
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the data behind the figure, by name."""
        return {
            "stages": np.array(self.stages),
            "dt": np.array(self.dt),
            "relative_errors": self.errors,
            "slopes": self.slopes(),
        }

    def table(self) -> str:
        """Write a table of errors and slopes at every step size, then the orders."""
        symbols = [SYMBOLS[name][0] for name in self.quantities]
        header = ["s", "h"]
        for symbol in symbols:
            header += [f"error {symbol}", "slope"]
        rows = []
        observed = self.slopes()
        for i, s in enumerate(self.stages):
            for j, h in enumerate(self.dt):
                row = [str(s), f"{h:.6g}"]
                for error, slope in zip(self.errors[i, j], observed[i, j], strict=True):
                    row += [f"{error:.2e}", format_slope(slope)]
                rows.append(row)
        orders = [
            [str(s)]
            + [
                f"{format_slope(x)} ({e})"
                for x, e in zip(found, self._expected(s), strict=True)
            ]
            for s, found in zip(self.stages, self.orders(), strict=True)
        ]
        summary = format_table(["s", *symbols], orders)
        return f"{format_table(header, rows)}\n\nobserved (expected) orders\n{summary}"

    def verdict(self) -> str:
        """Say whether the orders are those of the theory."""
        expected = np.array([self._expected(s) for s in self.stages])
        return order_verdict(self.quantities, self.orders(), expected)

    def figures(self) -> "dict[str, Figure]":
        """Draw the errors against the step size, like the paper's order plots."""
        from matplotlib.figure import Figure

        columns = math.ceil(len(self.quantities) / 2)
        figure = Figure(figsize=(5 * columns, 8), layout="constrained")
        axes = figure.subplots(2, columns, sharex=True).flat
        for ax in axes[len(self.quantities) :]:
            ax.set_axis_off()
        for k, name in enumerate(self.quantities):
            ax = axes[k]
            for i, s in enumerate(self.stages):
                plot.convergence(
                    self.dt,
                    self.errors[i, :, k],
                    order=self._expected(s)[k],
                    ax=ax,
                    color=f"C{i}",
                    label=f"s = {s}: {self._expected(s)[k]}",
                )
            ax.set_ylabel(f"relative error of {SYMBOLS[name][1]}")
            ax.set_xticks(self.dt, [f"{h:.4g}" for h in self.dt], rotation=45)
            # With an empty place below, sharing would leave these axes bare.
            ax.tick_params(labelbottom=True)
            ax.minorticks_off()
            # Room for the legend beside the curves.
            ax.set_xlim(right=2.5 * max(self.dt))
            ax.set_ylim(bottom=1e-16)
            ax.legend(title="order", loc="lower right", fontsize="small")
        figure.suptitle(
            f"{type(self.example).__name__} at t = {self.final_time:g}, "
            f"{self.closure} closure; dashed: the order of the theory"
        )
        return {self.name: figure}

    def _expected(self, s: int) -> tuple[int, ...]:
        order = 2 * s - 2
        # λ = Λ^s is that of the method only where it is carried on; the other
        # closures report λ_c.
        own = s - s % 2 if self.closure == "propagated" else order
        return tuple(own if name == "multiplier" else order for name in self.quantities)


_Study = TypeVar("_Study", bound=AbstractOrderStudy)


def order_study(
    study: type[_Study],
    example: ExactExample,
    *,
    stages: Sequence[int],
    dt: Sequence[float],
    final_time: float,
    closure: str,
    progress: bool,
) -> _Study:
    """Run the order study of an example for each number of stages and step size.

    **Raises:** `ArgumentError` for arguments that cannot be right, and
    `nhjax.IntegrationError` if a step cannot be solved.
    """
    check_stages(stages)
    check_step_sizes(dt)
    check_positive("final_time", final_time)
    dt = tuple(sorted(dt, reverse=True))
    num_steps = [whole_steps(final_time, h) for h in dt]
    q, v, multiplier_end = example.exact(final_time)
    p = example.system.momentum(final_time, jnp.asarray(q), jnp.asarray(v))
    end = State(q, v, np.asarray(p), multiplier_end)  # pyright: ignore[reportArgumentType]
    exact = _values(study.quantities, end, multiplier_end)
    errors, timings = [], []
    for s in tqdm.tqdm(stages, desc=study.name, disable=not progress):
        method = LobattoIIIAB(s, closure, chart="start")  # as in the paper
        ends, timing = _final_values(study, example, method, dt, num_steps)
        timings.append(timing)
        errors.append(
            [
                [
                    np.linalg.norm(x - reference) / np.linalg.norm(reference)
                    for x, reference in zip(end, exact, strict=True)
                ]
                for end in ends
            ]
        )
    return study(
        stages=tuple(stages),
        dt=dt,
        final_time=final_time,
        closure=closure,
        example=example,
        errors=np.array(errors),
        timings=timings,
    )


def _values(
    quantities: Sequence[str], y: State, found_multiplier: Any
) -> tuple[Any, ...]:
    values = {
        "q": y.q,
        "g": y.q,
        "v": y.v,
        "p": y.p,
        "multiplier": y.multiplier,
        "continuous_multiplier": found_multiplier,
    }
    return tuple(values[name] for name in quantities)


def _final_values(
    study: type[AbstractOrderStudy],
    example: ExactExample,
    method: LobattoIIIAB,
    dt: tuple[float, ...],
    num_steps: list[int],
) -> tuple[list[tuple[np.ndarray, ...]], Timing]:
    """Compute the quantities at the end of the run with each step size."""
    # The length of a run is static in `integrate`. One compiled program serves every
    # step size if all runs are of as many steps; what comes after the end is left.
    system = example.system
    start = example.initial_state()

    def observe(t, y, args):
        return _values(study.quantities, y, continuous_multiplier(system, t, y, args))

    def run(h):
        return integrate(
            system,
            method,
            start,
            dt=h,
            num_steps=max(num_steps),
            saveat=SaveAt(steps=True, fn=observe),
            # The largest steps are too large for SimplifiedNewton at high s.
            stage_solver=Newton(),
            throw=False,
        )

    sol, timing = compile_and_run(jax.vmap(run), jnp.array(dt))
    values, failed = jax.tree.map(np.asarray, (sol.ys, sol.stats["failed_step"]))
    for h, n, k in zip(dt, num_steps, failed, strict=True):
        if 0 <= k < n:
            raise IntegrationError(
                f"A step of size {h:g} with s = {method.stages} could not be solved: "
                "try smaller step sizes."
            )
    ends = [tuple(x[i, n - 1] for x in values) for i, n in enumerate(num_steps)]
    return ends, timing
