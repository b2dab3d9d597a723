"""Compilation of whole programs by three engines, anew when what they read changes."""

from ._elementary import (
    CALLING as CALLING,
    ELEMENTWISE as ELEMENTWISE,
    LARGEST_REDUCTION as LARGEST_REDUCTION,
    SMALL_PRODUCT as SMALL_PRODUCT,
)
from ._engine import engines as engines, EngineUse as EngineUse
from ._ensemble import ensemble as ensemble
from ._kernel import as_cpu_kernel as as_cpu_kernel, Programs as Programs
from ._shortened import shortened as shortened
from ._small_product import (
    LONGEST_SUM as LONGEST_SUM,
    small_product as small_product,
)
from ._tracked_jit import tracked_jit as tracked_jit
