"""Functions that write tables of numbers as text, and that sum up a run."""

from collections.abc import Sequence

import numpy as np

from ..diagnostics import convergence_order


# The symbols of quantities, in tables and in figures.
SYMBOLS = {
    "q": ("q", "$q$"),
    "g": ("g", "$g$"),
    "v": ("v", "$v$"),
    "p": ("p", "$p$"),
    "multiplier": ("λ", r"$\lambda$"),
    "continuous_multiplier": ("λ_c", r"$\lambda_c(q, p)$"),
}


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Write a table as text, with right-aligned columns under a ruled header."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    ruler = ["-" * width for width in widths]
    return "\n".join(
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        for row in (header, ruler, *rows)
    )


def format_slope(x: float) -> str:
    """Write a slope with two decimals, or a dash where there is none."""
    return f"{x:.2f}" if np.isfinite(x) else "-"


def largest_by_fifths(error: np.ndarray) -> list[float]:
    """Compute max |error| over each fifth of a run."""
    return [float(np.max(part)) for part in np.array_split(np.abs(error), 5)]


def slopes(
    step_sizes: Sequence[float] | np.ndarray, errors: np.ndarray, floor: float = 0.0
) -> np.ndarray:
    """Compute observed orders, aligned with `errors`; NaN where there is none.

    The first row has no predecessor, and errors at or below `floor` are round-off.
    """
    above = errors > floor
    order = np.full(errors.shape, np.nan)
    if len(errors) > 1:
        order[1:] = convergence_order(
            np.asarray(step_sizes), np.where(above, errors, 1.0)
        )
        order[1:][~(above[1:] & above[:-1])] = np.nan
    return order


def order_verdict(
    quantities: Sequence[str], orders: np.ndarray, expected: np.ndarray
) -> str:
    """Say in a line whether orders, of shape (stages, quantities), are as expected."""
    off = np.abs(orders - expected)
    if not np.any(np.isfinite(off)):
        return "no order can be seen: it takes two step sizes above round-off"
    worst = np.nanmax(off)
    # The largest steps of many stages are not small enough for a whole digit.
    theirs = "are those of the theory" if worst <= 0.5 else "are not all of the theory"
    names = ", ".join(SYMBOLS[name][0] for name in quantities)
    return f"the orders of {names} {theirs}; they differ by {worst:.2f} at most"
