"""Compiled functions of nhjax, which are traced again if values they read change."""

from ._kernel import as_cpu_kernel as as_cpu_kernel, TraceCache as TraceCache
from ._loop_start import started_like as started_like
from ._rows import SHORTEST_IN_LOOP as SHORTEST_IN_LOOP, vmapped as vmapped
from ._small_product import (
    LONGEST_SUM as LONGEST_SUM,
    small_product as small_product,
)
from ._tracked_jit import captured_by as captured_by, tracked_jit as tracked_jit
from ._write_row import write_row as write_row
