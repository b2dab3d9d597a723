"""Checks of the shapes and types of a state and of the functions of a system."""

import reprlib

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._custom_types import Args
from .._errors import DTypeError, is_traced, require, ShapeError
from .._manifold import AbstractLieGroup
from ._abstract import AbstractMechanicalSystem
from ._arguments import dtype_advice, finite, floating, no_array
from ._state import State


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
    """Raise a `ShapeError` unless there is one name for each coordinate, or none."""
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
    for name, (function, arguments) in system.functions(t, q, u, args).items():
        wanted, fits, advice = expected[name]
        called = f"`{name}({', '.join(system.signatures()[name])})`"
        out = eqx.filter_eval_shape(function, *arguments)
        shape = getattr(out, "shape", None)
        if shape is None:
            raise ShapeError(
                f"{called} must return an array of {wanted}, got {no_array(out)}"
            )
        if not fits(shape):
            raise ShapeError(
                f"{called} must return {wanted}, got shape {shape}.{advice}"
            )
        if out.dtype != dtype:
            raise DTypeError(
                f"{called} returns dtype {out.dtype}, but `q` has {dtype}: "
                f"{dtype_advice(out.dtype)}"
            )


def check_state(
    system: AbstractMechanicalSystem, y: State, args: Args, called: str = "y0"
) -> None:
    """Raise unless the shapes and dtypes of `y` are those of a state of `system`.

    Messages call it `called`.
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
    t = jnp.zeros((), y.v.dtype)
    u = system.fibre_coordinate(y)
    expected = eqx.filter_eval_shape(system.constraint, t, y.q, u, args).shape
    if y.multiplier.shape != expected:
        raise ShapeError(
            f"`{called}.multiplier` has shape {y.multiplier.shape}, but the "
            f"constraints of the system have shape {expected}. Use `initial_state` "
            "with this system."
        )
    for name, x in parts.items():
        # The integration itself reports traced parts that are not finite, lane by lane.
        if not is_traced(*jax.tree.leaves(x)):
            require(x, finite(f"{called}.{name}", x))
