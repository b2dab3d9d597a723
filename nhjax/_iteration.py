"""The loop that ends at round-off, and the increments that it is fed."""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ._custom_types import BoolScalar, FloatScalar, FloatScalarLike
from ._largest import unit


X = TypeVar("X")
Aux = TypeVar("Aux")


# The units of round-off up to which increments that have ceased to fall are taken for
# noise where an iteration may be slow. Above it they may as well be those of a slow
# iteration that comes near in circles.
NOISE_UNITS = 400
# By how much more noise is believed in where an increment fails to fall, and how far
# increments may grow over all that there is to be found before they diverge.
_IMPATIENCE, _HOPELESS = 30.0, 1e6


class Solved(NamedTuple, Generic[X, Aux]):
    """The outcome of an iteration: `aux` belongs to the last evaluation.

    If it has not converged, it was `exhausted` where it was given up for the number of
    its iterations, and has diverged otherwise.
    """

    x: X
    aux: Aux
    converged: BoolScalar
    exhausted: BoolScalar
    num_iterations: Int[Array, ""]


class _Progress(NamedTuple):
    scale: FloatScalar
    smallest: FloatScalar
    believed: FloatScalar
    iterations: Int[Array, ""]
    done: BoolScalar
    converged: BoolScalar
    exhausted: BoolScalar


def iterate(
    sweep: Callable[[X], tuple[X, FloatScalar, Aux]],
    x: X,
    scale: FloatScalar,
    *,
    max_iterations: int,
    tolerance: FloatScalarLike = 0.0,
    noise_units: float | None = None,
    skip: Bool[Array, ""] | bool = False,
) -> Solved[X, Aux]:
    """Repeat `sweep` until its increments no longer fall.

    `sweep(x)` returns the next iterate, the size of the increment, and whatever was
    evaluated at x. Sizes count relative to `scale`, the size of x, and from the second
    on to that of the first increment, if it is larger: x may start from nothing, where
    the first increment counts as it is.

    An increment below the unit round-off (or `tolerance`) ends the iteration; so do
    small increments that have ceased to fall, since that is round-off speaking. The
    floor of round-off depends on the conditioning of the problem, so that one absolute
    threshold would be either too coarse or never met (Hairer, Lubich, Wanner, GNI,
    section VIII.6): the more often increments fail to fall, the larger a floor is
    believed, up to `noise_units` of round-off. By default that is its square root, for
    iterations that converge so fast that nothing but noise can be in their way.
    Increments that grow far beyond all there is to be found end the iteration too.
    """
    aux_shape = jax.eval_shape(lambda x: sweep(x)[2], x)
    aux = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), aux_shape)
    dtype = jnp.result_type(*[leaf.dtype for leaf in jax.tree.leaves(x)])
    eps = jnp.finfo(dtype).eps
    floor = jnp.maximum(jnp.asarray(eps, dtype), jnp.asarray(tolerance, dtype))
    noisiest = eps**0.5 if noise_units is None else noise_units * eps

    def body(carry):
        x, _, progress = carry
        x_next, increment, aux = sweep(x)
        # No quotients, which would wait for each other: sizes are compared as they are.
        scale = unit(progress.scale)
        stalls = increment >= progress.smallest
        more = jnp.minimum(_IMPATIENCE * progress.believed, noisiest)
        believed = jnp.where(stalls, more, progress.believed)
        stagnant = stalls & (increment <= believed * scale)
        converged = (increment <= floor * scale) | stagnant
        count = progress.iterations + 1
        first = jnp.where(progress.iterations == 0, increment, 0)
        scale = jnp.maximum(progress.scale, first)
        # Not ">", which what is not a number would pass.
        bounded = increment <= _HOPELESS * scale
        exhausted = bounded & ~converged & (count >= max_iterations)
        progress = _Progress(
            scale=scale,
            smallest=jnp.minimum(increment, progress.smallest),
            believed=believed,
            iterations=count,
            done=converged | ~bounded | exhausted,
            converged=converged,
            exhausted=exhausted,
        )
        return x_next, aux, progress

    zero = jnp.zeros((), jnp.int32)
    skip = jnp.asarray(skip)
    scale = jnp.asarray(scale, dtype)
    infinite, least = jnp.asarray(jnp.inf, dtype), jnp.asarray(eps, dtype)
    never = jnp.zeros_like(skip)
    start = _Progress(scale, infinite, least, zero, skip, skip, never)
    x, aux, progress = jax.lax.while_loop(
        lambda carry: ~carry[2].done, body, (x, aux, start)
    )
    return Solved(x, aux, progress.converged, progress.exhausted, progress.iterations)


def dense_increment(
    residual: Callable[[Float[Array, " k"]], tuple[Float[Array, " k"], Aux]],
    x: Float[Array, " k"],
) -> tuple[Float[Array, " k"], Aux]:
    """The Newton increment -J⁻¹ r at x with the exact Jacobian J by autodiff."""
    jacobian, r, aux = jacobian_and_value(residual, x)
    return jnp.linalg.solve(jacobian, -r), aux


def jacobian_and_value(
    residual: Callable[[Float[Array, " k"]], tuple[Float[Array, " k"], Aux]],
    x: Float[Array, " k"],
) -> tuple[Float[Array, "k k"], Float[Array, " k"], Aux]:
    """The exact Jacobian of a residual by autodiff, the residual, and its `aux`."""

    def evaluated_twice_is_once(x):
        r, aux = residual(x)
        return r, (r, aux)

    jacobian, (r, aux) = jax.jacfwd(evaluated_twice_is_once, has_aux=True)(x)
    return jacobian, r, aux
