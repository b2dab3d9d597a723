"""Events: zeros of functions along a trajectory, and what happens there."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import numpy as np

from .._system import check_flag, check_signature, check_type
from ._saveat import SaveAt


class Event(eqx.Module):
    """A zero of a function along a trajectory, and what happens there.

    `integrate(..., event=...)` finds the zeros of `cond_fn(t, y, args)` by its sign at
    the ends of the steps. The step in which the sign changes is repeated with the size
    θ dt, 0 < θ <= 1, at whose end the function vanishes to round-off, so that the state
    at the event is the end of a step of the method. The size is differentiated by the
    implicit function theorem. Then the run ends, or goes on with the rest of the step,
    after a `reset` of the state if there is one.

    At `t0` and right after an event a function that is zero has the sign of its rate
    along the motion: what starts on a surface and leaves it does not meet it there. A
    function that touches zero within a step and has the same sign at both ends is not
    seen.

    **Arguments:**

    - `cond_fn`: a function (t, y, args) of a `State` that returns a real scalar. The
        multiplier of y is the continuous one, as of `nhjax.continuous_multiplier`.
    - `direction`: meet zeros where the function increases along the run (True), where
        it decreases (False), or both (None).
    - `reset`: a function (t, y, args) of the state at the event that returns the state
        to go on with: a pair (q, v), for a Hamiltonian system (q, p), or a `State`. It
        must satisfy the constraints.
    - `terminate`: end the run at the event, after its reset; by default True without a
        `reset`, and False with one. With False and no `reset` zeros are found and
        reported alone.
    - `max_events`: how many events a run has room for, an int >= 1; of several events
        the sum counts. One more ends the run with `RESULTS.too_many_events`. With
        `terminate` it is 1.

    **Raises:** `TypeError` or `ValueError` for arguments of a wrong type or value, and
    for functions that do not take (t, y, args) in this order.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> ball = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - q[0])
        >>> bounce = nhjax.Event(lambda t, y, args: y.q[0], direction=False,
        ...     reset=lambda t, y, args: (y.q, -0.5 * y.v))
        >>> y0 = nhjax.initial_state(ball, jnp.array([0.5]), jnp.array([0.0]))
        >>> sol = nhjax.integrate(ball, nhjax.LobattoIIIAB(2), y0, dt=0.3, num_steps=5,
        ...     event=bounce)
        >>> int(sol.events.num), round(float(sol.events.ts[0]), 6)
        (1, 1.0)
    """

    cond_fn: Callable[[Any, Any, Any], Any]
    direction: bool | None = eqx.field(static=True)
    reset: Callable[[Any, Any, Any], Any] | None
    terminate: bool = eqx.field(static=True)
    max_events: int = eqx.field(static=True)

    def __init__(
        self,
        cond_fn: Callable[[Any, Any, Any], Any],
        *,
        direction: bool | None = None,
        reset: Callable[[Any, Any, Any], Any] | None = None,
        terminate: bool | None = None,
        max_events: int = 32,
    ):
        for name, function in (("cond_fn", cond_fn), ("reset", reset)):
            if name == "cond_fn" or function is not None:
                check_signature("Event", name, function, ("t", "y", "args"))
        if not isinstance(direction, bool | np.bool_ | None):
            raise TypeError(
                "Event: `direction` must be True or False, for functions that increase "
                f"or decrease, or None for both, got {direction!r}."
            )
        if terminate is None:
            terminate = reset is None
        if not isinstance(max_events, int | np.integer) or max_events < 1:
            raise ValueError(
                f"Event: `max_events` must be an int >= 1, got {max_events!r}."
            )
        self.cond_fn, self.reset = cond_fn, reset
        self.direction = None if direction is None else bool(direction)
        self.terminate = check_flag("terminate", terminate)
        self.max_events = 1 if self.terminate else int(max_events)


def _as_events(event: Any) -> tuple[Event, ...] | None:
    """Return the events of a run as a tuple, or None if there are none."""
    if event is None:
        return None
    events = tuple(event) if isinstance(event, list | tuple) else event
    if not isinstance(events, tuple):
        events = (events,)
    advice = "Such as nhjax.Event(cond_fn), or a sequence of them."
    for one in events:
        check_type("event", one, Event, advice)
    return events or None


def checked_events(
    event: Event | Sequence[Event] | None, saveat: SaveAt, invariants: object
) -> tuple[Event, ...] | None:
    """Return the events of a run, or raise if something asked for goes without them."""
    events = _as_events(event)
    if events is not None and saveat.checkpoint:
        raise ValueError(
            "SaveAt: `checkpoint=True` is not available together with `event`, since "
            "the run may end between two nodes. Go on from its last state with the "
            "`t0` that is `sol.t1`."
        )
    if events is not None and invariants is not None:
        raise ValueError(
            "`invariants` are not available together with `event`, since a reset "
            "changes them. Leave out one of the two."
        )
    if events is not None and (saveat.dense or saveat.ts is not None):
        option = "dense=True" if saveat.dense else "ts=..."
        raise ValueError(
            f"SaveAt: `{option}` is not available together with `event`, since a step "
            "that is cut has two polynomials. Save at `steps`; `Solution.events` has "
            "the times and states of the events, and runs from one to the next have "
            "dense output."
        )
    return events
