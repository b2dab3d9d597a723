"""Errors in the arguments of a run that are found when tracing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import HarmonicOscillator, NonholonomicParticle
from oracles.mistakes import (
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


# SaveAt -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "exception", "message"),
    [
        ({}, ValueError, "nothing is saved. Give at least one of `t0`"),
        ({"steps": 0}, ValueError, "nothing is saved"),
        ({"steps": -3}, ValueError, "`steps` must be a bool or an int >= 1, got -3"),
        ({"steps": 2.0}, ValueError, "`steps`.*got 2.0"),
        ({"steps": None}, ValueError, "`steps`.*got None"),
        ({"ts": [0.1], "steps": 2}, ValueError, "`ts` or `steps`, not both.*dense"),
        ({"ts": [0.1, 0.3, 0.2]}, ValueError, "`ts` must be sorted in the direction"),
        ({"ts": [0.1, np.nan]}, nhjax.NonFiniteError, r"`ts` is not finite: \[0\.1"),
        ({"ts": np.ones((2, 2))}, ValueError, r"`ts`.*shape \(k,\).*got \(2, 2\)"),
        ({"ts": []}, ValueError, r"`ts`.*k >= 1, got \(0,\)"),
        ({"ts": 0.1}, ValueError, r"`ts`.*got \(\)"),
        ({"ts": [1j]}, nhjax.DTypeError, "`ts` must be real, got dtype complex128"),
        ({"t1": True, "fn": 3}, ValueError, r"`fn`.*\(t, y, args\), got 3"),
        # diffrax takes the end of the run where this takes a flag.
        ({"t1": 5.0}, ValueError, "`t1` must be True or False, got 5.0. Give times"),
        ({"t0": 0, "t1": True}, ValueError, "`t0` must be True or False, got 0"),
        ({"dense": "yes"}, ValueError, "`dense` must be True or False, got 'yes'"),
    ],
)
def test_save_at_with_wrong_arguments_raises(arguments, exception, message):
    with pytest.raises(exception, match=f"SaveAt: .*{message}"):
        SaveAt(**arguments)


# integrate: what tracing finds --------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "exception", "message"),
    [
        ({"num_steps": 0}, ValueError, "`num_steps` must be in 1.*got 0"),
        ({"num_steps": -1}, ValueError, "`num_steps` must be in 1.*got -1"),
        ({"num_steps": 2**31}, ValueError, r"2\^31 - 1, got 2147483648"),
        (
            {"num_steps": 4.0},
            TypeError,
            "`num_steps` must be an int.*got 4.0 of.*float",
        ),
        ({"num_steps": True}, TypeError, "`num_steps` must be an int.*got True"),
        ({"dt": 0.0}, ValueError, "`dt` is zero; give a positive or negative"),
        ({"dt": 0}, ValueError, "`dt` is zero"),
        ({"dt": np.nan}, nhjax.NonFiniteError, "`dt` is not finite: nan"),
        ({"dt": np.inf}, nhjax.NonFiniteError, "`dt` is not finite: inf"),
        ({"dt": jnp.ones(3)}, nhjax.ShapeError, r"`dt`.*\(3,\).*jax.vmap"),
        ({"dt": 0.1j}, nhjax.DTypeError, "`dt` must be a real number, got 0.1j"),
        ({"dt": True}, nhjax.DTypeError, "`dt` must be a real number, got True"),
        ({"dt": "0.1"}, nhjax.DTypeError, "`dt` must be a real number, got '0.1'"),
        ({"dt": None}, nhjax.DTypeError, "`dt` must be a real number, got None"),
        ({"t0": np.nan}, nhjax.NonFiniteError, "`t0` is not finite: nan"),
        ({"t0": jnp.ones((1, 1))}, nhjax.ShapeError, r"`t0` has shape \(1, 1\)"),
        ({"system": kinetic}, TypeError, "`system` must be an nhjax.LagrangianSystem"),
        ({"system": PARTICLE}, TypeError, r"NonholonomicParticle; pass .*`\.system`"),
        ({"method": 3}, TypeError, r"`method`.*got 3 of type int.*LobattoIIIAB\(3\)"),
        (
            {"method": nhjax.LobattoIIIAB},
            TypeError,
            r"`method`.*the class itself; write LobattoIIIAB\(\.\.\.\)",
        ),
        (
            {"stage_solver": "newton"},
            TypeError,
            r"`stage_solver`.*got 'newton'.*nhjax\.Newton\(\)",
        ),
        ({"saveat": True}, TypeError, "`saveat` must be an nhjax.SaveAt, got True"),
        (
            {"progress_meter": True},
            TypeError,
            "`progress_meter`.*got True of type bool",
        ),
        ({"method": nhjax.Gauss(2)}, ValueError, r"Gauss\(stages=2\).*hypothesis H1"),
        (
            {"saveat": SaveAt(steps=5)},
            ValueError,
            "`steps=5` saves nothing in a run of 4 steps. Add `t1=True`",
        ),
        (
            {"saveat": SaveAt(ts=[0.1, 0.5])},
            ValueError,
            "`ts` reaches from 0.1 to 0.5, outside the run from 0.0 to 0.4",
        ),
        ({"saveat": SaveAt(ts=[-0.1, 0.1])}, ValueError, "`ts` reaches from -0.1"),
        (
            {"saveat": SaveAt(ts=[0.2, 0.1])},
            ValueError,
            "`ts` must be sorted in the direction of time, which runs forward",
        ),
        (
            {"saveat": SaveAt(ts=[-0.2, -0.1]), "dt": -0.1},
            ValueError,
            "`ts` must be sorted in the direction of time, which runs backward",
        ),
    ],
)
def test_integrate_with_wrong_arguments_raises(arguments, exception, message, y0):
    with pytest.raises(exception, match=message):
        run(y0, **arguments)


def test_integrate_with_a_set_in_args_raises(y0):
    with pytest.raises(TypeError, match=r"`args\[0\]` is \{3\} of type set"):
        run(y0, args=({3},))


def test_num_steps_traced_with_saved_steps_raises(y0):
    with pytest.raises(TypeError, match=r"known when tracing.*static argument.*Tracer"):
        jax.jit(lambda n: run(y0, num_steps=n, saveat=SaveAt(steps=True)))(4)


@pytest.mark.parametrize("saveat", [SaveAt(dense=True), SaveAt(ts=[0.1])])
def test_dense_output_without_collocation_method_raises(saveat):
    y0 = nhjax.initial_state(FREE, Q, V)
    with pytest.raises(ValueError, match=r"C\(q\) for q >= stages = 4.*q = 1\. Use Lo"):
        run(y0, FREE, EXPLICIT_RK4, saveat=saveat)


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


def test_integrate_with_a_trajectory_as_state_raises(y0):
    sol = run(y0)
    with pytest.raises(
        nhjax.ShapeError, match=r"tree.map\(lambda x: x\[-1\], sol.ys\)"
    ):
        run(sol.ys)
    with pytest.raises(TypeError, match=r"`y0` must be an nhjax.State.*, got Solution"):
        run(sol)


def test_integrate_with_state_of_another_system_raises(y0):
    oscillator = HarmonicOscillator(q0=(1.0, 0.0, 0.0), v0=(0.0, 1.0, 0.0))
    with pytest.raises(nhjax.ShapeError, match=r"`y0.multiplier`.*\(0,\).*\(1,\). Use"):
        run(oscillator.initial_state())
    with pytest.raises(nhjax.ShapeError, match=r"`y0.multiplier`.*\(1,\).*\(0,\)"):
        run(y0, oscillator.system)
    with pytest.raises(TypeError, match=r"got \(Array.*of type tuple. Make one with"):
        run((Q, V))


# A state that is well-formed, but no state of this system at this time.
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
    # Differences for a derivative take the states off the constraint.
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
