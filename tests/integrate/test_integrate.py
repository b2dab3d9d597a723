"""The time loop: explicit time, reports, progress meters and single precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import (
    HarmonicOscillator,
)
from support import helpers
from support.particle_run import assert_trees_close, DT, PARTICLE, run, STEPS


# Time ---------------------------------------------------------------------------------


def test_run_with_explicit_time_continues_from_its_end():
    system, y0, args = helpers.problem("driven")
    method = nhjax.LobattoIIIAB(3)

    def part(y, t0, dt=0.05):
        sol = nhjax.integrate(
            system,
            method,
            y,
            dt=dt,
            num_steps=STEPS,
            t0=t0,
            args=args,
            saveat=SaveAt(t0=True, steps=5),
        )
        return sol, jax.tree.map(lambda x: x[-1], sol.ys)

    first, middle = part(y0, 0.0)
    second, end = part(middle, first.t1)
    np.testing.assert_allclose(second.ts, 1.0 + 0.25 * np.arange(5), rtol=1e-15)
    assert float(second.stats["max_constraint_violation"]) < 1e-14
    _, back = part(end, second.t1, -0.05)
    assert_trees_close(back, middle, rtol=1e-11, atol=1e-12)
    whole = nhjax.integrate(system, method, y0, dt=0.05, num_steps=2 * STEPS, args=args)
    assert_trees_close(end, jax.tree.map(lambda x: x[0], whole.ys), rtol=1e-13)
    # The time matters: the same state at another time is not consistent.
    with pytest.raises(nhjax.IntegrationError, match="step 0"):
        part(middle, 0.0)


@pytest.mark.parametrize("closure", helpers.CLOSURES)
def test_run_in_two_parts_equals_one_run(closure):
    method = nhjax.LobattoIIIAB(3, closure)
    whole = run(method=method, num_steps=100)
    half = run(method=method, num_steps=50)
    middle = jax.tree.map(lambda x: x[-1], half.ys)
    rest = run(method=method, num_steps=50, y0=middle, t0=half.t1)
    np.testing.assert_allclose(rest.t1, whole.t1, rtol=1e-15)
    # The propagated multiplier accumulates its round-off.
    assert_trees_close(rest.ys, whole.ys, rtol=1e-12, atol=1e-13)


# Reports ------------------------------------------------------------------------------


def test_stats_of_a_run_count_steps_and_iterations():
    sol = run(
        method=nhjax.LobattoIIIAB(3, "propagated"), saveat=SaveAt(t0=True, steps=True)
    )
    stats = sol.stats
    assert set(stats) == {
        "num_steps",
        "num_iterations",
        "num_newton_steps",
        "num_redundant",
        "max_residual",
        "max_constraint_violation",
        "max_multiplier_defect",
        "max_error_estimate",
        "failed_step",
        "worst_coordinate",
    }
    assert int(stats["num_steps"]) == STEPS
    assert int(stats["failed_step"]) == -1
    assert int(stats["worst_coordinate"]) == -1
    assert 2 * STEPS <= int(stats["num_iterations"]) <= 20 * STEPS
    assert 0 < float(stats["max_residual"]) < 1e-14
    system = PARTICLE.system
    phi = jax.vmap(system.constraint_violation)(sol.ts, sol.ys)
    np.testing.assert_allclose(
        stats["max_constraint_violation"], jnp.max(jnp.abs(phi)), atol=2e-16
    )
    defect = sol.ys.multiplier - jax.vmap(
        lambda t, y: nhjax.continuous_multiplier(system, t, y)
    )(sol.ts, sol.ys)
    np.testing.assert_allclose(
        stats["max_multiplier_defect"], jnp.max(jnp.abs(defect)), rtol=1e-9
    )
    assert sol.result == nhjax.RESULTS.successful
    assert sol.failures() == []


def test_stats_of_a_run_include_the_initial_state():
    # A start that violates the constraints, but not enough to be refused.
    y0 = PARTICLE.initial_state()
    y0 = eqx.tree_at(lambda y: y.q, y0, y0.q.at[1].add(1e-6))
    violation = jnp.abs(PARTICLE.system.constraint_violation(0.0, y0))[0]
    assert violation > 1e-7
    np.testing.assert_allclose(
        run(y0=y0).stats["max_constraint_violation"], violation, rtol=1e-9
    )


def test_text_progress_meter_prints_each_tenth(capfd):
    run(progress_meter=nhjax.TextProgressMeter())
    jax.effects_barrier()
    out, err = capfd.readouterr()
    assert out == "".join(f"{k} of 20 steps\n" for k in range(2, 21, 2))
    assert err == ""


@pytest.mark.parametrize("total", [1, 7, 10, 99, 100, 101, 250, 1000, 12345])
def test_text_progress_meter_prints_about_ten_lines(total, capsys):
    meter = nhjax.TextProgressMeter()
    every = max(1, total // 100)
    for done in range(1, total + 1):
        if done % every == 0 or done in (1, total):
            meter.update(done, total)
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == f"{total} of {total} steps"
    assert min(total, 10) <= len(lines) <= 15
    assert len(set(lines)) == len(lines)


def test_progress_meter_that_is_off_is_silent(capfd):
    run(progress_meter=nhjax.NoProgressMeter())
    jax.effects_barrier()
    assert capfd.readouterr() == ("", "")


def test_tqdm_progress_meter_shows_one_bar_and_closes_it(capfd):
    meter = nhjax.TqdmProgressMeter("pendulum")
    dts = jnp.array([0.1, 0.05])

    def final(dt):
        return run(dt=dt, progress_meter=meter).ys.q

    for runs in (
        lambda: final(0.1),
        lambda: jax.jit(final)(0.1),
        lambda: jax.vmap(final)(dts),
    ):
        jax.block_until_ready(runs())
        jax.effects_barrier()
        out, err = capfd.readouterr()
        assert out == ""
        assert err.count("pendulum: 100%") == err.count("20/20 [") >= 1
        assert err.count("\n") == 1
        assert err.endswith("\n")


class Recorder(nhjax.AbstractProgressMeter):
    """A progress meter of a user."""

    def update(self, done: int, total: int) -> None:
        recorded.append((done, total))


recorded: list[tuple[int, int]] = []


def test_progress_meter_in_a_batch_is_called_once_per_step():
    dts = jnp.array([0.1, 0.05])
    expected = [(k, STEPS) for k in range(1, STEPS + 1)]
    for saveat in (SaveAt(steps=7), SaveAt(ts=[0.1, 0.11, 0.7])):
        recorded.clear()
        program = jax.vmap(
            lambda dt, s=saveat: run(dt=dt, saveat=s, progress_meter=Recorder()).ys
        )
        jax.block_until_ready(jax.jit(program)(dts))
        jax.effects_barrier()
        assert recorded == expected


def test_progress_meter_in_a_long_run_is_called_a_hundred_times():
    oscillator = HarmonicOscillator()
    recorded.clear()
    run(
        system=oscillator.system,
        y0=oscillator.initial_state(),
        num_steps=1050,
        progress_meter=Recorder(),
    )
    jax.effects_barrier()
    assert recorded == [(k, 1050) for k in (1, *range(10, 1051, 10))]


# float32 ------------------------------------------------------------------------------


@pytest.mark.parametrize("closure", helpers.CLOSURES)
def test_run_in_single_precision_keeps_its_dtype(closure):
    y0 = PARTICLE.initial_state(jnp.float32)
    sol = run(y0=y0, method=nhjax.LobattoIIIAB(4, closure))
    for leaf in jax.tree.leaves((sol.t0, sol.t1, sol.ts, sol.ys, sol.stats)):
        assert leaf.dtype in (jnp.float32, jnp.int32)
    assert 0 < float(sol.stats["max_constraint_violation"]) < 1e-6
    assert float(sol.stats["max_residual"]) < 1e-6
    assert int(sol.stats["num_iterations"]) < 8 * STEPS
    q, v, multiplier = PARTICLE.exact(DT * STEPS)
    np.testing.assert_allclose(sol.ys.q[0], q, atol=2e-6)
    np.testing.assert_allclose(sol.ys.v[0], v, atol=2e-6)
    # The propagated multiplier has only its own order, which is 4.
    np.testing.assert_allclose(sol.ys.multiplier[0], multiplier, atol=1e-4)


def test_dense_output_in_single_precision_keeps_its_dtype():
    y0 = PARTICLE.initial_state(jnp.float32)
    sol = run(y0=y0, saveat=SaveAt(ts=[0.52, 1.0, 1.23], t0=True, dense=True))
    state = sol.evaluate(1.23)
    for leaf in jax.tree.leaves((sol.ts, sol.ys, state)):
        assert leaf.dtype == jnp.float32
    np.testing.assert_allclose(state.q, PARTICLE.exact(1.23)[0], atol=1e-5)
    assert_trees_close(
        state, jax.tree.map(lambda x: x[-1], sol.ys), rtol=1e-5, atol=1e-6
    )


def test_dense_output_in_single_precision_reaches_the_end_of_a_long_run():
    # The round-off of t1 is 1e-7 times t1, far more than a fixed part of a step.
    oscillator = HarmonicOscillator()
    y0 = oscillator.initial_state(jnp.float32)
    sol = run(
        system=oscillator.system,
        y0=y0,
        t0=7.3,
        num_steps=3001,
        saveat=SaveAt(dense=True, t1=True),
    )
    end = sol.evaluate(sol.t1)
    np.testing.assert_allclose(end.q, sol.ys.q[0], atol=3e-4)
    with pytest.raises(ValueError, match="outside the run"):
        sol.evaluate(sol.t1 + 0.1)


@pytest.mark.parametrize("closure", ["consistent", "symmetric"])
def test_closures_other_than_propagated_ignore_a_stale_multiplier(closure):
    sleigh = nhjax.systems.ChaplyginSleigh()
    y0 = sleigh.initial_state()
    stale = eqx.tree_at(lambda y: y.multiplier, y0, y0.multiplier + 5)
    sol = nhjax.integrate(
        sleigh.system,
        nhjax.LobattoIIIAB(3, closure),
        stale,
        dt=0.05,
        num_steps=2,
        saveat=nhjax.SaveAt(t0=True, steps=True),
    )
    continuous = jax.vmap(
        lambda t, y: nhjax.continuous_multiplier(sleigh.system, t, y)
    )(sol.ts, sol.ys)
    np.testing.assert_allclose(sol.ys.multiplier, continuous, rtol=1e-13)
