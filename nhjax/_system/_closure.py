"""Conversion of a system, so that arrays its functions close over become its leaves."""

from typing import TypeVar

import equinox as eqx

from .._custom_types import Args, FloatScalar
from .._numerics import ClosureConverted
from ._abstract import AbstractMechanicalSystem
from ._state import State


S = TypeVar("S", bound=AbstractMechanicalSystem)


def closure_converted(system: S, t: FloatScalar, y: State, args: Args) -> S:
    """Return the system with the arrays that its functions close over as leaves.

    A step can be differentiated with respect to leaves of its arguments alone.
    """
    functions = system.functions(t, y.q, system.fibre_coordinate(y), args)
    return eqx.tree_at(
        lambda system: [getattr(system, name) for name in functions],
        system,
        [ClosureConverted(f, *example) for f, example in functions.values()],
    )
