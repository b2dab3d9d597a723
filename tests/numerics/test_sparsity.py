"""Entries of Jacobians that vanish; entries that do not vanish are never missed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._numerics import jacobian_sparsity


X = jnp.asarray(np.random.default_rng(3).standard_normal(12))
PICKED = np.array([3, 1, 1, 7])

# Functions whose program shows all entries that vanish.
EXACT = {
    "picked": lambda x: x[PICKED] * x[2:6],
    "rolled and reversed": lambda x: jnp.roll(x, 3) * x[::-1],
    "transposed": lambda x: x.reshape(3, 4).T.reshape(-1) ** 2,
    "joined": lambda x: jnp.concatenate([x[:3], x[4:8] ** 2]),
    "padded": lambda x: jax.lax.pad(x[:4], 0.0, [(-1, 2, 1)]),
    "sums": lambda x: x.reshape(3, 4).sum(1),
    "matrix times vector": lambda x: x.reshape(4, 3) @ x[:3],
    "products in a batch": lambda x: jnp.einsum(
        "bij,bj->bi", x.reshape(3, 2, 2), x[:6].reshape(3, 2)
    ).reshape(-1),
    "lengths": lambda x: jnp.linalg.norm(jnp.diff(x.reshape(6, 2), axis=0), axis=1),
    "picked columns": lambda x: x.reshape(4, 3)[:, jnp.array([2, 0])].reshape(-1),
    "vmap": lambda x: jax.vmap(lambda a, b: a @ b)(x.reshape(4, 3), x.reshape(4, 3)),
    "outer": lambda x: jnp.outer(x[:2], x[3:5]).reshape(-1),
}
# Functions of which more entries are kept than differ from zero.
KEPT = {
    "written": lambda x: x.at[3].set(x[0]),
    "sorted": lambda x: jnp.sort(x)[:2],
    "loop": lambda x: jax.lax.fori_loop(0, 3, lambda _, y: y * x[0], x[:3]),
    "branch": lambda x: jax.lax.cond(x[0] > 0, lambda y: y[:2], lambda y: y[2:4], x),
    "largest": lambda x: x[-1:] * x[x.argmax()],
    "running sums": jnp.cumsum,
}


@pytest.mark.parametrize("name", [*EXACT, *KEPT])
def test_sparsity_pattern_contains_all_nonzero_entries_of_jacobian(name):
    function = (EXACT | KEPT)[name]
    found = jacobian_sparsity(function, X)
    entries = np.asarray(jax.jacfwd(function)(X)) != 0
    assert found.shape == entries.shape
    assert not np.any(entries & ~found)
    if name in EXACT:
        np.testing.assert_array_equal(found, entries)


def test_sparsity_pattern_of_custom_jvp_follows_its_rule():
    @jax.custom_jvp
    def square(x):
        return x**2

    square.defjvp(lambda x, dx: (square(*x), 2 * x[0] * jnp.roll(dx[0], 1)))
    expected = np.roll(np.eye(12, dtype=bool), -1, axis=1)
    np.testing.assert_array_equal(jacobian_sparsity(square, X), expected)
