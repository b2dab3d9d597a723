"""The interpreter that evaluates programs of JAX in 50 digits."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

from benchmarks._high_precision import evaluate, to_float
from nhjax import lanes


def test_high_precision_function_has_fifty_digits():
    x = jnp.array([0.3, 1.7])

    def function(x):
        product = jnp.einsum("i,ij->j", jnp.sin(x), jnp.outer(x, x) + jnp.eye(2))
        return jnp.where(x > 1, product / 3, jnp.exp(product)).at[0].add(x[1] ** 3)

    found = evaluate(function, x)
    with mpmath.workdps(60):
        a, b = map(mpmath.mpf, map(float, x))
        first = mpmath.sin(a) * (a * a + 1) + mpmath.sin(b) * a * b
        second = mpmath.sin(a) * a * b + mpmath.sin(b) * (b * b + 1)
        expected = [mpmath.exp(first) + b**3, second / 3]
        for got, wanted in zip(found, expected, strict=True):
            assert abs(got - wanted) < mpmath.mpf(10) ** -45


def test_high_precision_gradient_agrees_with_float64():
    def energy(x):
        return jnp.sum(jnp.sqrt(1 + x**2) * jnp.cos(x[::-1])) / (1 + x @ x)

    x = jnp.array([0.3, -0.8, 1.1])
    slope = jax.grad(energy)
    np.testing.assert_allclose(to_float(evaluate(slope, x)), slope(x), rtol=1e-14)


def test_high_precision_evaluates_compiled_programs_member_by_member():
    def wave(x, speed):
        return jnp.sin(x / 3) * speed, x.sum()

    x = jnp.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]])
    single, many = lanes.jit(wave), lanes.vmap(wave, in_axes=(0, None))
    expected = [evaluate(wave, row, 0.7) for row in x]
    for row, (wanted, _) in zip(x, expected, strict=True):
        assert (evaluate(single, row, 0.7)[0] == wanted).all()
    for got, column in zip(
        evaluate(many, x, 0.7), zip(*expected, strict=True), strict=True
    ):
        assert (got == np.stack(column)).all()
