"""Blocks of members that the caller and the threads of XLA's pool share, as LLVM IR.

A call of a kernel is divided into blocks, of as many members as the kernel computes at
once. They are run on the caller's thread and, where it pays, on threads of the pool:

- Blocks are handed out by a counter, to the caller and to its helpers alike.
- The caller asks the pool for helpers: for fewer than the pool has threads, as it works
  itself, and for so few that each has work for longer than it takes to wake it.
- At the end the caller waits for the blocks that others have begun. It does not wait
  for helpers that have not started: there may be none, because the pool has no free
  thread, or because this is a process that has forked and has no pool any more. So a
  call always comes to its end, since whoever has begun a block needs nobody else to
  finish it.
- What helpers share with the caller, the job, is kept until the last of them has seen
  that there is nothing left to do, which may be long after the call.

Several devices of one process share its pool, and threads of Python's do. For this
reason a counter that all programs of the process share tells how many threads are at
work in blocks. No helper is asked for if there are as many as the pool has threads, and
helpers leave after a block if there are more.
"""

from ._ffi_structs import field, size_of


# The shortest work, in ns, for which a helper is woken, which takes some 10 µs.
_WORTH_A_HELPER = 50_000
# How often the caller yields its core before it sleeps, which takes 50 µs at least;
# then it sleeps for an eighth of the time that it has slept, so that it is late by no
# more.
_YIELDS, _SHORTEST_SLEEP, _LONGEST_SLEEP = 100, 50, 10_000

# What a program's handler passes on: its kernel, the numbers of its operands and
# results, how many members the kernel computes at once, whether the results are
# batched, and how long the first block of the last call took, in ns.
PROGRAM = {
    "kernel": "ptr",
    "num_operands": "i64",
    "num_results": "i64",
    "width": "i64",
    "is_batched": "i64",
    "block_time": "i64",
}

# What the threads that work on a call share: how many blocks have been begun and are
# done, how many threads hold the job, how many the pool has, how many blocks there are,
# the last member, whether a block failed, the addresses of the data, and the program.
# The first two change all the time, and have cache lines of their own.
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
    """Return the instruction that finds the address of a field of `%program`."""
    index = list(PROGRAM).index(name)
    return f"getelementptr inbounds %Program, ptr %program, i32 0, i32 {index}"


def job_field(name: str) -> str:
    """Return the instruction that finds the address of a field of the job `%job`."""
    return f"getelementptr inbounds %Job, ptr %job, i32 0, i32 {list(JOB).index(name)}"


# The counter of all threads that are at work in blocks, of all programs.
WORKERS = "nhjax.workers"

_DECLARATIONS = f"""
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
; What the caller does: run blocks as long as there are any.
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

; Let go of the job, and free it if no other thread holds it.
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

; What a helper does: run blocks as long as there are any, and room for it at work.
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
  ; Of several that find too many at work, no more leave than there are too many.
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
; How many helpers are worth their waking, and have room beside the threads that are at
; work, this one included, if so many blocks are left to them and each takes so long.
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
; Wait until all blocks are done, those that other threads have begun.
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


# The functions that share the blocks of a call. `@nhjax.run` runs one block and
# `@nhjax.work` all that are left; `@nhjax.wanted` and `@nhjax.ask` are for helpers,
# `@nhjax.wait` waits for them, and `@nhjax.release` releases the job.
POOL = "\n".join([_DECLARATIONS, _RUN, _WORK, _WANTED, _ASK, _WAITING])
