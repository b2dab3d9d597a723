"""Moves of numbers by about their own size that hardly cancel one another."""

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree


def uneven_perturbations(q: PyTree[Array]) -> PyTree[Array]:
    """Return a perturbation of each number in q, of half its size to its size.

    The moves differ and have both signs, so that they hardly cancel in differences and
    sums of a few numbers. Multiples of the golden ratio, less their whole parts, differ
    from one another as much as they can.
    """
    numbers, unravel = ravel_pytree(q)
    k = np.arange(numbers.size)
    weights = (-1.0) ** k * (1 - 0.5 * (0.618 * k % 1))
    return unravel(jnp.abs(numbers) * jnp.asarray(weights, numbers.dtype))
