"""Compilation that notices changes of globals and closed-over variables."""

import inspect
from collections import deque
from collections.abc import Callable, Hashable
from functools import wraps
from typing import Any, TypeVar

import equinox as eqx

from ._captured import all_of, captured, Entry, Place, Unrepeatable
from ._collection import rare_collections


T = TypeVar("T")

# The largest number of entries in each of the two dictionaries below. If there are
# more, all are forgotten, and programs that are still used are traced once more.
_MOST = 1000


class _Key:
    """The values that functions read, as a key for compiled programs.

    `is_traced` tells whether a program has just been traced with this key.
    """

    def __init__(self, atoms: tuple[Hashable, ...]):
        self.atoms = atoms
        self.hash = hash(atoms)
        self.is_traced = False

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.atoms == other.atoms


# Values that change while functions are traced, such as a list in which they count
# their calls, are ignored: otherwise the functions would be traced anew for ever. Their
# places are kept with the objects that own them, so that the identities of these are
# not reused.
_unsteady: dict[Place, object] = {}
# The key that a program was traced with, found by what that key had become at the end
# of tracing.
_earlier: dict[_Key, _Key] = {}


def tracked_jit(*tracked: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Compile like `equinox.filter_jit`, and trace anew if what functions read changes.

    It makes a decorator for a function that is called with positional arguments.

    **Arguments:**

    - `tracked`: the names of the arguments that contain functions of the user.
    """

    def decorator(function: Callable[..., T]) -> Callable[..., T]:
        positions = list(inspect.signature(function).parameters)
        which = [positions.index(name) for name in tracked]

        @eqx.filter_jit
        def compiled(key: _Key, *args: Any) -> T:
            key.is_traced = True
            with rare_collections():
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
    """Remember what tracing changed, so that the program is found again afterwards.

    The changed places are ignored from now on, and the key as it is after tracing
    stands for the one as it was before.
    """
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
    """Find the places at which two lists of entries differ, with their owners."""
    atoms = [{entry.place: entry for entry in entries} for entries in (before, after)]
    changed = {}
    for one, other in (atoms, atoms[::-1]):
        for place, entry in one.items():
            there = other.get(place)
            if isinstance(entry.content, Unrepeatable):
                continue
            if there is None and isinstance(entry.owner, list | set | deque):
                # The container grows, so that its next element would be new again.
                place = all_of(entry.owner)
            if there is None or there.content != entry.content:
                changed[place] = entry.owner
    return changed
