"""The arithmetic that coefficients are computed in, and the rounding to float64."""

from typing import Any, TypeAlias

import mpmath
import numpy as np


# The library's own context: a user's `mpmath.mp.dps` neither changes nor is changed.
# 60 digits leave 20 for the 1e-40 to which the order conditions are checked.
CONTEXT = mpmath.MPContext()
CONTEXT.dps = 60

# Each context makes classes of its own for numbers and matrices; no type names them.
Number: TypeAlias = Any
Matrix: TypeAlias = Any


def to_float64(x: Matrix | list[Number]) -> np.ndarray:
    """Round mp numbers to the nearest float64, once, into a read-only array.

    **Arguments:**

    - `x`: an mp matrix, or a list of mp numbers.

    **Returns:**

    A float64 array of shape `(rows, cols)`, or `(len(x),)` for a list.
    """
    rows = x if isinstance(x, list) else x.tolist()
    array = np.array(
        [[float(e) for e in r] if isinstance(r, list) else float(r) for r in rows],
        dtype=np.float64,
    )
    array.setflags(write=False)
    return array
