"""The cache of native code on disk: keys, files, and processes that share it."""

import os
import subprocess
import sys
import threading
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from nhjax.lanes import _cache
from support import lane_processes


def process(directory, is_enabled="on", feature=""):
    """Start a process that compiles two programs with the cache."""
    command = [lane_processes.__file__, "kept", directory, is_enabled, feature]
    return subprocess.Popen(
        [sys.executable, "-W", "error", *map(str, command)],
        env={key: x for key, x in os.environ.items() if key != "XLA_FLAGS"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def outcome(started):
    """The number of programs that a process compiled, and its results."""
    out, errors = started.communicate(timeout=300)
    assert started.returncode == 0, errors
    words = out.splitlines()[-1].split()
    return int(words[1]), words[3]


def stored(directory):
    return sorted((directory / _cache.FOLDER).glob("*"))


def test_lanes_cache_in_second_process_gives_same_bits_without_llvm(tmp_path):
    number, results = outcome(process(tmp_path))
    assert number == 2
    files = stored(tmp_path)
    assert len(files) == 2
    contents = [path.read_bytes() for path in files]
    assert outcome(process(tmp_path)) == (0, results)
    # Damaged files are ignored, and replaced by intact ones.
    files[0].write_bytes(contents[0][:-100])
    files[1].write_bytes(contents[1][:5000] + b"\0\1\2" + contents[1][5003:])
    assert outcome(process(tmp_path)) == (2, results)
    assert [path.read_bytes() for path in stored(tmp_path)] == contents


def test_lanes_cache_switched_off_or_of_another_cpu_is_not_used(tmp_path):
    number, results = outcome(process(tmp_path, "off"))
    assert number == 2
    assert not (tmp_path / _cache.FOLDER).exists()
    # The features of a processor that is not this one.
    outcome(process(tmp_path, "on", ",-other"))
    files = stored(tmp_path)
    assert len(files) == 2
    assert outcome(process(tmp_path)) == (2, results)
    assert len(stored(tmp_path)) == 4


def test_lanes_cache_of_two_processes_at_once_is_intact(tmp_path):
    first, second = process(tmp_path), process(tmp_path)
    results = {outcome(first)[1], outcome(second)[1]}
    assert len(results) == 1
    assert [path.suffix for path in stored(tmp_path)] == [".object"] * 2
    assert outcome(process(tmp_path)) == (0, results.pop())


# Files


ENTRY = _cache.Entry("nhjax_lanes_test", bytes(range(256)) * 40 + b"\n\n")


@pytest.fixture
def options(monkeypatch):
    """JAX's options, to be changed for this module only."""
    changed = {
        "jax_persistent_cache_min_compile_time_secs": 0.0,
        "jax_compilation_cache_max_size": -1,
    }

    def option(name):
        return changed.get(name, getattr(jax.config, name))

    monkeypatch.setattr(_cache, "_option", option)
    return changed


def test_lanes_cache_entry_that_was_written_is_read(tmp_path, options):
    folder = tmp_path / "new" / "folder"
    _cache.write(folder, "key", ENTRY, 1.0)
    assert _cache.read(folder, "key") == ENTRY
    assert _cache.read(folder, "other") is None
    assert _cache.read(tmp_path / "none", "key") is None


def test_lanes_cache_file_that_was_damaged_is_ignored(tmp_path, options):
    _cache.write(tmp_path, "key", ENTRY, 1.0)
    (path,) = tmp_path.iterdir()
    data = path.read_bytes()
    for length in (0, 1, 13, 14, 40, 60, len(data) - 1):
        path.write_bytes(data[:length])
        assert _cache.read(tmp_path, "key") is None
    for place in (0, 20, 47, 60, 1000, len(data) - 1):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        assert _cache.read(tmp_path, "key") is None
    path.write_bytes(data + b"\0")
    assert _cache.read(tmp_path, "key") is None
    path.write_bytes(data)
    assert _cache.read(tmp_path, "key") == ENTRY


def test_lanes_cache_file_of_another_key_is_ignored(tmp_path, options):
    """As if the file of another machine had been given this name."""
    _cache.write(tmp_path, "other", ENTRY, 1.0)
    (path,) = tmp_path.iterdir()
    path.rename(path.with_stem("key"))
    assert _cache.read(tmp_path, "key") is None


def test_lanes_cache_limits_of_jax_decide_what_is_stored(tmp_path, options):
    options["jax_persistent_cache_min_compile_time_secs"] = 2.0
    _cache.write(tmp_path, "quick", ENTRY, 1.9)
    assert _cache.read(tmp_path, "quick") is None
    _cache.write(tmp_path, "slow", ENTRY, 2.1)
    assert _cache.read(tmp_path, "slow") == ENTRY
    options["jax_persistent_cache_min_entry_size_bytes"] = len(ENTRY.code) + 1
    _cache.write(tmp_path, "small", ENTRY, 2.1)
    assert _cache.read(tmp_path, "small") is None


def test_lanes_cache_larger_than_limit_loses_entries_of_oldest_use(tmp_path, options):
    for age, key in enumerate("abc"):
        _cache.write(tmp_path, key, ENTRY, 1.0)
        os.utime(tmp_path / f"{key}.object", (1000.0 + age, 1000.0 + age))
    assert _cache.read(tmp_path, "a") == ENTRY
    options["jax_compilation_cache_max_size"] = 3 * len(ENTRY.code) + 1000
    _cache.write(tmp_path, "d", ENTRY, 1.0)
    assert {path.stem for path in tmp_path.iterdir()} == {"a", "c", "d"}


def test_lanes_cache_without_local_directory_is_off(tmp_path, options):
    for root in ("", None, "gs://bucket/folder"):
        options["jax_compilation_cache_dir"] = root
        assert _cache.directory() is None
    options["jax_compilation_cache_dir"] = str(tmp_path)
    assert _cache.directory() == tmp_path / _cache.FOLDER
    options["jax_enable_compilation_cache"] = False
    assert _cache.directory() is None


def test_lanes_cache_folder_that_cannot_be_made_warns(tmp_path, options):
    folder = tmp_path / "file" / "folder"
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(UserWarning, match="could not write"):
        _cache.write(folder, "key", ENTRY, 1.0)
    options["jax_raise_persistent_cache_errors"] = True
    with pytest.raises(OSError, match="file"):
        _cache.write(folder, "key", ENTRY, 1.0)


def test_lanes_cache_entry_read_while_it_is_written_is_whole(tmp_path, options):
    seen, is_over = [], threading.Event()

    def write():
        while not is_over.is_set():
            _cache.write(tmp_path, "key", ENTRY, 1.0)

    writers = [threading.Thread(target=write) for _ in range(3)]
    _cache.write(tmp_path, "key", ENTRY, 1.0)
    for writer in writers:
        writer.start()
    for _ in range(300):
        seen.append(_cache.read(tmp_path, "key"))
    is_over.set()
    for writer in writers:
        writer.join()
    assert all(entry == ENTRY for entry in seen)
    assert [path.name for path in tmp_path.iterdir()] == ["key.object"]


# Keys


def pendulum(x, y, length=1.5, steps=12, weights=(0.5, 2.0), last=jnp.minimum):
    """A program with a loop, a branch, a table and an inner program."""

    @jax.jit
    def force(z):
        return -jnp.sin(z) / length

    def step(carry, weight):
        z, w = carry
        w = w + 0.1 * weight * force(z)
        return (z + 0.1 * w, w), lax.cond(w[0] > 0, jnp.sum, jnp.max, w)

    scales = jnp.asarray(np.resize(weights, steps).astype(x.dtype))
    (z, w), rows = lax.scan(step, (x, y), scales)
    return last(z, w), rows


def key(*options, function=pendulum, dtype="float64", shape=(2,)):
    x = jax.ShapeDtypeStruct(shape, dtype)
    program = jax.make_jaxpr(function)(x, x)
    return _cache.program_key(program, *(options or ((True, False), 4, False)))


def test_lanes_key_of_same_function_traced_again_is_equal():
    first = key()
    assert first is not None
    jax.clear_caches()
    assert key() == first
    assert key(function=lambda a, b: pendulum(a, b)) == first


CHANGED = {
    "a literal": {"function": partial(pendulum, length=1.6)},
    "a constant": {"function": partial(pendulum, weights=(0.5, 2.5))},
    "the length": {"function": partial(pendulum, steps=13)},
    "a primitive": {"function": partial(pendulum, last=jnp.maximum)},
    "the operands": {"function": lambda x, y: pendulum(y, x)},
    "the shape": {"shape": (3,)},
    "the dtype": {"dtype": "float32"},
}


@pytest.mark.parametrize("what", CHANGED)
def test_lanes_key_of_changed_program_differs(what):
    assert key(**CHANGED[what]) not in (None, key())


@pytest.mark.parametrize(
    "options", [((True, True), 4, False), ((True, False), 8, False), (None, 4, False)]
)
def test_lanes_key_of_other_members_differs(options):
    assert key(*options) not in (None, key())
    assert key((True, False), 4, True) != key()


@pytest.mark.parametrize("pair", [(0.0, -0.0), (1.0, 1), (np.nan, np.inf)])
def test_lanes_key_of_literals_that_differ_in_bits_or_dtype_differs(pair):
    programs = [jax.make_jaxpr(partial(jnp.asarray, number))() for number in pair]
    first, second = map(_cache.program_key, programs)
    assert first != second


@pytest.mark.parametrize("name", ["_SOURCES", "host", "version"])
def test_lanes_key_of_other_compiler_or_machine_differs(monkeypatch, name):
    before = key()
    _cache._environment.cache_clear()
    other = "other" if name == "_SOURCES" else lambda: ("other",)
    monkeypatch.setattr(_cache, name, other)
    after = key()
    monkeypatch.undo()
    _cache._environment.cache_clear()
    assert after not in (None, before)
    assert key() == before


def test_lanes_key_ignores_rules_of_derivatives():
    """The code does not depend on them."""

    def doubled(rule):
        function = jax.custom_jvp(lambda x, y: 2 * x + y)
        function.defjvp(rule)
        return function

    first = key(function=doubled(lambda x, dx: (x[0], dx[0])))
    assert first == key(function=doubled(lambda x, dx: (x[0], 2 * dx[0])))
    assert first is not None


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: jax.pure_callback(np.add, x, x, y),
        lambda x, y: jax.debug.callback(print, x) or x + y,
    ],
)
def test_lanes_program_with_function_of_python_has_no_key(function):
    assert key(function=function) is None


def test_lanes_key_of_random_keys_is_none():
    keys = jax.random.key(0)
    program = jax.make_jaxpr(lambda x: (x, jax.random.key_data(keys)))(1.0)
    assert _cache.program_key(program) is None
