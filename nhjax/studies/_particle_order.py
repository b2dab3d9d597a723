"""Orders of convergence on a system with an exact solution."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, ClassVar, TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
import tqdm

from .. import plot
from .._errors import IntegrationError
from .._integrate import integrate
from .._method import LobattoIIIAB
from .._newton import Newton
from .._solution import RESULTS
from ..systems import ChaplyginSleigh, NonholonomicParticle
from ._arguments import (
    ArgumentError,
    check_positive,
    check_stages,
    check_step_sizes,
    whole_steps,
)
from ._result import AbstractStudyResult, Timing
from ._run import compile_and_run
from ._table import format_slope, format_table, slopes


if TYPE_CHECKING:
    from matplotlib.figure import Figure


# The sleigh's mass matrix depends on position.
EXAMPLES = {"particle": NonholonomicParticle, "sleigh": ChaplyginSleigh}
QUANTITIES = ("q", "p", "multiplier", "continuous_multiplier")
SYMBOLS = {
    "q": "$q$",
    "p": "$p$",
    "multiplier": r"$\lambda$",
    "continuous_multiplier": r"$\lambda_c(q, p)$",
}


@dataclasses.dataclass(frozen=True)
class ParticleOrder(AbstractStudyResult):
    """Relative errors at the final time.

    - `errors`: shape (stages, step sizes, 4), for q, p, the multiplier λ that the
        method reports and the continuous one λ_c(q, p).
    - `timings`: one for each number of stages.
    """

    name: ClassVar[str] = "particle-order"

    stages: tuple[int, ...]
    dt: tuple[float, ...]
    final_time: float
    multiplier: str
    example: NonholonomicParticle | ChaplyginSleigh
    errors: np.ndarray
    timings: list[Timing]

    def slopes(self) -> np.ndarray:
        """Observed orders, of the shape of `errors`, NaN where round-off rules."""
        # The errors of a run to T = 3 level off below 1e-14.
        return np.stack([slopes(self.dt, e, floor=1e-13) for e in self.errors])

    def orders(self) -> np.ndarray:
        """The order at the smallest step sizes above round-off: (stages, 4)."""
        observed = self.slopes()
        last = np.full(observed.shape[::2], np.nan)
        for j in range(observed.shape[1]):
            last = np.where(np.isfinite(observed[:, j]), observed[:, j], last)
        return last

    def parameters(self) -> dict[str, Any]:
        """Every parameter of the computation, initial data included."""
        return {
            "stages": self.stages,
            "dt": self.dt,
            "num_steps": [whole_steps(self.final_time, h) for h in self.dt],
            "final_time": self.final_time,
            "multiplier": self.multiplier,
            "solver": "Newton",
            "system": type(self.example).__name__,
            "system_parameters": {
                field.name: float(getattr(self.example, field.name))
                for field in dataclasses.fields(self.example)
                if field.name not in ("q0", "v0")
            },
            "initial_data": {
                "q0": np.asarray(self.example.q0),
                "v0": np.asarray(self.example.v0),
                "multiplier": "continuous, from the hidden constraint",
            },
            "error": "|x - x_exact| / |x_exact| at the final time, Euclidean norms",
        }

    def summary(self) -> dict[str, Any]:
        """The results in short, with timings."""
        orders = self.orders()
        return {
            "quantities": QUANTITIES,
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
        """The data behind the figure."""
        return {
            "stages": np.array(self.stages),
            "dt": np.array(self.dt),
            "relative_errors": self.errors,
            "slopes": self.slopes(),
        }

    def table(self) -> str:
        """Errors and slopes at every step size, then the orders."""
        header = ["s", "h"]
        for name in ("q", "p", "λ", "λ_c"):
            header += [f"error {name}", "slope"]
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
        summary = format_table(["s", "q", "p", "λ", "λ_c"], orders)
        return f"{format_table(header, rows)}\n\nobserved (expected) orders\n{summary}"

    def figures(self) -> "dict[str, Figure]":
        """Error against step size, like the paper's order plots."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(10, 8), layout="constrained")
        for k, ax in enumerate(figure.subplots(2, 2, sharex=True).flat):
            for i, s in enumerate(self.stages):
                plot.convergence(
                    self.dt,
                    self.errors[i, :, k],
                    order=self._expected(s)[k],
                    ax=ax,
                    color=f"C{i}",
                    label=f"s = {s}: {self._expected(s)[k]}",
                )
            ax.set_ylabel(f"relative error of {SYMBOLS[QUANTITIES[k]]}")
            ax.set_xticks(self.dt, [f"{h:.4g}" for h in self.dt], rotation=45)
            ax.minorticks_off()
            # Room for the legend beside the curves.
            ax.set_xlim(right=2.5 * max(self.dt))
            ax.set_ylim(bottom=1e-16)
            ax.legend(title="order", loc="lower right", fontsize="small")
        figure.suptitle(
            f"{type(self.example).__name__} at t = {self.final_time:g}, "
            f"{self.multiplier} multiplier; dashed: the order of the theory"
        )
        return {self.name: figure}

    def _expected(self, s: int) -> tuple[int, int, int, int]:
        order = 2 * s - 2
        # λ = Λ^s is that of the method only where it is carried on; the other
        # closures report λ_c.
        own = s - s % 2 if self.multiplier == "propagated" else order
        return order, order, own, order


def particle_order(
    *,
    stages: Sequence[int] = (2, 3, 4, 5, 6),
    dt: Sequence[float] = (0.5, 0.375, 0.25, 0.1875, 0.125, 0.0625),
    final_time: float = 3.0,
    multiplier: str = "propagated",
    system: str = "particle",
    progress: bool = False,
) -> ParticleOrder:
    """Orders of q, p and the multiplier on the nonholonomic particle.

    The paper's first experiment, against the exact solution; the same for Chaplygin's
    sleigh, whose mass matrix depends on position.

    **Arguments:**

    - `stages`: the numbers of stages s.
    - `dt`: the step sizes h, each of which must divide `final_time`.
    - `final_time`: when the errors are taken.
    - `multiplier`: the closure, as for `nhjax.LobattoIIIAB`; the paper's by default.
    - `system`: `"particle"`, or `"sleigh"` for Chaplygin's sleigh.
    - `progress`: show a bar on the standard error stream.

    **Returns:** a `ParticleOrder`.

    **Raises:** `ArgumentError` for arguments that cannot be right.
    """
    check_stages(stages)
    check_step_sizes(dt)
    check_positive("final_time", final_time)
    dt = tuple(sorted(dt, reverse=True))
    num_steps = [whole_steps(final_time, h) for h in dt]
    if system not in EXAMPLES:
        raise ArgumentError("system", f"must be one of {[*EXAMPLES]}, got {system!r}")
    example = EXAMPLES[system]()
    q, v, multiplier_end = example.exact(final_time)
    p = np.asarray(example.system.momentum(final_time, jnp.asarray(q), jnp.asarray(v)))
    exact = (q, p, multiplier_end, multiplier_end)
    errors, timings = [], []
    for s in tqdm.tqdm(stages, desc=ParticleOrder.name, disable=not progress):
        method = LobattoIIIAB(s, multiplier)
        ends, timing = _final_states(example, method, dt, num_steps)
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
    return ParticleOrder(
        stages=tuple(stages),
        dt=dt,
        final_time=final_time,
        multiplier=multiplier,
        example=example,
        errors=np.array(errors),
        timings=timings,
    )


def _final_states(
    example: NonholonomicParticle | ChaplyginSleigh,
    method: LobattoIIIAB,
    dt: tuple[float, ...],
    num_steps: list[int],
) -> tuple[list[tuple[np.ndarray, ...]], Timing]:
    """(q, p, λ, λ_c) at the end of the run with each step size."""
    # The length of a run is static in `integrate`; runs of as many equal chunks as
    # they need make one compiled program serve every step size.
    chunk = math.gcd(*num_steps)
    system = example.system

    def run(h, chunks):
        def advance(_, carry):
            y, failed = carry
            sol = integrate(
                system,
                method,
                y,
                dt=h,
                num_steps=chunk,
                # The largest steps are too large for SimplifiedNewton at high s.
                solver=Newton(),
                throw=False,
            )
            failed = failed | (sol.result != RESULTS.successful)
            return jax.tree.map(lambda x: x[0], sol.ys), failed

        start = (example.initial_state(), jnp.array(False))
        y, failed = jax.lax.fori_loop(0, chunks, advance, start)
        return (y.q, y.p, y.multiplier, system.multiplier(0.0, y)), failed

    (ends, failed), timing = compile_and_run(
        jax.vmap(run), jnp.array(dt), jnp.array(num_steps) // chunk
    )
    if np.any(failed):
        h = dt[int(np.argmax(failed))]
        raise IntegrationError(
            f"A step of size {h:g} with s = {method.stages} could not be solved: try "
            "smaller step sizes."
        )
    return list(zip(*map(np.asarray, ends), strict=True)), timing
