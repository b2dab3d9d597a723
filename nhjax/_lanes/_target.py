"""The whole way of a program, from its jaxpr to a name that XLA can call."""

from typing import Any

from ._emission import member_ir
from ._native import host_width
from ._registration import registered


def single_target(program: Any, is_brief: bool = False) -> str:
    """Compile a program for one run, and return the name to call it by.

    What `is_brief` is compiled in less time to slower code.

    **Raises:** `Unsupported` if the program holds what cannot be compiled.
    """
    shared = (False,) * len(program.in_avals)
    kernel = member_ir(program, shared, 1)
    return registered(
        kernel,
        len(program.in_avals),
        len(program.out_avals),
        1,
        is_batched=False,
        is_brief=is_brief,
    )


def target(program: Any, is_batched: tuple[bool, ...], is_brief: bool = False) -> str:
    """Compile a member's program for an ensemble, and return the name to call it by.

    **Arguments:**

    - `program`: a closed jaxpr, the program of one member.
    - `is_batched`: for each operand whether members have their own, along its leading
        axis, or share it. All results have members.
    - `is_brief`: whether to compile it in less time to slower code.

    **Returns:** a name for `jax.ffi.ffi_call` and `jax.ffi.ffi_lowering`.

    **Raises:** `Unsupported` if the program holds what cannot be compiled.
    """
    width = host_width("float64" if _is_double(program) else "float32")
    kernel = member_ir(program, is_batched, width)
    return registered(
        kernel,
        len(program.in_avals),
        len(program.out_avals),
        width,
        is_batched=True,
        is_brief=is_brief,
    )


def _is_double(program: Any) -> bool:
    avals = [*program.in_avals, *program.out_avals]
    return any(aval.dtype == "float64" for aval in avals) or not any(
        aval.dtype == "float32" for aval in avals
    )
