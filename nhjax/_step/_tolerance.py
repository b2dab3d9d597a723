"""The `tolerance` of a stage solver, as it is given and as it is used."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._custom_types import FloatScalarLike
from .._errors import is_traced
from .._system import real_scalar


def check_tolerance(tolerance: Any) -> None:
    """Raise for the `tolerance` of a solver that no increment could meet."""
    if is_traced(tolerance):
        return
    if not np.all(np.isfinite(tolerance) & (np.asarray(tolerance) >= 0)):
        raise ValueError(
            f"`tolerance` must be finite and >= 0, got {tolerance}; 0 iterates to "
            "round-off."
        )


def tolerance_array(tolerance: FloatScalarLike) -> FloatScalarLike:
    """The `tolerance` of a solver as an array.

    On the host where that is possible: the default solver is made on import, which must
    not start JAX's backends, nor choose a precision.
    """
    if isinstance(tolerance, int | float) and not isinstance(tolerance, bool):
        return np.asarray(float(tolerance))
    return real_scalar("tolerance", tolerance, jnp.result_type(float))
