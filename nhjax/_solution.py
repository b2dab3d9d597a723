from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float, PyTree
import numpy as np

from ._custom_types import FloatScalarLike
from ._errors import IntegrationError, is_traced
from ._interpolation import DenseInterpolation
from ._state import State


class RESULTS(eqx.Enumeration):
    """How an integration ended. `RESULTS[sol.result]` is the message."""

    successful = ""
    nonlinear_divergence = (
        "The stage equations of a step could not be solved: Newton's iteration did not "
        "converge. Try a smaller `dt`, `solver=nhjax.Newton()`, or more iterations."
    )
    singular_stage_matrix = (
        "The mass matrix D2D2L or the compatibility matrix C = D2Φ M⁻¹ D2Φᵀ became "
        "singular, so that the multiplier is not determined. The system has reached "
        "the edge of its domain."
    )
    nonfinite_state = (
        "The state became infinite or NaN. Check the functions of the system along the "
        "trajectory, or try a smaller `dt`."
    )


class Solution(eqx.Module):
    """The outcome of `nhjax.integrate`.

    - `t0`, `t1`: first and last time.
    - `ts`: the times at which output was saved, shape (k,); None if nothing was.
    - `ys`: the saved states, a `State` with leading axis k, or whatever
        `SaveAt(fn=...)` returned, stacked; None if nothing was.
    - `stats`: `num_steps` (steps completed), `num_iterations` (of the nonlinear solver,
        in all), `max_residual` (of the stage equations, relative to the momenta),
        `max_constraint_violation` (|Φ| at the nodes), `max_multiplier_defect`
        (|Λ^s - λ_c|, how far the last stage multiplier of a step is from the
        continuous one), `failed_step` (index of the step that failed, -1 if none).
    - `result`: a `RESULTS`.
    - `interpolation`: the collocation polynomials, with `SaveAt(dense=True)`.

    Under `vmap` every array has the batch as leading axis; a batch member is a lane.
    """

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    ts: Float[Array, " k"] | None
    ys: PyTree[Array] | None
    stats: dict[str, Any]
    result: RESULTS
    interpolation: DenseInterpolation | None

    def evaluate(self, t: FloatScalarLike) -> State:
        """The state at any time of the run, by the collocation polynomials.

        q(t) is the paper's continuous polynomial u(t) (error O(h^{s+1}) inside a
        step), p(t) the mixed one v(t) (Proposition on continuous approximation, error
        O(h^s)), and v(t) follows from p(t) by the Legendre transform.

        **Arguments:**

        - `t`: a time between `t0` and `t1`; for many, use `jax.vmap(sol.evaluate)`.

        **Returns:** a `State`.

        **Raises:** `ValueError` without `SaveAt(dense=True)` or for a time outside the
        run (under `jit`, at run time).

        !!! example

            >>> import nhjax
            >>> example = nhjax.systems.HarmonicOscillator()
            >>> sol = nhjax.integrate(example.system, nhjax.LobattoIIIAB(3),
            ...     example.initial_state(), dt=0.1, num_steps=10,
            ...     saveat=nhjax.SaveAt(dense=True))
            >>> sol.evaluate(0.55).q.shape
            (1,)
        """
        if self.interpolation is None:
            raise ValueError(
                "Dense output was not saved: pass `saveat=nhjax.SaveAt(dense=True)` to "
                "`integrate` to be able to evaluate the solution between steps."
            )
        return self.interpolation.evaluate(t)

    def failures(self) -> list[tuple[int | None, int, str]]:
        """The failed lanes as (lane, step, reason); lane is None without a batch."""
        codes, steps = self.result._value, self.stats["failed_step"]
        if is_traced(codes, steps):
            raise RuntimeError(
                "Solution.failures() needs a computed solution, outside jit and vmap; "
                "inside them use `sol.result` and `sol.stats['failed_step']`."
            )
        messages = _messages()
        flat_codes, flat_steps = np.ravel(codes), np.ravel(steps)
        batched = np.ndim(codes) > 0
        return [
            (lane if batched else None, int(flat_steps[lane]), messages[int(code)])
            for lane, code in enumerate(flat_codes)
            if messages[int(code)]
        ]


def raise_failures(sol: Solution) -> Solution:
    """`sol`, or an `IntegrationError` that names step, time and reason."""
    failed = sol.result != RESULTS.successful
    if is_traced(failed):
        dynamic, static = eqx.partition(sol, eqx.is_array)
        dynamic = sol.result.error_if(dynamic, failed)
        return eqx.combine(dynamic, static)
    failures = sol.failures()
    if failures:
        lane, k, reason = failures[0]
        where = "" if lane is None else f"lane {lane}, "
        others = f" ({len(failures) - 1} more lanes failed)" if failures[1:] else ""
        raise IntegrationError(
            f"Integration failed in {where}step {k}{others}: {reason} "
            "With `throw=False` the part before the failure is returned."
        )
    return sol


def _messages() -> dict[int, str]:
    # Enumeration items are arrays; codes are needed on the host.
    names = (
        "successful",
        "nonlinear_divergence",
        "singular_stage_matrix",
        "nonfinite_state",
    )
    with jax.ensure_compile_time_eval():
        return {
            int(getattr(RESULTS, name)._value): RESULTS[getattr(RESULTS, name)]
            for name in names
        }
