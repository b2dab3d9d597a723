"""The equations of motion, linearised at a state, and the continuous multiplier λ_c.

`linearise` computes the matrices of the equations of motion and solves them for the
acceleration and the multiplier. `constraint_matrices` computes the same matrices
without the solution, and `motion_residual` evaluates the equations themselves.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._custom_types import Args, FloatScalar, FloatScalarLike
from .._numerics import (
    DenseMatrix,
    DiagonalMatrix,
    full_jacobian,
    inverse,
    InverseMatrix,
    jacobian_by_rows,
    jacobian_sparsity,
    JacobianMatrix,
    least_norm_inverse,
    least_norm_inverse_by_blocks,
    max_norm,
    nan_unless,
    ReactionMatrix,
    root,
    small_einsum,
    sparse_jacobian,
    SparsityPattern,
    square_jacobian,
    SquareMatrix,
)
from ._systems import AbstractMechanicalSystem, check_time_and_state, State


# With fewer constraints than this, sparse matrices save little. With four constraints
# in a chain, sparse matrices reduce the time of a step to a third.
_FEWEST_SPARSE = 4
# Matrices are stored sparse only if each block of C, with `SparsityPattern.group`
# rows, has at most this fraction of all rows.
_LARGEST_BLOCK = 1 / 4


class Linearisation(eqx.Module):
    """The equations of motion, linearised at one state (t, q, u), and their solution.

    u is the fibre coordinate of the system, v or p. The free force is the force without
    the reactions of the constraints. With N = ∂p/∂u, the Jacobian B = ∂Φ/∂u of the
    constraints on velocities, and their reactions R λ, the motion satisfies

    N u̇ - R λ = ad*_v p + free force - ∂t p - D1p v,    B u̇ = -∂t Φ - D1Φ v.

    These equations determine C λ, and therefore the multiplier λ. Here C = B N⁻¹ R is
    the Delassus matrix, which the paper calls the compatibility matrix C^{ab} (section
    3). For a Lagrangian system N is the mass matrix M = D2D2L, R = Bᵀ, and u̇ is the
    acceleration. For a Hamiltonian system N = 1 and R = (D2D2H)⁻¹ Bᵀ. In both cases
    N⁻¹ R = K⁻¹ Bᵀ with the fibre Hessian K = D2D2L or D2D2H. If the force depends on
    the multipliers, R includes ∂F/∂λ.

    The Jacobian of the stage equations contains the same matrices. Inverses are
    computed once, and later computations multiply by them: the matrices are tiny, and a
    triangular solve inside an iteration costs far more than a product. The matrices of
    many constraints are sparse if each constraint shares coordinates with few others.
    """

    fibre_hessian_inverse: SquareMatrix  # K⁻¹
    jacobian: JacobianMatrix  # B
    reaction: ReactionMatrix  # N⁻¹ R
    delassus_inverse: InverseMatrix  # C⁻¹, or its least-norm substitute
    acceleration: Float[Array, " n"]  # u̇
    multiplier: Float[Array, " l"]
    violation: Float[Array, " l"]
    fibre_coordinate_name: Literal["v", "p"] = eqx.field(static=True)
    is_redundant: bool = eqx.field(static=True)

    @property
    def momentum_inverse(self) -> SquareMatrix:
        """Return N⁻¹: inverse mass matrix or, for Hamiltonian systems, the identity."""
        if self.fibre_coordinate_name == "v":
            return self.fibre_hessian_inverse
        return DiagonalMatrix(jnp.ones_like(self.acceleration))

    @property
    def is_sparse(self) -> bool:
        """Return whether sparse matrices are stored for the constraints."""
        return self.jacobian.pattern is not None

    @property
    def dense(self) -> tuple[Array, Array, Array]:
        """Return B, N⁻¹ R and C⁻¹ as arrays with all entries."""
        matrices = self.jacobian, self.reaction, self.delassus_inverse
        jacobian, reaction, inverse = (matrix.as_matrix() for matrix in matrices)
        return jacobian, reaction, inverse

    @property
    def is_singular(self) -> Bool[Array, ""]:
        """Return whether the fibre Hessian K or the Delassus matrix C is singular."""
        inverses = jax.tree.leaves((self.fibre_hessian_inverse, self.delassus_inverse))
        return ~reduce(jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in inverses])

    @property
    def is_unique(self) -> Bool[Array, " l"]:
        """Return which multipliers are unique: all if no constraints are redundant."""
        if not self.is_redundant:
            return jnp.ones(self.violation.shape, bool)
        # C times its least-norm inverse projects onto the range of C. A multiplier is
        # unique if its diagonal entry in this product is one.
        jacobian, reaction, _ = self.dense
        delassus = small_einsum("kn,nl->kl", jacobian, reaction)
        kept = small_einsum("kl,lm->km", delassus, least_norm_inverse(delassus))
        small = float(jnp.finfo(kept.dtype).eps) ** 0.5
        return jnp.abs(1 - jnp.diagonal(kept)) <= small

    @property
    def num_redundant(self) -> Int[Array, ""]:
        """Return the number of redundant constraints, 0 if none are allowed."""
        if not self.is_redundant:
            return jnp.zeros((), jnp.int32)
        jacobian, reaction, inverse = self.dense
        delassus = small_einsum("kn,nl->kl", jacobian, reaction)
        rank = jnp.sum(delassus * inverse.T)
        return delassus.shape[0] - jnp.round(rank).astype(jnp.int32)

    @property
    def determines_multipliers(self) -> Bool[Array, ""]:
        """Return whether C can be inverted in the working precision."""
        factors = self.jacobian, self.reaction
        return ~self.delassus_inverse.is_nearly_singular(*factors)

    def solve(
        self, momentum_residual: Float[Array, " n"], hidden_residual: Float[Array, " l"]
    ) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
        """Solve N u̇ - R λ = momentum_residual, B u̇ = hidden_residual for (u̇, λ)."""
        free = self.momentum_inverse.matvec(momentum_residual)
        hidden = hidden_residual - self.jacobian.matvec(free)
        multiplier = self.delassus_inverse.matvec(hidden)
        return free + self.reaction.matvec(multiplier), multiplier

    def largest_correction(self, sizes: Float[Array, " l"]) -> FloatScalar:
        """Bound the change of u that corrects constraint violations of given sizes."""
        multipliers = self.delassus_inverse.absolute().matvec(sizes)
        return max_norm(self.reaction.absolute().matvec(multipliers))


def _momentum_and_constraint(
    system: AbstractMechanicalSystem, q: PyTree[Array], args: Args
) -> Callable[..., tuple[Array, Array]]:
    """Return the function (t, ξ, u) -> (p, Φ) on the chart ξ -> q τ(ξ) around q.

    The equations of motion follow from its derivatives.
    """
    manifold = system.manifold_of(q)

    def pair(t, xi, u):
        g = manifold.act(q, xi)
        return system.momentum(t, g, u, args), system.constraint(t, g, u, args)

    return pair


def _inertial_force(system, q, p: Array, v: Array) -> Array:
    """Compute ad*_v p, the part of ṗ that comes from the motion of the body frame."""
    manifold = system.manifold_of(q)
    return jnp.zeros_like(p) if manifold.is_flat else manifold.ad_dual(v, p)


def total_force(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    multiplier: Float[Array, " l"],
    args: Args,
) -> Float[Array, " n"]:
    """Compute the total force W: the free force plus the reaction of constraints."""
    free = system.free_force(t, q, u, multiplier, args)
    return free + system.reaction(t, q, u, multiplier, args)


def motion_residual(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    acceleration: Float[Array, " n"],
    multiplier: Float[Array, " l"],
    args: Args,
) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
    """Compute the residuals of the equations of motion and of the hidden constraint.

    The residuals are ṗ - ad*_v p - W, with the total force W, and dΦ/dt, at the rates
    (q̇, u̇) = (q v, a), where a is the given `acceleration`. They vanish if the
    multiplier is the continuous multiplier λ_c(q, u) and a is the acceleration of the
    motion.
    """
    v = system.velocity(t, q, u, args)
    (p, _), (p_dot, phi_dot) = jax.jvp(
        _momentum_and_constraint(system, q, args),
        (t, jnp.zeros_like(u), u),
        (jnp.ones_like(t), v, acceleration),
    )
    w = total_force(system, t, q, u, multiplier, args)
    return p_dot - (w + _inertial_force(system, q, p, v)), phi_dot


class ConstraintMatrices(NamedTuple):
    """The matrices of `Linearisation`, without the solution of the equations."""

    fibre_hessian_inverse: SquareMatrix  # K⁻¹
    jacobian: JacobianMatrix  # B
    reaction: ReactionMatrix  # K⁻¹ Bᵀ
    delassus_inverse: InverseMatrix  # C⁻¹

    def tangent_part(
        self, slope: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
        """Project s = ∂I/∂u of an invariant I onto directions that constraints allow.

        Return s - Bᵀ μ, which satisfies B K⁻¹ (s - Bᵀ μ) = 0, and the multipliers
        μ = C⁻¹ B K⁻¹ s.
        """
        pushed = self.jacobian.matvec(self.fibre_hessian_inverse.matvec(slope))
        multiplier = self.delassus_inverse.matvec(pushed)
        return slope - self.jacobian.rmatvec(multiplier), multiplier


def constraint_matrices(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
    num_constraints: int,
    *,
    may_be_sparse: bool = False,
) -> ConstraintMatrices:
    """Compute K⁻¹, B, K⁻¹ Bᵀ and C⁻¹ (see `Linearisation`) at (t, q, u).

    With `may_be_sparse` the matrices of many constraints are sparse where this is
    faster.
    """
    metric = square_jacobian(lambda u: system.fibre_derivative(t, q, u, args), u)
    fibre_hessian_inverse = metric.inverse()
    pattern = None
    if may_be_sparse and num_constraints >= _FEWEST_SPARSE and metric.is_diagonal:
        pattern = _constraint_pattern(system, t, q, u, args)
    if pattern is None:
        slopes = DenseMatrix(
            jacobian_by_rows(lambda u: system.constraint(t, q, u, args), u)
        )
    else:
        slopes = sparse_jacobian(lambda u: system.constraint(t, q, u, args), u, pattern)
    reaction = slopes.weighted_transpose(fibre_hessian_inverse)
    if system.constraints == "redundant":
        k = jax.eval_shape(lambda: system.position_constraint(t, q, args)).size
        delassus = small_einsum("kn,nl->kl", slopes.as_matrix(), reaction.as_matrix())
        delassus_inverse = DenseMatrix(
            least_norm_inverse_by_blocks(delassus, num_constraints - k)
        )
    else:
        delassus_inverse = slopes.inverse_of_product(reaction)
    return ConstraintMatrices(fibre_hessian_inverse, slopes, reaction, delassus_inverse)


def linearise(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
    *,
    may_be_sparse: bool = False,
) -> Linearisation:
    """Linearise the equations of motion at (t, q, u), and solve them for u̇ and λ_c.

    With `may_be_sparse` the matrices of many constraints are sparse where this is
    faster.
    """
    zero, v = jnp.zeros_like(u), system.velocity(t, q, u, args)
    (p, violation), (p_dot, phi_dot) = jax.jvp(
        _momentum_and_constraint(system, q, args),
        (t, zero, u),
        (jnp.ones_like(t), v, zero),
    )
    given = system, t, q, u, args, violation.shape[0]
    matrices = constraint_matrices(*given, may_be_sparse=may_be_sparse)
    lin = Linearisation(
        *matrices,
        acceleration=zero,
        multiplier=jnp.zeros_like(violation),
        violation=violation,
        fibre_coordinate_name=system.fibre_coordinate_name,
        is_redundant=system.constraints == "redundant",
    )
    inertial = _inertial_force(system, q, p, v)
    if system.force_takes_multipliers and violation.shape[0] > 0:
        known = system.conservative_force(t, q, u, args) + inertial - p_dot
        return _with_force_of_multipliers(system, t, q, u, args, lin, known, -phi_dot)
    known = system.free_force(t, q, u, lin.multiplier, args) + inertial
    acceleration, multiplier = lin.solve(known - p_dot, -phi_dot)
    return eqx.tree_at(
        lambda x: (x.acceleration, x.multiplier), lin, (acceleration, multiplier)
    )


def force_by_multiplier(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    multiplier: Float[Array, " l"],
    args: Args,
) -> Float[Array, "n l"]:
    """Compute ∂F/∂λ of a force F(t, q, v, multipliers, args)."""
    return full_jacobian(
        lambda multiplier: system.external_force(t, q, u, multiplier, args), multiplier
    )


def _with_force_of_multipliers(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
    lin: Linearisation,
    known: Float[Array, " n"],
    hidden: Float[Array, " l"],
) -> Linearisation:
    """Solve N u̇ - R λ - F(λ) = known, B u̇ = hidden; linearise F at the solution.

    The multiplier is NaN if Newton's method does not find one. The matrices N⁻¹ R and C
    of the result include ∂F/∂λ.
    """

    def free(multiplier, part=1.0):
        force = system.external_force(t, q, u, multiplier, args)
        force = known + jnp.asarray(part, force.dtype) * force
        return lin.momentum_inverse.matvec(force)

    def along_path(part, multiplier):
        # The product with C⁻¹ gives all rows the units of their multipliers.
        acceleration = free(multiplier, part) + lin.reaction.matvec(multiplier)
        rate = lin.jacobian.matvec(acceleration) - hidden
        return lin.delassus_inverse.matvec(rate)

    def solve(jacobian, b):
        return small_einsum("kl,l->k", inverse(jacobian), b)

    # Newton's method may cycle if friction depends on |λ|. In that case `root` follows
    # the multiplier along a path on which the force grows from zero to its full value.
    without = lin.momentum_inverse.matvec(known)
    start = lin.delassus_inverse.matvec(hidden - lin.jacobian.matvec(without))
    residual = partial(along_path, 1.0)
    scale = max_norm(start) + max_norm(residual(start))
    found = root(residual, start, scale, solve=solve, path=along_path)
    multiplier = nan_unless(found.converged, found.x)
    slopes = force_by_multiplier(system, t, q, u, multiplier, args)
    reaction = lin.reaction.as_matrix() + lin.momentum_inverse.matvec(slopes.T).T
    delassus = small_einsum("kn,nl->kl", lin.jacobian.as_matrix(), reaction)
    return replace(
        lin,
        reaction=DenseMatrix(reaction),
        delassus_inverse=DenseMatrix(inverse(delassus)),
        acceleration=free(multiplier) + lin.reaction.matvec(multiplier),
        multiplier=multiplier,
    )


def continuous_multiplier(
    system: AbstractMechanicalSystem, t: FloatScalarLike, y: State, args: Args = None
) -> Float[Array, " l"]:
    """Compute the multiplier λ_c of the continuous equations of motion at a state.

    The multiplier follows from the hidden constraint dΦ/dt = 0, and for holonomic
    constraints, whose rows come last, from d²Γ/dt² = 0 (the paper's section 3). Along a
    trajectory of a Lobatto method with s stages, this multiplier has order 2s-2, while
    the multiplier that the paper propagates has order s or s-1.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time of the state.
    - `y`: a state, such as one of `Solution.ys`.
    - `args`: passed on to the functions of the system.

    **Returns:** an array of shape (m + k,) for m nonholonomic and k holonomic
    constraints, in units of force divided by the units of D2Φ.

    **Raises:** `TypeError` if `y` is not a `State`.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> nhjax.continuous_multiplier(disc.system, 0.0, disc.initial_state()).shape
        (2,)
    """
    check_time_and_state("continuous_multiplier", t, y, "system, ")
    t = jnp.asarray(t, y.p.dtype)
    return linearise(system, t, y.q, system.fibre_coordinate(y), args).multiplier


def _constraint_pattern(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> SparsityPattern | None:
    """Find the sparsity pattern of B = ∂Φ/∂u; None if B is better stored dense.

    B is stored dense if the system allows redundant constraints, has both nonholonomic
    and holonomic constraints, or has a force that depends on the multipliers. B is also
    stored dense if constraints share coordinates with many others, because B K⁻¹ Bᵀ
    then has large blocks.
    """
    kinds = [system.nonholonomic, system.holonomic]
    if system.constraints == "redundant" or None not in kinds:
        return None
    if system.force_takes_multipliers:
        return None
    entries = jacobian_sparsity(lambda u: system.constraint(t, q, u, args), u)
    pattern = SparsityPattern(entries)
    return pattern if pattern.group <= _LARGEST_BLOCK * len(entries) else None
