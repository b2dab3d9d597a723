"""The unknowns of one step, and its equations once they have been evaluated."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float, PyTree


class StageUnknowns(eqx.Module):
    """The unknowns of one step: stage velocities, node coordinates and multipliers.

    Unknowns that a system or a closure does not have are arrays without entries.

    - `velocity`: H^1..H^s, the stage velocities in the chart (V^i on R^n).
    - `momentum`: the stage momenta in the body frame, of a Hamiltonian system; those of
        a Lagrangian one follow from the velocities.
    - `node_fibre_coordinate`: u^2..u^s (v or p) at the nodes, the last of them at the
        end of the step; without nonholonomic constraints only u_{k+1}.
    - `closure`: y, which gives the nonholonomic multipliers
        Λ = (start) λ_k + (end) λ_{k+1} + E y.
    - `holonomic`: the holonomic multipliers Λ^1..Λ^s.
    - `end_acceleration`, `end_multiplier`: u̇ and λ_c at the end of the step, unknowns
        of the symmetric closure alone.
    - `impulse`: ε, the impulses at the ends of the step along ∂I/∂v of the invariants
        I that the run keeps; None if it keeps none.
    """

    velocity: Float[Array, "s n"]
    momentum: Float[Array, "s p"]
    node_fibre_coordinate: Float[Array, "r n"]
    closure: Float[Array, "c m"]
    holonomic: Float[Array, "s k"]
    end_acceleration: Float[Array, " a"]
    end_multiplier: Float[Array, " e"]
    # None, the empty tree, if no invariants are kept.
    impulse: PyTree[Float[Array, " i"]] = None


class StageForces(NamedTuple):
    """The forces, multipliers and momenta at the stages i = 1..s, with residuals."""

    force: Float[Array, "s n"]  # n^i, the force W^i carried to the origin of the chart
    multiplier: Float[Array, "s l"]  # Λ^i
    residual: Float[Array, "s n"]  # Π^i - base - h Σ â_ij F^j
    momentum: Float[Array, "s n"]  # Π^i, by whose size residuals are judged
