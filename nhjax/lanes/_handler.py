"""The functions that XLA calls, in LLVM IR: they run a kernel on all members.

XLA calls a handler through its typed foreign function interface: to query its metadata,
or to compute results. Each program has its own handler, which only passes a description
of the program to a function that all programs share. The shared function is compiled
once in a process, because compiling it with each program took 20 to 50 ms.

A call is divided into blocks: the members that the kernel computes at once form a
block. The caller's thread runs blocks. Threads of XLA's pool help if this saves time:

- An atomic counter assigns blocks to the caller and to its helpers.
- The caller asks the pool for helpers. The number of helpers is smaller than the number
    of threads of the pool, because the caller works too. It is also so small that each
    helper works for longer than it takes to wake the helper.
- When no block is left, the caller waits for the blocks that helpers have begun. It
    does not wait for helpers that have not started: they may never start, because the
    pool has no free thread, or because this process was forked and has no pool any
    more. A call therefore always ends: every block that was begun has a thread of its
    own, which needs no other thread.
- The data that helpers share with the caller are called the job. The job is freed when
    the last helper has seen that no block is left, which may be long after the call.

Several devices of one process share the pool, and so do several threads of Python. For
this reason all programs of the process share a counter of the threads that are working
in blocks. If the counter equals the number of threads of the pool, a call starts no
helper. If the counter is larger, helpers leave after a block.
"""

import time

from ._ffi import (
    ERRORS,
    EXTENSION_METADATA,
    field,
    INVALID_ARGUMENT,
    MAJOR,
    MINOR,
    MISMATCH,
    NO_MEMORY,
    NO_SCRATCH,
    RESOURCE_EXHAUSTED,
    size_of,
    STRUCTS,
    type_definitions,
)


# The work, in ns, for which one helper is woken. Waking a helper takes about 10 µs.
_WORTH_A_HELPER = 50_000
# The number of times that a waiting caller yields its core before it sleeps, and the
# limits of a sleep in µs. Between these limits, a sleep takes an eighth of the time
# slept so far, so that the caller wakes late by at most an eighth of this time.
_YIELDS, _SHORTEST_SLEEP, _LONGEST_SLEEP = 100, 50, 10_000

# The description of a program: its kernel, the numbers of its operands and results, the
# number of members that the kernel computes at once, whether the results are batched,
# and how long the first block of the last call took, in ns.
PROGRAM = {
    "kernel": "ptr",
    "num_operands": "i64",
    "num_results": "i64",
    "width": "i64",
    "is_batched": "i64",
    "block_time": "i64",
}

# The data that the threads of a call share: the numbers of blocks begun and done, the
# number of threads that hold the job, the number of threads of the pool, the number of
# blocks, the index of the last member, whether a block failed, the addresses of the
# operands and results, and the program. The numbers of blocks begun and done change
# often, so that each of these two has its own cache line.
JOB = {
    "begun": "i64",
    "padding_1": "[7 x i64]",
    "done": "i64",
    "padding_2": "[7 x i64]",
    "holders": "i64",
    "threads": "i64",
    "blocks": "i64",
    "last": "i64",
    "failed": "i64",
    "operands": "ptr",
    "results": "ptr",
    "program": "ptr",
}


def program_field(name: str) -> str:
    """Return the instruction that computes the address of a field of `%program`."""
    index = list(PROGRAM).index(name)
    return f"getelementptr inbounds %Program, ptr %program, i32 0, i32 {index}"


def job_field(name: str) -> str:
    """Return the instruction that computes the address of a field of the job `%job`."""
    return f"getelementptr inbounds %Job, ptr %job, i32 0, i32 {list(JOB).index(name)}"


# The counter of the threads that are working in blocks. All programs share it.
WORKERS = "nhjax.workers"

_POOL_DECLARATIONS = f"""
@{WORKERS} = external global i64

declare void @free(ptr)
declare i32 @sched_yield()
declare i32 @usleep(i32)
declare i64 @llvm.umin.i64(i64, i64)
declare i64 @llvm.umax.i64(i64, i64)
declare i64 @llvm.smax.i64(i64, i64)
"""


_RUN = f"""
; Run one block.
define internal void @nhjax.run(ptr %job, i64 %block) {{
  %program_at = {job_field("program")}
  %program = load ptr, ptr %program_at
  %kernel_at = {program_field("kernel")}
  %kernel = load ptr, ptr %kernel_at
  %width_at = {program_field("width")}
  %width = load i64, ptr %width_at
  %operands_at = {job_field("operands")}
  %operands = load ptr, ptr %operands_at
  %results_at = {job_field("results")}
  %results = load ptr, ptr %results_at
  %last_at = {job_field("last")}
  %last = load i64, ptr %last_at
  %first = mul i64 %block, %width
  %has_failed = call i1 %kernel(
    ptr %operands, ptr %results, i64 %first, i64 %last)
  br i1 %has_failed, label %failed, label %done
failed:
  %failed_at = {job_field("failed")}
  store atomic i64 1, ptr %failed_at monotonic, align 8
  br label %done
done:
  %done_at = {job_field("done")}
  atomicrmw add ptr %done_at, i64 1 release
  ret void
}}
"""


_WORK = f"""
; Run blocks until none is left, as the caller does.
define internal void @nhjax.work(ptr %job) {{
  %begun_at = {job_field("begun")}
  %blocks_at = {job_field("blocks")}
  %blocks = load i64, ptr %blocks_at
  br label %next
next:
  %block = atomicrmw add ptr %begun_at, i64 1 monotonic
  %is_left = icmp ult i64 %block, %blocks
  br i1 %is_left, label %run, label %end
run:
  call void @nhjax.run(ptr %job, i64 %block)
  br label %next
end:
  ret void
}}

; Release the job, and free it if no other thread holds it.
define internal void @nhjax.release(ptr %job) {{
  %holders_at = {job_field("holders")}
  %holders = atomicrmw sub ptr %holders_at, i64 1 acq_rel
  %is_last = icmp eq i64 %holders, 1
  br i1 %is_last, label %free, label %end
free:
  call void @free(ptr %job)
  br label %end
end:
  ret void
}}

; Run blocks until none is left or too many threads are working, as a helper does.
define internal void @nhjax.help(ptr %job) {{
  %threads_at = {job_field("threads")}
  %threads = load i64, ptr %threads_at
  %begun_at = {job_field("begun")}
  %blocks_at = {job_field("blocks")}
  %blocks = load i64, ptr %blocks_at
  atomicrmw add ptr @{WORKERS}, i64 1 monotonic
  br label %next
next:
  %workers = load atomic i64, ptr @{WORKERS} monotonic, align 8
  %is_full = icmp sgt i64 %workers, %threads
  br i1 %is_full, label %part, label %begin
part:
  ; If several helpers find too many threads, only the surplus leaves.
  %with_this = atomicrmw sub ptr @{WORKERS}, i64 1 monotonic
  %is_too_many = icmp sgt i64 %with_this, %threads
  br i1 %is_too_many, label %release, label %rejoin
rejoin:
  atomicrmw add ptr @{WORKERS}, i64 1 monotonic
  br label %begin
begin:
  %block = atomicrmw add ptr %begun_at, i64 1 monotonic
  %is_left = icmp ult i64 %block, %blocks
  br i1 %is_left, label %run, label %leave
run:
  call void @nhjax.run(ptr %job, i64 %block)
  br label %next
leave:
  atomicrmw sub ptr @{WORKERS}, i64 1 monotonic
  br label %release
release:
  call void @nhjax.release(ptr %job)
  ret void
}}
"""


_THREADS = "XLA_FFI_ThreadPool_NumThreads_Args"
_WANTED = f"""
; Return how many helpers are worth waking for this many blocks that take this long,
; at most as many as the pool has threads that are not working.
define internal i64 @nhjax.wanted(
  ptr %frame, ptr %job, i64 %blocks, i64 %block_time
) {{
  %api_at = {field("%frame", "XLA_FFI_CallFrame", "api")}
  %api = load ptr, ptr %api_at
  %work = mul i64 %blocks, %block_time
  %worth = udiv i64 %work, {_WORTH_A_HELPER}
  %wanted = call i64 @llvm.umin.i64(i64 %worth, i64 %blocks)
  %is_wanted = icmp ne i64 %wanted, 0
  ; An older interface may end before the functions of the pool.
  %api_size = load i64, ptr %api
  %has_pool = icmp uge i64 %api_size, {size_of("XLA_FFI_Api")}
  %is_asked = and i1 %is_wanted, %has_pool
  br i1 %is_asked, label %count, label %none
count:
  %number = alloca i64
  store i64 1, ptr %number
  %args = alloca %{_THREADS}
  store %{_THREADS} zeroinitializer, ptr %args
  store i64 {size_of(_THREADS)}, ptr %args
  %ctx_at = {field("%frame", "XLA_FFI_CallFrame", "ctx")}
  %ctx = load ptr, ptr %ctx_at
  %to_ctx = {field("%args", _THREADS, "ctx")}
  store ptr %ctx, ptr %to_ctx
  %to_number = {field("%args", _THREADS, "num_threads")}
  store ptr %number, ptr %to_number
  %function_at = {field("%api", "XLA_FFI_Api", "XLA_FFI_ThreadPool_NumThreads")}
  %function = load ptr, ptr %function_at
  %error = call ptr %function(ptr %args)
  %failed = call i1 @nhjax.failed(ptr %api, ptr %error)
  br i1 %failed, label %none, label %counted
counted:
  %threads = load i64, ptr %number
  %threads_at = {job_field("threads")}
  store i64 %threads, ptr %threads_at
  %workers = load atomic i64, ptr @{WORKERS} monotonic, align 8
  %idle = sub i64 %threads, %workers
  %room = call i64 @llvm.smax.i64(i64 %idle, i64 0)
  %least = call i64 @llvm.umin.i64(i64 %wanted, i64 %room)
  ret i64 %least
none:
  ret i64 0
}}
"""


_SCHEDULE = "XLA_FFI_ThreadPool_Schedule_Args"
_ASK = f"""
; Ask the pool for helpers.
define internal void @nhjax.ask(ptr %frame, ptr %job, i64 %helpers) {{
  %args = alloca %{_SCHEDULE}
  store %{_SCHEDULE} zeroinitializer, ptr %args
  store i64 {size_of(_SCHEDULE)}, ptr %args
  %ctx_at = {field("%frame", "XLA_FFI_CallFrame", "ctx")}
  %ctx = load ptr, ptr %ctx_at
  %to_ctx = {field("%args", _SCHEDULE, "ctx")}
  store ptr %ctx, ptr %to_ctx
  %to_task = {field("%args", _SCHEDULE, "task")}
  store ptr @nhjax.help, ptr %to_task
  %to_data = {field("%args", _SCHEDULE, "data")}
  store ptr %job, ptr %to_data
  %api_at = {field("%frame", "XLA_FFI_CallFrame", "api")}
  %api = load ptr, ptr %api_at
  %function_at = {field("%api", "XLA_FFI_Api", "XLA_FFI_ThreadPool_Schedule")}
  %holders_at = {job_field("holders")}
  br label %next
next:
  %asked = phi i64 [0, %0], [%more, %ask]
  %is_more = icmp ult i64 %asked, %helpers
  br i1 %is_more, label %ask, label %end
ask:
  %more = add i64 %asked, 1
  atomicrmw add ptr %holders_at, i64 1 monotonic
  %function = load ptr, ptr %function_at
  %error = call ptr %function(ptr %args)
  %failed = call i1 @nhjax.failed(ptr %api, ptr %error)
  br i1 %failed, label %refused, label %next
refused:
  atomicrmw sub ptr %holders_at, i64 1 monotonic
  ret void
end:
  ret void
}}
"""


_WAITING = f"""
; Wait until all blocks are done, including those that other threads have begun.
define internal void @nhjax.wait(ptr %job) {{
  %blocks_at = {job_field("blocks")}
  %blocks = load i64, ptr %blocks_at
  %done_at = {job_field("done")}
  br label %look
look:
  %looks = phi i64 [0, %0], [%looks_more, %yield], [%looks, %sleep]
  %slept = phi i64 [0, %0], [0, %yield], [%slept_more, %sleep]
  %done = load atomic i64, ptr %done_at acquire, align 8
  %is_done = icmp eq i64 %done, %blocks
  br i1 %is_done, label %end, label %pause
pause:
  %is_early = icmp ult i64 %looks, {_YIELDS}
  br i1 %is_early, label %yield, label %sleep
yield:
  %looks_more = add i64 %looks, 1
  call i32 @sched_yield()
  br label %look
sleep:
  %eighth = lshr i64 %slept, 3
  %not_less = call i64 @llvm.umax.i64(i64 %eighth, i64 {_SHORTEST_SLEEP})
  %sleep_time = call i64 @llvm.umin.i64(i64 %not_less, i64 {_LONGEST_SLEEP})
  %microseconds = trunc i64 %sleep_time to i32
  call i32 @usleep(i32 %microseconds)
  %slept_more = add i64 %slept, %sleep_time
  br label %look
end:
  ret void
}}
"""


# The functions that divide the blocks of a call among threads. `@nhjax.run` runs one
# block and `@nhjax.work` all blocks that are left; `@nhjax.wanted` and `@nhjax.ask` get
# helpers, `@nhjax.wait` waits for them, and `@nhjax.release` releases the job.
POOL = "\n".join([_POOL_DECLARATIONS, _RUN, _WORK, _WANTED, _ASK, _WAITING])


# The names of a program's handler, and of the function that all handlers call.
HANDLER, SHARED_HANDLER = "nhjax.handler", "nhjax.handle"

# The time, in ns, that a block is assumed to take before any block has been run. It is
# so long that all available helpers are started. Longer measured times are replaced by
# this time, so that products do not overflow.
_LONG = 1 << 30


def handler_ir(
    num_operands: int, num_results: int, width: int, is_batched: bool
) -> str:
    """Return a module with the handler of the function `@kernel` of another module.

    The handler calls the function `SHARED_HANDLER` of the module `shared_handler_ir()`.

    **Arguments:**

    - `num_operands`, `num_results`: the numbers of arrays that the kernel reads and
        writes.
    - `width`: the number of members that the kernel computes at once.
    - `is_batched`: whether the leading axis of the results is the axis of the members.
        Otherwise there is one member. For a program without results, the handler
        computes no member.
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
declare ptr @{SHARED_HANDLER}(ptr, ptr)
@nhjax.program = internal global %Program {{ {fields} }}
define ptr @{HANDLER}(ptr %frame) {{
  %error = call ptr @{SHARED_HANDLER}(ptr %frame, ptr @nhjax.program)
  ret ptr %error
}}
"""


def shared_handler_ir() -> str:
    """Return the module of `SHARED_HANDLER`, which serves all programs."""
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
        _ENTRY,
    ]
    return "\n".join(parts)


_DECLARATIONS = f"""
declare ptr @malloc(i64)
declare i32 @clock_gettime(i32, ptr)

; Return the time in ns since some fixed moment.
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

; Write the addresses of the data of all arrays of a list into an array.
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
; Answer the query for metadata.
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
; Return the number of members: 0 without results, 1 without a batch, otherwise the
; leading dimension of the first result.
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
; Run all blocks of a job. The time of the first block of the last call determines how
; many helpers are asked for. If none was, the time of the first block of this call
; determines it again.
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
; Run a job to its end and release it; return an error if a block failed.
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
_ENTRY = f"""
; Answer XLA's call of the handler of a program.
define ptr @{SHARED_HANDLER}(ptr %frame, ptr %program) {{
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
; Check the arrays, and compute the results of a program.
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
