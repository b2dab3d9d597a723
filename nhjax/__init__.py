"""High-order geometric integrators for nonholonomic mechanical systems, in JAX."""

from importlib import import_module
from typing import Any, TYPE_CHECKING

from . import lanes as lanes
from ._analysis import (
    check_system as check_system,
    linear_stability as linear_stability,
    LinearStability as LinearStability,
    Motion as Motion,
    motion as motion,
    steady_motion as steady_motion,
    SystemReport as SystemReport,
)
from ._ensemble import (
    AbstractReduction as AbstractReduction,
    ensemble as ensemble,
    EnsembleOutcome as EnsembleOutcome,
    Histogram as Histogram,
    HistogramCounts as HistogramCounts,
    Maximum as Maximum,
    Mean as Mean,
    Minimum as Minimum,
    Variance as Variance,
)
from ._errors import (
    ConstraintViolationError as ConstraintViolationError,
    DependentConstraintsError as DependentConstraintsError,
    DTypeError as DTypeError,
    IncompatibleConstraintsError as IncompatibleConstraintsError,
    IntegrationError as IntegrationError,
    IrregularLagrangianError as IrregularLagrangianError,
    NewtonError as NewtonError,
    NonFiniteError as NonFiniteError,
    ShapeError as ShapeError,
)
from ._initial import initial_state as initial_state
from ._integrate import (
    AbstractAdjoint as AbstractAdjoint,
    AbstractProgressMeter as AbstractProgressMeter,
    AbstractStepSizeController as AbstractStepSizeController,
    Checkpoint as Checkpoint,
    ConstantStepSize as ConstantStepSize,
    DenseInterpolation as DenseInterpolation,
    DirectAdjoint as DirectAdjoint,
    Event as Event,
    EventLog as EventLog,
    integrate as integrate,
    NoProgressMeter as NoProgressMeter,
    PIDController as PIDController,
    RecursiveCheckpointAdjoint as RecursiveCheckpointAdjoint,
    ReversibleAdjoint as ReversibleAdjoint,
    ReversibleController as ReversibleController,
    SaveAt as SaveAt,
    Solution as Solution,
    step as step,
    suggest_step as suggest_step,
    TextProgressMeter as TextProgressMeter,
    TqdmProgressMeter as TqdmProgressMeter,
)
from ._io import load as load, save as save
from ._manifold import (
    AbstractLieGroup as AbstractLieGroup,
    Cayley as Cayley,
    Euclidean as Euclidean,
    Exponential as Exponential,
    ProductGroup as ProductGroup,
    SE2 as SE2,
    SE3 as SE3,
    SO2 as SO2,
    SO3 as SO3,
)
from ._method import (
    Gauss as Gauss,
    LobattoIIIAB as LobattoIIIAB,
    PartitionedRungeKutta as PartitionedRungeKutta,
)
from ._models import from_sympy as from_sympy, SymPyModel as SymPyModel
from ._results import RESULTS as RESULTS
from ._step import (
    AbstractStageSolver as AbstractStageSolver,
    Newton as Newton,
    SimplifiedNewton as SimplifiedNewton,
    Solved as Solved,
    stage_residual as stage_residual,
)
from ._system import (
    continuous_multiplier as continuous_multiplier,
    HamiltonianSystem as HamiltonianSystem,
    LagrangianSystem as LagrangianSystem,
    State as State,
)
from .diagnostics import (
    convergence_order as convergence_order,
    energy_error as energy_error,
    momentum_map as momentum_map,
)
from .lanes import engines as engines, EngineUse as EngineUse


if TYPE_CHECKING:
    from . import (
        forces as forces,
        friction as friction,
        plot as plot,
        rolling as rolling,
        systems as systems,
    )
    from ._films import Looks as Looks, render as render, view as view
    from ._robots import (
        example_robot as example_robot,
        example_robot_file as example_robot_file,
        from_mujoco as from_mujoco,
        Robot as Robot,
    )

__version__ = "0.1.0"

# These names are imported at their first use, because importing them immediately would
# take a quarter of the time of `import nhjax`. Each value is the package that contains
# the name, or None if the name is a module.
_LOADED_LATER = {
    **dict.fromkeys(("forces", "friction", "plot", "rolling", "systems")),
    **dict.fromkeys(("Looks", "render", "view"), "._films"),
    **dict.fromkeys(
        ("example_robot", "example_robot_file", "from_mujoco", "Robot"), "._robots"
    ),
}


def __getattr__(name: str) -> Any:
    if name not in _LOADED_LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    room = _LOADED_LATER[name]
    if room is None:
        return import_module(f".{name}", __name__)
    # The name is now a global, so that the next access does not call this function.
    value = globals()[name] = getattr(import_module(room, __name__), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LOADED_LATER})
