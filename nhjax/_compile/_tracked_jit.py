"""Compilation that notices changes of globals and closed-over variables.

A function compiled by `jax.jit` keeps the values that globals and closed-over variables
had when it was traced. `tracked_jit` traces the function again when such a value
changes. At each call `captured` lists the values that the functions of the user read:
it reads the names from their bytecode (`names`) and searches each value by its kind
(`Kind`). The list is a part of the key under which compiled programs are cached.
"""

import argparse
import dis
import enum
import hashlib
import inspect
import sys
import sysconfig
import types
from collections import deque
from collections.abc import Callable, Collection, Hashable
from functools import lru_cache, partial, wraps
from typing import Any, NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.core
import numpy as np

from ._garbage_collection import rare_collections


# The attributes read from a variable, as in `module.part.constant`.
Path: TypeAlias = tuple[str, ...]

_LOADS_GLOBAL = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")
_LOADS_CLOSED = ("LOAD_DEREF", "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF")
_LOADS_ATTRIBUTE = ("LOAD_ATTR", "LOAD_METHOD")
# These libraries may be installed from a working copy, outside of the usual folders.
_LIBRARIES = ("equinox", "jax", "jaxlib", "jaxtyping", "nhjax", "numpy")


class Names(NamedTuple):
    """The variables that code reads, each with the attribute paths read from it.

    Variables that the code itself assigns are left out: a function must not be traced
    again because of what it did itself.
    """

    of_globals: dict[str, set[Path]]
    closed_over: dict[str, set[Path]]


@lru_cache(maxsize=4096)
def names(code: types.CodeType) -> Names:
    """Find the variables that a function and the functions defined inside it read."""
    found, assigned = Names({}, {}), Names({}, {})
    path: list[str] | None = None
    for instruction in dis.get_instructions(code):
        operation, name = instruction.opname, instruction.argval
        if operation in _LOADS_ATTRIBUTE and path is not None:
            path.append(name)
            continue
        _close(found, path)
        path = None
        if operation in _LOADS_GLOBAL:
            path = ["of_globals", name]
        elif operation in _LOADS_CLOSED:
            path = ["closed_over", name]
        elif operation == "STORE_GLOBAL":
            assigned.of_globals[name] = set()
        elif operation == "STORE_DEREF":
            assigned.closed_over[name] = set()
    _close(found, path)
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            for variables, others in zip(found, names(inner), strict=True):
                for name, paths in others.items():
                    variables.setdefault(name, set()).update(paths)
    return Names(*map(_without, found, assigned))


def _close(found: Names, path: list[str] | None) -> None:
    if path is not None:
        kind, name, *attributes = path
        getattr(found, kind).setdefault(name, set()).add(tuple(attributes))


def _without(
    variables: dict[str, set[Path]], others: dict[str, set[Path]]
) -> dict[str, set[Path]]:
    return {name: paths for name, paths in variables.items() if name not in others}


@lru_cache(maxsize=4096)
def is_installed(module: str) -> bool:
    """Return whether a module belongs to Python or an installed library, not to the
    user.
    """
    if module == "__main__":
        return False
    if module.partition(".")[0] in (*_LIBRARIES, *sys.builtin_module_names):
        return True
    file = getattr(sys.modules.get(module), "__file__", None)
    folders = {
        sysconfig.get_path(name)
        for name in ("stdlib", "platstdlib", "purelib", "platlib")
    }
    return file is not None and file.startswith(tuple(folders))


class Kind(enum.Enum):
    """How a value is searched for the values that it contains."""

    PLAIN = enum.auto()
    FLOAT = enum.auto()
    COMPLEX = enum.auto()
    TRACER = enum.auto()
    ARRAY = enum.auto()
    NUMPY = enum.auto()
    FUNCTION = enum.auto()
    METHOD = enum.auto()
    PARTIAL = enum.auto()
    MAPPING = enum.auto()
    SEQUENCE = enum.auto()
    CLASS = enum.auto()
    # An object whose attributes are searched.
    OPEN = enum.auto()
    # Any other object, which is compared by its identity alone.
    OPAQUE = enum.auto()


# The kind of a class is given by the first row that fits.
_KINDS: list[tuple[Kind, tuple[type, ...]]] = [
    (Kind.OPAQUE, (enum.Enum, types.ModuleType)),
    (Kind.NUMPY, (np.ndarray, np.generic)),
    (Kind.PLAIN, (bool, int, str, bytes, type(None), type(Ellipsis), np.dtype)),
    (Kind.FLOAT, (float,)),
    (Kind.COMPLEX, (complex,)),
    (Kind.TRACER, (jax.core.Tracer,)),
    (Kind.ARRAY, (jax.Array,)),
    (Kind.FUNCTION, (types.FunctionType,)),
    (Kind.METHOD, (types.MethodType,)),
    (Kind.PARTIAL, (partial,)),
    (Kind.MAPPING, (dict, types.MappingProxyType)),
    (Kind.SEQUENCE, (list, tuple, deque, set, frozenset)),
    (Kind.CLASS, (type,)),
    # These classes belong to libraries, but hold values of the user.
    (Kind.OPEN, (types.SimpleNamespace, argparse.Namespace, eqx.Module)),
]


@lru_cache(maxsize=4096)
def kind_of(cls: type) -> Kind:
    """Return the kind of the instances of a class."""
    for kind, classes in _KINDS:
        if issubclass(cls, classes):
            return kind
    return Kind.OPAQUE if is_installed(cls.__module__) else Kind.OPEN


# If functions read more values than this, the other values are ignored: comparing them
# would take longer than a short run.
MOST_ENTRIES = 2000


class Place(NamedTuple):
    """The place where a value was read: an object's identity, and a name or index."""

    owner: int
    name: Hashable


class Entry(NamedTuple):
    """A value that a function reads, and where it was read.

    The owner, which is the object in which the value was found, is kept so that its
    identity is not reused. `key` is compared between calls: it contains the owner's
    number in the order of the visit, or -1, where `place` has the owner's identity.
    `content` is compared within a call: there a value that has parts is compared by its
    identity, not by its number.
    """

    key: tuple[int, Hashable, Hashable]
    place: Place
    owner: object
    content: Hashable

    @property
    def atom(self) -> Hashable:
        """The value in a form that can be compared and hashed."""
        return self.key[-1]


class Identity:
    """A wrapper that compares objects by identity.

    The object is kept, so that its identity is not reused.
    """

    def __init__(self, value: object):
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Identity) and self.value is other.value


class Unrepeatable:
    """A value that equals only itself; it stands for a tracer.

    A program that was made with a tracer cannot be used again.
    """


def captured(tree: Any, ignored: Collection[Place] = ()) -> list[Entry]:
    """List the values that the functions in a tree read, except at ignored places.

    The arrays in the tree are left out, because they are arguments of the compiled
    program.
    """
    walk = _Walk(ignored)
    walk.arguments(tree)
    return walk.entries


def all_of(owner: object) -> Place:
    """Return the place that stands for everything inside an object."""
    return Place(id(owner), Ellipsis)


class _Walk:
    def __init__(self, ignored: Collection[Place]):
        self.entries: list[Entry] = []
        self.ignored = ignored
        # The visited objects, by identity, with their numbers in order: equal
        # structures have equal numbers. The entries keep the objects, so that
        # identities are not reused.
        self.numbers: dict[int, int] = {}
        # The identities of the classes whose attributes have been recorded.
        self.searched: set[int] = set()

    def arguments(self, tree: Any) -> None:
        """Record static fields, leaves that are not arrays, and the code of classes."""
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
        # Decorators keep the wrapped function under this name. The result of `jax.jit`
        # is an object of a library's class, and so opaque.
        if kind is Kind.FUNCTION or kind is Kind.OPAQUE:
            self.named(value, ("__wrapped__",))

    def named(self, value: Any, attributes: Collection[str]) -> None:
        """Record the attributes in a list of names that the value has."""
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
                    # The generated methods of a dataclass read no values of the user.
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
        # The globals of a library are assumed to stay the same.
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
    """Return a value without parts, with its type; `None` if it may have parts."""
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
        # Arrays of NumPy can be changed in place, so that their contents are compared.
        # Arrays of JAX cannot.
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
    """Return the attributes of an object without calling code of its class."""
    try:
        return object.__getattribute__(value, "__dict__")
    except AttributeError:
        return {}


T = TypeVar("T")

# The largest number of entries in each of the two dictionaries below. When there are
# more, all are dropped, and programs that are still used are traced once more.
_MOST = 1000


class _Key:
    """The values that functions read, as a key for compiled programs.

    `is_traced` is set when a program has been traced with this key.
    """

    def __init__(self, atoms: tuple[Hashable, ...]):
        self.atoms = atoms
        self.hash = hash(atoms)
        self.is_traced = False

    def __hash__(self) -> int:
        return self.hash

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self.atoms == other.atoms


# Values that change during tracing, such as a list in which a function counts its
# calls, are ignored: otherwise the function would be traced again forever. The
# dictionary maps their places to the owners, so that the identities of these are not
# reused.
_changed_by_tracing: dict[Place, object] = {}
# The key with which a program was traced, by the key as it was after tracing.
_key_before_tracing: dict[_Key, _Key] = {}


def tracked_jit(*tracked: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Compile like `equinox.filter_jit`; trace again if values that functions read
    change.

    It returns a decorator for a function that is called with positional arguments.

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
            before = captured(functions, _changed_by_tracing)
            key = _key(before)
            key = _key_before_tracing.get(key, key)
            out = compiled(key, *args)
            if key.is_traced:
                key.is_traced = False
                _remember_changes(key, before, functions)
            return out

        return call

    return decorator


def _key(entries: list[Entry]) -> _Key:
    return _Key(tuple(entry.key for entry in entries))


def _remember_changes(key: _Key, before: list[Entry], functions: Any) -> None:
    """Remember what tracing changed, so that the program is found at the next call.

    From now on the changed places are ignored, and the key as it is after tracing leads
    to the key as it was before.
    """
    after = captured(functions, _changed_by_tracing)
    changed = _changed(before, after)
    if not changed:
        return
    for memory in (_changed_by_tracing, _key_before_tracing):
        if len(memory) > _MOST:
            memory.clear()
    _changed_by_tracing.update(changed)
    _key_before_tracing[_key(captured(functions, _changed_by_tracing))] = key


def _changed(before: list[Entry], after: list[Entry]) -> dict[Place, object]:
    """Find the places where two lists of entries differ, with their owners."""
    atoms = [{entry.place: entry for entry in entries} for entries in (before, after)]
    changed = {}
    for one, other in (atoms, atoms[::-1]):
        for place, entry in one.items():
            there = other.get(place)
            if isinstance(entry.content, Unrepeatable):
                continue
            if there is None and isinstance(entry.owner, list | set | deque):
                # The container grows, so that its next element would again be new.
                place = all_of(entry.owner)
            if there is None or there.content != entry.content:
                changed[place] = entry.owner
    return changed
