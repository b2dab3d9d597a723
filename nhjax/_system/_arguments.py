"""What can be wrong with a single argument, whatever it is for."""

import reprlib
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import Args, FloatScalar, FloatScalarLike
from .._errors import Check, DTypeError, NonFiniteError, ShapeError


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
