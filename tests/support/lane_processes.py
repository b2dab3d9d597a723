"""Separate programs that call native kernels: `python lane_processes.py NAME`.

Each prints its results in its last line.
"""

import os
import sys
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np


sys.path.insert(0, str(Path(__file__).parent.parent))

from nhjax import lanes
from support.lane_kernels import COUNT_THREADS, kernel_ir, RUNNING, TRIPLE, WIDTH


jax.config.update("jax_enable_x64", True)


def called(body: str, before: str = ""):
    """A compiled function that calls a kernel."""
    name = lanes.register_kernel(kernel_ir(body, before=before), 1, 1, WIDTH, True)
    return lambda x: jax.ffi.ffi_call(name, jax.ShapeDtypeStruct(x.shape, x.dtype))(x)


def cached(directory: str) -> None:
    """Run a program that JAX caches on disk, and print how often it was found there."""
    jax.config.update("jax_compilation_cache_dir", directory)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    hits = []
    jax.monitoring.register_event_listener(
        lambda event, **_: hits.append(event) if "cache_hits" in event else None
    )
    x = jnp.arange(11.0)
    y = jax.jit(lambda x: called(TRIPLE)(x) + 1.0)(x)
    np.testing.assert_array_equal(y, 3 * np.arange(11.0) + 1)
    print("hits:", len(hits))


def kept(directory: str, is_enabled: str, feature: str = "") -> None:
    """Compile a program for members and for a single run, with the cache on disk.

    If a feature is given, the cache keys describe a processor that has it in addition.
    Print how often LLVM generated code, and the results in hexadecimal.
    """
    from nhjax.lanes import _cache, _program

    jax.config.update("jax_compilation_cache_dir", directory)
    jax.config.update("jax_enable_compilation_cache", is_enabled == "on")
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    target = _cache.host()
    _cache.host = lambda: target._replace(features=target.features + feature)
    exported, compile_it = [], _program.object_code

    def object_code(texts, symbol, *rest, **options):
        exported.append(symbol)
        return compile_it(texts, symbol, *rest, **options)

    _program.object_code = object_code
    table = np.array([0.3, -1.7, 2.9])

    def relaxed(x, a):
        """Iterate x <- sin(a x + table), until the change is small."""

        def go_on(carry):
            return (jnp.abs(carry[1]) > 1e-9).any() & (carry[2] < 200)

        def step(carry):
            after = jnp.sin(a * carry[0] + table)
            return after, after - carry[0], carry[2] + 1

        carry = x, jnp.ones(3), 0
        x, _, count = jax.lax.while_loop(go_on, step, carry)
        return x, count

    x, a = jnp.linspace(-1.0, 1.0, 21).reshape(7, 3), jnp.asarray(0.6)
    program = jax.make_jaxpr(relaxed)(x[0], a)
    kinds = jax.ShapeDtypeStruct((3,), x.dtype), jax.ShapeDtypeStruct((), jnp.int64)
    many = [jax.ShapeDtypeStruct((7, *kind.shape), kind.dtype) for kind in kinds]
    found = [
        *jax.ffi.ffi_call(lanes.compile_single(program), kinds)(x[0], a),
        *jax.ffi.ffi_call(lanes.compile_batched(program, (True, False)), many)(x, a),
    ]
    np.testing.assert_allclose(found[0], found[2][0], rtol=1e-14)
    programs = exported.count(_program.HANDLER)
    texts = [np.asarray(part).tobytes().hex() for part in found]
    print("compiled:", programs, "results:", "".join(texts))


def saved(path: str) -> None:
    """Save an executable."""
    from jax.experimental import serialize_executable

    x = jnp.arange(11.0)
    program = jax.jit(called(TRIPLE)).lower(x).compile()
    payload, _, _ = serialize_executable.serialize(program)
    Path(path).write_bytes(payload)
    print("saved")


def loaded(path: str, is_registered: str) -> None:
    """Load an executable, with or without registering its kernel first."""
    from jax.experimental import serialize_executable

    if is_registered == "registered":
        called(TRIPLE)
    trees = jax.tree.structure(((0,), {})), jax.tree.structure(0)
    try:
        program = serialize_executable.deserialize_and_load(
            Path(path).read_bytes(), *trees
        )
        y = program(jnp.arange(11.0))
    except jax.errors.JaxRuntimeError as error:
        print("refused:", "nhjax_lanes_" in str(error))
    else:
        np.testing.assert_array_equal(y, 3 * np.arange(11.0))
        print("ran")


def forked() -> None:
    """Call programs in a child, and compile there, while the parent compiles too.

    In a child, JAX itself can run compiled programs but not compile, and it hangs when
    it gives work to other threads, such as copies of large arrays.
    """
    triple = jax.jit(called(TRIPLE))
    count = jax.jit(called(COUNT_THREADS, RUNNING))
    x, sleeps = np.arange(11.0), np.full(11, 5.0)
    np.testing.assert_array_equal(triple(x), 3 * x)
    count(sleeps).block_until_ready()
    is_over = threading.Event()

    def compile_on():
        # This thread holds the lock of the compiler nearly all the time.
        for number in range(10_000):
            if is_over.is_set():
                return
            before = f"@unused{number} = global i32 {number}\n"
            lanes.register_kernel(kernel_ir(TRIPLE, before=before), 1, 1, WIDTH, True)

    thread = threading.Thread(target=compile_on)
    thread.start()
    time.sleep(0.1)
    child = os.fork()
    if child == 0:
        ended = 1
        try:
            np.testing.assert_array_equal(triple(x), 3 * x)
            # The blocks are long enough to ask for helper threads, but none comes.
            np.testing.assert_array_equal(count(sleeps), 1.0)
            before = "@other = global i32 0\n"
            programs = lanes.compiled_code().programs
            lanes.register_kernel(kernel_ir(TRIPLE, before=before), 1, 1, WIDTH, True)
            assert lanes.compiled_code().programs == programs + 1
            ended = 0
        finally:
            os._exit(ended)
    _, status = os.waitpid(child, 0)
    is_over.set()
    thread.join()
    np.testing.assert_array_equal(triple(x), 3 * x)
    print("child:", os.waitstatus_to_exitcode(status))


def threads(devices: str) -> None:
    """Print the largest number of threads in a kernel at once; its members sleep."""
    mesh = jax.sharding.Mesh(np.array(jax.devices()), ("devices",))
    assert mesh.size == int(devices)
    spec = jax.sharding.PartitionSpec("devices")
    function = jax.jit(
        jax.shard_map(
            called(COUNT_THREADS, RUNNING),
            mesh=mesh,
            in_specs=spec,
            out_specs=spec,
            check_vma=False,
        )
    )
    x = np.full(40 * WIDTH * mesh.size, 1.0)
    print("most:", int(max(function(x).max() for _ in range(5))))


def many_callers() -> None:
    """Call programs from more threads than the pool has, all at once."""
    function = jax.jit(called(COUNT_THREADS, RUNNING))
    x = jnp.full(10 * WIDTH, 0.2)
    function(x).block_until_ready()
    done = []

    def call():
        for _ in range(10):
            done.append(function(x).block_until_ready().shape)

    callers = [threading.Thread(target=call) for _ in range(16)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    print("calls:", len(done))


def without_llvmlite() -> None:
    """Import the package as if llvmlite were not installed."""
    was_imported = "llvmlite" in sys.modules
    for name in [name for name in sys.modules if name.startswith("llvmlite")]:
        del sys.modules[name]
    sys.modules["llvmlite"] = None  # pyright: ignore[reportArgumentType]
    print("imported:", was_imported, "available:", lanes.is_available())


if __name__ == "__main__":
    commands = (
        cached,
        kept,
        saved,
        loaded,
        forked,
        threads,
        many_callers,
        without_llvmlite,
    )
    {command.__name__: command for command in commands}[sys.argv[1]](*sys.argv[2:])
