"""Derivatives of values that are computed by iterations or not defined everywhere.

`AbstractImplicitFunction` has the rule for the derivatives of all steps: derivatives
follow from the solution by the implicit function theorem, not from the iterations. The
rest of the file contains the linear and nonlinear solves that such functions use, and
helpers that change the tangents of trees: to zero, to NaN, or from a symbolic zero to
an array of zeros.
"""

from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PyTree

from .._compile import as_cpu_kernel, TraceCache
from .._custom_types import BoolScalar, FloatScalar
from ..lanes import cse_dce
from ._contraction import with_small_products
from ._floating_point import max_norm, nonzero_or_one
from ._iteration import dense_increment, iterate, Solved, UpdateNorms


# `solve_contraction` leaves out terms below this many units of round-off.
_UNITS_LEFT = 256
# `root` divides its `path` into `_PARTS_OF_PATH` parts, with `_ITERATIONS_OF_PART`
# iterations in each part.
_PARTS_OF_PATH, _ITERATIONS_OF_PART = 32, 3
# If the terms of `solve_contraction` stop falling above this many units of round-off,
# their sum does not converge. The derivative is then NaN rather than a wrong number.
_NOISIEST = 1e4

T = TypeVar("T")
X = TypeVar("X", bound=PyTree[Array])
Arguments = TypeVar("Arguments")
Solution = TypeVar("Solution")


class AbstractImplicitFunction(eqx.Module, Generic[Arguments, Solution]):
    """A function whose value solves equations, with derivatives from these equations.

    Call an instance with one tree of arguments. The function is differentiable with
    respect to its arguments, but not with respect to its own fields. JAX never
    differentiates `solve`: derivatives of every order come from `tangent`.

    - `programs`: a cache of traced programs; None if the function is part of a larger
        program. With a cache, the derivative rule reuses the traced program of `solve`
        instead of tracing `solve` again.
    """

    programs: eqx.AbstractVar[TraceCache | None]

    @abstractmethod
    def solve(self, arguments: Arguments) -> Solution:
        """Compute the solution, by iterations of any kind."""

    @abstractmethod
    def tangent(
        self, arguments: Arguments, rates: Arguments, solution: Solution
    ) -> Solution:
        """Compute the tangent of the solution for arguments that change at `rates`.

        Where a leaf of `rates` is None, the argument does not change. Leaves of the
        result may also be None, which stands for zero.
        """

    def __call__(self, arguments: Arguments) -> Solution:
        """Compute the solution; it can be differentiated with respect to `arguments`.

        If `programs` is a cache, the function is one primitive of JAX. When JAX splits
        a scan into a known and a linear part, it drops the derivative rules of
        functions, but not the rules of primitives. Without its rule, a step could be
        differentiated in reverse mode only once.
        """
        if self.programs is None:
            return _solution(arguments, self)
        return as_cpu_kernel(_solution, arguments, self, programs=self.programs)


@eqx.filter_custom_jvp
def _solution(
    arguments: Arguments, function: AbstractImplicitFunction[Arguments, Solution]
) -> Solution:
    return function.solve(arguments)


@_solution.def_jvp
def _solution_jvp(primals, tangents):
    arguments, function = primals
    solution = function(arguments)
    return solution, function.tangent(arguments, tangents[0], solution)


def fixed_point_tangent(
    iteration: Callable[[T, X], X],
    parameters: T,
    rates: T,
    x: X,
    units: list[FloatScalar],
    *,
    max_iterations: int,
) -> X:
    """Compute how a fixed point x = G(θ, x) changes with the parameters θ.

    `solve_contraction` solves dx = ∂G/∂x dx + ∂G/∂θ dθ for the change dx.

    **Arguments:**

    - `iteration`: G, which contracts in x near the fixed point.
    - `parameters`, `rates`: θ and its tangent dθ.
    - `x`: the fixed point.
    - `units`, `max_iterations`: as for `solve_contraction`.
    """
    # The iteration is traced once, and differentiated twice.
    iteration = ClosureConverted(iteration, parameters, x)
    _, b = jax.jvp(lambda theta: iteration(theta, x), (parameters,), (rates,))
    _, contraction = jax.linearize(lambda x: iteration(parameters, x), x)
    return solve_contraction(contraction, b, units, max_iterations=max_iterations)


def solve_contraction(
    contraction: Callable[[X], X],
    b: X,
    units: list[FloatScalar],
    *,
    max_iterations: int,
) -> X:
    """Solve x = G x + b for a linear contraction G; x is NaN if G does not contract.

    Both x and the solution of the transposed equation are sums of a Neumann series. The
    sum ends when its terms are below 256 units of round-off. If G contracts by a factor
    ρ, the sum of the remaining terms is at most ρ / (1 - ρ) times this bound.

    If x -> G x + b is a linearised simplified Newton iteration, the sum is iterative
    refinement with the matrix factors of that iteration. It takes about as many
    evaluations as the nonlinear iteration took. Derivatives of every order follow from
    the equation, not from the iterations.

    The size of a term is its largest entry, after each leaf is divided by its entry in
    `units`. The unknowns of the transposed equation have the inverse units, so that the
    product of x and these unknowns has no unit.
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

        def iteration(x):
            increment = _minus(b, matvec(x))
            x = [x + dx for x, dx in zip(x, increment, strict=True)]
            return x, UpdateNorms(size(increment), size(x)), None

        scale = size(b)
        tolerance = _UNITS_LEFT * float(jnp.finfo(scale.dtype).eps)
        solved = iterate(
            iteration,
            b,
            scale,
            max_iterations=max_iterations,
            tolerance=tolerance,
            noise_units=_NOISIEST,
        )
        return nan_unless(solved.converged, solved.x)

    pairs = zip(given, units, strict=True)
    scales = [nonzero_or_one(jax.lax.stop_gradient(one)) for x, one in pairs if x.size]
    x = jax.lax.custom_linear_solve(
        operator,
        _depending_on_all(_not_empty(b)),
        solve=partial(refine, [1 / one for one in scales]),
        transpose_solve=partial(refine, scales),
    )
    return full(_depending_on_all(x))


def _not_empty(tree: PyTree[Array]) -> list[Array]:
    """List the leaves of a tree that have elements."""
    return [leaf for leaf in jax.tree.leaves(tree) if leaf.size]


def _minus(xs: list[Array], ys: list[Array]) -> list[Array]:
    return [x - y for x, y in zip(xs, ys, strict=True)]


def _depending_on_all(xs: list[Array]) -> list[Array]:
    """Return arrays with the same values, each of which depends on all the arrays.

    Differentiation then treats either all or none of the arrays as constants. JAX
    cannot transpose a linear equation if only a part of its right-hand side is treated
    as constant.
    """
    zero = 0 * sum(x.reshape(-1)[0] for x in xs)
    return [x + zero for x in xs]


def root(
    residual: Callable[[X], PyTree[Array]],
    x0: X,
    scale: FloatScalar,
    *,
    judged: Callable[[X], PyTree[Array]] = lambda x: x,
    solve: Callable[[Array, Array], Array] = jnp.linalg.solve,
    path: Callable[[FloatScalar, X], PyTree[Array]] | None = None,
    max_iterations: int = 30,
) -> Solved[X, None]:
    """Find a root of `residual` near `x0`, to round-off, by Newton's method.

    The derivative of the root follows from the implicit function theorem.

    **Arguments:**

    - `scale`: the size to which the round-off of x is proportional. It is larger than
        the size of x0 if x is an increment to a larger number.
    - `judged`: a function that selects the part of an increment that must be small to
        end the iteration. Multipliers can be left out, because they have other units
        and follow from the other unknowns.
    - `solve`: a function that is called as `solve(jacobian, b)` for the increments and
        for the derivative of the root; a dense solve by default.
    - `path`: a function of (θ, x) that returns residuals. It has the root `x0` at
        θ = 0, and is equal to `residual` at θ = 1. Newton's method may cycle where the
        residual has kinks. If Newton's method does not find a root, the root of `path`
        is followed from θ = 0 to θ = 1.
    - `max_iterations`: the largest number of iterations.
    """
    flat, unravel = ravel_pytree(x0)
    scale = jax.lax.stop_gradient(scale)

    def flat_residual(x):
        return ravel_pytree(residual(unravel(x)))[0]

    def iteration(x):
        dx, _ = dense_increment(lambda z: (flat_residual(z), None), x, solve)
        # The part that is not judged must be finite too.
        rest = jnp.where(jnp.all(jnp.isfinite(dx)), 0, jnp.inf).astype(dx.dtype)
        size = rest + max_norm(*jax.tree.leaves(judged(unravel(dx))))
        return x + dx, UpdateNorms(size), None

    def followed(path, x, is_needed):
        count = _PARTS_OF_PATH * _ITERATIONS_OF_PART

        def advance(k, x):
            part = (k // _ITERATIONS_OF_PART + 1).astype(x.dtype) / _PARTS_OF_PATH

            def residual(z):
                return ravel_pytree(path(part, unravel(z)))[0], None

            # Increments are shortened, because full increments may cycle at a kink.
            dx, _ = dense_increment(residual, x, solve)
            shorter = x[None] + jnp.outer(0.5 ** jnp.arange(5, dtype=x.dtype), dx)
            sizes = jax.vmap(lambda z: max_norm(residual(z)[0]))(shorter)
            return shorter[jnp.nanargmin(sizes)]

        return jax.lax.fori_loop(0, jnp.where(is_needed, count, 0), advance, x)

    def newton(_, x):
        solved = iterate(iteration, x, scale, max_iterations=max_iterations)
        if path is not None:
            start = followed(path, x, ~solved.converged)
            again = iterate(
                iteration,
                start,
                scale,
                max_iterations=max_iterations,
                skip=solved.converged,
            )
            solved = tree_where(solved.converged, solved, again)
        # `custom_root` needs floats in `aux`, because it creates tangents of the same
        # dtypes.
        outcome = (solved.converged, solved.exhausted, solved.num_iterations)
        return solved.x, jax.tree.map(lambda z: z.astype(x.dtype), outcome)

    def solve_linear(operator, b):
        return solve(jax.jacfwd(operator)(jnp.zeros_like(b)), b)

    x, (converged, exhausted, num_iterations) = jax.lax.custom_root(
        flat_residual, flat, newton, solve_linear, has_aux=True
    )
    num_iterations = num_iterations.astype(jnp.int32)
    return Solved(unravel(x), None, converged > 0, exhausted > 0, num_iterations)


class ClosureConverted(eqx.Module):
    """A traced function as a tree, whose leaves are the arrays that it closes over.

    A function with a custom rule of derivatives is differentiated only with respect to
    its arguments. If an argument is an instance of this class, the function is also
    differentiated with respect to the arrays that the instance closes over.
    `equinox.filter_closure_convert` does the same, but it refuses arrays whose sharding
    differs inside and outside of `jax.shard_map`.

    Call an instance with trees of the structure of `example`. Leaves that are not
    arrays always have the values that they have in `example`.
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
    """Return which leaves of a tree of tangents are not None; None stands for zero."""
    return jax.tree.map(
        lambda leaf: leaf is not None, tangents, is_leaf=lambda leaf: leaf is None
    )


def with_zero_tangents(tree: X, parameters: PyTree[Any]) -> X:
    """Return the same tree, in which each array has a tangent, which may be zero.

    If no array of `parameters` or of the tree has a tangent, none is added.

    JAX traces the body of a loop again if a part of the carry has no tangent at first,
    but has a tangent after an iteration. If all parts of the initial carry have
    tangents, JAX traces the body once.
    """
    parameters = jax.tree.leaves(eqx.filter(parameters, eqx.is_inexact_array))
    inexact, others = eqx.partition(tree, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(inexact)
    if not leaves or not parameters:
        return tree
    return eqx.combine(
        jax.tree.unflatten(structure, _with_zero_tangents(leaves, parameters)), others
    )


@eqx.filter_custom_jvp
def _with_zero_tangents(leaves: list[Array], parameters: list[Array]) -> list[Array]:
    # The parameters are arguments, because JAX applies the rule below only if an
    # argument has a tangent.
    del parameters
    return leaves


@_with_zero_tangents.def_jvp
def _with_zero_tangents_jvp(primals, tangents):
    (leaves, _), (rates, others) = primals, tangents
    given = jax.tree.leaves((rates, others))
    if not given:
        return leaves, rates
    # This zero is the sum of an empty slice of a tangent, so that it depends on the
    # tangent. JAX treats a zero that depends on no tangent as a missing tangent.
    zero = jnp.sum(jnp.ravel(given[0])[:0])
    return leaves, [
        jnp.zeros_like(x) + zero.astype(x.dtype) if rate is None else rate
        for x, rate in zip(leaves, rates, strict=True)
    ]


def stop_gradient(tree: T) -> T:
    """Stop derivatives through the arrays of a tree; return other leaves unchanged.

    `jax.lax.stop_gradient` refuses leaves that are not arrays.
    """
    return jax.tree.map(
        lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, tree
    )


def tree_where(ok: BoolScalar, tree: X, other: X) -> X:
    """Return the numbers of `tree` where `ok` is true, and of `other` elsewhere."""
    return jax.tree.map(lambda x, y: jnp.where(ok, x, y), tree, other)


def zero_unless(ok: BoolScalar, tree: X) -> X:
    """Replace the numbers of a tree by zeros where `ok` is false; None stays None."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.zeros_like(x)), tree)


def nan_unless(ok: BoolScalar, tree: X) -> X:
    """Replace the numbers of a tree by NaN where `ok` is false; None stays None."""
    return jax.tree.map(lambda x: jnp.where(ok, x, jnp.nan), tree)


def nan_gradient_unless(ok: BoolScalar, tree: X, parameters: PyTree[Any]) -> X:
    """Return the same values, with derivatives that are NaN where `ok` is false.

    The derivatives with respect to all `parameters` are NaN, whether or not the values
    depend on them. A cotangent of zero stays zero, so that a loss has a finite
    derivative if it leaves out failed members.
    """
    parameters = eqx.filter(parameters, eqx.is_inexact_array)
    return jax.tree.map(
        lambda x: (
            _value(x, ok, parameters) if jnp.issubdtype(x.dtype, jnp.inexact) else x
        ),
        tree,
    )


@eqx.filter_custom_jvp
def _value(x: Array, ok: BoolScalar, parameters: PyTree[Array]) -> Array:
    # Under `vmap`, a leaf of the result must be batched if its derivative is batched,
    # that is, if `ok` or a parameter is batched. Therefore the operations below make
    # the result depend on all of them. The compiler removes these operations.
    for leaf in jax.tree.leaves(parameters):
        ok = ok | jnp.any(leaf == 0)
    return jnp.where(ok, x, x)


@_value.def_jvp
def _value_jvp(primals, tangents):
    (x, ok, _), (dx, _, rates) = primals, tangents

    change = sum(jnp.sum(rate) for rate in jax.tree.leaves(rates))
    if dx is None and not jax.tree.leaves(rates):
        return _value(*primals), None
    dx = jnp.zeros_like(x) if dx is None else dx
    dx = dx + jnp.where(ok, 0, change).astype(x.dtype)
    return _value(*primals), nan_tangent_unless(ok, dx)


def nan_tangent_unless(ok: BoolScalar, dx: Array) -> Array:
    """Return a tangent, but NaN where `ok` is false and the tangent is not zero.

    This function is not linear, but JAX can transpose only linear functions. Therefore
    it is written as a linear solve, whose transpose does the same to a cotangent.
    """

    def solve(_, b):
        return jnp.where(ok | (b == 0), b, jnp.nan)

    return jax.lax.custom_linear_solve(
        lambda x: x, dx, solve=solve, transpose_solve=solve
    )
