"""The text of LLVM of a program's kernel.

Nothing but the kernel's scratch memory is allocated: on the stack up to 64 kB, beyond
that by `malloc`, and programs that need more than 64 MB are refused.
"""

from typing import Any

from ._control import Control
from ._elementary_functions import library
from ._liveness import find_varying, Live, mark_wide
from ._places import ALIGNMENT, Places
from ._trace import trace
from ._types import vector
from ._unsupported import Unsupported
from ._writer import Text


_STACK = 2**16
_MOST_SCRATCH = 2**26


def member_ir(
    program: Any, is_batched: tuple[bool, ...], width: int, *, contract: bool = True
) -> str:
    """Write a kernel that runs a program for a number of members at a time.

    **Arguments:**

    - `program`: the closed jaxpr of one member.
    - `is_batched`: for each operand, whether it has the member as its leading axis.
    - `width`: the number of members that run in the lanes of vectors, a power of two.
    - `contract`: whether a product and a sum may be rounded together.

    **Returns:**

    The text of a module of LLVM with the function
    `i1 kernel(ptr operands, ptr results, i64 first, i64 last)`. It computes the members
    from `first` to `first + width - 1`; those beyond `last` repeat that one. It returns
    whether that failed, for lack of scratch memory.

    **Raises:**

    - `Unsupported`: if the program has to run in another way.
    """
    traced = trace(program)
    live = Live(traced.results)
    if width > 1:
        find_varying(live, is_batched)
        mark_wide(live)
    else:
        for buffer in live.buffers:
            # The member is part of the address even so.
            buffer.varies = buffer.kind == "operand" and is_batched[buffer.place]
    text = Text(width, "contract" if contract else "")
    places = Places(text, live.buffers)
    control = Control(text, places, live)
    control.region(live.in_region.get(traced.root, []))
    text.add("ret void")
    if places.size > _MOST_SCRATCH:
        raise Unsupported(f"{places.size} bytes of scratch memory")
    return _module(text, places.size)


def _module(text: Text, size: int) -> str:
    first = [
        "define internal void @member(ptr %operands, ptr %results, i64 %first, "
        "i64 %last, ptr noalias %scratch) noinline nounwind {",
        "entry:",
        *_members(text.width),
    ]
    size = max(size, ALIGNMENT)
    call = (
        "call void @member(ptr %operands, ptr %results, i64 %first, i64 %last, "
        "ptr %scratch)"
    )
    if size <= _STACK:
        body = [
            f"  %scratch = alloca [{size} x i8], align {ALIGNMENT}",
            f"  {call}",
            "  ret i1 false",
        ]
    else:
        body = [
            f"  %piece = call ptr @malloc(i64 {size + ALIGNMENT})",
            "  %is_lacking = icmp eq ptr %piece, null",
            "  br i1 %is_lacking, label %lacking, label %run",
            "lacking:",
            "  ret i1 true",
            "run:",
            f"  %up = getelementptr i8, ptr %piece, i64 {ALIGNMENT - 1}",
            f"  %scratch = call ptr @llvm.ptrmask.p0.i64(ptr %up, i64 -{ALIGNMENT})",
            f"  {call}",
            "  call void @free(ptr %piece)",
            "  ret i1 false",
        ]
        text.declare("malloc", "declare ptr @malloc(i64)")
        text.declare("free", "declare void @free(ptr)")
    lines = [
        *text.globals,
        *first,
        *text.lines,
        "}",
        "define i1 @kernel(ptr %operands, ptr %results, i64 %first, i64 %last) {",
        *body,
        "}",
        *text.declared.values(),
        "!0 = !{}",
        library(text.wanted),
    ]
    return "\n".join(lines) + "\n"


def _members(width: int) -> list[str]:
    """Write the numbers of the members in the lanes."""
    if width == 1:
        return ["  %members = add i64 %first, 0"]
    lines, whole, kind = [], "poison", vector("i64", width)
    for lane in range(width):
        lines.append(f"  %i{lane} = add i64 %first, {lane}")
        lines.append(f"  %j{lane} = call i64 @llvm.smin.i64(i64 %i{lane}, i64 %last)")
        name = "%members" if lane == width - 1 else f"%m{lane}"
        lines.append(
            f"  {name} = insertelement {kind} {whole}, i64 %j{lane}, i64 {lane}"
        )
        whole = name
    return lines
