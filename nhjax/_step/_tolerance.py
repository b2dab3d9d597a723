"""The check and the conversion of the `tolerance` of a stage solver."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from .._custom_types import FloatScalarLike
from .._errors import is_traced
from .._system import real_scalar


def check_tolerance(tolerance: Any) -> None:
    """Raise a `ValueError` unless the `tolerance` of a solver is finite and >= 0."""
    if is_traced(tolerance):
        return
    if not np.all(np.isfinite(tolerance) & (np.asarray(tolerance) >= 0)):
        raise ValueError(
            f"`tolerance` must be finite and >= 0, got {tolerance}; 0 iterates to "
            "round-off."
        )


def tolerance_array(tolerance: FloatScalarLike) -> FloatScalarLike:
    """Convert the `tolerance` of a solver to an array.

    A number becomes an array of NumPy on the host: the default solver is made when
    nhjax is imported, which must not start JAX's backends, nor choose a precision.
    """
    if isinstance(tolerance, int | float) and not isinstance(tolerance, bool):
        return np.asarray(float(tolerance))
    return real_scalar("tolerance", tolerance, jnp.result_type(float))
