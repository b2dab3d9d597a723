"""The largest number of matrices, and the column in which it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._numerics import largest_column, max_norm


@pytest.mark.parametrize("columns", [1, 2, 3, 8, 33])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_column_is_that_of_the_largest_number(columns, dtype):
    random = np.random.default_rng(columns)
    matrices = [
        jnp.asarray(random.normal(size=(rows, columns)), dtype) for rows in (3, 2)
    ]
    value, column = jax.jit(largest_column)(*matrices)
    sizes = np.max(np.abs(np.concatenate(matrices)), axis=0)
    assert int(column) == np.argmax(sizes)
    assert value.dtype == dtype
    # As many bits are lost as number the columns.
    lost = 2 * columns * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(value, max_norm(*matrices), rtol=lost)


def test_what_is_not_finite():
    matrix = jnp.asarray([[1.0, -jnp.inf, 2.0]])
    value, column = largest_column(matrix)
    assert (float(value), int(column)) == (float("inf"), 1)
    value, column = largest_column(matrix.at[0, 2].set(jnp.nan))
    assert np.isnan(value)
    assert int(column) == 2
    value, column = largest_column(jnp.zeros((2, 3)))
    assert float(value) == 0.0
