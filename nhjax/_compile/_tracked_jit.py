"""Compilation that knows of the globals and closed-over variables of functions."""

import inspect
from collections import deque
from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, TypeVar

import equinox as eqx

from ._captured import all_of, captured, Entry, Place, Unrepeatable


T = TypeVar("T")

# How many of what is remembered below; if there are more, all is forgotten, and what is
# still used is traced once more.
_MOST = 1000


class _Key:
    """What functions read, and whether a program was traced with it just now."""

    def __init__(self, atoms: tuple[Hashable, ...]):
        self.atoms = atoms
        self.hash = hash(atoms)
        self.is_traced = False

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.atoms == other.atoms


# What changes while functions are traced, such as a list in which they count their
# calls, is not looked at: they would be traced anew for ever. Its owners are held, so
# that their identities are not reused.
_unsteady: dict[Place, object] = {}
# The key that a program was traced with, by what it became while that was done.
_earlier: dict[_Key, _Key] = {}


def tracked_jit(*tracked: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """As `equinox.filter_jit`, but traced anew if what functions read has changed.

    **Arguments:**

    - `tracked`: the names of the arguments in which functions of the user's are.
    """

    def decorator(function: Callable[..., T]) -> Callable[..., T]:
        positions = list(inspect.signature(function).parameters)
        which = [positions.index(name) for name in tracked]

        @eqx.filter_jit
        def compiled(key: _Key, *args: Any) -> T:
            key.is_traced = True
            return function(*args)

        @wraps(function)
        def call(*args: Any) -> T:
            functions = [args[position] for position in which]
            before = captured(functions, _unsteady)
            key = _key(before)
            key = _earlier.get(key, key)
            out = compiled(key, *args)
            if key.is_traced:
                key.is_traced = False
                _learn(key, before, functions)
            return out

        return call

    return decorator


def _key(entries: list[Entry]) -> _Key:
    return _Key(tuple(entry.key for entry in entries))


def _learn(key: _Key, before: list[Entry], functions: Any) -> None:
    """Find what tracing changed, and let what it became count as what it was."""
    after = captured(functions, _unsteady)
    changed = _changed(before, after)
    if not changed:
        return
    for memory in (_unsteady, _earlier):
        if len(memory) > _MOST:
            memory.clear()
    _unsteady.update(changed)
    _earlier[_key(captured(functions, _unsteady))] = key


def _changed(before: list[Entry], after: list[Entry]) -> dict[Place, object]:
    """The places at which entries differ, with their owners."""
    atoms = [{entry.place: entry for entry in entries} for entries in (before, after)]
    changed = {}
    for one, other in (atoms, atoms[::-1]):
        for place, entry in one.items():
            there = other.get(place)
            if isinstance(entry.content, Unrepeatable):
                continue
            if there is None and isinstance(entry.owner, list | set | deque):
                # Of what grows, the next element would be unknown again.
                place = all_of(entry.owner)
            if there is None or there.content != entry.content:
                changed[place] = entry.owner
    return changed
