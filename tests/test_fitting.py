"""At small size, the fitting notebooks find the truth within their error bars."""

import json
from functools import cache

import numpy as np
import pytest

from support.notebook_runs import FITS, run_notebook


pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def results_of(tmp_path_factory):
    """What the last cell of a notebook prints, in JSON; each notebook runs once."""

    @cache
    def results(name):
        assert name in FITS
        return json.loads(run_notebook(name, tmp_path_factory.mktemp(name))[-1]["text"])

    return results


@pytest.mark.parametrize("fit", ["sleigh", "ball"])
def test_fit_of_parameters_from_every_start_recovers_the_truth(results_of, fit):
    results = results_of("fitting")[fit]
    truth, estimates, bars = (
        np.array(results[key]) for key in ("truth", "estimates", "bars")
    )
    # The error bars are small: a few percent of the parameter.
    assert np.all(bars < 0.05 * truth)
    deviations = np.array(results["deviations_in_bars"])
    np.testing.assert_array_less(np.abs(estimates - truth), 3 * bars)
    np.testing.assert_array_less(np.abs(deviations), 3)
    # |r|² is distributed as χ², of variance twice its mean.
    freedom = results["degrees_of_freedom"]
    loss = np.array(results["loss"])
    np.testing.assert_array_less(np.abs(loss - freedom), 3 * np.sqrt(2 * freedom))
    # Starts of one experiment end at one minimum.
    starts = results["starts_per_experiment"]
    assert starts > 1
    of_one_experiment = estimates.reshape(-1, starts, truth.size)
    assert np.all(np.ptp(of_one_experiment, axis=1) < 1e-3 * bars.min(axis=0))


def test_learned_potential_is_as_accurate_as_noise_permits(results_of):
    results = results_of("learning_potential")
    loss = np.array(results["loss"])
    spread = np.sqrt(2 / results["num_data"])
    assert np.all(loss < 1 + 4 * spread)
    # A linear fit of all weights to all data would have the error σ √(P/n).
    assert np.all(np.array(results["held_out_errors"]) < 3 * results["expected_error"])
    bar = results["potential_bar"]
    assert bar < 0.1 * results["potential_size"]
    assert np.all(np.array(results["potential_errors"]) < 3 * bar)


def test_learned_system_conserves_its_energy(results_of):
    results = results_of("learning_potential")
    first, second = (results[f"energy_error_{x}_half"] for x in ("first", "second"))
    # Energies are of order one, and h⁴ = 4e-3.
    assert first < 1e-2
    assert second < 2 * first


def test_steering_reaches_the_pose_with_stationary_effort(results_of):
    results = results_of("steering_unicycle")
    assert np.all(np.array(results["misses"]) < 1e-6)
    assert np.all(np.array(results["fine_misses"]) < 1e-6)
    # The last step is the remaining part of the controls in the null space.
    assert np.all(np.array(results["last_steps"]) < 1e-3)


def test_rattleback_designed_by_gradient_reverses_its_spin(results_of):
    results = results_of("rattleback")
    assert results["first"] > 2
    assert results["last"] < -2
    # The motion itself reverses, not only its discretisation.
    assert abs(results["mean_of_finer_run"] - results["last"]) < 0.1
    np.testing.assert_allclose(results["slope"], results["difference"], rtol=1e-4)
    assert results["smallest_force"] > 0
