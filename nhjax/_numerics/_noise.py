"""The round-off of a function near a point, measured by differences of high order."""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree


# A value is not told from round-off up to so many standard deviations of its noise.
NOISE_DEVIATIONS = 100

# The points of one difference lie on a ray that starts at the point of interest.
_NUM_POINTS = 6
# Distances of neighbouring points, as powers of the unit round-off, smallest first.
_DISTANCES = 0.85, 0.68, 0.5
# Two rays for each distance, since one difference may be small by chance.
_NUM_RAYS = 2
# A function counts as smooth if its fifth difference is less than this part of the
# fourth.
_SMOOTH = 1 / 30


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

    Points that are very close may not differ at all beside a constant inside the
    function, and those farther away may differ by more than round-off. Of three
    distances (5e-14, 2e-11 and 1e-8 in double precision) the largest result is
    returned, up to the first at which the differences fall with their order as those of
    a smooth function do. The points lie on rays from the point of interest, so that a
    kink or a jump at this point, as that of friction at rest, is not taken for
    round-off.

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
    # One row for each point of a ray: its distance, and its weights in a fourth and a
    # fifth difference.
    numbers = np.arange(1.0, _NUM_POINTS + 1)
    columns = numbers, np.append(_weights(4), 0.0), _weights(5)
    points = jnp.asarray(np.stack(columns, axis=1), dtype)
    rays = jnp.asarray(rays.reshape(-1, size), dtype)
    lengths = [math.prod(x.shape) for x in jax.tree.leaves(like)]

    # A loop of `while` contains the function once; a short `scan` may be unrolled.
    def on_ray(_, ray):
        def add(carry):
            k, total = carry
            found = function(points[k, 0] * ray)
            values = jnp.concatenate([x.reshape(-1) for x in jax.tree.leaves(found)])
            return k + 1, total + points[k, 1:, None] * values[None]

        start = jnp.zeros((), jnp.int32), jnp.zeros((2, sum(lengths)), dtype)
        return None, jax.lax.while_loop(lambda x: x[0] < _NUM_POINTS, add, start)[1]

    differences = jnp.abs(jax.lax.scan(on_ray, None, rays)[1])
    differences = jnp.where(jnp.isfinite(differences), differences, 0)
    largest = jnp.max(differences.reshape(*shape[:2], 2, -1), axis=1)
    fourth, fifth = largest[:, 0], largest[:, 1]
    noise, smooth = fifth[0], fifth[0] < _SMOOTH * fourth[0]
    for k in range(1, len(_DISTANCES)):
        smooth = smooth | (fifth[k] < _SMOOTH * fourth[k])
        noise = jnp.where(smooth, noise, jnp.maximum(noise, fifth[k]))
    parts = jnp.split(noise, np.cumsum(lengths)[:-1])
    leaves, structure = jax.tree.flatten(like)
    shaped = [x.reshape(y.shape) for x, y in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(structure, shaped)


def _weights(order: int) -> np.ndarray:
    """Return the weights of a difference, under which noise keeps its deviation."""
    weights = np.array([(-1.0) ** k * math.comb(order, k) for k in range(order + 1)])
    return weights / np.linalg.norm(weights)
