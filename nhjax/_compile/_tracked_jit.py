"""Compilation that notices changes of globals and closed-over variables.

A function compiled by `jax.jit` always uses the values that globals and closed-over
variables had when it was traced. `tracked_jit` traces the function again when a value
changes: at each call `captured_by` lists the values that the user's functions
read, and the list is a part of the key of the compiled program.
"""

import argparse
import contextlib
import dis
import enum
import hashlib
import inspect
import sys
import sysconfig
import types
from collections import deque
from collections.abc import Callable, Collection, Hashable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache, partial, WRAPPER_ASSIGNMENTS, wraps
from itertools import islice
from typing import Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.core
import numpy as np

from ..lanes import rare_collections


# The owner of a value is the object that contains the value. The place of the value
# consists of the identity of its owner and a name or index in the owner.
Place: TypeAlias = tuple[int, Hashable]
# The owner of a value, the name of the value in the owner, and the value.
Part: TypeAlias = tuple[object, Hashable, Any]
T = TypeVar("T")

# At most this many of the values that functions read are compared. Further values are
# ignored, because comparing them would take longer than a short run.
MOST_ENTRIES = 2000
# These libraries are recognised by their names, because they may be installed from a
# working copy, outside of the usual folders.
_LIBRARIES = ("equinox", "jax", "jaxlib", "jaxtyping", "nhjax", "numpy")
# Since Python 3.12, LOAD_FROM_DICT_OR_GLOBALS reads globals in a class body inside a
# function.
_GLOBAL_LOADS = ("LOAD_GLOBAL", "LOAD_NAME", "LOAD_FROM_DICT_OR_GLOBALS")
_NUMBERS, _ARRAYS = (float, complex), (np.ndarray, np.generic)
_PLAIN = (bool, int, str, bytes, type(None), type(Ellipsis), np.dtype)
_LEAVES = (*_PLAIN, *_NUMBERS, *_ARRAYS, jax.core.Tracer)
_MAPPINGS = (dict, types.MappingProxyType)
_SEQUENCES = (list, tuple, deque, set, frozenset)
# Values of these classes are compared part by part, although the classes belong to
# libraries.
_CONTAINERS = (*_MAPPINGS, *_SEQUENCES, types.MethodType, partial)
_CONTAINERS += (types.SimpleNamespace, argparse.Namespace, eqx.Module)


@lru_cache(maxsize=4096)
def _names(code: types.CodeType) -> tuple[dict[str, None], dict[str, None]]:
    """Return names of globals and attributes that code and its inner functions read."""
    variables, attributes = {}, {}
    for instruction in dis.get_instructions(code):
        if instruction.opname in ("LOAD_ATTR", "LOAD_METHOD"):
            attributes[instruction.argval] = None
        elif instruction.opname in _GLOBAL_LOADS:
            variables[instruction.argval] = None
    for inner in code.co_consts:
        if isinstance(inner, types.CodeType):
            variables |= _names(inner)[0]
            attributes |= _names(inner)[1]
    return variables, attributes


@lru_cache(maxsize=4096)
def _is_installed(module: str) -> bool:
    """Return whether a module belongs to Python or a library, not to the user."""
    if module.partition(".")[0] in (*_LIBRARIES, *sys.builtin_module_names):
        return True
    file = getattr(sys.modules.get(module), "__file__", None)
    kinds = ("stdlib", "platstdlib", "purelib", "platlib")
    folders = tuple(sysconfig.get_path(kind) for kind in kinds)
    return module != "__main__" and file is not None and file.startswith(folders)


@dataclass(frozen=True)
class _Identity:
    """An object that is compared by its identity.

    The object is stored too: while it exists, no other object gets its identity.
    """

    number: int
    value: object = field(compare=False)


class _Unrepeatable:
    """The data by which a tracer is compared: an object that equals only itself."""


@lru_cache(maxsize=4096)
def _is_leaf(cls: type) -> bool:
    """Return whether values of a class have no parts.

    NumPy's arrays count as values without parts, although arrays of objects have some.
    """
    return issubclass(cls, _LEAVES) and not issubclass(cls, enum.Enum)


@lru_cache(maxsize=4096)
def _is_open(cls: type) -> bool:
    """Return whether values of a class are compared by their parts."""
    closed = enum.Enum, type, types.ModuleType, jax.Array
    of_user = not (issubclass(cls, closed) or _is_installed(cls.__module__))
    return of_user or issubclass(cls, _CONTAINERS)


def _atom(value: Any) -> Hashable:
    """Return the data by which a value is compared, without the values inside it."""
    cls = type(value)
    if _is_open(cls):
        return cls
    if cls is types.FunctionType:
        return value.__code__
    if not _is_leaf(cls):
        return _Identity(id(value), value)
    if isinstance(value, _ARRAYS):
        # NumPy's arrays can be changed in place, so their contents are compared.
        digest = hashlib.blake2b(value.tobytes(), digest_size=16).digest()
        return cls, value.dtype, value.shape, digest
    if isinstance(value, _NUMBERS):
        # Zeros of different signs differ, and NaN equals itself.
        return cls, repr(value)
    return (cls, value) if isinstance(value, _PLAIN) else _Unrepeatable()


def _key_name(key: Any) -> Hashable:
    """Return the data by which a key of a mapping is compared.

    Keys that are equal may still differ: 0.0 and -0.0, or the user's objects.
    """
    return (type(key), key) if isinstance(key, _PLAIN) else _Identity(id(key), key)


def _parts(value: Any) -> Iterator[Part]:
    """Yield each value inside a value as (owner, name in the owner, value)."""
    if isinstance(value, types.FunctionType):
        yield from _read_by(value)
    elif isinstance(value, _MAPPINGS):
        yield from ((value, _key_name(key), x) for key, x in list(value.items()))
    elif isinstance(value, (*_SEQUENCES, np.ndarray)):
        yield from ((value, index, x) for index, x in enumerate(list(value)))
    elif isinstance(value, type):
        yield from _of_class(value)
    elif isinstance(value, (types.MethodType, partial)):
        for name in ("__self__", "__func__", "func", "args", "keywords"):
            if hasattr(type(value), name):
                yield value, name, getattr(value, name)
    elif _is_open(type(value)):
        # Yield the attributes, and then the slots, without calling code of the class.
        state: Any = object.__getstate__(value)
        for variables in state if isinstance(state, tuple) else (state,):
            for name, x in list((variables or {}).items()):
                if name not in WRAPPER_ASSIGNMENTS:
                    yield value, name, x
        yield value, "__class__", type(value)
    elif hasattr(value, "__wrapped__"):
        # The result of `jax.jit` stores the user's function in this attribute.
        yield value, "__wrapped__", value.__wrapped__


def _read_by(function: types.FunctionType) -> Iterator[Part]:
    """Yield a function's closed-over values, its defaults and the globals it reads.

    The globals of libraries are assumed to stay the same. If a value is a module of the
    user, yield also the variables of the module whose names occur as attributes in the
    code.
    """
    variables, attributes = _names(function.__code__)
    found: list[Part] = []
    for cell in function.__closure__ or ():
        with contextlib.suppress(ValueError):  # An empty cell has no content.
            found.append((cell, "content", cell.cell_contents))
    for name in ("__defaults__", "__kwdefaults__", "__wrapped__"):
        if (value := getattr(function, name, None)) is not None:
            found.append((function, name, value))
    known = function.__globals__
    if not _is_installed(str(known.get("__name__", ""))):
        found += [(known, name, known[name]) for name in variables if name in known]
    modules = set()
    for part in found:  # The list grows during the loop.
        yield part
        module = part[2]
        if isinstance(module, types.ModuleType) and not _is_installed(module.__name__):
            known = {} if module in modules else vars(module)
            modules.add(module)
            found += [(known, x, known[x]) for x in attributes if x in known]


def _of_class(cls: type) -> Iterator[Part]:
    """Yield the attributes and methods of a user's class and of its bases."""
    bases = [base for base in cls.__mro__ if not _is_installed(base.__module__)]
    for base in bases:
        for name, value in list(vars(base).items()):
            if isinstance(value, property):
                value = value.fget
            elif isinstance(value, (staticmethod, classmethod)):
                value = value.__func__
            if isinstance(value, types.FunctionType):
                # Methods that a dataclass generates read none of the user's values.
                if value.__code__.co_filename != "<string>":
                    yield base, name, value
            elif not (name.startswith("__") or name == "_abc_impl"):
                yield base, name, value


@lru_cache(maxsize=4096)
def _static_fields(cls: type) -> tuple[str, ...] | None:
    """Return names of a class's static fields; `None` if a library class has none."""
    fields = getattr(cls, "__dataclass_fields__", {}).values()
    names = tuple(x.name for x in fields if x.metadata.get("static", False))
    return names or (None if _is_installed(cls.__module__) else ())


def static_parts(tree: Any) -> list[Any]:
    """List the parts of a tree that are not arrays.

    These are leaves other than arrays, and the classes and static fields of nodes.
    Arrays are not listed, because they are arguments of the compiled program.
    """
    nodes: list[Any] = []

    def note(node: Any) -> bool:
        nodes.append(node)
        return False

    leaves = jax.tree.leaves(tree, is_leaf=note)
    found = [leaf for leaf in leaves if not eqx.is_array(leaf)]
    for node in nodes:
        names = _static_fields(type(node))
        if names is not None:
            found += [type(node), *(getattr(node, name, None) for name in names)]
    return found


class Captured:
    """The values that functions read, except at the ignored places.

    - `atoms`: for each value, the number of its owner, its name in the owner and the
      data by which it is compared. Objects are numbered in the order in which they are
      found, so that a new function equal to an old one has equal atoms.
    - `contents`: the owner and the content of each place; the content of an object with
      parts is its identity. The owners are stored, so that no other object gets the
      same identity.
    - `is_repeatable`: False if a value is a tracer, or if `atoms` is incomplete.
    """

    def __init__(self, functions: Any, ignored: Collection[Place] = ()):
        # The functions are stored, because `_remember_changes` lists their values again
        # after tracing, and must start from the same object.
        self.functions = functions
        self.atoms: list[Hashable] = []
        self.contents: dict[Place, tuple[object, Hashable]] = {}
        self.is_repeatable = True
        numbers: dict[int, int] = {}
        stack: list[Part] = [(None, "", functions)]
        while stack and len(self.atoms) < MOST_ENTRIES:
            owner, name, value = stack.pop()
            place = id(owner), name
            if ignored and (place in ignored or (id(owner), ...) in ignored):
                continue
            content = atom = _atom(value)
            if isinstance(atom, _Unrepeatable):
                # Tracing may replace a tracer by another one: compare identities.
                content = _Identity(id(value), value)
                self.is_repeatable = False
            has_objects = isinstance(value, np.ndarray) and value.dtype.hasobject
            if has_objects or not _is_leaf(type(value)):
                content = _Identity(id(value), value)
                if id(value) not in numbers:
                    numbers[id(value)] = len(numbers)
                    stack += list(islice(_parts(value), MOST_ENTRIES))[::-1]
                atom = atom, numbers[id(value)]
            self.atoms.append((numbers.get(id(owner), -1), name, atom))
            self.contents[place] = owner, content
        self.is_repeatable &= not stack


@dataclass(frozen=True)
class _Key:
    """The values that functions read, as a key of compiled programs.

    `traces` gets an entry when a program with this key is traced.
    """

    atoms: tuple[Hashable, ...]
    traces: list[None] = field(default_factory=list, compare=False)


# Values that change during tracing, such as a list in which a function counts its
# calls, are ignored: otherwise every call would trace the function again. The owners
# are stored too, so that their identities are not reused. If there are more entries
# than _MOST, all entries are removed, and programs that are still used are traced once
# more.
_MOST = 1000
_changed_by_tracing: dict[Place, object] = {}
# A key without the ignored values is mapped to the key at the time of tracing.
_key_before_tracing: dict[_Key, _Key] = {}


def captured_by(*trees: Any) -> Captured:
    """Return the values that the functions in trees read.

    The result can be shared by several programs with the same functions, if they are
    called one after the other.
    """
    return Captured(static_parts(list(trees)), _changed_by_tracing)


def tracked_jit(*tracked: str) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """Compile like `equinox.filter_jit`; trace again if captured values change.

    The result is a decorator. The decorated function is called with positional
    arguments. If the caller already has the result of `captured_by`, it can be passed
    as the keyword argument `captured`.

    **Arguments:**

    - `tracked`: the names of the arguments that contain the user's functions.
    """

    def decorator(function: Callable[..., T]) -> Callable[..., T]:
        positions = list(inspect.signature(function).parameters)
        which = [positions.index(name) for name in tracked]

        @eqx.filter_jit
        def compiled(key: _Key, *args: Any) -> T:
            key.traces.append(None)
            with rare_collections():
                return function(*args)

        @wraps(function)
        def call(*args: Any, captured: Captured | None = None) -> T:
            trees = [args[position] for position in which]
            before = captured_by(*trees) if captured is None else captured
            key = _Key(tuple(before.atoms))
            key = _key_before_tracing.get(key, key)
            out = compiled(key, *args)
            if key.traces:
                key.traces.clear()
                _remember_changes(key, before)
            return out

        return call

    return decorator


def _remember_changes(key: _Key, before: Captured) -> None:
    """Record the places that tracing changed, and a key that leaves them out.

    Later calls ignore these places, and find the program by this key.
    """
    functions = before.functions
    after = Captured(functions, _changed_by_tracing)
    changed = {}
    for one, other in ((before, after), (after, before)):
        for place, (owner, content) in one.contents.items():
            there = other.contents.get(place)
            if there is None and isinstance(owner, list | set | deque):
                # The container grows with each call, so all its elements are ignored.
                place = (id(owner), ...)
            if there is None or there[1] != content:
                changed[place] = owner
    if changed:
        for memory in (_changed_by_tracing, _key_before_tracing):
            if len(memory) > _MOST:
                memory.clear()
        _changed_by_tracing.update(changed)
        now = Captured(functions, _changed_by_tracing)
        _key_before_tracing[_Key(tuple(now.atoms))] = key
