"""Derivatives by the implicit function theorem, also where they are not defined."""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._compile import cse_dce
from .._custom_types import BoolScalar, FloatScalar
from ._contraction import with_small_products
from ._iteration import dense_increment, iterate, Sizes, Solved
from ._max_norm import max_norm, unit


# Terms of the Neumann series below this many units of round-off are left out.
_UNITS_LEFT = 256
# If the terms of the series stop falling above this many units of round-off, it does
# not converge: the derivative is NaN then, rather than a wrong number.
_NOISIEST = 1e4

T = TypeVar("T")
X = TypeVar("X", bound=PyTree[Array])


def solve_contraction(
    contraction: Callable[[X], X],
    b: X,
    units: list[FloatScalar],
    *,
    max_iterations: int,
) -> X:
    """Solve x = G x + b for a linear G that contracts; x is NaN if it does not.

    Both x and the solution of the transposed equation are sums of the Neumann series,
    taken until its terms are below 256 units of round-off. The terms that are left out
    sum up to ρ / (1 - ρ) times that bound where G contracts by ρ. If x -> G x + b is a
    linearised simplified Newton iteration, the sum is iterative refinement with the
    factors of that iteration, and takes about as many evaluations as the nonlinear
    iteration did. Derivatives of every order follow from the equation, not from the
    iterations.

    Terms are judged by their largest number, in the `units` of the leaves of x. The
    unknowns of the transposed equation have the inverse units, so that products of the
    two have none.
    """
    given, treedef = jax.tree.flatten(b)

    def full(leaves):
        rest = iter(leaves)
        return treedef.unflatten(
            [next(rest) if x.size else jnp.zeros(x.shape, x.dtype) for x in given]
        )

    def operator(x):
        return _minus(x, _not_empty(contraction(full(x))))

    def refine(weights, matvec, b):

        def size(x):
            pairs = zip(weights, x, strict=True)
            return max_norm(*(weight * leaf for weight, leaf in pairs))

        def sweep(x):
            increment = _minus(b, matvec(x))
            x = [x + dx for x, dx in zip(x, increment, strict=True)]
            return x, Sizes(size(increment), size(x)), None

        scale = size(b)
        tolerance = _UNITS_LEFT * float(jnp.finfo(scale.dtype).eps)
        solved = iterate(
            sweep,
            b,
            scale,
            max_iterations=max_iterations,
            tolerance=tolerance,
            noise_units=_NOISIEST,
        )
        return nan_unless(solved.converged, solved.x)

    pairs = zip(given, units, strict=True)
    scales = [unit(jax.lax.stop_gradient(one)) for x, one in pairs if x.size]
    x = jax.lax.custom_linear_solve(
        operator,
        _mixed(_not_empty(b)),
        solve=partial(refine, [1 / one for one in scales]),
        transpose_solve=partial(refine, scales),
    )
    return full(_mixed(x))


def _not_empty(tree: PyTree[Array]) -> list[Array]:
    """List the leaves of a tree that have elements."""
    return [leaf for leaf in jax.tree.leaves(tree) if leaf.size]


def _minus(xs: list[Array], ys: list[Array]) -> list[Array]:
    return [x - y for x, y in zip(xs, ys, strict=True)]


def _mixed(xs: list[Array]) -> list[Array]:
    """Return the same arrays, each of which depends on all of them.

    So either all of them are constant for differentiation or none is: a linear equation
    of which some parts are constant could not be transposed.
    """
    nothing = 0 * sum(x.reshape(-1)[0] for x in xs)
    return [x + nothing for x in xs]


def root(
    residual: Callable[[X], PyTree[Array]],
    x0: X,
    scale: FloatScalar,
    *,
    judged: Callable[[X], PyTree[Array]] = lambda x: x,
    solve: Callable[[Array, Array], Array] = jnp.linalg.solve,
    max_iterations: int = 30,
) -> Solved[X, None]:
    """Find a root of `residual` near `x0`, to round-off, by Newton's method.

    The iteration ends by the size of the `judged` part of its increments. `scale` is
    the size to which the round-off of that part is proportional, which is larger than
    the size of x0 if x is an increment to something larger. Multipliers, which have
    units of their own and follow from the rest, need not be judged. Increments, and the
    derivative of the root, are found by `solve(jacobian, b)`, a dense solve by default.
    """
    flat, unravel = ravel_pytree(x0)
    scale = jax.lax.stop_gradient(scale)

    def flat_residual(x):
        return ravel_pytree(residual(unravel(x)))[0]

    def sweep(x):
        dx, _ = dense_increment(lambda z: (flat_residual(z), None), x, solve)
        # The part that is not judged must be finite all the same.
        rest = jnp.where(jnp.all(jnp.isfinite(dx)), 0, jnp.inf).astype(dx.dtype)
        size = rest + max_norm(*jax.tree.leaves(judged(unravel(dx))))
        return x + dx, Sizes(size), None

    def newton(_, x):
        solved = iterate(sweep, x, scale, max_iterations=max_iterations)
        # The outcome is converted to floats, because `custom_root` takes the tangents
        # of `aux` for floats.
        outcome = (solved.converged, solved.exhausted, solved.num_iterations)
        return solved.x, jax.tree.map(lambda z: z.astype(x.dtype), outcome)

    def solve_linear(operator, b):
        return solve(jax.jacfwd(operator)(jnp.zeros_like(b)), b)

    x, (converged, exhausted, num_iterations) = jax.lax.custom_root(
        flat_residual, flat, newton, solve_linear, has_aux=True
    )
    num_iterations = num_iterations.astype(jnp.int32)
    return Solved(unravel(x), None, converged > 0, exhausted > 0, num_iterations)


def with_zero_tangents(tree: X, parameters: PyTree[Any]) -> X:
    """Return the same values, with tangents wherever any parameter has one.

    JAX traces the body of a loop once more if a part of the carry that had no
    derivative at the start has one after a round. What starts a loop is given a
    derivative of zeros by this function, so that one trace is enough.
    """
    parameters = jax.tree.leaves(eqx.filter(parameters, eqx.is_inexact_array))
    moving, fixed = eqx.partition(tree, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(moving)
    if not leaves or not parameters:
        return tree
    return eqx.combine(
        jax.tree.unflatten(structure, _moving(leaves, parameters)), fixed
    )


@eqx.filter_custom_jvp
def _moving(leaves: list[Array], parameters: list[Array]) -> list[Array]:
    del parameters
    return leaves


@_moving.def_jvp
def _moving_jvp(primals, tangents):
    (leaves, _), (rates, others) = primals, tangents
    given = jax.tree.leaves((rates, others))
    if not given:
        return leaves, rates
    # A sum of no terms: JAX takes what depends on no tangent for no derivative at all.
    nothing = jnp.sum(jnp.ravel(given[0])[:0])
    return leaves, [
        jnp.zeros_like(x) + nothing.astype(x.dtype) if rate is None else rate
        for x, rate in zip(leaves, rates, strict=True)
    ]


class ClosureConverted(eqx.Module):
    """A function with the arrays that it closes over, which are among its leaves.

    Our own rules of differentiation must be given all that is differentiated; with this
    class derivatives reach the closed-over arrays too. It does what
    `equinox.filter_closure_convert` does, but takes arrays of any sharding, as there
    are inside and outside of `jax.shard_map`.

    Call it with trees of the structure of `example`. Leaves that are not arrays keep
    the values that they have in `example`.
    """

    consts: list[Array]
    jaxpr: Any = eqx.field(static=True)
    treedef: Any = eqx.field(static=True)

    def __init__(self, function: Callable[..., PyTree[Array]], *example: Any):
        dynamic, static = eqx.partition(example, eqx.is_array)
        closed, shape = jax.make_jaxpr(
            lambda dynamic: function(*eqx.combine(dynamic, static)), return_shape=True
        )(dynamic)
        closed = jax.make_jaxpr(with_small_products(closed))(*jax.tree.leaves(dynamic))
        closed = cse_dce(closed)
        self.consts, self.jaxpr = list(closed.consts), closed.jaxpr
        self.treedef = jax.tree.structure(shape)

    def __call__(self, *args: Any) -> PyTree[Array]:
        arrays = jax.tree.leaves(eqx.filter(args, eqx.is_array))
        closed = jax.extend.core.ClosedJaxpr(self.jaxpr, self.consts)
        out = jax.extend.core.jaxpr_as_fun(closed)(*arrays)
        return jax.tree.unflatten(self.treedef, out)


def has_tangent(tangents: PyTree[Any]) -> PyTree[bool]:
    """Tell which leaves of a tree of tangents are not the `None` of a symbolic zero."""
    return jax.tree.map(
        lambda leaf: leaf is not None, tangents, is_leaf=lambda leaf: leaf is None
    )


def tree_where(ok: BoolScalar, tree: X, other: X) -> X:
    """Take the numbers of a tree where `ok` is true, those of another elsewhere."""
    return jax.tree.map(lambda x, y: jnp.where(ok, x, y), tree, other)


def zero_unless(ok: BoolScalar, tree: X) -> X:
    """Replace the numbers of a tree by zeros where `ok` is false; `None` stays."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.zeros_like(x)), tree)


def nan_unless(ok: BoolScalar, tree: X) -> X:
    """Replace the numbers of a tree by NaN where `ok` is false; `None` stays."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.nan), tree)


def stop_gradient(tree: T) -> T:
    """Stop derivatives through the arrays of a tree, and keep its other leaves."""
    return jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree
    )
