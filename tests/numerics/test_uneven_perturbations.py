"""Moves of numbers by about their own size."""

import itertools

import jax.numpy as jnp
import numpy as np

from nhjax._numerics import uneven_perturbations


def test_moves_are_of_the_size_of_the_numbers_and_do_not_cancel():
    q = (jnp.full(3, -2.0), jnp.full((2, 2), 2.0))
    moves = uneven_perturbations(q)
    assert [x.shape for x in moves] == [(3,), (2, 2)]
    numbers = np.concatenate([np.ravel(x) for x in moves])
    assert np.all((np.abs(numbers) >= 1.0) & (np.abs(numbers) <= 2.0))
    assert np.any(numbers > 0)
    assert np.any(numbers < 0)
    for one, other in itertools.combinations(numbers, 2):
        assert abs(one - other) > 0.05
        assert abs(one + other) > 0.05


def test_what_is_zero_does_not_move():
    np.testing.assert_array_equal(uneven_perturbations(jnp.zeros(2)), 0)
