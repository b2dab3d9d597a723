"""The sparsity pattern of the constraints' Jacobian, where it is worth using."""

from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalar
from .._numerics import jacobian_sparsity, SparsityPattern
from ._systems import AbstractMechanicalSystem


# With fewer constraints than this there is little to leave out. Of four in a row a step
# takes a third of the time that it takes with dense matrices.
FEWEST_SPARSE = 4
# The largest part of all constraints that a block may hold.
_LARGEST_BLOCK = 1 / 4


def constraint_pattern(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> SparsityPattern | None:
    """Find the places of the entries of B = ∂Φ/∂u; None if B is to be dense.

    That is where constraints are redundant, or of both kinds, or each shares
    coordinates with many others, so that B K⁻¹ Bᵀ is full.
    """
    kinds = [system.nonholonomic, system.holonomic]
    if system.constraints == "redundant" or None not in kinds:
        return None
    entries = jacobian_sparsity(lambda u: system.constraint(t, q, u, args), u)
    pattern = SparsityPattern(entries)
    return pattern if pattern.group <= _LARGEST_BLOCK * len(entries) else None
