"""The time loop: what is saved, what is reported, and the transformations of JAX."""

import re
from typing import Any

import equinox as eqx
import helpers
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import (
    Appell,
    ChaoticSystem,
    HarmonicOscillator,
    NonholonomicParticle,
)


PARTICLE = NonholonomicParticle()
STEPS, DT = 20, 0.1


def run(**others: Any) -> nhjax.Solution:
    arguments: dict[str, Any] = {
        "system": PARTICLE.system,
        "method": nhjax.LobattoIIIAB(3),
        "y0": PARTICLE.initial_state(),
        "dt": DT,
        "num_steps": STEPS,
    }
    return nhjax.integrate(**(arguments | others))


def assert_trees_equal(got, expected):
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def assert_trees_close(got, expected, rtol, atol=0.0):
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=atol),
        got,
        expected,
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
def test_saved_nodes_are_those_of_the_full_output(saveat, nodes, full):
    sol = run(saveat=saveat)
    assert_trees_equal(
        (sol.ts, sol.ys),
        jax.tree.map(lambda x: x[jnp.asarray(nodes)], (full.ts, full.ys)),
    )
    assert sol.ts.shape == (len(nodes),)
    if saveat is not None:
        assert saveat.num_saved(STEPS) == len(nodes)


def test_the_full_output_starts_at_y0_and_ends_at_t1(full):
    y0 = PARTICLE.initial_state()
    assert_trees_equal(jax.tree.map(lambda x: x[0], full.ys), y0)
    np.testing.assert_array_equal(full.ts, DT * np.arange(STEPS + 1))
    assert full.ys.q.shape == full.ys.v.shape == full.ys.p.shape == (STEPS + 1, 3)
    assert full.ys.multiplier.shape == (STEPS + 1, 1)
    assert (float(full.t0), float(full.t1)) == (0.0, DT * STEPS)
    assert full.interpolation is None


def test_dense_output_alone_saves_no_states(dense):
    assert dense.ts is None
    assert dense.ys is None


TIMES = [0.0, 0.03, 0.1, 0.1, 0.15, 0.7, 1.2345, 1.99, 2.0]


def test_samples_are_those_of_the_dense_output(dense, full):
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


def test_samples_between_both_ends(full):
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


def test_samples_may_be_integers_and_of_another_precision():
    sol = run(saveat=SaveAt(ts=np.array([0, 1, 2])))
    assert sol.ts.dtype == jnp.float64
    again = run(saveat=SaveAt(ts=np.array([0.0, 1.0, 2.0], np.float32)))
    assert_trees_equal(sol.ys, again.ys)


def test_samples_backwards(full):
    ts = [2.0, 1.5, 0.31, 0.0]
    end = jax.tree.map(lambda x: x[-1], full.ys)
    sol = run(y0=end, t0=full.t1, dt=-DT, saveat=SaveAt(ts=ts))
    np.testing.assert_array_equal(sol.ts, ts)
    np.testing.assert_allclose(sol.t1, 0.0, atol=1e-15)
    nodes = jax.tree.map(lambda x: x[jnp.array([20, 15, 0])], full.ys)
    there = jax.tree.map(lambda x: x[jnp.array([0, 1, 3])], sol.ys)
    # The symmetric closure makes a step of -h undo a step of h.
    assert_trees_close(there, nodes, rtol=1e-12, atol=1e-13)


def test_a_function_of_the_state(full):
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
def test_thinned_output_needs_no_buffer_of_the_length_of_the_run(saveat):
    steps = 1000

    def program(y0):
        return run(y0=y0, num_steps=steps, saveat=saveat, throw=False).ys

    lowered = jax.jit(program).lower(PARTICLE.initial_state())
    arrays = re.findall(r"\b(\w+)\[([\d,]+)\]", lowered.compile().as_text() or "")
    floats = {shape for kind, shape in arrays if kind == "f64"}
    assert floats  # the pattern does find arrays
    sizes = {int(np.prod([int(n) for n in shape.split(",")])) for shape in floats}
    assert max(sizes) < steps


# Time ---------------------------------------------------------------------------------


def test_a_run_in_explicit_time_goes_on_where_it_stopped():
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
    # It is the time that does it: the same state at another time is not consistent.
    with pytest.raises(nhjax.IntegrationError, match="step 0"):
        part(middle, 0.0)


@pytest.mark.parametrize("closure", helpers.CLOSURES)
def test_two_runs_in_a_row_are_one(closure):
    method = nhjax.LobattoIIIAB(3, closure)
    whole = run(method=method, num_steps=100)
    half = run(method=method, num_steps=50)
    middle = jax.tree.map(lambda x: x[-1], half.ys)
    rest = run(method=method, num_steps=50, y0=middle, t0=half.t1)
    np.testing.assert_allclose(rest.t1, whole.t1, rtol=1e-15)
    # The propagated multiplier carries its round-off along.
    assert_trees_close(rest.ys, whole.ys, rtol=1e-12, atol=1e-13)


# Reports ------------------------------------------------------------------------------


def test_stats():
    sol = run(
        method=nhjax.LobattoIIIAB(3, "propagated"), saveat=SaveAt(t0=True, steps=True)
    )
    stats = sol.stats
    assert set(stats) == {
        "num_steps",
        "num_iterations",
        "num_newton_steps",
        "max_residual",
        "max_constraint_violation",
        "max_multiplier_defect",
        "failed_step",
    }
    assert int(stats["num_steps"]) == STEPS
    assert int(stats["failed_step"]) == -1
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


def test_stats_count_the_start():
    # A start off the constraints, by less than what is refused.
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


def test_no_progress_meter_is_silent(capfd):
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
    """A meter of a user's own."""

    def update(self, done: int, total: int) -> None:
        recorded.append((done, total))


recorded: list[tuple[int, int]] = []


def test_a_meter_is_called_once_a_step_whatever_the_batch():
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


def test_a_meter_is_called_a_hundred_times_in_a_long_run():
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


# Transformations ----------------------------------------------------------------------


class Driven(eqx.Module):
    """Explicit time, a parameter, `args`."""

    mass: jax.Array

    def lagrangian(self, t, q, v, args):
        return 0.5 * self.mass * (1.0 + 0.5 * jnp.sin(t)) * (v @ v) - 0.5 * (q @ q)

    def constraint(self, t, q, v, args):
        return v[2] - q[1] * v[0] - jnp.cos(t)

    def friction(self, t, q, v, args):
        return -args["friction"] * v


def driven_run(mass, q, dt, t0, friction):
    driven = Driven(mass)
    system = nhjax.LagrangianSystem(
        driven.lagrangian, nonholonomic=driven.constraint, force=driven.friction
    )
    args = {"friction": friction, "a name": "is static"}
    v = jnp.array([0.4, 0.6, 1.0])
    y0 = nhjax.initial_state(system, q, v, t=t0, args=args, project=True)
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(2),
        y0,
        dt=dt,
        num_steps=8,
        t0=t0,
        args=args,
        saveat=SaveAt(t0=True, steps=3, t1=True),
    )
    return sol.ts, sol.ys, sol.stats


LANES = {
    "mass": jnp.array([1.0, 1.5, 2.0]),
    "q": jnp.array([[0.5, -0.3, 0.2], [1.0, 0.0, 0.0], [-0.2, 0.8, 0.1]]),
    "dt": jnp.array([0.1, 0.05, -0.1]),
    "t0": jnp.array([0.0, 1.0, -2.0]),
    "friction": jnp.array([0.0, 0.1, 0.2]),
}


@pytest.fixture(scope="module")
def driven_single():
    return jax.jit(driven_run)


@pytest.mark.parametrize(
    "names", [["q"], ["dt", "t0"], ["mass", "friction"], list(LANES)]
)
def test_a_batch_is_its_lanes(names, driven_single):
    first = {name: values[0] for name, values in LANES.items()}
    axes = [0 if name in names else None for name in LANES]
    given = [LANES[name] if name in names else first[name] for name in LANES]
    batch = jax.jit(jax.vmap(driven_run, in_axes=axes))(*given)
    for k in range(3):
        lane = [LANES[name][k] if name in names else first[name] for name in LANES]
        (ts, ys, stats) = jax.tree.map(lambda x, k=k: x[k], batch)
        expected_ts, expected_ys, expected_stats = driven_single(*lane)
        np.testing.assert_array_equal(ts, expected_ts)
        assert_trees_close(ys, expected_ys, rtol=1e-13, atol=1e-14)
        assert set(stats) == set(expected_stats)
        assert int(stats["num_steps"]) == 8


def test_an_ensemble_is_its_members():
    chaotic = ChaoticSystem()

    def member(q, v):
        y0 = nhjax.initial_state(chaotic.system, q, v)
        return run(system=chaotic.system, y0=y0, num_steps=10).ys

    q0, v0 = chaotic.ensemble(100)
    batch = jax.jit(jax.vmap(member))(q0, v0)
    single = jax.jit(member)
    singles = [single(q, v) for q, v in zip(q0, v0, strict=True)]
    expected = jax.tree.map(lambda *x: jnp.stack(x), *singles)
    assert batch.q.shape == (101, 1, 7)
    assert_trees_close(batch, expected, rtol=1e-13, atol=1e-13)


def test_solutions_pass_through_jit():
    # Functions are no leaves that a jitted function may return.
    sol = jax.jit(lambda dt: run(dt=dt, saveat=SaveAt(dense=True)))(DT)
    again = eqx.filter_jit(lambda sol, t: sol.evaluate(t))(sol, 0.55)
    assert_trees_close(again, sol.evaluate(0.55), rtol=1e-15)


class Counted(eqx.Module):
    """A Lagrangian that counts how often it is traced."""

    stiffness: jax.Array

    def __call__(self, t, q, v, args):
        traces.append(1)
        return 0.5 * (v @ v) - 0.5 * args * self.stiffness * (q @ q)


traces: list[int] = []


def counted_run(dt=0.1, t0=0.0, args: Any = 1.0, tolerance=0.0, stiffness=1.0, q=1.0):
    system = nhjax.LagrangianSystem(
        Counted(jnp.asarray(stiffness)), nonholonomic=PARTICLE.constraint
    )
    y0 = PARTICLE.initial_state()
    y0 = eqx.tree_at(lambda y: y.q, y0, y0.q.at[0].set(q))
    return run(
        system=system,
        y0=y0,
        dt=dt,
        t0=t0,
        args=args,
        stage_solver=nhjax.SimplifiedNewton(tolerance=tolerance),
        saveat=SaveAt(ts=t0 + dt * jnp.array([0.5, 2.5])),
    ).ys


OTHER_VALUES = {
    "dt": 0.05,
    "t0": 1.0,
    "args": 2.0,
    "tolerance": 1e-8,
    "stiffness": 3.0,
    "q": 0.5,
}


def test_other_values_recompile_nothing():
    first = counted_run()
    count = len(traces)
    assert count > 0
    for name, value in OTHER_VALUES.items():
        other = counted_run(**{name: value})
        assert len(traces) == count, name
        if name != "t0":
            assert jnp.any(other.q != first.q), name


def test_other_values_retrace_nothing_under_jit():
    program = jax.jit(counted_run)
    program(**dict.fromkeys(OTHER_VALUES, 1.0))
    count = len(traces)
    program(**OTHER_VALUES)
    assert len(traces) == count


# Failures -----------------------------------------------------------------------------


APPELL = Appell()


@eqx.filter_jit
@jax.vmap
def fall(speed) -> nhjax.Solution:
    """Particles of Appell's: those that rise come to an apex where D2Φ vanishes."""
    v = speed * jnp.array([0.3, 0.4, 1.0])
    y0 = nhjax.initial_state(APPELL.system, APPELL.q0, v)
    return run(
        system=APPELL.system,
        y0=y0,
        dt=0.05,
        throw=False,
        saveat=SaveAt(t0=True, steps=True),
    )


@pytest.fixture(scope="module")
def falls():
    failing = fall(jnp.array([-1.0, 0.5, -0.5, 0.25]))
    return failing, fall(jnp.array([-1.0, -0.7, -0.5, -0.2]))


def test_a_failing_lane_leaves_the_others_untouched(falls):
    failing, benign = falls
    assert benign.failures() == []
    good = jnp.array([0, 2])
    for part in (lambda s: s.ts, lambda s: s.ys, lambda s: s.stats):
        assert_trees_equal(
            jax.tree.map(lambda x: x[good], part(failing)),
            jax.tree.map(lambda x: x[good], part(benign)),
        )


def test_a_failure_is_reported_with_lane_and_step(falls):
    failing, _ = falls
    (first, k1, reason), (second, k2, _) = failing.failures()
    assert (first, second) == (1, 3)
    # ż = ż_0 - t / (1 + κ²) vanishes at t = 1.25 ż_0, in the steps 12 and 6.
    assert 10 <= k1 <= 12
    assert 4 <= k2 <= 6
    assert "smaller `dt`" in reason
    np.testing.assert_array_equal(failing.stats["failed_step"], [-1, k1, -1, k2])
    np.testing.assert_array_equal(failing.stats["num_steps"], [20, k1, 20, k2])
    failed = jax.vmap(lambda r: r != nhjax.RESULTS.successful)(failing.result)
    np.testing.assert_array_equal(failed, [False, True, False, True])
    for value in failing.stats.values():
        assert value.shape == (4,)
        assert jnp.all(jnp.isfinite(value))


def test_a_failed_lane_stays_at_its_last_good_state(falls):
    failing, _ = falls
    for lane, k, _ in failing.failures():
        states = jax.tree.map(lambda x, lane=lane: np.asarray(x[lane]), failing.ys)
        last = jax.tree.map(lambda x, k=k: x[k], states)
        rest = jax.tree.map(lambda x, k=k: x[k:], states)
        assert_trees_equal(
            rest,
            jax.tree.map(lambda x, k=k: np.tile(x, (STEPS + 1 - k, 1)), last),
        )
        assert np.all(last.q != states.q[k - 1])
        start = eqx.tree_at(lambda a: a.v0, APPELL, jnp.asarray(states.v[0]))
        q, v, multiplier = start.exact(0.05 * k)
        np.testing.assert_allclose(last.q, q, rtol=1e-12)
        np.testing.assert_allclose(last.v, v, rtol=1e-11)
        np.testing.assert_allclose(last.multiplier, multiplier, rtol=1e-11)


def test_a_lane_without_a_number_fails_alone():
    y0 = PARTICLE.initial_state()

    def one(factor):
        scaled = eqx.tree_at(lambda y: y.q, y0, y0.q * factor)
        return run(y0=scaled, num_steps=3, throw=False)

    sol = jax.vmap(one)(jnp.array([1.0, jnp.nan]))
    assert [(lane, k) for lane, k, _ in sol.failures()] == [(1, 0)]
    assert "from the start" in sol.failures()[0][2]
    np.testing.assert_array_equal(sol.stats["num_steps"], [3, 0])
    assert jnp.all(jnp.isfinite(sol.ys.q[0]))


def test_a_solver_that_gives_up():
    solver = nhjax.SimplifiedNewton(max_iterations=2, fallback=False)
    sol = run(stage_solver=solver, throw=False, num_steps=2)
    assert sol.result == nhjax.RESULTS.nonlinear_max_iterations
    assert "within the `max_iterations`" in sol.failures()[0][2]
    assert_trees_equal(jax.tree.map(lambda x: x[0], sol.ys), PARTICLE.initial_state())


# float32 ------------------------------------------------------------------------------


@pytest.mark.parametrize("closure", helpers.CLOSURES)
def test_single_precision(closure):
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
    # The propagated multiplier has no better than the order 4 of its own.
    np.testing.assert_allclose(sol.ys.multiplier[0], multiplier, atol=1e-4)


def test_single_precision_between_steps():
    y0 = PARTICLE.initial_state(jnp.float32)
    sol = run(y0=y0, saveat=SaveAt(ts=[0.52, 1.0, 1.23], t0=True, dense=True))
    state = sol.evaluate(1.23)
    for leaf in jax.tree.leaves((sol.ts, sol.ys, state)):
        assert leaf.dtype == jnp.float32
    np.testing.assert_allclose(state.q, PARTICLE.exact(1.23)[0], atol=1e-5)
    assert_trees_close(
        state, jax.tree.map(lambda x: x[-1], sol.ys), rtol=1e-5, atol=1e-6
    )


def test_single_precision_knows_the_end_of_a_long_run():
    # t1 is rounded to 1e-7 of itself, far more than a fixed part of a step.
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
def test_closures_without_memory_ignore_and_correct_a_stale_multiplier(closure):
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
