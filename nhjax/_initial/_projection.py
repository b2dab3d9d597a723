"""The states on the constraints that are nearest to a given one."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._numerics import (
    DenseMatrix,
    stop_gradient,
    inverse,
    least_norm_inverse,
    least_norm_solve,
    max_norm,
    NEARLY_DEPENDENT,
    root,
)
from .._system import position_scale, velocity_scale
from ._keep import Kept, kept_numbers


Vector = Float[Array, " n"]


class Fixed(NamedTuple):
    """The combinations of constraints that kept components do not allow to change.

    A row of them belongs to a constraint, divided by the size of its derivatives.

    - `sizes`: the sizes of the derivatives of the constraints.
    - `projector`: the projector onto the combinations that do not change, to first
        order, however the other components change.
    - `slopes`: the derivatives of the constraints along the kept components.
    """

    sizes: Float[Array, " l"]
    projector: Float[Array, "l l"]
    slopes: Float[Array, "l k"]


class Nearest(NamedTuple):
    """The result of a search for the nearest point on a constraint.

    - `x`: the point at which the search ended, a vector or an element of the group.
    - `found`: whether it is a solution.
    - `jacobian`: the Jacobian of the constraint where the search started.
    - `fixed`: the combinations of constraints that kept components fix; None if no
        components are kept.
    """

    x: PyTree[Array]
    found: BoolScalar
    jacobian: Float[Array, "m n"]
    fixed: Fixed | None = None


def project_position(system, t, q, u, args, kept: Kept, given: PyTree[Array]):
    """Project q onto Γ = 0: find the stationary point of ½ ξᵀ M ξ on Γ(t, q τ(ξ)) = 0.

    M is the mass matrix at (t, q, u). The numbers of q τ(ξ) that are `kept` have the
    values that they have in `given`. The `x` of the result is q τ(ξ).
    """
    manifold = system.manifold_of(q)
    mass = system.metric(t, q, u, args)
    if system.fibre_coordinate_name == "p":
        mass = inverse(mass)
    is_redundant, zero = system.constraints == "redundant", jnp.zeros_like(u)

    def gamma(xi):
        return system.position_constraint(t, manifold.act(q, xi), args)

    def held(xi):
        moved = kept_numbers(manifold.act(q, xi), kept)
        return moved - kept_numbers(given, kept)

    def sizes(_):
        return max_norm(*jax.tree.leaves(q)), position_scale(system, t, q, args)

    if not kept.indices:
        nearest = _nearest(mass, gamma, zero, sizes, is_redundant)
        return nearest._replace(x=manifold.act(q, nearest.x))
    terms = jnp.full(len(kept.indices), max_norm(*jax.tree.leaves(q)))
    nearest = _nearest_keeping(mass, gamma, held, zero, sizes, terms, is_redundant)
    # A condition such as w = 1 on a quaternion has no derivative where it holds.
    moved = manifold.act(q, nearest.x)
    size = max_norm(*jax.tree.leaves(stop_gradient((q, moved))))
    off = max_norm(stop_gradient(held(nearest.x)))
    is_kept = off <= 1e3 * float(jnp.finfo(u.dtype).eps) * size
    return nearest._replace(x=moved, found=nearest.found & is_kept)


def project_fibre_coordinate(system, t, q, u, args, kept: Kept, given: Vector):
    """Project u onto Φ = 0: find the stationary point w of ½ (w-u)ᵀ K (w-u) there.

    The constraint is Φ(t, q, w) = 0, and K the metric on the fibre at (t, q, u). The
    `kept` components of v or p, whichever was given, have the values of `given`.
    """

    def phi(w):
        return system.constraint(t, q, w, args)

    def sizes(jacobian):
        return max_norm(u), velocity_scale(system, DenseMatrix(jacobian), t, q, u, args)

    metric = system.metric(t, q, u, args)
    is_redundant = system.constraints == "redundant"
    if not kept.indices:
        return _nearest(metric, phi, u, sizes, is_redundant)
    indices = jnp.asarray(kept.indices)
    is_fibre_coordinate = kept.letter == system.fibre_coordinate_name
    zero, terms = jnp.zeros_like(u), jnp.zeros(len(kept.indices), u.dtype)
    if not is_fibre_coordinate:
        at_zero = system.fibre_derivative(t, q, zero, args)
        terms = (jnp.abs(given) + jnp.abs(at_zero))[indices]

    def held(change):
        if is_fibre_coordinate:
            return change[indices]
        return (system.fibre_derivative(t, q, u + change, args) - given)[indices]

    nearest = _nearest_keeping(
        metric, lambda change: phi(u + change), held, zero, sizes, terms, is_redundant
    )
    moved = u + nearest.x
    if is_fibre_coordinate:
        moved = kept.restored(moved, given)
    return nearest._replace(x=moved)


def _nearest_keeping(
    metric: Float[Array, "n n"],
    constraint: Callable[[Vector], Float[Array, " m"]],
    held: Callable[[Vector], Float[Array, " k"]],
    x: Vector,
    sizes: Callable[[Float[Array, "m n"]], tuple[FloatScalar, Float[Array, " m"]]],
    terms_of_held: Float[Array, " k"],
    is_redundant: bool,
) -> Nearest:
    """Do what `_nearest` does, and keep `held(y) = 0` as well.

    A combination of constraints is left out of the equations if its derivatives vanish
    in all directions in which `held` does not change. The kept values then decide
    whether it vanishes. The caller must judge all constraints at the result, at which
    such a combination may be violated.

    `terms_of_held` has the sizes of the terms of `held`.
    """
    jacobian = jax.jacrev(constraint)(x)
    size, terms = sizes(jacobian)
    small = float(jnp.finfo(x.dtype).eps) ** 0.75
    # The units of single components are taken out by the metric.
    units = jnp.sqrt(jnp.abs(jnp.diagonal(metric)))
    units = jnp.where(units > 0, units, 1)
    by_units = jacobian / units[None], jax.jacrev(held)(x) / units[None]
    slopes, rows = stop_gradient(by_units)
    row_sizes, slope_sizes = _row_sizes(rows), _row_sizes(slopes)
    rows, slopes = rows / row_sizes[:, None], slopes / slope_sizes[:, None]
    along_kept = slopes @ jnp.linalg.pinv(rows, rtol=small)
    kept_basis, kept_active = _left_basis(rows, small)
    basis, active = _left_basis(
        slopes - along_kept @ rows, NEARLY_DEPENDENT if is_redundant else small
    )
    combined = block_diag(
        _active(kept_basis, kept_active, row_sizes),
        _active(basis, active, slope_sizes),
    )
    idle = jnp.concatenate([1 - kept_active, 1 - active])

    def all_sizes(_):
        return size, jnp.abs(combined) @ jnp.concatenate([terms_of_held, terms])

    nearest = _nearest(
        metric,
        lambda y: combined @ jnp.concatenate([held(y), constraint(y)]),
        x,
        all_sizes,
        is_redundant,
        idle,
    )
    unchanging = basis * (1 - active)[None]
    fixed = Fixed(slope_sizes, unchanging @ unchanging.T, along_kept)
    return nearest._replace(jacobian=jacobian, fixed=stop_gradient(fixed))


def _row_sizes(matrix: Float[Array, "l n"]) -> Float[Array, " l"]:
    largest = jnp.max(jnp.abs(matrix), axis=1)
    return jnp.where(largest > 0, largest, 1)


def _left_basis(
    matrix: Float[Array, "l n"], negligible: float
) -> tuple[Float[Array, "l l"], Float[Array, " l"]]:
    """Find orthonormal combinations of rows, and which are active: one, or else zero.

    The combinations, which are the columns of the result, are active unless they are
    negligible.
    """
    missing = jnp.zeros(max(matrix.shape[0] - matrix.shape[1], 0), matrix.dtype)
    left, singular, _ = jnp.linalg.svd(matrix)
    sizes = jnp.concatenate([singular, missing])
    return left, (sizes > negligible).astype(matrix.dtype)


def _active(
    basis: Float[Array, "l l"], active: Float[Array, " l"], sizes: Float[Array, " l"]
) -> Float[Array, "l l"]:
    """Return the matrix that makes the active combinations of rows of these sizes.

    Where all combinations are active the rows stay as they are.
    """
    combinations = active[:, None] * basis.T / sizes[None]
    same = jnp.eye(basis.shape[0], dtype=basis.dtype)
    return jnp.where(jnp.all(active > 0), same, combinations)


def _nearest(
    metric: Float[Array, "n n"],
    constraint: Callable[[Float[Array, " n"]], Float[Array, " m"]],
    x: Float[Array, " n"],
    sizes: Callable[[Float[Array, "m n"]], tuple[FloatScalar, Float[Array, " m"]]],
    is_redundant: bool,
    idle: Float[Array, " m"] | None = None,
) -> Nearest:
    """Find the stationary point y of ½ (y-x)ᵀ K (y-x) on constraint(y) = 0.

    **Arguments:**

    - `metric`: the matrix K.
    - `constraint`: the function that is to vanish.
    - `x`: the point from which the search starts.
    - `sizes`: called as `sizes(jacobian)`, the sizes of y and of the terms of the
        constraint, to which their round-off is proportional.
    - `is_redundant`: whether constraints may follow from each other.
    - `idle`: one for rows of the constraint that are zero everywhere, and zero for the
        others. The multipliers of idle rows are zero.
    """
    jacobian = jax.jacrev(constraint)(x)
    size, terms = sizes(jacobian)
    # The round-off of the constraint moves y too. If y is zero, nothing else does.
    reaction = inverse(metric) @ jacobian.T
    compliance = jacobian @ reaction
    if idle is not None:
        compliance = compliance + jnp.diag(idle)
    invert, solve = inverse, jnp.linalg.solve
    if is_redundant:
        invert = partial(least_norm_inverse, negligible=NEARLY_DEPENDENT**2)
        solve = least_norm_solve
    response = reaction @ invert(compliance)
    scale = size + max_norm(jnp.abs(response) @ terms)

    def stationarity(z):
        y, multiplier = z
        value, pullback = jax.vjp(constraint, y)
        if idle is not None:
            value = value + idle * multiplier
        return metric @ (y - x) - pullback(multiplier)[0], value

    solved = root(
        stationarity,
        (x, jnp.zeros_like(constraint(x))),
        jnp.where(jnp.isfinite(scale), scale, size),
        judged=lambda z: z[0],
        solve=solve,
    )
    return Nearest(solved.x[0], solved.converged, jacobian)
