"""What can be wrong with arguments, found before anything is compiled."""

import reprlib
from typing import Any, TYPE_CHECKING, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ._custom_types import Args, FloatScalar, FloatScalarLike
from ._errors import Check, DTypeError, is_traced, NonFiniteError, require, ShapeError


if TYPE_CHECKING:
    from ._state import State
    from ._system import AbstractMechanicalSystem


Kind: TypeAlias = type | tuple[type, ...]


def check_type(name: str, x: object, kind: Kind, advice: str = "") -> None:
    """Raise a `TypeError` unless `x` is a `kind`, or one of several."""
    if isinstance(x, kind):
        return
    if isinstance(x, type):
        got = f"the class itself; write {x.__name__}(...)"
    elif isinstance(getattr(x, "system", None), kind):
        got = f"{type(x).__name__}; pass its attribute `.system`"
    else:
        got = f"{reprlib.repr(x)} of type {type(x).__name__}"
    advice = f" {advice}" if advice else ""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    names = " or ".join(f"nhjax.{kind.__name__}" for kind in kinds)
    raise TypeError(f"`{name}` must be an {names}, got {got}.{advice}")


def check_flag(name: str, x: object) -> bool:
    """`x` as a bool; a string such as "no" would count as true."""
    if not isinstance(x, bool | np.bool_):
        raise TypeError(
            f"`{name}` must be True or False, known when tracing, got "
            f"{reprlib.repr(x)} of type {type(x).__name__}."
        )
    return bool(x)


def floating(name: str, x: Any) -> Array:
    """`x` as an array, or a `DTypeError` if it is not of float32 or float64."""
    try:
        array = jnp.asarray(x)
    except (TypeError, ValueError):
        raise DTypeError(
            f"`{name}` must be an array of floats, got {reprlib.repr(x)} of type "
            f"{type(x).__name__}."
        ) from None
    if array.dtype not in (jnp.float32, jnp.float64):
        raise DTypeError(
            f"`{name}` has dtype {array.dtype}, but float32 or float64 is needed: "
            f"write 1.0 for 1, or convert with `jnp.asarray({name}, float)`."
        )
    return array


def configuration(q: Any) -> PyTree[Array]:
    """`q` as an array, or as a tuple (of tuples) of arrays on a product of groups."""
    if isinstance(q, tuple | list) and any(
        isinstance(part, tuple | list) or getattr(part, "ndim", 0) > 0 for part in q
    ):
        return tuple(configuration(part) for part in q)
    return floating("q", q)


def require_manifold(
    system: "AbstractMechanicalSystem", name: str, q: PyTree[Array]
) -> None:
    """Raise for a tuple in a system that has no manifold to say what it is."""
    if system.manifold is None and isinstance(q, tuple):
        raise ShapeError(
            f"`{name}` is a tuple of {len(q)}, but the system has no `manifold`. Give "
            "it one, such as nhjax.ProductGroup(...), or make one array of "
            f"`{name}`."
        )


def real_scalar(name: str, x: FloatScalarLike, dtype: Any) -> FloatScalar:
    """`x` as a scalar of `dtype`; integers are welcome."""
    array = jnp.asarray(x) if eqx.is_array_like(x) else None
    if array is None or not (
        jnp.issubdtype(array.dtype, jnp.floating)
        or jnp.issubdtype(array.dtype, jnp.integer)
    ):
        raise DTypeError(
            f"`{name}` must be a real number, got {reprlib.repr(x)} of type "
            f"{type(x).__name__}."
        )
    if array.shape != ():
        raise ShapeError(
            f"`{name}` has shape {array.shape}, but a scalar is needed; for several "
            "values use `jax.vmap`."
        )
    return array.astype(dtype)


def finite(name: str, x: Any) -> Check:
    """The check that every number in `x` is finite."""
    return Check(all_finite(x), _not_finite, (name, x))


def _not_finite(name: str, x: Any) -> NonFiniteError:
    return NonFiniteError(f"`{name}` is not finite: {x}.")


def parameters(args: Args) -> Args:
    """`args` with its floats as arrays, so that changing one recompiles nothing."""

    def leaf(path, x):
        if eqx.is_array(x):
            return x
        # Through `float`: a weakly-typed scalar takes part in float32 and float64
        # arithmetic alike.
        if isinstance(x, float):
            return jnp.asarray(float(x))
        try:
            hash(x)
        except TypeError:
            raise TypeError(
                f"`args{jax.tree_util.keystr(path)}` is {reprlib.repr(x)} of type "
                f"{type(x).__name__}: what is no array is compiled in, and must be "
                "hashable for that. Use arrays in a tuple, a list, a dict or an "
                "equinox.Module."
            ) from None
        return x

    return jax.tree_util.tree_map_with_path(leaf, args)


def all_finite(tree: Any) -> Array:
    """Whether every number in `tree` is finite."""
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(leaves))


def check_functions(
    system: "AbstractMechanicalSystem", t: Array, q: PyTree[Array], args: Args
) -> None:
    """Raise unless the functions of the system return what they should."""
    n, dtype = system.manifold_of(q).dim, jax.tree.leaves(q)[0].dtype
    u = jax.ShapeDtypeStruct((n,), dtype)

    def few(shape):
        return shape == () or (len(shape) == 1 and 1 <= shape[0] <= n)

    expected = {
        system.generator: ("shape (), a scalar", lambda shape: shape == ()),
        "nonholonomic": (
            f"shape () or (m,) with 1 <= m <= {n}, the number of coordinates",
            few,
        ),
        "holonomic": (
            f"shape () or (k,) with 1 <= k <= {n}, the number of coordinates",
            few,
        ),
        "force": (f"shape ({n},)", lambda shape: shape == (n,)),
    }
    for name, (function, arguments) in system.functions(t, q, u, args).items():
        wanted, fits = expected[name]
        signature = f"({', '.join(system.signatures()[name])})"
        out = eqx.filter_eval_shape(function, *arguments)
        shape = getattr(out, "shape", None)
        if shape is None:
            raise ShapeError(
                f"`{name}{signature}` must return an array of {wanted}, got "
                f"{reprlib.repr(out)} of type {type(out).__name__}."
            )
        if not fits(shape):
            raise ShapeError(
                f"`{name}{signature}` must return {wanted}, got shape {shape}."
            )
        if out.dtype != dtype:
            raise DTypeError(
                f"`{name}{signature}` returns dtype {out.dtype}, but `q` has "
                f"{dtype}: constants of another precision inside it?"
            )


def check_state(system: "AbstractMechanicalSystem", y0: "State", args: Args) -> None:
    """Raise unless `y0` can be a state of `system`."""
    parts = {name: getattr(y0, name) for name in ("p", "v", "q", "multiplier")}
    for name, x in parts.items():
        for leaf in jax.tree.leaves(x, is_leaf=lambda leaf: leaf is None):
            if not eqx.is_array(leaf):
                raise TypeError(
                    f"`y0.{name}` must be an array, got {reprlib.repr(leaf)} of type "
                    f"{type(leaf).__name__}. Use `initial_state`."
                )
            floating(f"y0.{name}", leaf)
            if leaf.dtype != y0.p.dtype:
                raise DTypeError(
                    f"`y0.{name}` has dtype {leaf.dtype} and `y0.p` {y0.p.dtype}: all "
                    "parts of a state must agree. Use `initial_state`."
                )
    require_manifold(system, "y0.q", y0.q)
    advice = (
        "For many trajectories use `jax.vmap` over `y0`; the last state of a solution "
        "is `jax.tree.map(lambda x: x[-1], sol.ys)`."
    )
    for name in ("q", "p") if system.manifold is None else ("p",):
        if jnp.ndim(parts[name]) != 1:
            raise ShapeError(
                f"`y0.{name}` has shape {parts[name].shape}, but a state has shape "
                f"(n,). {advice}"
            )
    manifold = system.manifold_of(y0.q)
    manifold.check(y0.q)
    for name in ("v", "p"):
        shape = parts[name].shape
        if shape != (manifold.dim,):
            raise ShapeError(
                f"`y0.{name}` has shape {shape}, but `y0.q` needs ({manifold.dim},). "
                "Use `initial_state`."
            )
    t = jnp.zeros((), y0.v.dtype)
    u = system.fibre(y0)
    expected = eqx.filter_eval_shape(system.constraint, t, y0.q, u, args).shape
    if y0.multiplier.shape != expected:
        raise ShapeError(
            f"`y0.multiplier` has shape {y0.multiplier.shape}, but the constraints of "
            f"the system have shape {expected}. Use `initial_state` with this system."
        )
    for name, x in parts.items():
        # Of traced parts the integration itself reports it, lane by lane.
        if not is_traced(*jax.tree.leaves(x)):
            require(x, finite(f"y0.{name}", x))
