"""The functions that XLA calls, as text of LLVM IR: they run kernels on all members.

A handler of XLA's typed foreign function interface answers a query about itself, or
computes results from operands. Each program has a handler of its own, which only passes
a description of the program to `@nhjax.handle`. That function and all that it calls are
the same for all programs, so that they are compiled once in a process: compiling them
with each program took 20 to 50 ms. How the work is shared among threads is in `_pool`.
"""

import time

from ._ffi_errors import ERRORS, MISMATCH, NO_MEMORY, NO_SCRATCH
from ._ffi_structs import (
    EXTENSION_METADATA,
    field,
    INVALID_ARGUMENT,
    MAJOR,
    MINOR,
    RESOURCE_EXHAUSTED,
    size_of,
    STRUCTS,
    type_definitions,
)
from ._pool import JOB, job_field, POOL, PROGRAM, program_field, WORKERS


# The name of the handler of a program, and of the function that it calls.
HANDLER, HANDLE = "nhjax.handler", "nhjax.handle"

# The time of a block, in ns, as long as none has been run: long enough for as many
# helpers as there are. Longer times are taken for this one, so that products with it do
# not overflow.
_LONG = 1 << 30


def handler_ir(
    num_operands: int, num_results: int, width: int, is_batched: bool
) -> str:
    """Return the text of a module: the handler of the function `@kernel` of another.

    It refers to the function `HANDLE` of the module `handle_ir()`.

    **Arguments:**

    - `num_operands`, `num_results`: how many arrays the kernel reads and writes.
    - `width`: how many members it computes at once.
    - `is_batched`: whether the results have members, along the leading axis; else there
        is one. A program without results has nothing to do.
    """
    values = {
        "kernel": "@kernel",
        "num_operands": num_operands,
        "num_results": num_results,
        "width": width,
        "is_batched": int(is_batched),
        "block_time": _LONG,
    }
    fields = ", ".join(f"{PROGRAM[name]} {value}" for name, value in values.items())
    return f"""
{type_definitions({"Program": PROGRAM})}
declare i1 @kernel(ptr, ptr, i64, i64)
declare ptr @{HANDLE}(ptr, ptr)
@nhjax.program = internal global %Program {{ {fields} }}
define ptr @{HANDLER}(ptr %frame) {{
  %error = call ptr @{HANDLE}(ptr %frame, ptr @nhjax.program)
  ret ptr %error
}}
"""


def handle_ir() -> str:
    """Return the text of the module of `HANDLE`, which serves all programs."""
    parts = [
        type_definitions({**STRUCTS, "Program": PROGRAM, "Job": JOB}),
        _DECLARATIONS,
        ERRORS,
        _METADATA,
        POOL,
        _MEMBERS,
        _CALL,
        _OUTCOME,
        _EXECUTE,
        _HANDLE,
    ]
    return "\n".join(parts)


_DECLARATIONS = f"""
declare ptr @malloc(i64)
declare i32 @clock_gettime(i32, ptr)

; The time in ns, from some moment on.
define internal i64 @nhjax.clock() {{
  %time = alloca {{ i64, i64 }}
  call i32 @clock_gettime(i32 {getattr(time, "CLOCK_MONOTONIC", 1)}, ptr %time)
  %seconds = load i64, ptr %time
  %rest_at = getelementptr inbounds {{ i64, i64 }}, ptr %time, i32 0, i32 1
  %rest = load i64, ptr %rest_at
  %whole = mul i64 %seconds, 1000000000
  %now = add i64 %whole, %rest
  ret i64 %now
}}

; Put the addresses of the data of all arrays of a list into one of addresses.
define internal void @nhjax.gather(ptr %buffers, i64 %number, ptr %addresses) {{
  br label %next
next:
  %i = phi i64 [0, %0], [%i_next, %gather]
  %is_more = icmp ult i64 %i, %number
  br i1 %is_more, label %gather, label %end
gather:
  %buffer_at = getelementptr ptr, ptr %buffers, i64 %i
  %buffer = load ptr, ptr %buffer_at
  %data_at = {field("%buffer", "XLA_FFI_Buffer", "data")}
  %data = load ptr, ptr %data_at
  %to = getelementptr ptr, ptr %addresses, i64 %i
  store ptr %data, ptr %to
  %i_next = add i64 %i, 1
  br label %next
end:
  ret void
}}
"""


_VERSION = ("XLA_FFI_Metadata", "api_version")
_METADATA = f"""
; The answer to the query for metadata.
define internal void @nhjax.answer(ptr %extension) {{
  %metadata_at = {field("%extension", "XLA_FFI_Metadata_Extension", "metadata")}
  %metadata = load ptr, ptr %metadata_at
  %size_at = {field("%metadata", *_VERSION, "struct_size")}
  store i64 {size_of("XLA_FFI_Api_Version")}, ptr %size_at
  %extension_at = {field("%metadata", *_VERSION, "extension_start")}
  store ptr null, ptr %extension_at
  %major_at = {field("%metadata", *_VERSION, "major_version")}
  store i32 {MAJOR}, ptr %major_at
  %minor_at = {field("%metadata", *_VERSION, "minor_version")}
  store i32 {MINOR}, ptr %minor_at
  %traits_at = {field("%metadata", "XLA_FFI_Metadata", "traits")}
  store i32 0, ptr %traits_at
  ret void
}}
"""


_MEMBERS = f"""
; The number of members: none without results, one where they are not batched, otherwise
; the leading dimension of the first result.
define internal i64 @nhjax.members(ptr %program, ptr %rets) {{
  %num_results_at = {program_field("num_results")}
  %num_results = load i64, ptr %num_results_at
  %is_batched_at = {program_field("is_batched")}
  %is_batched = load i64, ptr %is_batched_at
  %is_empty = icmp eq i64 %num_results, 0
  br i1 %is_empty, label %none, label %some
none:
  ret i64 0
some:
  %is_single = icmp eq i64 %is_batched, 0
  br i1 %is_single, label %single, label %batch
single:
  ret i64 1
batch:
  %result = load ptr, ptr %rets
  %dims_at = {field("%result", "XLA_FFI_Buffer", "dims")}
  %dims = load ptr, ptr %dims_at
  %members = load i64, ptr %dims
  ret i64 %members
}}
"""


_CALL = f"""
; Run all blocks of a job. The first is timed: from the time of the last call's it is
; guessed before it how many helpers are worth asking for, and if these were none and
; the block took longer, the guess is made again.
define internal void @nhjax.call(ptr %frame, ptr %job) {{
  %program_at = {job_field("program")}
  %program = load ptr, ptr %program_at
  %block_time_at = {program_field("block_time")}
  %blocks_at = {job_field("blocks")}
  %blocks = load i64, ptr %blocks_at
  atomicrmw add ptr @{WORKERS}, i64 1 monotonic
  %after_one = sub i64 %blocks, 1
  %guess = load atomic i64, ptr %block_time_at monotonic, align 8
  %early = call i64 @nhjax.wanted(
    ptr %frame, ptr %job, i64 %after_one, i64 %guess)
  call void @nhjax.ask(ptr %frame, ptr %job, i64 %early)
  %begun_at = {job_field("begun")}
  %block = atomicrmw add ptr %begun_at, i64 1 monotonic
  %is_left = icmp ult i64 %block, %blocks
  br i1 %is_left, label %first, label %end
first:
  %start = call i64 @nhjax.clock()
  call void @nhjax.run(ptr %job, i64 %block)
  %stop = call i64 @nhjax.clock()
  %elapsed = sub i64 %stop, %start
  %time = call i64 @llvm.umin.i64(i64 %elapsed, i64 {_LONG})
  store atomic i64 %time, ptr %block_time_at monotonic, align 8
  %is_alone = icmp eq i64 %early, 0
  %are_more = icmp ugt i64 %after_one, 1
  %is_asked_again = and i1 %is_alone, %are_more
  br i1 %is_asked_again, label %again, label %rest
again:
  %after_two = sub i64 %after_one, 1
  %late = call i64 @nhjax.wanted(
    ptr %frame, ptr %job, i64 %after_two, i64 %time)
  call void @nhjax.ask(ptr %frame, ptr %job, i64 %late)
  br label %rest
rest:
  call void @nhjax.work(ptr %job)
  br label %end
end:
  atomicrmw sub ptr @{WORKERS}, i64 1 monotonic
  call void @nhjax.wait(ptr %job)
  ret void
}}
"""

_OUTCOME = f"""
; Run a job to its end and let go of it; return an error if a block failed.
define internal ptr @nhjax.outcome(ptr %frame, ptr %job) {{
  call void @nhjax.call(ptr %frame, ptr %job)
  %failed_at = {job_field("failed")}
  %failed = load atomic i64, ptr %failed_at monotonic, align 8
  call void @nhjax.release(ptr %job)
  %is_fine = icmp eq i64 %failed, 0
  br i1 %is_fine, label %fine, label %lacking
fine:
  ret ptr null
lacking:
  %no_scratch = call ptr @nhjax.error(
    ptr %frame, ptr @{NO_SCRATCH}, i32 {RESOURCE_EXHAUSTED})
  ret ptr %no_scratch
}}
"""


_FRAME = "XLA_FFI_CallFrame"
_HANDLE = f"""
; Answer a call by XLA of the handler of a program.
define ptr @{HANDLE}(ptr %frame, ptr %program) {{
  %extension_at = {field("%frame", _FRAME, "extension_start")}
  %extension = load ptr, ptr %extension_at
  %is_plain = icmp eq ptr %extension, null
  br i1 %is_plain, label %execute, label %extended
extended:
  %type_at = {field("%extension", "XLA_FFI_Extension_Base", "type")}
  %type = load i32, ptr %type_at
  %is_query = icmp eq i32 %type, {EXTENSION_METADATA}
  br i1 %is_query, label %query, label %execute
query:
  call void @nhjax.answer(ptr %extension)
  ret ptr null
execute:
  %error = call ptr @nhjax.execute(ptr %frame, ptr %program)
  ret ptr %error
}}
"""


_EXECUTE = f"""
; Compute the results of a program, after checks.
define internal ptr @nhjax.execute(ptr %frame, ptr %program) {{
  %num_operands_at = {field("%frame", _FRAME, "args", "size")}
  %num_operands = load i64, ptr %num_operands_at
  %num_results_at = {field("%frame", _FRAME, "rets", "size")}
  %num_results = load i64, ptr %num_results_at
  %operands_expected_at = {program_field("num_operands")}
  %operands_expected = load i64, ptr %operands_expected_at
  %results_expected_at = {program_field("num_results")}
  %results_expected = load i64, ptr %results_expected_at
  %is_right_in = icmp eq i64 %num_operands, %operands_expected
  %is_right_out = icmp eq i64 %num_results, %results_expected
  %is_right = and i1 %is_right_in, %is_right_out
  br i1 %is_right, label %measure, label %mismatch
mismatch:
  %refusal = call ptr @nhjax.error(
    ptr %frame, ptr @{MISMATCH}, i32 {INVALID_ARGUMENT})
  ret ptr %refusal
measure:
  %args_at = {field("%frame", _FRAME, "args", "args")}
  %args = load ptr, ptr %args_at
  %rets_at = {field("%frame", _FRAME, "rets", "rets")}
  %rets = load ptr, ptr %rets_at
  %members = call i64 @nhjax.members(ptr %program, ptr %rets)
  %is_empty = icmp eq i64 %members, 0
  br i1 %is_empty, label %done, label %prepare
prepare:
  ; Helpers read these addresses only within a block, for which the caller waits.
  %operands = alloca ptr, i64 %num_operands
  call void @nhjax.gather(ptr %args, i64 %num_operands, ptr %operands)
  %results = alloca ptr, i64 %num_results
  call void @nhjax.gather(ptr %rets, i64 %num_results, ptr %results)
  %job = call ptr @malloc(i64 {size_of("Job")})
  %is_lacking = icmp eq ptr %job, null
  br i1 %is_lacking, label %lacking, label %run
lacking:
  %no_memory = call ptr @nhjax.error(
    ptr %frame, ptr @{NO_MEMORY}, i32 {RESOURCE_EXHAUSTED})
  ret ptr %no_memory
run:
  %width_at = {program_field("width")}
  %width = load i64, ptr %width_at
  %before = sub i64 %members, 1
  %before_last = udiv i64 %before, %width
  %blocks = add i64 %before_last, 1
  store %Job zeroinitializer, ptr %job
  %program_at = {job_field("program")}
  store ptr %program, ptr %program_at
  %holders_at = {job_field("holders")}
  store i64 1, ptr %holders_at
  %blocks_at = {job_field("blocks")}
  store i64 %blocks, ptr %blocks_at
  %last_at = {job_field("last")}
  store i64 %before, ptr %last_at
  %operands_at = {job_field("operands")}
  store ptr %operands, ptr %operands_at
  %results_at = {job_field("results")}
  store ptr %results, ptr %results_at
  %outcome = call ptr @nhjax.outcome(ptr %frame, ptr %job)
  ret ptr %outcome
done:
  ret ptr null
}}
"""
