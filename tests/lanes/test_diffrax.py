"""`lanes.vmap` of ensembles that diffrax integrates with adaptive steps."""

from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import lanes


def solve(y0, rate, solver, **options):
    """The Lorenz system with adaptive steps."""

    def field(t, y, rate):
        a, b, c = y
        return jnp.stack([10 * (b - a), a * (rate - c) - b, a * b - 8 / 3 * c])

    return diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        solver,
        t0=0.0,
        t1=0.3,
        dt0=0.01,
        y0=y0,
        args=rate,
        stepsize_controller=diffrax.PIDController(rtol=1e-7, atol=1e-7),
        **options,
    )


STARTS = 1.0 + jnp.linspace(0.0, 5.0, 5)[:, None] * jnp.ones((1, 3))


@pytest.mark.parametrize("name", ["Tsit5", "Kvaerno5"])
def test_adaptive_diffrax_ensemble_is_compiled_and_equals_jax_vmap(name):
    def run(y0):
        sol = solve(y0, 28.0, getattr(diffrax, name)())
        return sol.ys, sol.stats["num_steps"]

    (use,) = nhjax.engines(lanes.vmap(run), STARTS)
    assert use.engine == "lanes"
    assert use.members == 5
    ys, steps = jax.jit(lanes.vmap(run))(STARTS)
    expected, expected_steps = jax.jit(jax.vmap(run))(STARTS)
    assert len(set(steps.tolist())) > 1
    np.testing.assert_array_equal(steps, expected_steps)
    np.testing.assert_allclose(ys, expected, rtol=1e-11)


def test_adaptive_diffrax_gradient_equals_that_of_jax_vmap():
    def loss(vmap, y0, rate):
        def run(y0, rate):
            ts = jnp.array([0.1, 0.3])
            return solve(
                y0, rate, diffrax.Tsit5(), saveat=diffrax.SaveAt(ts=ts), max_steps=100
            ).ys

        return jnp.sum(vmap(run, (0, None))(y0, rate) ** 2)

    got = jax.jit(jax.grad(partial(loss, lanes.vmap), (0, 1)))(STARTS, 28.0)
    expected = jax.jit(jax.grad(partial(loss, jax.vmap), (0, 1)))(STARTS, 28.0)
    for x, y in zip(got, expected, strict=True):
        np.testing.assert_allclose(
            x, y, rtol=0, atol=1e-10 * float(jnp.max(jnp.abs(y)))
        )


def test_diffrax_member_without_enough_steps_raises(capfd):
    def run(y0):
        return solve(y0, 28.0, diffrax.Tsit5(), max_steps=3).ys

    with pytest.raises(Exception, match="maximum number of solver steps"):
        jax.block_until_ready(eqx.filter_jit(lanes.vmap(run))(STARTS))
    capfd.readouterr()
