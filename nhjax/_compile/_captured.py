"""The values that functions read beside their arguments, in a form to be compared.

A compiled function keeps the values that globals and closed-over variables had when it
was traced. The entries found here differ as soon as such a value does, so that a cache
of compiled programs can take them as a key.
"""

import hashlib
import types
from collections.abc import Collection, Hashable
from functools import lru_cache
from typing import Any, NamedTuple

import jax

from ._kinds import Kind, kind_of
from ._names import is_installed, names, Path


# If functions read more values than this, the rest is ignored: to compare it would take
# longer than a short run.
MOST_ENTRIES = 2000


class Place(NamedTuple):
    """The place where a value was read: an object's identity, and a name or index."""

    owner: int
    name: Hashable


class Entry(NamedTuple):
    """A value that a function reads, with the place where it does so.

    The owner, the object in which the value was found, is kept so that its identity is
    not reused. `key` serves for comparison between calls: it has the owner's number in
    the order of the visit, or -1, where `place` has the owner's identity. `content`
    serves for comparison within a call: a value that has parts stands there for itself,
    whatever its number.
    """

    key: tuple[int, Hashable, Hashable]
    place: Place
    owner: object
    content: Hashable

    @property
    def atom(self) -> Hashable:
        """Return the value in a form that can be compared and hashed."""
        return self.key[-1]


class Identity:
    """A wrapper of an object by which two are equal only if they hold the same object.

    The object is kept, so that its identity is not reused.
    """

    def __init__(self, value: object):
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and self.value is other.value


class Unrepeatable:
    """A value that equals nothing but itself, which stands for a tracer.

    A program that was made with a tracer cannot be used again.
    """


def captured(tree: Any, ignored: Collection[Place] = ()) -> list[Entry]:
    """List what the functions among the leaves of a tree read, except ignored places.

    The arrays among the leaves are left out, because they are arguments of the compiled
    program.
    """
    walk = _Walk(ignored)
    walk.arguments(tree)
    return walk.entries


def all_of(owner: object) -> Place:
    """Make the place that stands for everything inside of an object."""
    return Place(id(owner), Ellipsis)


class _Walk:
    def __init__(self, ignored: Collection[Place]):
        self.entries: list[Entry] = []
        self.ignored = ignored
        # The objects that were visited, by identity, with their numbers in order: equal
        # structures have equal numbers. Identities are not reused meanwhile, as the
        # entries hold the objects.
        self.numbers: dict[int, int] = {}
        # The identities of the classes whose attributes have been recorded.
        self.searched: set[int] = set()

    def arguments(self, tree: Any) -> None:
        """Record static fields, leaves that are no arrays, and the code of classes."""
        nodes = []

        def note(node: Any) -> bool:
            nodes.append(node)
            return False

        leaves = jax.tree.leaves(tree, is_leaf=note)
        leaf_ids = set(map(id, leaves))
        for index, node in enumerate(nodes):
            kind = kind_of(type(node))
            if kind is Kind.ARRAY or kind is Kind.TRACER:
                continue
            if id(node) in leaf_ids:
                self.read(tree, index, node)
            elif kind is Kind.OPEN:
                self.methods(type(node))
                variables = _variables(node)
                for name in _static_fields(type(node)):
                    if name in variables:
                        self.read(node, name, variables[name])

    def read(self, owner: object, name: Hashable, value: Any) -> None:
        """Record one value, and the values inside of it."""
        place = Place(id(owner), name)
        if len(self.entries) >= MOST_ENTRIES:
            return
        if self.ignored and (place in self.ignored or all_of(owner) in self.ignored):
            return
        kind, is_new = kind_of(type(value)), False
        atom = content = _atom(value, kind)
        if atom is None:
            content = Identity(value)
            is_new = id(value) not in self.numbers
            number = self.numbers.setdefault(id(value), len(self.numbers))
            atom = _name(value, kind), number
        key = (self.numbers.get(id(owner), -1), name, atom)
        self.entries.append(Entry(key, place, owner, content))
        if is_new:
            self.contents(value, kind)

    def contents(self, value: Any, kind: Kind) -> None:
        """Record the values inside of a value that has parts."""
        if kind is Kind.FUNCTION:
            self.function(value)
        elif kind is Kind.MAPPING:
            for key, item in list(value.items()):
                name = key if kind_of(type(key)) is Kind.PLAIN else Identity(key)
                self.read(value, name, item)
        elif kind is Kind.SEQUENCE or kind is Kind.NUMPY:
            for index, item in enumerate(list(value)):
                self.read(value, index, item)
        elif kind is Kind.METHOD:
            self.named(value, ("__self__", "__func__"))
        elif kind is Kind.PARTIAL:
            self.named(value, ("func", "args", "keywords"))
        elif kind is Kind.CLASS:
            self.methods(value)
        elif kind is Kind.OPEN:
            self.attributes(value)
            self.methods(type(value))
        # Decorators keep the function that they wrap under this name. The result of
        # `jax.jit` is an object of a library's class, and so opaque.
        if kind is Kind.FUNCTION or kind is Kind.OPAQUE:
            self.named(value, ("__wrapped__",))

    def named(self, value: Any, attributes: Collection[str]) -> None:
        """Record those of the named attributes that the value has."""
        for name in attributes:
            if hasattr(value, name):
                self.read(value, name, getattr(value, name))

    def attributes(self, value: Any) -> None:
        """Record the attributes of an object, those in slots included."""
        for name, item in list(_variables(value).items()):
            self.read(value, name, item)
        for base in type(value).__mro__:
            slots = vars(base).get("__slots__", ())
            self.named(value, (slots,) if isinstance(slots, str) else tuple(slots))

    def methods(self, kind: type) -> None:
        """Record the attributes of a user's class, and what its methods read."""
        for base in kind.__mro__:
            if is_installed(base.__module__) or id(base) in self.searched:
                continue
            self.searched.add(id(base))
            # A class that a function reads has a number before it is searched.
            self.numbers.setdefault(id(base), len(self.numbers))
            for name, item in list(vars(base).items()):
                if isinstance(item, property):
                    item = item.fget
                elif isinstance(item, staticmethod | classmethod):
                    item = item.__func__
                if isinstance(item, types.FunctionType):
                    # Methods that a dataclass generates read nothing of the user's.
                    if item.__code__.co_filename != "<string>":
                        self.read(base, name, item)
                elif not (name.startswith("__") or name == "_abc_impl"):
                    self.read(base, name, item)

    def function(self, function: types.FunctionType) -> None:
        """Record what a function closes over, its defaults, and globals it reads."""
        code, variables = function.__code__, function.__globals__
        found = names(code)
        cells = function.__closure__ or ()
        for name, cell in zip(code.co_freevars, cells, strict=True):
            for path in found.closed_over.get(name, ()):
                try:
                    content = cell.cell_contents
                except ValueError:
                    # The closed-over variable has no value yet.
                    break
                self.chain(cell, "content", content, path)
        if function.__defaults__:
            self.read(function, "defaults", function.__defaults__)
        if function.__kwdefaults__:
            self.read(function, "kwdefaults", function.__kwdefaults__)
        # The globals of a library are its own, and taken to stay the same.
        if is_installed(str(variables.get("__name__", ""))):
            return
        for name, paths in found.of_globals.items():
            for path in paths if name in variables else ():
                self.chain(variables, name, variables[name], path)

    def chain(self, owner: object, name: str, value: Any, path: Path) -> None:
        """Record `value` and the path `value.a.b` through modules of the user."""
        self.read(owner, name, value)
        for attribute in path:
            if not isinstance(value, types.ModuleType) or is_installed(value.__name__):
                return
            if attribute not in vars(value):
                return
            owner, value = value, vars(value)[attribute]
            self.read(owner, attribute, value)


def _atom(value: Any, kind: Kind) -> Hashable | None:
    """Return a value without parts, with its type; None if the value may have parts."""
    if kind is Kind.PLAIN:
        return type(value), value
    if kind is Kind.FLOAT:
        # In hexadecimal form zeros of different signs differ, and NaN equals itself.
        return type(value), float.hex(value)
    if kind is Kind.COMPLEX:
        return type(value), repr(value)
    if kind is Kind.TRACER:
        return Unrepeatable()
    if kind is Kind.NUMPY and not value.dtype.hasobject:
        # An array of NumPy can be changed in place, so that its contents are compared;
        # an array of JAX cannot.
        digest = hashlib.blake2b(value.tobytes(), digest_size=16).digest()
        return type(value), value.dtype, value.shape, digest
    is_closed = kind is Kind.OPAQUE and not hasattr(value, "__wrapped__")
    is_library = kind is Kind.CLASS and is_installed(value.__module__)
    if kind is Kind.ARRAY or is_closed or is_library:
        return Identity(value)
    return None


def _name(value: Any, kind: Kind) -> Hashable:
    """Return what distinguishes values with parts, apart from their parts."""
    if kind is Kind.FUNCTION:
        return value.__code__
    if kind is Kind.NUMPY:
        return value.shape
    return Identity(value) if kind in (Kind.CLASS, Kind.OPAQUE) else type(value)


@lru_cache(maxsize=4096)
def _static_fields(cls: type) -> list[str]:
    fields = getattr(cls, "__dataclass_fields__", {}).items()
    return [name for name, field in fields if field.metadata.get("static", False)]


def _variables(value: Any) -> dict[str, Any]:
    """Return the attributes of an object, read in a way that no class can make slow."""
    try:
        return object.__getattribute__(value, "__dict__")
    except AttributeError:
        return {}
