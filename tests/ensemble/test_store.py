"""Stores of ensembles: xarray opens them, runs resume bit for bit, faults raise."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import nhjax
from nhjax._ensemble import _durable
from support.ensembles import BAD, start, starts


COUNT, CHUNK = 50, 4


def run(x):
    """Return powers quickly, along an axis of their own."""
    return {"powers": x ** jnp.arange(3.0), "is_large": x > 1.0}


def failing(x):
    """Return powers quickly; fail for some members."""
    codes = nhjax.RESULTS.nonfinite_state, nhjax.RESULTS.successful
    return {
        "powers": x ** jnp.arange(3.0),
        "result": nhjax.RESULTS.where(x > 1, *codes),
    }


def call(out, function=run, count=COUNT, **options):
    members = np.linspace(0.5, 1.5, count)
    chosen: dict[str, Any] = {"chunk_size": CHUNK} | options
    return nhjax.ensemble(function, members, out=out, **chosen)


def power(table):
    """Return a run with an array whose numbers are not in the text of its jaxpr."""
    return lambda x: x**table


def content(folder: Path) -> dict[str, bytes]:
    """Return all files of a store, by name."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return the files of a run that was not interrupted."""
    folder = tmp_path_factory.mktemp("whole") / "store"
    call(folder)
    return content(folder)


@pytest.fixture
def store(tmp_path, whole):
    """Create a finished store that a test may damage."""
    for name, data in whole.items():
        path = tmp_path / "store" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    return tmp_path / "store"


def test_ensemble_store_of_solutions_opens_in_xarray_with_labels(tmp_path):
    options = {"out": tmp_path / "s", "units": {"time": "s", "value": "J"}}
    outcome = nhjax.ensemble(start, starts(), chunk_size=4, **options)
    expected = nhjax.ensemble(start, starts(), chunk_size=4)
    assert outcome.values is None
    assert outcome.path == tmp_path / "s"
    assert outcome.failures() == expected.failures()
    with xarray.open_zarr(tmp_path / "s") as data:
        assert dict(data.sizes) == {"trajectory": 10, "time": 4}
        assert data.value.dims == ("trajectory", "time")
        assert (data.value.units, data.time.units) == ("J", "s")
        np.testing.assert_array_equal(data.time, expected.values.ts[0])
        np.testing.assert_array_equal(data.value, expected.values.ys)
        meanings = data.result.flag_meanings.split()
        assert [meanings[i] for i in data.result.values[list(BAD)]] == [
            "nonfinite_state"
        ] * 2
        steps = expected.values.stats["num_steps"]
        np.testing.assert_array_equal(data.stats_num_steps, steps)


def test_ensemble_store_with_units_has_the_labels_of_to_xarray(tmp_path):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v - q[1], coordinates=("x", "angle")
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.ones(2))
    options: dict[str, Any] = {"dt": 0.1, "saveat": nhjax.SaveAt(steps=True)}
    sol = nhjax.integrate(system, nhjax.LobattoIIIAB(2), y0, num_steps=1, **options)
    units = {"time": "s", "x": "m", "p": "N s"}
    nhjax.ensemble(
        lambda x: jax.tree.map(lambda leaf: leaf + x.astype(leaf.dtype), sol),
        np.zeros(3),
        out=tmp_path / "s",
        units=units,
    )
    single = sol.to_xarray(units=units)
    with xarray.open_zarr(tmp_path / "s") as data:
        assert data.q.coordinate_names == ["x", "angle"]
        assert data.q.coordinate_units == single.coordinate_unit.values.tolist()
        assert data.v.coordinate_units == single.velocity_unit.values.tolist()
        assert "coordinate_units" not in data.p.attrs
        assert data.p.units == single.p.units == "N s"


def test_ensemble_store_of_a_tree_opens_in_xarray(store):
    with xarray.open_zarr(store) as data:
        x = np.linspace(0.5, 1.5, COUNT)
        np.testing.assert_allclose(data.powers, np.stack([x**0, x, x**2], axis=1))
        assert data.powers.dims == ("trajectory", "powers_0")
        assert data.is_large.dtype == bool


class Killed(BaseException):
    """Simulates the end of the process."""


def test_ensemble_store_interrupted_at_any_operation_resumes(
    tmp_path, whole, monkeypatch
):
    """Each run ends at another file operation, which loses its last bytes."""
    fsync, replace, folder = os.fsync, os.replace, tmp_path / "store"
    left, ran = [0], []

    def counted(function):
        def operation(first, *rest):
            left[0] -= 1
            if left[0] == 0:
                if function is fsync:
                    os.ftruncate(first, max(0, os.fstat(first).st_size - 3))
                raise Killed
            return function(first, *rest)

        return operation

    # The simulated end truncates a file, which is not possible for folders.
    monkeypatch.setattr(_durable, "sync_folder", lambda folder: None)
    monkeypatch.setattr(_durable.os, "fsync", counted(fsync))
    monkeypatch.setattr(_durable.os, "replace", counted(replace))
    for operations in (1, 2, 7, 13, 14, 1, 2, 3, 4, 5, 6, 7, 9, 10, 11):
        left[0] = operations
        with pytest.raises(Killed):
            call(folder)
        ran.append(content(folder) if folder.exists() else {})
    left[0] = -1
    call(folder)
    assert content(folder) == whole
    assert "manifest/chunks.jsonl" not in ran[0]
    # Finished chunks do not run again.
    journals = [x.get("manifest/chunks.jsonl", b"").count(b"\n") for x in ran]
    assert journals == sorted(journals)
    assert 0 < journals[-1] < 13


SCRIPT = """
import jax
jax.config.update("jax_enable_x64", True)
import sys
from ensemble import test_store
test_store.call(sys.argv[1], count=800)
"""


def test_ensemble_store_of_a_killed_run_resumes_to_the_same_bytes(tmp_path):
    root = Path(__file__).parents[2]
    places = os.pathsep.join([str(root), str(root / "tests")])
    command = [sys.executable, "-c", SCRIPT, str(tmp_path / "killed")]
    journal = tmp_path / "killed" / "manifest" / "chunks.jsonl"
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": places})
    while process.poll() is None:
        if journal.exists() and journal.read_bytes().count(b"\n") > 20:
            process.send_signal(signal.SIGKILL)
            break
        time.sleep(0.001)
    assert process.wait() == -signal.SIGKILL
    done = journal.read_bytes().count(b"\n")
    assert 20 < done < 200
    call(tmp_path / "killed", count=800)
    call(tmp_path / "whole", count=800)
    assert content(tmp_path / "killed") == content(tmp_path / "whole")


def test_ensemble_store_that_is_finished_runs_no_chunk(store, whole, capsys):
    call(store, progress_meter=nhjax.TextProgressMeter())
    assert capsys.readouterr().out == ""
    assert content(store) == whole
    with pytest.raises(FileExistsError, match="`resume=True`"):
        call(store, resume=False)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunk_size": 5}, "`chunk_size`, 4 before and 5 now"),
        ({"count": 51}, "`num_members`, 50 before and 51 now"),
        ({"function": lambda x: {"x": x}}, "the names, shapes or dtypes of what"),
        (
            {
                "function": lambda x: {
                    "powers": x ** jnp.arange(3.0) + 0.25,
                    "is_large": x > 1.0,
                }
            },
            r"computation in `run`, or the numbers in it.*add.*0\.25",
        ),
    ],
)
def test_ensemble_store_resumed_with_other_parameters_raises(
    options, message, store, whole
):
    with pytest.raises(ValueError, match=f"another run. Differences: .*{message}"):
        call(store, **options)
    assert content(store) == whole


def test_ensemble_store_resumed_with_other_arrays_raises(store):
    with pytest.raises(ValueError, match="the arrays of `members`"):
        nhjax.ensemble(run, np.ones(COUNT), out=store, chunk_size=CHUNK)
    own = store.with_name("own")
    call(own, power(jnp.arange(3.0)))
    with pytest.raises(ValueError, match="the computation in `run`"):
        call(own, power(jnp.array([0.0, 1.0, 2.5])))


def test_ensemble_store_with_damaged_chunk_raises_until_deleted(store, whole):
    path = store / "powers" / "c" / "3" / "0"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    with pytest.raises(ValueError, match=r"powers/c/3/0.*members 12 to 15"):
        call(store)
    path.unlink()
    call(store)
    assert content(store) == whole


@pytest.mark.parametrize("name", ["zarr.json", "program.txt", "chunks.jsonl"])
def test_ensemble_store_with_missing_file_raises(name, store):
    (store / "manifest" / name).unlink()
    with pytest.raises(ValueError, match=f"has no 'manifest/{name}'"):
        call(store)


def test_ensemble_store_with_damaged_manifest_raises(store):
    (store / "manifest" / "zarr.json").write_text("{")
    with pytest.raises(ValueError, match=r"a damaged 'manifest/zarr\.json'"):
        call(store)


def test_ensemble_store_with_damaged_journal_raises_with_the_line(store):
    journal = store / "manifest" / "chunks.jsonl"
    lines = journal.read_text().splitlines()
    journal.write_text("\n".join([lines[0][:-5], *lines[1:], ""]))
    with pytest.raises(ValueError, match="Line 1 of"):
        call(store)


def test_ensemble_store_on_full_disk_raises_and_keeps_finished_chunks(
    tmp_path, whole, monkeypatch
):
    left = [30]

    def fsync(file):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(_durable.os, "fsync", fsync)
        with pytest.raises(OSError, match="No space left") as told:
            call(tmp_path / "store")
    assert told.value.errno == errno.ENOSPC
    assert "could not be written to" in str(told.value)
    call(tmp_path / "store")
    assert content(tmp_path / "store") == whole


def test_ensemble_store_in_unusable_folder_raises(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileExistsError, match="is a file: `out` names a folder"):
        call(tmp_path / "file")
    with pytest.raises(NotADirectoryError, match="cannot be used"):
        call(tmp_path / "file" / "store")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("")
    with pytest.raises(ValueError, match=r"was not made by `nhjax\.ensemble`"):
        call(tmp_path / "mine")

    def refused(*args):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "store")

    monkeypatch.setattr(_durable, "write", refused)
    with pytest.raises(PermissionError, match="Permission denied"):
        call(tmp_path / "store")


@pytest.mark.parametrize("name", ["lock", "chunks-1.jsonl"])
def test_ensemble_store_locked_by_another_process_raises(name, store, whole):
    """The lock belongs to the store, or to a process that still runs."""
    fcntl = pytest.importorskip("fcntl")
    with open(store / "manifest" / name, "w") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        with pytest.raises(RuntimeError, match="written by another process"):
            call(store)
    call(store)
    assert content(store) == whole


def test_ensemble_store_on_system_without_fcntl_raises(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "fcntl", None)
    with pytest.raises(RuntimeError, match="has no module `fcntl`"):
        call(tmp_path / "store")


def test_ensemble_store_on_a_file_system_without_locks_warns(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def flock(opened, how):
        raise OSError(errno.ENOLCK, "no locks")

    monkeypatch.setattr(fcntl, "flock", flock)
    with pytest.warns(UserWarning, match="a file system without locks"):
        call(tmp_path / "store")


def test_ensemble_store_interrupted_by_ctrl_c_resumes(tmp_path, whole):
    class Interrupting(nhjax.AbstractProgressMeter):
        def update(self, done, total):
            raise KeyboardInterrupt

    folder = tmp_path / "store"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(nhjax._ensemble._ensemble, "_SECONDS", 0.0)
        with pytest.raises(KeyboardInterrupt):
            call(folder, progress_meter=Interrupting())
    line = json.loads((folder / "manifest" / "chunks.jsonl").read_text())
    assert line["chunk"] == 0
    call(folder)
    assert content(folder) == whole


def test_ensemble_store_without_zarr_raises_with_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(ImportError, match=r'pip install "nhjax\[ensemble\]"'):
        call(tmp_path / "store")


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        (
            {"reduce": nhjax.Mean(), "units": {}},
            ValueError,
            "`units` are for the values in a store",
        ),
        ({"units": {"mass": "kg"}}, ValueError, "`units` has the name 'mass'"),
        ({"function": lambda x: {"time": x}}, ValueError, "an array called 'time'"),
        (
            {"function": lambda x: x.astype(jnp.bfloat16)},
            TypeError,
            "dtype bfloat16, which Zarr",
        ),
    ],
)
def test_ensemble_store_with_unsupported_values_or_units_raises(
    options, error, message, tmp_path
):
    with pytest.raises(error, match=message):
        call(tmp_path / "store", **options)
    assert not (tmp_path / "store").exists()


def test_ensemble_with_units_but_no_store_raises():
    with pytest.raises(ValueError, match="name its folder by `out`"):
        call(None, units={"time": "s"})


def test_ensemble_statistics_in_a_folder_resume_after_interruption(
    tmp_path, monkeypatch
):
    reduce = {"mean": nhjax.Mean(), "variance": nhjax.Variance()}
    members = np.linspace(0.5, 1.5, 10)
    options: dict[str, Any] = {"members": members, "chunk_size": 2, "reduce": reduce}
    whole = nhjax.ensemble(failing, **options)
    replace, folder, left = os.replace, tmp_path / "s", [0]

    def interrupted(*args):
        left[0] -= 1
        if left[0] == 0:
            raise Killed
        replace(*args)

    monkeypatch.setattr(os, "replace", interrupted)
    # The first three runs end before the program, the manifest and the first state
    # exist; the others end between chunks.
    for operations in (1, 2, 3, 2, 2):
        left[0] = operations
        with pytest.raises(Killed):
            nhjax.ensemble(failing, out=folder, **options)
    # The first call runs the remaining chunks, and the second call runs none.
    for _ in range(2):
        again = nhjax.ensemble(failing, out=folder, **options)
        assert again.failures() == whole.failures() != []
        assert content_of(again.statistics) == content_of(whole.statistics)
    for name, value, message in (
        ("reduce", nhjax.Minimum(), "`reduce`, .*Mean.* before and .*Minimum"),
        (
            "reduce",
            reduce | {"mean": nhjax.Mean(of=lambda it: it["powers"])},
            "`reduce`, ",
        ),
        ("chunk_size", 4, "`chunk_size`, 2 before and 4 now"),
    ):
        other: dict[str, Any] = options | {name: value}
        with pytest.raises(ValueError, match=message):
            nhjax.ensemble(failing, **other, out=folder)
    fcntl = pytest.importorskip("fcntl")
    with open(folder / "lock") as locked:
        fcntl.flock(locked, fcntl.LOCK_EX)
        with pytest.raises(RuntimeError, match="written by another process"):
            nhjax.ensemble(failing, out=folder, **options)
    (folder / "state.npz").write_bytes(b"PK")
    with pytest.raises(ValueError, match="is damaged"):
        nhjax.ensemble(failing, out=folder, **options)
    (folder / "manifest.json").unlink()
    with pytest.raises(ValueError, match=r"has no 'manifest\.json'"):
        nhjax.ensemble(failing, out=folder, **options)


def content_of(tree):
    """Return the bytes of the arrays of a tree."""
    return [np.asarray(x).tobytes() for x in jax.tree.leaves(tree)]
