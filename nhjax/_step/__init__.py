"""One step of a method: its equations, their solvers, its end and its derivative."""

from .._numerics import Solved as Solved
from ._chart import chart_of_step as chart_of_step
from ._equations import stage_residual as stage_residual
from ._first_order import has_force_slopes as has_force_slopes
from ._invariants import (
    invariant_values as invariant_values,
    Invariants as Invariants,
    LEAST_PART as LEAST_PART,
)
from ._jacobian import ForceSlopeError as ForceSlopeError
from ._local_error import local_error as local_error
from ._solvers import (
    has_default_jacobian as has_default_jacobian,
    is_simplified_alone as is_simplified_alone,
    Newton as Newton,
    SimplifiedNewton as SimplifiedNewton,
    solvers_of_unsolved_steps as solvers_of_unsolved_steps,
)
from ._step import (
    AbstractStageSolver as AbstractStageSolver,
    estimated_error as estimated_error,
    first_step_state as first_step_state,
    ImplicitStep as ImplicitStep,
    largest_violation as largest_violation,
    StepArguments as StepArguments,
    StepOutcome as StepOutcome,
    StepRecord as StepRecord,
    StepState as StepState,
    tangent_of_outcome as tangent_of_outcome,
)
