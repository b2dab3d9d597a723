"""Fixed-point iterations that end at the level of round-off, and Newton increments."""

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import BoolScalar, FloatScalar, FloatScalarLike
from ._floating_point import nonzero_or_one


X = TypeVar("X")
Aux = TypeVar("Aux")


# If an iteration may converge slowly, increments that have stopped falling are treated
# as noise up to this many units of round-off. Larger increments are not treated as
# noise, because they can also come from a slow iteration that spirals towards the
# solution.
NOISE_UNITS = 400
# When an increment fails to fall for the first time, this many units of round-off are
# treated as noise. Each further failure multiplies this level by one of the two factors
# below, and each new smallest increment divides the level by the same factor. The
# factor is smaller for iterations that may be slow, since their increments may rise and
# fall before convergence.
_FIRST_UNITS = 30.0
_GROWTH, _GROWTH_IF_SLOW = 30.0, 2.0
# An iteration counts as divergent if an increment is larger than this factor times the
# sum of the size of x and the first increment.
_HOPELESS = 1e6
# The problem is assumed to magnify round-off by at most this factor.
_LARGEST_NOISE = 1e5
# Convergence counts as slow after more than this many iterations.
_SLOW = 100
# If convergence is slow, the increment of the last allowed iteration is treated as
# noise up to this many times the measured noise. Near positions at which constraints
# become dependent, increments have been seen to vary between 5 and 19 times the noise
# without falling further.
_LAST_UNITS = 32.0


class UpdateNorms(NamedTuple):
    """The sizes of an increment and of the iterate that it leads to, in the same unit.

    `noise` is the change of the iterate per relative change of the data of the problem,
    or None if this is not known. Rounding changes the data by a few units of round-off.
    """

    increment: FloatScalar
    iterate: FloatScalar | float = 0.0
    noise: FloatScalar | None = None


class Solved(NamedTuple, Generic[X, Aux]):
    """The outcome of an iteration: its last iterate, and whether it has converged.

    `aux` holds the auxiliary values of the last iteration. An iteration that has not
    converged is `exhausted` if it reached the maximum number of iterations; otherwise
    it has diverged.
    """

    x: X
    aux: Aux
    converged: BoolScalar
    exhausted: BoolScalar
    num_iterations: Int[Array, ""]


class _Rules(NamedTuple):
    """The constants with which `iterate` decides whether an iteration ends."""

    scale: FloatScalar
    round_off: FloatScalar
    least: FloatScalar
    noise: FloatScalar
    tolerance_or_eps: FloatScalar
    quietest: float
    noisiest: float
    growth: float
    max_iterations: int


class _Progress(NamedTuple):
    """The progress of an iteration so far.

    - `first`, `smallest`: the first and the smallest increment.
    - `believed`: increments up to this size, relative to x, are treated as noise.
    - `iterations`: the number of iterations so far.
    - `done`, `converged`, `exhausted`: whether the iteration has ended, and how.
    """

    first: FloatScalar
    smallest: FloatScalar
    believed: FloatScalar
    iterations: Int[Array, ""]
    done: BoolScalar
    converged: BoolScalar
    exhausted: BoolScalar


def iterate(
    iteration: Callable[[X], tuple[X, UpdateNorms, Aux]],
    x: X,
    scale: FloatScalar,
    *,
    max_iterations: int,
    tolerance: FloatScalarLike = 0.0,
    round_off: FloatScalarLike = 0.0,
    noise: FloatScalarLike = 0.0,
    noise_units: float | None = None,
    skip: Bool[Array, ""] | bool = False,
) -> Solved[X, Aux]:
    """Repeat `iteration` until it has converged, diverged or reached `max_iterations`.

    `iteration(x)` returns the next iterate, the sizes of the increment and of the
    iterate, and auxiliary values at x. Increments are measured relative to the size of
    x: `scale`, or the size of the iterate if that is larger, because x may start from
    zero. If both are zero, increments are measured relative to the first increment.
    `round_off` is the size of data that are larger than x: their round-off adds to the
    round-off of x, so that `scale` plus `round_off` replaces `scale`, except for the
    tolerance. `noise` measures the errors that increments always contain: they are
    about the unit round-off times `noise`. If `skip`, x is returned as converged.

    The iteration ends

    - when an increment is at most `tolerance` times the size of x, or at most the unit
        round-off times the size of x (with `round_off`) or times `noise`;
    - when small increments have stopped falling, because they are then round-off;
    - when an increment is not finite, or far larger than the first increment and the
        iterate;
    - after `max_iterations`. If more than 100 are allowed, the iteration counts as
        converged if its last increment is at most 32 times the measured noise. With
        convergence by a factor ρ per iteration, such an increment leaves an error of at
        most 32 noise / (1 - ρ), and the noise of all iterations causes an error of
        noise / (1 - ρ) anyway.

    The size of round-off depends on the conditioning of the problem, so that a fixed
    threshold would be either too coarse or never met (Hairer, Lubich, Wanner, GNI,
    section VIII.6). Each time that an increment fails to fall, the level of increments
    that are treated as noise is raised, up to `noise_units` of round-off. Each new
    smallest increment lowers this level again. The default of the highest level is the
    square root of the unit round-off. This default suits iterations that converge so
    fast that only noise can slow them down. After more than 100 iterations all levels
    fall in inverse proportion to the number of iterations, because the error of a slow
    iteration is much larger than its increment.
    """
    # `jit` makes JAX trace the iteration only once, for both the shapes and the loop.
    # Tracing the iteration is most of the work of tracing a step.
    iteration = jax.jit(iteration, inline=True)
    aux_shape = jax.eval_shape(iteration, x)[2]
    aux = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), aux_shape)
    dtype = jnp.result_type(*[leaf.dtype for leaf in jax.tree.leaves(x)])
    eps = float(jnp.finfo(dtype).eps)
    scale, round_off = jnp.asarray(scale, dtype), jnp.asarray(round_off, dtype)
    noise, tolerance = jnp.asarray(noise, dtype), jnp.asarray(tolerance, dtype)
    growth = _GROWTH if noise_units is None else _GROWTH_IF_SLOW
    rules = _Rules(
        scale=scale,
        round_off=round_off,
        least=jnp.maximum(
            eps * jnp.maximum(scale + round_off, noise), tolerance * scale
        ),
        noise=eps * noise,
        tolerance_or_eps=jnp.maximum(tolerance, eps),
        quietest=_FIRST_UNITS / growth * eps,
        noisiest=eps**0.5 if noise_units is None else noise_units * eps,
        growth=growth,
        max_iterations=max_iterations,
    )

    def body(carry):
        x, _, progress = carry
        x_next, sizes, aux = iteration(x)
        return x_next, aux, _progress(rules, progress, sizes)

    zero = jnp.zeros((), jnp.int32)
    skip = jnp.asarray(skip)
    one, infinite, least = (jnp.asarray(x, dtype) for x in (1, jnp.inf, rules.quietest))
    never = jnp.zeros_like(skip)
    start = _Progress(one, infinite, least, zero, skip, skip, never)
    x, aux, progress = jax.lax.while_loop(
        lambda carry: ~carry[2].done, body, (x, aux, start)
    )
    return Solved(x, aux, progress.converged, progress.exhausted, progress.iterations)


def _progress(rules: _Rules, before: _Progress, sizes: UpdateNorms) -> _Progress:
    """Update the progress of an iteration by an increment; decide whether it ends."""
    increment = sizes.increment
    first = jnp.where(before.iterations == 0, increment, before.first)
    # The norms are compared without divisions, whose latencies would add up.
    found = jnp.maximum(rules.scale + rules.round_off, sizes.iterate)
    has_size = found > 0
    measure = jnp.where(has_size, found, before.first)
    magnified = measure
    if sizes.noise is not None:
        noise = jnp.minimum(sizes.noise, _LARGEST_NOISE * measure)
        magnified = jnp.maximum(measure, noise)
    count = before.iterations + 1
    left = increment
    if rules.max_iterations > _SLOW:
        # An iteration that reaches round-off after n iterations contracts by about
        # eps^(1/n). The error that it leaves is larger than an increment, by a factor
        # that grows with n. `left` estimates this error.
        left = increment * jnp.maximum(1, count.astype(increment.dtype) / _SLOW)
    # Only increments that can be noise raise the level `believed`. Larger increments
    # also rise and fall if an iteration spirals towards the solution.
    may_be_noise = left <= rules.noisiest * magnified
    stalls = may_be_noise & (increment >= before.smallest)
    more = jnp.minimum(rules.growth * before.believed, rules.noisiest)
    less = jnp.maximum(before.believed / rules.growth, rules.quietest)
    believed = jnp.where(stalls, more, before.believed)
    believed = jnp.where(increment < before.smallest, less, believed)
    stagnant = stalls & (left <= believed * magnified)
    # A tolerance is relative to x itself, without `round_off` and `noise`.
    least = jnp.maximum(rules.least, rules.tolerance_or_eps * sizes.iterate)
    least = jnp.where(has_size, least, rules.tolerance_or_eps * before.first)
    small = increment <= least
    converged = small | stagnant
    is_last = count >= rules.max_iterations
    if rules.max_iterations > _SLOW:
        # If the noise is nearly as large as x, an increment below the noise does not
        # show convergence. Therefore the noise is bounded here.
        eps = float(jnp.finfo(increment.dtype).eps)
        limit = _LAST_UNITS * jnp.minimum(rules.noise, _LARGEST_NOISE * eps * measure)
        converged = converged | (is_last & (increment <= limit))
    # If the increment is not finite, this comparison is False.
    bounded = increment < _HOPELESS * (measure + first)
    exhausted = bounded & ~converged & is_last
    return _Progress(
        first=nonzero_or_one(first),
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
    solve: Callable[[Array, Array], Array] = jnp.linalg.solve,
) -> tuple[Float[Array, " k"], Aux]:
    """Compute the Newton increment -J⁻¹ r at x, with J by autodiff, and `aux`."""
    jacobian, r, aux = jacobian_and_value(residual, x)
    return solve(jacobian, -r), aux


def jacobian_and_value(
    residual: Callable[[Float[Array, " k"]], tuple[Float[Array, " m"], Aux]],
    x: Float[Array, " k"],
) -> tuple[Float[Array, "m k"], Float[Array, " m"], Aux]:
    """Compute a residual, its `aux`, and its exact Jacobian by autodiff."""

    def evaluated_twice_is_once(x):
        r, aux = residual(x)
        return r, (r, aux)

    jacobian, (r, aux) = jax.jacfwd(evaluated_twice_is_once, has_aux=True)(x)
    return jacobian, r, aux
