"""The numerical building blocks without mechanics: products, norms, iterations."""

from ._contraction import (
    small_einsum as small_einsum,
    with_small_products as with_small_products,
)
from ._floating_point import (
    largest_column as largest_column,
    max_norm as max_norm,
    measured_noise as measured_noise,
    NOISE_DEVIATIONS as NOISE_DEVIATIONS,
    nonzero_or_one as nonzero_or_one,
    relative as relative,
    two_sum as two_sum,
    uneven_perturbations as uneven_perturbations,
)
from ._implicit import (
    AbstractImplicitFunction as AbstractImplicitFunction,
    ClosureConverted as ClosureConverted,
    fixed_point_tangent as fixed_point_tangent,
    has_tangent as has_tangent,
    nan_gradient_unless as nan_gradient_unless,
    nan_tangent_unless as nan_tangent_unless,
    nan_unless as nan_unless,
    root as root,
    stop_gradient as stop_gradient,
    tree_where as tree_where,
    with_zero_tangents as with_zero_tangents,
    zero_unless as zero_unless,
)
from ._inverse import (
    inverse as inverse,
    inverse_by_blocks as inverse_by_blocks,
    inverses as inverses,
    mapped as mapped,
    repeated as repeated,
    solve_by_rows as solve_by_rows,
)
from ._iteration import (
    iterate as iterate,
    jacobian_and_value as jacobian_and_value,
    NOISE_UNITS as NOISE_UNITS,
    Solved as Solved,
    UpdateNorms as UpdateNorms,
)
from ._kept import kept_function as kept_function
from ._operators import (
    AbstractOperator as AbstractOperator,
    block_tridiagonal_inverse as block_tridiagonal_inverse,
    BlockTridiagonalInverse as BlockTridiagonalInverse,
    compressed_products as compressed_products,
    DenseMatrix as DenseMatrix,
    DiagonalMatrix as DiagonalMatrix,
    full_jacobian as full_jacobian,
    InverseMatrix as InverseMatrix,
    jacobian_by_rows as jacobian_by_rows,
    JacobianMatrix as JacobianMatrix,
    ReactionMatrix as ReactionMatrix,
    sparse_jacobian as sparse_jacobian,
    SparseMatrix as SparseMatrix,
    SparsityPattern as SparsityPattern,
    square_jacobian as square_jacobian,
    SquareMatrix as SquareMatrix,
    WeightedTranspose as WeightedTranspose,
)
from ._rank import (
    active_ranks as active_ranks,
    dependent_rows as dependent_rows,
    has_zero_row as has_zero_row,
    is_deficient as is_deficient,
    is_nearly_singular as is_nearly_singular,
    least_norm_inverse as least_norm_inverse,
    least_norm_inverse_by_blocks as least_norm_inverse_by_blocks,
    least_norm_solve as least_norm_solve,
    NEARLY_DEPENDENT as NEARLY_DEPENDENT,
    rank_of_gram as rank_of_gram,
    RankCondition as RankCondition,
    reciprocal_condition as reciprocal_condition,
    reciprocal_condition_of_range as reciprocal_condition_of_range,
)
from ._sparsity import jacobian_sparsity as jacobian_sparsity
