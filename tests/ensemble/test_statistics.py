"""Statistics of ensembles equal exact fractions for every chunk size."""

from fractions import Fraction

import jax.numpy as jnp
import numpy as np
import pytest

import nhjax


MEMBERS = 1000
CHUNKS = (1, 7, 1000)
ALL = {
    "mean": nhjax.Mean(),
    "variance": nhjax.Variance(),
    "least": nhjax.Minimum(),
    "largest": nhjax.Maximum(),
    "histogram": nhjax.Histogram(np.linspace(-3.0, 3.0, 601), of=lambda x: x["small"]),
}


@pytest.fixture(scope="module")
def data():
    """Return small numbers, and the same with a mean of 1e8 standard deviations."""
    small = np.random.default_rng(0).standard_normal((MEMBERS, 2))
    return {"small": small, "large": small + 1e8}


@pytest.fixture(scope="module", params=CHUNKS)
def statistics(request, data):
    run = {"members": data, "reduce": ALL, "chunk_size": request.param}
    return nhjax.ensemble(lambda member: member, **run).statistics


def exact(x):
    """Compute the mean and the variance of a column with fractions."""
    numbers = [Fraction(float(y)) for y in x]
    mean = sum(numbers) / len(numbers)
    squares = sum((y - mean) ** 2 for y in numbers)
    return float(mean), float(squares / (len(numbers) - 1))


@pytest.mark.parametrize("name", ["small", "large"])
def test_ensemble_mean_and_variance_in_chunks_equal_exact_fractions(
    name, statistics, data
):
    for column in range(2):
        mean, variance = exact(data[name][:, column])
        got = [statistics[x][name][column] for x in ("mean", "variance")]
        # The mean of the small numbers is itself the result of a cancellation.
        np.testing.assert_allclose(got[0], mean, rtol=1e-15, atol=1e-17)
        np.testing.assert_allclose(got[1], variance, rtol=1e-15)


def test_ensemble_minimum_and_maximum_in_chunks_equal_numpy(statistics, data):
    for name, x in data.items():
        assert np.array_equal(statistics["least"][name], x.min(axis=0))
        assert np.array_equal(statistics["largest"][name], x.max(axis=0))


def test_ensemble_histogram_and_quantiles_in_chunks_equal_numpy(statistics, data):
    found, x = statistics["histogram"], data["small"]
    for column in range(2):
        counts = np.histogram(x[:, column], found.edges)[0]
        assert np.array_equal(found.counts[column], counts)
    below = np.sum(x < -3, axis=0)
    assert np.array_equal(found.below, below)
    inside = np.sum(found.counts, axis=-1)
    assert np.array_equal(inside + below + found.above, [MEMBERS] * 2)
    for fraction in (0.1, 0.5, 0.9):
        expected = np.quantile(x, fraction, axis=0)
        # The error is at most the width of a bin plus the distance of two members.
        np.testing.assert_allclose(found.quantile(fraction), expected, atol=0.02)


def test_ensemble_quantile_outside_the_edges_raises():
    found = nhjax.ensemble(
        lambda x: x, jnp.array([0.0, 1.0, 5.0]), reduce=nhjax.Histogram([0.5, 2.0])
    ).statistics
    assert 0.5 <= found.quantile(0.5) <= 2.0
    with pytest.raises(ValueError, match="1 members are below them and 1 above"):
        found.quantile(0.01)


def test_ensemble_statistics_of_infinity_and_nan_propagate_them():
    x = np.ones((5, 3))
    x[1, 0], x[2, 1], x[3, 1], x[4, 2] = np.inf, np.inf, -np.inf, np.nan
    got = nhjax.ensemble(
        lambda x: x,
        x,
        reduce=(nhjax.Mean(), nhjax.Minimum(), nhjax.Histogram([0, 2])),
        chunk_size=2,
    ).statistics
    np.testing.assert_array_equal(got[0], [np.inf, np.nan, np.nan])
    np.testing.assert_array_equal(got[1], [1.0, -np.inf, np.nan])
    assert got[2].nan.tolist() == [0, 0, 1]
    assert got[2].above.tolist() == [1, 1, 0]


def test_ensemble_statistics_of_integers_and_booleans_are_computed():
    got = nhjax.ensemble(
        lambda i: (i, i > 1),
        lambda i: i,
        num_members=4,
        reduce={"mean": nhjax.Mean(), "least": nhjax.Minimum()},
    ).statistics
    assert [float(x) for x in got["mean"]] == [1.5, 0.5]
    assert [x.item() for x in got["least"]] == [0, False]


class Product(nhjax.AbstractReduction):
    """A reduction that a user has defined."""

    def init(self, value):
        """Create a product without factors."""
        return jnp.ones(value.shape, value.dtype)

    def update(self, state, values, counts):
        """Multiply with the members of a chunk."""
        return state * jnp.prod(jnp.where(counts, values, 1.0))

    def merge(self, one, other):
        """Multiply two products."""
        return one * other

    def finish(self, state):
        """Convert to a Python float."""
        return float(state)


def test_ensemble_reduction_of_a_user_is_applied_in_chunks():
    got = nhjax.ensemble(
        lambda x: x, jnp.arange(1.0, 6.0), reduce=Product(), chunk_size=2
    )
    assert got.statistics == 120.0


def test_ensemble_variance_of_one_member_raises():
    with pytest.raises(ValueError, match="more than 1 members"):
        nhjax.ensemble(lambda x: x, jnp.ones(1), reduce=nhjax.Variance())


@pytest.mark.parametrize("edges", [[1.0], [0.0, 0.0], [0.0, np.nan], [[0.0, 1.0]]])
def test_ensemble_histogram_with_invalid_edges_raises(edges):
    with pytest.raises(ValueError, match="`edges` must"):
        nhjax.Histogram(edges)
