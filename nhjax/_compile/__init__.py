"""Compilation of whole programs by three engines, with derivatives and `vmap`."""

from ._batched_call import batched_call as batched_call, vmapped as vmapped
from ._jaxprs import (
    CALLING as CALLING,
    cse_dce as cse_dce,
    ELEMENTWISE as ELEMENTWISE,
    LARGEST_REDUCTION as LARGEST_REDUCTION,
    SMALL_PRODUCT as SMALL_PRODUCT,
)
from ._kernel import as_cpu_kernel as as_cpu_kernel, TraceCache as TraceCache
from ._loop_start import started_like as started_like
from ._lowering import engines as engines, EngineUse as EngineUse
from ._small_product import (
    LONGEST_SUM as LONGEST_SUM,
    small_product as small_product,
)
from ._tracked_jit import captured_by as captured_by, tracked_jit as tracked_jit
