"""Functions that a run keeps at their values, and the impulses that keep them."""

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
    small_einsum,
    SquareMatrix,
    unit,
)
from .._system import (
    AbstractMechanicalSystem,
    constraint_matrices,
    Linearisation,
    State,
)


# Impulses change the part of an invariant that belongs to the motion by no more than
# this: where hardly any is left, no impulse might make up for the error.
_LARGEST_PART = 0.1
# With an indefinite mass matrix, ω·M⁻¹ω can vanish where ω does not. A step has no
# impulse where ω·M⁻¹ω is less than this part of its bound Σ_ij |M⁻¹_ij| ω_i². Other
# impulses are at most 1 / 0.03 times as large as with a definite matrix of this size.
# With parts from 0.01 to 0.3 the largest errors of motions were the same (measured).
LEAST_PART = 0.03


class Invariants(eqx.Module):
    """Functions I(t, q, u) of the fibre coordinate u, and the values they are kept at.

    - `function`: called as `function(t, q, u, args)`, of shape (k,); None stands for
        the energy of the system.
    - `value`: the k values.
    - `least_sizes`: the measured round-off of the functions at the start of the run, in
        units of the unit round-off; it includes constants that cancel.
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
        """Compute by how much the functions differ from their values."""
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
        """Compute the directions of the impulses at a state, from ∂I/∂u if it is known.

        The ∂I/∂v of a function that is conserved on the constraint set alone has a part
        Bᵀ μ along reactions. An impulse along it would violate the constraints, and the
        reactions that make up for this would take back what it adds to I. Without that
        part, B M⁻¹ ω = 0. The ω of the energy, M v, is free of it: where a system
        conserves its energy, B v = 0.
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
        """Compute by how much I - μ·Φ differs from the values of I.

        It is I where the constraints hold, and its derivative there is that of
        `directions`: to leading order, what the constraints still change does not
        change it.
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

        That of positions counts: those of a wheel that rolls on and on grow for ever.
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
    # The energy reads the fibre coordinate alone, whichever of the two it is.
    nothing = jnp.zeros((0,), u.dtype)
    return system.energy(t, State(q, u, u, nothing), args)[None]


def _is_constrained(system: AbstractMechanicalSystem) -> bool:
    return system.nonholonomic is not None or system.holonomic is not None


class Directions(NamedTuple):
    """The directions of the impulses that keep invariants, at one state.

    - `slopes`: ∂I/∂u - Bᵀ μ, the part of ∂I/∂u that reactions do not change.
    - `covectors`: ω, the same as covectors: impulses are along them.
    - `multipliers`: μ = C⁻¹ B M⁻¹ ∂I/∂v; None where μ = 0 is known.
    """

    slopes: Float[Array, "k n"]
    covectors: Float[Array, "k n"]
    multipliers: Float[Array, "k l"] | None


class StartImpulses(eqx.Module):
    """The invariants of a step, with what is known of them at its start.

    - `slopes`, `covectors`: ∂I/∂u and ω = ∂I/∂v there.
    - `momentum_inverse`: N⁻¹, which turns momenta into fibre coordinates.
    - `row_sums`: Σ_j |K⁻¹_ij|, the diagonal matrix D with |ω·K⁻¹ω| <= ω·Dω.
    - `moving`: Σ |u ∂I/∂u| there, of the energy twice the kinetic one as a rule.
    - `sizes`: the sizes of the terms of the invariants, whose round-off is theirs.
    - `position`: q_k before it was wrapped and the rounding error that it has
        accumulated, so that the invariants are kept at the position to which the step
        will round its end.
    """

    invariants: Invariants
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
        invariants: Invariants,
        system: AbstractMechanicalSystem,
        t: FloatScalar,
        y: State,
        position: tuple[PyTree[Array], PyTree[Array]],
        args: Args,
        lin: Linearisation,
    ) -> "StartImpulses":
        """Make the start impulses at the state y, whose linearisation is `lin`."""
        u = system.fibre_coordinate(y)
        all_slopes = invariants.slopes(system, t, y.q, u, args)
        sizes = invariants.sizes(system, t, y.q, u, args, all_slopes)
        slopes, covectors, _ = invariants.directions(
            system, t, y.q, u, args, all_slopes
        )
        row_sums = lin.metric_inverse.absolute_row_sums()
        given = slopes, covectors, lin.momentum_inverse, row_sums
        return cls(invariants, *given, moving_part(slopes, u), sizes, position)


def moving_part(slopes: Float[Array, "k n"], u: Float[Array, " n"]) -> Array:
    """Measure the part of invariants that belongs to the motion, Σ |u ∂I/∂u|."""
    return jnp.sum(jnp.abs(slopes * u[None]), axis=1)


class InvariantCorrection(eqx.Module):
    """The linearised equations for the impulses ε of a step, near its solution.

    To leading order a change of ε changes the invariants at the end by G δε with
    G = Σ ∂I/∂u N⁻¹ ωᵀ, the sum being over both ends: what an impulse at the start adds
    to an invariant is still there at the end. Row by row the equation r = 0 for the
    errors r of the invariants is blended with ε = 0,

    a r / g + (1 - a) ε = 0,    g = G_ii,    a = g² / (g² + ϵ S²),

    with ϵ the unit round-off and S the size of the terms of I. Where g is not small, a
    is 1 up to round-off; at rest g vanishes, so that no impulse could keep I.

    With an indefinite mass matrix G can be singular away from rest too. There, a = 0
    for all functions; see `LEAST_PART`.

    - `errors`: a / g, by which errors are multiplied.
    - `rest`: 1 - a.
    - `inverse`: the inverse of the derivative of the equations by ε.
    - `limits`: the largest |ε|, by the sum of the |terms| of g, which do not cancel.
    - `start`, `end`: N⁻¹ ω at both ends, by which u changes with ε.
    - `velocity`: M⁻¹ ω at the start, by which velocities do.
    - `noise`: the round-off of u for that of the invariants.
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
        given: StartImpulses,
        slopes: Float[Array, "k n"],
        covectors: Float[Array, "k n"],
        moving: Float[Array, " k"],
        hamiltonian: bool,
    ) -> "InvariantCorrection":
        """Make the weights from what is given at the start and known at the end."""
        start, end = (
            given.momentum_inverse.matvec(x) for x in (given.covectors, covectors)
        )
        gram = small_einsum("kn,ln->kl", given.slopes, start)
        gram = gram + small_einsum("kn,ln->kl", slopes, end)
        eps = float(jnp.finfo(gram.dtype).eps)
        one = jnp.eye(gram.shape[0], dtype=gram.dtype)
        g = jnp.sum(gram * one, axis=1)
        denominator = unit(g**2 + eps * given.sizes**2)
        errors, a = g / denominator, g**2 / denominator
        matrix = errors[:, None] * gram + (1 - a)[:, None] * one
        # Functions of which some follow from others have a singular matrix.
        solved = inverse(matrix + eps**0.5 * one)
        # The impulses for given errors, relative to those of the definite matrix of the
        # row sums: of one function, Σ (row sum) ω² over |g|.
        squares = given.covectors**2 + covectors**2
        roots = jnp.sqrt(jnp.sum(given.row_sums[None] * squares, axis=1))
        gain = roots[:, None] * solved * (errors * roots)[None]
        acts = ~(given.invariants.least_part * max_norm(gain) > 1)
        pushes = jnp.abs(jnp.concatenate([start, end], axis=1))
        terms = jnp.abs(given.slopes * start) + jnp.abs(slopes * end)
        return cls(
            errors=jnp.where(acts, errors, 0),
            rest=jnp.where(acts, 1 - a, 1),
            inverse=jnp.where(acts, solved, one),
            limits=_LARGEST_PART * (given.moving + moving) / unit(jnp.sum(terms, 1)),
            start=start,
            end=end,
            velocity=given.slopes if hamiltonian else start,
            noise=max_norm(given.sizes * errors * jnp.max(pushes, axis=1)),
        )

    def change(
        self, impulse: Float[Array, " k"], error: Float[Array, " k"]
    ) -> Float[Array, " k"]:
        """Compute the change of ε that makes the linearised equations hold."""
        residual = self.errors * error + self.rest * impulse
        wanted = impulse - small_einsum("kl,l->k", self.inverse, residual)
        return jnp.clip(wanted, -self.limits, self.limits) - impulse
