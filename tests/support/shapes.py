"""Annotations of shapes that are checked while functions run."""

import pkgutil
from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

from beartype import beartype, BeartypeConf
from beartype.roar import BeartypeDecorHintException


# An int counts as a float, as for type checkers.
_checked = beartype(conf=BeartypeConf(is_pep484_tower=True))


# These rooms transform programs and write native code.
WITHOUT_SHAPES = ("nhjax._compile", "nhjax.lanes")


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function with its annotations checked, if the checker supports them.

    It does not support generic named tuples.
    """
    try:
        return _checked(function)
    except BeartypeDecorHintException:
        return function


def rooms_with_shapes() -> list[str]:
    """All rooms but WITHOUT_SHAPES, which have no shapes and make many calls."""
    package = find_spec("nhjax")
    assert package is not None
    rooms = pkgutil.iter_modules(package.submodule_search_locations, "nhjax.")
    return [room.name for room in rooms if room.name not in WITHOUT_SHAPES]
