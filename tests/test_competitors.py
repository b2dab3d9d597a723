"""heyoka, which nhjax is compared with, solves the same equations."""

import math
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks._competitors import extrapolated, problems
from benchmarks._ladders import Case, heyoka_runs
from nhjax._system import linearise


if sys.platform != "linux" or sys.version_info >= (3, 15):
    pytest.skip("heyoka has no wheel for this Python", allow_module_level=True)

import heyoka as hy

from benchmarks import _heyoka


PROBLEMS = problems()
MEMBERS = 11  # not a multiple of any number of lanes
THREADS = 2


def initial_states(name, members=MEMBERS):
    problem = PROBLEMS[name]
    q, v = (np.asarray(x) for x in problem.members(members))
    return q, v, problem.to_state(q, v)


@pytest.mark.parametrize("name", PROBLEMS)
def test_heyoka_equations_equal_other_competitors(name):
    pairs = _heyoka.equations(name)
    field = hy.cfunc([right for _, right in pairs], [left for left, _ in pairs])
    for y in initial_states(name)[2]:
        expected = PROBLEMS[name].field(math, y.tolist())
        np.testing.assert_allclose(field(y), expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", PROBLEMS)
def test_heyoka_accelerations_equal_nhjax(name):
    problem = PROBLEMS[name]
    pairs = _heyoka.equations(name)
    field = hy.cfunc([right for _, right in pairs], [left for left, _ in pairs])
    for q, v, y in zip(*initial_states(name, 3), strict=True):
        time, system = jnp.asarray(0.0), problem.example.system
        acceleration = linearise(
            system, time, jnp.asarray(q), jnp.asarray(v), None
        ).acceleration
        expected = problem.to_state(q, np.asarray(acceleration))[len(q) :]
        np.testing.assert_allclose(field(y)[len(q) :], expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", PROBLEMS)
def test_heyoka_run_ends_at_the_reference(name):
    y0 = initial_states(name, 1)[2]
    run, _ = _heyoka.heyoka_run(name, "single", y0, 20.0)(1e-14)
    expected = extrapolated(PROBLEMS[name], y0, 20.0, 0.2)
    np.testing.assert_allclose(run(), expected, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("layout", _heyoka.layouts(MEMBERS, THREADS))
def test_heyoka_ensemble_in_each_layout_ends_at_the_reference(layout):
    y0 = initial_states("chaotic")[2]
    run, seconds = _heyoka.heyoka_run("chaotic", layout, y0, 2.0, THREADS)(1e-13)
    expected = extrapolated(PROBLEMS["chaotic"], y0, 2.0, 0.2)
    # The second run starts where the first did.
    for _ in range(2):
        np.testing.assert_allclose(run(), expected, rtol=0.0, atol=1e-12)
    assert seconds > 0


@pytest.mark.long
def test_heyoka_errors_decrease_with_its_tolerance():
    runs = [*heyoka_runs(Case("CVT", 2.0, 3), limit=6, longest=math.inf)]
    assert all(math.isfinite(run.compile) for run in runs)
    ladder = [run for run in runs if run.method == "heyoka batch"]
    errors = [run.error for run in ladder]
    assert len(errors) == 6
    # The last two are as small as round-off, in any order.
    assert errors[:4] == sorted(errors[:4], reverse=True)
    assert errors[0] > 1e-6
    assert errors[-1] < 1e-14
    assert {run.method for run in runs} >= {"heyoka single", "heyoka ensemble batch"}
