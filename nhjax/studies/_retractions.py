"""The retractions that studies on groups take, by name."""

from collections.abc import Mapping
from types import MappingProxyType

from .._manifold import AbstractRetraction, Cayley, Exponential


RETRACTIONS: Mapping[str, AbstractRetraction] = MappingProxyType(
    {"cayley": Cayley(), "exponential": Exponential()}
)
