"""Errors for objects of wrong types name the argument."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import plot, SaveAt
from nhjax.systems import HarmonicOscillator, NonholonomicParticle


OSCILLATOR = HarmonicOscillator()
PARTICLE = NonholonomicParticle()
HAMILTONIAN = nhjax.HamiltonianSystem(lambda t, q, p, args: 0.5 * p @ p + 0.5 * q @ q)
SOLVERS = (nhjax.Newton, nhjax.SimplifiedNewton)


def run(**others: Any) -> nhjax.Solution:
    arguments: dict[str, Any] = {
        "system": OSCILLATOR.system,
        "method": nhjax.LobattoIIIAB(2),
        "y0": OSCILLATOR.initial_state(),
        "dt": 0.1,
        "num_steps": 4,
    }
    return nhjax.integrate(**(arguments | others))


@pytest.fixture(scope="module")
def sol():
    return run(saveat=SaveAt(t0=True, steps=True))


@pytest.fixture(scope="module")
def y():
    return OSCILLATOR.initial_state()


@pytest.mark.parametrize("throw", ["yes", None, 0, 1.0])
def test_throw_that_is_not_a_bool_raises(throw):
    with pytest.raises(TypeError, match=r"`throw` must be True or False, .*got "):
        run(throw=throw)


# Solvers and methods ------------------------------------------------------------------


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("tolerance", [-1e-9, np.nan, np.inf, jnp.asarray(-1.0)])
def test_tolerance_out_of_range_raises(solver, tolerance):
    with pytest.raises(ValueError, match="`tolerance` must be finite and >= 0, got "):
        solver(tolerance=tolerance)


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("tolerance", ["1e-9", None, 1j, True])
def test_tolerance_that_is_not_a_number_raises(solver, tolerance):
    with pytest.raises(nhjax.DTypeError, match="`tolerance` must be a real number"):
        solver(tolerance=tolerance)


@pytest.mark.parametrize("method", [nhjax.LobattoIIIAB, nhjax.Gauss])
def test_stages_above_the_maximum_raise(method):
    with pytest.raises(ValueError, match="must be <= 32, got 100: more stages"):
        method(100)


@pytest.mark.parametrize("method", [nhjax.LobattoIIIAB(32), nhjax.Gauss(32)])
def test_stages_at_the_maximum_have_collocation_coefficients(method):
    # C(q) holds to round-off, also to high orders, for the float64 coefficients.
    for k in range(1, 33):
        np.testing.assert_allclose(
            method.a @ method.c ** (k - 1), method.c**k / k, rtol=0, atol=4e-16
        )
    np.testing.assert_allclose(method.a_hat.sum(axis=1), method.c, rtol=0, atol=4e-16)
    assert np.all(np.diff(method.c) > 0)


# Times that do not advance ------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"t0": 1e20}, r"`dt` = 0\.1 is below the round-off of the time `t0` = 1e\+20"),
        ({"t0": -1e20}, r"the time `t0` = -1e\+20 in float64"),
        ({"t0": 1.0, "dt": 1e-17}, r"`dt` = 1e-17 is below .* `t0` = 1\.0"),
    ],
)
def test_dt_below_round_off_of_time_raises(arguments, message):
    with pytest.raises(ValueError, match=message):
        run(**arguments)


def test_dt_below_round_off_in_single_precision_raises():
    y0 = OSCILLATOR.initial_state(jnp.float32)
    assert run(y0=y0, dt=1e-3).ts.dtype == jnp.float32
    with pytest.raises(ValueError, match=r"`t0` = 1e\+05 in float32|100000.* float32"):
        run(y0=y0, t0=1e5, dt=1e-3)


def test_dt_below_round_off_under_jit_raises():
    program = jax.jit(lambda t0: run(t0=t0).ys.q)
    jax.block_until_ready(program(1.0))
    # JAX raises either, depending on whether the program runs at once or later.
    with pytest.raises((RuntimeError, ValueError), match=r"`dt` = 0\.1 is below the"):
        jax.block_until_ready(program(1e20))


# SaveAt -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("end", "got 'end' of type str"),
        ({"q": jnp.ones(2), "name": "end"}, "got 'end' of type str"),
        (object, "of type type"),
    ],
)
def test_saved_value_that_is_not_an_array_raises(value, message):
    with pytest.raises(TypeError, match=rf"`fn\(t, y, args\)` must return.*{message}"):
        run(saveat=SaveAt(t1=True, fn=lambda t, y, args: value))


def test_saved_number_becomes_an_array():
    saveat = SaveAt(t1=True, fn=lambda t, y, args: (1.0, np.ones(2), t))
    assert [leaf.shape for leaf in jax.tree.leaves(run(saveat=saveat).ys)] == [
        (1,),
        (1, 2),
        (1,),
    ]


@pytest.mark.parametrize("ts", ["0.1", [None], [[0.1], [0.1, 0.2]]])
def test_sample_times_that_are_not_numbers_raise(ts):
    with pytest.raises(nhjax.DTypeError, match="SaveAt: `ts` must be a vector of real"):
        SaveAt(ts=ts)


# Systems, diagnostics and plots -------------------------------------------------------


@pytest.mark.parametrize("system", [OSCILLATOR.system, HAMILTONIAN])
@pytest.mark.parametrize(
    "name", ["energy", "continuous_multiplier", "constraint_violation"]
)
def test_arguments_t_and_y_in_the_wrong_order_raise(system, name, y):
    function = getattr(system, name, None) or partial(getattr(nhjax, name), system)
    call = rf"{name}\((system, )?t, y, args\)"
    with pytest.raises(TypeError, match=f"`t` must be a time.*{call}"):
        function(y, 0.0)
    with pytest.raises(TypeError, match=f"`y` must be an nhjax.State, got .*{call}"):
        function(0.0, y.q)


def test_convergence_order_of_wrong_objects_raises(sol):
    for arguments in [(["a", "b"], [1.0, 2.0]), ([0.1, 0.2], sol), ({}, [1.0])]:
        with pytest.raises(TypeError, match="must be an array of real numbers, got "):
            nhjax.convergence_order(*arguments)


def test_plots_of_wrong_objects_raise(sol):
    system: Any = OSCILLATOR.system
    with pytest.raises(TypeError, match=r"`sol` must be an nhjax\.Solution"):
        plot.multiplier(sol.ys)
    for name in ("energy", "constraint"):
        with pytest.raises(TypeError, match=r"`system` must be an nhjax\.Lagrangian"):
            getattr(plot, name)(sol, system)
        with pytest.raises(TypeError, match=r"`sol` must be an nhjax\.Solution, got 3"):
            getattr(plot, name)(system, 3)
    wrong: Any
    for wrong in (3, (0, 1.5), None):
        with pytest.raises(TypeError, match="`coordinates` must be a sequence of ints"):
            plot.trajectory(sol, wrong)
    with pytest.raises(TypeError, match="`errors` must be an array of real numbers"):
        plot.convergence([0.1, 0.2], sol)
    wrong = "4"
    with pytest.raises(TypeError, match="`order` must be a number or None, got '4'"):
        plot.convergence([0.1, 0.2], [1e-3, 1e-4], order=wrong)
