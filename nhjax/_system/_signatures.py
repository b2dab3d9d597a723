"""Whether a function of the user takes the arguments that it will be called with."""

import inspect
from collections.abc import Callable
from types import MethodType
from typing import Any


def check_signature(owner: Any, name: str, arguments: tuple[str, ...]) -> None:
    """Raise a `TypeError` unless the function `name` of `owner` takes `arguments`."""
    function, kind = getattr(owner, name), type(owner).__name__
    expected = f"({', '.join(arguments)})"
    if not callable(function):
        raise TypeError(
            f"{kind}: `{name}` must be a function of {expected}, got {function!r}."
        )
    signature = _signature(function)
    if signature is not None and not _takes(signature, arguments):
        raise TypeError(
            f"{kind}: `{name}` must take {expected}, but "
            f"`{_name(function)}{signature}` does not."
        )


def _signature(function: Callable[..., Any]) -> inspect.Signature | None:
    """The signature by which a function is called, None where it cannot be known.

    Not that of a function that it wraps, whose arguments need not be the same, unless
    it has none of its own, such as the outcome of `jax.jit`.
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
        # Types would make a message long.
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


def _name(function: Callable[..., Any]) -> str:
    return getattr(function, "__name__", type(function).__name__)
