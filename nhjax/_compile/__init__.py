"""What makes programs fast, and keeps what is compiled in from being stale."""

from ._elementary import (
    CALLING as CALLING,
    ELEMENTWISE as ELEMENTWISE,
    LARGEST_REDUCTION as LARGEST_REDUCTION,
)
from ._kernel import as_cpu_kernel as as_cpu_kernel
from ._tracked_jit import tracked_jit as tracked_jit
