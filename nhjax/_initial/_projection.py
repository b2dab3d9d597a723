"""The projection of a configuration and a velocity onto the constraints.

A projection finds the nearest point on the constraints in the kinetic metric. The user
may choose components of q, v or p that the projection does not change. The result is
then the nearest of all points on the constraints with the same kept components.
"""

import operator
import reprlib
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar, FloatScalar
from .._errors import is_traced
from .._numerics import (
    DenseMatrix,
    inverse,
    least_norm_inverse,
    least_norm_solve,
    max_norm,
    NEARLY_DEPENDENT,
    root,
    stop_gradient,
)
from .._system import AbstractMechanicalSystem, position_scale, velocity_scale


T = TypeVar("T", bound=PyTree[Array])
# The components that a user chooses: an index, a name, or several of them.
Chosen: TypeAlias = int | str | Iterable[int | str] | None


class Kept(NamedTuple):
    """The components of q, v or p that a projection does not change.

    - `letter`: the argument that has these components: "q", "v" or "p".
    - `indices`: the indices of the components among all numbers of the argument.
    - `labels`: the names of the components in messages, such as "v[2]".
    """

    letter: str
    indices: tuple[int, ...] = ()
    labels: tuple[str, ...] = ()

    @property
    def argument(self) -> str:
        """Return the argument of `initial_state` that selected these components."""
        return f"keep_{self.letter}"

    def restored(self, tree: T, given: T) -> T:
        """Return `tree` with its kept numbers replaced by the numbers of `given`."""
        if not self.indices:
            return tree
        is_kept = np.zeros(sum(x.size for x in jax.tree.leaves(tree)), bool)
        is_kept[list(self.indices)] = True
        leaves, structure = jax.tree.flatten(tree)
        ends = np.cumsum([x.size for x in leaves])[:-1]
        masks = [
            mask.reshape(x.shape)
            for mask, x in zip(np.split(is_kept, ends), leaves, strict=True)
        ]
        return jax.tree.map(
            jnp.where, jax.tree.unflatten(structure, masks), given, tree
        )


def kept_numbers(tree: PyTree[Array], kept: Kept) -> Float[Array, " k"]:
    """Return the kept numbers of a tree as one vector."""
    numbers = jnp.concatenate([x.reshape(-1) for x in jax.tree.leaves(tree)])
    return numbers[jnp.asarray(kept.indices, int)]


def checked_keep(
    system: AbstractMechanicalSystem,
    q: PyTree[Array],
    letter: str,
    chosen: dict[str, Any],
    project: bool,
) -> tuple[Kept, Kept]:
    """Return the kept numbers of q and the kept components of the given v or p.

    **Arguments:**

    - `letter`: "v" or "p", the argument that was given.
    - `chosen`: the arguments `keep_q`, `keep_v` and `keep_p` by the letters q, v and p.
    """
    other = "p" if letter == "v" else "v"
    if chosen[other] is not None:
        raise ValueError(
            f"`keep_{other}` chooses components of `{other}`, but `{letter}` is given: "
            f"use `keep_{letter}`, or give `{other}` instead of `{letter}`."
        )
    dimension = system.manifold_of(q).dim
    of_q = _kept(system, "q", chosen["q"], _labels(q), dimension)
    labels = [f"{letter}[{i}]" for i in range(dimension)]
    of_u = _kept(system, letter, chosen[letter], labels, dimension)
    for kept in (of_q, of_u):
        if kept.indices and not project:
            raise ValueError(
                f"`{kept.argument}` chooses what a projection keeps, but `project` is "
                f"False, so that all of `{kept.letter}` is kept: pass `project=True`, "
                f"or leave `{kept.argument}` out."
            )
    return of_q, of_u


def _labels(q: PyTree[Array]) -> list[str]:
    """Return a label for each number of q, such as "q[1][0]" in a tuple."""
    found = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(q):
        where = "q" + jax.tree_util.keystr(path)
        found += [
            f"{where}[{', '.join(map(str, index))}]" for index in np.ndindex(leaf.shape)
        ]
    return found


def _kept(
    system: AbstractMechanicalSystem,
    letter: str,
    given: Any,
    labels: list[str],
    dimension: int,
) -> Kept:
    if given is None:
        return Kept(letter)
    name = f"keep_{letter}"
    entries = _entries(name, given)
    indices = [_index(system, name, x, len(labels), dimension) for x in entries]
    for i in indices:
        if indices.count(i) > 1:
            raise ValueError(f"`{name}` = {given!r} has {labels[i]} more than once.")
    names = system.coordinates
    if names is not None and len(names) == len(labels):
        labels = [f"{label} ({x})" for label, x in zip(labels, names, strict=True)]
    indices = tuple(sorted(indices))
    return Kept(letter, indices, tuple(labels[i] for i in indices))


def _entries(name: str, given: Any) -> list[Any]:
    """List the indices or names that an argument chooses."""
    if is_traced(*jax.tree.leaves(given)):
        raise TypeError(
            f"`{name}` is a traced array, but must be known when tracing: the program "
            "depends on which components are kept. Pass a tuple of ints, and not as an "
            "argument of `jax.jit` or `jax.vmap`."
        )
    is_one = isinstance(given, str) or getattr(given, "ndim", None) == 0
    if is_one or not isinstance(given, Iterable):
        return [given]
    if isinstance(given, Mapping):
        raise TypeError(_wrong_kind(name, given))
    return list(given)


def _wrong_kind(name: str, x: Any) -> str:
    return (
        f"`{name}` must be indices or names of components, got {reprlib.repr(x)} of "
        f"type {type(x).__name__}."
    )


def _index(
    system: AbstractMechanicalSystem, name: str, x: Any, size: int, dimension: int
) -> int:
    """Return the nonnegative index of a component given by index or name."""
    letter = name[-1]
    if isinstance(x, str):
        return _index_of_name(system, name, x, size, dimension)
    if isinstance(x, bool) or getattr(x, "dtype", None) == np.bool_:
        raise TypeError(
            f"`{name}` must be indices or names of components, not bools. For a mask, "
            "pass `numpy.flatnonzero(mask)`."
        )
    try:
        index = operator.index(x)
    except TypeError:
        raise TypeError(_wrong_kind(name, x)) from None
    if not -size <= index < size:
        raise ValueError(
            f"`{name}` has the index {index}, but `{letter}` has {size} numbers: pass "
            f"0 to {size - 1}."
        )
    return index % size


def _index_of_name(
    system: AbstractMechanicalSystem, name: str, x: str, size: int, dimension: int
) -> int:
    names, letter = system.coordinates, name[-1]
    if names is None:
        raise ValueError(
            f"`{name}` has the name {x!r}, but the system has no names: pass indices, "
            f"or name the coordinates, `{type(system).__name__}(..., "
            "coordinates=(...))`."
        )
    if len(names) != dimension:
        raise ValueError(
            f"`{name}` has the name {x!r}, but `coordinates` of the system has "
            f"{len(names)} names for {dimension} coordinates: {', '.join(names)}."
        )
    if size != dimension:
        raise ValueError(
            f"`{name}` has the name {x!r}, but the {size} numbers of `{letter}` are "
            f"not the {dimension} coordinates that have names: pass indices of "
            f"`{letter}`."
        )
    if x not in names:
        raise ValueError(
            f"`{name}` has the name {x!r}, but the coordinates are {', '.join(names)}."
        )
    return names.index(x)


Vector = Float[Array, " n"]


class Fixed(NamedTuple):
    """The combinations of constraints that the kept components determine.

    Row i of `projector` and `slopes` belongs to constraint i, divided by its largest
    absolute derivative. The derivatives are with respect to components that are scaled
    by the metric.

    - `sizes`: the largest absolute derivative of each constraint, 1 if all are zero.
    - `projector`: the projector onto the combinations that are constant, to first
        order, when only the components that are not kept change.
    - `slopes`: the derivatives of the constraints along the kept components.
    """

    sizes: Float[Array, " l"]
    projector: Float[Array, "l l"]
    slopes: Float[Array, "l k"]


class Nearest(NamedTuple):
    """The result of a search for the nearest point on a constraint.

    - `x`: the point at which the search ended, a vector or an element of the group.
    - `found`: whether the search succeeded.
    - `jacobian`: the Jacobian of the constraint at the start of the search.
    - `fixed`: the combinations of constraints that the kept components determine; None
        if no components are kept.
    """

    x: PyTree[Array]
    found: BoolScalar
    jacobian: Float[Array, "m n"]
    fixed: Fixed | None = None


def project_position(system, t, q, u, args, kept: Kept, given: PyTree[Array]):
    """Project q onto Γ = 0: find the stationary point of ½ ξᵀ M ξ on Γ(t, q τ(ξ)) = 0.

    M is the mass matrix at (t, q, u). The `kept` numbers of q τ(ξ) are equal to the
    same numbers of `given`. The `x` of the result is q τ(ξ).
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
    # A condition such as w = 1 on a unit quaternion has zero derivative where it holds.
    # A search that starts there leaves the condition out of its equations, and can
    # converge to a point that violates it. Therefore the kept numbers are checked.
    moved = manifold.act(q, nearest.x)
    size = max_norm(*jax.tree.leaves(stop_gradient((q, moved))))
    off = max_norm(stop_gradient(held(nearest.x)))
    is_kept = off <= 1e3 * float(jnp.finfo(u.dtype).eps) * size
    return nearest._replace(x=moved, found=nearest.found & is_kept)


def project_fibre_coordinate(system, t, q, u, args, kept: Kept, given: Vector):
    """Project u: find the stationary point w of ½ (w-u)ᵀ K (w-u) on Φ(t, q, w) = 0.

    K is the metric on the fibre at (t, q, u). The `kept` components of the
    argument that the user gave, v or p, are equal to the same components of `given`.
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
    """Find the nearest point as `_nearest` does, subject also to `held(y) = 0`.

    A combination of constraints is left out of the equations if its derivatives vanish
    in all directions in which `held` is constant, because the kept values determine it.
    Such a combination may be violated at the result: the caller must check all
    constraints there.

    `terms_of_held` has the sizes of the terms of `held`. The round-off of `held` is
    proportional to these sizes.
    """
    jacobian = jax.jacrev(constraint)(x)
    size, terms = sizes(jacobian)
    small = float(jnp.finfo(x.dtype).eps) ** 0.75
    # Scaling by the metric makes the ranks independent of the units of components.
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
    """Find orthonormal combinations of rows, and which combinations are active.

    The combinations are the columns of the first result. A combination is active if its
    singular value exceeds `negligible`. The second result is 1 for active combinations
    and 0 for the others.
    """
    missing = jnp.zeros(max(matrix.shape[0] - matrix.shape[1], 0), matrix.dtype)
    left, singular, _ = jnp.linalg.svd(matrix)
    sizes = jnp.concatenate([singular, missing])
    return left, (sizes > negligible).astype(matrix.dtype)


def _active(
    basis: Float[Array, "l l"], active: Float[Array, " l"], sizes: Float[Array, " l"]
) -> Float[Array, "l l"]:
    """Return the matrix that maps rows to their active combinations.

    The matrix is the identity if all combinations are active.
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
    - `constraint`: the function that must vanish.
    - `x`: the point from which the search starts.
    - `sizes`: called as `sizes(jacobian)`; returns the size of y and the sizes of the
        terms of the constraint. The round-off of y and of the constraint is
        proportional to these sizes.
    - `is_redundant`: whether constraints may be dependent.
    - `idle`: 1 for rows of the constraint that are zero everywhere, and 0 for the
        others. The multipliers of idle rows are zero.
    """
    jacobian = jax.jacrev(constraint)(x)
    size, terms = sizes(jacobian)
    # The scale of y includes the effect of round-off in the constraint. If y is zero,
    # this is the only round-off of y.
    reaction = inverse(metric) @ jacobian.T
    delassus = jacobian @ reaction
    if idle is not None:
        delassus = delassus + jnp.diag(idle)
    invert, solve = inverse, jnp.linalg.solve
    if is_redundant:
        invert = partial(least_norm_inverse, negligible=NEARLY_DEPENDENT**2)
        solve = least_norm_solve
    response = reaction @ invert(delassus)
    scale = size + max_norm(jnp.abs(response) @ terms)

    def stationarity(z):
        y, multiplier = z
        value, pullback = jax.vjp(constraint, y)
        if idle is not None:
            value = value + idle * multiplier
        # With this sign of `value`, the Jacobian of this function is symmetric.
        return metric @ (y - x) - pullback(multiplier)[0], -value

    solved = root(
        stationarity,
        (x, jnp.zeros_like(constraint(x))),
        jnp.where(jnp.isfinite(scale), scale, size),
        judged=lambda z: z[0],
        solve=solve,
    )
    return Nearest(solved.x[0], solved.converged, jacobian)
