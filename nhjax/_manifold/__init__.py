"""Configuration spaces: vector spaces, Lie groups, and their retractions."""

from ._abstract import AbstractLieGroup as AbstractLieGroup
from ._euclidean import Euclidean as Euclidean
from ._frames import framed as framed, is_framed as is_framed, unframed as unframed
from ._product import ProductGroup as ProductGroup
from ._retraction import (
    AbstractRetraction as AbstractRetraction,
    Cayley as Cayley,
    Exponential as Exponential,
)
from ._se2 import SE2 as SE2
from ._se3 import SE3 as SE3
from ._so2 import SO2 as SO2
from ._so3 import SO3 as SO3
