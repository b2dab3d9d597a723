"""High-order geometric integrators for nonholonomic mechanical systems, in JAX."""

from . import plot as plot, systems as systems
from ._adjoint import (
    AbstractAdjoint as AbstractAdjoint,
    DirectAdjoint as DirectAdjoint,
    RecursiveCheckpointAdjoint as RecursiveCheckpointAdjoint,
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
from ._initial_state import initial_state as initial_state
from ._integrate import integrate as integrate
from ._interpolation import DenseInterpolation as DenseInterpolation
from ._manifold import (
    AbstractLieGroup as AbstractLieGroup,
    AbstractRetraction as AbstractRetraction,
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
    AbstractMethod as AbstractMethod,
    Gauss as Gauss,
    LobattoIIIAB as LobattoIIIAB,
    PartitionedRungeKutta as PartitionedRungeKutta,
)
from ._newton import (
    AbstractStageSolver as AbstractStageSolver,
    Newton as Newton,
    SimplifiedNewton as SimplifiedNewton,
)
from ._progress_meter import (
    AbstractProgressMeter as AbstractProgressMeter,
    NoProgressMeter as NoProgressMeter,
    TextProgressMeter as TextProgressMeter,
    TqdmProgressMeter as TqdmProgressMeter,
)
from ._reversible import ReversibleAdjoint as ReversibleAdjoint
from ._saveat import SaveAt as SaveAt
from ._solution import RESULTS as RESULTS, Solution as Solution
from ._state import State as State
from ._system import (
    AbstractMechanicalSystem as AbstractMechanicalSystem,
    HamiltonianSystem as HamiltonianSystem,
    LagrangianSystem as LagrangianSystem,
)
from .diagnostics import (
    convergence_order as convergence_order,
    energy_error as energy_error,
    momentum_map as momentum_map,
)


__version__ = "0.1.0"
