"""What the reset of an event returns, made a state."""

import reprlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from .._custom_types import Args, FloatScalar
from .._errors import DTypeError, naming, ShapeError
from .._system import AbstractMechanicalSystem, configuration, floating, State


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
    with naming(f"Event {i}: reset(t, y, args)", reset, args):
        out = reset(t, y, args)
    if isinstance(out, tuple | list) and len(out) == 2:
        q, u = configuration(out[0]), floating(name, out[1])
        _check_part(called, "q", q, y.q)
        _check_part(called, name, u, y.p)
        v, p = system.velocity(t, q, u, args), system.momentum(t, q, u, args)
        return State(q, v, p, y.multiplier)
    if not isinstance(out, State):
        raise TypeError(
            f"{called} must return a pair (q, {name}) or an nhjax.State, got "
            f"{reprlib.repr(out)} of type {type(out).__name__}."
        )
    for part in ("q", "v", "p", "multiplier"):
        _check_part(called, part, getattr(out, part), getattr(y, part))
    return out


def _check_part(called: str, name: str, got: Any, like: Any) -> None:
    """Raise unless a part of what a reset returned has the arrays of a state's."""

    def tree(x: Any) -> Any:
        return jax.tree.structure(x)

    if tree(got) != tree(like) or not all(map(eqx.is_array, jax.tree.leaves(got))):
        raise TypeError(
            f"{called} returned the `{name}` {reprlib.repr(got)} of type "
            f"{type(got).__name__}, but it must be as in the state that it is given: "
            f"{reprlib.repr(like)}."
        )
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(like), strict=True):
        if x.shape != y.shape:
            raise ShapeError(
                f"{called} returned a `{name}` with an array of shape {x.shape}, but "
                f"the state that it is given has shape {y.shape} there."
            )
        if x.dtype != y.dtype:
            raise DTypeError(
                f"{called} returned a `{name}` of dtype {x.dtype}, but the state that "
                f"it is given has {y.dtype}: constants of another precision inside it?"
            )
