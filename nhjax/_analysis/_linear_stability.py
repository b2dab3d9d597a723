"""The constrained motion, linearised about a steady motion, and its eigenvalues."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from .._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from .._errors import (
    Check,
    DependentConstraintsError,
    IrregularLagrangianError,
    require,
)
from .._system import AbstractMechanicalSystem, check_flag, parameters, State
from ._linearisation import (
    BoundedResidual,
    check_relative_equilibrium,
    check_symmetry,
    independent_basis,
    Indices,
    indices,
    linearise_along_symmetry,
    linearise_along_velocity,
    LinearisedEquations,
    orthonormal_basis,
    state_size,
    Symmetry,
    symmetry_checks,
    SymmetryConditions,
)
from ._motion import checked_time


class LinearStability(eqx.Module):
    """The constrained motion, linearised about a steady motion: ż = A z.

    - `matrix`: A, shape (d, d).
    - `basis`: the perturbation (ξ, w) of the state for each component of z, as columns,
        shape (2n, d). The first n rows are the change ξ of the configuration, which
        becomes q + ξ, or q τ(ξ) on a group. The last n rows are the change w of the
        velocity, or of the momentum of a Hamiltonian system. With a `symmetry`,
        perturbations that differ by a combination of the generators are equivalent, and
        each column represents a class of equivalent perturbations.
    """

    matrix: Float[Array, "d d"]
    basis: Float[Array, "x d"]

    @property
    def eigenvalues(self) -> Complex[Array, " d"]:
        """Return the eigenvalues of A, in 1/s: growth rates + i angular frequencies."""
        return jnp.linalg.eigvals(self.matrix)

    @property
    def modes(self) -> tuple[Complex[Array, " d"], Complex[Array, "x d"]]:
        """Return the eigenvalues, and the perturbations of the modes as columns."""
        values, vectors = jnp.linalg.eig(self.matrix)
        return values, self.basis.astype(vectors.dtype) @ vectors


def linear_stability(
    system: AbstractMechanicalSystem,
    t: FloatScalarLike,
    y: State,
    args: Args = None,
    *,
    positions: Sequence[int] | None = None,
    velocities: Sequence[int] | None = None,
    symmetry: Symmetry | None = None,
    must_be_steady: bool = True,
) -> LinearStability:
    """Linearise the constrained equations of motion about a steady motion.

    A steady motion, or relative equilibrium, is an orbit of a one-parameter group of
    symmetries of the system. Let x = (q, u), where u is the velocity or momentum, and
    let ẋ = f(x) be the equations of motion. Their multipliers follow from the time
    derivatives of the constraints. Let X be the vector field that generates the
    symmetries. Then f - X vanishes at the state, and

    ż = A z,    A = W D(f - X) Z,

    in the frame that moves with X. The columns of Z are perturbations δx that satisfy
    the constraints to first order, and W is a left inverse of Z: W Z = 1. On a group,
    perturbations are left-trivialised.

    There are two ways to specify X. With `symmetry`, X is the combination of the given
    generators along which the state moves. Perturbations along the generators only
    shift the motion in time or space and are excluded, so that A belongs to the reduced
    system. Without `symmetry`, X generates the translation that has the velocity of the
    state: a translation of ignorable coordinates, or a left translation of the group.
    All velocities (on a group, body velocities), or at least the chosen positions and
    velocities, must be constant. For a bicycle on a circle, only some velocities are
    constant: choose these.

    About any other motion, A is valid only for an instant, and its eigenvalues do not
    decide stability. `steady_motion` finds steady motions.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time at which functions of time are evaluated.
    - `y`: a consistent state on the steady motion.
    - `args`: passed on to the functions of the system.
    - `positions`, `velocities`: the indices of the independent coordinates and of the
        independent velocities (of momenta for a Hamiltonian system), which form z. All
        other velocities must follow from the constraints: with m nonholonomic and k
        holonomic constraints there are n - m - k independent velocities. Only
        coordinates that are in `positions` or follow from holonomic constraints are
        perturbed. Omit coordinates on which the motion does not depend, such as the
        position of a wheel. By default, z consists of coordinates in an orthonormal
        basis of all perturbations that the constraints permit.
    - `symmetry`: a function that returns generators of symmetries, like the `generator`
        of `momentum_map`. It is called as `symmetry(q)` and returns vectors of shape
        (n,) or (k, n), in the components of the velocity. On a group, the generator of
        g -> g exp(εξ), a symmetry of the body, is the constant ξ. The generator of g ->
        exp(εξ) g, a symmetry of space, is `manifold.Ad(manifold.inverse(q), xi)`. The
        velocity must be a combination of the generators. If one generator is a rotation
        and another is a translation that it rotates, include the translations in all
        directions that this rotation produces; otherwise the generators are not closed
        (they leave their span in the moving frame).
    - `must_be_steady`: whether to raise if the motion is not steady. Pass False to
        linearise at an instant, for instance along a trajectory.

    **Returns:** a `LinearStability` with the matrix A, its eigenvalues and its modes,
    differentiable with respect to `y` and `args`. JAX computes the eigenvalues of a
    nonsymmetric matrix only on a CPU.

    **Raises:** `TypeError` if `system` is not a system, `y` is not a `State`, or
    `symmetry` is not a function. `ValueError` if only one of `positions` and
    `velocities` is given, an index is out of range or occurs twice, the number of
    indices is wrong, or they do not determine the other velocities; if the motion is
    not steady; if generators are dependent, not closed, or not symmetries of the
    equations of motion to first order at `y`. `DependentConstraintsError` if the
    constraints are dependent. `IrregularLagrangianError` if the mass matrix or the
    compatibility matrix is singular. `ShapeError` if `y` is not a state of this system,
    or a generator does not have the shape of a velocity.

    !!! example

        A pendulum that moves on a cone with cos θ = 1/4:

        >>> import jax.numpy as jnp, nhjax
        >>> pendulum = nhjax.systems.SphericalPendulum(
        ...     q0=(0.9682458365518543, 0.0, -0.25), v0=(0.0, 1.9364916731037085, 0.0))
        >>> stability = nhjax.linear_stability(
        ...     pendulum.system, 0.0, pendulum.initial_state(),
        ...     symmetry=lambda q: jnp.stack([-q[1], q[0], 0 * q[2]]))
        >>> [round(float(x), 6) for x in jnp.sort(stability.eigenvalues.imag)]
        [-2.179449, 0.0, 2.179449]
    """
    args = parameters(args)
    t = checked_time("linear_stability", system, t, y, args)
    independent = check_independent(system, t, y, args, positions, velocities)
    must_be_steady = check_flag("must_be_steady", must_be_steady)
    if symmetry is None:
        linearised = linearise_along_velocity(system, t, y, args)
    else:
        _check_only_symmetry(independent, must_be_steady)
        check_symmetry(symmetry, y)
        linearised = linearise_along_symmetry(system, t, y, args, symmetry)
    reduced = _reduce(linearised, y, independent)
    checks = [Check(reduced.has_motion, _singular_matrix, (y.q,))]
    if reduced.conditions is not None:
        checks += symmetry_checks(reduced.conditions)
    checks.append(Check(reduced.determined, _not_determined, (independent,)))
    if must_be_steady and reduced.conditions is None:
        drift = reduced.drift
        checks.append(Check(drift.holds, _not_steady, tuple(drift)))
    return require(reduced.found, *checks)


def _check_only_symmetry(independent: object, must_be_steady: bool) -> None:
    if independent is not None:
        raise ValueError(
            "Pass either `symmetry` or `positions` and `velocities`, not both: both "
            "choose which perturbations to exclude."
        )
    if not must_be_steady:
        raise ValueError(
            "With `symmetry` the motion must be steady: omit `must_be_steady`."
        )


def _drift_rates(
    linearised: LinearisedEquations,
    y: State,
    independent: tuple[Indices, Indices] | None,
) -> BoundedResidual:
    """Compute the rates that vanish in a steady motion, and their bounds.

    In a steady motion, the chosen positions and velocities are constant; if none are
    chosen, all velocities are constant. Their first and second time derivatives must
    vanish. The first alone is not enough: for the velocity of a pendulum, it also
    vanishes at the lowest point. The bounds allow for states that are accurate to only
    a few digits.
    """
    dim = linearised.position_jacobian.shape[1]
    if independent is None:
        chosen = jnp.arange(dim, 2 * dim)
    else:
        positions, velocities = independent
        chosen = jnp.asarray((*positions, *(dim + i for i in velocities)), int)
    rates = jnp.abs(linearised.rates)
    drift = jnp.stack([linearised.velocity, linearised.rates @ linearised.velocity])
    terms = jnp.stack(
        [jnp.sum(rates, axis=1) * state_size(y), rates @ jnp.abs(linearised.velocity)]
    )
    small = float(jnp.finfo(drift.dtype).eps) ** 0.25
    allowed = small * (1 + terms)
    return BoundedResidual(
        jnp.abs(drift[:, chosen]).reshape(-1), allowed[:, chosen].reshape(-1)
    )


def _singular_matrix(q: object) -> IrregularLagrangianError:
    return IrregularLagrangianError(
        "The mass matrix D2D2L (or D2D2H) or the compatibility matrix C is singular at "
        f"q = {q}, or a function of the system is not finite there, so that the "
        "equations of motion cannot be linearised. `nhjax.check_system` reports which."
    )


def _not_steady(drift: np.ndarray, allowed: np.ndarray) -> ValueError:
    worst = int(np.argmax(drift / allowed))
    return ValueError(
        "The motion is not steady: a velocity or chosen position changes at the rate "
        f"{float(drift[worst]):.3g} (allowed {float(allowed[worst]):.1g}). Find a "
        "steady motion with `nhjax.steady_motion`, choose `positions` and `velocities` "
        "that are constant, or pass `must_be_steady=False`."
    )


def _not_determined(independent: tuple[Indices, Indices] | None) -> ValueError:
    if independent is None:
        return DependentConstraintsError(
            "The constraints are dependent at `y`: they permit more velocities than "
            "n - m - k. Remove redundant constraints."
        )
    positions, velocities = independent
    return ValueError(
        f"`positions` = {positions} and `velocities` = {velocities} do not determine "
        "the other velocities at `y`: choose coordinates that are independent "
        "under the constraints."
    )


class _ReducedEquations(NamedTuple):
    """The linear equations, and the conditions under which they are valid."""

    found: LinearStability
    has_motion: BoolScalar
    determined: BoolScalar
    drift: BoundedResidual
    conditions: SymmetryConditions | None


@eqx.filter_jit
def _reduce(
    linearised: LinearisedEquations,
    y: State,
    independent: tuple[Indices, Indices] | None,
) -> _ReducedEquations:
    """Restrict the linear equations to the permitted perturbations."""
    orbit = linearised.orbit
    if independent is None:
        excluded = linearised.rates[:0] if orbit is None else orbit.directions
        permitted = orthonormal_basis(linearised.all_constraints, excluded)
    else:
        permitted = independent_basis(
            linearised.constraint_jacobian, linearised.position_jacobian, *independent
        )
    matrix = permitted.left @ linearised.rates @ permitted.basis
    conditions, equations = None, linearised.rates
    if orbit is not None:
        conditions = check_relative_equilibrium(
            orbit, linearised.all_constraints, permitted, state_size(y)
        )
        equations = orbit.motion_jacobian
    return _ReducedEquations(
        found=LinearStability(matrix, permitted.basis),
        has_motion=jnp.all(jnp.isfinite(equations)),
        determined=permitted.determined,
        drift=_drift_rates(linearised, y, independent),
        conditions=conditions,
    )


def check_independent(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    y: State,
    args: Args,
    positions: Sequence[int] | None,
    velocities: Sequence[int] | None,
) -> tuple[Indices, Indices] | None:
    """Check and return the indices of independent coordinates; None if not given."""
    if positions is None and velocities is None:
        return None
    if positions is None or velocities is None:
        missing = "positions" if positions is None else "velocities"
        raise ValueError(
            f"Pass `positions` and `velocities` together: `{missing}` is missing."
        )
    dim, count = y.p.shape[0], y.multiplier.shape[0]
    chosen = (
        indices("positions", positions, dim),
        indices("velocities", velocities, dim),
    )
    if len(chosen[1]) != dim - count:
        raise ValueError(
            f"`velocities` has {len(chosen[1])} indices, but {dim} velocities with "
            f"{count} constraints have {dim - count} independent ones."
        )
    num_holonomic = jax.eval_shape(
        lambda q: system.position_constraint(t, q, args), y.q
    ).size
    if len(chosen[0]) > dim - num_holonomic:
        raise ValueError(
            f"`positions` has {len(chosen[0])} indices, but {dim} coordinates with "
            f"{num_holonomic} holonomic constraints have {dim - num_holonomic} "
            "independent ones."
        )
    return chosen
