"""Checks of a system at a state: shapes, dtypes, and independent constraints."""

import reprlib

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalar
from .._errors import (
    DependentConstraintsError,
    DTypeError,
    is_traced,
    require,
    ShapeError,
)
from .._manifold import AbstractLieGroup
from .._numerics import dependent_rows, has_zero_row, is_deficient, max_norm
from ._arguments import dtype_advice, finite, floating, no_array
from ._systems import AbstractMechanicalSystem, State


def require_manifold(
    system: AbstractMechanicalSystem, name: str, q: PyTree[Array]
) -> None:
    """Raise a `ShapeError` if `q` is a tuple but the system has no manifold."""
    if system.manifold is None and isinstance(q, tuple):
        raise ShapeError(
            f"`{name}` is a tuple of {len(q)}, but the system has no `manifold`. Give "
            "it one, such as nhjax.ProductGroup(...), or make one array of "
            f"`{name}`."
        )


def require_names(
    system: AbstractMechanicalSystem, name: str, manifold: AbstractLieGroup
) -> None:
    """Raise a `ShapeError` if the numbers of names and of coordinates differ."""
    names = system.coordinates
    if names is not None and len(names) != manifold.dim:
        raise ShapeError(
            f"`{name}` has {manifold.dim} coordinates, but the system has {len(names)} "
            f"names of `coordinates`, {names}: give one name for each coordinate, and "
            "one coordinate for each name."
        )


def check_functions(
    system: AbstractMechanicalSystem, t: Array, q: PyTree[Array], args: Args
) -> None:
    """Raise if a function of the system returns a wrong shape or dtype."""
    n, dtype = system.manifold_of(q).dim, jax.tree.leaves(q)[0].dtype
    u = jax.ShapeDtypeStruct((n,), dtype)

    def few(shape):
        return shape == () or (len(shape) == 1 and 1 <= shape[0] <= n)

    letter = system.fibre_coordinate_name
    summed = f" Sum over the coordinates, as in `0.5 * {letter} @ {letter}`."
    each = " Give one component for each coordinate."
    expected = {
        system.generator: ("shape (), a scalar", lambda shape: shape == (), summed),
        "nonholonomic": (
            f"shape () or (m,) with 1 <= m <= {n}, the number of coordinates",
            few,
            "",
        ),
        "holonomic": (
            f"shape () or (k,) with 1 <= k <= {n}, the number of coordinates",
            few,
            "",
        ),
        "force": (f"shape ({n},)", lambda shape: shape == (n,), each),
    }
    # The number of multipliers is known once the constraints have been checked.
    multiplier = None
    functions = system.functions(t, q, u, multiplier, args)
    for name in functions:
        if name == "force" and system.force_takes_multipliers:
            multiplier = eqx.filter_eval_shape(system.constraint, t, q, u, args)
            functions = system.functions(t, q, u, multiplier, args)
        function, arguments = functions[name]
        wanted, fits, advice = expected[name]
        called = f"`{name}({', '.join(system.signatures()[name])})`"
        out = eqx.filter_eval_shape(function, *arguments)
        shape = getattr(out, "shape", None)
        if shape is None:
            raise ShapeError(
                f"{called} must return an array of {wanted}, got {no_array(out)}"
            )
        if not fits(shape):
            if name == "nonholonomic" and len(shape) == 2:
                advice = f" For constraints A(q) {letter} = 0 return `A @ {letter}`."
            raise ShapeError(
                f"{called} must return {wanted}, got shape {shape}.{advice}"
            )
        if out.dtype != dtype:
            raise DTypeError(
                f"{called} returns dtype {out.dtype}, but `q` has {dtype}: "
                f"{dtype_advice(out.dtype)}"
            )


def check_state(system: AbstractMechanicalSystem, y: State, called: str = "y0") -> None:
    """Raise unless `y` has the shapes and dtypes of a state of `system`.

    `check_multiplier` checks the shape of the multiplier. `called` is the name of `y`
    in messages.
    """
    parts = {name: getattr(y, name) for name in ("p", "v", "q", "multiplier")}
    for name, x in parts.items():
        for leaf in jax.tree.leaves(x, is_leaf=lambda leaf: leaf is None):
            if not eqx.is_array(leaf):
                raise TypeError(
                    f"`{called}.{name}` must be an array, got {reprlib.repr(leaf)} of "
                    f"type {type(leaf).__name__}. Use `initial_state`."
                )
            floating(f"{called}.{name}", leaf)
            if leaf.dtype != y.p.dtype:
                raise DTypeError(
                    f"`{called}.{name}` has dtype {leaf.dtype} and `{called}.p` "
                    f"{y.p.dtype}: all parts of a state must agree. Use "
                    "`initial_state`."
                )
    require_manifold(system, f"{called}.q", y.q)
    advice = (
        f"For many trajectories use `jax.vmap` over `{called}`; the last state of a "
        "solution is `jax.tree.map(lambda x: x[-1], sol.ys)`."
    )
    for name in ("q", "p") if system.manifold is None else ("p",):
        if jnp.ndim(parts[name]) != 1:
            raise ShapeError(
                f"`{called}.{name}` has shape {parts[name].shape}, but a state has "
                f"shape (n,). {advice}"
            )
    manifold = system.manifold_of(y.q)
    manifold.check(y.q)
    for name in ("v", "p"):
        shape = parts[name].shape
        if shape != (manifold.dim,):
            raise ShapeError(
                f"`{called}.{name}` has shape {shape}, but `{called}.q` needs "
                f"({manifold.dim},). Use `initial_state`."
            )
    require_names(system, f"{called}.q", manifold)
    for name, x in parts.items():
        # For traced parts the integration reports each member that is not finite.
        if not is_traced(*jax.tree.leaves(x)):
            require(x, finite(f"{called}.{name}", x))


def check_multiplier(
    system: AbstractMechanicalSystem, y: State, args: Args, called: str = "y0"
) -> None:
    """Raise unless `y` has a multiplier for each constraint of `system`.

    The check traces the user's constraints. Compiled programs run this check only while
    they are traced, so that later calls do not repeat it.
    """
    t = jax.ShapeDtypeStruct((), y.v.dtype)
    u = system.fibre_coordinate(y)
    expected = eqx.filter_eval_shape(system.constraint, t, y.q, u, args).shape
    if y.multiplier.shape != expected:
        raise ShapeError(
            f"`{called}.multiplier` has shape {y.multiplier.shape}, but the "
            f"constraints of the system have shape {expected}. Use `initial_state` "
            "with this system."
        )


def _names(num_nonholonomic: int, num_holonomic: int) -> list[str]:
    """List the names of all constraints, such as "nonholonomic[0]" or "holonomic[2]".

    The rows of the Jacobian ∂Φ/∂u and the multipliers have the same order.
    """
    return [f"nonholonomic[{a}]" for a in range(num_nonholonomic)] + [
        f"holonomic[{a}]" for a in range(num_holonomic)
    ]


def dependence_error(
    jacobian: Float[Array, "l n"],
    num_holonomic: int,
    letter: str,
    where: str,
) -> DependentConstraintsError:
    """Create the error that names the constraints which depend on each other.

    **Arguments:**

    - `jacobian`: the derivatives of all constraints, with the holonomic constraints
        last, or of the holonomic constraints alone.
    - `num_holonomic`: the number k of holonomic constraints.
    - `letter`: the letter of nonholonomic constraints, Φ or Ψ.
    - `where`: the state, as text.
    """
    rows, k = np.asarray(jacobian), num_holonomic
    m = rows.shape[0] - k
    names = _names(m, k)
    zero = [a for a in range(m + k) if not np.any(rows[a])]
    if zero and zero[0] < m:
        advice = (
            f"The derivatives of {names[zero[0]]} with respect to velocities are zero "
            "there. Pass a constraint on positions as `holonomic`. In place of a "
            "square, pass the expression itself: the derivative of a square is zero "
            "where the constraint holds."
        )
    elif zero:
        advice = (
            f"{names[zero[0]]} has no gradient there. In place of a square, pass the "
            "expression itself: the derivative of a square is zero where the "
            "constraint holds."
        )
    elif _rank(rows[:m]) + _rank(rows[m:]) > _rank(rows):
        advice = (
            "One of these nonholonomic constraints follows from holonomic ones: a "
            "holonomic constraint enforces its rate too. Remove it, start from a state "
            "at which it does not follow, or give the system "
            '`constraints="redundant"`.'
        )
    else:
        advice = (
            "Remove redundant constraints, start from a state at which they are "
            'independent, or give the system `constraints="redundant"`.'
        )
    derivatives = " and ".join([f"D2{letter}"] * (m > 0) + ["DΓ"] * (k > 0))
    do = "do" if m > 0 and k > 0 else "does"
    which = dependent_names(jacobian, k)
    return DependentConstraintsError(
        f"The constraints are dependent: {derivatives} {do} not have full rank at "
        f"{where} (the paper's admissibility condition fails for {which}). {advice}"
    )


def dependent_names(matrix: Float[Array, "l c"], num_holonomic: int) -> str:
    """Name the constraints whose rows of a matrix depend on each other.

    The rows of the `num_holonomic` holonomic constraints are the last.
    """
    rows = np.asarray(matrix)
    names = _names(rows.shape[0] - num_holonomic, num_holonomic)
    return enumerated([names[a] for a in dependent_rows(rows)])


def require_independent(
    system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
) -> None:
    """Raise a `DependentConstraintsError` if constraints are dependent at a state.

    With `constraints="redundant"`, only a constraint whose derivative with respect to u
    is zero raises this error.
    """
    u = system.fibre_coordinate(y)
    jacobian = jax.jacrev(system.constraint, argnums=2)(t, y.q, u, args)
    is_redundant = system.constraints == "redundant"
    lacking = has_zero_row if is_redundant else is_deficient
    if jacobian.shape[0] == 0 or not lacking(jacobian):
        return
    k = system.position_constraint(t, y.q, args).shape[0]
    letter = "Φ" if system.fibre_coordinate_name == "v" else "Ψ"
    where = f"q = {y.q}, {system.fibre_coordinate_name} = {u}"
    raise dependence_error(jacobian, k, letter, where)


def describe_inconsistency(
    system: AbstractMechanicalSystem, t: FloatScalar, y: State, args: Args
) -> str:
    """Describe how far a state is from being consistent, in a sentence."""
    parts = []
    values = np.asarray(system.constraint_violation(t, y, args))
    if values.size:
        k = system.position_constraint(t, y.q, args).shape[0]
        m = values.size - 2 * k
        letter = "Φ" if system.fibre_coordinate_name == "v" else "Ψ"
        names = [f"{letter}[{a}]" for a in range(m)]
        names += [f"dΓ[{a}]/dt" for a in range(k)] + [f"Γ[{a}]" for a in range(k)]
        # NaN counts as the largest value.
        worst = int(np.argmax(np.abs(values)))
        parts.append(f"the largest constraint is {names[worst]} = {values[worst]:.3g}")
    u = system.fibre_coordinate(y)
    kind = system.fibre_coordinate_name
    dual, given = (y.p, "p") if kind == "v" else (y.v, "v")
    off = max_norm(dual - system.fibre_derivative(t, y.q, u, args))
    if not off <= 1e3 * jnp.finfo(u.dtype).eps * max_norm(dual):
        parts.append(f"{given} differs from its value for {kind} by {float(off):.3g}")
    off = float(system.manifold_of(y.q).distance_to_group(y.q))
    if not off <= 1e3 * jnp.finfo(u.dtype).eps:
        parts.append(f"q is off the group by {off:.3g}")
    return f"At t = {float(t):.6g}, {enumerated(parts)}." if parts else ""


def _rank(rows: np.ndarray) -> int:
    if not rows.size:
        return 0
    scaled = rows / np.max(np.abs(rows), axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(scaled, rtol=np.finfo(rows.dtype).eps ** 0.5))


def enumerated(names: list[str], conjunction: str = "and") -> str:
    """Write names as a list in a sentence, such as "a, b and c"."""
    first = [", ".join(names[:-1])] if names[1:] else []
    return f" {conjunction} ".join(first + names[-1:])
