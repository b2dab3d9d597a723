"""A short form of the benchmark of long runs."""

import pytest

from benchmarks.long_runs import balance, Case
from nhjax.systems import CarAxis


@pytest.mark.parametrize("power", ["", "road"])
def test_energy_of_a_long_run_balances_the_work_of_the_road(power):
    row = balance(Case("CarAxis", CarAxis(), 0.01, 1.0, power))
    assert row["violation"] < 1e-13
    assert row["first tenth"] <= row["all"]
    # The road does work; without this work, the energy is not balanced.
    assert (row["all"] < 1e-4) == bool(power)
