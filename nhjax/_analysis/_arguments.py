"""Checks of the arguments that the functions of this room have in common."""

from typing import Any

from .._custom_types import FloatScalar, FloatScalarLike
from .._system import (
    check_time_and_state,
    check_type,
    HamiltonianSystem,
    LagrangianSystem,
    real_scalar,
)


def checked_time(function: str, system: Any, t: FloatScalarLike, y: Any) -> FloatScalar:
    """Return the time as an array; raise for what is no system, time or state."""
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))
    check_time_and_state(function, t, y, "system, ")
    return real_scalar("t", t, y.p.dtype)
