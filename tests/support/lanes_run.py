"""Run kernels of lanes on arrays of NumPy, without XLA."""

import ctypes
import time
from collections.abc import Sequence
from typing import Any

import jax
import llvmlite.binding as llvm
import numpy as np

from nhjax.lanes import llvm_ir


llvm.initialize_native_target()
llvm.initialize_native_asmprinter()


def compiled(text: str, level: int = 1) -> Any:
    """Compile the text of a module for this machine; the engine holds the code."""
    module = llvm.parse_assembly(text)
    module.verify()
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=level,
        jit=True,
    )
    options = llvm.PipelineTuningOptions(speed_level=level)
    passes = llvm.create_pass_builder(machine, options)
    passes.getModulePassManager().run(module, passes)
    engine = llvm.create_mcjit_compiler(module, machine)
    engine.finalize_object()
    return engine


def prepared(
    program: Any, is_batched: Sequence[bool], width: int, contract: bool = True
) -> tuple[Any, dict[str, float]]:
    """Compile a closed jaxpr; return the kernel, the times, and the lines of IR."""
    start = time.process_time()
    text = llvm_ir(program, tuple(is_batched), width, contract=contract)
    middle = time.process_time()
    engine = compiled(text)
    kernel = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 2, *[ctypes.c_int64] * 2)(
        engine.get_function_address("kernel")
    )
    # The code lives as long as the engine.
    kernel.engine = engine  # pyright: ignore[reportAttributeAccessIssue]
    end = time.process_time()
    figures = {"trace": middle - start, "llvm": end - middle, "lines": text.count("\n")}
    return kernel, figures


def call(
    kernel: Any,
    program: Any,
    operands: Sequence[Any],
    is_batched: Sequence[bool],
    width: int,
) -> list[np.ndarray]:
    """Compute the results of a compiled program for all members of a batch."""
    arrays = [np.ascontiguousarray(x) for x in operands]
    sizes = [len(x) for x, b in zip(arrays, is_batched, strict=True) if b]
    members = sizes[0] if sizes else 1
    results = [np.zeros((members, *a.shape), a.dtype) for a in program.out_avals]
    pointers = [
        (ctypes.c_void_p * max(len(xs), 1))(*[x.ctypes.data for x in xs])
        for xs in (arrays, results)
    ]
    for first in range(0, members, width):
        kernel(*[ctypes.addressof(p) for p in pointers], first, members - 1)
    return results


def run(
    program: Any,
    operands: Sequence[Any],
    is_batched: Sequence[bool],
    width: int,
    contract: bool = True,
) -> list[np.ndarray]:
    """Compute the results of a closed jaxpr for all members of a batch.

    It runs on an XLA thread, where subnormal numbers are treated as zero.
    """
    kernel, _ = prepared(program, is_batched, width, contract)
    sizes = [len(x) for x, b in zip(operands, is_batched, strict=True) if b]
    members = sizes[0] if sizes else 1
    shapes = [
        jax.ShapeDtypeStruct((members, *a.shape), a.dtype) for a in program.out_avals
    ]

    def run_all(*operands: Any) -> list[np.ndarray]:
        return call(kernel, program, operands, is_batched, width)

    _waiting.append(run_all)
    out = jax.pure_callback(_on_thread, shapes, *operands)
    return [np.asarray(x) for x in jax.block_until_ready(out)]


# The function that runs next on an XLA thread. JAX would keep a separate callback for
# each kernel forever.
_waiting: list[Any] = []


def _on_thread(*operands: Any) -> list[np.ndarray]:
    return _waiting.pop()(*operands)


def run_batched(function: Any, width: int, *operands: Any, **options: Any) -> Any:
    """Run a function of one member in lanes; every operand has a leading batch axis."""
    firsts = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in operands]
    program, shapes = jax.make_jaxpr(function, return_shape=True)(*firsts)
    out = run(program, operands, [True] * len(operands), width, **options)
    return jax.tree.unflatten(jax.tree.structure(shapes), out)
