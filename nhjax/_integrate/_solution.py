"""The solution of a run, the log of its events, and the errors that it raises."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import FloatScalarLike
from .._errors import IntegrationError, is_traced, member_name, on_host, raise_where
from .._results import (
    EVENT_OCCURRED,
    FALLBACK,
    JUMPS,
    messages,
    result_codes,
    RESULTS,
)
from .._system import State
from ._checkpoint import Checkpoint
from ._dataset import to_dataset
from ._interpolation import DenseInterpolation


class EventLog(eqx.Module):
    """The events of a run in order of time: the field `events` of a `Solution`.

    - `num`: the number of events.
    - `ts`: the times of the events, of shape (e,), where e is the sum of the
        `max_events` of all events, or 1 if every event ends the run.
    - `which`: for each entry, the index of the event in the argument `event`.
    - `before`, `after`: the states at the events before and after their resets, each a
        `State` with a leading axis of length e.

    Unused entries are infinite, and -1 in `which`.
    """

    num: Int[Array, ""]
    ts: Float[Array, " e"]
    which: Int[Array, " e"]
    before: PyTree[Array]
    after: PyTree[Array]


class Solution(eqx.Module):
    """The result of `nhjax.integrate`: the saved output, and how the run went.

    - `t0`, `t1`: the first and the last time of the run.
    - `ts`: the times at which output was saved, of shape (k,); None if only dense
        output or a checkpoint was saved.
    - `ys`: the saved states, a `State` with a leading axis of length k, or the values
        of `SaveAt(fn=...)`, stacked along such an axis; None if `ts` is None.
    - `stats`: a dictionary of numbers about the run:
        `num_steps` (the number of completed steps),
        `num_iterations` (the total number of iterations of the stage solver),
        `num_newton_steps` (the number of steps that Newton's method solved after the
        stage solver's own iteration had failed),
        `num_rejected_steps` (only in a run with variable steps: the number of attempts
        at a step that were repeated with another size),
        `num_unsolved_steps` (only in such a run: the number of these repeated attempts
        whose equations were not solved),
        `max_error_over_tolerance` (only with `PIDController`: the largest estimated
        error of an accepted step, in units of its tolerance),
        `num_redundant` (the number of redundant constraints at the start; if there are
        any, the reactions are not unique),
        `max_residual` (the largest residual of the stage equations, relative to the
        momenta),
        `max_constraint_violation` (the largest |Φ|, |Γ| or |dΓ/dt| at the initial state
        and at the ends of the steps),
        `max_multiplier_defect` (the largest |Λ^s - λ_c|, where Λ^s is the last stage
        multiplier of a step, and λ_c the multiplier of the continuous equations at the
        end of the step),
        `max_invariant_error` (only with `invariants`: the largest |I - I_0| of a
        conserved function, relative to the size of its terms),
        `max_error_estimate` (the largest estimated error of a step, relative to the
        change of the state in the step; a value of 1 means that the step is entirely
        wrong; missing if all stages of the method are at one time),
        `failed_step` (the index of the step that failed, -1 for none), and
        `worst_coordinate` (the index of the coordinate whose momentum equations had
        the largest residual, or a residual that is not a number, in the step that
        failed; -1 if no step failed).
    - `result`: a member of `nhjax.RESULTS`, which says how the run ended.
    - `interpolation`: the collocation polynomials, with `SaveAt(dense=True)`; None
        otherwise.
    - `checkpoint`: the `nhjax.Checkpoint` from which a later run continues bit for bit,
        with `SaveAt(checkpoint=True)`; None otherwise.
    - `coordinates`: the names of the coordinates, or None if the system has no names.
    - `events`: an `nhjax.EventLog` of the events of the run if `event` was given; None
        otherwise. With `event`, `stats` also has `num_events`, and `num_steps` counts
        only steps whose end was reached. If an event ends the run, `t1` is the time of
        this event, and with constant steps all later entries of `ts` and `ys` repeat
        the time and the state of the event.

    With variable steps, the output of a call outside of transformations has entries
    only for the steps that were taken. Under `jit` the output has entries for the
    largest possible number of steps, and entries that are not used are infinite.

    Under `vmap` every array has a leading axis for the members of the batch.
    """

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    # `PyTree` includes None, the empty tree, so that type checkers do not require users
    # to test for None.
    ts: PyTree[Float[Array, " k"]]
    ys: PyTree[Array]
    stats: dict[str, Any]
    result: RESULTS
    interpolation: DenseInterpolation | None
    checkpoint: PyTree[Checkpoint] = None
    coordinates: tuple[str, ...] | None = eqx.field(default=None, static=True)
    events: PyTree[EventLog] = None

    def evaluate(self, t: FloatScalarLike) -> State:
        """Compute the state at any time of the run, by the collocation polynomials.

        The configuration q(t) is the paper's continuous polynomial (there u(t)), and
        the momentum p(t) is the mixed polynomial (there v(t)) of its Proposition on
        continuous approximation. The velocity v(t) follows from p(t) by the Legendre
        transform.
        λ(t) is the multiplier of the continuous equations at that state; with the
        propagated closure it is the polynomial through the stage multipliers Λ^i.
        At the ends of the steps the result is the state that `integrate` computed.
        With s stages, the error inside a step is O(h^s) in q, v and p. If no force
        depends on the velocity, the error in p and v is O(h^{s+1}).

        **Arguments:**

        - `t`: a time between `t0` and `t1`; for many times, use
            `jax.vmap(sol.evaluate)`. To compile the evaluation, use
            `eqx.filter_jit(sol.evaluate)`.

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
                "Dense output was not saved. To evaluate the solution between steps, "
                "pass `saveat=nhjax.SaveAt(dense=True)` to `integrate`."
            )
        return self.interpolation.evaluate(t)

    def to_xarray(
        self,
        *,
        coordinates: Sequence[str] | None = None,
        units: Mapping[str, str] | None = None,
    ) -> Any:
        """Return the saved output as an `xarray.Dataset` with named axes.

        The variables are `q`, `v`, `p` and `multiplier`, with the dimensions `time`,
        `coordinate` and `constraint`. If the elements of a group have more numbers than
        the group has dimensions, `q` has the dimension `q_0` instead of `coordinate`.
        On a product of groups the parts of `q` are `q0`, `q1`, and so on. Values of
        `SaveAt(fn=...)` are named by their paths in the tree; a single array is named
        `value`.

        The `stats` are variables such as `stats_num_steps`, and `result` is the name of
        a member of `nhjax.RESULTS`. A run with events has the variables `event_t` and
        `event_which` with the dimension `event`. A batch has the first dimension
        `trajectory` (a batch of batches `trajectory_0`, `trajectory_1`). If the members
        of a batch have different times, `time` has no labels, and the variable `t` has
        the times.

        **Arguments:**

        - `coordinates`: the names of the n coordinates. The default is the names in the
            system.
        - `units`: a mapping from names to units, where a name is a variable, `time`, or
            a coordinate. Units of variables and of `time` become the attribute `units`.
            Units of coordinates become the labels `coordinate_unit`. Units of
            coordinates divided by the unit of `time` become the labels `velocity_unit`.
            The unit of a momentum does not follow from these units.

        **Returns:** an `xarray.Dataset`.

        **Raises:** `ImportError` without xarray (`pip install "nhjax[xarray]"`);
        `RuntimeError` under `jit` and `vmap`; `ValueError` if the run saved no states,
        for unknown names in `units`, or for a wrong number of names in `coordinates`.

        !!! example

            >>> import nhjax
            >>> disc = nhjax.systems.VerticalRollingDisc()
            >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
            ...     disc.initial_state(), dt=0.5, num_steps=4,
            ...     saveat=nhjax.SaveAt(steps=True))
            >>> data = sol.to_xarray(coordinates=("x", "y", "θ", "φ"))
            >>> data.q.sel(coordinate="x", time=1.5).shape
            ()
        """
        return to_dataset(self, coordinates, {} if units is None else units)

    def failures(self) -> list[tuple[int | tuple[int, ...] | None, int, str]]:
        """List the runs that failed, each as (member, step, reason).

        `step` is the index of the step that failed, and `reason` is the message of the
        run's `result`; it may also name a coordinate. `member` is None for a solution
        without a batch, an index for a batch, and a tuple of indices for a batch of
        batches.
        """
        outcome = _outcome(self)
        if is_traced(*outcome):
            raise RuntimeError(
                "Solution.failures() needs a computed solution, outside jit and vmap. "
                "Inside them, use `sol.result` and `sol.stats['failed_step']`."
            )
        return _failures(outcome, self.coordinates)


class _Outcome(NamedTuple):
    """How runs ended: the codes of `RESULTS`, failed steps and worst coordinates."""

    codes: Any
    steps: Any
    coordinates: Any


def _outcome(sol: Solution) -> _Outcome:
    stats = sol.stats
    return _Outcome(sol.result._value, stats["failed_step"], stats["worst_coordinate"])


def is_unsolved(sol: Solution) -> bool:
    """Return whether a run without a batch ended because a step was not solved."""
    unsolved = "nonlinear_divergence", "nonlinear_max_iterations", "left_chart"
    return ended_as(sol, *unsolved)


def ended_as(sol: Solution, *results: str) -> bool:
    """Return whether a run without a batch ended with one of the named `RESULTS`."""
    code = int(sol.result._value)
    return any(code == result_codes()[name] for name in results)


def is_singular_from_the_start(sol: Solution) -> bool:
    """Return whether a single run failed in step 0 because a matrix is singular."""
    singular = ended_as(sol, "singular_stage_matrix")
    return singular and int(sol.stats["failed_step"]) == 0


def raise_failures(
    sol: Solution, dt: FloatScalarLike | None = None, used_newton: bool = False
) -> Solution:
    """Return `sol`, or raise an `IntegrationError` with member, step and reason.

    The message may suggest a smaller step size if `dt` is given, and may recommend
    Newton's method unless the run has already `used_newton`.
    """
    outcome = on_host(_outcome(sol))
    bad = outcome.codes != messages().index("")
    if sol.events is not None:
        bad = bad & (outcome.codes != messages().index(EVENT_OCCURRED))
    if is_traced(*outcome, dt):
        failure = partial(_failure, used_newton, sol.coordinates)
        return raise_where(sol, bad, failure, (outcome, dt))
    if np.any(bad):
        raise _failure(used_newton, sol.coordinates, bad, (outcome, dt))
    return sol


def _failure(
    used_newton: bool,
    names: tuple[str, ...] | None,
    bad: Any,
    values: tuple[_Outcome, Any],
) -> IntegrationError:
    outcome, dt = values
    first = tuple(np.argwhere(bad)[0])
    size = None if dt is None else float(np.broadcast_to(dt, np.shape(bad))[first])
    message = _failure_message(_failures(outcome, names), size)
    return IntegrationError(message.replace(FALLBACK, "") if used_newton else message)


def _failures(
    outcome: _Outcome, names: tuple[str, ...] | None
) -> list[tuple[int | tuple[int, ...] | None, int, str]]:
    codes, steps, coordinates = map(np.asarray, outcome)
    texts, failures = messages(), []
    for index in np.ndindex(codes.shape):
        message, coordinate = texts[int(codes[index])], int(coordinates[index])
        # Other failures are not due to a single equation.
        if "stage equations" in message and coordinate >= 0:
            name = "" if names is None else f" ({names[coordinate]})"
            message += (
                " The equation with the largest residual, or with one that is not a "
                f"number, belongs to coordinate {coordinate}{name}."
            )
        if message not in ("", EVENT_OCCURRED):
            failures.append((member_name(index), int(steps[index]), message))
    return failures


def _failure_message(
    failures: list[tuple[int | tuple[int, ...] | None, int, str]], dt: float | None
) -> str:
    member, k, reason = failures[0]
    where = "" if member is None else f"member {member}, "
    others = f" ({len(failures) - 1} more members failed)" if failures[1:] else ""
    if dt is not None and "smaller `dt`" in reason:
        smooth = "if all forces are smooth, " if JUMPS in reason else ""
        reason += (
            f" `dt` is {dt:.6g}: {smooth}try {0.5 * dt:.6g}, or let the steps adapt, "
            "with `t1` and `stepsize_controller=nhjax.PIDController(rtol, atol)`."
        )
    message = f"Integration failed in {where}step {k}{others}: {reason}"
    if k > 0:
        message += " With `throw=False` the part before the failure is returned."
        if "stage equations" in reason:
            message += (
                " If the velocities grow without bound there, no `dt` is small enough: "
                "end the run earlier with an `nhjax.Event`."
            )
    return message
