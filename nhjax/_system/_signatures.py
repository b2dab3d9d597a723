"""Checks of the arguments of a user's functions, and of the options of a system."""

import inspect
from collections.abc import Callable
from types import MethodType
from typing import Any

from .._errors import check_choice
from .._manifold import AbstractLieGroup


def check_signature(
    owner: str, name: str, function: object, arguments: tuple[str, ...]
) -> None:
    """Raise a `TypeError` unless a function of the user takes `arguments`.

    It is called by position. A function that gives a place to an argument of another
    name is accepted, but one that takes two of the names in each other's places is not.

    **Arguments:**

    - `owner`, `name`: what the message calls the object or function of nhjax that is
        given the function, and the argument by which it is given.
    - `function`: the function.
    - `arguments`: the names of its arguments, in their order.
    """
    expected = f"({', '.join(arguments)})"
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


def check_constraints(owner: Any) -> None:
    """Raise a `ValueError` unless the option `constraints` of `owner` is known."""
    name = f"{type(owner).__name__}: `constraints`"
    check_choice(name, owner.constraints, ("independent", "redundant"))


def check_manifold(owner: Any) -> None:
    """Raise a `TypeError` unless the `manifold` of `owner` is one, or None."""
    manifold = owner.manifold
    if not isinstance(manifold, AbstractLieGroup | None):
        is_class = isinstance(manifold, type)
        got = f"the class; write {manifold.__name__}()" if is_class else repr(manifold)
        raise TypeError(
            f"{type(owner).__name__}: `manifold` must be an nhjax manifold such as "
            f"nhjax.Euclidean(3), got {got}."
        )


def check_coordinates(owner: Any) -> None:
    """Raise unless the names of the coordinates of `owner` are names, or None."""
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
            f"{type(owner).__name__}: `coordinates` has a name twice: {names}."
        )


def _signature(function: Callable[..., Any]) -> inspect.Signature | None:
    """Find the signature by which a function is called, or None if it is not known.

    For a function that wraps another, the signature of the wrapper counts, since the
    arguments of the wrapped function may differ. If the wrapper has no signature of its
    own, as the result of `jax.jit`, that of the wrapped function is taken.
    """
    method, of = (
        getattr(function, "__func__", None),
        getattr(function, "__self__", None),
    )
    if method is not None and of is not None:
        # A method of an `equinox.Module` has a type of its own that takes anything.
        function = MethodType(method, of)
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
    """Return whether two or more arguments stand where others are expected."""
    by_position = (
        inspect.Parameter.POSITIONAL_ONLY,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
    )
    given = [x.name for x in signature.parameters.values() if x.kind in by_position]
    pairs = zip(given, arguments, strict=False)
    moved = [name for name, there in pairs if name != there and name in arguments]
    return len(moved) >= 2


def _name(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", type(function).__name__)
