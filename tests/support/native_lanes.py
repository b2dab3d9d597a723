"""Text of LLVM IR, compiled by llvmlite and called on arrays of NumPy."""

import ctypes

import llvmlite.binding as llvm
import numpy as np


class Native:
    """Functions of vectors, which are called on arrays of any length."""

    def __init__(self, definitions: str, symbols: list[str], cpu: str | None = None):
        """Compile definitions, for this machine unless another CPU is named."""
        llvm.initialize_native_target()
        llvm.initialize_native_asmprinter()
        loops = "\n".join(_loop(symbol) for symbol in symbols)
        module = llvm.parse_assembly(definitions + loops)
        module.verify()
        features = "" if cpu else llvm.get_host_cpu_features().flatten()
        machine = llvm.Target.from_default_triple().create_target_machine(
            cpu=cpu or llvm.get_host_cpu_name(), features=features, opt=3
        )
        tuning = llvm.create_pipeline_tuning_options(speed_level=3)
        builder = llvm.create_pass_builder(machine, tuning)
        builder.getModulePassManager().run(module, builder)
        self.engine = llvm.create_mcjit_compiler(module, machine)
        self.engine.finalize_object()

    def __call__(self, symbol: str, *arguments: np.ndarray) -> np.ndarray:
        """Call a function on arrays of one length, in blocks of its width."""
        width = int(symbol.split(".")[2].partition("x")[2] or 1)
        count = len(arguments[0])
        filled = -(-count // width) * width
        padded = [np.resize(x, filled) for x in arguments]
        result = np.empty_like(padded[0])
        function = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 3, ctypes.c_int64)(
            self.engine.get_function_address(f"loop.{symbol}")
        )
        pointers = [x.ctypes.data for x in (padded[0], padded[-1], result)]
        function(*pointers, filled // width)
        return result[:count]


BINARY = ("atan2", "pow", "rem")


def _loop(symbol: str) -> str:
    """Return a function that calls another for vector after vector in memory."""
    _, op, kind = symbol.split(".")
    scalar = {"f64": "double", "f32": "float"}[kind[:3]]
    width = int(kind.partition("x")[2] or 1)
    vector = scalar if width == 1 else f"<{width} x {scalar}>"
    size = 8 if scalar == "double" else 4
    given = f"{vector} %a, {vector} %b" if op in BINARY else f"{vector} %a"
    return f"""
define void @loop.{symbol}(ptr %x, ptr %y, ptr %result, i64 %count) {{
entry:
  br label %loop
loop:
  %i = phi i64 [ 0, %entry ], [ %next, %loop ]
  %px = getelementptr {vector}, ptr %x, i64 %i
  %py = getelementptr {vector}, ptr %y, i64 %i
  %pr = getelementptr {vector}, ptr %result, i64 %i
  %a = load {vector}, ptr %px, align {size}
  %b = load {vector}, ptr %py, align {size}
  %r = call {vector} @{symbol}({given})
  store {vector} %r, ptr %pr, align {size}
  %next = add i64 %i, 1
  %more = icmp slt i64 %next, %count
  br i1 %more, label %loop, label %end
end:
  ret void
}}
"""
