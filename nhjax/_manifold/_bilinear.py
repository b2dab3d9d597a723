"""Bilinear maps of constant coefficients, of which the formulas of rotations are made.

Most of the coefficients are zeros. To multiply with them costs less than to cut vectors
into parts and to join these: a part that is cut out is padded where it is
differentiated, and loops over joined parts branch. On SO(3) a step takes three quarters
of the time, its gradient two thirds, and the compiler's time falls as much (measured).
A number that is not finite spreads to all of the product.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics import small_einsum


def bilinear(
    tensor: np.ndarray, a: Float[Array, " n"], b: Float[Array, " k"]
) -> Float[Array, " m"]:
    """Σ T_ijk a_j b_k."""
    return small_einsum("ik,k->i", matrix_of(tensor, a), b)


def matrix_of(tensor: np.ndarray, a: Float[Array, " n"]) -> Float[Array, "m k"]:
    """Σ T_ijk a_j, the matrix of b -> Σ T_ijk a_j b_k."""
    return small_einsum("ijk,j->ik", jnp.asarray(tensor, a.dtype), a)
