"""Systems as programs see them: with what their functions close over as leaves."""

from typing import TypeVar

import equinox as eqx

from .._custom_types import Args, FloatScalar
from .._numerics import ClosureConverted
from ._abstract import AbstractMechanicalSystem
from ._state import State


S = TypeVar("S", bound=AbstractMechanicalSystem)


def closure_converted(system: S, t: FloatScalar, y: State, args: Args) -> S:
    """The system, with the arrays that its functions close over among its leaves.

    Only leaves of what a step is given can be differentiated.
    """
    functions = system.functions(t, y.q, system.fibre_coordinate(y), args)
    return eqx.tree_at(
        lambda system: [getattr(system, name) for name in functions],
        system,
        [ClosureConverted(f, *example) for f, example in functions.values()],
    )
