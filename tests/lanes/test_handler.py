"""The handler of a kernel, called by a runtime whose pool does as it is told."""

import ctypes
import itertools
import threading

import numpy as np
import pytest

from nhjax.lanes import _ffi, _handler, _native
from support import ffi_runtime
from support.ffi_runtime import Runtime
from support.lane_kernels import kernel_ir, TRIPLE, WIDTH


NUMBERS = itertools.count()

# Functions that count the handler's allocations, and a clock that advances by the same
# time whenever it is read.
STAND_INS = {
    "malloc": "counted_malloc",
    "free": "counted_free",
    "clock_gettime": "steady_clock",
}
COUNTED = """
@held = global i64 0
@step = global i64 1000000
@now = internal global i64 0
declare ptr @malloc(i64)
declare void @free(ptr)
declare ptr @nhjax.handler(ptr)
define ptr @counted_malloc(i64 %size) {
  atomicrmw add ptr @held, i64 1 seq_cst
  %block = call ptr @malloc(i64 %size)
  ret ptr %block
}
define void @counted_free(ptr %block) {
  atomicrmw sub ptr @held, i64 1 seq_cst
  call void @free(ptr %block)
  ret void
}
define i32 @steady_clock(i32 %which, ptr %time) {
  %step = load i64, ptr @step
  %before = atomicrmw add ptr @now, i64 %step seq_cst
  store i64 0, ptr %time
  %rest = getelementptr i64, ptr %time, i64 1
  store i64 %before, ptr %rest
  ret i32 0
}
define i64 @held_now() {
  %held = load atomic i64, ptr @held seq_cst, align 8
  ret i64 %held
}
define ptr @address_of(i64 %which) {
  switch i64 %which, label %handler [i64 1, label %held_now i64 2, label %step]
handler:
  ret ptr @nhjax.handler
held_now:
  ret ptr @held_now
step:
  ret ptr @step
}
"""


WORKERS = ctypes.c_int64(0)


def loaded(texts, symbol):
    """The address of a function of modules that are compiled for this machine."""
    code = _native.object_code(texts, symbol, _native.host())
    imports = {_handler.WORKERS: ctypes.addressof(WORKERS)}
    return _native.load(code, f"test_{next(NUMBERS)}", symbol, imports)


def with_handler(body, is_batched=True):
    """A kernel and its handler, which refers to the module of `shared_handler_ir`."""
    return [kernel_ir(body), _handler.handler_ir(1, 1, WIDTH, is_batched)]


class Program:
    """The handler of a kernel that triples, with these allocations and this clock."""

    def __init__(self, is_batched=True):
        text = _handler.shared_handler_ir()
        for name, stand_in in STAND_INS.items():
            assert f"@{name}(" in text
            text = text.replace(f"@{name}(", f"@{stand_in}(")
        find = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int64)(
            loaded([*with_handler(TRIPLE, is_batched), COUNTED, text], "address_of")
        )
        self.handler = find(0)
        self.held = ctypes.CFUNCTYPE(ctypes.c_int64)(find(1))
        self.step = ctypes.c_int64.from_address(find(2))

    def triples(self, runtime, members):
        x, y = np.arange(float(members)), np.full(members, -1.0)
        assert runtime.call(self.handler, [x], [y]) is None
        np.testing.assert_array_equal(y, 3 * x)


@pytest.fixture(scope="module")
def compiled():
    return Program()


@pytest.fixture
def program(compiled):
    """A program whose blocks are known to take 1 ms each."""
    compiled.step.value = 1_000_000
    compiled.triples(Runtime(threads=1), 1)
    assert compiled.held() == 0
    yield compiled
    assert WORKERS.value == 0


# Names in newer headers, and functions that the handler calls. Other functions may be
# renamed, as long as their positions do not change.
RENAMED = {"XLA_FFI_Extension_Base": "XLA_FFI_InternalExtension"}
CALLED = {
    "XLA_FFI_Error_Create",
    "XLA_FFI_Error_Destroy",
    "XLA_FFI_ThreadPool_Schedule",
    "XLA_FFI_ThreadPool_NumThreads",
}


def in_header(struct):
    structs = ffi_runtime.STRUCTS
    return structs[struct if struct in structs else RENAMED[struct]]


@pytest.mark.parametrize("struct", _ffi.STRUCTS)
def test_lanes_ffi_fields_have_offsets_of_the_header(struct):
    fields = _ffi.STRUCTS[struct]
    stores = "\n".join(
        f"""
        %p{k} = {_ffi.field("null", struct, name)}
        %i{k} = ptrtoint ptr %p{k} to i64
        %o{k} = getelementptr i64, ptr %offsets, i64 {k}
        store i64 %i{k}, ptr %o{k}"""
        for k, name in enumerate(fields)
    )
    text = _ffi.type_definitions(_ffi.STRUCTS)
    text += f"define void @offsets(ptr %offsets) {{ {stores}\n ret void }}"
    offsets = (ctypes.c_int64 * len(fields))()
    ctypes.CFUNCTYPE(None, ctypes.c_void_p)(loaded([text], "offsets"))(offsets)
    header = in_header(struct)
    names = [field[0] for field in header._fields_[: len(fields)]]
    assert list(offsets) == [getattr(header, name).offset for name in names]
    checked = CALLED if struct == "XLA_FFI_Api" else fields
    for name, expected in zip(fields, names, strict=True):
        assert name == expected or name not in checked


def test_lanes_ffi_arguments_have_sizes_of_the_header():
    for struct in _ffi.STRUCTS:
        if not struct.endswith("_Args") or struct == "XLA_FFI_Args":
            continue
        text = _ffi.type_definitions(_ffi.STRUCTS)
        text += f"define i64 @size() {{ ret i64 {_ffi.size_of(struct)} }}"
        size = ctypes.CFUNCTYPE(ctypes.c_int64)(loaded([text], "size"))()
        assert size == ctypes.sizeof(in_header(struct))


def test_lanes_handler_metadata_claims_the_lowest_version(program):
    metadata = Runtime().metadata(program.handler)
    version = metadata.api_version
    assert (version.major_version, version.minor_version) == (0, 1)
    assert version.struct_size == ctypes.sizeof(version)
    assert metadata.traits == 0


@pytest.mark.parametrize("members", [0, 1, WIDTH - 1, WIDTH, WIDTH + 1, 1001])
def test_lanes_handler_without_helpers_runs_all_blocks(program, members):
    runtime = Runtime(threads=4)
    program.triples(runtime, members)
    blocks = -(-members // WIDTH)
    assert runtime.offers == max(0, min(4, blocks) - 1)
    # Helpers that start after the call find nothing to do, and the last of them frees
    # what they share.
    assert program.held() == (1 if runtime.offers else 0)
    runtime.run_tasks()
    assert program.held() == 0


def test_lanes_handler_with_tasks_in_its_own_thread_finishes(program):
    runtime = Runtime(threads=4, schedule=lambda task: task() is None)
    program.triples(runtime, 1001)
    assert runtime.offers == 3
    assert program.held() == 0


def test_lanes_handler_with_tasks_in_threads_finishes(program):
    threads = []

    def start(task):
        threads.append(threading.Thread(target=task))
        threads[-1].start()
        return True

    runtime = Runtime(threads=4, schedule=start)
    for members in [1, 2 * WIDTH, 100_003]:
        program.triples(runtime, members)
    for thread in threads:
        thread.join()
    assert len(threads) == 0 + 1 + 3
    assert program.held() == 0


def test_lanes_handler_with_pool_that_refuses_tasks_finishes(program):
    runtime = Runtime(threads=4, schedule=lambda task: False)
    program.triples(runtime, 1001)
    # After the first refusal no more tasks are offered; each error is destroyed.
    assert runtime.offers == 1
    assert len(runtime.messages) == 1
    assert runtime.errors == set()
    assert program.held() == 0


def test_lanes_handler_without_pool_finishes(program):
    runtime = Runtime(threads=None)
    program.triples(runtime, 1001)
    assert runtime.offers == 0
    assert len(runtime.messages) > 0
    assert runtime.errors == set()
    assert program.held() == 0


def test_lanes_handler_with_interface_without_pool_asks_no_helper(program):
    runtime = Runtime(threads=4)
    runtime.api.struct_size = ffi_runtime.STRUCTS[
        "XLA_FFI_Api"
    ].XLA_FFI_ThreadPool_NumThreads.offset
    program.triples(runtime, 1001)
    assert runtime.offers == 0


@pytest.mark.parametrize("threads", [-1, 0, 1])
def test_lanes_handler_with_pool_of_one_thread_asks_no_helper(program, threads):
    runtime = Runtime(threads=threads)
    program.triples(runtime, 1001)
    assert runtime.offers == 0


@pytest.mark.parametrize("others", [1, 2, 3, 7])
def test_lanes_handler_with_busy_threads_asks_helpers_that_fit(program, others):
    runtime = Runtime(threads=4)
    WORKERS.value = others
    program.triples(runtime, 1001)
    WORKERS.value = 0
    assert runtime.offers == max(0, 3 - others)
    runtime.run_tasks()
    assert program.held() == 0


def test_lanes_helper_with_too_many_threads_returns(program):
    x, y = np.arange(1001.0), np.full(1001, -1.0)
    seen = []

    def start_beside_others(task):
        WORKERS.value += 3
        task()
        WORKERS.value -= 3
        seen.append((program.held(), WORKERS.value, y.max()))
        return True

    runtime = Runtime(threads=4, schedule=start_beside_others)
    assert runtime.call(program.handler, [x], [y]) is None
    # The helpers have done no block; the caller, which alone holds the job, does all.
    assert seen == [(1, 1, -1.0)] * 3
    np.testing.assert_array_equal(y, 3 * x)
    assert program.held() == 0


def test_lanes_handler_before_first_call_asks_for_helpers():
    runtime = Runtime(threads=4)
    program = Program()
    program.step.value = 1
    program.triples(runtime, 1001)
    assert runtime.offers == 3


def test_lanes_handler_of_short_program_asks_no_helper(program):
    program.step.value = 1_000
    program.triples(Runtime(threads=1), 1)
    runtime = Runtime(threads=8)
    # A block takes 1 µs: the caller does up to 50 of them faster than helpers could.
    program.triples(runtime, 50 * WIDTH)
    assert runtime.offers == 0
    program.triples(runtime, 151 * WIDTH)
    assert runtime.offers == 3
    runtime.run_tasks()


def test_lanes_handler_of_slower_call_asks_helpers_after_first_block(program):
    program.step.value = 1_000
    program.triples(Runtime(threads=1), 1)
    program.step.value = 1_000_000
    runtime = Runtime(threads=8)
    program.triples(runtime, 4 * WIDTH)
    # One block is done, one is the caller's next: at most the two others are offered.
    assert runtime.offers == 2
    runtime.run_tasks()


def test_lanes_handler_with_wrong_number_of_arrays_returns_error(program):
    runtime = Runtime()
    x, y = np.ones(3), np.zeros(3)
    error = runtime.call(program.handler, [x, x], [y])
    assert error is not None
    assert runtime.messages[error] == (3, "unexpected numbers of arrays")
    assert runtime.errors == {error}
    np.testing.assert_array_equal(y, 0.0)


def test_lanes_handler_without_memory_for_job_returns_error():
    text = _handler.shared_handler_ir()
    declared = "declare ptr @malloc(i64)"
    assert declared in text
    text = text.replace(
        declared, "define internal ptr @malloc(i64 %size) { ret ptr null }"
    )
    handler = loaded([*with_handler(TRIPLE), text], _handler.HANDLER)
    runtime = Runtime()
    error = runtime.call(handler, [np.ones(3)], [np.zeros(3)])
    assert error is not None
    assert runtime.messages[error] == (8, "no memory to share a call's blocks")


def test_lanes_handler_of_failed_block_returns_error():
    # Only the first block finds memory.
    kernel = """
define i1 @kernel(ptr %operands, ptr %results, i64 %first, i64 %last) {
  %is_later = icmp sgt i64 %first, 0
  ret i1 %is_later
}
"""
    handler = _handler.handler_ir(1, 1, WIDTH, True)
    texts = [kernel, handler, _handler.shared_handler_ir()]
    handler = loaded(texts, _handler.HANDLER)
    for members, is_lacking in ((WIDTH, False), (3 * WIDTH, True)):
        runtime = Runtime(threads=2)
        x = np.ones(members)
        error = runtime.call(handler, [x], [x])
        runtime.run_tasks()
        assert (error is not None) == is_lacking
        texts = [(8, "no memory for the arrays that a program works with")]
        assert list(runtime.messages.values()) == texts[: int(is_lacking)]
    assert WORKERS.value == 0


def test_lanes_handler_without_batch_runs_once():
    program = Program(is_batched=False)
    runtime = Runtime(threads=4)
    x, y = np.full(3, 2.0), np.zeros(3)
    assert runtime.call(program.handler, [x], [y]) is None
    # The kernel is told that 0 is the last member.
    np.testing.assert_array_equal(y, [6.0, 0.0, 0.0])
    assert runtime.offers == 0


def test_lanes_handler_without_results_does_nothing():
    kernel = "define i1 @kernel(ptr %operands, ptr %results, i64 %first, i64 %last) {"
    handler = _handler.handler_ir(1, 0, WIDTH, True)
    texts = [f"{kernel} unreachable }}", handler, _handler.shared_handler_ir()]
    assert Runtime().call(loaded(texts, _handler.HANDLER), [np.ones(3)], []) is None
