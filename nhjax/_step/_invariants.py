"""Functions that a run keeps at their initial values, by impulses in each step."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalar
from .._numerics import (
    inverse,
    max_norm,
    nonzero_or_one,
    small_einsum,
    SquareMatrix,
)
from .._system import (
    AbstractMechanicalSystem,
    constraint_matrices,
    Linearisation,
    State,
)


# An impulse changes an invariant I by at most this fraction of Σ |u ∂I/∂u|, with the
# fibre coordinate u (v or p), added up over both ends of the step. Near rest, where
# there may be no impulse that corrects the error, this limit is small.
_LARGEST_PART = 0.1
# An impulse ε ω, with ω from `Directions`, changes I by ε ω·M⁻¹ω. With an indefinite
# mass matrix M, ω·M⁻¹ω can vanish although ω does not. If |ω·M⁻¹ω| is less than this
# fraction of its bound Σ_ij |M⁻¹_ij| ω_i², a step has no impulse. All other impulses
# are at most 1 / 0.03 times as large as with a definite matrix that attains the bound.
# Fractions from 0.01 to 0.3 gave the same largest errors of test motions.
LEAST_PART = 0.03


class Invariants(eqx.Module):
    """Functions I(t, q, u) of the fibre coordinate u, and the values that are kept.

    - `function`: called as `function(t, q, u, args)`, returns shape (k,). None stands
        for the energy of the system.
    - `value`: the k values that are kept.
    - `least_sizes`: the measured round-off of the functions at the start of the run,
        divided by the unit round-off. It includes the round-off of constants that
        cancel.
    - `least_part`: zero if the mass matrix is definite, otherwise `LEAST_PART`.
    """

    function: Callable[..., Array] | None
    value: Float[Array, " k"]
    least_sizes: Float[Array, " k"]
    least_part: FloatScalar

    def error(
        self,
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args,
    ) -> Float[Array, " k"]:
        """Compute the differences between the functions and the values to keep."""
        return invariant_values(self.function, system, t, q, u, args) - self.value

    def slopes(
        self,
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args,
    ) -> Float[Array, "k n"]:
        """Compute the derivatives ∂I/∂u."""
        return jax.jacrev(
            lambda u: invariant_values(self.function, system, t, q, u, args)
        )(u)

    def directions(
        self,
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args,
        slopes: Float[Array, "k n"] | None = None,
    ) -> "Directions":
        """Compute the directions of the impulses at a state.

        If a function is conserved only on the constraint set Φ = 0, its derivative
        ∂I/∂v has a part Bᵀ μ along the reactions, with B = ∂Φ/∂v. An impulse along this
        part would violate the constraints, and the reactions that restore them would
        undo its effect on I. Therefore this part is removed, so that the direction
        ω = ∂I/∂v - Bᵀ μ satisfies B M⁻¹ ω = 0. For the energy, ω = M v has no such
        part: a system that conserves its energy has B v = 0.

        `slopes` is ∂I/∂u, if it is known.
        """
        if slopes is None:
            slopes = self.slopes(system, t, q, u, args)
        multipliers = None
        if self.function is not None and _is_constrained(system):
            num_constraints = jax.eval_shape(
                lambda: system.constraint(t, q, u, args)
            ).shape[0]
            given = system, t, q, u, args, num_constraints
            matrices = constraint_matrices(*given, may_be_sparse=True)
            slopes, multipliers = jax.vmap(matrices.tangent_part)(slopes)
        covectors = slopes
        if system.fibre_coordinate_name == "p":
            covectors = jax.vmap(lambda x: system.flat(t, q, u, x, args))(slopes)
        return Directions(slopes, covectors, multipliers)

    def tangent_error(
        self,
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args,
    ) -> Float[Array, " k"]:
        """Compute the difference between I - μ·Φ and the values to keep.

        Here Φ = 0 are the constraints, and μ the `multipliers` of `directions`. Where
        the constraints hold, I - μ·Φ is equal to I, and its derivative is the `slopes`
        of `directions`. To leading order, a correction of the constraints does not
        change I - μ·Φ.
        """
        error = self.error(system, t, q, u, args)
        multipliers = self.directions(system, t, q, u, args).multipliers
        if multipliers is None:
            return error
        violation = system.constraint(t, q, u, args)
        return error - small_einsum("kl,l->k", multipliers, violation)

    def sizes(
        self,
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        q: PyTree[Array],
        u: Float[Array, " n"],
        args: Args,
        slopes: Float[Array, "k n"],
    ) -> Float[Array, " k"]:
        """Estimate the sizes of the terms of I, to which its round-off is proportional.

        Position terms are included, because the coordinates of a rolling wheel grow
        without bound.
        """
        found = jnp.abs(self.value) + moving_part(slopes, u)
        by_position = jax.jacrev(
            lambda q: invariant_values(self.function, system, t, q, u, args)
        )(q)
        for slope, x in zip(*map(jax.tree.leaves, (by_position, q)), strict=True):
            found = found + jnp.sum(
                jnp.abs(slope * x[None]), axis=tuple(range(1, slope.ndim))
            )
        return jnp.maximum(found, self.least_sizes)


def invariant_values(
    function: Callable[..., Array] | None,
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    q: PyTree[Array],
    u: Float[Array, " n"],
    args: Args,
) -> Float[Array, " k"]:
    """Evaluate the functions of `Invariants`, in shape (k,)."""
    if function is not None:
        return jnp.atleast_1d(function(t, q, u, args))
    # The energy uses only the fibre coordinate, which is either v or p.
    no_multiplier = jnp.zeros((0,), u.dtype)
    return system.energy(t, State(q, u, u, no_multiplier), args)[None]


def _is_constrained(system: AbstractMechanicalSystem) -> bool:
    return system.nonholonomic is not None or system.holonomic is not None


class Directions(NamedTuple):
    """The directions of the impulses that keep invariants, at one state.

    - `slopes`: ∂I/∂u - (∂Φ/∂u)ᵀ μ, which is ∂I/∂u without its part along the reactions.
    - `covectors`: ω, the directions: the slopes or, if u is p, the slopes mapped from
        velocities to momenta.
    - `multipliers`: μ = C⁻¹ B M⁻¹ ∂I/∂v, with B = ∂Φ/∂v and C = B M⁻¹ Bᵀ; None if μ is
        known to be zero.
    """

    slopes: Float[Array, "k n"]
    covectors: Float[Array, "k n"]
    multipliers: Float[Array, "k l"] | None


class InvariantsAtStart(eqx.Module):
    """The invariants of a step, with their derivatives and sizes at its start.

    - `functions`: the functions, and the values that are kept.
    - `slopes`, `covectors`: the fields of `Directions` at the start.
    - `momentum_inverse`: N⁻¹, which maps momenta to fibre coordinates.
    - `row_sums`: Σ_j |K⁻¹_ij| with the fibre Hessian K (D2D2L or D2D2H), the entries of
        a diagonal matrix D with |x·K⁻¹x| <= x·Dx for the slopes x.
    - `moving`: Σ |u ∂I/∂u| at the start; for the energy usually twice the kinetic
        energy.
    - `sizes`: the sizes of the terms of the invariants, to which their round-off is
        proportional.
    - `position`: q_k before its angles are reduced to one turn, and its accumulated
        rounding error. The equations of the step use them to compute the end with the
        same rounding as in the next state, so that the invariants are kept there.
    """

    functions: Invariants
    slopes: Float[Array, "k n"]
    covectors: Float[Array, "k n"]
    momentum_inverse: SquareMatrix
    row_sums: Float[Array, " n"]
    moving: Float[Array, " k"]
    sizes: Float[Array, " k"]
    position: tuple[PyTree[Array], PyTree[Array]]

    @classmethod
    def at(
        cls,
        functions: Invariants,
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        y: State,
        position: tuple[PyTree[Array], PyTree[Array]],
        args: Args,
        lin: Linearisation,
    ) -> "InvariantsAtStart":
        """Evaluate the invariants at the state y, whose linearisation is `lin`."""
        u = system.fibre_coordinate(y)
        all_slopes = functions.slopes(system, t, y.q, u, args)
        sizes = functions.sizes(system, t, y.q, u, args, all_slopes)
        slopes, covectors, _ = functions.directions(system, t, y.q, u, args, all_slopes)
        row_sums = lin.fibre_hessian_inverse.absolute_row_sums()
        given = slopes, covectors, lin.momentum_inverse, row_sums
        return cls(functions, *given, moving_part(slopes, u), sizes, position)


def moving_part(slopes: Float[Array, "k n"], u: Float[Array, " n"]) -> Array:
    """Compute the part of invariants that belongs to the motion, Σ |u ∂I/∂u|."""
    return jnp.sum(jnp.abs(slopes * u[None]), axis=1)


class InvariantCorrection(eqx.Module):
    """The linearised equations for the impulses ε of a step, near its solution.

    To leading order, a change of ε changes the invariants at the end by G δε with
    G = Σ ∂I/∂u N⁻¹ ωᵀ, where N = ∂p/∂u and ω are the directions of the impulses. The
    sum has a term for each end, because the change of an invariant by an impulse at the
    start persists until the end. In each row, the equation r = 0 for the errors r of
    the invariants is blended with ε = 0:

    a r / g + (1 - a) ε = 0,    g = G_ii,    a = x² / (x² + ϵ),    x = |g| δ / S.

    Here ϵ is the unit round-off, S is the size of the terms of I, and δ is the impulse
    that would change velocities by their own size, so that x does not depend on units.
    Unless x is small, a is 1 up to round-off. At rest no impulse can keep I; there x
    and a are zero.

    With an indefinite mass matrix, G can also be singular away from rest. In such
    steps a = 0 for all kept functions; see `LEAST_PART`.

    - `errors`: a / g, the factor of the errors.
    - `rest`: 1 - a.
    - `inverse`: the inverse of the derivative of the equations with respect to ε.
    - `limits`: the largest |ε|, computed from the absolute values of the terms of g,
        which cannot cancel.
    - `start`, `end`: N⁻¹ ω at both ends, the derivative of u with respect to ε.
    - `velocity`: M⁻¹ ω at the start, the derivative of velocities with respect to ε.
    - `noise`: the round-off of u that the round-off of the invariants causes, divided
        by the unit round-off.
    """

    errors: Float[Array, " k"]
    rest: Float[Array, " k"]
    inverse: Float[Array, "k k"]
    limits: Float[Array, " k"]
    start: Float[Array, "k n"]
    end: Float[Array, "k n"]
    velocity: Float[Array, "k n"]
    noise: FloatScalar

    @classmethod
    def at(
        cls,
        at_start: InvariantsAtStart,
        slopes: Float[Array, "k n"],
        covectors: Float[Array, "k n"],
        moving: Float[Array, " k"],
        hamiltonian: bool,
    ) -> "InvariantCorrection":
        """Build the equations from the values at the start and at the end of a step."""
        start, end = (
            at_start.momentum_inverse.matvec(x) for x in (at_start.covectors, covectors)
        )
        gram = small_einsum("kn,ln->kl", at_start.slopes, start)
        gram = gram + small_einsum("kn,ln->kl", slopes, end)
        eps = float(jnp.finfo(gram.dtype).eps)
        one = jnp.eye(gram.shape[0], dtype=gram.dtype)
        g = jnp.sum(gram * one, axis=1)
        terms = jnp.abs(at_start.slopes * start) + jnp.abs(slopes * end)
        unit = (at_start.moving + moving) / nonzero_or_one(jnp.sum(terms, 1))
        x = jnp.abs(g) * unit / nonzero_or_one(at_start.sizes)
        a = x**2 / (x**2 + eps)
        errors = a / nonzero_or_one(g)
        matrix = errors[:, None] * gram + (1 - a)[:, None] * one
        # If one function follows from others, the matrix is singular without the added
        # term.
        solved = inverse(matrix + eps**0.5 * one)
        # The gain is the ratio of the impulses to the impulses that a definite matrix,
        # the diagonal matrix of the row sums, would give for the same errors. With one
        # function it is Σ (row sum) (slope)² / |g|.
        squares = at_start.slopes**2 + slopes**2
        roots = jnp.sqrt(jnp.sum(at_start.row_sums[None] * squares, axis=1))
        gain = roots[:, None] * solved * (errors * roots)[None]
        acts = ~(at_start.functions.least_part * max_norm(gain) > 1)
        pushes = jnp.abs(jnp.concatenate([start, end], axis=1))
        return cls(
            errors=jnp.where(acts, errors, 0),
            rest=jnp.where(acts, 1 - a, 1),
            inverse=jnp.where(acts, solved, one),
            limits=_LARGEST_PART * unit,
            start=start,
            end=end,
            velocity=at_start.slopes if hamiltonian else start,
            noise=max_norm(at_start.sizes * errors * jnp.max(pushes, axis=1)),
        )

    def change(
        self, impulse: Float[Array, " k"], error: Float[Array, " k"]
    ) -> Float[Array, " k"]:
        """Compute the change of ε that solves the linearised equations.

        The changed ε is clipped to `limits`.
        """
        residual = self.errors * error + self.rest * impulse
        wanted = impulse - small_einsum("kl,l->k", self.inverse, residual)
        return jnp.clip(wanted, -self.limits, self.limits) - impulse
