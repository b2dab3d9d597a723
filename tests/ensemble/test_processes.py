"""Two JAX processes that run an ensemble together return the result of one."""

import ast
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest

import nhjax
from nhjax._ensemble import _processes
from support import processes


# JAX must know of the other process before anything uses the devices.
SCRIPT = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
index, port, folder, task = sys.argv[1:]
jax.distributed.initialize(f"localhost:{port}", 2, int(index))
import nhjax
from nhjax._ensemble import _processes
from support import processes
getattr(processes, task)(int(index), Path(folder))
"""
ROOT = Path(__file__).parents[2]


def start_two(folder: Path, task: str) -> list[subprocess.Popen]:
    """Start two processes that are connected by JAX."""
    with socket.socket() as found:
        found.bind(("localhost", 0))
        port = found.getsockname()[1]
    places = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    return [
        subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(index), str(port), str(folder), task],
            env=os.environ | {"PYTHONPATH": places},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in range(2)
    ]


def wait_for(both: list[subprocess.Popen]) -> list[tuple[str, str]]:
    """Wait for processes, and return their output and errors."""
    try:
        return [process.communicate(timeout=300) for process in both]
    finally:
        for process in both:
            process.kill()


def without_gloo(output: str) -> list[str]:
    """Return the lines of an output without the messages of Gloo."""
    return [line for line in output.splitlines() if not line.startswith("[Gloo]")]


def content(folder: Path) -> dict[str, bytes]:
    """Return all files of a store, by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def lines(folder: Path, index: int) -> int:
    """Return how many chunks a process has finished since its start."""
    name = f"chunks-{index}.jsonl" if index else "chunks.jsonl"
    journal = folder / "manifest" / name
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("two")


@pytest.fixture(scope="module")
def outputs(folder):
    """Return the outputs of two processes; the second is killed while it writes."""
    both = start_two(folder, "together")
    while both[1].poll() is None:
        if lines(folder / "killed", 1) > 20:
            both[1].send_signal(signal.SIGKILL)
            break
        time.sleep(0.001)
    found = wait_for(both)
    codes = [process.returncode for process in both]
    assert codes == [3, -signal.SIGKILL], found
    return [without_gloo(out) for out, _ in found]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the files of a store that one process has written."""
    path = tmp_path_factory.mktemp("one") / "store"
    processes.stored(path)
    return content(path)


def test_ensemble_on_two_processes_equals_one_process(outputs, tmp_path):
    assert outputs[0][:2] == outputs[1][:2]
    alone = processes.summary(tmp_path)
    assert ast.literal_eval(outputs[0][0]) == alone
    assert alone["digits"] == alone["rounds"] == 1234567
    assert len(alone["failures"]) == 2
    # Without a fixed order, shares are merged at the end.
    expected = jax.tree.leaves(processes.statistics().statistics)
    for x, y in zip(ast.literal_eval(outputs[0][1]), expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-30)


def test_ensemble_on_two_processes_raises_if_one_is_killed(outputs):
    assert outputs[0][2].startswith("Another of the 2 processes has ended or cannot be")
    assert len(outputs[1]) == 2


@pytest.mark.long
def test_ensemble_on_two_processes_resumed_writes_the_same_bytes(
    outputs, folder, whole, monkeypatch
):
    monkeypatch.setattr(nhjax._ensemble._ensemble, "_SECONDS", 0.0)
    with pytest.raises(OSError, match="No space"):
        processes.statistics(folder / "begun", progress_meter=processes.Failing())
    assert int(nhjax.load(folder / "begun" / "state.npz")["chunks"]) == 1
    left = folder / "begun" / f".{'0' * 32}"
    left.touch()
    assert 20 < lines(folder / "killed", 1) < processes.CHUNKS // 2
    shutil.copytree(folder / "killed", folder / "alone")
    processes.stored(folder / "alone")
    assert content(folder / "alone") == whole
    both = start_two(folder, "again")
    found = wait_for(both)
    assert [process.returncode for process in both] == [0, 0], found
    for name in ("killed", "bad"):
        assert content(folder / name) == whole
    one, other = [without_gloo(out) for out, _ in found]
    assert one[:3] == other[:3]
    assert "process 0 and process 1 differ in `chunk_size`: 4 and 5" in one[0]
    assert "differ in `fixed_order`: False and True" in one[1]
    assert "differ in `run`" in one[2]
    assert one[3].startswith("RuntimeError Process 1 of 2 has failed, and so this one")
    assert other[3].startswith("ValueError Process 1 does not see the store")
    assert "ends: OSError: [Errno 28] No space left" in one[4]
    assert other[4].startswith("OSError [Errno 28] No space left")
    alone = processes.statistics(fixed_order=True).statistics
    assert one[5] == other[5] == processes.bits(alone)
    assert not left.exists()


def test_ensemble_on_two_processes_with_different_calls_raises():
    calls = {"out": False}, {"out": False, "reduce": "Mean()"}

    class Scripted(_processes.Processes):
        def allgather(self, data=b""):
            return [json.dumps(call).encode() for call in calls]

    for call in calls:
        with pytest.raises(ValueError, match=r"differ in `reduce`: None and Mean\(\)"):
            Scripted().check_same_call(call)


def test_ensemble_on_processes_with_unequal_devices_raises():
    _processes.check_equal_devices([0, 1, 1, 0])
    with pytest.raises(ValueError, match="process 0 has 2, process 1 has 1"):
        _processes.check_equal_devices([0, 0, 1])


def test_ensemble_on_processes_with_unequal_shares_finishes(monkeypatch):
    """Threads replace processes; an unmatched exchange would wait forever."""
    monkeypatch.setattr(_processes, "_SECONDS", 0.004)
    barrier, sent, exchanges = threading.Barrier(3), {}, [0, 0, 0]

    class Others(_processes.Processes):
        def __init__(self, index):
            self.index, self.count = index, 3

        def allgather(self, data=b""):
            exchanges[self.index] += 1
            sent[self.index] = data
            barrier.wait(timeout=60)
            found = [sent[index] for index in range(3)]
            barrier.wait(timeout=60)
            return found

    def run(index, chunks):
        exchange = _processes.PeriodicExchange(Others(index), chunks, is_needed=True)
        for _ in range(chunks):
            time.sleep(0.001)
            exchange.chunk_done()
        exchange.finish()

    with ThreadPoolExecutor(3) as pool:
        for ended in [pool.submit(run, *x) for x in enumerate((40, 0, 7))]:
            ended.result()
    assert exchanges[0] == exchanges[1] == exchanges[2] > 5
