"""The operation that writes a row into a buffer, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import lanes
from nhjax._compile import write_row


ROWS = 6


def loop_of(write):
    """A loop that writes its states to a buffer, in another order of rows."""

    def run(x):
        def advance(k, carry):
            x, buffer = carry
            x = jnp.sin(x) + 0.1 * x[::-1]
            # The last row receives the states that are not kept.
            slot = jnp.where(k % 3 == 2, ROWS, (5 * k) % ROWS)
            return x, write(buffer, x, slot)

        start = x, jnp.zeros((ROWS + 1, *x.shape))
        return jax.lax.fori_loop(0, ROWS, advance, start)[1][:-1]

    return run


def by_jax(buffer, row, slot):
    return jax.lax.dynamic_update_index_in_dim(buffer, row, slot, 0)


OURS, THEIRS = loop_of(write_row), loop_of(by_jax)
X = jnp.array([0.3, 0.8])
MANY = jnp.array([[0.3, 0.8], [-0.2, 0.4], [1.0, 0.1]])


def loss(run):
    return lambda x: jnp.sum(
        jnp.cos(run(x)) * jnp.arange(1.0, 1 + 2 * ROWS).reshape(ROWS, 2)
    )


@pytest.mark.parametrize(
    "transformed",
    [
        lambda run: run(X),
        lambda run: jax.jvp(run, (X,), (2 * X,))[1],
        lambda run: jax.grad(loss(run))(X),
        lambda run: jax.jacfwd(run)(X),
        lambda run: jax.hessian(loss(run))(X),
        lambda run: jax.vmap(run)(MANY),
        lambda run: jax.vmap(jax.grad(loss(run)))(MANY),
        lambda run: jax.grad(lambda x: jnp.sum(jax.vmap(loss(run))(x)))(MANY),
        lambda run: jax.grad(jax.checkpoint(loss(run)))(X),
        lambda run: lanes.jit(run)(X),
        lambda run: lanes.vmap(run)(MANY),
        lambda run: jax.grad(loss(lanes.jit(run)))(X),
    ],
)
def test_written_rows_and_their_derivatives_agree_with_updates_by_jax(transformed):
    expected = transformed(THEIRS)
    np.testing.assert_allclose(transformed(OURS), expected, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize(
    "axes", [(0, 0, 0), (None, 0, 0), (0, None, None), (None, 1, None), (1, 0, None)]
)
def test_write_of_a_row_for_each_member_agrees_with_jax(axes):
    def arrays(axis, *shape):
        numbers = np.random.default_rng(0).normal(size=(3, *shape))
        return numbers[0] if axis is None else np.moveaxis(numbers, 0, axis)

    buffer, row = map(jnp.asarray, (arrays(axes[0], 5, 2), arrays(axes[1], 2)))
    slot = jnp.array([4, 0, 2]) if axes[2] == 0 else jnp.array(3)
    got, expected = (jax.vmap(f, axes)(buffer, row, slot) for f in (write_row, by_jax))
    np.testing.assert_array_equal(got, expected)


def test_write_of_integers_in_a_differentiated_loop_is_allowed():
    def run(x):
        def advance(k, carry):
            x, buffer = carry
            return x * x, write_row(buffer, k, k)

        return jax.lax.fori_loop(0, 3, advance, (x, jnp.zeros(4, int)))

    gradient, rows = jax.grad(run, has_aux=True)(1.1)
    np.testing.assert_allclose(gradient, 8 * 1.1**7)
    np.testing.assert_array_equal(rows, [0, 1, 2, 0])


def test_gradient_of_many_saved_rows_is_compiled_and_exact():
    disc = nhjax.systems.VerticalRollingDisc()
    y0 = disc.initial_state()

    def sum_of_rows(scale):
        y = jax.tree.map(lambda x: scale * x, y0)
        saveat = nhjax.SaveAt(steps=True)
        return nhjax.integrate(
            disc.system,
            nhjax.LobattoIIIAB(2),
            y,
            dt=1e-3,
            num_steps=5000,
            saveat=saveat,
            throw=False,
        ).ys.q.sum()

    slope = jax.grad(sum_of_rows)
    assert {use.engine for use in lanes.engines(slope, 1.0)} == {"lanes"}
    # The motion is linear in time and in the scale.
    expected = jax.jvp(sum_of_rows, (1.0,), (1.0,))[1]
    np.testing.assert_allclose(slope(1.0), expected, rtol=1e-10)
