"""Newton's method for equations that leave unknowns free or depend on each other."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._numerics import (
    ClosureConverted,
    frozen,
    iterate,
    jacobian_and_value,
    max_norm,
    Sizes,
    Solved,
    unit,
)


def nearest_root(
    residual: Callable[[Array], Array],
    free: Float[Array, " k"],
    start: Float[Array, " k"],
    groups: Sequence[int],
    max_iterations: int,
) -> tuple[Float[Array, " k"], Array, Solved[Array, Any]]:
    """Find a root by Newton's method from zero, with the smallest increments.

    There may be fewer equations than unknowns, and equations may depend on each other
    at the root.

    **Arguments:**

    - `residual`: the function that is to vanish.
    - `free`: one for each component that may be changed, and zero for the others.
    - `start`: the numbers to which the unknowns are increments.
    - `groups`: how many unknowns of each kind there are, one kind after the other.
        Those of one kind are rounded by the size of the largest of them.
    - `max_iterations`: the largest number of iterations.

    **Returns:** the root, the residual there, and how the method ended.
    """
    residual = ClosureConverted(residual, start)
    # Derivatives come from the two steps after the iteration. Without this they would
    # also be traced through its loop, which jax 0.10.1 cannot do twice.
    fixed_residual, start = frozen((residual, start))

    def sweep(x):
        slopes, value, _ = jacobian_and_value(lambda x: (fixed_residual(x), None), x)
        # Where the equations are dependent, the pseudo-inverse leaves them out.
        inverse = free[:, None] * jnp.linalg.pinv(slopes * free[None, :])
        increment = inverse @ value
        return x - increment, Sizes(max_norm(increment)), (inverse, slopes)

    solved = iterate(
        sweep,
        jnp.zeros_like(free),
        unit(max_norm(start)),
        max_iterations=max_iterations,
    )
    x, (inverse, slopes) = frozen((solved.x, solved.aux))

    # With the slopes frozen, each step more makes one more order of derivatives right.
    def refined(x, _):
        left = residual(x)
        return x - inverse @ left, left

    x, left = jax.lax.scan(refined, x, length=2)
    # An increment also vanishes where the unknowns that may change have no influence:
    # the residual is checked too. It is compared with the sum of the derivatives, each
    # times the size of its unknown; an unknown without influence has size zero.
    sizes = jnp.where(
        jnp.any(slopes != 0, axis=0), jnp.abs(start) + jnp.abs(frozen(x)), 0
    )
    eps = float(jnp.finfo(x.dtype).eps)
    # Unknowns of one kind share the largest of their sizes. Where all are zero, as at
    # rest or at the origin, a small part of a unit stands for them.
    ends = np.cumsum(groups)
    kinds = jnp.split(sizes, ends[:-1])
    sizes = jnp.concatenate(
        [
            jnp.full_like(kind, jnp.maximum(jnp.max(kind, initial=0), eps**0.5))
            for kind in kinds
        ]
    )
    is_root = jnp.all(jnp.abs(left[0]) <= eps**0.5 * (jnp.abs(slopes) @ sizes))
    return x, left[0], solved._replace(converged=solved.converged & is_root)
