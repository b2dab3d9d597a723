"""The round-off of a function near a point, measured by differences of high order."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree


# The points of one difference lie on a ray that starts at the point of interest.
_NUM_POINTS = 6
# Two distances of neighbouring points, as powers of the unit round-off.
_DISTANCES = 0.7, 0.85
# Two rays for each distance, since one difference may be small by chance.
_NUM_RAYS = 2


def measured_noise(
    function: Callable[[Float[Array, " k"]], PyTree[Array]],
    size: int,
    like: PyTree[Array | jax.ShapeDtypeStruct],
) -> PyTree[Array]:
    """Estimate the round-off of a function, for each number that it returns.

    Values at points that are close to each other differ by a smooth change and by
    round-off. A difference of fifth order removes the smooth change, so that round-off
    is left (Moré and Wild, Estimating computational noise, SIAM J. Sci. Comput. 33,
    2011). Such a measurement includes constants inside the function, cancellation, the
    rounding of arguments and its magnification by steep functions.

    Round-off does not depend on the distance of the points, and a smooth change does:
    the smaller of the results for two distances, 1e-11 and 5e-14 in double precision,
    is returned. The points lie on rays from the point of interest, so that a kink or a
    jump at this point, as that of friction at rest, is not taken for round-off.

    **Arguments:**

    - `function`: a function of a displacement from the point of interest, of shape
        (k,), in units of positions and velocities.
    - `size`: the number k.
    - `like`: arrays of the shapes and the type of what the function returns, or
        `jax.ShapeDtypeStruct`s.

    **Returns:** estimates of the standard deviation of round-off, as a tree of the same
    structure as the function returns. Numbers that are not finite count as zero.
    """
    dtype = jax.tree.leaves(like)[0].dtype
    eps = float(jnp.finfo(dtype).eps)
    rng = np.random.default_rng(0)
    shape = len(_DISTANCES), _NUM_RAYS, size
    rays = rng.uniform(0.5, 1.5, shape) * rng.choice([-1.0, 1.0], shape)
    rays *= np.reshape([eps**power for power in _DISTANCES], (-1, 1, 1))
    order = _NUM_POINTS - 1
    weights = np.array([(-1.0) ** k * math.comb(order, k) for k in range(order + 1)])
    weights /= np.linalg.norm(weights)
    # One row for each point: its distance along its ray, its weight, and for each ray
    # whether it is that one.
    columns = np.arange(1.0, _NUM_POINTS + 1), weights
    points = np.tile(np.stack(columns, axis=1), (shape[0] * shape[1], 1))
    is_on = np.repeat(np.eye(shape[0] * shape[1]), _NUM_POINTS, axis=0)
    rows = jnp.asarray(np.concatenate([points, is_on], axis=1), dtype)
    rays = jnp.asarray(rays.reshape(-1, size), dtype)
    # The function is traced once, in the loop, which takes longer than all of the rest.
    lengths = [math.prod(x.shape) for x in jax.tree.leaves(like)]

    def add(total, row):
        step, weight, on = row[0], row[1], row[2:]
        found = function(step * jnp.sum(on[:, None] * rays, axis=0))
        values = jnp.concatenate([x.reshape(-1) for x in jax.tree.leaves(found)])
        # Values that are not finite must not reach other rays.
        change = jnp.where(on[:, None] > 0, weight * values, 0)
        return total + change, None

    # A loop, so that the program contains the function once.
    total = jnp.zeros((rays.shape[0], sum(lengths)), dtype)
    total = jnp.abs(jax.lax.scan(add, total, rows)[0])
    total = jnp.where(jnp.isfinite(total), total, 0)
    total = total.reshape(*shape[:2], -1)
    noise = jnp.min(jnp.max(total, axis=1), axis=0)
    parts = jnp.split(noise, np.cumsum(lengths)[:-1])
    leaves, structure = jax.tree.flatten(like)
    shaped = [x.reshape(y.shape) for x, y in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(structure, shaped)
