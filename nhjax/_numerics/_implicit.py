"""Derivatives by the implicit function theorem, and where they are not defined."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._custom_types import BoolScalar, FloatScalar
from ._contraction import with_small_products
from ._iteration import dense_increment, iterate, Sizes, Solved
from ._max_norm import max_norm


# Round-off units below which terms of the Neumann series are left out.
_UNITS_LEFT = 256
# Terms that have ceased to fall above as many units are not those of a series that
# converges: there is no derivative then, rather than a wrong one.
_NOISIEST = 1e4

T = TypeVar("T")
X = TypeVar("X", bound=PyTree[Array])


def solve_contraction(contraction: Callable[[X], X], b: X, *, max_iterations: int) -> X:
    """x with x = G x + b, for a linear G that contracts; NaN if it does not.

    Both x and the solution of the transposed equation are sums of the Neumann series,
    until its terms are below 256 units of round-off; those that are left out sum up to
    ρ / (1 - ρ) of that where G contracts by ρ. Where x -> G x + b is a simplified
    Newton iteration, linearised, this is iterative refinement with its factors, and
    costs about as many evaluations as the nonlinear iteration did. Derivatives of every
    order follow from the equation, not from the iterations.
    """
    given, treedef = jax.tree.flatten(b)

    def full(leaves):
        rest = iter(leaves)
        return treedef.unflatten(
            [next(rest) if x.size else jnp.zeros(x.shape, x.dtype) for x in given]
        )

    def operator(x):
        return _minus(x, _not_empty(contraction(full(x))))

    def refine(matvec, b):

        def sweep(x):
            increment = _minus(b, matvec(x))
            x = [x + dx for x, dx in zip(x, increment, strict=True)]
            return x, Sizes(max_norm(*increment), max_norm(*x)), None

        scale = max_norm(*b)
        tolerance = _UNITS_LEFT * float(jnp.finfo(scale.dtype).eps)
        solved = iterate(
            sweep,
            b,
            scale,
            max_iterations=max_iterations,
            tolerance=tolerance,
            noise_units=_NOISIEST,
        )
        return [jnp.where(solved.converged, x, jnp.nan) for x in solved.x]

    x = jax.lax.custom_linear_solve(
        operator, _mixed(_not_empty(b)), solve=refine, transpose_solve=refine
    )
    return full(_mixed(x))


def _not_empty(tree: PyTree[Array]) -> list[Array]:
    """The leaves that have elements."""
    return [leaf for leaf in jax.tree.leaves(tree) if leaf.size]


def _minus(xs: list[Array], ys: list[Array]) -> list[Array]:
    return [x - y for x, y in zip(xs, ys, strict=True)]


def _mixed(xs: list[Array]) -> list[Array]:
    """The same, of which none is constant unless all are.

    A linear equation with a constant on one side could not be transposed.
    """
    nothing = 0 * sum(x.reshape(-1)[0] for x in xs)
    return [x + nothing for x in xs]


def root(
    residual: Callable[[X], PyTree[Array]],
    x0: X,
    scale: FloatScalar,
    *,
    judged: Callable[[X], PyTree[Array]] = lambda x: x,
    max_iterations: int = 30,
) -> Solved[X, None]:
    """A root of `residual` near `x0`, to round-off, by Newton's method.

    `scale` is the size that the `judged` part of x is rounded by: not that of x0 where
    this is an increment to something larger. Multipliers, which have units of their
    own and follow from the rest, need not be judged. The derivative is that of the
    root, by a dense solve with the Jacobian there.
    """
    flat, unravel = ravel_pytree(x0)
    scale = jax.lax.stop_gradient(scale)

    def flat_residual(x):
        return ravel_pytree(residual(unravel(x)))[0]

    def sweep(x):
        dx, _ = dense_increment(lambda z: (flat_residual(z), None), x)
        # What is not judged may still not be NaN.
        rest = jnp.where(jnp.all(jnp.isfinite(dx)), 0, jnp.inf).astype(dx.dtype)
        size = rest + max_norm(*jax.tree.leaves(judged(unravel(dx))))
        return x + dx, Sizes(size), None

    def newton(_, x):
        solved = iterate(sweep, x, scale, max_iterations=max_iterations)
        # As numbers: `custom_root` takes the tangents of `aux` for such.
        outcome = (solved.converged, solved.exhausted, solved.num_iterations)
        return solved.x, jax.tree.map(lambda z: z.astype(x.dtype), outcome)

    def solve_linear(operator, b):
        return jnp.linalg.solve(jax.jacfwd(operator)(jnp.zeros_like(b)), b)

    x, (converged, exhausted, num_iterations) = jax.lax.custom_root(
        flat_residual, flat, newton, solve_linear, has_aux=True
    )
    num_iterations = num_iterations.astype(jnp.int32)
    return Solved(unravel(x), None, converged > 0, exhausted > 0, num_iterations)


def nan_gradient_unless(ok: BoolScalar, tree: X, parameters: PyTree[Any]) -> X:
    """The same values, with NaN for derivatives where `ok` is false.

    Those with respect to all that is among the `parameters`, whether or not the values
    came to depend on it. A derivative of nothing stays zero: a loss that leaves out a
    failed lane has one. The rule is written as a linear equation, because a rule of
    forward mode is transposed to that of reverse mode, and this one is not linear.
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
    # By this function alone JAX decides whether x has a lane for each of a batch, and
    # the derivative has one wherever `ok` or a parameter does. It compiles to nothing.
    for leaf in jax.tree.leaves(parameters):
        ok = ok | jnp.any(leaf == 0)
    return jnp.where(ok, x, x)


@_identity.def_jvp
def _identity_jvp(primals, tangents):
    (x, ok, _), (dx, _, rates) = primals, tangents

    def pass_on(_, b):
        return jnp.where(ok | (b == 0), b, jnp.nan)

    change = sum(jnp.sum(rate) for rate in jax.tree.leaves(rates))
    if dx is None and not jax.tree.leaves(rates):
        return _identity(*primals), None
    dx = jnp.zeros_like(x) if dx is None else dx
    dx = dx + jnp.where(ok, 0, change).astype(x.dtype)
    dx = jax.lax.custom_linear_solve(
        lambda x: x, dx, solve=pass_on, transpose_solve=pass_on
    )
    return _identity(*primals), dx


class ClosureConverted(eqx.Module):
    """A function and what it closes over, the arrays in this among the leaves.

    So that derivatives reach it where rules of differentiation are our own, which must
    be given all that is differentiated. As `equinox.filter_closure_convert`, but it
    takes arrays of any sharding, as there are inside and outside of `jax.shard_map`.
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
        self.consts, self.jaxpr = list(closed.consts), closed.jaxpr
        self.treedef = jax.tree.structure(shape)

    def __call__(self, *args: Any) -> PyTree[Array]:
        arrays = jax.tree.leaves(eqx.filter(args, eqx.is_array))
        closed = jax.extend.core.ClosedJaxpr(self.jaxpr, self.consts)
        out = jax.extend.core.jaxpr_as_fun(closed)(*arrays)
        return jax.tree.unflatten(self.treedef, out)


def has_tangent(tangents: PyTree[Any]) -> PyTree[bool]:
    """Which leaves of a tree of tangents are not the `None` of a symbolic zero."""
    return jax.tree.map(
        lambda leaf: leaf is not None, tangents, is_leaf=lambda leaf: leaf is None
    )


def zero_unless(ok: BoolScalar, tree: X) -> X:
    """The tree with zeros where `ok` is false; `None` stays."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.zeros_like(x)), tree)


def frozen(tree: T) -> T:
    """The same without derivatives; functions and other leaves are left alone."""
    return jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree
    )
