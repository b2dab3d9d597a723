"""Compilation of programs into one kernel, and anew when what they read changes."""

from ._elementary import (
    CALLING as CALLING,
    ELEMENTWISE as ELEMENTWISE,
    LARGEST_REDUCTION as LARGEST_REDUCTION,
)
from ._kernel import as_cpu_kernel as as_cpu_kernel
from ._tracked_jit import tracked_jit as tracked_jit
