"""Jacobians, which are computed as diagonals where the function's program allows it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._contraction import Matrix
from ._index_sets import dependence


def jacobian(function: Callable[[Array], Array], u: Float[Array, " n"]) -> Matrix:
    """Compute ∂f_i/∂u_j, or its diagonal alone if each f_i depends on u_i alone.

    The mass matrices of most Lagrangians that one writes down are diagonal; their
    products with vectors then cost n instead of n² operations. Whether the Jacobian is
    diagonal is decided when the function is traced, from its operations and not from
    values. A function whose operations are not understood counts as dense.
    """

    def push(du):
        return jax.jvp(function, (u,), (du,))[1]

    found = dependence(function, u)
    if found.shape == (u.shape[0],) * 2 and not np.any(
        found & ~np.eye(len(u), dtype=bool)
    ):
        return push(jnp.ones_like(u))
    return jax.vmap(push, out_axes=1)(jnp.eye(u.shape[0], dtype=u.dtype))
