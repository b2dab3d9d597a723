"""Integration over many steps: the time loop, events, output and derivatives.

`_integrate` checks the arguments. `_run` has the compiled programs. Outside of the
transformations of JAX, `_chunks` calls such a program once for each chunk of steps. A
stepper is the object that advances a run by one iteration of the time loop. The plain
stepper in `_stepper` takes steps of equal size; the steppers in `_variable` and
`_events` use it for steps of different sizes and for events. `_loop` has the time loop
and the adjoints, which decide how the loop is differentiated. A further adjoint is in
`_reversible`.
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
