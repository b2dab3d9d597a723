"""Integration over many steps: the time loop, events, output and derivatives.

`_integrate` checks the arguments, `_run` has the compiled programs, `_chunks` drives
them outside of transformations, `_loop` iterates and is differentiated by adjoints, of
which `_reversible` is one, `_stepper` takes the steps, and `_events` wraps the plain
stepper.
"""

from ._checkpoint import Checkpoint as Checkpoint
from ._dataset import (
    named_arrays as named_arrays,
    units_of_coordinates as units_of_coordinates,
)
from ._events import Event as Event
from ._integrate import (
    integrate as integrate,
    step as step,
    suggest_step as suggest_step,
)
from ._interpolation import DenseInterpolation as DenseInterpolation
from ._loop import (
    AbstractAdjoint as AbstractAdjoint,
    DirectAdjoint as DirectAdjoint,
    RecursiveCheckpointAdjoint as RecursiveCheckpointAdjoint,
)
from ._progress_meter import (
    AbstractProgressMeter as AbstractProgressMeter,
    NoProgressMeter as NoProgressMeter,
    TextProgressMeter as TextProgressMeter,
    TqdmProgressMeter as TqdmProgressMeter,
)
from ._reversible import ReversibleAdjoint as ReversibleAdjoint
from ._saving import SaveAt as SaveAt
from ._solution import (
    EventLog as EventLog,
    raise_failures as raise_failures,
    Solution as Solution,
)
from ._step_sizes import (
    AbstractStepSizeController as AbstractStepSizeController,
    ConstantStepSize as ConstantStepSize,
    PIDController as PIDController,
    ReversibleController as ReversibleController,
)
