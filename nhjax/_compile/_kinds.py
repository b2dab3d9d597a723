"""What kinds of values there are for those who look into what functions read."""

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
    """How a value is looked into."""

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
    # An object whose attributes are looked at.
    OPEN = enum.auto()
    # Any other, of which its identity is all.
    OPAQUE = enum.auto()


# The first that fits is taken.
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
    # Of a class that is not the user's, but made to hold what is.
    (Kind.OPEN, (types.SimpleNamespace, argparse.Namespace, eqx.Module)),
]


@lru_cache(maxsize=4096)
def kind_of(cls: type) -> Kind:
    """The kind of the instances of a class."""
    for kind, classes in _KINDS:
        if issubclass(cls, classes):
            return kind
    return Kind.OPAQUE if is_installed(cls.__module__) else Kind.OPEN
