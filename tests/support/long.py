"""Test cases that do not belong to the quick ones.

CI runs the long ones with `pytest -n 2 -m long`. Exhaustive ones are the remaining
combinations of parameters; `pytest -n 2 -m exhaustive` runs them.
"""

from collections.abc import Iterable
from typing import Any

import pytest


def long(*case: Any, id: str | None = None) -> Any:
    """A test case that takes long."""
    return pytest.param(*case, id=id, marks=pytest.mark.long)


def exhaustive(*case: Any) -> Any:
    """A test case whose code paths in the library are also taken by other cases."""
    return pytest.param(*case, marks=pytest.mark.exhaustive)


def exhaustive_but(short: Iterable[Any], cases: Iterable[Any]) -> list[Any]:
    """The cases, of which all but the short ones are exhaustive.

    The short ones cover each kind of system or method that takes a different path
    through the library.
    """
    cases, short = list(cases), list(short)
    missing = [case for case in short if case not in cases]
    assert not missing, f"no such cases: {missing}"
    # A named tuple is one argument; a plain tuple holds several arguments.
    return [
        case
        if case in short
        else exhaustive(*(case if type(case) is tuple else (case,)))
        for case in cases
    ]
