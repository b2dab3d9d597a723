"""Checks of the arguments that the functions of `nhjax._analysis` have in common."""

import operator
from typing import Any

from .._custom_types import Args, FloatScalar, FloatScalarLike
from .._system import (
    check_state,
    check_time_and_state,
    check_type,
    HamiltonianSystem,
    LagrangianSystem,
    real_scalar,
)


def checked_time(
    function: str, system: Any, t: FloatScalarLike, y: Any, args: Args
) -> FloatScalar:
    """Return the time as an array; raise for what is no system, time or state of it."""
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    check_time_and_state(function, t, y, "system, ")
    check_state(system, y, args, "y")
    return real_scalar("t", t, y.p.dtype)


def checked_count(name: str, value: Any) -> int:
    """Return a number of iterations, or raise a `ValueError`."""
    try:
        count = operator.index(value)
    except TypeError:
        count = 0
    if count < 1 or isinstance(value, bool):
        raise ValueError(f"`{name}` must be an int >= 1, got {value!r}.")
    return count
