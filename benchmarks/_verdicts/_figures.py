"""The figures of the page of experiments, in colours that all tell apart."""

from typing import Any, TYPE_CHECKING

import numpy as np

from nhjax.studies import envelope


if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Okabe and Ito.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
BLUE, VERMILION, PURPLE = "#0072B2", "#D55E00", "#CC79A7"
COLOURS = {
    "propagated": BLUE,
    "symmetric": ORANGE,
    "consistent": PURPLE,
    "DLA": BLACK,
    "SPARK": GREEN,
    "RK4": VERMILION,
}


def _band(ax: Any, times: np.ndarray, values: np.ndarray, color: str, label: str):
    middles, low, high = envelope(times, values, 80)
    ax.fill_between(middles, low, high, color=color, alpha=0.25, linewidth=0)
    for edge, name in ((low, None), (high, label)):
        ax.plot(middles, edge, color=color, linewidth=1.0, label=name)


def transmission_figure(
    ours: dict[str, Any], others: dict[str, np.ndarray], *high: Any
) -> "Figure":
    """Draw the energy of the CVT by several methods, as envelopes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.6), layout="constrained")
    axes = figure.subplots(1, 3)
    for i, (ax, regime) in enumerate(zip(axes, ours, strict=False)):
        run = ours[regime]
        times = run.times[1:]
        for name, color in (("RK4", "RK4"), ("SPARK 2", "SPARK"), ("DLA", "DLA")):
            _band(ax, times, others[name][i], COLOURS[color], name)
        _band(
            ax,
            times,
            run.deviations()[1:, 0],
            COLOURS["propagated"],
            "Lobatto-2, paper",
        )
        ax.set_title(f"s = 2, {regime} energy")
        ax.set_ylabel("$E - E_0$")
    axes[1].legend(fontsize="small")
    for run, closure in zip(high, ("propagated", "symmetric"), strict=True):
        _band(
            axes[2], run.times, run.deviations()[:, 0], COLOURS[closure],
            f"{closure} closure",
        )  # fmt: skip
    axes[2].set_title("s = 3, high energy")
    axes[2].legend(fontsize="small")
    for ax in axes:
        ax.set_xlabel("time $t$")
    return figure


def chaotic_figure(curves: dict[int, dict[str, Any]], h: float) -> "Figure":
    """Draw μ(E) against time, a panel for each number of stages.

    `curves` holds (times, μ, standard error) by name, in intervals of time.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.8), layout="constrained")
    axes = figure.subplots(1, len(curves), squeeze=False)[0]
    for ax, (stages, members) in zip(axes, curves.items(), strict=True):
        for name, (times, mu, error) in members.items():
            ax.errorbar(
                times, mu, error, color=COLOURS[name.split()[0]], label=name,
                marker="o", markersize=3, linewidth=1.2, capsize=2,
            )  # fmt: skip
        ax.set_xscale("log")
        ax.set_yscale("log")
        ax.set_title(f"s = {stages}, h = {h:g}")
        ax.set_xlabel("time $t$")
        ax.legend(fontsize="small")
    axes[0].set_ylabel(r"$\mu(E)$")
    return figure
