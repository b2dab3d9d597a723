"""A result prints its name and what to do; for many runs, how they ended."""

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest

import nhjax
from nhjax import RESULTS
from nhjax._results import messages, result_codes


def of_codes(codes):
    """Make the results of a batch, as `vmap` does."""
    return jax.tree.map(lambda x: jnp.asarray(codes, x.dtype), RESULTS.successful)


@pytest.mark.parametrize("name", result_codes())
def test_result_of_one_run_prints_its_name_and_message(name):
    item, message = getattr(RESULTS, name), messages()[result_codes()[name]]
    expected = f"{name}: {message}" if name != "successful" else name
    assert RESULTS[item] == expected
    assert str(item) == repr(item) == f"nhjax.RESULTS<{expected}>"
    assert (len(message) > 30) == (name != "successful")


def test_result_of_integrate_prints_its_name():
    oscillator = nhjax.systems.HarmonicOscillator()
    y0, method = oscillator.initial_state(), nhjax.LobattoIIIAB(2)
    sol = nhjax.integrate(oscillator.system, method, y0, dt=0.1, num_steps=2)
    assert str(sol.result) == "nhjax.RESULTS<successful>"
    assert "result=nhjax.RESULTS<successful>" in str(sol)
    bad = eqx.tree_at(lambda y: y.v, y0, 2.0 * y0.v + 1.0)
    sol = nhjax.integrate(
        oscillator.system, method, bad, dt=0.1, num_steps=2, throw=False
    )
    assert str(sol.result).startswith(
        "nhjax.RESULTS<inconsistent_start: The initial state violates"
    )


def test_results_of_many_runs_print_counts_and_first_of_each():
    codes = result_codes()
    good, bad, turned = (
        codes[name] for name in ("successful", "nonfinite_state", "left_chart")
    )
    several = of_codes([good, turned, bad, good, bad])
    assert str(several) == (
        "nhjax.RESULTS<5 runs: 2 successful, 2 nonfinite_state (first: 2), "
        "1 left_chart (first: 1)>"
    )
    assert RESULTS[of_codes([good] * 1000)] == "1000 runs: 1000 successful"
    nested = RESULTS[of_codes([[good, good], [good, bad]])]
    assert nested == "4 runs: 3 successful, 1 nonfinite_state (first: (1, 1))"
    assert RESULTS[of_codes([])] == "0 runs"


def test_result_without_value_prints_that_it_is_traced(capsys):
    jax.jit(lambda result: print(result))(RESULTS.left_chart)
    assert capsys.readouterr().out == "nhjax.RESULTS<traced>\n"
    shape = jax.eval_shape(lambda result: result, RESULTS.left_chart)
    assert str(shape) == "nhjax.RESULTS<unknown>"


def test_result_of_a_wrong_number_raises():
    with pytest.raises(ValueError, match="must be an enumeration item"):
        RESULTS[3]  # pyright: ignore
