"""The loop that ends at round-off, and the increments that it is fed."""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import BoolScalar, FloatScalar, FloatScalarLike
from ._max_norm import unit


X = TypeVar("X")
Aux = TypeVar("Aux")


# The units of round-off up to which increments that have ceased to fall are taken for
# noise where an iteration may be slow. Above it they may as well be those of a slow
# iteration that comes near in circles.
NOISE_UNITS = 400
# With the first increment that fails to fall so many units of round-off are believed to
# be noise, and with each further one so many times more: where an iteration may be
# slow, increments that rise and fall need not have come to an end.
_FIRST_UNITS = 30.0
_GROWTH, _GROWTH_IF_SLOW = 30.0, 2.0
# An increment that is larger by this than x and the first increment is of an iteration
# that diverges.
_HOPELESS = 1e6
# No more magnification of round-off than this is believed in.
_LARGEST_NOISE = 1e5


class Sizes(NamedTuple):
    """The sizes of an increment and of the iterate that it leads to, in one unit.

    `noise` is how much the iterate would change if what is given were changed by its
    own size, where that is known: round-off does so in units of round-off.
    """

    increment: FloatScalar
    iterate: FloatScalar | float = 0.0
    noise: FloatScalar | None = None


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


class _Rules(NamedTuple):
    """By what increments are judged: see `iterate`."""

    scale: FloatScalar
    floor: FloatScalar
    noisiest: float
    growth: float
    max_iterations: int


class _Progress(NamedTuple):
    """What is known of an iteration on its way."""

    first: FloatScalar
    smallest: FloatScalar
    believed: FloatScalar
    iterations: Int[Array, ""]
    done: BoolScalar
    converged: BoolScalar
    exhausted: BoolScalar


def iterate(
    sweep: Callable[[X], tuple[X, Sizes, Aux]],
    x: X,
    scale: FloatScalar,
    *,
    max_iterations: int,
    tolerance: FloatScalarLike = 0.0,
    noise_units: float | None = None,
    skip: Bool[Array, ""] | bool = False,
) -> Solved[X, Aux]:
    """Repeat `sweep` until its increments no longer fall.

    `sweep(x)` returns the next iterate, the sizes of the increment and of the iterate,
    and whatever was evaluated at x. Increments count relative to `scale`, what x is
    rounded by, or to the size of the iterate, if it is larger: x may start from
    nothing. Where neither is known to be more than nothing they count relative to the
    first, which counts as it is.

    An increment below the unit round-off (or `tolerance`) ends the iteration; so do
    small increments that have ceased to fall, since that is round-off speaking. The
    floor of round-off depends on the conditioning of the problem, so that one absolute
    threshold would be either too coarse or never met (Hairer, Lubich, Wanner, GNI,
    section VIII.6): the more often increments fail to fall, the larger a floor is
    believed, up to `noise_units` of round-off. By default that is its square root, for
    iterations that converge so fast that nothing but noise can be in their way.
    An increment that is not finite, or far larger than the first and the iterate, ends
    the iteration too.
    """
    aux_shape = jax.eval_shape(lambda x: sweep(x)[2], x)
    aux = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), aux_shape)
    dtype = jnp.result_type(*[leaf.dtype for leaf in jax.tree.leaves(x)])
    eps = float(jnp.finfo(dtype).eps)
    rules = _Rules(
        scale=jnp.asarray(scale, dtype),
        floor=jnp.maximum(jnp.asarray(eps, dtype), jnp.asarray(tolerance, dtype)),
        noisiest=eps**0.5 if noise_units is None else noise_units * eps,
        growth=_GROWTH if noise_units is None else _GROWTH_IF_SLOW,
        max_iterations=max_iterations,
    )

    def body(carry):
        x, _, progress = carry
        x_next, sizes, aux = sweep(x)
        return x_next, aux, _progress(rules, progress, sizes)

    zero = jnp.zeros((), jnp.int32)
    skip = jnp.asarray(skip)
    least = _FIRST_UNITS / rules.growth * eps
    one, infinite, least = (jnp.asarray(x, dtype) for x in (1, jnp.inf, least))
    never = jnp.zeros_like(skip)
    start = _Progress(one, infinite, least, zero, skip, skip, never)
    x, aux, progress = jax.lax.while_loop(
        lambda carry: ~carry[2].done, body, (x, aux, start)
    )
    return Solved(x, aux, progress.converged, progress.exhausted, progress.iterations)


def _progress(rules: _Rules, before: _Progress, sizes: Sizes) -> _Progress:
    """Whether an iteration has come to an end with an increment, and how."""
    increment = sizes.increment
    first = jnp.where(before.iterations == 0, increment, before.first)
    size = jnp.maximum(rules.scale, sizes.iterate)
    # No quotients, which would wait for each other: sizes are compared as they are.
    measure = jnp.where(size > 0, size, before.first)
    stalls = increment >= before.smallest
    more = jnp.minimum(rules.growth * before.believed, rules.noisiest)
    believed = jnp.where(stalls, more, before.believed)
    magnified = measure
    if sizes.noise is not None:
        noise = jnp.minimum(sizes.noise, _LARGEST_NOISE * measure)
        magnified = jnp.maximum(measure, noise)
    stagnant = stalls & (increment <= believed * magnified)
    converged = (increment <= rules.floor * measure) | stagnant
    count = before.iterations + 1
    # False for what is not finite.
    bounded = increment < _HOPELESS * (measure + first)
    exhausted = bounded & ~converged & (count >= rules.max_iterations)
    return _Progress(
        first=unit(first),
        smallest=jnp.minimum(increment, before.smallest),
        believed=believed,
        iterations=count,
        done=converged | ~bounded | exhausted,
        converged=converged,
        exhausted=exhausted,
    )


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
