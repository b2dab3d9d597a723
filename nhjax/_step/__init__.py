"""One step of a method: its stage equations, their solvers, its end and derivative."""

from .._numerics import Solved as Solved
from ._curved_chart import chart_of_step as chart_of_step
from ._derivative import (
    change_of_step as change_of_step,
    primitive_step as primitive_step,
    tangent_of_outcome as tangent_of_outcome,
)
from ._error_estimate import estimated_error as estimated_error
from ._invariants import (
    invariant_values as invariant_values,
    Invariants as Invariants,
    LEAST_PART as LEAST_PART,
)
from ._jacobian import stage_residual as stage_residual
from ._newton import (
    AbstractStageSolver as AbstractStageSolver,
    is_simplified_alone as is_simplified_alone,
    leaves_steps_to_newton as leaves_steps_to_newton,
    Newton as Newton,
    SimplifiedNewton as SimplifiedNewton,
)
from ._record import StepRecord as StepRecord
from ._round_off import (
    round_off_of_steps as round_off_of_steps,
    RoundOff as RoundOff,
)
from ._step import (
    first_step_state as first_step_state,
    largest_violation as largest_violation,
    step as step,
    StepArguments as StepArguments,
    StepOutcome as StepOutcome,
    StepState as StepState,
)
