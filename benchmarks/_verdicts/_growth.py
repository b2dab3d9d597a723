"""How a mean squared error grows in time."""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.optimize import curve_fit


class Curve(NamedTuple):
    """μ(E) in intervals of time, with its standard error over the members."""

    times: np.ndarray
    mu: np.ndarray
    error: np.ndarray

    def mean(self, start: float, end: float) -> tuple[float, float]:
        """Return the mean of μ from `start` to `end`, and its error."""
        inside = (self.times >= start) & (self.times <= end)
        if not np.any(inside):
            return np.nan, np.nan
        # The errors of one member at one time and at the next are not independent.
        return float(np.mean(self.mu[inside])), float(np.mean(self.error[inside]))


class Growth(NamedTuple):
    """The fit μ = A + D (t/T)^α, or no growth, α = 0, where μ stays as it is."""

    ratio: float
    alpha: float
    alpha_error: float


def in_stretches(times, mu, error, final_time: float) -> Curve:
    """Average over intervals of time that grow as time does."""
    edges = np.geomspace(10.0, final_time, 13)
    # A window that begins after one sample and ends with another.
    chosen = [(times > a) & (times <= b) for a, b in itertools.pairwise(edges)]
    chosen = [x for x in chosen if np.any(x)]
    mean = lambda y: np.array([np.mean(y[x]) for x in chosen])  # noqa: E731
    return Curve(mean(times), mean(mu), mean(error))


def growth(curve: Curve) -> Growth:
    """Fit how μ grows."""
    x = curve.times / curve.times[-1]
    ratio = float(np.mean(curve.mu[-2:]) / np.mean(curve.mu[:3]))
    if ratio < 1.5:
        return Growth(ratio, 0.0, 0.0)

    def model(x, a, d, alpha):
        return np.log(np.exp(a) + np.exp(d) * x**alpha)

    first, last = np.log(curve.mu[[0, -1]])
    found, covariance = curve_fit(
        model,
        x,
        np.log(curve.mu),
        p0=[first, last, 1.0],
        sigma=curve.error / curve.mu,
        absolute_sigma=True,
        bounds=([first - 30, last - 30, 0.0], [first + 3, last + 3, 4.0]),
    )
    return Growth(ratio, float(found[2]), float(np.sqrt(covariance[2, 2])))
