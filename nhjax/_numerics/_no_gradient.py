"""Derivatives that are NaN where there are none, unless nobody asks for them."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from .._custom_types import BoolScalar


X = TypeVar("X", bound=PyTree[Array])


def nan_gradient_unless(ok: BoolScalar, tree: X, parameters: PyTree[Any]) -> X:
    """Return the same values, with derivatives that are NaN where `ok` is false.

    This holds for the derivatives with respect to all `parameters`, whether or not the
    values depend on them. A zero cotangent stays zero, so that a loss that leaves out a
    failed lane has a derivative. The rule is written as a linear equation, because JAX
    transposes the rule of forward mode to that of reverse mode, and this rule is not
    linear.
    """
    parameters = eqx.filter(parameters, eqx.is_inexact_array)
    return jax.tree.map(
        lambda x: (
            _identity(x, ok, parameters) if jnp.issubdtype(x.dtype, jnp.inexact) else x
        ),
        tree,
    )


@eqx.filter_custom_jvp
def _identity(x: Array, ok: BoolScalar, parameters: PyTree[Array]) -> Array:
    # From this function JAX decides whether x is batched under `vmap`. The derivative
    # of x is batched wherever `ok` or a parameter is, so that x must seem to depend on
    # them. The function compiles to nothing.
    for leaf in jax.tree.leaves(parameters):
        ok = ok | jnp.any(leaf == 0)
    return jnp.where(ok, x, x)


@_identity.def_jvp
def _identity_jvp(primals, tangents):
    (x, ok, _), (dx, _, rates) = primals, tangents

    change = sum(jnp.sum(rate) for rate in jax.tree.leaves(rates))
    if dx is None and not jax.tree.leaves(rates):
        return _identity(*primals), None
    dx = jnp.zeros_like(x) if dx is None else dx
    dx = dx + jnp.where(ok, 0, change).astype(x.dtype)
    return _identity(*primals), nan_tangent_unless(ok, dx)


def nan_tangent_unless(ok: BoolScalar, dx: Array) -> Array:
    """Return a tangent, or NaN where `ok` is false and it is not zero.

    It is linear for JAX, and its transpose does the same to a cotangent.
    """

    def pass_on(_, b):
        return jnp.where(ok | (b == 0), b, jnp.nan)

    return jax.lax.custom_linear_solve(
        lambda x: x, dx, solve=pass_on, transpose_solve=pass_on
    )
