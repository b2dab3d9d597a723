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
    Bounded,
    check_symmetry,
    checks_of,
    independent_basis,
    Indices,
    indices,
    judged,
    orthonormal_basis,
    size_of,
    Slopes,
    slopes_along_symmetry,
    slopes_along_velocity,
    Symmetry,
    Verdict,
)
from ._motion import checked_time


class LinearStability(eqx.Module):
    """The constrained motion, linearised about a steady motion: ż = A z.

    - `matrix`: A, shape (d, d).
    - `basis`: the perturbation (ξ, w) of the state that belongs to each z, as columns,
        shape (2n, d). The first n rows are the change ξ of the configuration, which
        becomes q + ξ or, on a group, q τ(ξ); the last n rows are the change w of the
        velocity, or for a Hamiltonian system of the momentum. With a `symmetry` each
        stands for all that differ from it by a perturbation along its generators.
    """

    matrix: Float[Array, "d d"]
    basis: Float[Array, "x d"]

    @property
    def eigenvalues(self) -> Complex[Array, " d"]:
        """Return the eigenvalues of A, in 1/s: growth rates + i angular frequencies."""
        return jnp.linalg.eigvals(self.matrix)

    @property
    def modes(self) -> tuple[Complex[Array, " d"], Complex[Array, "x d"]]:
        """Return the eigenvalues, and the perturbation of each mode as a column."""
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

    A steady motion is the orbit of a one-parameter group of symmetries of the system, a
    relative equilibrium. With x = (q, u), the equations of motion ẋ = f(x), whose
    multipliers follow from the hidden constraints, and the vector field X that makes
    the symmetries, f - X vanishes at the state, and

    ż = A z,    A = W D(f - X) Z,

    in the frame that moves with X. Perturbations δx = Z z satisfy the constraints to
    first order, and W Z = 1. On a group they are left-trivialised.

    There are two ways to tell X. With `symmetry` it is the combination of the given
    generators along which the state moves, and perturbations along the generators,
    which lead to the same motion moved in time or space, are left out: A is that of
    the reduced system. Without it X has the velocity itself as its constant
    components; it is a translation of ignorable coordinates, or of the group from the
    left, and velocities are constant: those of the body on a group, or at least the
    independent ones that are chosen, as for a bicycle that runs in a circle.

    About any other motion A holds for an instant, and its eigenvalues have no meaning
    for stability. `steady_motion` finds steady motions.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time at which functions that depend on time are taken.
    - `y`: a consistent state on the steady motion.
    - `args`: passed on to the functions of the system.
    - `positions`, `velocities`: the indices of the independent coordinates and of the
        independent velocities (of momenta for a Hamiltonian system), which are then z.
        All other velocities follow from the constraints, so that there are n - m - k of
        them. Positions that neither are independent nor follow from the holonomic
        constraints are not perturbed: use it for coordinates that the motion does not
        depend on, such as where a wheel is. By default z are coordinates in an
        orthonormal basis of all perturbations that the constraints permit.
    - `symmetry`: generators of symmetries, as vector fields like those of
        `momentum_map`: called as `symmetry(q)`, of shape (n,) or (k, n), in the
        components of the velocity. On a group that of g -> g exp(εξ), a symmetry of the
        body, is the constant ξ, and that of g -> exp(εξ) g, one of space, is
        `manifold.Ad(manifold.inverse(q), xi)`. The velocity must be a combination of
        them, and translations go with rotations that turn them.
    - `must_be_steady`: raise unless the motion is steady. Without it the matrix is that
        of the instant, for instance to linearise along a trajectory.

    **Returns:** a `LinearStability` with the matrix A, its eigenvalues and its modes,
    differentiable with respect to `y` and `args`. The eigenvalues themselves are
    computed by a library that JAX has on a CPU only.

    **Raises:** `TypeError` if `system` is no system, `y` no `State` or `symmetry` no
    function; `ValueError` if only one of `positions` and `velocities` is given, an
    index is out of range or occurs twice, their number does not fit, or they do not
    determine the other velocities, if the motion is not steady, or if generators are
    dependent, not closed, or no symmetries of the equations of motion to first order at
    `y`; `DependentConstraintsError` if the constraints are dependent;
    `IrregularLagrangianError` if the mass matrix or the compatibility matrix is
    singular; `ShapeError` if `y` is no state of this system, or generators no
    velocities.

    !!! example

        A pendulum that turns on a cone, where cos θ is 1/4:

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
        slopes = slopes_along_velocity(system, t, y, args)
    else:
        _check_alone(independent, must_be_steady)
        check_symmetry(symmetry, y)
        slopes = slopes_along_symmetry(system, t, y, args, symmetry)
    reduced = _reduced(slopes, y, independent)
    checks = [Check(reduced.has_motion, _singular, (y.q,))]
    if reduced.verdict is not None:
        checks += checks_of(reduced.verdict)
    checks.append(Check(reduced.determined, _not_determined, (independent,)))
    if must_be_steady and reduced.verdict is None:
        drift = reduced.drift
        checks.append(Check(drift.holds, _not_steady, tuple(drift)))
    return require(reduced.found, *checks)


def _check_alone(independent: object, must_be_steady: bool) -> None:
    if independent is not None:
        raise ValueError(
            "Give either `symmetry`, which leaves out what its generators move, or "
            "`positions` and `velocities`, not both."
        )
    if not must_be_steady:
        raise ValueError(
            "With `symmetry` the motion must be steady: leave `must_be_steady` out."
        )


def _drift(
    slopes: Slopes, y: State, independent: tuple[Indices, Indices] | None
) -> Bounded:
    """Compute the rates of what a steady motion keeps constant, and their bounds.

    Constant are the chosen coordinates, or all velocities where none are chosen. Their
    first and second derivatives by time must vanish: where a pendulum passes its lowest
    point, the first derivative of its velocity vanishes, but not the second. The bounds
    allow for states that were computed or printed with some digits.
    """
    dim = slopes.on_positions.shape[1]
    if independent is None:
        chosen = jnp.arange(dim, 2 * dim)
    else:
        positions, velocities = independent
        chosen = jnp.asarray((*positions, *(dim + i for i in velocities)), int)
    rates = jnp.abs(slopes.rates)
    drift = jnp.stack([slopes.velocity, slopes.rates @ slopes.velocity])
    terms = jnp.stack(
        [jnp.sum(rates, axis=1) * size_of(y), rates @ jnp.abs(slopes.velocity)]
    )
    small = float(jnp.finfo(drift.dtype).eps) ** 0.25
    allowed = small * (1 + terms)
    return Bounded(
        jnp.abs(drift[:, chosen]).reshape(-1), allowed[:, chosen].reshape(-1)
    )


def _singular(q: object) -> IrregularLagrangianError:
    return IrregularLagrangianError(
        "The mass matrix D2D2L (or D2D2H) or the compatibility matrix C is singular at "
        f"q = {q}, or a function of the system is not finite there: there is no motion "
        "to linearise. `nhjax.check_system` tells which."
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
            "The constraints are dependent at `y`: they leave more perturbations than "
            "n - m - k. Remove redundant constraints."
        )
    positions, velocities = independent
    return ValueError(
        f"`positions` = {positions} and `velocities` = {velocities} do not determine "
        "the other velocities at `y`: choose coordinates that the constraints leave "
        "independent."
    )


class _Reduced(NamedTuple):
    """The linear equations, and what tells whether they mean anything."""

    found: LinearStability
    has_motion: BoolScalar
    determined: BoolScalar
    drift: Bounded
    verdict: Verdict | None


@eqx.filter_jit
def _reduced(
    slopes: Slopes, y: State, independent: tuple[Indices, Indices] | None
) -> _Reduced:
    """Restrict the linear equations to the perturbations that are permitted."""
    orbit = slopes.orbit
    if independent is None:
        beside = slopes.rates[:0] if orbit is None else orbit.directions
        permitted = orthonormal_basis(slopes.rows, beside)
    else:
        permitted = independent_basis(
            slopes.on_velocities, slopes.on_positions, *independent
        )
    matrix = permitted.left @ slopes.rates @ permitted.basis
    verdict, equations = None, slopes.rates
    if orbit is not None:
        verdict = judged(orbit, slopes.rows, permitted, size_of(y))
        equations = orbit.motion_slopes
    return _Reduced(
        found=LinearStability(matrix, permitted.basis),
        has_motion=jnp.all(jnp.isfinite(equations)),
        determined=permitted.determined,
        drift=_drift(slopes, y, independent),
        verdict=verdict,
    )


def check_independent(
    system: AbstractMechanicalSystem,
    t: FloatScalar,
    y: State,
    args: Args,
    positions: Sequence[int] | None,
    velocities: Sequence[int] | None,
) -> tuple[Indices, Indices] | None:
    """Check the choice of independent coordinates; None if none are chosen."""
    if positions is None and velocities is None:
        return None
    if positions is None or velocities is None:
        missing = "positions" if positions is None else "velocities"
        raise ValueError(
            f"Give `positions` and `velocities` together: `{missing}` is missing."
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
    tied = jax.eval_shape(lambda q: system.position_constraint(t, q, args), y.q).size
    if len(chosen[0]) > dim - tied:
        raise ValueError(
            f"`positions` has {len(chosen[0])} indices, but {dim} coordinates with "
            f"{tied} holonomic constraints have {dim - tied} independent ones."
        )
    return chosen
