"""The axes that everything is drawn into."""

import reprlib
from typing import TYPE_CHECKING


if TYPE_CHECKING:
    from matplotlib.axes import Axes


def new_axes(ax: "Axes | None", projection: str | None = None) -> "Axes":
    """Return the axes that a user has given, or those of a new figure."""
    if ax is not None:
        if not hasattr(ax, "plot"):
            raise TypeError(
                "`ax` must be axes of matplotlib, such as those of "
                f"`matplotlib.pyplot.subplots()`, got {reprlib.repr(ax)} of type "
                f"{type(ax).__name__}."
            )
        return ax
    # The import is here alone, because drawing into given axes must not choose a
    # backend of matplotlib.
    from matplotlib import pyplot as plt

    keywords = {} if projection is None else {"projection": projection}
    return plt.figure(layout="constrained").add_subplot(**keywords)
