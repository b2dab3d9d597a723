"""Jacobians of functions of few variables, as diagonals where their programs allow."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._contraction import Matrix
from ._sparsity import dependence


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
    return full_jacobian(function, u)


def full_jacobian(
    function: Callable[[Array], PyTree[Array]], u: Float[Array, " n"]
) -> PyTree[Array]:
    """Compute the derivatives of all results of a function by u, on their last axis."""

    def push(du):
        return jax.jvp(function, (u,), (du,))[1]

    return jax.vmap(push, out_axes=-1)(_unit_vectors(u))


def _unit_vectors(u: Float[Array, " n"]) -> Float[Array, "n n"]:
    # Of zeros that pad an array the compiler of lanes knows that they stay zero in any
    # product; of those of a unit matrix it does not, since the other factor might be
    # infinite.
    n, one, zero = u.shape[0], jnp.ones((1,), u.dtype), jnp.zeros((), u.dtype)
    rows = [jax.lax.pad(one, zero, [(k, n - 1 - k, 0)]) for k in range(n)]
    return jnp.stack(rows)
