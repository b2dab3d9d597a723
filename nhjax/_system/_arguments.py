"""Checks and conversions of single arguments, and of the signatures of functions."""

import inspect
import reprlib
import warnings
from collections.abc import Callable
from types import MethodType
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from .._errors import (
    Check,
    check_choice,
    DTypeError,
    is_traced,
    NonFiniteError,
    ShapeError,
)
from .._manifold import AbstractLieGroup


Kind: TypeAlias = type | tuple[type, ...]


def check_type(name: str, x: object, kind: Kind, advice: str = "") -> None:
    """Raise a `TypeError` unless `x` is an instance of a type in `kind`."""
    if isinstance(x, kind):
        return
    if isinstance(x, type):
        got = f"the class itself; write {x.__name__}(...)"
    elif isinstance(getattr(x, "system", None), kind):
        got = f"{type(x).__name__}; pass its attribute `.system`"
    elif isinstance(x, eqx.Module):
        # The fields are left out, since they would fill the message.
        got = type(x).__name__
    else:
        got = f"{reprlib.repr(x)} of type {type(x).__name__}"
    advice = f" {advice}" if advice else ""
    kinds = kind if isinstance(kind, tuple) else (kind,)
    names = " or ".join(f"nhjax.{kind.__name__}" for kind in kinds)
    raise TypeError(f"`{name}` must be an {names}, got {got}.{advice}")


def check_flag(name: str, x: object) -> bool:
    """Return `x` as a bool, or raise a `TypeError` if it is not True or False."""
    if not isinstance(x, bool | np.bool_):
        known = ", known when tracing" if is_traced(x) else ""
        raise TypeError(
            f"`{name}` must be True or False{known}, got {reprlib.repr(x)} of type "
            f"{type(x).__name__}."
        )
    return bool(x)


def dtype_advice(dtype: Any) -> str:
    """Return advice for a user's function that returns a wrong dtype."""
    if dtype == jnp.bool_:
        return "return the number that must vanish, `a - b` instead of `a == b`."
    if jnp.issubdtype(dtype, jnp.integer):
        return "write 1.0 instead of 1."
    if jnp.issubdtype(dtype, jnp.complexfloating):
        return "take its real part."
    return "write its constants in the precision of the state."


def no_array(x: Any) -> str:
    """Describe what a user's function returned instead of an array, with advice."""
    if x is None:
        return "None: is a `return` missing?"
    if isinstance(x, tuple | list):
        return f"a {type(x).__name__} of {len(x)}: join its parts with `jnp.stack`."
    return f"{reprlib.repr(x)} of type {type(x).__name__}."


def floating(name: str, x: Any) -> Array:
    """Return `x` as an array of float32 or float64, or raise a `DTypeError`."""
    try:
        array = jnp.asarray(x)
    except (TypeError, ValueError):
        raise DTypeError(
            f"`{name}` must be an array of floats, got {reprlib.repr(x)} of type "
            f"{type(x).__name__}."
        ) from None
    if array.dtype not in (jnp.float32, jnp.float64):
        advice = f"convert it with `jnp.asarray({name}, float)`."
        if jnp.issubdtype(array.dtype, jnp.integer):
            advice = f"write 1.0 instead of 1, or {advice}"
        elif jnp.issubdtype(array.dtype, jnp.complexfloating):
            advice = f"if its imaginary part is zero, pass `{name}.real`."
        raise DTypeError(
            f"`{name}` has dtype {array.dtype}, but float32 or float64 is needed: "
            f"{advice}"
        )
    return array


def configuration(q: Any) -> PyTree[Array]:
    """Convert `q` to an array or, on a product of groups, to a tuple of arrays."""
    if isinstance(q, tuple | list) and any(
        isinstance(part, tuple | list) or getattr(part, "ndim", 0) > 0 for part in q
    ):
        return tuple(configuration(part) for part in q)
    return floating("q", q)


def real_scalar(name: str, x: FloatScalarLike, dtype: Any) -> FloatScalar:
    """Convert a real number (or an integer) to a scalar array of `dtype`.

    Other types raise a `DTypeError`. Arrays that are not scalars raise a `ShapeError`.
    """
    # A concrete number stays concrete inside `jit`, and its conversion on the host
    # needs no compilation.
    array: Any = None
    if eqx.is_array_like(x):
        array = x if is_traced(x) else np.asarray(x)
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
    if is_traced(array):
        return array.astype(dtype)
    with jax.ensure_compile_time_eval():
        return jax.device_put(array.astype(dtype))


def real_vector(name: str, x: Any, dtype: Any) -> Float[Array, " k"]:
    """Convert an array of real numbers of shape (k,), k >= 1, to an array of `dtype`.

    Other types raise a `DTypeError`. Arrays of other shapes raise a `ShapeError`.
    """
    array: Any = x if is_traced(x) else np.asarray(x)
    if not (
        jnp.issubdtype(array.dtype, jnp.floating)
        or jnp.issubdtype(array.dtype, jnp.integer)
    ):
        raise DTypeError(
            f"`{name}` must have real numbers, got {reprlib.repr(x)} of dtype "
            f"{array.dtype}."
        )
    if array.ndim != 1 or array.shape[0] == 0:
        raise ShapeError(f"`{name}` must have shape (k,), k >= 1, got {array.shape}.")
    if is_traced(array):
        return array.astype(dtype)
    with jax.ensure_compile_time_eval():
        return jax.device_put(array.astype(dtype))


def finite(name: str, x: Any) -> Check:
    """Create the check that every number in `x` is finite."""
    return Check(all_finite(x), _not_finite, (name, x))


def _not_finite(name: str, x: Any) -> NonFiniteError:
    return NonFiniteError(f"`{name}` is not finite: {x}.")


def parameter(value: ArrayLike) -> Array:
    """Convert a parameter to an array, so that changing it does not recompile.

    A Python or NumPy scalar becomes a weakly-typed float, so that it takes part in
    float32 and float64 arithmetic, even with strict dtype promotion.
    """
    if isinstance(value, (int, float, np.number)):
        return jnp.asarray(float(value))
    if isinstance(value, str):
        raise TypeError(f"A parameter must be a number, got {value!r} of type str.")
    return jnp.asarray(value)


def parameters(args: Args) -> Args:
    """Convert the floats in `args` to arrays, so that changing them does not recompile.

    Arrays stay as they are. All other values are compiled in, and raise a `TypeError`
    if they are not hashable.
    """

    def leaf(path, x):
        if eqx.is_array(x):
            return x
        if isinstance(x, float):
            return parameter(x)
        try:
            hash(x)
        except TypeError:
            raise TypeError(
                f"`args{jax.tree_util.keystr(path)}` is {reprlib.repr(x)} of type "
                f"{type(x).__name__}: values that are not arrays are compiled in, "
                "and must be hashable. Use arrays in a tuple, a list, a dict or an "
                "equinox.Module."
            ) from None
        return x

    return jax.tree_util.tree_map_with_path(leaf, args)


def all_finite(tree: Any) -> BoolScalar | np.bool_:
    """Return whether every number in `tree` is finite."""
    leaves = jax.tree.leaves(tree)
    if not is_traced(*leaves):
        # NumPy gives a concrete answer inside `jit` too, and needs no compilation.
        finite = [np.all(np.isfinite(np.asarray(leaf))) for leaf in leaves]
        return np.all(finite)
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves]))


def check_signature(
    owner: str, name: str, function: object, arguments: tuple[str, ...]
) -> None:
    """Raise a `TypeError` unless a user's function takes `arguments`.

    The function is called by position, so its arguments may have other names. A
    function in which expected names are interchanged is refused.

    **Arguments:**

    - `owner`, `name`: names for the message: `owner` is the object or function of nhjax
        that receives the user's function, and `name` is the argument.
    - `function`: the function.
    - `arguments`: the names of its arguments, in their order.
    """
    expected = f"({', '.join(arguments)})"
    if isinstance(function, tuple | list) and all(map(callable, function)):
        joined = f"`jnp.hstack([f{expected}, g{expected}])`"
        advice = f"Join functions f and g by one that returns {joined}."
        if name == "force":
            advice = "Add forces f and g: `nhjax.forces.Sum(f, g)`."
        raise TypeError(
            f"{owner}: `{name}` must be one function of {expected}, got a "
            f"{type(function).__name__} of {len(function)}. {advice}"
        )
    if not callable(function):
        raise TypeError(
            f"{owner}: `{name}` must be a function of {expected}, got {function!r}."
        )
    signature = _signature(function)
    if signature is None:
        return
    called = f"`{_name(function)}{signature}`"
    if not _takes(signature, arguments):
        raise TypeError(
            f"{owner}: `{name}` must take {expected}, but {called} does not."
        )
    if _confuses(signature, arguments):
        raise TypeError(
            f"{owner}: `{name}` must take {expected}, in this order, but {called} has "
            "another order: nhjax passes arguments by position."
        )


def check_third_argument(
    owner: str, name: str, function: Any, arguments: tuple[str, ...], letter: str
) -> None:
    """Raise or warn if a function of a system takes a variable that it never gets.

    The functions of a Lagrangian system receive v, and the functions of a Hamiltonian
    system receive p. Holonomic constraints receive neither v nor p. `letter` is "v" or
    "p".

    For nonholonomic constraints and forces there is only a warning: where the momentum
    equals the velocity, one function can serve both kinds of systems.
    """
    signature = _signature(function)
    given = [] if signature is None else _positional_names(signature)[2:3]
    if name == "holonomic":
        refused, passed = {"v", letter}, "`args`"
        remedy = "Pass a constraint on velocities as `nonholonomic`."
    elif letter == "v":
        refused, passed = {"p"}, "the velocity v"
        remedy = "Write the function in terms of v, and name the argument v."
    else:
        refused, passed = {"v"}, "the momentum p"
        remedy = "Write the function in terms of p, and name the argument p."
        if name == "force":
            remedy += " Forces of nhjax that use velocities need a LagrangianSystem."
    if refused.isdisjoint(given):
        return
    message = (
        f"{owner}: `{name}` must take ({', '.join(arguments)}), but "
        f"`{_name(function)}{signature}` takes {given[0]}: nhjax passes {passed} as "
        f"the third argument. {remedy}"
    )
    if name in ("nonholonomic", "force"):
        warnings.warn(message, stacklevel=2)
    else:
        raise TypeError(message)


def takes_multipliers(force: Any) -> bool:
    """Return whether a force is a function of (t, q, v, multipliers, args).

    If the force has an attribute `takes_multipliers`, its value is returned. Otherwise
    the force takes multipliers if its fourth argument is called `multipliers`, or if it
    can be called with five arguments but not with four.
    """
    stated = getattr(force, "takes_multipliers", None)
    if stated is not None:
        return bool(stated)
    signature = _signature(force) if callable(force) else None
    if signature is None:
        return False
    if "multipliers" in _positional_names(signature)[3:4]:
        return True
    arguments = ("t", "q", "v", "multipliers", "args")
    return _takes(signature, arguments) and not _takes(signature, arguments[1:])


def check_constraints(owner: Any) -> None:
    """Raise a `ValueError` unless the option `constraints` of `owner` is known."""
    name = f"{type(owner).__name__}: `constraints`"
    check_choice(name, owner.constraints, ("independent", "redundant"))
    if owner.constraints == "redundant" and owner.force_takes_multipliers:
        raise ValueError(
            f'{name} cannot be "redundant" with a `force` that takes the multipliers: '
            "the multipliers of redundant constraints are not unique. Remove the "
            "constraints that follow from others."
        )


def check_manifold(owner: Any) -> None:
    """Raise a `TypeError` unless the `manifold` of `owner` is a manifold or None."""
    manifold = owner.manifold
    if not isinstance(manifold, AbstractLieGroup | None):
        is_class = isinstance(manifold, type)
        got = f"the class; write {manifold.__name__}()" if is_class else repr(manifold)
        raise TypeError(
            f"{type(owner).__name__}: `manifold` must be an nhjax manifold such as "
            f"nhjax.Euclidean(3), got {got}."
        )


def check_same_manifold(
    name: str,
    part: object,
    own: AbstractLieGroup | None,
    of_system: AbstractLieGroup | None,
) -> None:
    """Raise a `ValueError` unless a part and its system have manifolds of one type.

    **Arguments:**

    - `name`: the name of the system's argument in which the part was passed.
    - `part`: the part, such as a force or a contact.
    - `own`, `of_system`: the manifold of the part and of the system.
    """
    kinds = (None if x is None or x.is_flat else type(x) for x in (own, of_system))
    if len(set(kinds)) > 1:
        kind = type(part).__name__
        raise ValueError(
            f"`{name}` has a {kind} with the manifold {own}, and the system has "
            f"{of_system}: pass the same `manifold=` to the part, "
            f"{kind}(..., manifold=...)."
        )


def check_coordinates(owner: Any) -> None:
    """Raise unless `coordinates` of `owner` is None or a tuple of different names."""
    names = owner.coordinates
    if names is None:
        return
    if not isinstance(names, tuple) or not all(isinstance(x, str) for x in names):
        raise TypeError(
            f"{type(owner).__name__}: `coordinates` must be a tuple of names, such "
            f"as ('x', 'y'), got {names!r}."
        )
    if len(set(names)) != len(names):
        raise ValueError(
            f"{type(owner).__name__}: `coordinates` has a name twice: {names}. Give "
            "each coordinate its own name."
        )


def _signature(function: Callable[..., Any]) -> inspect.Signature | None:
    """Return the signature by which a function is called, or None if it is not known.

    If a function wraps another, the signature of the wrapper is used, since the wrapped
    function may take other arguments. A wrapper without a signature, such as the result
    of `jax.jit`, has the signature of the wrapped function.
    """
    method = getattr(function, "__func__", None)
    instance = getattr(function, "__self__", None)
    if method is not None and instance is not None:
        # equinox wraps methods in a class whose signature accepts all arguments.
        function = MethodType(method, instance)
    for follow in (False, True):
        try:
            signature = inspect.signature(function, follow_wrapped=follow)
        except (TypeError, ValueError):
            continue
        # Annotations are left out, since they would make the message long.
        bare = [
            parameter.replace(annotation=inspect.Parameter.empty)
            for parameter in signature.parameters.values()
        ]
        return inspect.Signature(bare)
    return None


def _takes(signature: inspect.Signature, arguments: tuple[str, ...]) -> bool:
    try:
        signature.bind(*arguments)
    except TypeError:
        return False
    return True


def _confuses(signature: inspect.Signature, arguments: tuple[str, ...]) -> bool:
    """Return whether two or more of the expected names are at wrong positions."""
    pairs = zip(_positional_names(signature), arguments, strict=False)
    moved = [name for name, there in pairs if name != there and name in arguments]
    return len(moved) >= 2


def _positional_names(signature: inspect.Signature) -> list[str]:
    by_position = (
        inspect.Parameter.POSITIONAL_ONLY,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
    )
    return [x.name for x in signature.parameters.values() if x.kind in by_position]


def _name(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", type(function).__name__)
