"""Sequences that are split by marks, and merged again."""

from collections.abc import Iterable
from typing import Any


def split(marks: Iterable[bool], xs: Iterable[Any]) -> tuple[list[Any], list[Any]]:
    """Split a sequence into the entries whose mark is true, and the other entries."""
    pairs = list(zip(marks, xs, strict=True))
    return [x for mark, x in pairs if mark], [x for mark, x in pairs if not mark]


def merged(
    marks: Iterable[bool], marked: Iterable[Any], others: Iterable[Any]
) -> list[Any]:
    """Merge two sequences that `split` made, in the original order."""
    marked, others = iter(marked), iter(others)
    return [next(marked) if mark else next(others) for mark in marks]
