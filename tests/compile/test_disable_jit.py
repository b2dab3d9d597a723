"""`jax.disable_jit`, with which people debug, shows numbers and changes none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

import nhjax
from nhjax._compile import as_cpu_kernel


PARTICLE = nhjax.systems.NonholonomicParticle()
METHOD = nhjax.LobattoIIIAB(2)


@pytest.mark.long
def test_three_steps_and_their_gradient_are_those_of_the_compiled_program():
    y0 = PARTICLE.initial_state()

    def loss(dt):
        sol = nhjax.integrate(PARTICLE.system, METHOD, y0, dt=dt, num_steps=3)
        return jnp.sum(jnp.sin(sol.ys.q)), sol

    program = jax.value_and_grad(loss, has_aux=True)
    (value, sol), gradient = program(0.1)
    with jax.disable_jit():
        (same, other), derivative = program(0.1)
    np.testing.assert_allclose(same, value, rtol=1e-14)
    np.testing.assert_allclose(derivative, gradient, rtol=1e-12)
    for got, expected in zip(
        jax.tree.leaves(other.ys), jax.tree.leaves(sol.ys), strict=True
    ):
        np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-15)
    assert int(other.stats["num_steps"]) == 3


def test_the_end_of_a_run_at_an_event_is_that_of_the_compiled_program():
    fall = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v[0] ** 2 - q[0])
    y0 = nhjax.initial_state(fall, jnp.array([1.0]), jnp.array([0.0]))
    ground = nhjax.Event(lambda t, y, args: y.q[0])

    def end(y0):
        return nhjax.integrate(fall, METHOD, y0, dt=2.0, num_steps=1, event=ground)

    expected = end(y0)
    with jax.disable_jit():
        sol = end(y0)
    np.testing.assert_allclose(sol.t1, np.sqrt(2), rtol=1e-14)
    np.testing.assert_allclose(sol.t1, expected.t1, rtol=1e-15)
    assert int(sol.stats["num_events"]) == 1


def test_a_function_in_a_kernel_sees_numbers():
    seen = []

    def function(x):
        seen.append(float(x))
        return 2 * x

    with jax.disable_jit():
        assert float(as_cpu_kernel(function, jnp.asarray(1.5))) == 3
    assert seen == [1.5]


def test_a_kernel_that_was_traced_before_is_evaluated():
    traced = jax.make_jaxpr(lambda x: as_cpu_kernel(jnp.sin, x))(0.5)
    with jax.disable_jit():
        (got,) = jaxpr_as_fun(traced)(jnp.asarray(0.5))
    np.testing.assert_allclose(got, np.sin(0.5), rtol=1e-15)


def test_a_start_that_is_refused_is_refused_with_the_same_words():
    system = PARTICLE.system
    wrong = PARTICLE.v0 + jnp.array([0.0, 0.0, 1.0])
    with (
        jax.disable_jit(),
        pytest.raises(nhjax.ConstraintViolationError, match=r"Φ\[0\] = .*project=True"),
    ):
        nhjax.initial_state(system, PARTICLE.q0, wrong)
