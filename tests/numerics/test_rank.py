"""Tests of what is told from the pivots of a matrix."""

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._numerics import is_definite


@pytest.mark.parametrize("size", [1, 2, 5, 30])
def test_definite_matrices_are_told_from_indefinite_ones(size):
    numbers = np.random.default_rng(size)
    for _ in range(20):
        q, _ = np.linalg.qr(numbers.normal(size=(size, size)))
        values = 10 ** numbers.uniform(-6, 0, size)
        assert is_definite(jnp.asarray(q * values @ q.T))
        assert is_definite(jnp.asarray(-(q * values) @ q.T))
        if size > 1:
            values[numbers.integers(size)] *= -1
            assert not is_definite(jnp.asarray(q * values @ q.T))


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        pytest.param([1.0, 2.0], True, id="diagonal"),
        pytest.param([-1.0, -2.0], True, id="negative diagonal"),
        pytest.param([1.0, -2.0], False, id="mixed diagonal"),
        pytest.param([1.0, 0.0], False, id="singular diagonal"),
        pytest.param([[0.0, 1.0], [1.0, 0.0]], False, id="no first pivot"),
        pytest.param([[1.0, 1.0], [1.0, 1.0]], False, id="singular"),
        pytest.param([[1.0, np.nan], [np.nan, 1.0]], False, id="not finite"),
    ],
)
def test_special_matrices(matrix, expected):
    assert bool(is_definite(jnp.array(matrix))) is expected
