"""A failed run names its member and step, and does not change other members."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import (
    Appell,
)
from support.particle_run import assert_trees_equal, PARTICLE, run, STEPS


# Failures -----------------------------------------------------------------------------


APPELL = Appell()


@eqx.filter_jit
@jax.vmap
def fall(speed) -> nhjax.Solution:
    """Appell's particles: the rising ones reach an apex where D2Φ vanishes."""
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


def test_failure_of_a_member_does_not_change_others(falls):
    failing, benign = falls
    assert benign.failures() == []
    good = jnp.array([0, 2])
    for part in (lambda s: s.ts, lambda s: s.ys, lambda s: s.stats):
        assert_trees_equal(
            jax.tree.map(lambda x: x[good], part(failing)),
            jax.tree.map(lambda x: x[good], part(benign)),
        )


def test_failure_in_a_batch_names_member_and_step(falls):
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


def test_failure_of_a_member_keeps_its_last_good_state(falls):
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


def test_failure_by_nan_affects_one_member_only():
    y0 = PARTICLE.initial_state()

    def one(factor):
        scaled = eqx.tree_at(lambda y: y.q, y0, y0.q * factor)
        return run(y0=scaled, num_steps=3, throw=False)

    sol = jax.vmap(one)(jnp.array([1.0, jnp.nan]))
    assert [(lane, k) for lane, k, _ in sol.failures()] == [(1, 0)]
    assert "from the start" in sol.failures()[0][2]
    np.testing.assert_array_equal(sol.stats["num_steps"], [3, 0])
    assert jnp.all(jnp.isfinite(sol.ys.q[0]))


def test_failure_by_max_iterations_returns_its_result():
    solver = nhjax.SimplifiedNewton(max_iterations=2, fallback=False)
    saveat = SaveAt(t0=True, t1=True)
    sol = run(stage_solver=solver, throw=False, num_steps=2, saveat=saveat)
    assert sol.result == nhjax.RESULTS.nonlinear_max_iterations
    assert "within the `max_iterations`" in sol.failures()[0][2]
    first, last = (jax.tree.map(lambda x, k=k: x[k], sol.ys) for k in (0, 1))
    assert_trees_equal(last, first)
    start = PARTICLE.initial_state()
    assert_trees_equal((last.q, last.v, last.p), (start.q, start.v, start.p))
    # The run computes the continuous multiplier again, in another program.
    np.testing.assert_allclose(last.multiplier, start.multiplier, rtol=1e-14)


def test_failure_message_names_coordinate_and_smaller_dt():
    # Three uncoupled oscillators, the second one very stiff.
    stiffness = jnp.asarray([1.0, 1e9, 2.0])

    def lagrangian(t, q, v, args):
        return 0.5 * (v @ v) - 0.25 * jnp.sum(stiffness * q**4)

    system = nhjax.LagrangianSystem(lagrangian)
    y0 = nhjax.initial_state(system, jnp.ones(3), jnp.zeros(3))
    solver = nhjax.SimplifiedNewton(fallback=False)

    def run_with(dt, **options):
        return nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=dt,
            num_steps=2,
            stage_solver=solver,
            **options,
        )

    stats = run_with(0.25, throw=False).stats
    assert (stats["failed_step"], stats["worst_coordinate"]) == (0, 1)
    assert run_with(1e-6).stats["worst_coordinate"] == -1
    message = (
        r"to coordinate 1\. `dt` is 0\.25: if all forces are smooth, try 0\.125, or"
    )
    with pytest.raises(nhjax.IntegrationError, match=message):
        run_with(0.25)
    # Each lane has its own step size.
    with pytest.raises(Exception, match=f"member 1, step 0: .*{message}"):
        jax.vmap(run_with)(jnp.asarray([1e-6, 0.25]))


def test_failure_message_of_accelerating_motion_names_coordinate_and_event():
    # The second coordinate goes to infinity as 1 / (1 - t).
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v) + 0.5 * q[1] ** 4,
        coordinates=("drift", "height"),
    )
    y0 = nhjax.initial_state(system, jnp.ones(2), jnp.ones(2))
    with pytest.raises(nhjax.IntegrationError) as error:
        nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(3),
            y0,
            dt=0.0625,
            t1=2.0,
            stage_solver=nhjax.Newton(),
        )
    text = str(error.value)
    assert "belongs to coordinate 1 (height)." in text
    assert text.endswith("end the run earlier with an `nhjax.Event`.")
    assert int(text.split("in step ")[1].split(":")[0]) in range(10, 18)


def test_inconsistent_start_names_the_constraint_and_its_value():
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * args * (v @ v),
        nonholonomic=lambda t, q, v, args: v[1] - jnp.sin(t) * q[0],
    )
    q, v = jnp.array([1.0, 0.0]), jnp.array([1.0, 0.0])
    y0 = nhjax.initial_state(system, q, v, args=2.0)

    def run_from(t0, args):
        method = nhjax.LobattoIIIAB(2)
        return nhjax.integrate(
            system, method, y0, t0=t0, dt=0.1, num_steps=2, args=args
        )

    with pytest.raises(
        nhjax.IntegrationError, match=r"At t = 2, .* Φ\[0\] = -0\.909\."
    ):
        run_from(2.0, 2.0)
    with pytest.raises(
        nhjax.IntegrationError, match="p differs from its value for v by 1"
    ):
        run_from(0.0, 3.0)


@pytest.mark.parametrize("shape", [(), (1,), (2,)])
def test_force_of_wrong_shape_in_another_system_than_of_the_start_raises(shape):
    def lagrangian(t, q, v, args):
        return 0.5 * (v @ v)

    y0 = nhjax.initial_state(
        nhjax.LagrangianSystem(lagrangian), jnp.zeros(3), jnp.ones(3)
    )
    damped = nhjax.LagrangianSystem(
        lagrangian, force=lambda t, q, v, args: -0.1 * jnp.ones(shape) * v[0]
    )
    with pytest.raises(nhjax.ShapeError, match=r"must return shape \(3,\), got shape"):
        nhjax.integrate(damped, nhjax.LobattoIIIAB(2), y0, dt=0.1, num_steps=2)
