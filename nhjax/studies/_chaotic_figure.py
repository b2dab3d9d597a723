"""The figure of the chaotic study."""

from typing import TYPE_CHECKING

import numpy as np


if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The powers of h that the paper's figure divides μ by.
PAPER_POWERS = {2: 4, 3: 10}

Curve = tuple[int, float, np.ndarray, np.ndarray, np.ndarray]


def chaotic_figure(curves: list[Curve], title: str) -> "Figure":
    """Draw μ against time, a column for each s: ours above, the paper's below.

    `curves` holds (s, h, times, μ, standard error of μ), the latter for bands.
    """
    from matplotlib.figure import Figure

    stages = list(dict.fromkeys(s for s, *_ in curves))
    figure = Figure(figsize=(1 + 4 * len(stages), 7), layout="constrained")
    axes = figure.subplots(2, len(stages), sharex=True, squeeze=False)
    for (ours, paper), s in zip(axes.T, stages, strict=True):
        chosen = [curve for curve in curves if curve[0] == s]
        _panel(ours, chosen, 4 * (s - 1))
        ours.set_title(f"s = {s}")
        if s in PAPER_POWERS:
            _panel(paper, chosen, PAPER_POWERS[s])
        else:
            paper.set_axis_off()
            paper.text(
                0.5, 0.5, "not in the paper", ha="center", transform=paper.transAxes
            )
    axes[0, 0].legend(loc="lower right")
    figure.suptitle(
        f"Mean squared energy error of the chaotic ensemble, {title}\n"
        "above: over $h^{4(s-1)}$, the measured power; below: over the power of the "
        "paper's figure"
    )
    return figure


def _panel(ax: "Axes", curves: list[Curve], power: int) -> None:
    # The first steps come from zero: they would squeeze the rest.
    levels = []
    for i, (_, h, times, mu, error) in enumerate(curves):
        scaled, spread = mu / h**power, _smoothed(error) / h**power
        levels += [np.min(scaled[len(scaled) // 10 :]), np.max(scaled[1:])]
        ax.plot(times, scaled, linewidth=0.4, alpha=0.35, color=f"C{i}")
        mean = _smoothed(scaled)
        ax.plot(times, mean, color=f"C{i}", linewidth=1.5, label=f"$h$ = {h:g}")
        # Errors of one time and the next are not independent: they do not average out.
        ax.fill_between(
            times, mean - spread, mean + spread, color=f"C{i}", alpha=0.2, linewidth=0
        )
    ax.set_yscale("log")
    ax.set_ylim(min(levels) / 1.5, max(levels) * 1.5)
    ax.set_xlabel("time $t$")
    ax.set_ylabel(f"$\\mu(E, k) / h^{{{power}}}$")
    ax.tick_params(labelbottom=True)


def _smoothed(x: np.ndarray) -> np.ndarray:
    """Compute running means over a fortieth of the run."""
    width = max(1, len(x) // 40)
    kernel = np.ones(width)
    return np.convolve(x, kernel, "same") / np.convolve(np.ones(len(x)), kernel, "same")
