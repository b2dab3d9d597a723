"""The arguments of `integrate` beside system, method, state and args, once checked."""

from collections.abc import Callable
from typing import Any

import equinox as eqx

from .._custom_types import FloatScalar, IntScalar
from .._step import AbstractStageSolver
from ._adjoint import AbstractAdjoint
from ._event import Event
from ._progress_meter import AbstractProgressMeter
from ._saveat import SaveAt


class TimeGrid(eqx.Module):
    """The nodes t_k = t0 + k dt of a run, for k = 0, ..., num_steps."""

    t0: FloatScalar
    dt: FloatScalar
    num_steps: int | IntScalar


class Options(eqx.Module):
    """The functions of a user beside the system's: what is saved, kept and waited for.

    The fields are the arguments of `integrate` of the same names, and `events` its
    `event` as a tuple.
    """

    saveat: SaveAt
    invariants: str | Callable[..., Any] | None
    events: tuple[Event, ...] | None


class Means(eqx.Module):
    """The means by which steps are solved, differentiated and reported."""

    stage_solver: AbstractStageSolver
    adjoint: AbstractAdjoint
    meter: AbstractProgressMeter
