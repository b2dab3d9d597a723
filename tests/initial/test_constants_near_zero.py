"""Starts near the constraints and near zero, by the code of the benchmark."""

import jax.numpy as jnp
import pytest

from benchmarks.acceptance import CASES, count_near_constraints, count_near_zero
from nhjax import systems


@pytest.mark.parametrize("name", CASES)
def test_initial_state_near_zero_is_refused_only_beyond_round_off_of_constants(name):
    for row in count_near_zero(CASES[name], 4):
        assert row["refused"] == {0: 0, 10: 0, 1000: 4}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_initial_state_near_constraints_is_projected_and_nan_is_refused(dtype):
    counts = count_near_constraints(
        systems.SphericalPendulum(), dtype, 4, (0.0, 1e-4, float("nan"))
    )
    assert list(counts) == ["q", "v", "v, at rest", "q, at rest"]
    assert all(count == [0, 0, 4] for count in counts.values())
