"""Annotations of shapes that are checked while functions run."""

import pkgutil
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from beartype import beartype, BeartypeConf
from beartype.roar import BeartypeDecorHintException


# An int is a float, as type checkers have it.
_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))


# They transform programs and write native code.
WITHOUT_SHAPES = ("nhjax._compile", "nhjax.lanes")


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its annotations checked, where the checker knows their kind.

    It knows no generic named tuples.
    """
    try:
        return _checked(function)
    except BeartypeDecorHintException:
        return function


def rooms_with_shapes() -> list[str]:
    """All rooms but the two that transform programs: no shapes, and many calls."""
    package = find_spec("nhjax")
    assert package is not None
    rooms = pkgutil.iter_modules(package.submodule_search_locations, "nhjax.")
    return [room.name for room in rooms if room.name not in WITHOUT_SHAPES]
