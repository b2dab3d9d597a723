"""Orders of convergence on systems with an exact solution.

`particle_order` and `unicycle_order` integrate to a final time with several numbers of
stages and step sizes, and compare the end of each run with the exact solution.
"""

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
from ..systems import ChaplyginSleigh, NonholonomicParticle, Unicycle
from ._arguments import (
    check_choice,
    check_positive,
    check_stages,
    check_step_sizes,
    RETRACTIONS,
    whole_steps,
)
from ._result import (
    AbstractStudyResult,
    compile_and_run,
    format_slope,
    format_table,
    initial_data,
    slopes,
    system_parameters,
    Timing,
)


if TYPE_CHECKING:
    from matplotlib.figure import Figure


# The symbols of quantities in tables and in figures.
SYMBOLS = {
    "q": ("q", "$q$"),
    "g": ("g", "$g$"),
    "v": ("v", "$v$"),
    "p": ("p", "$p$"),
    "multiplier": ("λ", r"$\lambda$"),
    "continuous_multiplier": ("λ_c", r"$\lambda_c(q, p)$"),
}
# The mass matrix is constant for the particle, and depends on position for the sleigh.
EXAMPLES = {"particle": NonholonomicParticle, "sleigh": ChaplyginSleigh}


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

    - `errors`: shape (stages, step sizes, quantities). The quantity `multiplier` is the
        multiplier that the method reports, and `continuous_multiplier` is λ_c(q, p),
        the multiplier of the continuous equations.
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
        """Return observed orders in the shape of `errors`; undefined orders are NaN."""
        # Errors up to 1e-13 are ignored. In runs to T = 3, round-off is below 1e-14.
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
        """Return every parameter of the computation, including initial data."""
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
        """Return a summary of the results, with timings."""
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
        """Format a table of errors and slopes at each step size, and of orders."""
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
        """State whether the observed orders agree with theory."""
        expected = np.array([self._expected(s) for s in self.stages])
        off = np.abs(self.orders() - expected)
        if not np.any(np.isfinite(off)):
            return (
                "no order can be observed: it takes two step sizes with errors above "
                "round-off"
            )
        worst = np.nanmax(off)
        # The tolerance of 0.5 is large: with many stages, only the largest steps have
        # errors above round-off, and they are not yet in the asymptotic regime.
        agree = "agree with theory" if worst <= 0.5 else "do not all agree with theory"
        names = ", ".join(SYMBOLS[name][0] for name in self.quantities)
        return f"the orders of {names} {agree}; the largest difference is {worst:.2f}"

    def figures(self) -> "dict[str, Figure]":
        """Draw the errors against the step size, as in the order plots of the paper."""
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
            # With shared axes, a panel above an empty panel would have no tick labels.
            ax.tick_params(labelbottom=True)
            ax.minorticks_off()
            # Leave space for the legend.
            ax.set_xlim(right=2.5 * max(self.dt))
            ax.set_ylim(bottom=1e-16)
            ax.legend(title="order", loc="lower right", fontsize="small")
        figure.suptitle(
            f"{type(self.example).__name__} at t = {self.final_time:g}, "
            f"{self.closure} closure; dashed: the theoretical order"
        )
        return {self.name: figure}

    def _expected(self, s: int) -> tuple[int, ...]:
        order = 2 * s - 2
        # Only the propagated closure reports its own multiplier, λ = Λ^s. The other
        # closures report the continuous multiplier λ_c.
        own = s - s % 2 if self.closure == "propagated" else order
        return tuple(own if name == "multiplier" else order for name in self.quantities)


@dataclasses.dataclass(frozen=True)
class ParticleOrder(AbstractOrderStudy):
    """Errors of the nonholonomic particle at the final time, by stages and step size.

    - `errors`: relative errors, of shape (stages, step sizes, 4), of q, p, the
        multiplier λ that the method reports, and the continuous multiplier λ_c(q, p).
    - `timings`: one for each number of stages.
    """

    name: ClassVar[str] = "particle-order"
    quantities: ClassVar[tuple[str, ...]] = (
        "q",
        "p",
        "multiplier",
        "continuous_multiplier",
    )


def particle_order(
    *,
    stages: Sequence[int] = (2, 3, 4, 5, 6),
    dt: Sequence[float] = (0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625),
    final_time: float = 3.0,
    closure: str = "propagated",
    system: str = "particle",
    progress: bool = False,
) -> ParticleOrder:
    """Measure the orders of q, p and the multiplier on the nonholonomic particle.

    This is the first experiment of the paper. The results are compared with the exact
    solution. The same study can run on Chaplygin's sleigh, whose mass matrix depends on
    position.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h, each of which must divide `final_time`.
    - `final_time`: the time at which the errors are measured.
    - `closure`: the closure of the multipliers, as for `nhjax.LobattoIIIAB`; by default
        the closure of the paper.
    - `system`: `"particle"`, or `"sleigh"` for Chaplygin's sleigh.
    - `progress`: whether to show a progress bar on the standard error stream.

    **Returns:** a `ParticleOrder`.

    **Raises:** `ArgumentError` for invalid arguments, and `nhjax.IntegrationError` if a
    step cannot be solved.
    """
    check_choice("system", system, EXAMPLES)
    return _order_study(
        ParticleOrder,
        EXAMPLES[system](),
        stages=stages,
        dt=dt,
        final_time=final_time,
        closure=closure,
        progress=progress,
    )


@dataclasses.dataclass(frozen=True)
class UnicycleOrder(AbstractOrderStudy):
    """The errors of the unicycle on SE(2) at the final time, by stages and step size.

    - `errors`: relative errors, of shape (stages, step sizes, 5), of g = (x, y, θ), the
        body velocity v, the body momentum p, the multiplier λ that the method reports,
        and the continuous multiplier λ_c(g, p).
    - `timings`: one for each number of stages.
    """

    name: ClassVar[str] = "unicycle-order"
    quantities: ClassVar[tuple[str, ...]] = (
        "g",
        "v",
        "p",
        "multiplier",
        "continuous_multiplier",
    )


def unicycle_order(
    *,
    stages: Sequence[int] = (2, 3, 4, 5),
    dt: Sequence[float] = (0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625),
    final_time: float = 3.0,
    closure: str = "propagated",
    retraction: str = "cayley",
    progress: bool = False,
) -> UnicycleOrder:
    """Measure the orders of g, v, p and the multiplier on the unicycle, on SE(2).

    This is the fourth experiment of the paper. The paper compares its results with a
    run of its own method at h = 1e-4; this study compares with the exact solution.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h, each of which must divide `final_time`.
    - `final_time`: the time at which the errors are measured.
    - `closure`: the closure of the multipliers, as for `nhjax.LobattoIIIAB`; by default
        the closure of the paper.
    - `retraction`: `"cayley"`, as in the paper, or `"exponential"`.
    - `progress`: whether to show a progress bar on the standard error stream.

    **Returns:** a `UnicycleOrder`.

    **Raises:** `ArgumentError` for invalid arguments, and `nhjax.IntegrationError` if a
    step cannot be solved.
    """
    check_choice("retraction", retraction, RETRACTIONS)
    return _order_study(
        UnicycleOrder,
        Unicycle(retraction=RETRACTIONS[retraction]),
        stages=stages,
        dt=dt,
        final_time=final_time,
        closure=closure,
        progress=progress,
    )


_Study = TypeVar("_Study", bound=AbstractOrderStudy)


def _order_study(
    study: type[_Study],
    example: ExactExample,
    *,
    stages: Sequence[int],
    dt: Sequence[float],
    final_time: float,
    closure: str,
    progress: bool,
) -> _Study:
    """Run an example for each number of stages and step size, and measure errors."""
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
    # One compiled program runs all step sizes, each for the largest number of steps.
    # States after the final time are ignored.
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
            # For large s, SimplifiedNewton does not converge with the largest steps.
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
