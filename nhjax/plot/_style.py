"""The style of figures, and the creation of axes in this style."""

import contextlib
import functools
import reprlib
from collections.abc import Callable
from typing import Any, ParamSpec, TYPE_CHECKING, TypeVar


if TYPE_CHECKING:
    from matplotlib.axes import Axes


P = ParamSpec("P")
R = TypeVar("R")

# The colours of Okabe and Ito, which colour-blind readers can distinguish.
COLOURS = {
    "blue": "#0072B2",
    "vermilion": "#D55E00",
    "green": "#009E73",
    "purple": "#CC79A7",
    "orange": "#E69F00",
    "sky": "#56B4E9",
    "yellow": "#F0E442",
    "black": "#000000",
}
ON_LIGHT = ("blue", "vermilion", "green", "purple", "orange", "sky", "black")
ON_DARK = ("sky", "orange", "green", "yellow", "purple", "vermilion", "blue")


def style(*, dark: bool = False) -> contextlib.ExitStack:
    """Set matplotlib's settings to the style of the figures of nhjax.

    The style sets the colours of Okabe and Ito, which colour-blind readers can
    distinguish, and the sizes, widths, grid, layout and resolution of figures. A call
    of `style` affects all figures that are created later. In a `with` statement,
    `style` affects the figures in the block, and restores the previous settings at the
    end of the block.

    Without a call of `style`, the functions of `nhjax.plot` use the light style for the
    figures that they create. They keep each setting that differs from matplotlib's
    default, because you have set it, for instance by `style(dark=True)`.

    **Arguments:**

    - `dark`: if True, the background is transparent, and text, axes and lines are
        light, for slides and pages with a dark background.

    **Returns:** a context manager that restores the previous settings when it exits.

    !!! example

        >>> import nhjax
        >>> from matplotlib import pyplot as plt
        >>> with nhjax.plot.style(dark=True):
        ...     figure, ax = plt.subplots()
        ...     lines = ax.plot([0.0, 1.0], [0.0, 1.0])
        >>> lines[0].get_color()
        '#56B4E9'
    """
    return _set(_settings(dark))


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Let a function draw in the light style if it creates the figure itself."""

    @functools.wraps(draw)
    def drawn(*args: P.args, **kwargs: P.kwargs) -> R:
        if kwargs.get("ax") is not None:
            return draw(*args, **kwargs)
        from matplotlib import rcParams, rcParamsDefault

        current: Any = rcParams
        default: Any = rcParamsDefault
        settings = {
            name: value
            for name, value in _settings(dark=False).items()
            if current[name] == default[name]
        }
        with _set(settings):
            return draw(*args, **kwargs)

    return drawn


def grey(level: float) -> str:
    """Return a grey between the colours of text (level 0) and background (level 1)."""
    from matplotlib import colors, rcParams

    light = sum(colors.to_rgb(rcParams["text.color"])) > 1.5
    return str(1 - level if light else level)


def new_axes(ax: "Axes | None", projection: str | None = None) -> "Axes":
    """Return the axes given by the user, or the axes of a new figure."""
    if ax is not None:
        if not hasattr(ax, "plot"):
            raise TypeError(
                "`ax` must be axes of matplotlib, for example from "
                f"`matplotlib.pyplot.subplots()`, got {reprlib.repr(ax)} of type "
                f"{type(ax).__name__}."
            )
        return ax
    # The import is inside the function, because drawing into the user's axes must not
    # choose a backend of matplotlib.
    from matplotlib import pyplot as plt

    keywords = {} if projection is None else {"projection": projection}
    return plt.figure(layout="constrained").add_subplot(**keywords)


def _set(settings: dict[str, Any]) -> contextlib.ExitStack:
    from matplotlib import rcParams

    current: Any = rcParams
    # `rc_context` is not used, because it would restore the settings as soon as it is
    # garbage-collected.
    restoration = contextlib.ExitStack()
    restoration.callback(current.update, {name: current[name] for name in settings})
    current.update(settings)
    return restoration


def _settings(dark: bool) -> dict[str, Any]:
    from cycler import cycler

    names = ON_DARK if dark else ON_LIGHT
    ink, frame, grid = ("0.9", "0.6", "0.3") if dark else ("black", "0.4", "0.9")
    background = "none" if dark else "white"
    return {
        "axes.prop_cycle": cycler(color=[COLOURS[name] for name in names]),
        "lines.linewidth": 1.2,
        "lines.markersize": 4.0,
        "font.size": 10.0,
        "axes.titlesize": 10.0,
        "axes.labelsize": 10.0,
        "xtick.labelsize": 9.0,
        "ytick.labelsize": 9.0,
        "legend.fontsize": 9.0,
        "axes.grid": True,
        "axes.axisbelow": True,
        "grid.color": grid,
        "grid.linewidth": 0.6,
        # With this setting the labels of axes show 0.05 instead of 5 × 10⁻².
        "axes.formatter.min_exponent": 2,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "figure.figsize": (6.4, 4.0),
        "figure.dpi": 100.0,
        "savefig.dpi": 160.0,
        "figure.constrained_layout.use": True,
        "figure.facecolor": background,
        "axes.facecolor": background,
        "text.color": ink,
        "axes.labelcolor": ink,
        "axes.edgecolor": frame,
        "xtick.color": frame,
        "ytick.color": frame,
        "xtick.labelcolor": ink,
        "ytick.labelcolor": ink,
        **{f"axes3d.{axis}axis.panecolor": background for axis in "xyz"},
    }
