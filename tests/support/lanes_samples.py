"""Shared by the tests of lanes: samples, loops, and the comparison with JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from support import lanes_run


WIDTHS = pytest.mark.parametrize("width", [1, 4, 8])
MEMBERS = 11


def assert_as_jax(function, width, *operands):
    expected = jax.jit(jax.vmap(function))(*operands)
    got = lanes_run.run_batched(function, width, *operands, contract=False)
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-14), got, expected
    )


def sample(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=(MEMBERS, *shape))


def count(most, seed=0):
    return np.random.default_rng(seed).integers(0, most, size=MEMBERS)


def repeated(times, body, x):
    """A loop whose number of rounds may differ between members."""

    def step(state):
        k, x = state
        return k + 1, body(k, x)

    start = (jnp.zeros((), int), x)
    return lax.while_loop(lambda state: state[0] < times, step, start)[1]
