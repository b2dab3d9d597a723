"""A compiler of small JAX programs that run for many members, by SIMD and threads."""

from ._batched_call import batched_call as batched_call
from ._engines import engines as engines, EngineUse as EngineUse
from ._garbage_collection import rare_collections as rare_collections
from ._graph import Unsupported as Unsupported
from ._jaxprs import (
    CALLING as CALLING,
    COMPILED_ONCE as COMPILED_ONCE,
    cse_dce as cse_dce,
    ELEMENTWISE as ELEMENTWISE,
    KEPT_CALL as KEPT_CALL,
    LARGEST_REDUCTION as LARGEST_REDUCTION,
    num_results as num_results,
    SMALL_INVERSE as SMALL_INVERSE,
    SMALL_PRODUCT as SMALL_PRODUCT,
    WRITE_ROW as WRITE_ROW,
)
from ._kernel import (
    captures_tracers as captures_tracers,
    CompileOptions as CompileOptions,
    never_high as never_high,
    run_program as run_program,
    split_by_operands as split_by_operands,
)
from ._native import host_width as host_width, is_available as is_available
from ._program import (
    compile_batched as compile_batched,
    compile_single as compile_single,
    compiled_code as compiled_code,
    CompiledCode as CompiledCode,
    llvm_ir as llvm_ir,
    register_kernel as register_kernel,
)
from ._transforms import jit as jit, vmap as vmap
