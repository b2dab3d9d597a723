"""Files of states, solutions and checkpoints are read bit for bit as written."""

import dataclasses
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems


BALL = systems.TurntableBall()


@pytest.fixture(scope="module")
def sol():
    """Return a run on a product of groups, so that q is a tuple."""
    saveat = SaveAt(steps=True, checkpoint=True, dense=True)
    options = {"dt": 0.05, "num_steps": 4, "saveat": saveat}
    run = nhjax.integrate(BALL.system, LobattoIIIAB(2), BALL.initial_state(), **options)
    return run


@pytest.fixture(scope="module")
def saved(sol):
    return dataclasses.replace(sol, interpolation=None)


def assert_same(got, expected):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    pairs = zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True)
    for x, y in pairs:
        assert np.asarray(x).dtype == np.asarray(y).dtype
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


def test_save_of_a_tree_loads_bit_for_bit(saved, tmp_path):
    tree = {
        "run": saved,
        "start": (saved.checkpoint.state, [1, 2.5, True, None, "ω", float("-inf")]),
        "numbers": {3: jnp.asarray([np.nan, -0.0, 1e-310])},
        "small": jnp.float32(0.1),
    }
    nhjax.save(tmp_path / "all", tree)
    got = nhjax.load(tmp_path / "all")
    assert_same(got, tree)
    assert got["start"][1] == tree["start"][1]
    assert got["run"].result == nhjax.RESULTS.successful
    # No temporary file is left in the folder.
    assert [path.name for path in tmp_path.iterdir()] == ["all"]


def test_save_writes_arrays_that_numpy_reads_by_path(saved, tmp_path):
    nhjax.save(tmp_path / "run.npz", saved)
    with np.load(tmp_path / "run.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["ys.q[1]"], saved.ys.q[1])
        header = json.loads(file["nhjax"].tobytes())
    assert header["format"] == 1
    assert header["tree"]["kind"] == "Solution"


def test_load_of_results_numbered_differently_uses_their_names(saved, tmp_path):
    path = tmp_path / "run.npz"
    failed = nhjax.RESULTS.nonfinite_state
    batch = jax.tree.map(lambda *x: jnp.stack(x), saved.result, failed)
    nhjax.save(path, batch)
    entries = dict(np.load(path))
    header = json.loads(entries["nhjax"].tobytes())
    # Simulate a release that numbers the results differently.
    names = header["tree"]["names"]
    order = sorted(names, reverse=True)
    codes = {code: name for name, code in names.items()}
    header["tree"]["names"] = {name: order.index(name) for name in order}
    key = header["tree"]["codes"]["name"]
    entries[key] = np.array([order.index(codes[int(c)]) for c in entries[key]])
    _write(path, header, entries)
    assert [bool(x) for x in nhjax.load(path) == batch] == [True, True]


def _write(path, header, entries):
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(path, **(entries | {"nhjax": text}))


def test_load_of_float64_in_single_precision_raises(saved, tmp_path):
    nhjax.save(tmp_path / "run.npz", saved.checkpoint)
    program = f"import nhjax; nhjax.load({str(tmp_path / 'run.npz')!r})"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert "`state.q[0]` has dtype float64 in the file, but JAX" in done.stderr
    assert "jax_enable_x64" in done.stderr


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda file: file.write_bytes(b"nothing"), "is not a file of `nhjax.save`"),
        (lambda file: np.savez(file, q=np.ones(2)), "it has no entry 'nhjax'"),
        (
            lambda file: file.write_bytes(file.read_bytes()[:-100]),
            "is not a file of `nhjax.save`, or is damaged",
        ),
        (lambda file: _changed(file, format="new"), "its header lacks format"),
        (lambda file: _as_array(file), "it is not an .npz"),
        (lambda file: _changed(file, format=2), "in format 2, .* formats up to 1"),
        (
            lambda file: _changed(file, tree={"kind": "Robot", "parts": {}}),
            "contains the type 'Robot'",
        ),
        (
            lambda file: _changed(file, tree={"kind": "State", "parts": {"w": _ONE}}),
            "State has the fields w",
        ),
    ],
)
def test_load_of_a_foreign_or_damaged_file_raises(change, message, saved, tmp_path):
    path = tmp_path / "run.npz"
    nhjax.save(path, saved.checkpoint.state)
    change(path)
    with pytest.raises(ValueError, match=message):
        nhjax.load(path)


_ONE = {"kind": "value", "value": 1}


def _as_array(path):
    with open(path, "wb") as file:
        np.save(file, np.ones(2))


def _changed(path, **parts):
    entries = dict(np.load(path))
    header = json.loads(entries["nhjax"].tobytes()) | parts
    _write(path, header, entries)


def test_load_of_a_file_with_a_flipped_bit_raises(saved, tmp_path):
    path = tmp_path / "run.npz"
    nhjax.save(path, saved.checkpoint.state)
    data, q = bytearray(path.read_bytes()), np.asarray(saved.checkpoint.state.p)
    data[bytes(data).index(q.tobytes())] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match="damaged"):
        nhjax.load(path)


@pytest.mark.parametrize("name", ["run.H5", "run.csv", "run.MAT", "run.pickle"])
def test_save_with_suffix_of_another_format_raises(name, tmp_path):
    with pytest.raises(
        ValueError, match=r"the suffix of another format, .*: use .*npz"
    ):
        nhjax.save(tmp_path / name, {"x": jnp.zeros(2)})
    assert not list(tmp_path.iterdir())


def test_save_of_an_unsupported_part_raises_with_its_path(sol, tmp_path):
    path = tmp_path / "run.npz"
    wrong = {
        "`interpolation` is the dense output of a run": sol,
        r"`\[0\]` is a random key": (jax.random.key(0),),
        "has the key 1.5 of type float": {1.5: 1},
        "has dtype bfloat16": jnp.ones(2, jnp.bfloat16),
    }
    for message, tree in wrong.items():
        with pytest.raises(TypeError, match=message):
            nhjax.save(path, tree)
    assert not path.exists()


def test_save_over_a_file_keeps_its_permissions_and_links(tmp_path):
    path, link = tmp_path / "run.npz", tmp_path / "link"
    (tmp_path / "plain").touch()
    nhjax.save(path, 1)
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    path.chmod(0o640)
    link.symlink_to(path)
    nhjax.save(link, 2)
    assert link.is_symlink()
    assert nhjax.load(path) == 2
    assert path.stat().st_mode & 0o777 == 0o640
    with pytest.raises(IsADirectoryError, match="give the name of a file"):
        nhjax.save(tmp_path, 1)


def test_save_that_fails_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "run.npz"
    nhjax.save(path, 1)

    def broken(*args, **kwargs):
        raise OSError("the disc is full")

    monkeypatch.setattr(np, "savez", broken)
    with pytest.raises(OSError, match="full"):
        nhjax.save(path, 2)
    assert nhjax.load(path) == 1
    assert [found.name for found in tmp_path.iterdir()] == ["run.npz"]
