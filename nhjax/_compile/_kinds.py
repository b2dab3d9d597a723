"""The kinds of values that functions may read, each searched in its own way."""

import argparse
import enum
import types
from collections import deque
from functools import lru_cache, partial

import equinox as eqx
import jax
import jax.core
import numpy as np

from ._names import is_installed


class Kind(enum.Enum):
    """The way in which a value is searched for the values that it contains."""

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


# The kind of a class is that of the first row that fits.
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
    # These classes are not the user's, but made to hold the user's values.
    (Kind.OPEN, (types.SimpleNamespace, argparse.Namespace, eqx.Module)),
]


@lru_cache(maxsize=4096)
def kind_of(cls: type) -> Kind:
    """Find the kind of the instances of a class."""
    for kind, classes in _KINDS:
        if issubclass(cls, classes):
            return kind
    return Kind.OPAQUE if is_installed(cls.__module__) else Kind.OPEN
