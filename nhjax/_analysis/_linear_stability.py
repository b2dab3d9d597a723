"""The constrained motion, linearised about a steady motion, and its eigenvalues."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from .._compile import as_cpu_kernel, tracked_jit
from .._custom_types import Args, BoolScalar, FloatScalarLike
from .._errors import (
    Check,
    DependentConstraintsError,
    IrregularLagrangianError,
    require,
)
from .._numerics import jacobian_and_value, max_norm, unit
from .._system import (
    AbstractMechanicalSystem,
    check_flag,
    parameters,
    State,
)
from ._arguments import checked_time
from ._permitted import independent_basis, orthonormal_basis
from ._perturbation import check_independent, Indices, perturbed, rates_of_change


class LinearStability(eqx.Module):
    """The constrained motion, linearised about a steady motion: ż = A z.

    - `matrix`: A, shape (d, d).
    - `basis`: the perturbation (ξ, w) of the state that belongs to each z, as columns,
        shape (2n, d). The first n rows are the change ξ of the configuration, which
        becomes q + ξ or, on a group, q τ(ξ); the last n rows are the change w of the
        velocity, or for a Hamiltonian system of the momentum.
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
    must_be_steady: bool = True,
) -> LinearStability:
    """Linearise the constrained equations of motion about a steady motion.

    With x = (q, u) and the equations of motion ẋ = f(x), whose multipliers follow from
    the hidden constraints, a perturbation that satisfies the constraints to first order
    is δx = Z z, and ż = A z with A = W Df(x) Z for any W with W Z = 1. On a group
    perturbations are left-trivialised, ξ̇ = δv - ad_v ξ.

    The motion is an equilibrium, or it is steady in these coordinates: all velocities
    are constant, those of the body on a group, or at least the independent ones that
    are chosen, as for a bicycle that runs in a circle. A body of revolution that rolls
    on a circle is not steady in this sense, since its axes turn against the motion.
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
    - `must_be_steady`: raise unless the motion is steady. Without it the matrix is that
        of the instant, for instance to linearise along a trajectory.

    **Returns:** a `LinearStability` with the matrix A, its eigenvalues and its modes,
    differentiable with respect to `y` and `args`. The eigenvalues themselves are
    computed by a library that JAX has on a CPU only.

    **Raises:** `TypeError` if `system` is no system or `y` no `State`; `ValueError` if
    only one of `positions` and `velocities` is given, an index is out of range or
    occurs twice, their number does not fit, or they do not determine the other
    velocities, or if the motion is not steady; `DependentConstraintsError` if the
    constraints are dependent; `IrregularLagrangianError` if the mass matrix or the
    compatibility matrix is singular; `ShapeError` if `y` is no state of this system.

    !!! example

        >>> import nhjax
        >>> pendulum = nhjax.systems.SphericalPendulum(
        ...     q0=(0.0, 0.0, -1.0), v0=(0.0, 0.0, 0.0), gravity=4.0)
        >>> y = pendulum.initial_state()
        >>> stability = nhjax.linear_stability(pendulum.system, 0.0, y)
        >>> [round(abs(float(x.imag)), 4) for x in stability.eigenvalues]
        [2.0, 2.0, 2.0, 2.0]
    """
    args = parameters(args)
    t = checked_time("linear_stability", system, t, y, args)
    independent = check_independent(system, t, y, args, positions, velocities)
    must_be_steady = check_flag("must_be_steady", must_be_steady)
    slopes = _slopes(system, t, y, args)
    reduced = _reduced(slopes, y, independent)
    checks = [
        Check(reduced.has_motion, _singular, (y.q,)),
        Check(reduced.determined, _not_determined, (independent,)),
    ]
    if must_be_steady:
        drift = reduced.drift, reduced.allowed
        checks.append(Check(reduced.is_steady, _not_steady, drift))
    return require(reduced.found, *checks)


def _drift(
    slopes: "_Slopes", y: State, independent: tuple[Indices, Indices] | None
) -> tuple[Array, Array]:
    """Find how fast what must be constant changes, and how fast it may.

    The bound is for states that were computed or printed with some digits.
    """
    dim = slopes.on_positions.shape[1]
    drift = jnp.abs(slopes.drift)
    if independent is None:
        chosen = jnp.arange(dim, 2 * dim)
    else:
        positions, velocities = independent
        chosen = jnp.asarray((*positions, *(dim + i for i in velocities)), int)
    size = unit(max_norm(*jax.tree.leaves(y.q), y.v, y.p))
    terms = jnp.sum(jnp.abs(slopes.rates), axis=1) * size
    small = float(jnp.finfo(drift.dtype).eps) ** 0.25
    return drift[chosen], small * (1 + terms[chosen])


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


class _Slopes(NamedTuple):
    """The derivatives of the equations with respect to perturbations x = (ξ, w)."""

    rates: Float[Array, "x x"]
    drift: Float[Array, " x"]  # (v, u̇), of which the steady part must vanish
    on_velocities: Float[Array, "l x"]
    on_positions: Float[Array, "k n"]


@tracked_jit("system", "args")
def _slopes(system, t, y, args) -> _Slopes:
    dim, count = y.p.shape[0], y.multiplier.shape[0]

    def equations(x):
        q, u = perturbed(system, y, x)
        return jnp.concatenate(
            [
                rates_of_change(system, t, y, args)(x),
                system.constraint(t, q, u, args),
                system.position_constraint(t, q, args),
            ]
        )

    slopes, value, _ = jacobian_and_value(
        lambda x: (as_cpu_kernel(equations, x), None), jnp.zeros(2 * dim, y.p.dtype)
    )
    drift = jnp.concatenate([y.v, value[dim : 2 * dim]])
    rates, on_velocities, rest = jnp.split(slopes, [2 * dim, 2 * dim + count])
    return _Slopes(rates, drift, on_velocities, rest[:, :dim])


class _Reduced(NamedTuple):
    """The linear equations, and what tells whether they mean anything."""

    found: LinearStability
    has_motion: BoolScalar
    determined: BoolScalar
    is_steady: BoolScalar
    drift: Array
    allowed: Array


@eqx.filter_jit
def _reduced(
    slopes: _Slopes, y: State, independent: tuple[Indices, Indices] | None
) -> _Reduced:
    """Restrict the linear equations to the perturbations that are permitted."""
    if independent is None:
        dim = slopes.on_positions.shape[1]
        rows = jnp.pad(slopes.on_positions, ((0, 0), (0, dim)))
        found = orthonormal_basis(jnp.concatenate([slopes.on_velocities, rows]))
    else:
        found = independent_basis(
            slopes.on_velocities, slopes.on_positions, *independent
        )
    matrix = found.left @ slopes.rates @ found.basis
    drift, allowed = _drift(slopes, y, independent)
    return _Reduced(
        found=LinearStability(matrix, found.basis),
        has_motion=jnp.all(jnp.isfinite(slopes.rates)),
        determined=found.determined,
        is_steady=jnp.all(drift <= allowed),
        drift=drift,
        allowed=allowed,
    )
