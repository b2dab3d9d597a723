"""Compilation of whole programs by three engines, anew when what they read changes."""

from ._ensemble import ensemble as ensemble
from ._jaxprs import (
    CALLING as CALLING,
    ELEMENTWISE as ELEMENTWISE,
    LARGEST_REDUCTION as LARGEST_REDUCTION,
    shortened as shortened,
    SMALL_PRODUCT as SMALL_PRODUCT,
)
from ._kernel import as_cpu_kernel as as_cpu_kernel, Programs as Programs
from ._lowering import engines as engines, EngineUse as EngineUse
from ._small_product import (
    LONGEST_SUM as LONGEST_SUM,
    small_product as small_product,
)
from ._tracked_jit import tracked_jit as tracked_jit
