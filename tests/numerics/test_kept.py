"""Functions that are traced once have the values and derivatives of the originals."""

from unittest.mock import Mock

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax._numerics import kept_function
from nhjax._numerics._kept import _known, _MOST_FUNCTIONS


@pytest.fixture(autouse=True)
def _no_earlier_functions():
    _known.clear()


X, Y = jnp.array([0.3, -0.7]), {"a": jnp.array([[1.0, 2.0], [-0.5, 0.1]])}


def energy(x, y):
    return jnp.sin(x) @ y["a"] @ jnp.cosh(x) + y["a"][0, 1] * x[0]


class Spring(eqx.Module):
    stiffness: jax.Array
    power: float

    def __call__(self, x):
        return jnp.sum(self.stiffness * x**2) ** self.power


def kept(function, *example):
    found = kept_function(function, *example)
    assert found is not None
    return found


@pytest.mark.parametrize(
    "derived",
    [
        lambda f: f(X, Y),
        lambda f: eqx.filter_jit(f)(X, Y),
        lambda f: jax.grad(f, argnums=(0, 1))(X, Y),
        lambda f: jax.hessian(f)(X, Y),
        lambda f: jax.jacfwd(jax.jacfwd(f, argnums=1))(X, Y),
        lambda f: jax.jacrev(jax.jacrev(jax.jacrev(f)))(X, Y),
        lambda f: jax.jvp(lambda x: f(x, Y), (X,), (X,)),
        lambda f: jax.vmap(f, in_axes=(0, None))(jnp.outer(X, X), Y),
        lambda f: jax.vmap(jax.grad(f), in_axes=(1, None))(jnp.outer(X, X), Y),
        lambda f: jax.jacfwd(jax.vmap(jax.grad(f), in_axes=(0, None)))(
            jnp.outer(X, X), Y
        ),
    ],
)
def test_kept_function_and_derivatives_equal_those_of_the_function(derived):
    found, expected = derived(kept(energy, X, Y)), derived(energy)
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-15),
        found,
        expected,
    )


def test_kept_function_for_the_same_kinds_of_arguments_has_one_program():
    def function(x):
        return x**3

    assert kept(function, X).program is kept(function, 2 * X).program
    assert kept(function, X).program is not kept(function, X[:1]).program


def test_kept_function_that_changes_a_value_it_reads_is_right():
    calls = []

    def function(x):
        calls.append(None)
        return x**2

    for _ in range(3):
        np.testing.assert_allclose(kept(function, X)(3 * X), 9 * X**2, rtol=1e-15)
    assert calls


def test_kept_function_derivative_is_traced_once_for_two_callers():
    count = []

    @jax.custom_jvp
    def function(x):
        return jnp.sin(x)

    @function.defjvp
    def _rule(primals, tangents):
        count.append(None)
        return function(primals[0]), jnp.cos(primals[0]) * tangents[0]

    def total(x):
        return jnp.sum(function(x))

    for _ in range(3):
        found = kept(total, X)
        np.testing.assert_allclose(jax.grad(found)(X), jnp.cos(X), rtol=1e-15)
        np.testing.assert_allclose(jax.grad(found)(2 * X), jnp.cos(2 * X), rtol=1e-15)
    assert len(count) <= 3


SCALE = 2.0


def test_kept_function_that_reads_changed_values_is_traced_again(monkeypatch):
    table, extra = np.array([1.0, 3.0]), [5.0]

    def function(x):
        return SCALE * jnp.sum(table * x) + extra[0]

    def value():
        return float(kept(function, X)(X))

    def expected():
        return SCALE * float(table @ np.asarray(X)) + extra[0]

    assert value() == pytest.approx(expected(), rel=1e-15)
    table[0] = -4.0
    assert value() == pytest.approx(expected(), rel=1e-15)
    extra[0] = 0.0
    assert value() == pytest.approx(expected(), rel=1e-15)
    monkeypatch.setitem(globals(), "SCALE", -1.0)
    assert value() == pytest.approx(expected(), rel=1e-15)


@pytest.mark.parametrize(("one", "other"), [(0.0, -0.0), (1, True), (2, 2.0)])
def test_kept_function_with_equal_but_different_numbers_is_traced_again(one, other):
    def moved(x, number):
        return x + float(number)

    programs = [kept(moved, X, number).program for number in (one, other)]
    assert programs[0] is not programs[1]


def test_kept_function_of_other_parameters_shares_its_program():
    soft, hard = Spring(jnp.array(1.0), 0.5), Spring(jnp.array(4.0), 0.5)
    programs = [kept(spring, X).program for spring in (soft, hard)]
    assert programs[0] is programs[1]
    np.testing.assert_allclose(kept(hard, X)(X), hard(X), rtol=1e-15)
    cubic = Spring(jnp.array(1.0), 1.5)
    np.testing.assert_allclose(kept(cubic, X)(X), cubic(X), rtol=1e-15)
    slope = jax.grad(lambda spring: kept(spring, X)(X))(hard).stiffness
    np.testing.assert_allclose(slope, hard(X) / 8, rtol=1e-15)


def test_kept_function_that_closes_over_a_tracer_has_its_derivative():
    def run(scale):
        return kept(lambda x: jnp.sum(scale * x**2), X)(X)

    for scale in (1.0, 3.0):
        np.testing.assert_allclose(jax.grad(run)(scale), X @ X, rtol=1e-15)
        np.testing.assert_allclose(jax.jit(run)(scale), scale * X @ X, rtol=1e-15)
    assert not _known


def test_kept_function_under_other_settings_of_jax_is_traced_again():
    x = X.astype(jnp.float32)
    programs = []
    for enabled in (True, False, True):
        with jax.enable_x64(enabled):
            programs.append(kept(jnp.sum, x).program)
    assert programs[0] is programs[2]
    assert programs[0] is not programs[1]


def test_kept_function_with_effects_is_none(capfd):
    def function(x):
        jax.debug.print("{}", x[0])
        return x

    assert kept_function(function, X) is None


def test_kept_functions_are_dropped_after_the_most_that_are_kept():
    for power in range(_MOST_FUNCTIONS + 5):
        kept(lambda x, p: x**p, X, power)
    assert len(_known) == _MOST_FUNCTIONS


def test_kept_function_without_jit_calls_single_operations():
    found = kept(energy, X, Y)
    with jax.disable_jit():
        assert "kept_call" not in str(jax.make_jaxpr(found)(X, Y))
    assert "kept_call" in str(jax.make_jaxpr(found)(X, Y))


def test_kept_function_with_a_constant_result_is_compiled_by_xla(monkeypatch):
    monkeypatch.setenv("NHJAX_ENGINE", "kernels")
    found = kept(lambda x: jnp.eye(2), X)
    np.testing.assert_array_equal(jax.jit(lambda x: found(x))(X), jnp.eye(2))


def test_functions_of_a_system_are_called_once_for_all_uses():
    # A mock is compared by identity, so that its count is not a changed value.
    seen = Mock()

    def lagrangian(t, q, v, args):
        seen()
        return 0.5 * v @ v - 0.5 * args * q[0] ** 2

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=lambda t, q, v, args: v[0] - q[1] * v[1]
    )
    q, v, stiffness = jnp.array([0.1, 0.2]), jnp.array([0.2, 1.0]), jnp.array(1.0)
    start = nhjax.initial_state(system, q, v, args=stiffness)
    # One of the calls checks the shape of the result.
    assert seen.call_count == 2

    def end(stiffness):
        method = nhjax.LobattoIIIAB(2)
        run = nhjax.integrate(
            system, method, start, dt=0.1, num_steps=5, args=stiffness
        )
        return run.ys.q[-1, 0]

    end(stiffness)
    jax.grad(end)(stiffness)
    nhjax.motion(system, 0.0, start, args=stiffness)
    assert seen.call_count == 2
    nhjax.check_system(system, q, v, args=stiffness)
    assert seen.call_count == 3


def test_run_that_xla_compiles_calls_native_code_for_long_functions_only(monkeypatch):
    # XLA compiles all programs but the functions of the system.
    patched = "nhjax.lanes._program."
    monkeypatch.setattr(f"{patched}_suits_vectors", _contains_kept_functions)
    monkeypatch.setattr(f"{patched}reason_against_kernel", lambda program: "large")

    def engines(terms):
        def lagrangian(t, q, v, args):
            potential = sum(jnp.cos((k + 1) * q[0]) for k in range(terms))
            return 0.5 * v @ v - potential

        system = nhjax.LagrangianSystem(lagrangian)
        y0 = nhjax.initial_state(system, jnp.ones(2), jnp.ones(2))

        def run(y0):
            method = nhjax.LobattoIIIAB(2)
            return nhjax.integrate(system, method, y0, dt=0.1, num_steps=3, throw=False)

        return {use.engine for use in nhjax.engines(run, y0)}

    assert engines(3) == {"xla"}
    assert engines(300) == {"xla", "lanes"}


def _contains_kept_functions(program):
    return "kept_call" in str(program)
