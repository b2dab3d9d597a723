"""The collocation polynomials between the nodes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import Appell, NonholonomicParticle
from support import helpers
from support.long import long


PARTICLE = NonholonomicParticle()
T = 1.0
# T lies in the step after these, at a general point of it: in the middle, some of the
# polynomials are more accurate.
STEPS_BEFORE, FRACTION = np.array([8, 11, 16, 23]), 0.3
STEP_SIZES = T / (STEPS_BEFORE + FRACTION)


def errors(problem, stages, closure, expected):
    """Largest errors at T, as {part: one for each step size}."""
    system, y0, args = problem

    @jax.jit
    @jax.vmap
    def state(dt):
        sol = nhjax.integrate(
            system,
            nhjax.LobattoIIIAB(stages, closure),
            y0,
            dt=dt,
            num_steps=int(STEPS_BEFORE[-1]) + 1,
            args=args,
            saveat=SaveAt(ts=jnp.array([T])),
        )
        return jax.tree.map(lambda x: x[0], sol.ys)

    states = state(jnp.asarray(STEP_SIZES))
    return {
        name: np.max(np.abs(getattr(states, name) - np.asarray(value)[None]), axis=1)
        for name, value in expected.items()
    }


def order(error):
    return np.polyfit(np.log(STEP_SIZES), np.log(error), 1)[0]


# Two stages are an exception; three and four stand for odd and even numbers.
@pytest.mark.parametrize("stages", [2, 3, 4])
def test_dense_output_without_velocity_forces_has_expected_orders(stages):
    q, v, multiplier = PARTICLE.exact(T)
    problem = PARTICLE.system, PARTICLE.initial_state(), None
    expected = {"q": q, "v": v, "p": v, "multiplier": multiplier}
    error = errors(problem, stages, "symmetric", expected)
    assert abs(order(error["q"]) - stages) < 0.25
    # One order more than in general; with two stages, even the nodes have only 2.
    better = min(stages + 1, 2 * stages - 2)
    assert better - 0.25 < order(error["p"]) < better + 0.5
    assert better - 0.25 < order(error["v"]) < better + 0.5
    assert stages - 0.4 < order(error["multiplier"]) < stages + 0.25


@pytest.mark.parametrize("stages", [3, 4])
def test_dense_output_with_velocity_forces_has_expected_orders(stages):
    system, y0, args = problem = helpers.problem("driven")
    reference = nhjax.integrate(
        system, nhjax.LobattoIIIAB(6), y0, dt=T / 40, num_steps=40, args=args
    ).ys
    expected = {name: getattr(reference, name)[0] for name in ("q", "v", "p")}
    error = errors(problem, stages, "symmetric", expected)
    for name in expected:
        assert abs(order(error[name]) - stages) < 0.25, name


@pytest.mark.parametrize(("stages", "expected"), [(3, 2), (4, 4)])
def test_dense_output_of_propagated_multiplier_has_expected_orders(stages, expected):
    # The order is s for even s and s - 1 for odd s, as at the nodes.
    _, _, multiplier = PARTICLE.exact(T)
    problem = PARTICLE.system, PARTICLE.initial_state(), None
    error = errors(problem, stages, "propagated", {"multiplier": multiplier})
    assert abs(order(error["multiplier"]) - expected) < 0.25


@pytest.fixture(scope="module")
def sol():
    return nhjax.integrate(
        PARTICLE.system,
        nhjax.LobattoIIIAB(4),
        PARTICLE.initial_state(),
        dt=-0.1,
        num_steps=10,
        t0=0.5,
        saveat=SaveAt(t0=True, steps=True, dense=True),
    )


def test_dense_output_at_the_nodes_is_continuous(sol):
    evaluate = jax.jit(jax.vmap(lambda t: sol.evaluate(t)))
    inner, near = sol.ts[1:-1], 1e-13
    for shift in (-near, 0.0, near):
        states = evaluate(inner + shift)
        nodes = jax.tree.map(lambda x: x[1:-1], sol.ys)
        jax.tree.map(
            lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=2e-12),
            states,
            nodes,
        )


def test_dense_output_under_vmap_and_jit_equals_single_evaluations(sol):
    ts = jnp.linspace(-0.5, 0.5, 7)
    batch = jax.vmap(sol.evaluate)(ts)
    compiled = eqx.filter_jit(sol.evaluate)
    assert batch.q.shape == batch.v.shape == batch.p.shape == (7, 3)
    assert batch.multiplier.shape == (7, 1)
    for k, t in enumerate(ts):
        for state in (sol.evaluate(t), sol.evaluate(float(t)), compiled(t)):
            jax.tree.map(
                lambda x, y, k=k: np.testing.assert_allclose(
                    x[k], y, rtol=1e-13, atol=1e-15
                ),
                batch,
                state,
            )


def test_dense_output_between_nodes_is_a_consistent_state(sol):
    t = jnp.asarray(0.234)
    state, rate = jax.jvp(sol.evaluate, (t,), (jnp.ones_like(t),))
    np.testing.assert_allclose(state.p, PARTICLE.system.momentum(t, state.q, state.v))
    np.testing.assert_allclose(rate.q, state.v, atol=1e-4)
    np.testing.assert_allclose(
        state.multiplier,
        nhjax.continuous_multiplier(PARTICLE.system, t, state),
        rtol=1e-13,
    )
    # The constraint is imposed only at the nodes.
    violation = jnp.abs(PARTICLE.system.constraint_violation(t, state))[0]
    assert 1e-12 < violation < 1e-5


def test_dense_output_at_an_integer_time_is_evaluated(sol):
    assert sol.evaluate(0).q.dtype == jnp.float64
    np.testing.assert_array_equal(sol.evaluate(0).q, sol.evaluate(0.0).q)


@pytest.mark.filterwarnings("ignore:.SimplifiedNewton. did not solve")
@pytest.mark.parametrize("closure", [long("propagated"), "symmetric"])
def test_dense_output_after_a_failure_stays_at_last_good_state(closure):
    # It rises to an apex where D2Φ vanishes.
    appell = Appell(v0=(0.15, 0.2, 0.5))

    def samples(saveat):
        return nhjax.integrate(
            appell.system,
            nhjax.LobattoIIIAB(3, closure),
            appell.initial_state(),
            dt=0.05,
            num_steps=20,
            saveat=saveat,
            throw=False,
        )

    dense = samples(SaveAt(t0=True, steps=True, dense=True))
    ((_, k, _),) = dense.failures()
    last = jax.tree.map(lambda x: x[k], dense.ys)
    ts = jnp.array([0.05 * k, 0.05 * k + 0.01, 0.8, 1.0])
    evaluated = jax.vmap(dense.evaluate)(ts)
    for states in (evaluated, samples(SaveAt(ts=ts)).ys):
        for name in ("q", "v", "p"):
            expected = jnp.broadcast_to(getattr(last, name), (4, 3))
            np.testing.assert_allclose(getattr(states, name), expected, rtol=1e-13)
        expected = jnp.broadcast_to(last.multiplier, (4, 1))
        np.testing.assert_allclose(states.multiplier, expected, rtol=1e-9)
