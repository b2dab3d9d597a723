"""Figures of trajectories and of convergence, and animations, drawn with matplotlib.

Every drawing function draws into the axes `ax` if they are given, and into the axes of
a new figure otherwise, in the light form of `style`. It returns the axes, or the
animation, and never shows or saves anything. Matplotlib is imported by the first call
that needs it.
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
