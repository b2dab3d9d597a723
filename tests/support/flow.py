"""Ordinary differential equations, solved by SciPy as exactly as it can."""

import numpy as np
from scipy.integrate import solve_ivp


def flow(velocity_field, y0, times, start=None):
    """The solution of ẏ = f(t, y) at `times`; y0 holds at `start` or at the first."""
    solution = solve_ivp(
        velocity_field,
        (times[0] if start is None else start, times[-1]),
        np.asarray(y0, float),
        method="DOP853",
        t_eval=times,
        rtol=3e-14,
        atol=1e-14,
    )
    assert solution.success
    return solution.y.T
