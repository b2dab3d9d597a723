"""Errors that depend on values, under jit and vmap, and during a run."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import Appell
from support.mistakes import (
    changed,
    PARTICLE,
    run,
)


@pytest.fixture(scope="module")
def y0():
    return PARTICLE.initial_state()


# integrate: what values decide, under jit and vmap ------------------------------------


GIVEN = {"dt": 0.1, "t0": 0.0, "ts": jnp.array([0.1, 0.2, 0.25])}
AT_RUN_TIME = {
    "dt zero": ({"dt": 0.0}, "`dt` is zero; give a positive or negative step size"),
    "dt nan": ({"dt": np.nan}, "`dt` is not finite: nan"),
    "t0 nan": ({"t0": np.nan}, "`t0` is not finite: nan"),
    "ts outside": (
        {"ts": jnp.array([0.1, 0.2, 0.9])},
        r"SaveAt: `ts` reaches from 0\.1 to 0\.9, outside the run from 0\.0 to 0\.4",
    ),
    "ts nan": (
        {"ts": jnp.array([0.1, 0.2, np.nan])},
        r"SaveAt: `ts` reaches from nan to nan, outside the run from 0\.0 to 0\.4",
    ),
    "ts unsorted": (
        {"ts": jnp.array([0.2, 0.1, 0.3])},
        "SaveAt: `ts` must be sorted in the direction of time, which runs forward here",
    ),
    **{
        f"y0.{part} nan": ({part: np.nan}, "step 0: The state became .* from the start")
        for part in ("q", "v", "p", "multiplier")
    },
    "y0.v by hand": ({"v": 2.0}, "step 0: The initial state violates"),
}
at_run_time = pytest.mark.parametrize(
    "case", AT_RUN_TIME.values(), ids=AT_RUN_TIME.keys()
)


def sampled(y0, dt, t0, ts, **factors):
    parts = {name: getattr(y0, name) * factor for name, factor in factors.items()}
    return run(changed(y0, **parts), dt=dt, t0=t0, saveat=SaveAt(ts=ts)).ys.q


@pytest.fixture(scope="module")
def compiled(y0):
    one = dict.fromkeys(("q", "v", "p", "multiplier"), 1.0)
    single = jax.jit(lambda given: sampled(y0, **given))
    batch = jax.jit(jax.vmap(lambda given: sampled(y0, **given)))
    good = jax.tree.map(jnp.asarray, GIVEN | one)
    return single, batch, good


@at_run_time
def test_integrate_with_wrong_values_under_jit_raises(case, compiled):
    wrong, message = case
    single, _, good = compiled
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(single(good | jax.tree.map(jnp.asarray, wrong)))


@at_run_time
def test_integrate_with_one_wrong_member_under_vmap_raises(case, compiled):
    wrong, message = case
    _, batch, good = compiled
    bad = good | jax.tree.map(jnp.asarray, wrong)
    lanes = jax.tree.map(lambda *x: jnp.stack(x), good, bad)
    if message.startswith("step"):
        message = f"Integration failed in member 1, {message}"
    else:
        message = f"Error: member 1: {message}"
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(batch(lanes))


def test_integrate_with_valid_values_under_jit_runs(compiled, y0):
    single, batch, good = compiled
    expected = sampled(y0, **GIVEN)
    assert jnp.all(jnp.isfinite(expected))
    np.testing.assert_allclose(single(good), expected, rtol=1e-14)
    lanes = jax.tree.map(lambda x: x[None], good)
    np.testing.assert_allclose(batch(lanes)[0], expected, rtol=1e-14)


# Failures along the way ---------------------------------------------------------------


def fall(speed, **others):
    """Appell's particle, which rises to the apex where D2Φ vanishes."""
    appell = Appell()
    y0 = nhjax.initial_state(
        appell.system, appell.q0, speed * jnp.asarray([0.3, 0.4, 1])
    )
    return nhjax.integrate(
        appell.system, nhjax.LobattoIIIAB(3), y0, dt=0.05, num_steps=20, **others
    )


@pytest.mark.filterwarnings("ignore:.SimplifiedNewton. did not solve")
def test_failure_of_a_run_names_step_and_reason():
    with pytest.raises(
        nhjax.IntegrationError,
        match=r"^Integration failed in step 1[0-2]: .* With `throw=False` the part",
    ):
        fall(jnp.asarray(0.5))


def test_failure_under_jit_names_step_and_reason():
    with pytest.raises(RuntimeError, match=r"Integration failed in step 1[0-2]: "):
        jax.block_until_ready(jax.jit(lambda v: fall(v).ys.q)(0.5))


def test_failure_under_vmap_names_the_member():
    speeds = jnp.array([-1.0, 0.5, -0.5, 0.25])
    message = r"Integration failed in member 1, step 1[0-2] \(1 more members failed\): "
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(jax.jit(jax.vmap(fall))(speeds))
    message = (
        r"Integration failed in member \(0, 1\), step 1[0-2] "
        r"\(1 more members failed\): "
    )
    with pytest.raises(RuntimeError, match=message):
        jax.block_until_ready(jax.jit(jax.vmap(jax.vmap(fall)))(speeds.reshape(2, 2)))


def test_failure_under_jit_raises_whatever_part_of_the_solution_is_used():
    with pytest.raises(RuntimeError, match=r"Integration failed in step 1[0-2]"):
        jax.block_until_ready(jax.jit(lambda v: fall(v).t1)(0.5))


@pytest.mark.parametrize("transform", [lambda f: f, jax.jit], ids=["plain", "jit"])
def test_failure_under_vmap_is_reported_once(transform, caplog):
    speeds = jnp.array([-1.0, 0.5, -0.5, 0.25])
    with pytest.raises((RuntimeError, ValueError)) as error:
        jax.block_until_ready(transform(jax.vmap(fall))(speeds))
    told = "".join([str(error.value), *(x.getMessage() for x in caplog.records)])
    assert told.count("Integration failed in member 1") == 1


def test_failures_of_a_traced_solution_raises():
    with pytest.raises(RuntimeError, match=r"outside jit and vmap.*`sol.result`"):
        jax.jit(lambda v: fall(v, throw=False).failures())(0.5)


# Solution.evaluate --------------------------------------------------------------------


@pytest.fixture(scope="module")
def dense(y0):
    return run(y0, saveat=SaveAt(dense=True))


@pytest.mark.parametrize(
    ("t", "exception", "message"),
    [
        (0.5, ValueError, r"`t` = 0\.5 lies outside the run, from 0\.0 to 0\.4"),
        (-0.01, ValueError, r"`t` = -0\.01 lies outside the run"),
        (np.nan, ValueError, "`t` = nan lies outside the run"),
        (jnp.array([0.1, 0.2]), nhjax.ShapeError, r"`t` has shape \(2,\).*`jax.vmap`"),
        (None, nhjax.DTypeError, "`t` must be a real number, got None"),
        ("end", nhjax.DTypeError, "`t` must be a real number, got 'end'"),
        (0.1j, nhjax.DTypeError, "`t` must be a real number, got 0.1j"),
    ],
)
def test_evaluate_at_wrong_times_raises(t, exception, message, dense):
    with pytest.raises(exception, match=message):
        dense.evaluate(t)


def test_evaluate_without_dense_output_raises(y0):
    with pytest.raises(ValueError, match=r"pass `saveat=nhjax.SaveAt\(dense=True\)`"):
        run(y0).evaluate(0.1)


def test_evaluate_outside_the_run_under_jit_and_vmap_raises(dense):
    outside = r"`t` = 0\.5 lies outside the run, from 0\.0 to 0\.4"
    with pytest.raises(RuntimeError, match=outside):
        jax.block_until_ready(jax.jit(lambda t: dense.evaluate(t))(0.5))
    with pytest.raises(RuntimeError, match=f"member 1: Solution.evaluate: {outside}"):
        jax.block_until_ready(jax.vmap(dense.evaluate)(jnp.array([0.1, 0.5])))


def test_evaluate_of_a_batch_without_vmap_raises(y0):
    batch = jax.vmap(lambda dt: run(y0, dt=dt, saveat=SaveAt(dense=True)))(
        jnp.array([0.1, 0.2])
    )
    with pytest.raises(
        ValueError, match=r"batch of shape \(2,\).*jax.vmap\(lambda sol"
    ):
        batch.evaluate(0.1)
    q = jax.vmap(lambda sol: sol.evaluate(0.1))(batch).q
    assert q.shape == (2, 3)
