"""The ways in which a run can end, with messages that give advice."""

import functools
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ._errors import member_name


JUMPS = (
    "that jump, such as friction with `jnp.sign(v)`, have no solution in a step across "
    "the jump, however small: smooth them, as in `jnp.tanh(v / 0.01)`, or split the "
    "run at the jump with an `nhjax.Event`."
)
# This advice is given only if the stage solver does not switch to Newton's method.
FALLBACK = (
    ', or `stage_solver=nhjax.SimplifiedNewton(jacobian="full")` where feedback, '
    "springs or reactions are stiff, or "
    "`stage_solver=nhjax.SimplifiedNewton(fallback=True)`, by which Newton's "
    "method takes over steps that are not solved"
)
EVENT_OCCURRED = "An event ended the run, as requested; this is not a failure."


# When a result is printed, the metaclass of its enumeration looks up its text.
class _Named(type(eqx.Enumeration)):
    """The metaclass of `RESULTS`: the texts of results begin with their names."""

    def __getitem__(cls, item: Any) -> str:
        is_known = isinstance(item, cls) and eqx.is_array_like(item._value)
        if not is_known or item.is_traced():
            return super().__getitem__(item)
        names = {code: name for name, code in result_codes().items()}
        codes = np.asarray(item._value)
        if codes.ndim:
            return _counted(codes, names)
        name, message = names[int(codes)], super().__getitem__(item)
        return f"{name}: {message}" if message else name


def _counted(codes: np.ndarray, names: dict[int, str]) -> str:
    """Return a text that counts runs by result.

    It also names the first run of each result except `successful`.
    """
    parts = []
    for code in np.unique(codes):
        where, name = np.argwhere(codes == code), names[int(code)]
        first = member_name(tuple(where[0].tolist()))
        which = "" if name == "successful" else f" (first: {first})"
        parts.append(f"{len(where)} {name}{which}")
    return f"{codes.size} runs: {', '.join(parts)}" if parts else "0 runs"


class RESULTS(eqx.Enumeration, metaclass=_Named):
    """The ways in which a run can end.

    `RESULTS[sol.result]` is the name of the result with a message that says what to do;
    for many runs, it is the number of runs with each result. `print(sol.result)` shows
    the same text. `sol.failures()` has the message of each failed run.
    """

    # This assignment makes a result print as `nhjax.RESULTS<...>`.
    __module__ = "nhjax"

    successful = ""
    nonlinear_divergence = (
        "The stage equations of a step could not be solved: Newton's iteration "
        "diverged. Try a smaller `dt`" + FALLBACK + ". Forces " + JUMPS
    )
    nonlinear_max_iterations = (
        "The stage equations of a step were not solved to round-off within the "
        "`max_iterations` of the stage solver: its iteration converges too slowly, or "
        "not at all. Try a smaller `dt`"
        + FALLBACK
        + ", or more iterations; where stiff forces magnify round-off, a `tolerance` "
        "of the stage solver. None of these helps in two cases. Forces "
        + JUMPS
        + " And if constraints become dependent during the step, for instance in a "
        "linkage whose bars lie in one line, the multipliers and the further motion "
        "are not determined."
    )
    singular_stage_matrix = (
        "The mass matrix D2D2L (or D2D2H) or the compatibility matrix C = D2Φ M⁻¹ D2Φᵀ "
        "became singular, so that the multiplier is not determined. The system has "
        "reached the edge of its domain, or its constraints are dependent, which "
        '`constraints="redundant"` of a system permits.'
    )
    nonfinite_state = (
        "The state became infinite or NaN, or was so from the start. Check `y0` and "
        "the functions of the system along the trajectory, or try a smaller `dt`."
    )
    left_chart = (
        "A step, or its iteration, left the chart of the retraction: it turned by an "
        "angle near π (Cayley) or 2π (Exponential) from the origin of the chart, which "
        "is in the middle of a step or at its start. With Cayley and two stages, a "
        "step of about one radian may have no solution. Use a smaller `dt`, "
        "`retraction=nhjax.Exponential()`, or more stages."
    )
    lost_constraints = (
        "Constraints are violated at the end of a step, although the step enforced as "
        "many as were independent at its start: the redundant constraints contradict "
        "each other, or more of them became independent. Leave out constraints that "
        "do not always follow from the others."
    )
    inconsistent_start = (
        "The initial state violates the constraints at `t0`, its q is not an element "
        "of the group, or its p is not the momentum of its v. Create `y0` with "
        "`nhjax.initial_state`, for the system, args and time of the integration; do "
        "not change a state by hand."
    )
    invalid_argument = (
        "An argument of the run is not valid: `dt` or `t0` is not finite, `dt` is zero "
        "or so small that time does not advance, `num_steps` is less than 1, or `ts` "
        "of `SaveAt` is not sorted or reaches outside the run. With `throw=True` "
        "the message names it."
    )
    not_conserved = (
        "The system does not conserve the `invariants`: their rate of change "
        "along the motion is not zero at the start, or at a state near it. Reactions "
        "of affine, rheonomic and other constraints that are not homogeneous in the "
        "velocities do work, as forces do. If such a system conserves another "
        "quantity, such as a moving energy, pass it as a function."
    )
    event_occurred = EVENT_OCCURRED
    nonfinite_event = (
        "The condition of an event became infinite or NaN where the state is finite. "
        "Check its `cond_fn` along the trajectory."
    )
    inconsistent_reset = (
        "The state that the `reset` of an event returned is not finite, violates the "
        "constraints, its q is not on the group, or its v and p do not agree. "
        "Return a pair (q, v), for a Hamiltonian system (q, p), whose velocity "
        "satisfies the constraints."
    )
    too_many_events = (
        "There were more events than the sum of the `max_events` of the "
        "`nhjax.Event`s, or an event triggered itself within round-off. Increase "
        "`max_events`, unless the events accumulate at one time, like the bounces of a "
        "ball that comes to rest: then end the run, or let the reset keep the "
        "motion away from the next event."
    )
    max_steps_reached = (
        "The run took `max_steps` attempts at a step before it reached its end. Pass a "
        "larger `max_steps`, or allow larger errors; `SaveAt(checkpoint=True)` with "
        "`throw=False` returns a checkpoint from which the run goes on. If the "
        "equations of many attempts were not solved (`num_unsolved_steps` in `stats`), "
        'pass `stage_solver=nhjax.SimplifiedNewton(jacobian="full")`.'
    )
    dt_min_reached = (
        "The error of a step is larger than the tolerance of the "
        "`stepsize_controller` even at its `dtmin`, or, without one, at the smallest "
        "step by which time advances. Lower `dtmin` or allow larger errors. Forces "
        + JUMPS
    )
    density_not_positive = (
        "The step density of the `stepsize_controller` is zero, negative or not a "
        "number, or follows its `density` so badly that the next step would have no "
        "size. Check that `density` is positive along the trajectory, and try a "
        "smaller `eps`."
    )
    interrupted = (
        "The run was interrupted from the keyboard. The solution ends with the last "
        "step before the interruption."
    )


@functools.cache
def result_codes() -> dict[str, int]:
    """Map the names of all `RESULTS` to the integers that represent them in arrays."""
    names = (
        "successful",
        "nonlinear_divergence",
        "nonlinear_max_iterations",
        "singular_stage_matrix",
        "nonfinite_state",
        "left_chart",
        "lost_constraints",
        "inconsistent_start",
        "invalid_argument",
        "not_conserved",
        "event_occurred",
        "nonfinite_event",
        "inconsistent_reset",
        "too_many_events",
        "max_steps_reached",
        "dt_min_reached",
        "density_not_positive",
        "interrupted",
    )
    # The items hold JAX arrays. Their codes are needed as Python integers, also while
    # JAX traces the caller.
    with jax.ensure_compile_time_eval():
        return {name: int(getattr(RESULTS, name)._value) for name in names}


@functools.cache
def messages() -> list[str]:
    """List the messages of `RESULTS`, without names, in the order of their codes."""
    codes = result_codes()
    with jax.ensure_compile_time_eval():
        ordered = sorted(codes, key=lambda name: codes[name])
        texts = [RESULTS[getattr(RESULTS, name)] for name in ordered]
    return [text.partition(": ")[2] for text in texts]
