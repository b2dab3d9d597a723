"""The sizes of arrays, and perturbations by about the size of a number."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._numerics import largest_column, max_norm, uneven_perturbations


@pytest.mark.parametrize("columns", [1, 2, 3, 8, 33])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_largest_column_of_matrices_contains_their_largest_number(columns, dtype):
    random = np.random.default_rng(columns)
    matrices = [
        jnp.asarray(random.normal(size=(rows, columns)), dtype) for rows in (3, 2)
    ]
    value, column = jax.jit(largest_column)(*matrices)
    sizes = np.max(np.abs(np.concatenate(matrices)), axis=0)
    assert int(column) == np.argmax(sizes)
    assert value.dtype == dtype
    # The value loses the bits that store the number of the column.
    lost = 2 * columns * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(value, max_norm(*matrices), rtol=lost)


def test_largest_column_with_infinity_or_nan_is_its_column():
    matrix = jnp.asarray([[1.0, -jnp.inf, 2.0]])
    value, column = largest_column(matrix)
    assert (float(value), int(column)) == (float("inf"), 1)
    value, column = largest_column(matrix.at[0, 2].set(jnp.nan))
    assert np.isnan(value)
    assert int(column) == 2
    value, column = largest_column(jnp.zeros((2, 3)))
    assert float(value) == 0.0


def test_uneven_perturbations_have_the_size_of_the_numbers():
    q = (jnp.full(3, -2.0), jnp.full((2, 2), 2.0))
    changes = uneven_perturbations(q)
    assert [x.shape for x in changes] == [(3,), (2, 2)]
    numbers = np.concatenate([np.ravel(x) for x in changes])
    assert np.all((np.abs(numbers) >= 1.0) & (np.abs(numbers) <= 2.0))
    assert np.any(numbers > 0)
    assert np.any(numbers < 0)
    for one, other in itertools.combinations(numbers, 2):
        assert abs(one - other) > 0.05
        assert abs(one + other) > 0.05


def test_uneven_perturbations_of_zero_are_zero():
    np.testing.assert_array_equal(uneven_perturbations(jnp.zeros(2)), 0)
