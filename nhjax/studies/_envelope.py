"""Long oscillating curves as bands between their least and greatest values."""

from typing import TYPE_CHECKING

import numpy as np


if TYPE_CHECKING:
    from matplotlib.axes import Axes


# Few enough that the edges of a band stay lines.
BINS = 200


def envelope(
    times: np.ndarray, values: np.ndarray, bins: int = BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the least and greatest of `values` in each of `bins` intervals of time.

    Returns the middles of the intervals, the least and the greatest values. What is not
    finite is left out, and an interval of nothing else is NaN.
    """
    starts = np.linspace(0, len(times), bins + 1).astype(int)[:-1]
    finite = np.isfinite(values)
    low = np.minimum.reduceat(np.where(finite, values, np.inf), starts)
    high = np.maximum.reduceat(np.where(finite, values, -np.inf), starts)
    ends = np.append(starts[1:], len(times)) - 1
    seen = low <= high
    return (
        0.5 * (times[starts] + times[ends]),
        np.where(seen, low, np.nan),
        np.where(seen, high, np.nan),
    )


def draw_envelope(
    ax: "Axes", times: np.ndarray, values: np.ndarray, *, color: str, label: str
) -> None:
    """Draw a curve, and a band in its place if it has many more points than columns."""
    if len(times) <= 10 * BINS:
        ax.plot(times, values, linewidth=0.8, color=color, label=label)
        return
    middles, low, high = envelope(times, values)
    ax.fill_between(middles, low, high, color=color, alpha=0.25, linewidth=0)
    for edge, name in ((low, None), (high, label)):
        ax.plot(middles, edge, linewidth=0.8, color=color, label=name)
