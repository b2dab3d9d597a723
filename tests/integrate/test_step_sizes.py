"""Runs whose steps differ: given sizes, an end time, output, checkpoints, meters."""

import signal
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import nhjax
from nhjax import (
    Event,
    LobattoIIIAB,
    PIDController,
    RESULTS,
    ReversibleController,
    SaveAt,
)
from nhjax._integrate import _chunks
from support.long import exhaustive_but
from support.particle_run import assert_trees_close, assert_trees_equal
from support.reports import new_meter


METHOD = LobattoIIIAB(3)


def lagrangian(t, q, v, args):
    push = 0.0 if args is None else args * jnp.sin(1.3 * t)
    return 0.5 * v @ v - 0.7 * q[0] ** 2 - 0.25 * q[1] ** 4 - 0.1 * q[2] + push * q[1]


SLIDE = nhjax.LagrangianSystem(
    lagrangian, nonholonomic=lambda t, q, v, args: (v[2] - q[1] * v[0])[None]
)
START = nhjax.initial_state(
    SLIDE, jnp.array([0.4, 0.7, 0.0]), jnp.array([0.9, 0.8, 0.0]), project=True
)
PID = PIDController(rtol=1e-6, atol=1e-6)


def density(t, q, v, args):
    return 1.0 + q[0] ** 2 + 0.5 * q[1] ** 2


REVERSIBLE = ReversibleController(0.1, density)
CONTROLLERS = {"pid": PID, "reversible": REVERSIBLE}
T1 = 2.0


def run(y0=START, **options):
    return nhjax.integrate(SLIDE, METHOD, y0, **options)


def adaptive(name="pid", y0: Any = START, **options):
    options = {"t1": T1, "stepsize_controller": CONTROLLERS[name]} | options
    return run(y0, **options)


def start_with(v):
    return nhjax.initial_state(SLIDE, START.q, v, project=True)


def last(tree):
    return jax.tree.map(lambda x: x[-1], tree)


@pytest.fixture(scope="module")
def whole():
    """A PID run with all of its output."""
    return adaptive(saveat=SaveAt(t0=True, steps=True, dense=True, checkpoint=True))


# Given sizes -------------------------------------------------------------------------

SIZES = 0.1 + 0.05 * jnp.sin(jnp.arange(12.0))


def test_given_sizes_that_are_equal_repeat_a_run_of_constant_steps():
    got = run(dt=jnp.full(12, 0.1), saveat=SaveAt(t0=True, steps=True))
    expected = run(dt=0.1, num_steps=12, saveat=SaveAt(t0=True, steps=True))
    np.testing.assert_allclose(got.ts, expected.ts, rtol=1e-15)
    assert_trees_close(got.ys, expected.ys, rtol=0, atol=1e-14)
    assert int(got.stats["num_steps"]) == 12
    assert int(got.stats["num_rejected_steps"]) == 0


@pytest.mark.parametrize("sign", [1, -1])
def test_given_sizes_take_the_steps_of_single_steps(sign):
    sizes, t, y = sign * SIZES, 0.4, START
    got = run(dt=sizes, t0=t, args=0.8, saveat=SaveAt(steps=True))
    for k, h in enumerate(np.asarray(sizes)):
        y = nhjax.step(SLIDE, METHOD, t, h, y, 0.8)
        t = t + h
        one = jax.tree.map(lambda x, k=k: x[k], got.ys)
        assert_trees_close((one.q, one.p), (y.q, y.p), rtol=0, atol=1e-14)
        np.testing.assert_allclose(got.ts[k], t, rtol=0, atol=1e-15)
    assert got.t1 == got.ts[-1]


@jax.jit
def end_of(sizes):
    return run(dt=sizes, t0=0.4, args=0.8).ys.q[-1]


def test_given_sizes_have_the_derivatives_of_central_differences():
    got = jax.jacrev(end_of)(SIZES)
    d = 1e-5
    for k in range(len(SIZES)):
        two = (end_of(SIZES.at[k].add(x)) for x in (d, -d))
        np.testing.assert_allclose(
            got[:, k], np.subtract(*two) / (2 * d), rtol=0, atol=1e-9
        )


@pytest.mark.long
@pytest.mark.parametrize(
    "adjoint", [nhjax.RecursiveCheckpointAdjoint(), nhjax.ReversibleAdjoint()]
)
def test_given_sizes_with_other_adjoints_have_the_same_gradient(adjoint):
    def end(sizes, v, args, adjoint):
        y = start_with(v)
        sol = run(y, dt=sizes, t0=0.4, args=args, adjoint=adjoint)
        return jnp.sum(jnp.sin(sol.ys.q)) + sol.t1**2

    given = SIZES, START.v, 0.8
    gradient = jax.jit(jax.grad(end, argnums=(0, 1, 2)), static_argnums=3)
    expected = gradient(*given, nhjax.DirectAdjoint())
    assert_trees_close(gradient(*given, adjoint), expected, rtol=1e-10, atol=1e-12)


def test_given_sizes_reversed_retrace_the_run():
    there = run(dt=SIZES, saveat=SaveAt(checkpoint=True))
    back = run(there.checkpoint, dt=-SIZES[::-1])
    assert_trees_close(last(back.ys).q, START.q, rtol=0, atol=1e-14)
    assert_trees_close(last(back.ys).p, START.p, rtol=0, atol=1e-14)
    np.testing.assert_allclose(back.t1, 0, atol=1e-16)


def test_given_sizes_continued_from_a_checkpoint_repeat_one_run_bit_for_bit():
    saveat = SaveAt(t1=True, checkpoint=True)
    expected = run(dt=SIZES, saveat=saveat)
    half = run(dt=SIZES[:5], saveat=saveat).checkpoint
    got = run(half, dt=SIZES[5:], saveat=saveat)
    assert_trees_equal((got.ys, got.t1), (expected.ys, expected.t1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"dt": jnp.array([0.1, -0.1])}, "`dt`: all step sizes must be positive"),
        ({"dt": jnp.array([0.1, 0.0])}, "`dt`: all step sizes must be positive"),
        ({"dt": jnp.array([0.1, jnp.nan])}, "`dt`"),
        ({"dt": jnp.zeros(0)}, "`dt`"),
        ({"dt": jnp.ones((2, 2))}, r"`dt` has shape \(2, 2\)"),
        ({"dt": SIZES, "num_steps": 11}, "`dt` has 12 sizes, but `num_steps` is 11"),
        ({"dt": SIZES, "t1": 1.0}, "`t1` is given together with an array `dt`"),
        ({"dt": SIZES, "stepsize_controller": PID}, "`dt` is an array"),
        ({"dt": 0.1}, "`num_steps` is missing"),
        ({"num_steps": 3}, "`dt` is missing"),
        ({"t1": 1.0}, "`dt` is missing"),
        ({"t1": 1.0, "dt": -0.1}, "`dt` = -0.1 does not lead from `t0`"),
        ({"t1": 1.0, "dt": 0.0}, "`dt` = 0.0 does not lead from `t0`"),
        ({"t1": 0.0, "dt": 0.1}, "`t1` = 0.0 equals `t0`"),
        ({"t1": 1.0, "dt": 0.1, "num_steps": 10}, "`t1` and `num_steps` are both"),
        ({"t1": np.nan, "stepsize_controller": PID}, "`t1`"),
        ({"t1": 1.0, "t0": np.inf, "stepsize_controller": PID}, "`t0`"),
        ({"t1": "1", "stepsize_controller": PID}, "`t1`"),
        ({"stepsize_controller": PID}, "`t1` is missing"),
        ({"num_steps": 3, "dt": 0.1, "max_steps": 9}, "`max_steps` is given together"),
        ({"t1": 1.0, "dt": 0.1, "max_steps": 0}, "`max_steps` must be in"),
        ({"t1": 1.0, "dt": 0.1, "max_steps": 2.0}, "`max_steps` must be an int"),
        ({"t1": 1.0, "dt": 0.1, "max_steps": True}, "`max_steps` must be an int"),
        ({"num_steps": 2.5, "stepsize_controller": PID}, "`num_steps` must be an int"),
        ({"t1": 1.0, "stepsize_controller": "pid"}, "stepsize_controller"),
        ({"t1": 1.0, "stepsize_controller": PIDController}, "stepsize_controller"),
        (
            {
                "num_steps": 3,
                "stepsize_controller": PID,
                "saveat": SaveAt(ts=[0.1]),
            },
            "`ts` needs `t1`",
        ),
        (
            {"t1": 1.0, "stepsize_controller": PID, "saveat": SaveAt(ts=[0.1, 1.1])},
            "`ts` reaches from 0.1 to 1.1, outside the run from 0.0 to 1.0",
        ),
        (
            {"t1": 1.0, "stepsize_controller": PID, "saveat": SaveAt(ts=[0.2, 0.1])},
            "`ts` must be sorted",
        ),
    ],
)
def test_step_sizes_that_do_not_belong_together_raise_an_error_that_names_them(
    options, message
):
    with pytest.raises((ValueError, TypeError), match=message):
        run(**options)


# The end of the run ------------------------------------------------------------------


@pytest.mark.parametrize("name", [None, *CONTROLLERS])
@pytest.mark.parametrize(("t0", "t1"), [(0.0, 2.0), (-1.3, 0.9), (7.1, 4.9)])
def test_run_to_t1_ends_there_exactly(name, t0, t1):
    options: dict[str, Any] = {"t0": t0, "t1": t1, "saveat": SaveAt(steps=True)}
    if name is None:
        sol = run(dt=np.copysign(0.3, t1 - t0), **options)
    else:
        sol = adaptive(name, **options)
    assert float(sol.t1) == t1 == float(sol.ts[-1])
    assert sol.result == RESULTS.successful
    assert np.all(np.diff(sol.ts) * np.sign(t1 - t0) > 0)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize(
    ("t0", "dt", "number"),
    [
        (0.0, 0.1, 10),
        (0.0, 0.7, 10),
        (0.0, 0.3, 57),
        (0.0, 0.01, 1000),
        (0.0, -0.01, 777),
        (50.0, 0.1, 333),
        (-3.3, 0.3, 11),
    ],
)
def test_run_of_constant_steps_to_a_multiple_of_dt_takes_no_further_step(
    dtype, t0, dt, number
):
    y = jax.tree.map(lambda x: x.astype(dtype), START)
    sol = run(y, dt=dt, t0=t0, t1=t0 + number * dt)
    assert int(sol.stats["num_steps"]) == number
    assert sol.t1.dtype == dtype
    assert sol.t1 == jnp.asarray(t0 + number * dt, dtype)


@pytest.mark.parametrize(("t0", "dt"), [(1e6, 0.01), (-3e8, 0.3), (1e9, 0.1)])
def test_run_of_constant_steps_at_a_late_time_takes_no_further_step(t0, dt):
    for number in (1, 10, 31, 777):
        sol = run(dt=dt, t0=t0, t1=t0 + number * dt)
        assert int(sol.stats["num_steps"]) == number


def test_run_of_constant_steps_to_a_time_between_multiples_takes_a_short_step():
    sol = run(dt=0.3, t1=1.0, saveat=SaveAt(t0=True, steps=True))
    np.testing.assert_allclose(np.diff(sol.ts), [0.3, 0.3, 0.3, 0.1], rtol=1e-14)
    expected = run(dt=jnp.array([0.3, 0.3, 0.3, 0.1]))
    assert_trees_close(last(sol.ys).q, last(expected.ys).q, rtol=0, atol=1e-14)
    longer = run(dt=3.0, t1=1.0, saveat=SaveAt(t0=True, steps=True))
    assert np.diff(longer.ts).tolist() == [1.0]


def test_run_of_constant_steps_to_t1_in_float32_stays_in_float32():
    y = jax.tree.map(lambda x: x.astype(jnp.float32), START)
    sol = adaptive(y0=y, stepsize_controller=PIDController(1e-3, 1e-3))
    kinds = {x.dtype for x in jax.tree.leaves((sol.ys, sol.t1, sol.ts))}
    assert kinds == {jnp.dtype("float32")}
    assert float(sol.t1) == T1


@pytest.mark.parametrize("name", exhaustive_but(["reversible"], CONTROLLERS))
def test_run_of_many_num_steps_with_a_controller_ends_after_them(name):
    sol = adaptive(name, t1=None, num_steps=4200)
    assert int(sol.stats["num_steps"]) == 4200


# Output ------------------------------------------------------------------------------


def test_saved_steps_of_a_plain_run_are_those_taken(whole):
    number = int(whole.stats["num_steps"])
    assert whole.ts.shape == (number + 1,) == whole.ys.q.shape[:1]
    assert np.all(np.isfinite(whole.ts))
    assert np.all(np.diff(whole.ts) > 0)
    assert whole.interpolation.num_steps == number


def jitted(name="pid", **options):
    options = {"max_steps": 60} | options
    return jax.jit(lambda y: adaptive(name, y0=y, **options))(START)


def test_saved_times_equal_dense_output_plain_and_under_jit(whole):
    ts = jnp.concatenate([whole.ts[:5], jnp.array([0.9, 0.9, 1.234, T1])])
    ts = jnp.sort(ts)
    saveat = SaveAt(t0=True, ts=ts, t1=True)
    expected = jax.vmap(whole.evaluate)(ts)
    for sol in (adaptive(saveat=saveat), jitted(saveat=saveat)):
        np.testing.assert_array_equal(sol.ts[1:-1], ts)
        inner = jax.tree.map(lambda x: x[1:-1], sol.ys)
        assert_trees_close(inner, expected, rtol=0, atol=1e-13)
        assert_trees_equal(last(sol.ys), last(whole.ys))


def test_saved_times_beyond_the_end_of_a_run_that_failed_are_left_out(whole):
    options = {"saveat": SaveAt(ts=[0.0, 0.1, 1.9]), "max_steps": 9, "throw": False}
    sol = adaptive(**options)
    assert sol.result == RESULTS.max_steps_reached
    assert sol.ts.tolist() == [0.0, 0.1]
    got = jitted(**options)
    np.testing.assert_array_equal(got.ts, [0.0, 0.1, np.inf])
    assert np.all(np.isinf(got.ys.q[2]))
    assert_trees_close(got.ys.q[:2], sol.ys.q, rtol=0, atol=1e-14)


def test_dense_output_meets_the_nodes_and_is_smooth_inside(whole):
    at_nodes = jax.vmap(whole.evaluate)(whole.ts)
    assert_trees_close(at_nodes.q, whole.ys.q, rtol=0, atol=1e-14)
    assert_trees_close(at_nodes.p, whole.ys.p, rtol=0, atol=1e-14)
    fine = run(dt=jnp.full(40, 1.37 / 40))
    # Three stages have an error of the third order inside a step.
    inside = whole.evaluate(1.37)
    np.testing.assert_allclose(inside.q, fine.ys.q[-1], rtol=0, atol=1e-4)
    got = jitted(saveat=SaveAt(dense=True))
    assert_trees_close(got.evaluate(1.37), inside, rtol=0, atol=1e-13)


@pytest.mark.parametrize("t", [-0.01, 2.01, np.nan])
def test_dense_output_outside_of_the_run_raises_an_error(whole, t):
    with pytest.raises((ValueError, nhjax.NonFiniteError), match="outside the run"):
        whole.evaluate(t)
    under_jit = jitted(saveat=SaveAt(dense=True))
    with pytest.raises((ValueError, nhjax.NonFiniteError), match="outside the run"):
        under_jit.evaluate(t)


@pytest.mark.long
def test_dense_output_of_a_backward_run_meets_the_nodes():
    saveat = SaveAt(steps=True, dense=True)
    sol = adaptive(t0=1.0, t1=-1.0, saveat=saveat)
    at_nodes = jax.vmap(sol.evaluate)(sol.ts)
    assert_trees_close(at_nodes.q, sol.ys.q, rtol=0, atol=1e-14)


def test_to_xarray_of_an_adaptive_run_has_its_times(whole):
    data = whole.to_xarray()
    np.testing.assert_array_equal(data.time, whole.ts)
    np.testing.assert_array_equal(data.q, whole.ys.q)
    assert int(data.stats_num_rejected_steps) == int(whole.stats["num_rejected_steps"])


@pytest.mark.parametrize("name", exhaustive_but(["reversible"], CONTROLLERS))
def test_solution_and_checkpoint_survive_files(name, tmp_path):
    sol = adaptive(name, saveat=SaveAt(steps=True, checkpoint=True))
    nhjax.save(tmp_path / "sol.npz", sol)
    got = nhjax.load(tmp_path / "sol.npz")
    assert_trees_equal((got.ts, got.ys, got.stats), (sol.ts, sol.ys, sol.stats))
    nhjax.save(tmp_path / "checkpoint.npz", sol.checkpoint)
    loaded = nhjax.load(tmp_path / "checkpoint.npz")
    rest = (adaptive(name, y0=x, t1=3.0).ys for x in (loaded, sol.checkpoint))
    assert_trees_equal(*rest)


SPEEDS = jnp.array([0.2, 1.0, 3.0])


@pytest.mark.parametrize("name", exhaustive_but(["pid"], CONTROLLERS))
def test_vmap_of_adaptive_runs_gives_each_member_its_own_steps(name):
    saveat = SaveAt(t0=True, steps=True, dense=True)

    def one(speed, **options):
        return adaptive(name, start_with(speed * START.v), saveat=saveat, **options)

    several = jax.jit(jax.vmap(lambda x: one(x, max_steps=120)))(SPEEDS)
    numbers = several.stats["num_steps"].tolist()
    assert len(set(numbers)) == 3
    at = jnp.array([0.0, 0.7, T1])
    inside = jax.vmap(lambda sol: jax.vmap(sol.evaluate)(at))(several)
    for i, speed in enumerate(SPEEDS):
        single, number = one(speed), numbers[i]
        assert int(single.stats["num_steps"]) == number
        rejected = several.stats["num_rejected_steps"][i]
        assert rejected == single.stats["num_rejected_steps"]
        np.testing.assert_allclose(
            several.ts[i, : number + 1], single.ts, rtol=1e-11, atol=0
        )
        assert np.all(np.isinf(several.ts[i, number + 1 :]))
        np.testing.assert_allclose(
            several.ys.q[i, : number + 1], single.ys.q, rtol=0, atol=1e-11
        )
        got = jax.tree.map(lambda x, i=i: x[i], inside)
        expected = jax.vmap(single.evaluate)(at)
        assert_trees_close(got.q, expected.q, rtol=0, atol=1e-11)


# Checkpoints -------------------------------------------------------------------------


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("max_steps", [1, 7, 11])
def test_run_cut_by_max_steps_and_resumed_repeats_the_whole_run_bit_for_bit(
    name, max_steps
):
    saveat = SaveAt(steps=True, checkpoint=True)
    expected = adaptive(name, saveat=saveat)
    cut = adaptive(name, saveat=saveat, max_steps=max_steps, throw=False)
    assert cut.result == RESULTS.max_steps_reached
    tried = cut.stats["num_steps"] + cut.stats["num_rejected_steps"]
    assert int(tried) == max_steps
    assert int(cut.stats["failed_step"]) == int(cut.stats["num_steps"])
    rest = adaptive(name, y0=cut.checkpoint, saveat=saveat)
    joined = jax.tree.map(
        lambda *x: jnp.concatenate(x), (cut.ts, cut.ys), (rest.ts, rest.ys)
    )
    assert_trees_equal(joined, (expected.ts, expected.ys))
    assert_trees_equal(rest.checkpoint, expected.checkpoint)
    rejected = cut.stats["num_rejected_steps"] + rest.stats["num_rejected_steps"]
    assert rejected == expected.stats["num_rejected_steps"]


@pytest.mark.parametrize("name", exhaustive_but(["reversible"], CONTROLLERS))
def test_checkpoint_of_constant_steps_continues_with_steps_that_differ(name):
    first = run(dt=0.1, num_steps=7, t0=0.5, saveat=SaveAt(checkpoint=True)).checkpoint
    got = adaptive(name, y0=first, saveat=SaveAt(t0=True, t1=True))
    np.testing.assert_allclose(got.ts, [1.2, T1], rtol=1e-15)
    expected = adaptive(name, y0=first.state, t0=first.t)
    np.testing.assert_allclose(got.ys.q[-1], expected.ys.q[-1], rtol=0, atol=1e-13)


@pytest.mark.parametrize("name", exhaustive_but(["reversible"], CONTROLLERS))
def test_checkpoint_of_steps_that_differ_continues_with_constant_steps(name):
    first = adaptive(name, saveat=SaveAt(checkpoint=True)).checkpoint
    assert float(first.t) == T1
    for options in ({"num_steps": 10}, {"t1": 3.0}):
        got = run(first, dt=0.1, **options, saveat=SaveAt(t0=True, steps=True))
        np.testing.assert_allclose(got.ts, 2 + 0.1 * np.arange(11), rtol=1e-15)
        expected = run(first.state, t0=T1, dt=0.1, num_steps=10)
        np.testing.assert_allclose(got.ys.q[-1], expected.ys.q[-1], rtol=0, atol=1e-13)


def test_checkpoint_of_constant_steps_to_t1_continues_with_another_dt():
    first = run(dt=0.1, t1=1.0, saveat=SaveAt(checkpoint=True)).checkpoint
    got = run(first, dt=0.05, t1=1.2, saveat=SaveAt(t0=True, steps=True))
    np.testing.assert_allclose(np.diff(got.ts), 0.05, rtol=1e-14)


@pytest.mark.parametrize("names", [("pid", "reversible"), ("reversible", "pid")])
def test_checkpoint_of_another_controller_continues_as_its_state(names):
    first = adaptive(names[0], saveat=SaveAt(checkpoint=True)).checkpoint
    options = {"t1": 3.0, "saveat": SaveAt(steps=True)}
    got = adaptive(names[1], y0=first, **options)
    expected = adaptive(names[1], y0=first.state, t0=first.t, **options)
    np.testing.assert_allclose(got.ts, expected.ts, rtol=1e-13)


def test_checkpoint_with_smaller_dtmax_takes_no_longer_step():
    first = adaptive(saveat=SaveAt(checkpoint=True)).checkpoint
    sizes = PIDController(1e-6, 1e-6, dtmax=0.02)
    options = {"t1": 2.2, "stepsize_controller": sizes}
    sol = adaptive(y0=first, **options, saveat=SaveAt(t0=True, steps=True))
    assert np.max(np.diff(sol.ts)) <= 0.02 * (1 + 1e-9)


@pytest.mark.parametrize("damage", [lambda x: x[:-1], lambda x: (*x, x[0])])
def test_checkpoint_with_a_damaged_clock_starts_with_a_new_one(damage):
    first = adaptive(saveat=SaveAt(checkpoint=True)).checkpoint
    damaged = nhjax.Checkpoint(**(vars(first) | {"clock": damage(first.clock)}))
    got = adaptive(y0=damaged, t1=3.0, saveat=SaveAt(steps=True))
    expected = adaptive(y0=first.state, t0=first.t, t1=3.0, saveat=SaveAt(steps=True))
    np.testing.assert_allclose(got.ts, expected.ts, rtol=1e-13)


# Progress and interruption -----------------------------------------------------------


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


OPTIONS_OF_METERS = {
    "pid": {"stepsize_controller": PID},
    "reversible": {"stepsize_controller": REVERSIBLE},
    "constant": {"dt": 0.013},
    "stopped": {
        "stepsize_controller": PID,
        "event": Event(lambda t, y, args: y.q[0] - 0.9),
    },
}


@pytest.mark.parametrize("name", exhaustive_but(["pid", "stopped"], OPTIONS_OF_METERS))
@pytest.mark.parametrize("is_jitted", [False, True])
@pytest.mark.usefixtures("short_chunks")
def test_progress_of_a_run_to_t1_grows_to_the_end(name, is_jitted):
    meter = new_meter()

    def end(y):
        options = {"t1": T1, "max_steps": 200, "progress_meter": meter}
        return run(y, **options, **OPTIONS_OF_METERS[name]).t1

    jax.block_until_ready((jax.jit(end) if is_jitted else end)(START))
    jax.effects_barrier()
    done = [x for x, total in meter.seen if total == 100]
    assert len(done) == len(meter.seen) > 3
    assert done == sorted(set(done))
    assert done[-1] == 100


@pytest.mark.long
@pytest.mark.usefixtures("short_chunks")
def test_progress_of_num_steps_steps_grows_with_the_steps():
    meter = new_meter()
    adaptive(t1=None, num_steps=30, progress_meter=meter)
    done = [x for x, _ in meter.seen]
    assert done == sorted(set(done))
    assert done[-1] == 100


def test_progress_of_a_batch_is_that_of_its_slowest_member():
    meter = new_meter()

    def end(speed):
        y = start_with(speed * START.v)
        return adaptive(y0=y, max_steps=120, progress_meter=meter).t1

    jax.block_until_ready(jax.jit(jax.vmap(end))(SPEEDS))
    jax.effects_barrier()
    done = [x for x, _ in meter.seen]
    assert done == sorted(set(done))
    assert done[-1] == 100


@pytest.mark.parametrize("is_jitted", [False, True])
@pytest.mark.usefixtures("short_chunks")
def test_text_meter_of_a_run_to_t1_prints_percents(is_jitted, capsys):
    def end(y):
        meter = nhjax.TextProgressMeter()
        return adaptive(y0=y, max_steps=61, progress_meter=meter).t1

    for _ in range(2):
        jax.block_until_ready((jax.jit(end) if is_jitted else end)(START))
        jax.effects_barrier()
        lines = capsys.readouterr().out.splitlines()
        assert lines[-1] == "100 % of the run"
        assert 3 < len(lines) <= 11


@pytest.mark.long
@pytest.mark.parametrize("is_jitted", [False, True])
@pytest.mark.usefixtures("short_chunks")
def test_tqdm_meter_of_a_run_to_t1_closes_its_bar(is_jitted, capsys):
    meter = nhjax.TqdmProgressMeter("slide")

    def end(y):
        return adaptive(y0=y, max_steps=61, progress_meter=meter).t1

    jax.block_until_ready((jax.jit(end) if is_jitted else end)(START))
    jax.effects_barrier()
    assert "100/100" in capsys.readouterr().err
    assert not meter._open.bars


@pytest.mark.usefixtures("usual_handler", "short_chunks")
def test_interrupted_run_with_samples_returns_those_before():
    saveat = SaveAt(ts=[0.0, 0.05, 1.99])
    with pytest.warns(UserWarning, match="interrupted after"):
        got = adaptive(saveat=saveat, progress_meter=new_meter(3))
    assert got.ts.tolist() == [0.0, 0.05]


# With other features -----------------------------------------------------------------


def test_energy_kept_by_an_adaptive_run_is_constant_to_round_off(whole):
    kept = adaptive(invariants="energy", saveat=SaveAt(t0=True, steps=True))
    energies, others = (
        jax.vmap(lambda y: y.v @ y.v - lagrangian(0.0, y.q, y.v, None))(x)
        for x in (kept.ys, whole.ys)
    )
    assert np.ptp(energies) < 1e-14 < np.ptp(others)
    assert float(kept.stats["max_invariant_error"]) < 1e-14


def test_exported_adaptive_run_without_throw_gives_the_same_end():
    def end(v):
        y = nhjax.initial_state(SLIDE, START.q, v, project=True, throw=False)
        sol = adaptive(y0=y, max_steps=60, throw=False)
        return sol.ys.q[-1], sol.result._value

    program = export.export(jax.jit(end))(START.v)
    got = export.deserialize(program.serialize()).call(START.v)
    assert_trees_close(got, jax.jit(end)(START.v), rtol=1e-12)


@pytest.mark.long
def test_ensemble_of_adaptive_runs_equals_single_runs():
    def one(speed):
        y = start_with(speed * START.v)
        return adaptive(y0=y, max_steps=120, throw=False)

    outcome = nhjax.ensemble(one, SPEEDS, chunk_size=2)
    for i, speed in enumerate(SPEEDS):
        single = one(speed)
        np.testing.assert_allclose(
            outcome.values.ys.q[i], single.ys.q, rtol=0, atol=1e-11
        )
        assert outcome.values.stats["num_steps"][i] == single.stats["num_steps"]
