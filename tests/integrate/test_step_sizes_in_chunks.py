"""Runs whose steps differ, as one program and in chunks: the same bit for bit."""

import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, PIDController, RESULTS, ReversibleController, SaveAt
from nhjax._integrate import _chunks
from support.particle_run import assert_trees_equal
from support.reports import new_meter


# Programs agree bit for bit only in optimised kernels, as users have them.
pytestmark = pytest.mark.usefixtures("optimised_kernels")

SLIDE = nhjax.LagrangianSystem(
    lambda t, q, v, args: 0.5 * v @ v - 0.6 * q[0] ** 2 - 0.2 * q[1] ** 4,
    nonholonomic=lambda t, q, v, args: (v[2] - q[1] * v[0])[None],
)
START = nhjax.initial_state(
    SLIDE, jnp.array([0.4, 0.7, 0.0]), jnp.array([0.9, 0.8, 0.0]), project=True
)
CONTROLLERS = {
    "pid": PIDController(rtol=1e-6, atol=1e-6),
    "reversible": ReversibleController(0.1, lambda t, q, v, args: 1.0 + q @ q),
}


def adaptive(name="pid", y0=START, **options):
    options = {"t1": 2.0, "stepsize_controller": CONTROLLERS[name]} | options
    return nhjax.integrate(SLIDE, LobattoIIIAB(3), y0, **options)


def jitted(name="pid", **options):
    return jax.jit(lambda y: adaptive(name, y0=y, max_steps=60, **options))(START)


def last(tree):
    return jax.tree.map(lambda x: x[-1], tree)


@pytest.fixture(scope="module")
def whole():
    return adaptive(saveat=SaveAt(t0=True, steps=True))


@pytest.mark.parametrize("name", CONTROLLERS)
def test_saved_steps_under_jit_equal_those_of_a_plain_run_before_the_padding(name):
    saveat = SaveAt(t0=True, steps=True)
    got, expected = jitted(name, saveat=saveat), adaptive(name, saveat=saveat)
    number = int(got.stats["num_steps"]) + 1
    assert got.ts.shape == (61,)
    assert expected.ts.shape == (number,)
    prefix, rest = (
        jax.tree.map(lambda x, part=part: x[part], (got.ts, got.ys))
        for part in (slice(number), slice(number, None))
    )
    assert_trees_equal(prefix, (expected.ts, expected.ys))
    assert all(np.all(np.isinf(x)) for x in jax.tree.leaves(rest))
    assert_trees_equal(got.stats, expected.stats)


def value(t, y, args):
    return {"count": jnp.asarray(3, jnp.int32), "flag": y.q[0] > 0, "q": y.q[:2]}


@pytest.mark.parametrize("steps", [3, 1000])
@pytest.mark.parametrize("t1", [False, True])
def test_every_kth_step_is_saved_and_the_end_once(whole, steps, t1):
    taken = np.asarray(whole.ts)
    expected = taken[steps::steps]
    if t1 and (len(taken) - 1) % steps:
        expected = np.append(expected, taken[-1])
    saveat = SaveAt(steps=steps, t1=t1, fn=value)
    plain = adaptive(saveat=saveat)
    np.testing.assert_array_equal(plain.ts, expected)
    assert plain.ys["count"].tolist() == [3] * len(expected)
    assert plain.ys["q"].shape == (len(expected), 2)
    got = jitted(saveat=saveat)
    np.testing.assert_array_equal(got.ts[: len(expected)], expected)
    assert np.all(np.isinf(got.ts[len(expected) :]))
    head = jax.tree.map(lambda x: x[: len(expected)], got.ys)
    assert_trees_equal(head, plain.ys)
    assert got.ys["count"].dtype == jnp.int32


@pytest.fixture
def short_chunks(monkeypatch):
    """Chunks of at most three iterations and four rows."""
    monkeypatch.setattr(_chunks, "_FIRST_ITERATIONS", 3)
    monkeypatch.setattr(_chunks._Schedule, "finished", lambda *_: None)
    monkeypatch.setattr(_chunks, "_LEAST_ROWS", 4)
    monkeypatch.setattr(_chunks, "_MOST_ROWS", 4)


@pytest.fixture
def usual_handler():
    """The handler that an interactive Python has."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.usefixtures("usual_handler", "short_chunks")
def test_interrupted_run_returns_the_steps_before_and_resumes(name):
    saveat = SaveAt(t0=True, steps=True, checkpoint=True)
    expected = adaptive(name, saveat=saveat)
    with pytest.warns(UserWarning, match="interrupted after"):
        got = adaptive(name, saveat=saveat, progress_meter=new_meter(3))
    number = int(got.stats["num_steps"])
    assert got.result == RESULTS.interrupted
    assert 0 < number < int(expected.stats["num_steps"])
    assert got.t1 == got.ts[-1] == expected.ts[number]
    assert_trees_equal(got.ys.q, expected.ys.q[: number + 1])
    rest = adaptive(name, y0=got.checkpoint, saveat=saveat)
    assert_trees_equal(last(rest.ys), last(expected.ys))
    assert_trees_equal(rest.checkpoint, expected.checkpoint)
