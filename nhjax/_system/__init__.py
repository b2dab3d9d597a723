"""Lagrangian and Hamiltonian systems, their states and their linearised motion."""

from ._arguments import (
    all_finite as all_finite,
    check_flag as check_flag,
    check_same_manifold as check_same_manifold,
    check_signature as check_signature,
    check_type as check_type,
    configuration as configuration,
    dtype_advice as dtype_advice,
    finite as finite,
    floating as floating,
    no_array as no_array,
    parameter as parameter,
    parameters as parameters,
    real_scalar as real_scalar,
    real_vector as real_vector,
    takes_multipliers as takes_multipliers,
)
from ._checks import (
    check_functions as check_functions,
    check_multiplier as check_multiplier,
    check_state as check_state,
    dependence_error as dependence_error,
    dependent_names as dependent_names,
    describe_inconsistency as describe_inconsistency,
    enumerated as enumerated,
    require_independent as require_independent,
    require_manifold as require_manifold,
    require_names as require_names,
)
from ._linearisation import (
    constraint_matrices as constraint_matrices,
    continuous_multiplier as continuous_multiplier,
    force_by_multiplier as force_by_multiplier,
    Linearisation as Linearisation,
    linearise as linearise,
    motion_residual as motion_residual,
    total_force as total_force,
)
from ._scales import (
    function_noise as function_noise,
    FunctionNoise as FunctionNoise,
    keeps_constraints as keeps_constraints,
    noise_near as noise_near,
    position_scale as position_scale,
    position_terms as position_terms,
    velocity_scale as velocity_scale,
    violation_scale as violation_scale,
)
from ._systems import (
    AbstractMechanicalSystem as AbstractMechanicalSystem,
    AbstractOfSystem as AbstractOfSystem,
    as_given as as_given,
    check_time_and_state as check_time_and_state,
    HamiltonianSystem as HamiltonianSystem,
    LagrangianSystem as LagrangianSystem,
    State as State,
    static_function as static_function,
    value_and_rate as value_and_rate,
    with_frames as with_frames,
    with_kept_functions as with_kept_functions,
)
