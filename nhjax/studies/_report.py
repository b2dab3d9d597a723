"""The tables, slopes, colours and envelopes that reports of studies share."""

import contextlib
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..diagnostics import convergence_order


if TYPE_CHECKING:
    from matplotlib.axes import Axes


# The colours of Okabe and Ito, which colour-blind readers can distinguish; most of them
# also differ in a grey print.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")
# The number of bins of an envelope; few enough that its edges are smooth lines.
BINS = 200


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Format a table as text, with right-aligned columns under a header and a ruler."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    ruler = ["-" * width for width in widths]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in (header, ruler, *rows)
    )


def format_slope(x: float) -> str:
    """Format a slope with two decimals, or as a dash if it is not finite."""
    return f"{x:.2f}" if np.isfinite(x) else "-"


def largest_by_fifths(error: np.ndarray) -> list[float]:
    """Compute max |error| over each fifth of a run."""
    return [float(np.max(part)) for part in np.array_split(np.abs(error), 5)]


def slopes(
    step_sizes: Sequence[float] | np.ndarray, errors: np.ndarray, floor: float = 0.0
) -> np.ndarray:
    """Compute observed orders in the shape of `errors`, with NaN for undefined ones.

    The first row is NaN, because it has no larger step size to compare with. So are
    orders that involve errors at or below `floor`, which are round-off.
    """
    above = errors > floor
    order = np.full(errors.shape, np.nan)
    if len(errors) > 1:
        order[1:] = convergence_order(
            np.asarray(step_sizes), np.where(above, errors, 1.0)
        )
        order[1:][~(above[1:] & above[:-1])] = np.nan
    return order


def envelope(
    times: np.ndarray, values: np.ndarray, bins: int = BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the minimum and maximum of `values` in each of `bins` time intervals.

    It returns the middles of the intervals, the minima and the maxima. Values that are
    not finite are ignored; an interval without finite values gives NaN.
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
    """Draw a curve, or its envelope if the curve has many more points than bins."""
    if len(times) <= 10 * BINS:
        ax.plot(times, values, linewidth=0.8, color=color, label=label)
        return
    middles, low, high = envelope(times, values)
    ax.fill_between(middles, low, high, color=color, alpha=0.25, linewidth=0)
    for edge, name in ((low, None), (high, label)):
        ax.plot(middles, edge, linewidth=0.8, color=color, label=name)


@contextlib.contextmanager
def colour_blind_safe() -> Iterator[None]:
    """Use colours that everyone can distinguish for figures drawn and saved inside."""
    import matplotlib
    from cycler import cycler

    with matplotlib.rc_context({"axes.prop_cycle": cycler(color=COLOURS)}):
        yield
