"""`jax.disable_jit`, which people use to debug, shows numbers without changing them."""

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
def test_steps_with_disable_jit_equal_compiled_steps():
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


def test_event_with_disable_jit_equals_compiled_event():
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


def test_function_with_disable_jit_sees_numbers():
    seen = []

    def function(x):
        seen.append(float(x))
        return 2 * x

    with jax.disable_jit():
        assert float(as_cpu_kernel(function, jnp.asarray(1.5))) == 3
    assert seen == [1.5]


def test_kernel_traced_before_disable_jit_is_evaluated():
    traced = jax.make_jaxpr(lambda x: as_cpu_kernel(jnp.sin, x))(0.5)
    with jax.disable_jit():
        (got,) = jaxpr_as_fun(traced)(jnp.asarray(0.5))
    np.testing.assert_allclose(got, np.sin(0.5), rtol=1e-15)


def test_refused_start_with_disable_jit_has_same_message():
    system = PARTICLE.system
    wrong = PARTICLE.v0 + jnp.array([0.0, 0.0, 1.0])
    with (
        jax.disable_jit(),
        pytest.raises(nhjax.ConstraintViolationError, match=r"Φ\[0\] = .*project=True"),
    ):
        nhjax.initial_state(system, PARTICLE.q0, wrong)
