"""Starts near the constraints and near zero, by the code of the benchmark."""

import jax.numpy as jnp
import pytest

from benchmarks.acceptance import CASES, count_near_constraints, count_near_zero
from nhjax import systems


@pytest.mark.parametrize("name", CASES)
def test_start_near_zero_is_refused_for_many_units_of_round_off_and_not_for_ten(name):
    for row in count_near_zero(CASES[name], 4):
        assert row["refused"] == {0: 0, 10: 0, 1000: 4}


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_start_near_constraints_is_projected_and_of_nan_is_refused(dtype):
    counts = count_near_constraints(
        systems.SphericalPendulum(), dtype, 4, (0.0, 1e-4, float("nan"))
    )
    assert list(counts) == ["q", "v", "v, at rest", "q, at rest"]
    assert all(count == [0, 0, 4] for count in counts.values())
