"""Iterations that end in unusual ways."""

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._numerics import iterate, UpdateNorms


def circling(rate, angle, units, max_iterations=200, components=1):
    """An iteration whose error turns by `angle` as it contracts.

    If only one component is measured, its increments rise and fall.
    """
    turn = rate * np.array(
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    )

    def sweep(x):
        after = jnp.asarray(turn) @ x
        change = jnp.max(jnp.abs(after - x)[:components])
        return after, UpdateNorms(change), None

    return iterate(
        sweep,
        jnp.asarray([1.0, 0.3]),
        jnp.asarray(1.0),
        max_iterations=max_iterations,
        noise_units=units,
    )


@pytest.mark.parametrize("angle", [0.7, 1.4, 1.9, 2.6])
@pytest.mark.parametrize("rate", [0.3, 0.5, 0.7])
def test_iteration_that_spirals_converges(rate, angle):
    solved = circling(rate, angle, 400)
    assert solved.converged
    # The remaining error has the size of increments that are taken for noise.
    assert float(jnp.max(jnp.abs(solved.x))) < 100 * np.finfo(float).eps / (1 - rate)


@pytest.mark.parametrize("angle", [0.0, 0.3, 0.8, 1.3, 2.0, 2.6])
@pytest.mark.parametrize("rate", [0.8, 0.9, 0.95, 0.965])
def test_slow_iteration_that_spirals_leaves_no_more_error_than_noise(rate, angle):
    solved = circling(rate, angle, 400, max_iterations=1000, components=2)
    assert solved.converged
    assert int(solved.num_iterations) > 100
    # The error is 1 / (1 - rate) times as large as an increment.
    assert float(jnp.max(jnp.abs(solved.x))) < 400 * np.finfo(float).eps


@pytest.mark.parametrize(
    ("rate", "angle", "most"), [(0.7, 1.4, 30), (0.8, 0.3, 300), (0.8, 1.9, 50)]
)
def test_iteration_that_reaches_smaller_increments_is_not_noise(rate, angle, most):
    solved = circling(rate, angle, 400, max_iterations=1000)
    assert solved.converged
    assert float(jnp.max(jnp.abs(solved.x))) < most * np.finfo(float).eps


def test_iteration_with_increments_of_noise_ends():
    def sweep(k):
        # Some 150 units of round-off, with both signs.
        return k + 1, UpdateNorms(150 * 2.2e-16 * (1.5 + jnp.sin(k))), None

    solved = iterate(
        sweep, jnp.asarray(0.0), jnp.asarray(1.0), max_iterations=50, noise_units=400
    )
    assert solved.converged
    assert int(solved.num_iterations) < 20


def test_iteration_with_large_increments_that_do_not_fall_is_exhausted():
    def sweep(k):
        return k + 1, UpdateNorms(1e-10 * (1.5 + jnp.sin(k))), None

    solved = iterate(
        sweep, jnp.asarray(0.0), jnp.asarray(1.0), max_iterations=50, noise_units=400
    )
    assert not solved.converged
    assert solved.exhausted


@pytest.mark.parametrize(("tolerance", "iterations"), [(0.0, 13), (1e-6, 6)])
def test_iteration_with_large_data_ends_at_their_round_off_and_keeps_tolerance(
    tolerance, iterations
):
    # Increments 10⁻¹, 10⁻², ...; the data are a thousand times as large as x.
    solved = iterate(
        lambda k: (k + 1, UpdateNorms(0.9 * 10.0**-k), None),
        jnp.asarray(1.0),
        jnp.asarray(1.0),
        max_iterations=50,
        tolerance=tolerance,
        round_off=jnp.asarray(999.0),
    )
    assert solved.converged
    assert int(solved.num_iterations) == iterations


@pytest.mark.parametrize(
    ("is_measured", "limit", "ends"),
    [(True, 2000, True), (False, 2000, False), (True, 100, False)],
)
def test_slow_iteration_ends_only_at_measured_noise(is_measured, limit, ends):
    eps, noise = np.finfo(float).eps, 1e-11

    def sweep(k):
        fluctuation = noise * (10 + 4 * jnp.sin(k))
        return k + 1, UpdateNorms(jnp.maximum(0.75**k, fluctuation)), None

    solved = iterate(
        sweep,
        jnp.asarray(0.0),
        jnp.asarray(1.0),
        max_iterations=limit,
        noise=noise / eps if is_measured else 0.0,
        noise_units=400,
    )
    assert solved.converged == ends
    assert solved.exhausted != ends
