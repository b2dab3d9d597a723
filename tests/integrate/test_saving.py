"""The output of a run: both ends, steps, samples, and functions of the state."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax import SaveAt
from support.particle_run import (
    assert_trees_close,
    assert_trees_equal,
    DT,
    PARTICLE,
    run,
    STEPS,
)


@pytest.fixture(scope="module")
def full():
    return run(saveat=SaveAt(t0=True, steps=True))


@pytest.fixture(scope="module")
def dense():
    return run(saveat=SaveAt(dense=True))


# SaveAt -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("saveat", "nodes"),
    [
        (SaveAt(t1=True), [20]),
        (SaveAt(t0=True), [0]),
        (SaveAt(t0=True, t1=True), [0, 20]),
        (SaveAt(steps=True), range(1, 21)),
        (SaveAt(steps=True, t1=True), range(1, 21)),
        (SaveAt(steps=7), [7, 14]),
        (SaveAt(t0=True, steps=7, t1=True), [0, 7, 14, 20]),
        (SaveAt(steps=5, t1=True), [5, 10, 15, 20]),
        (SaveAt(steps=20), [20]),
        (SaveAt(steps=21, t1=True), [20]),
        (SaveAt(t0=True, steps=7, dense=True), [0, 7, 14]),
    ],
)
def test_saved_every_kth_step_equals_full_output(saveat, nodes, full):
    sol = run(saveat=saveat)
    assert_trees_equal(
        (sol.ts, sol.ys),
        jax.tree.map(lambda x: x[jnp.asarray(nodes)], (full.ts, full.ys)),
    )
    assert sol.ts.shape == (len(nodes),)
    if saveat is not None:
        assert saveat.num_saved(STEPS) == len(nodes)


def test_saved_full_output_starts_at_y0_and_ends_at_t1(full):
    y0 = PARTICLE.initial_state()
    start = jax.tree.map(lambda x: x[0], full.ys)
    assert_trees_equal((start.q, start.v, start.p), (y0.q, y0.v, y0.p))
    # The run computes the multiplier of its first state again.
    np.testing.assert_allclose(start.multiplier, y0.multiplier, rtol=1e-14)
    np.testing.assert_array_equal(full.ts, DT * np.arange(STEPS + 1))
    assert full.ys.q.shape == full.ys.v.shape == full.ys.p.shape == (STEPS + 1, 3)
    assert full.ys.multiplier.shape == (STEPS + 1, 1)
    assert (float(full.t0), float(full.t1)) == (0.0, DT * STEPS)
    assert full.interpolation is None


def test_saved_dense_output_alone_has_no_states(dense):
    assert dense.ts is None
    assert dense.ys is None


TIMES = [0.0, 0.03, 0.1, 0.1, 0.15, 0.7, 1.2345, 1.99, 2.0]


def test_saved_samples_equal_dense_output(dense, full):
    sol = run(saveat=SaveAt(ts=TIMES))
    np.testing.assert_array_equal(sol.ts, TIMES)
    expected = jax.vmap(dense.evaluate)(jnp.asarray(TIMES))
    assert_trees_close(sol.ys, expected, rtol=1e-13, atol=1e-15)
    nodes, samples = jnp.array([0, 1, 1, 7, 20]), jnp.array([0, 2, 3, 5, 8])
    assert_trees_close(
        jax.tree.map(lambda x: x[samples], sol.ys),
        jax.tree.map(lambda x: x[nodes], full.ys),
        rtol=1e-14,
        atol=1e-15,
    )
    assert_trees_equal(sol.stats, full.stats)


def test_saved_samples_with_both_ends_are_in_order(full):
    for is_dense in (False, True):
        saveat = SaveAt(t0=True, t1=True, ts=[0.25, 0.5], dense=is_dense)
        sol = run(saveat=saveat)
        np.testing.assert_array_equal(sol.ts, [0.0, 0.25, 0.5, 2.0])
        assert saveat.num_saved(STEPS) == 4
        assert_trees_equal(
            jax.tree.map(lambda x: x[jnp.array([0, 3])], sol.ys),
            jax.tree.map(lambda x: x[jnp.array([0, STEPS])], full.ys),
        )
        np.testing.assert_allclose(sol.ys.q[2], full.ys.q[5], rtol=1e-14)


def test_saved_samples_at_integer_or_other_precision_times_keep_dtype():
    sol = run(saveat=SaveAt(ts=np.array([0, 1, 2])))
    assert sol.ts.dtype == jnp.float64
    again = run(saveat=SaveAt(ts=np.array([0.0, 1.0, 2.0], np.float32)))
    assert_trees_equal(sol.ys, again.ys)


def test_saved_samples_with_negative_dt_equal_dense_output(full):
    ts = [2.0, 1.5, 0.31, 0.0]
    end = jax.tree.map(lambda x: x[-1], full.ys)
    sol = run(y0=end, t0=full.t1, dt=-DT, saveat=SaveAt(ts=ts))
    np.testing.assert_array_equal(sol.ts, ts)
    np.testing.assert_allclose(sol.t1, 0.0, atol=1e-15)
    nodes = jax.tree.map(lambda x: x[jnp.array([20, 15, 0])], full.ys)
    there = jax.tree.map(lambda x: x[jnp.array([0, 1, 3])], sol.ys)
    # The symmetric closure makes a step of -h undo a step of h.
    assert_trees_close(there, nodes, rtol=1e-12, atol=1e-13)


def test_saved_function_of_the_state_equals_its_values(full):
    system = PARTICLE.system

    def fn(t, y, args):
        return {"energy": args * system.energy(t, y), "time": t, "one": 1.0}

    args = 2.0
    saveat = SaveAt(t0=True, steps=6, t1=True, fn=fn)
    sol = run(saveat=saveat, args=args)
    nodes = jnp.array([0, 6, 12, 18, 20])
    assert set(sol.ys) == {"energy", "time", "one"}
    np.testing.assert_array_equal(sol.ys["time"], full.ts[nodes])
    np.testing.assert_array_equal(sol.ys["one"], np.ones(5))
    energy = jax.vmap(system.energy)(full.ts, full.ys)[nodes]
    np.testing.assert_allclose(sol.ys["energy"], 2 * energy, rtol=1e-15)


@pytest.mark.parametrize(
    "saveat",
    [
        SaveAt(t1=True),
        SaveAt(t0=True, steps=100, t1=True),
        SaveAt(steps=99),
        SaveAt(ts=[0.1, 7.7, 33.0]),
    ],
    ids=["t1", "steps with t1", "steps with a rest", "ts"],
)
def test_saved_every_kth_step_needs_no_full_buffer(saveat):
    steps = 1000

    def program(y0):
        return run(y0=y0, num_steps=steps, saveat=saveat, throw=False).ys

    lowered = jax.jit(program).lower(PARTICLE.initial_state())
    arrays = re.findall(r"\b(\w+)\[([\d,]+)\]", lowered.compile().as_text() or "")
    floats = {shape for kind, shape in arrays if kind == "f64"}
    assert floats  # the pattern does find arrays
    sizes = {int(np.prod([int(n) for n in shape.split(",")])) for shape in floats}
    assert max(sizes) < steps
