import functools
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import FloatScalarLike
from .._errors import IntegrationError, is_traced, lane_name, raise_where
from .._results import RESULTS
from .._system import State
from ._interpolation import DenseInterpolation


class Solution(eqx.Module):
    """The outcome of `nhjax.integrate`.

    - `t0`, `t1`: first and last time.
    - `ts`: the times at which output was saved, shape (k,); None if nothing was.
    - `ys`: the saved states, a `State` with leading axis k, or whatever
        `SaveAt(fn=...)` returned, stacked; None if nothing was.
    - `stats`: `num_steps` (steps completed), `num_iterations` (of the nonlinear solver,
        in all), `num_newton_steps` (steps that the solver's own iteration did not solve
        and Newton's method had to), `max_residual` (of the stage equations, relative
        to the momenta),
        `max_constraint_violation` (|Φ| at the nodes, the first included),
        `max_multiplier_defect` (|Λ^s - λ_c|, how far the last stage multiplier of a
        step is from the continuous one), `failed_step` (index of the step that
        failed, -1 if none).
    - `result`: a `RESULTS`.
    - `interpolation`: the collocation polynomials, with `SaveAt(dense=True)`.

    Under `vmap` every array has the batch as leading axis; a batch member is a lane.
    """

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    # None, the empty tree, if nothing was saved.
    ts: PyTree[Float[Array, " k"]]
    ys: PyTree[Array]
    stats: dict[str, Any]
    result: RESULTS
    interpolation: DenseInterpolation | None

    def evaluate(self, t: FloatScalarLike) -> State:
        """The state at any time of the run, by the collocation polynomials.

        q(t) is the paper's continuous polynomial u(t), p(t) the mixed one v(t) of its
        Proposition on continuous approximation; v(t) follows from p(t) by the Legendre
        transform, and λ(t) is the continuous multiplier there (of a propagated
        multiplier, the polynomial through the Λ^i). At the nodes they are the states.
        Inside a step the error is O(h^s) in q, v and p, one order better in p and v if
        no force depends on the velocity.

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

    def failures(self) -> list[tuple[int | tuple[int, ...] | None, int, str]]:
        """The failed lanes as (lane, step, reason).

        `lane` is None without a batch, an index into a batch, and a tuple of indices
        into a batch of batches.
        """
        codes, steps = self.result._value, self.stats["failed_step"]
        if is_traced(codes, steps):
            raise RuntimeError(
                "Solution.failures() needs a computed solution, outside jit and vmap; "
                "inside them use `sol.result` and `sol.stats['failed_step']`."
            )
        return _failures(codes, steps)


def is_unsolved(sol: Solution) -> bool:
    """Whether a single run has ended because a step could not be solved."""
    unsolved = (
        RESULTS.nonlinear_divergence,
        RESULTS.nonlinear_max_iterations,
        RESULTS.left_chart,
    )
    return any(bool(sol.result == result) for result in unsolved)


def raise_failures(sol: Solution) -> Solution:
    """`sol`, or an `IntegrationError` that names lane, step and reason."""
    codes, steps = sol.result._value, sol.stats["failed_step"]
    bad = codes != _messages().index("")
    if is_traced(codes, steps):
        return raise_where(sol, bad, _failure, (codes, steps))
    if np.any(bad):
        raise _failure(bad, (codes, steps))
    return sol


def _failure(bad: Any, values: tuple[Any, Any]) -> IntegrationError:
    del bad
    return IntegrationError(_failure_message(_failures(*values)))


def _failures(
    codes: Any, steps: Any
) -> list[tuple[int | tuple[int, ...] | None, int, str]]:
    codes, steps = np.asarray(codes), np.asarray(steps)
    messages, failures = _messages(), []
    for index in np.ndindex(codes.shape):
        message = messages[int(codes[index])]
        if message:
            failures.append((lane_name(index), int(steps[index]), message))
    return failures


def _failure_message(
    failures: list[tuple[int | tuple[int, ...] | None, int, str]],
) -> str:
    lane, k, reason = failures[0]
    where = "" if lane is None else f"lane {lane}, "
    others = f" ({len(failures) - 1} more lanes failed)" if failures[1:] else ""
    return (
        f"Integration failed in {where}step {k}{others}: {reason} "
        "With `throw=False` the part before the failure is returned."
    )


@functools.cache
def _messages() -> list[str]:
    """The messages of `RESULTS` in the order of their codes."""
    # Items are arrays, and their codes are needed on the host.
    items = [
        RESULTS.successful,
        RESULTS.nonlinear_divergence,
        RESULTS.nonlinear_max_iterations,
        RESULTS.singular_stage_matrix,
        RESULTS.nonfinite_state,
        RESULTS.left_chart,
        RESULTS.inconsistent_start,
    ]
    with jax.ensure_compile_time_eval():
        return [RESULTS[item] for item in sorted(items, key=lambda x: int(x._value))]
