"""Starts near zero of systems whose constraints have constants of their own."""

import pytest

from benchmarks._refusals_near_zero import CASES, count


@pytest.mark.parametrize("name", CASES)
def test_start_near_zero_is_refused_for_many_units_of_round_off_and_not_for_ten(name):
    for row in count(CASES[name], 4):
        assert row["refused"] == {0: 0, 10: 0, 1000: 4}
