"""Native kernels that XLA calls: from one thread or many, in one process or more."""

import os
import subprocess
import sys
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from nhjax import lanes
from support import lane_processes
from support.lane_kernels import kernel_ir, SHARED, TRIPLE, WIDTH


def call(name, *operands, shape=None):
    """Call a kernel by its name, compiled by JAX."""
    shape = operands[0].shape if shape is None else shape
    out = jax.ShapeDtypeStruct(shape, jnp.float64)
    return jax.jit(lambda *x: jax.ffi.ffi_call(name, out)(*x))(*operands)


def printed(*command, **environment):
    """The last line that a separate process prints."""
    others = {key: x for key, x in os.environ.items() if key not in ("XLA_FLAGS",)}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", lane_processes.__file__, *map(str, command)],
        env=others | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()[-1]


@pytest.fixture(scope="module")
def triple():
    return lanes.register_kernel(kernel_ir(TRIPLE), 1, 1, WIDTH, True)


@pytest.mark.parametrize("members", [0, 1, WIDTH - 1, WIDTH, WIDTH + 1, 100_000])
def test_lanes_kernel_of_any_number_of_members_computes_each(triple, members):
    x = jnp.arange(members, dtype=jnp.float64)
    np.testing.assert_array_equal(call(triple, x), 3 * np.arange(members))


def test_lanes_kernel_with_subnormal_numbers_flushes_as_xla(triple):
    """XLA flushes them to zero, in the threads of its pool and in the caller's."""
    x = jnp.full(100_000, 5e-324)
    np.testing.assert_array_equal(call(triple, x), jax.jit(lambda x: 3 * x)(x))


def test_lanes_kernel_without_scratch_memory_raises_in_jax():
    def sums(x):
        # Too many numbers for the stack.
        places = jnp.zeros(3000)
        return lax.fori_loop(0, 20, lambda k, y: y.at[100 * k].add(x[k]), places)[:1000]

    x = jnp.arange(20.0 * WIDTH).reshape(WIDTH, 20)
    text = lanes.llvm_ir(jax.make_jaxpr(sums)(x[0]), (True,), WIDTH)
    declared = "declare ptr @malloc(i64)"
    assert declared in text
    name = lanes.register_kernel(text, 1, 1, WIDTH, True)
    found = call(name, x, shape=(WIDTH, 1000))
    np.testing.assert_array_equal(found, jax.vmap(sums)(x))
    lacking = "define internal ptr @malloc(i64 %size) { ret ptr null }"
    text = text.replace(declared, lacking)
    name = lanes.register_kernel(text, 1, 1, WIDTH, True)
    message = "RESOURCE_EXHAUSTED: no memory for the arrays that a program works with"
    with pytest.raises(jax.errors.JaxRuntimeError, match=message):
        jax.block_until_ready(call(name, x, shape=(WIDTH, 1000)))


@pytest.mark.parametrize("members", [1, WIDTH + 1, 1000])
def test_lanes_kernel_with_shared_operand_reads_it_for_each_member(members):
    name = lanes.register_kernel(kernel_ir(SHARED), 2, 1, WIDTH, True)
    x = jnp.arange(members, dtype=jnp.float64)
    shared = jnp.full(1, 5.0)
    np.testing.assert_array_equal(call(name, x, shared), np.arange(members) + 5)


@pytest.mark.parametrize("members", [0, 1, 1000])
def test_lanes_arrays_without_elements_in_call_are_computed(members):
    """A kernel that does not touch its arrays, which have no elements."""
    kernel = kernel_ir("")
    name = lanes.register_kernel(kernel, 1, 1, WIDTH, True)
    x = jnp.zeros((members, 0))
    assert call(name, x).shape == (members, 0)


def test_lanes_kernel_without_batch_computes_one_member():
    name = lanes.register_kernel(kernel_ir(TRIPLE, width=1), 1, 1, 1, False)
    np.testing.assert_array_equal(call(name, jnp.full(1, 2.0)), [6.0])


def test_lanes_kernel_with_wrong_number_of_arrays_raises_in_jax(triple):
    x = jnp.ones(3)
    with pytest.raises(jax.errors.JaxRuntimeError, match="unexpected numbers"):
        call(triple, x, x)


def test_lanes_kernel_registered_twice_is_compiled_once(triple):
    before = lanes.compiled_code()
    assert lanes.register_kernel(kernel_ir(TRIPLE), 1, 1, WIDTH, True) == triple
    assert lanes.compiled_code() == before
    assert before.bytes > 0
    others = [(1, 1, WIDTH, False), (1, 1, WIDTH + 1, True), (2, 1, WIDTH, True)]
    names = {lanes.register_kernel(kernel_ir(TRIPLE), *other) for other in others}
    assert len(names | {triple}) == 4


def test_lanes_compiled_code_after_new_kernel_grows():
    before = lanes.compiled_code()
    unused = "@grows = global i32 0\n"
    lanes.register_kernel(kernel_ir(TRIPLE, before=unused), 1, 1, WIDTH, True)
    after = lanes.compiled_code()
    assert after.programs == before.programs + 1
    assert after.bytes > before.bytes


def test_lanes_kernel_of_a_million_characters_compiles():
    """Its code is generated at another optimisation level than for shorter modules."""
    comment = f"; {'.' * 1_000_000}\n"
    name = lanes.register_kernel(kernel_ir(TRIPLE, before=comment), 1, 1, WIDTH, True)
    x = np.arange(1001.0)
    np.testing.assert_array_equal(call(name, x), 3 * x)


def test_lanes_kernel_with_invalid_ir_raises():
    with pytest.raises(RuntimeError, match="parsing"):
        lanes.register_kernel("this is not LLVM IR", 1, 1, WIDTH, True)


def test_lanes_kernel_requested_by_several_threads_is_compiled_once():
    kernel = kernel_ir(TRIPLE, before="@at_once = global i32 0\n")
    before = lanes.compiled_code().programs
    start, names = threading.Barrier(8), []

    def want():
        start.wait()
        name = lanes.register_kernel(kernel, 1, 1, WIDTH, True)
        x = np.arange(1000.0)
        np.testing.assert_array_equal(call(name, x), 3 * x)
        names.append(name)

    threads = [threading.Thread(target=want) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(names) == 8
    assert len(set(names)) == 1
    assert lanes.compiled_code().programs == before + 1


def test_lanes_kernel_called_from_more_threads_than_the_pool_finishes():
    assert printed("many_callers", NPROC="2") == "calls: 160"


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_lanes_kernel_uses_at_most_the_threads_of_the_pool(threads):
    # The blocks last 0.8 s in all, long enough for all threads of the pool to join.
    assert printed("threads", 1, NPROC=str(threads)) == f"most: {threads}"


def test_lanes_kernel_on_several_devices_shares_the_pool():
    flags = "--xla_force_host_platform_device_count=2"
    most = int(printed("threads", 2, NPROC="4", XLA_FLAGS=flags).split()[-1])
    # The second device's own thread may join when four threads are at work.
    assert 2 <= most <= 5


def test_lanes_kernel_in_forked_process_finishes():
    assert printed("forked") == "child: 0"


@pytest.mark.long
def test_lanes_kernel_in_executable_from_jax_cache_runs(tmp_path):
    assert printed("cached", tmp_path) == "hits: 0"
    assert list(tmp_path.iterdir())
    assert printed("cached", tmp_path) != "hits: 0"


@pytest.mark.long
def test_lanes_kernel_in_saved_executable_runs_or_is_refused(tmp_path):
    path = tmp_path / "executable"
    printed("saved", path)
    assert printed("loaded", path, "registered") == "ran"
    assert printed("loaded", path, "not") == "refused: True"
