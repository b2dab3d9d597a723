"""Statistics of ensembles equal exact fractions for every chunk size."""

from fractions import Fraction

import jax
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


def test_ensemble_moments_of_arrays_of_several_dtypes_and_shapes_equal_numpy(data):
    small = data["small"]
    values = {
        "matrix": small[:, :, None] * np.array([1.0, -2.0, 1e6]),
        "single": small.astype(np.float32)[:, 0],
        "double": small[:, 1] + 1e6,
        "whole": np.arange(MEMBERS) ** 2,
        "nothing": np.zeros((MEMBERS, 0)),
    }
    reduce = {"mean": nhjax.Mean(), "variance": nhjax.Variance(ddof=0)}
    run = {"reduce": reduce, "chunk_size": 300}
    got = nhjax.ensemble(lambda member: member, values, **run).statistics
    for name, x in values.items():
        mean, variance = got["mean"][name], got["variance"][name]
        assert mean.shape == variance.shape == x.shape[1:]
        assert (
            mean.dtype
            == variance.dtype
            == (np.float32 if name == "single" else np.float64)
        )
        x, rtol = x.astype(float), 1e-6 if name == "single" else 1e-13
        np.testing.assert_allclose(mean, np.mean(x, axis=0), rtol=rtol)
        np.testing.assert_allclose(variance, np.var(x, axis=0), rtol=rtol)


def test_ensembles_with_equal_values_and_reductions_trace_the_reductions_once():
    """Compiling reductions takes as long as compiling a short run."""
    traced = []

    def of(value):
        traced.append(value)
        return value

    reduce, x, counts = nhjax.Mean(of=of), np.linspace(0.0, 1.0, 6), []
    for run in (jnp.sin, jnp.cos, jnp.tan):
        got = nhjax.ensemble(run, x, reduce=reduce, chunk_size=3).statistics
        np.testing.assert_allclose(got, np.mean(run(x)), rtol=1e-14)
        counts.append(len(traced))
    # Each ensemble creates the state without members.
    assert counts[2] - counts[1] == counts[1] - counts[0] < counts[0]


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


class Count(Product):
    """Counts members; a chunk returns a number of a smaller type than the total."""

    def init(self, value):
        """Count no member."""
        return jnp.zeros((), jnp.int64)

    def update(self, state, values, counts):
        """Count the members of a chunk in one byte."""
        return jnp.sum(counts, dtype=jnp.int8)

    def merge(self, one, other):
        """Add two counts."""
        return one + other


def test_ensemble_reduction_whose_chunks_have_another_dtype_keeps_the_larger_dtype():
    run = {"reduce": Count(), "chunk_size": 100}
    with jax.numpy_dtype_promotion("standard"):
        found = nhjax.ensemble(lambda x: x, jnp.arange(200.0), **run).statistics
    assert found == 200.0


def test_ensemble_with_reductions_does_not_store_values_that_they_do_not_use():
    members, size, chunk = 40, 100_000, 20

    def run(x):
        return {"large": jnp.sin(x * jnp.arange(float(size))), "small": 2.0 * x}

    x = np.arange(float(members))
    reduce = {"small": nhjax.Mean(of=lambda value: value["small"])}
    sizes = []

    class Meter(nhjax.TextProgressMeter):
        def update(self, done, total):
            sizes.append(sum(x.nbytes for x in jax.live_arrays()))

    before = sum(x.nbytes for x in jax.live_arrays())
    options = {"chunk_size": chunk, "progress_meter": Meter()}
    found = nhjax.ensemble(run, x, reduce=reduce, **options)
    assert float(found.statistics["small"]) == 2.0 * np.mean(x)
    assert sizes
    assert max(sizes) - before < 8 * size
