"""Errors in the arguments of a run that are found when tracing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import HarmonicOscillator, NonholonomicParticle
from support.mistakes import (
    changed,
    EXPLICIT_RK4,
    FREE,
    kinetic,
    PARTICLE,
    Q,
    run,
    V,
)


@pytest.fixture(scope="module")
def y0():
    return PARTICLE.initial_state()


@pytest.mark.parametrize("solver", [nhjax.Newton, nhjax.SimplifiedNewton])
@pytest.mark.parametrize("count", [0, 2.5])
def test_max_iterations_of_a_wrong_value_raises(solver, count):
    with pytest.raises(ValueError, match=f"{solver.__name__}: `max_iterations`.*got"):
        solver(max_iterations=count)


# integrate: what tracing finds --------------------------------------------------------


def test_samples_without_collocation_method_raise():
    y0 = nhjax.initial_state(FREE, Q, V)
    with pytest.raises(ValueError, match=r"C\(q\) for q >= stages = 4.*q = 1\. Use Lo"):
        run(y0, FREE, EXPLICIT_RK4, saveat=SaveAt(ts=[0.1]))


@pytest.mark.parametrize(
    ("part", "value", "exception", "message"),
    [
        ("q", jnp.ones(2), nhjax.ShapeError, r"`y0.v`.*\(3,\).*`y0.q` needs \(2,\)"),
        ("q", jnp.ones(()), nhjax.ShapeError, r"`y0.q` has shape \(\)"),
        ("v", jnp.ones(4), nhjax.ShapeError, r"`y0.v`.*\(4,\).*`y0.q` needs \(3,\)"),
        ("p", jnp.ones(4), nhjax.ShapeError, r"`y0.p` has shape \(4,\)"),
        ("multiplier", jnp.ones(2), nhjax.ShapeError, r"`y0.mult.*\(2,\).*\(1,\)"),
        ("q", jnp.ones(3, jnp.float32), nhjax.DTypeError, "`y0.q` has dtype float32"),
        ("v", jnp.ones(3, int), nhjax.DTypeError, "`y0.v` has dtype int64"),
        ("p", jnp.ones(3, jnp.float32), nhjax.DTypeError, "and `y0.p` float32"),
        ("multiplier", jnp.ones(1, complex), nhjax.DTypeError, "`y0.mult.*complex128"),
        ("v", [0.4, 0.7, 0.12], TypeError, "`y0.v` must be an array, got .*float"),
        ("multiplier", None, TypeError, "`y0.multiplier` must be an array, got None"),
        ("q", jnp.full(3, jnp.nan), nhjax.NonFiniteError, r"`y0.q`.*finite: \[nan"),
        ("v", jnp.full(3, jnp.inf), nhjax.NonFiniteError, r"`y0.v`.*finite: \[inf"),
        ("p", jnp.full(3, jnp.nan), nhjax.NonFiniteError, r"`y0.p`.*finite: \[nan"),
        ("multiplier", jnp.full(1, jnp.nan), nhjax.NonFiniteError, r"`y0.mult.*\[nan"),
    ],
)
def test_integrate_with_wrong_state_raises(part, value, exception, message, y0):
    with pytest.raises(exception, match=message):
        run(changed(y0, **{part: value}))


def test_integrate_with_a_batch_of_states_raises(y0):
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), y0)
    with pytest.raises(nhjax.ShapeError, match=r"`y0.q`.*\(2, 3\).*`jax.vmap` over"):
        run(batch)


def test_integrate_with_state_of_another_system_raises(y0):
    oscillator = HarmonicOscillator(q0=(1.0, 0.0, 0.0), v0=(0.0, 1.0, 0.0))
    with pytest.raises(nhjax.ShapeError, match=r"`y0.multiplier`.*\(1,\).*\(0,\)"):
        run(y0, oscillator.system)
    with pytest.raises(TypeError, match=r"got \(Array.*of type tuple. Create one with"):
        run((Q, V))


# A well-formed state, but not a state of this system at this time.
INCONSISTENT = {
    "v by hand": lambda y0: changed(y0, v=y0.v + jnp.array([0.0, 0.1, 0.0])),
    "p by hand": lambda y0: changed(y0, p=1.01 * y0.p),
    "q by hand": lambda y0: changed(y0, q=y0.q.at[1].add(0.1)),
    "other mass": lambda y0: NonholonomicParticle(mass=2.0).initial_state(),
}


@pytest.mark.parametrize("change", INCONSISTENT.values(), ids=INCONSISTENT.keys())
def test_integrate_with_inconsistent_state_raises(change, y0):
    with pytest.raises(nhjax.IntegrationError, match="step 0: The initial state viola"):
        run(change(y0))


def test_integrate_with_slightly_perturbed_state_runs(y0):
    # Finite differences move the states off the constraint.
    sol = run(changed(y0, q=y0.q.at[1].add(1e-5)))
    assert sol.result == nhjax.RESULTS.successful
    np.testing.assert_allclose(sol.stats["max_constraint_violation"], 4e-6, rtol=1e-9)


def test_integrate_with_state_of_another_time_raises():
    system = nhjax.LagrangianSystem(
        kinetic, nonholonomic=lambda t, q, v, args: v[0] - jnp.cos(t)
    )
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.array([1.0, 0.0]))
    with pytest.raises(nhjax.IntegrationError, match="constraints at `t0`"):
        run(y0, system, t0=0.5)
