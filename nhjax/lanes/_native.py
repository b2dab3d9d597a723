"""Compilation of LLVM IR to native code, which llvmlite optimises and loads.

llvmlite is imported when a function of this module first needs it, so that the package
can be imported without llvmlite.

The code is position-independent, has the small code model, and is linked by JITLink, so
that the constants of a kernel are reached by short addresses. The large code model,
llvmlite's default for a JIT, first loads the address of each constant. Kernels with the
large code model were a tenth to a third slower, and took longer to compile.
"""

import platform
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np


class Target(NamedTuple):
    """A machine to compile for: LLVM's triple, the CPU's name, and its features."""

    triple: str
    cpu: str
    features: str = ""


# The supported platforms: 64-bit little-endian machines with the POSIX functions that
# the code in `_handler` calls.
_PLATFORMS = {("linux", "x86_64"), ("linux", "aarch64"), ("darwin", "arm64")}

# The level of LLVM's passes on the IR. Kernels are already simplified when they are
# written. Therefore code of level 1 was as fast as code of level 3, and took half as
# long to compile. Without passes the code was 5 to 15 percent slower.
_PASSES = 1
# A module is short if its text has fewer characters than `_LONG_TEXT`. Short and long
# modules have different levels of the code generator. Level 1 takes half of the compile
# time of level 2. With level 1 a short kernel was 6 percent slower, and a long kernel
# was 2 percent faster.
_LONG_TEXT = 1_000_000
_GENERATION_OF_SHORT, _GENERATION_OF_LONG = 2, 1
# For modules of at least this length, such as gradients of large mechanisms, only a few
# passes run. The other passes, of which moving invariant operations out of loops is the
# slowest, took a quarter of the compile time, and made the code only 4 percent faster.
_VERY_LONG_TEXT = 4_000_000
# The level of the passes and of the code generator for programs that must compile
# quickly: no optimisation.
_QUICK = 0


@lru_cache(maxsize=1)
def is_available() -> bool:
    """Return whether programs can be compiled and called in this process."""
    if (sys.platform, platform.machine()) not in _PLATFORMS:
        return False
    if sys.maxsize < 2**32:
        # This is a 32-bit Python.
        return False
    try:
        _llvm()
    except (ImportError, OSError):
        # llvmlite is not installed, or cannot be loaded on this system.
        return False
    return True


@lru_cache(maxsize=1)
def _llvm() -> Any:
    from llvmlite import binding

    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding


@lru_cache(maxsize=1)
def host() -> Target:
    """Return the machine that this process runs on."""
    llvm = _llvm()
    return Target(
        llvm.get_process_triple(),
        llvm.get_host_cpu_name(),
        llvm.get_host_cpu_features().flatten(),
    )


@lru_cache(maxsize=1)
def version() -> str:
    """Return the versions of llvmlite and LLVM, on which the native code depends."""
    import llvmlite

    return f"{llvmlite.__version__} {_llvm().llvm_version_info}"


def host_width(dtype: Any) -> int:
    """Return the number of members that fill a vector register of this machine."""
    features = _llvm().get_host_cpu_features()
    bits = 128
    if features.get("avx512f") and features.get("avx512dq"):
        bits = 512
    elif features.get("avx2"):
        bits = 256
    return bits // (8 * np.dtype(dtype).itemsize)


def object_code(
    texts: Sequence[str], exported: str, target: Target, is_quick: bool = False
) -> bytes:
    """Compile modules, which may refer to each other, to one object file.

    **Arguments:**

    - `texts`: the modules, in LLVM IR. They may declare the same functions.
    - `exported`: the only function that is visible outside of the object file.
    - `target`: the machine, which may differ from the machine of this process.
    - `is_quick`: whether to compile in a third of the time or less, to slower code.
    """
    module, machine = _compiled(texts, exported, target, is_quick)
    return machine.emit_object(module)


def assembly(texts: Sequence[str], exported: str, target: Target) -> str:
    """Compile modules to assembly text, for people to read."""
    module, machine = _compiled(texts, exported, target, is_quick=False)
    return machine.emit_assembly(module)


def load(code: bytes, name: str, symbol: str, imports: dict[str, int]) -> int:
    """Load an object file for this machine, and return the address of a function.

    The code stays loaded until the process ends.

    **Arguments:**

    - `code`: the object file. Functions that it calls are looked up in the process.
    - `name`: a name that no other object file has.
    - `symbol`: the name of the function.
    - `imports`: the addresses of other symbols that the file refers to.
    """
    builder = _llvm().JITLibraryBuilder().add_object_img(code).add_current_process()
    for imported, address in imports.items():
        builder.import_symbol(imported, address)
    library = builder.export_symbol(symbol).link(_linker(), name)
    # Without `detach`, the code would be unmapped when `library` is freed.
    library.detach()
    return library[symbol]


@lru_cache(maxsize=1)
def _linker() -> Any:
    # llvmlite does not free this linker when Python exits. The code therefore stays
    # valid as long as XLA may call it.
    return _llvm().create_lljit_compiler(
        _machine(host(), _GENERATION_OF_SHORT), use_jit_link=True
    )


def _machine(target: Target, level: int) -> Any:
    llvm = _llvm()
    if target.triple != host().triple:
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
    return llvm.Target.from_triple(target.triple).create_target_machine(
        cpu=target.cpu,
        features=target.features,
        opt=level,
        reloc="pic",
        codemodel="small",
        jit=True,
    )


def _compiled(
    texts: Sequence[str], exported: str, target: Target, is_quick: bool
) -> tuple[Any, Any]:
    """Return the module after all passes, and the machine that generates its code."""
    llvm = _llvm()
    length = sum(map(len, texts))
    level = _GENERATION_OF_LONG if length >= _LONG_TEXT else _GENERATION_OF_SHORT
    machine = _machine(target, _QUICK if is_quick else level)
    # A new context is used, because types and constants in the global context are never
    # freed.
    context = llvm.create_context()
    module, *others = [llvm.parse_assembly(text, context) for text in texts]
    # Without the triple and the layout, the passes would assume a generic machine.
    for part in (module, *others):
        part.triple = machine.triple
        part.data_layout = str(machine.target_data)
    for other in others:
        module.link_in(other)
    module.verify()
    for function in module.functions:
        if not function.is_declaration:
            # No code raises exceptions, so that no tables for them are needed.
            function.add_function_attribute("nounwind")
            # Internal linkage lets LLVM remove functions that were inlined everywhere.
            if function.name != exported:
                function.linkage = "internal"
    options = llvm.create_pipeline_tuning_options(
        speed_level=_QUICK if is_quick else _PASSES
    )
    # Loops are not vectorised, because vectors already contain the members.
    options.loop_vectorization = options.loop_interleaving = False
    options.slp_vectorization = options.loop_unrolling = False
    builder = llvm.create_pass_builder(machine, options)
    if is_quick or length < _VERY_LONG_TEXT:
        passes = builder.getModulePassManager()
    else:
        passes = llvm.create_new_module_pass_manager()
        passes.add_always_inliner_pass()
        passes.add_sroa_pass()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
        passes.add_global_dead_code_eliminate_pass()
    passes.run(module, builder)
    return module, machine
