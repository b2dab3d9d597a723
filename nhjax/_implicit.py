"""Derivatives by the implicit function theorem, and where they are not defined."""

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from ._custom_types import BoolScalar
from ._iteration import dense_increment, iterate, relative_size, Solved


T = TypeVar("T")
X = TypeVar("X", bound=PyTree[Array])


def solve_contraction(contraction: Callable[[X], X], b: X, *, max_iterations: int) -> X:
    """x with x = G x + b, for a linear G that contracts; NaN if it does not.

    Both x and the solution of the transposed equation are sums of the Neumann series,
    to round-off. Where x -> G x + b is a simplified Newton iteration, linearised, this
    is iterative refinement with its factors, and costs about as many evaluations as
    the nonlinear iteration did. Derivatives of every order follow from the equation,
    not from the iterations.
    """
    # One vector: a part of b that happened to be constant could not be transposed.
    flat_b, unravel = ravel_pytree(b)

    def operator(x):
        return x - ravel_pytree(contraction(unravel(x)))[0]

    def refine(matvec, b):
        def sweep(x):
            increment = b - matvec(x)
            return x + increment, relative_size(increment, x), None

        solved = iterate(sweep, b, max_iterations=max_iterations)
        return jnp.where(solved.converged, solved.x, jnp.nan)

    return unravel(
        jax.lax.custom_linear_solve(
            operator, flat_b, solve=refine, transpose_solve=refine
        )
    )


def root(
    residual: Callable[[X], PyTree[Array]], x0: X, max_iterations: int = 30
) -> Solved[X, None]:
    """A root of `residual` near `x0`, to round-off, by Newton's method.

    Its derivative is that of the root, by a dense solve with the Jacobian there.
    """
    flat, unravel = ravel_pytree(x0)

    def flat_residual(x):
        return ravel_pytree(residual(unravel(x)))[0]

    def sweep(x):
        dx, _ = dense_increment(lambda z: (flat_residual(z), None), x)
        return x + dx, relative_size(dx, x), None

    def newton(_, x):
        solved = iterate(sweep, x, max_iterations=max_iterations)
        # As numbers: `custom_root` takes the tangents of `aux` for such.
        outcome = (solved.converged, solved.num_iterations)
        return solved.x, jax.tree.map(lambda z: z.astype(x.dtype), outcome)

    def solve_linear(operator, b):
        return jnp.linalg.solve(jax.jacfwd(operator)(jnp.zeros_like(b)), b)

    x, (converged, num_iterations) = jax.lax.custom_root(
        flat_residual, flat, newton, solve_linear, has_aux=True
    )
    converged, num_iterations = converged > 0, num_iterations.astype(jnp.int32)
    return Solved(unravel(x), None, converged, num_iterations)


def undefined_unless(ok: BoolScalar, tree: X) -> X:
    """The same values, with NaN for derivatives where `ok` is false.

    A derivative that is exactly zero stays so: a loss that leaves out a failed lane has
    a derivative. The identity is written as a linear equation, because a rule of
    forward mode is transposed to that of reverse mode, and this one is not linear.
    """
    return jax.tree.map(
        lambda x: _identity(x, ok) if jnp.issubdtype(x.dtype, jnp.inexact) else x, tree
    )


@eqx.filter_custom_jvp
def _identity(x: Array, ok: BoolScalar) -> Array:
    del ok
    return x


@_identity.def_jvp
def _identity_jvp(primals, tangents):
    (x, ok), (dx, _) = primals, tangents

    def pass_on(_, b):
        return jnp.where(ok | (b == 0), b, jnp.nan)

    if dx is not None:
        dx = jax.lax.custom_linear_solve(
            lambda x: x, dx, solve=pass_on, transpose_solve=pass_on
        )
    return _identity(x, ok), dx


def masked(ok: BoolScalar, tree: X) -> X:
    """The tree with zeros where `ok` is false; `None` stays."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.zeros_like(x)), tree)


def frozen(tree: T) -> T:
    """The same without derivatives; functions and other leaves are left alone."""
    return jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree
    )
