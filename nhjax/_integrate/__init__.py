"""Integration over many steps: the time loop, events, output and derivatives.

`_integrate` checks the arguments and compiles the run, `_loop` iterates, `_stepper`
takes the steps, `_events` wraps the plain stepper, and `_adjoint` and `_reversible`
differentiate the loop.
"""

from ._adjoint import (
    AbstractAdjoint as AbstractAdjoint,
    DirectAdjoint as DirectAdjoint,
    RecursiveCheckpointAdjoint as RecursiveCheckpointAdjoint,
)
from ._checkpoint import Checkpoint as Checkpoint
from ._dataset import (
    named_arrays as named_arrays,
    units_of_coordinates as units_of_coordinates,
)
from ._events import Event as Event, EventLog as EventLog
from ._integrate import integrate as integrate, step as step
from ._interpolation import DenseInterpolation as DenseInterpolation
from ._progress_meter import (
    AbstractProgressMeter as AbstractProgressMeter,
    NoProgressMeter as NoProgressMeter,
    TextProgressMeter as TextProgressMeter,
    TqdmProgressMeter as TqdmProgressMeter,
)
from ._reversible import ReversibleAdjoint as ReversibleAdjoint
from ._saving import SaveAt as SaveAt
from ._solution import raise_failures as raise_failures, Solution as Solution
