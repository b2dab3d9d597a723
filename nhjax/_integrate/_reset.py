"""What the reset of an event returns, made a state."""

import reprlib
from collections.abc import Callable
from typing import Any

from .._custom_types import Args, FloatScalar
from .._errors import ShapeError
from .._system import (
    AbstractMechanicalSystem,
    check_state,
    configuration,
    floating,
    State,
)


def completed(
    system: AbstractMechanicalSystem,
    i: int,
    reset: Callable[[Any, Any, Any], Any],
    t: FloatScalar,
    y: State,
    args: Args,
) -> State:
    """Make a state of what a reset returns, a pair (q, u) or a state."""
    name = system.fibre_coordinate_name
    called = f"Event {i}: `reset(t, y, args)`"
    out = reset(t, y, args)
    if isinstance(out, tuple | list) and len(out) == 2:
        q, u = configuration(out[0]), floating(name, out[1])
        if u.shape != y.p.shape:
            raise ShapeError(
                f"{called} returned a `{name}` of shape {u.shape}, but a state has "
                f"shape {y.p.shape}."
            )
        v, p = system.velocity(t, q, u, args), system.momentum(t, q, u, args)
        out = State(q, v, p, y.multiplier)
    if not isinstance(out, State):
        raise TypeError(
            f"{called} must return a pair (q, {name}) or an nhjax.State, got "
            f"{reprlib.repr(out)} of type {type(out).__name__}."
        )
    check_state(system, out, args, called=f"reset of event {i}")
    return out
