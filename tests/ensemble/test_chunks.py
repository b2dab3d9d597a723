"""Ensembles in chunks return the values of `vmap` and list the members that failed."""

import io
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from benchmarks import ensembles
from support.ensembles import BAD, start, starts


@pytest.fixture(scope="module")
def outcome():
    return nhjax.ensemble(start, starts(), chunk_size=4)


def test_ensemble_values_in_chunks_equal_vmap(outcome):
    expected = jax.jit(jax.vmap(start))(starts())
    assert isinstance(outcome.values, nhjax.Solution)
    assert jax.tree.structure(outcome.values) == jax.tree.structure(expected)

    # XLA rounds slightly differently in vectors of another length.
    def close(x, y):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-14)

    jax.tree.map(close, outcome.values, expected)


def test_ensemble_with_failing_members_lists_them_and_runs_others(outcome):
    assert outcome.failed.tolist() == list(BAD)
    assert outcome.failed_step.tolist() == [0, 0]
    whole = [(index, step, reason) for index, step, reason in outcome.values.failures()]
    assert outcome.failures() == whole
    assert outcome.num_members == 10


def test_ensemble_statistics_with_failing_members_leave_them_out(outcome):
    got = nhjax.ensemble(start, starts(), chunk_size=4, reduce=nhjax.Mean())
    assert got.failures() == outcome.failures()
    good = np.delete(outcome.values.ys, BAD, axis=0)
    np.testing.assert_allclose(got.statistics.ys, good.mean(axis=0), rtol=1e-15)
    assert got.statistics.result is None
    again = nhjax.ensemble(start, np.ones(10)[got.failed], chunk_size=4)
    assert again.failures() == []


def test_ensemble_of_bare_results_lists_failed_members():
    def bare(x):
        good, bad = nhjax.RESULTS.successful, nhjax.RESULTS.nonfinite_state
        return x, nhjax.RESULTS.where(x < 2.0, good, bad)

    got = nhjax.ensemble(bare, jnp.arange(4.0), reduce=nhjax.Maximum())
    assert got.failed.tolist() == [2, 3]
    assert got.failed_step.tolist() == [-1, -1]
    assert float(got.statistics[0]) == 1.0


def test_ensemble_statistics_if_all_members_fail_raise_the_first_reason():
    with pytest.raises(nhjax.IntegrationError, match=r"all 2 members, .* step 0: The"):
        nhjax.ensemble(start, starts()[list(BAD)], reduce=nhjax.Mean(), chunk_size=4)


def test_ensemble_of_several_chunks_compiles_one_program():
    traced = []

    def count(x):
        traced.append(None)
        return 2 * x

    nhjax.ensemble(count, lambda i: i, num_members=10, chunk_size=4)
    # Once for the shapes of its values, and once for the program.
    assert len(traced) == 2


def test_ensemble_members_as_trees_keys_and_functions_equal_vmap():
    keys = jax.random.split(jax.random.key(1), 5)

    def draw(member):
        return jax.random.normal(member["key"]) + member["shift"].astype(float)

    member = {"key": keys, "shift": np.arange(5)}
    got = nhjax.ensemble(draw, member, chunk_size=2).values
    np.testing.assert_array_equal(got, jax.vmap(draw)(member))
    by_index = nhjax.ensemble(
        draw, lambda i: {"key": keys[i], "shift": i}, num_members=5, chunk_size=3
    )
    np.testing.assert_array_equal(by_index.values, got)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"members": {}}, nhjax.ShapeError, "no members"),
        ({"run": lambda x: jax.random.key(0)}, TypeError, "key_data"),
        ({"reduce": {}}, TypeError, "holds no reduction"),
        (
            {"devices": []},
            ValueError,
            "`devices` must be one or more different devices",
        ),
        ({"devices": "cpu"}, TypeError, "`devices` must be a sequence of devices"),
    ],
)
def test_ensemble_with_invalid_argument_raises_with_its_name(arguments, error, message):
    whole = {"run": lambda x: x, "members": np.ones(3)} | arguments
    with pytest.raises(error, match=message):
        nhjax.ensemble(whole.pop("run"), whole.pop("members"), **whole)


def test_ensemble_progress_bar_counts_members_and_needs_a_terminal(monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    nhjax.ensemble(lambda x: x, np.ones(5))
    assert shown.getvalue() == ""
    meter = nhjax.TqdmProgressMeter("sweep", unit="member")
    nhjax.ensemble(lambda x: x, np.ones(5), chunk_size=2, progress_meter=meter)
    assert "sweep: 100%" in shown.getvalue()
    assert "5/5" in shown.getvalue()
    assert "member" in shown.getvalue()


SEVERAL = """
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np, nhjax
from support.ensembles import start, starts
assert len(jax.devices()) == 3
whole, one = nhjax.ensemble(start, starts()), jax.devices()[:1]
alone = nhjax.ensemble(start, starts(), devices=one)
close = lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-14)
jax.tree.map(close, whole.values, alone.values)
assert whole.failures() == alone.failures() != []
reduce = {"variance": nhjax.Variance(), "mean": nhjax.Mean()}
options = {"reduce": reduce, "chunk_size": 60}
x = np.random.default_rng(0).standard_normal(200)
square = lambda x: x * x
fixed = nhjax.ensemble(square, x, fixed_order=True, **options)
alone = nhjax.ensemble(square, x, devices=one, **options)
jax.tree.map(np.testing.assert_array_equal, fixed.statistics, alone.statistics)
free = nhjax.ensemble(square, x, **options).statistics
jax.tree.map(close, free, alone.statistics)
print("the same")
"""


@pytest.mark.long
def test_ensemble_on_several_devices_equals_one_device():
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=3"
    root = Path(__file__).parents[2]
    places = os.pathsep.join([str(root), str(root / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", SEVERAL],
        env=os.environ
        | {"XLA_FLAGS": flags, "PYTHONPATH": places}
        | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "the same\n", done.stderr


def test_ensemble_benchmark_with_few_members_computes_their_mean_energy():
    row = ensembles.measure(members=2500, num_steps=2, rounds=1)
    assert row["failed"] == 0
    # The energy of all members.
    np.testing.assert_allclose(row["mean"], 3.06, atol=1e-3)
    assert "2500 | 2" in ensembles.table([row])
