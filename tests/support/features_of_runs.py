"""Short tests of outputs, invariants, reports and ensembles, as users run them."""

import os
import tempfile

import jax
import jax.numpy as jnp
import numpy as np
import xarray

import nhjax
from nhjax import SaveAt, systems
from support.user_features import (
    assert_exact,
    close,
    DT,
    feature,
    PARTICLE,
    run,
    STEPS,
    TWO,
)


@feature
def energy_that_is_kept():
    for example in (PARTICLE, systems.Suslov()):
        start = example.initial_state()
        sol = run(example, TWO, y0=start, num_steps=50, invariants="energy")
        expected = example.energy(0.0, start.q, start.v)
        y = jax.tree.map(lambda x: x[-1], sol.ys)
        close(example.energy(5.0, y.q, y.v), expected, 1e-14)
        assert float(sol.stats["max_invariant_error"]) < 1e-14


@feature
def dense_output_and_samples():
    ts = jnp.array([0.05, 0.33, 1.0])
    dense = jax.vmap(run(saveat=SaveAt(dense=True)).evaluate)(ts)
    sampled = run(saveat=SaveAt(ts=ts)).ys
    close(sampled, dense)
    close(dense.q[1], PARTICLE.exact(0.33)[0], 1e-5)


@feature
def saved_functions():
    system = PARTICLE.system
    saveat = SaveAt(
        t0=True, steps=2, t1=True, fn=lambda t, y, args: system.energy(t, y)
    )
    energies = run(saveat=saveat).ys
    assert energies.shape == (6,)
    close(energies, jnp.full(6, energies[0]), 1e-5)


@feature
def a_run_that_is_resumed_from_a_file():
    saveat = SaveAt(t1=True, checkpoint=True)
    with tempfile.TemporaryDirectory() as folder:
        half = run(num_steps=4, saveat=saveat)
        nhjax.save(f"{folder}/half.npz", half.checkpoint)
        resumed = nhjax.load(f"{folder}/half.npz")
    rest = run(y0=resumed, num_steps=STEPS - 4, saveat=saveat)
    close(rest.ys, run(saveat=saveat).ys, 0.0)
    assert_exact(PARTICLE, rest)


@feature
def labelled_data():
    data = run(saveat=SaveAt(steps=True)).to_xarray(coordinates=("x", "y", "z"))
    assert data.q.sel(coordinate="z", time=DT * STEPS).shape == ()


@feature
def events_that_reset_and_end():
    """A ball falls from height 1/2 in unit time and rebounds with half its speed."""
    ball = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - args * q[0])
    bounce = nhjax.Event(
        lambda t, y, args: y.q[0],
        direction=False,
        reset=lambda t, y, args: (y.q, -0.5 * y.v),
    )
    end = nhjax.Event(lambda t, y, args: t - 1.25)

    def found(gravity):
        y0 = nhjax.initial_state(ball, jnp.array([0.5]), jnp.zeros(1), args=gravity)
        options = {"args": gravity, "event": [bounce, end], "dt": 0.3, "num_steps": 9}
        sol = nhjax.integrate(ball, TWO, y0, **options)
        return sol.events.ts[0], sol.t1, sol.events.num

    close(found(1.0), (1.0, 1.25, 2))
    rates = jax.vmap(jax.grad(lambda gravity: found(gravity)[0]))(jnp.array([1.0, 4.0]))
    close(rates, jnp.array([-0.5, -0.0625]))


@feature
def batches():
    dts = jnp.array([0.1, 0.05, -0.1])
    batch = jax.jit(jax.vmap(lambda dt: run(dt=dt).ys))(dts)
    close(jax.tree.map(lambda x: x[0], batch), run().ys)


@feature
def an_ensemble_in_chunks_with_statistics():
    def member(dt):
        return run(method=TWO, dt=dt, throw=False)

    dts = np.array([0.1, 0.05, 300.0, 0.02, 0.08])
    reduce = {"mean": nhjax.Mean(), "variance": nhjax.Variance()}
    reduce |= {"least": nhjax.Minimum(), "most": nhjax.Maximum()}
    reduce["counts"] = nhjax.Histogram([-10, 0, 10], of=lambda sol: sol.ys.q)
    outcome = nhjax.ensemble(member, dts, reduce=reduce, chunk_size=2)
    assert outcome.failed.tolist() == [2]
    with tempfile.TemporaryDirectory() as folder:
        options = {"reduce": reduce, "chunk_size": 2, "out": folder}
        for _ in range(2):
            kept = nhjax.ensemble(member, dts, **options)
            close(kept.statistics, outcome.statistics, atol=0)
    q = nhjax.ensemble(member, dts, chunk_size=2).values.ys.q[[0, 1, 3, 4]]
    got = outcome.statistics
    close(got["mean"].ys.q, q.mean(axis=0))
    close(got["variance"].ys.q, q.var(axis=0, ddof=1))
    close((got["least"].ys.q, got["most"].ys.q), (q.min(axis=0), q.max(axis=0)))
    close(got["counts"].counts[..., 1], np.sum(q >= 0, axis=0))


@feature
def an_ensemble_that_is_stored_and_goes_on():
    def member(dt):
        return run(method=TWO, dt=dt, throw=False)

    dts = np.linspace(0.05, 0.1, 5)
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "sweep.zarr")
        nhjax.ensemble(member, dts, out=path, chunk_size=2)
        os.remove(os.path.join(path, "q", "c", "1", "0", "0"))
        assert nhjax.ensemble(member, dts, out=path, chunk_size=2).failures() == []
        with xarray.open_zarr(path) as data:
            close(data.q.values, nhjax.ensemble(member, dts).values.ys.q)


@feature
def single_precision():
    sol = run(y0=PARTICLE.initial_state(jnp.float32))
    assert sol.ys.q.dtype == jnp.float32
    close(sol.ys.q[-1].astype(float), PARTICLE.exact(1.0)[0], 1e-5)


@feature
def a_failure_is_told():
    y0 = PARTICLE.initial_state()
    wrong = nhjax.State(y0.q, y0.v + 1.0, y0.p, y0.multiplier)
    sol = run(y0=wrong, throw=False)
    assert sol.result == nhjax.RESULTS.inconsistent_start
    try:
        jax.block_until_ready(jax.jit(lambda y0: run(y0=y0).ys.q)(wrong))
    except RuntimeError as error:
        assert "step 0: The initial state violates" in str(error)  # noqa: PT017
    else:
        raise AssertionError("nothing was raised")


@feature
def a_time_loop_of_ones_own():
    system, y0 = PARTICLE.system, PARTICLE.initial_state()
    once = jax.jit(lambda y: nhjax.step(system, TWO, 0.0, DT, y))(y0)
    close(once, jax.tree.map(lambda x: x[0], run(method=TWO, num_steps=1).ys), 0.0)

    def advance(y, k):
        return nhjax.step(system, TWO, k * DT, DT, y), None

    y, _ = jax.lax.scan(advance, y0, jnp.arange(float(STEPS)))
    close(y, jax.tree.map(lambda x: x[0], run(method=TWO).ys), 1e-14)


@feature
def progress_that_is_shown():
    meter = nhjax.TextProgressMeter()
    close(run(progress_meter=meter).ys, run().ys, 1e-14)


@feature
def errors_orders_and_momenta():
    sleigh = systems.RodSleigh()
    sol = run(sleigh, saveat=SaveAt(t0=True, steps=True))
    assert jnp.max(jnp.abs(nhjax.energy_error(sleigh.system, sol))) < 1e-5
    momentum = nhjax.momentum_map(sol.ys, lambda q: jnp.eye(q.size)[0])
    close(momentum, sol.ys.p[:, 0])
    multiplier = nhjax.continuous_multiplier(
        PARTICLE.system, 0.0, PARTICLE.initial_state()
    )
    close(multiplier, PARTICLE.exact(0.0)[2])
    steps = np.array([0.1, 0.05])
    ends = [run(method=TWO, dt=h, num_steps=round(1 / h)).ys.q[-1] for h in steps]
    errors = [float(jnp.max(jnp.abs(q - PARTICLE.exact(1.0)[0]))) for q in ends]
    assert abs(nhjax.convergence_order(steps, errors)[0] - 2) < 0.2


@feature
def pictures():
    sol = run(saveat=SaveAt(t0=True, steps=True))
    lines = nhjax.plot.trajectory(sol, (0, 1)).lines
    close(lines[0].get_xdata(), sol.ys.q[:, 0])
    figures = [
        nhjax.plot.energy(PARTICLE.system, sol),
        nhjax.plot.multiplier(sol),
    ]
    assert all(len(axes.lines) == 1 for axes in figures)
