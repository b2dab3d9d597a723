"""Runs outside of transformations, which the host drives in chunks of steps."""

import signal
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax._integrate import _chunks
from nhjax.systems import HeavyTopSE3
from support.particle_run import assert_trees_close, assert_trees_equal


# As in `test_num_steps`, programs agree bit for bit only in optimised kernels.
pytestmark = pytest.mark.usefixtures("optimised_kernels")

METHOD = nhjax.LobattoIIIAB(3)
traces: list[int] = []


def sled(stiffness: float) -> nhjax.LagrangianSystem:
    """A blade on a plane with a spring; each stiffness compiles another program."""

    def lagrangian(t, q, v, args):
        traces.append(1)
        kinetic = 0.5 * (v[0] ** 2 + v[1] ** 2 + 0.7 * v[2] ** 2)
        return kinetic - 0.5 * stiffness * (q[0] ** 2 + q[1] ** 2)

    def no_slip(t, q, v, args):
        return jnp.array([jnp.sin(q[2]) * v[0] - jnp.cos(q[2]) * v[1]])

    return nhjax.LagrangianSystem(lagrangian, nonholonomic=no_slip)


def start(system):
    q, v = jnp.array([0.3, -0.2, 0.4]), jnp.array([0.5, 0.1, 0.9])
    return nhjax.initial_state(system, q, v, project=True)


def run(system, num_steps=40, **options):
    y0 = options.pop("y0", None) or start(system)
    dt = options.pop("dt", 0.05)
    return nhjax.integrate(system, METHOD, y0, dt=dt, num_steps=num_steps, **options)


def compiled_as_a_whole(system, num_steps=40, **options):
    """The same run as one program."""
    return jax.jit(lambda dt: run(system, num_steps, dt=dt, **options))(0.05)


@pytest.fixture(scope="module")
def system():
    return sled(1.3)


@pytest.fixture
def short_chunks(monkeypatch):
    """Chunks of at most three iterations and four rows."""
    monkeypatch.setattr(_chunks, "_FIRST_ITERATIONS", 3)
    monkeypatch.setattr(_chunks._Schedule, "finished", lambda *_: None)
    monkeypatch.setattr(_chunks, "_LEAST_ROWS", 4)
    monkeypatch.setattr(_chunks, "_MOST_ROWS", 4)


def norm(t, y, args):
    return {"square": y.q @ y.q, "angle": y.q[2]}


BOUNCE = nhjax.Event(
    lambda t, y, args: y.q[0] - 0.35,
    reset=lambda t, y, args: (y.q, -y.v),
    direction=True,
    max_events=64,
)
STOP = nhjax.Event(lambda t, y, args: y.q[0] - 0.4)

OPTIONS = {
    "end": {},
    "both ends": {"saveat": SaveAt(t0=True, t1=True)},
    "steps": {"saveat": SaveAt(t0=True, steps=True)},
    "every seventh": {"saveat": SaveAt(t0=True, steps=7, t1=True)},
    "function": {"saveat": SaveAt(steps=3, fn=norm)},
    "checkpoint": {"saveat": SaveAt(steps=2, checkpoint=True)},
    "reset": {"saveat": SaveAt(t0=True, steps=4, t1=True), "event": BOUNCE},
    "stop": {"saveat": SaveAt(steps=True), "event": STOP},
}


# The same results as one program -----------------------------------------------------


@pytest.mark.usefixtures("short_chunks")
@pytest.mark.parametrize("name", OPTIONS)
def test_run_in_chunks_equals_one_program(name):
    system, options = sled(1.7), OPTIONS[name]
    got, expected = run(system, **options), compiled_as_a_whole(system, **options)
    if name == "checkpoint":
        # A jitted run with a checkpoint hides the constants of its start.
        assert_trees_close(got.ys, expected.ys, rtol=1e-12, atol=1e-12)
        return
    assert_trees_equal(jax.tree.leaves(got), jax.tree.leaves(expected))


def test_run_in_chunks_on_a_group_equals_one_program():
    top = HeavyTopSE3()
    y0 = top.initial_state()

    def end(dt):
        saveat = SaveAt(t0=True, steps=3)
        return nhjax.integrate(
            top.system, METHOD, y0, dt=dt, num_steps=10, saveat=saveat
        )

    got, expected = end(0.02), jax.jit(end)(0.02)
    assert_trees_equal(got.ys, expected.ys)
    assert_trees_equal(got.stats, expected.stats)


@pytest.mark.usefixtures("short_chunks")
def test_samples_of_a_run_in_chunks_equal_one_program():
    system = sled(1.7)
    ts = jnp.sort(jnp.concatenate([jnp.linspace(0, 2, 83), jnp.array([0.31, 0.31])]))
    saveat = SaveAt(t0=True, ts=ts, t1=True)
    got = run(system, saveat=saveat)
    expected = compiled_as_a_whole(system, saveat=saveat)
    np.testing.assert_array_equal(got.ts, expected.ts)
    assert_trees_close(got.ys, expected.ys, rtol=1e-13, atol=1e-14)


@pytest.mark.usefixtures("short_chunks")
def test_dense_output_of_a_run_in_chunks_equals_one_program():
    system = sled(1.7)
    saveat = SaveAt(dense=True)
    got = run(system, saveat=saveat)
    expected = compiled_as_a_whole(system, saveat=saveat)
    for t in (0.0, 0.513, 2.0):
        assert_trees_close(
            got.evaluate(t), expected.evaluate(t), rtol=1e-13, atol=1e-14
        )


@pytest.mark.usefixtures("short_chunks")
def test_failed_run_in_chunks_stays_at_last_good_state():
    def sticky(t, q, v, args):
        return jnp.array([0.0, 0.0, jnp.where(t > 1.02, jnp.nan, 0.0)])

    whole = sled(1.7)
    system = nhjax.LagrangianSystem(
        whole.lagrangian, nonholonomic=whole.nonholonomic, force=sticky
    )
    options = {"throw": False, "saveat": SaveAt(steps=True)}
    got, expected = run(system, **options), compiled_as_a_whole(system, **options)
    assert int(got.stats["failed_step"]) == 20
    assert_trees_equal(jax.tree.leaves(got), jax.tree.leaves(expected))


def test_run_in_chunks_saves_random_keys():
    system = sled(5.0)
    saveat = SaveAt(steps=True, fn=lambda t, y, args: jax.random.key(3))
    assert run(system, 5, saveat=saveat).ys.shape == (5,)


# Compiled once -----------------------------------------------------------------------


def test_other_lengths_and_outputs_do_not_trace_again(system):
    y0 = start(system)
    run(system, y0=y0)
    run(system, y0=y0, saveat=SaveAt(dense=True))
    run(system, y0=y0, saveat=SaveAt(ts=[0.1]))
    count = len(traces)
    for num_steps in (1, 3, 300):
        for saveat in (
            SaveAt(t1=True),
            SaveAt(t0=True, t1=True, checkpoint=True),
            SaveAt(steps=True),
            SaveAt(steps=2, t1=True),
            SaveAt(t0=True, ts=[0.01, 0.02, 0.05]),
            SaveAt(dense=True),
        ):
            run(system, num_steps, y0=y0, saveat=saveat)
    run(system, y0=y0, adjoint=nhjax.ReversibleAdjoint())
    run(system, y0=y0, progress_meter=Presses(at=10**9))
    assert len(traces) == count


# Ctrl-C ------------------------------------------------------------------------------


class Presses(nhjax.AbstractProgressMeter):
    """A user who presses Ctrl-C after a number of steps."""

    at: int

    def update(self, done: int, total: int) -> None:
        """Press Ctrl-C if it is time."""
        if done == self.at:
            signal.raise_signal(signal.SIGINT)


@pytest.fixture(autouse=True)
def usual_handler():
    """The handler that an interactive Python has."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("throw", [True, False])
def test_interrupted_run_returns_the_steps_before(system, throw):
    saveat = SaveAt(t0=True, steps=2, t1=True, checkpoint=True)
    with pytest.warns(UserWarning, match="interrupted after 13 of 40 steps"):
        got = run(system, saveat=saveat, progress_meter=Presses(at=13), throw=throw)
    assert got.result == nhjax.RESULTS.interrupted
    expected = run(system, 13, saveat=saveat)
    assert_trees_equal((got.ts, got.ys), (expected.ts, expected.ys))
    assert got.t1 == expected.t1
    assert_trees_equal(got.stats, expected.stats)
    rest = nhjax.integrate(system, METHOD, got.checkpoint, dt=0.05, num_steps=27)
    assert_trees_equal(rest.ys, run(system).ys)


def test_interrupted_run_with_samples_returns_those_before(system):
    ts = [0.01, 0.31, 0.64, 0.66, 1.9]
    with pytest.warns(UserWarning, match="interrupted"):
        got = run(system, saveat=SaveAt(ts=ts), progress_meter=Presses(at=13))
    np.testing.assert_allclose(got.ts, ts[:3])
    with pytest.warns(UserWarning, match="interrupted"):
        got = run(system, saveat=SaveAt(dense=True), progress_meter=Presses(at=13))
    expected = run(system, 13, saveat=SaveAt(dense=True)).evaluate(0.64)
    assert_trees_equal(got.evaluate(0.64), expected)
    with pytest.raises(ValueError, match="outside the run"):
        got.evaluate(0.7)


def test_interrupted_run_with_events_returns_the_rows_before():
    system, options = sled(6.0), OPTIONS["reset"]
    whole = run(system, 200, **options)
    assert int(whole.events.num) > 0
    with pytest.warns(UserWarning, match="interrupted"):
        got = run(system, 200, progress_meter=Presses(at=18), **options)
    count = got.ts.shape[0] - 1
    assert 0 < count < whole.ts.shape[0] - 1
    np.testing.assert_array_equal(got.ts[:count], whole.ts[:count])
    np.testing.assert_array_equal(got.ys.q[:count], whole.ys.q[:count])
    assert int(got.events.num) <= int(whole.events.num)


def test_pressed_twice_raises_keyboard_interrupt(system):
    class Twice(nhjax.AbstractProgressMeter):
        def update(self, done, total):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        run(system, progress_meter=Twice())


def test_handler_of_the_user_is_left_alone(system):
    pressed = []
    signal.signal(signal.SIGINT, lambda *_: pressed.append(1))
    try:
        sol = run(system, progress_meter=Presses(at=13))
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    assert pressed == [1]
    assert sol.result == nhjax.RESULTS.successful


def test_run_in_another_thread_needs_no_handler(system):
    found = []
    thread = threading.Thread(target=lambda: found.append(run(system).ys.q))
    thread.start()
    thread.join()
    np.testing.assert_array_equal(found[0], run(system).ys.q)


# The buffers -------------------------------------------------------------------------


def test_buffers_of_large_rows_are_short():
    small = jax.ShapeDtypeStruct((3,), jnp.float64)
    large = jax.ShapeDtypeStruct((10**7,), jnp.float64)
    assert _chunks.room_for(small) == 4096
    assert _chunks.room_for((small, large)) == 16
    assert _chunks.room_for(jax.ShapeDtypeStruct((1000,), jnp.float64)) == 128
