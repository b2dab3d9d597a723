"""Figures of trajectories and of convergence, and animations, drawn with matplotlib.

Every drawing function draws into the axes `ax` if they are given. Otherwise it creates
a figure in the light style (see `style`). The function returns the axes or the
animation, and never shows or saves them. The first call that needs matplotlib imports
it.
"""

from ._animation import animate as animate
from ._figures import (
    constraint as constraint,
    convergence as convergence,
    energy as energy,
    multiplier as multiplier,
    trajectory as trajectory,
)
from ._style import style as style
