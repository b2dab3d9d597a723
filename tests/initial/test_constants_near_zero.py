"""Starts near zero of systems whose constraints have constants of their own."""

import pytest

from benchmarks._refusals_near_zero import CASES, count


@pytest.mark.parametrize("name", CASES)
def test_initial_state_near_zero_is_refused_only_beyond_round_off_of_constants(name):
    for row in count(CASES[name], 4):
        assert row["refused"] == {0: 0, 10: 0, 1000: 4}
