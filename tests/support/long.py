"""Cases of tests that take long, which `pytest -n 2 -m long` runs, as CI does."""

from collections.abc import Iterable
from typing import Any

import pytest


def long(*case: Any, id: str | None = None) -> Any:
    """A case of a test that takes long."""
    return pytest.param(*case, id=id, marks=pytest.mark.long)


def long_but(short: Iterable[Any], cases: Iterable[Any]) -> list[Any]:
    """The cases, of which all but the short ones take long.

    Those that stay among the quick tests cover what the test is about: each kind of
    system or method that takes another way through the library.
    """
    cases, short = list(cases), list(short)
    missing = [case for case in short if case not in cases]
    assert not missing, f"no such cases: {missing}"
    return [case if case in short else _long_one(case) for case in cases]


def _long_one(case: Any) -> Any:
    # A named tuple is one argument, a plain one holds several.
    return long(*case) if type(case) is tuple else long(case)
