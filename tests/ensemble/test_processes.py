"""Two processes of JAX run an ensemble together, as one does."""

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
from oracles import processes


# Nothing may touch the devices before JAX knows of the other process.
SCRIPT = """
import sys
from pathlib import Path
import jax
jax.config.update("jax_enable_x64", True)
index, port, folder, task = sys.argv[1:]
jax.distributed.initialize(f"localhost:{port}", 2, int(index))
import nhjax
from nhjax._ensemble import _processes
from oracles import processes
getattr(processes, task)(int(index), Path(folder))
"""
ROOT = Path(__file__).parents[2]


def pair(folder: Path, task: str) -> list[subprocess.Popen]:
    """Start two processes that know of one another."""
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


def ended(both: list[subprocess.Popen]) -> list[tuple[str, str]]:
    """Wait for processes, and return what they have printed."""
    try:
        return [process.communicate(timeout=300) for process in both]
    finally:
        for process in both:
            process.kill()


def spoken(output: str) -> list[str]:
    """The lines that are not by what connects the processes."""
    return [line for line in output.splitlines() if not line.startswith("[Gloo]")]


def content(folder: Path) -> dict[str, bytes]:
    """All files of a store, by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def lines(folder: Path, index: int) -> int:
    """How many chunks a process has finished since it was started."""
    name = f"chunks-{index}.jsonl" if index else "chunks.jsonl"
    journal = folder / "manifest" / name
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("two")


@pytest.fixture(scope="module")
def said(folder):
    """What two processes have said; the second is killed in a store's midst."""
    both = pair(folder, "together")
    while both[1].poll() is None:
        if lines(folder / "killed", 1) > 20:
            both[1].send_signal(signal.SIGKILL)
            break
        time.sleep(0.001)
    found = ended(both)
    codes = [process.returncode for process in both]
    assert codes == [3, -signal.SIGKILL], found
    return [spoken(out) for out, _ in found]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The files of a store that one process has written."""
    path = tmp_path_factory.mktemp("one") / "store"
    processes.stored(path)
    return content(path)


def test_statistics_and_values_are_those_of_one_process(said, tmp_path):
    assert said[0][:2] == said[1][:2]
    alone = processes.summary(tmp_path)
    assert ast.literal_eval(said[0][0]) == alone
    assert alone["digits"] == alone["rounds"] == 1234567
    assert len(alone["failures"]) == 2
    # Of shares that are merged in the end.
    expected = jax.tree.leaves(processes.statistics().statistics)
    for x, y in zip(ast.literal_eval(said[0][1]), expected, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-30)


def test_one_that_is_killed_ends_the_other_with_an_error(said):
    assert said[0][2].startswith("Another of the 2 processes has ended or cannot be")
    assert len(said[1]) == 2


@pytest.mark.long
def test_both_and_one_alone_go_on_to_the_same_bytes(said, folder, whole, monkeypatch):
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
    both = pair(folder, "again")
    found = ended(both)
    assert [process.returncode for process in both] == [0, 0], found
    for name in ("killed", "bad"):
        assert content(folder / name) == whole
    one, other = [spoken(out) for out, _ in found]
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


def test_what_only_one_process_is_given_is_refused_in_all():
    calls = {"out": False}, {"out": False, "reduce": "Mean()"}

    class Told(_processes.Processes):
        def exchange(self, data=b""):
            return [json.dumps(call).encode() for call in calls]

    for call in calls:
        with pytest.raises(ValueError, match=r"differ in `reduce`: None and Mean\(\)"):
            Told().agree(call)


def test_processes_with_other_numbers_of_devices_are_named():
    _processes.check_devices([0, 1, 1, 0])
    with pytest.raises(ValueError, match="process 0 has 2, process 1 has 1"):
        _processes.check_devices([0, 0, 1])


def test_processes_of_unequal_shares_meet_as_often(monkeypatch):
    """Threads stand for processes; one that waited for nobody would wait for ever."""
    monkeypatch.setattr(_processes, "_SECONDS", 0.004)
    barrier, told, meetings = threading.Barrier(3), {}, [0, 0, 0]

    class Others(_processes.Processes):
        def __init__(self, index):
            self.index, self.count = index, 3

        def exchange(self, data=b""):
            meetings[self.index] += 1
            told[self.index] = data
            barrier.wait(timeout=60)
            found = [told[index] for index in range(3)]
            barrier.wait(timeout=60)
            return found

    def run(index, chunks):
        pace = _processes.Pace(Others(index), chunks, is_needed=True)
        for _ in range(chunks):
            time.sleep(0.001)
            pace.chunk_done()
        pace.finish()

    with ThreadPoolExecutor(3) as pool:
        for ended in [pool.submit(run, *x) for x in enumerate((40, 0, 7))]:
            ended.result()
    assert meetings[0] == meetings[1] == meetings[2] > 5
