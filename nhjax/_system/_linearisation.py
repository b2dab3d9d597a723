from collections.abc import Callable
from functools import reduce
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._custom_types import Args, FloatScalar, FloatScalarLike
from .._numerics import (
    absolute,
    block_tridiagonal_inverse,
    BlockTridiagonalInverse,
    couplings,
    inverse,
    is_nearly_singular,
    jacobian,
    least_norm_inverse,
    least_norm_inverse_by_blocks,
    Matrix,
    matvec,
    max_norm,
    small_einsum,
    sparse_jacobian,
    SparseMatrix,
    WeightedTranspose,
)
from ._structure import constraint_pattern, FEWEST_SPARSE
from ._systems import AbstractMechanicalSystem, check_time_and_state, State


class Linearisation(eqx.Module):
    """The equations of motion, linearised at one state (t, q, u), and their solution.

    u is the fibre coordinate of the system, v or p. With N = ∂p/∂u, B = ∂Φ/∂u of the
    constraints on velocities, and R = ♭ Bᵀ their reactions, the motion satisfies

    N u̇ - R λ = ad*_v p + free force - ∂t p - D1p v,    B u̇ = -∂t Φ - D1Φ v,

    which determines C λ with C = B N⁻¹ R, the paper's compatibility matrix C^{ab}
    (section 3), and so the multiplier λ. For a Lagrangian system N is the mass matrix
    M = D2D2L, R = Bᵀ, and u̇ is the acceleration; for a Hamiltonian one N = 1 and
    R = (D2D2H)⁻¹ Bᵀ. In both cases N⁻¹ R = K⁻¹ Bᵀ with K the metric on the fibre.

    The same matrices are the leading structure of the stage system. Inverses are formed
    once, and later computations multiply with them: the matrices are tiny, and a
    triangular solve inside an iteration costs far more than a product. Those of many
    constraints, each of which shares coordinates with few others, are kept sparse.
    """

    metric_inverse: Matrix  # K⁻¹
    jacobian: Float[Array, "l n"] | SparseMatrix  # B
    reaction: Float[Array, "n l"] | WeightedTranspose  # N⁻¹ R
    # C⁻¹, or of the least norm
    compliance_inverse: Float[Array, "l l"] | BlockTridiagonalInverse
    acceleration: Float[Array, " n"]  # u̇
    multiplier: Float[Array, " l"]
    violation: Float[Array, " l"]
    fibre_coordinate_name: Literal["v", "p"] = eqx.field(static=True)
    is_redundant: bool = eqx.field(static=True)

    @property
    def momentum_inverse(self) -> Matrix:
        """Return N⁻¹, the inverse mass matrix or, for a Hamiltonian system, identity.

        A vector stands for the diagonal matrix with these entries.
        """
        if self.fibre_coordinate_name == "v":
            return self.metric_inverse
        return jnp.ones_like(self.acceleration)

    @property
    def dense(self) -> tuple[Array, Array, Array]:
        """Return B, N⁻¹ R and C⁻¹ as arrays, of a linearisation that is not sparse."""
        assert not isinstance(self.jacobian, SparseMatrix)
        assert not isinstance(self.reaction, WeightedTranspose)
        assert not isinstance(self.compliance_inverse, BlockTridiagonalInverse)
        return self.jacobian, self.reaction, self.compliance_inverse

    @property
    def is_singular(self) -> Bool[Array, ""]:
        """Tell whether the metric K or the compatibility matrix C is singular."""
        inverses = [self.metric_inverse, *jax.tree.leaves(self.compliance_inverse)]
        return ~reduce(jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in inverses])

    @property
    def is_unique(self) -> Bool[Array, " l"]:
        """Tell which multipliers are unique; of redundant constraints not all are."""
        if not self.is_redundant:
            return jnp.ones(self.violation.shape, bool)
        # It projects onto what the derivatives of the constraints can reach.
        jacobian, reaction, _ = self.dense
        compliance = small_einsum("kn,nl->kl", jacobian, reaction)
        kept = small_einsum("kl,lm->km", compliance, least_norm_inverse(compliance))
        small = float(jnp.finfo(kept.dtype).eps) ** 0.5
        return jnp.abs(1 - jnp.diagonal(kept)) <= small

    @property
    def num_redundant(self) -> Int[Array, ""]:
        """Count the constraints that follow from others, if these are redundant."""
        if not self.is_redundant:
            return jnp.zeros((), jnp.int32)
        jacobian, reaction, inverse = self.dense
        compliance = small_einsum("kn,nl->kl", jacobian, reaction)
        rank = jnp.sum(compliance * inverse.T)
        return compliance.shape[0] - jnp.round(rank).astype(jnp.int32)

    @property
    def determines_multipliers(self) -> Bool[Array, ""]:
        """Tell whether C can be inverted in the working precision."""
        if isinstance(self.jacobian, SparseMatrix):
            assert isinstance(self.compliance_inverse, BlockTridiagonalInverse)
            squares = SparseMatrix(self.jacobian.values**2, self.jacobian.pattern)
            sizes = jnp.abs(matvec(squares, self.metric_inverse))
            eps = float(jnp.finfo(sizes.dtype).eps)
            number = 1 / (10 * sizes.shape[0] * eps)
            return ~self.compliance_inverse.exceeds(sizes, number)
        jacobian, reaction, inverse = self.dense
        compliance = small_einsum("kn,nl->kl", jacobian, reaction)
        return ~is_nearly_singular(compliance, inverse)

    def solve(
        self, momentum_residual: Float[Array, " n"], hidden_residual: Float[Array, " l"]
    ) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
        """Find (u̇, λ) with N u̇ - R λ and B u̇ equal to the two given residuals."""
        free = matvec(self.momentum_inverse, momentum_residual)
        hidden = hidden_residual - matvec(self.jacobian, free)
        multiplier = matvec(self.compliance_inverse, hidden)
        return free + matvec(self.reaction, multiplier), multiplier

    def largest_correction(self, sizes: Float[Array, " l"]) -> FloatScalar:
        """Bound the change of u that makes up for violations of the given sizes."""
        multipliers = matvec(absolute(self.compliance_inverse), sizes)
        return max_norm(matvec(absolute(self.reaction), multipliers))


def _momentum_and_constraint(
    system: AbstractMechanicalSystem, q: PyTree[Array], args: Args
) -> Callable[..., tuple[Array, Array]]:
    """Make the function (t, ξ, u) -> (p, Φ) on the chart ξ -> q τ(ξ) around q.

    The equations of motion follow from its derivatives.
    """
    manifold = system.manifold_of(q)

    def pair(t, xi, u):
        g = manifold.act(q, xi)
        return system.momentum(t, g, u, args), system.constraint(t, g, u, args)

    return pair


def _inertial_force(system, q, p: Array, v: Array) -> Array:
    """Compute ad*_v p, the term in ṗ by which the body momentum turns."""
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
    """Compute the whole force W: the free force plus the reaction of constraints."""
    free = system.free_force(t, q, u, args)
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

    These are ṗ - ad*_v p - W and dΦ/dt along (q̇, u̇) = (q v, a), where a is the given
    `acceleration`. They vanish where the multiplier is the continuous multiplier
    λ = λ_c(q, u) and a the acceleration that belongs to it.
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
    """The matrices of `Linearisation` that need no solution of the equations."""

    metric_inverse: Matrix  # K⁻¹
    jacobian: Float[Array, "l n"] | SparseMatrix  # B
    reaction: Float[Array, "n l"] | WeightedTranspose  # K⁻¹ Bᵀ
    compliance_inverse: Float[Array, "l l"] | BlockTridiagonalInverse  # C⁻¹

    def tangent_part(
        self, slope: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
        """Split a derivative s = ∂I/∂u by u: s - Bᵀ μ with B K⁻¹ (s - Bᵀ μ) = 0.

        Return s - Bᵀ μ and the multipliers μ = C⁻¹ B K⁻¹ s.
        """
        pushed = matvec(self.jacobian, matvec(self.metric_inverse, slope))
        multiplier = matvec(self.compliance_inverse, pushed)
        if isinstance(self.jacobian, SparseMatrix):
            return slope - self.jacobian.rmatvec(multiplier), multiplier
        return slope - small_einsum("ln,l->n", self.jacobian, multiplier), multiplier


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
    """Compute the metric and the derivatives of the constraints at (t, q, u).

    With `may_be_sparse` the matrices of many constraints are sparse where that pays.
    """
    metric = jacobian(lambda u: system.fibre_derivative(t, q, u, args), u)
    metric_inverse = inverse(metric)
    pattern = None
    if may_be_sparse and num_constraints >= FEWEST_SPARSE and metric.ndim == 1:
        pattern = constraint_pattern(system, t, q, u, args)
    if pattern is None:
        slopes = jax.jacrev(system.constraint, argnums=2)(t, q, u, args)
        reaction = matvec(metric_inverse, slopes).T
        compliance = small_einsum("kn,nl->kl", slopes, reaction)
        if system.constraints == "redundant":
            k = jax.eval_shape(lambda: system.position_constraint(t, q, args)).size
            m = slopes.shape[0] - k
            compliance_inverse = least_norm_inverse_by_blocks(compliance, m)
        else:
            compliance_inverse = inverse(compliance)
    else:
        slopes = sparse_jacobian(lambda u: system.constraint(t, q, u, args), u, pattern)
        reaction = WeightedTranspose(metric_inverse, slopes)
        rows = SparseMatrix(slopes.values[None], pattern)
        products = couplings(rows, rows, metric_inverse)
        compliance_inverse = block_tridiagonal_inverse(products, pattern)
    return ConstraintMatrices(metric_inverse, slopes, reaction, compliance_inverse)


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

    With `may_be_sparse` the matrices of many constraints are sparse where that pays.
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
    known = system.free_force(t, q, u, args) + _inertial_force(system, q, p, v)
    acceleration, multiplier = lin.solve(known - p_dot, -phi_dot)
    return eqx.tree_at(
        lambda x: (x.acceleration, x.multiplier), lin, (acceleration, multiplier)
    )


def continuous_multiplier(
    system: AbstractMechanicalSystem, t: FloatScalarLike, y: State, args: Args = None
) -> Float[Array, " l"]:
    """Compute the multiplier λ_c of the continuous equations of motion at a state.

    It follows from the hidden constraint dΦ/dt = 0, and for the rows of holonomic
    constraints, which come last, from d²Γ/dt² = 0 (the paper's section 3). Along a
    trajectory of a Lobatto method it is of order 2s-2, while the multiplier that the
    paper propagates is of order s or s-1.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time of the state.
    - `y`: a state, such as one of `Solution.ys`.
    - `args`: passed on to the functions of the system.

    **Returns:** an array of shape (m + k,) for m nonholonomic and k holonomic
    constraints, in units of force over those of D2Φ.

    **Raises:** `TypeError` if `y` is no `State`.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> nhjax.continuous_multiplier(disc.system, 0.0, disc.initial_state()).shape
        (2,)
    """
    check_time_and_state("continuous_multiplier", t, y, "system, ")
    t = jnp.asarray(t, y.p.dtype)
    return linearise(system, t, y.q, system.fibre_coordinate(y), args).multiplier
