"""What functions read beside their arguments, as something that can be compared.

A compiled function keeps the values that globals and closed-over variables had when it
was traced. The entries found here differ as soon as such a value does, so that a cache
of compiled programs can take them as a key.
"""

import argparse
import enum
import hashlib
import types
from collections import deque
from collections.abc import Collection, Hashable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ._names import is_installed, names, Path


# Of a function that reads more than this the rest is not looked at: it would take
# longer than a short run.
MOST_ENTRIES = 2000

_PLAIN = bool | int | str | bytes | None | types.EllipsisType | np.dtype
_SEQUENCES = list | tuple | deque | set | frozenset
_MAPPINGS = dict | types.MappingProxyType
# Of a class that is not the user's, but made to hold what is.
_WITH_PARTS = types.MethodType | partial | _MAPPINGS | _SEQUENCES
_HOLDERS = types.SimpleNamespace | argparse.Namespace | eqx.Module


class Place(NamedTuple):
    """Where a value was read: an object, by identity, and a name or index in it."""

    owner: int
    name: Hashable


class Entry(NamedTuple):
    """A value that a function reads, and where; the owner is held with it.

    `key` is for comparison between calls: with the owner by its number in the order of
    the visit, or -1, where `place` has its identity.
    """

    key: tuple[int, Hashable, Hashable]
    place: Place
    owner: object

    @property
    def atom(self) -> Hashable:
        """The value, as something that can be compared."""
        return self.key[-1]


class Identity:
    """An object that equals itself alone, held so that its identity is not reused."""

    def __init__(self, value: object):
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and self.value is other.value


class Unrepeatable:
    """Equals nothing but itself: what is made with a tracer cannot be used again."""


def captured(tree: Any, ignored: Collection[Place] = ()) -> list[Entry]:
    """What the functions among the leaves of a tree read, but for ignored places.

    The arrays among its leaves are not looked at: they are arguments of what is
    compiled.
    """
    walk = _Walk(ignored)
    walk.arguments(tree)
    return walk.entries


def all_of(owner: object) -> Place:
    """The place that stands for all that is in an object."""
    return Place(id(owner), Ellipsis)


class _Walk:
    def __init__(self, ignored: Collection[Place]):
        self.entries: list[Entry] = []
        self.ignored = ignored
        # What was visited, numbered in order: equal structures have equal numbers.
        # Identities are not reused meanwhile, as the objects are held by the entries.
        self.numbers: dict[int, int] = {}

    def arguments(self, tree: Any) -> None:
        """Note the leaves of a tree that are no arrays, and the code of its classes."""
        nodes = []
        leaves = jax.tree.leaves(tree, is_leaf=lambda node: nodes.append(node))
        is_leaf = set(map(id, leaves))
        for index, node in enumerate(nodes):
            if isinstance(node, jax.Array):
                continue
            if id(node) in is_leaf:
                self.read(tree, index, node)
                continue
            self.methods(type(node))
            if isinstance(node, eqx.Module):
                for name in _static_fields(node):
                    self.read(node, name, vars(node)[name])

    def read(self, owner: object, name: Hashable, value: Any) -> None:
        """Note one value, and what is in it."""
        place = Place(id(owner), name)
        if len(self.entries) >= MOST_ENTRIES:
            return
        if self.ignored and (place in self.ignored or all_of(owner) in self.ignored):
            return
        atom, is_new = _atom(value), False
        if atom is None:
            is_new = id(value) not in self.numbers
            number = self.numbers.setdefault(id(value), len(self.numbers))
            atom = _kind(value), number
        key = (self.numbers.get(id(owner), -1), name, atom)
        self.entries.append(Entry(key, place, owner))
        if is_new:
            self.contents(value)

    def contents(self, value: Any) -> None:
        """Note what is in a value that has parts."""
        if isinstance(value, types.FunctionType):
            self.function(value)
        elif isinstance(value, types.MethodType):
            self.read(value, "__self__", value.__self__)
            self.read(value, "__func__", value.__func__)
        elif isinstance(value, partial):
            for name in ("func", "args", "keywords"):
                self.read(value, name, getattr(value, name))
        elif isinstance(value, _MAPPINGS):
            for key, item in list(value.items()):
                name = key if isinstance(key, _PLAIN) else Identity(key)
                self.read(value, name, item)
        elif isinstance(value, _SEQUENCES):
            for index, item in enumerate(list(value)):
                self.read(value, index, item)
        elif isinstance(value, type):
            self.methods(value)
        elif _is_open(value):
            self.attributes(value)
            self.methods(type(value))
        if hasattr(value, "__wrapped__"):
            self.read(value, "__wrapped__", value.__wrapped__)

    def attributes(self, value: Any) -> None:
        """Note the attributes of an object."""
        for name, item in list(getattr(value, "__dict__", {}).items()):
            self.read(value, name, item)
        for base in type(value).__mro__:
            slots = vars(base).get("__slots__", ())
            for name in (slots,) if isinstance(slots, str) else slots:
                if hasattr(value, name):
                    self.read(value, name, getattr(value, name))

    def methods(self, kind: type) -> None:
        """Note the attributes of a class of the user's and what its methods read."""
        for base in kind.__mro__:
            if is_installed(base.__module__) or id(base) in self.numbers:
                continue
            self.numbers[id(base)] = len(self.numbers)
            for name, item in list(vars(base).items()):
                if isinstance(item, property):
                    item = item.fget
                elif isinstance(item, staticmethod | classmethod):
                    item = item.__func__
                if isinstance(item, types.FunctionType):
                    # That which a dataclass generates reads nothing of the user's.
                    if item.__code__.co_filename != "<string>":
                        self.read(base, name, item)
                elif not (name.startswith("__") or name == "_abc_impl"):
                    self.read(base, name, item)

    def function(self, function: types.FunctionType) -> None:
        """Note what a function closes over, its defaults, and the globals it reads."""
        code, variables = function.__code__, function.__globals__
        found = names(code)
        for name, cell in zip(
            code.co_freevars, function.__closure__ or (), strict=True
        ):
            for path in found.closed_over.get(name, ()):
                try:
                    self.chain(cell, "content", cell.cell_contents, path)
                except ValueError:
                    # It has no value yet.
                    break
        self.read(function, "defaults", function.__defaults__)
        self.read(function, "kwdefaults", function.__kwdefaults__)
        # The globals of a library are its own, and stay.
        if is_installed(str(variables.get("__name__", ""))):
            return
        for name, paths in found.of_globals.items():
            for path in paths if name in variables else ():
                self.chain(variables, name, variables[name], path)

    def chain(self, owner: object, name: str, value: Any, path: Path) -> None:
        """Note `value.a.b`, as far as it leads through modules of the user's."""
        self.read(owner, name, value)
        for attribute in path:
            if not isinstance(value, types.ModuleType) or is_installed(value.__name__):
                return
            if attribute not in vars(value):
                return
            owner, value = value, vars(value)[attribute]
            self.read(owner, attribute, value)


def _kind(value: Any) -> Hashable:
    """What tells values with parts apart, beside their parts."""
    if isinstance(value, types.FunctionType):
        return value.__code__
    is_known = isinstance(value, _WITH_PARTS) or _is_open(value)
    return type(value) if is_known else Identity(value)


def _atom(value: Any) -> Hashable | None:
    """A value that has no parts, with its type; None if it may have some."""
    if isinstance(value, enum.Enum):
        return Identity(value)
    if isinstance(value, _PLAIN):
        return type(value), value
    if isinstance(value, float):
        # Zeros of both signs differ, and not a number equals itself.
        return type(value), float.hex(value)
    if isinstance(value, complex):
        return type(value), repr(value)
    if isinstance(value, jax.core.Tracer):
        return Unrepeatable()
    if isinstance(value, np.generic | np.ndarray) and not value.dtype.hasobject:
        # Such an array can be changed in place; one of JAX's cannot.
        digest = hashlib.blake2b(value.tobytes(), digest_size=16).digest()
        return type(value), value.dtype, value.shape, digest
    if isinstance(value, type):
        return Identity(value) if is_installed(value.__module__) else None
    if isinstance(value, types.FunctionType | _WITH_PARTS) or _is_open(value):
        return None
    return None if hasattr(value, "__wrapped__") else Identity(value)


def _is_open(value: Any) -> bool:
    """Whether the attributes of an object are looked at: not those of libraries'."""
    if isinstance(value, jax.Array | types.ModuleType | type):
        return False
    return isinstance(value, _HOLDERS) or not is_installed(type(value).__module__)


def _static_fields(module: eqx.Module) -> list[str]:
    return [
        name
        for name, field in module.__dataclass_fields__.items()
        if field.metadata.get("static", False) and name in vars(module)
    ]
