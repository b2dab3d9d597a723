"""A compiler of small JAX programs that run for many members, by SIMD and threads."""

from ._graph import Unsupported as Unsupported
from ._native import host_width as host_width, is_available as is_available
from ._program import (
    compile_batched as compile_batched,
    compile_single as compile_single,
    compiled_code as compiled_code,
    CompiledCode as CompiledCode,
    llvm_ir as llvm_ir,
    register_kernel as register_kernel,
)
