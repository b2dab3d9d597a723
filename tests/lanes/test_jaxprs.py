"""The sizes of arrays in a program, which decide the engine that compiles it."""

import jax
import jax.numpy as jnp

from nhjax.lanes._jaxprs import rms_array_size


def test_large_arrays_outside_of_the_inner_loop_count_less():
    def step(x, _):
        x = jax.lax.fori_loop(0, 5, lambda i, x: jnp.sin(x) + x, x)
        return x + jnp.sum(jnp.cos(x[:, None] * jnp.ones((1, 100)))), None

    def run(x):
        return jax.lax.scan(step, x, length=7)[0]

    program = jax.make_jaxpr(run)(jnp.ones(4)).jaxpr
    alike = rms_array_size(program)
    assert alike > 100
    # With operations in loops counted 16 times, the two arrays of 400 numbers matter
    # less.
    assert rms_array_size(program, 16) < 0.6 * alike
