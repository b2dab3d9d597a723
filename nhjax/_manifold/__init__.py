"""Configuration spaces: vector spaces, Lie groups, and their retractions."""

from ._group import AbstractLieGroup as AbstractLieGroup
from ._planar_groups import (
    framed as framed,
    is_framed as is_framed,
    SE2 as SE2,
    SO2 as SO2,
    unframed as unframed,
)
from ._product import ProductGroup as ProductGroup
from ._retraction import (
    AbstractRetraction as AbstractRetraction,
    Cayley as Cayley,
    Exponential as Exponential,
)
from ._spatial_groups import (
    cross_matrix as cross_matrix,
    Euclidean as Euclidean,
    SE3 as SE3,
    SO3 as SO3,
)
