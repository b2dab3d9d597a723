"""The reversible adjoint: the backward pass retraces the run from its end."""

from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import BoolScalar
from .._numerics import max_norm, relative
from .._system import AbstractMechanicalSystem, State
from ._loop import AbstractAdjoint, count, DirectAdjoint, Loop
from ._progress_meter import NoProgressMeter
from ._saving import Rows
from ._stepper import AbstractCarry


class ReversibleAdjoint(AbstractAdjoint):
    """Store only the end of the run and retrace the steps from there: memory O(1).

    If the method is symmetric, a step of -h leads back to the start of a step of h.
    There are two exceptions, in which a step of -h leads back only up to a small error:
    the consistent closure, and on a group the chart at the start of a step. In these
    cases, and if the method is not symmetric, the step is inverted by an iteration that
    starts from the step of -h.

    The retraced states differ from the states of the run by round-off. If a set
    attracts the motion, as for a sleigh, it repels the motion in reversed time, and
    these differences grow as fast as the motion approached the set. In that case prefer
    `RecursiveCheckpointAdjoint`. This adjoint allows only reverse mode and forward over
    reverse mode: `jax.jvp` needs `DirectAdjoint` or `RecursiveCheckpointAdjoint`.
    Gradients are also available if `num_steps` is an array.

    !!! example

        >>> import jax, nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> def end(dt):
        ...     return nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...         disc.initial_state(), dt=dt, num_steps=10,
        ...         adjoint=nhjax.ReversibleAdjoint()).ys.q[-1, 3]
        >>> round(float(jax.grad(end)(0.1)), 6)
        7.0
    """

    needs_log: ClassVar[bool] = True

    def run(self, loop: Loop, carry: AbstractCarry) -> tuple[AbstractCarry, Rows]:
        """Run the loop from `carry`; return the last carry and all saved rows."""
        return _run((loop, carry))


@eqx.filter_custom_vjp
def _run(arguments: tuple[Loop, AbstractCarry]) -> tuple[AbstractCarry, Rows]:
    return DirectAdjoint().run(*arguments)


@_run.def_fwd
def _run_fwd(perturbed, arguments):
    del perturbed
    # `_run` is not called here: it has a custom rule for reverse mode, which forward
    # mode cannot differentiate.
    carry, rows = DirectAdjoint().run(*arguments)
    # The backward pass needs the log and, of all other rows, only the shapes.
    shapes = jax.eval_shape(lambda: rows)
    return (carry, rows), (carry, shapes, rows.log)


@_run.def_bwd
def _run_bwd(residuals, cotangents, perturbed, arguments):
    del perturbed
    (end, shapes, log), (loop, start) = residuals, arguments
    meter = eqx.filter(loop.meter, eqx.is_inexact_array)
    # The forward pass has shown the progress already.
    loop, stepper = replace(loop, meter=NoProgressMeter()), loop.stepper
    of_end, row_cotangents = cotangents
    reverse = stepper.reverse_replay(start, end, log)
    cotangent = _filled(stepper.differentiable(of_end), stepper.differentiable(end))
    row_cotangents = _filled(row_cotangents, shapes)
    parameters, fixed = eqx.partition(loop, eqx.is_inexact_array)
    zeros = jax.tree.map(jnp.zeros_like, parameters)

    def back(state, k):
        replay, step_state, cotangent, total = state
        replay, step_state = reverse.back(replay, step_state, k)
        before = reverse.carry_before(replay, step_state, k)

        def forward(parameters, part):
            loop = eqx.combine(parameters, fixed)
            carry = eqx.tree_at(stepper.differentiable, before, part)
            carry, rows = loop.step(carry, k, replay)
            return stepper.differentiable(carry), eqx.filter(rows, eqx.is_inexact_array)

        _, pullback = jax.vjp(forward, parameters, stepper.differentiable(before))
        rows = loop.saving.read(row_cotangents, *reverse.places(replay, k))
        rows = eqx.filter(rows, eqx.is_inexact_array)
        change, cotangent = pullback((cotangent, rows))
        return replay, step_state, cotangent, jax.tree.map(jnp.add, total, change)

    number = count(reverse.num_iterations)
    last = number - np.int32(1)
    _, first, cotangents, total = jax.lax.fori_loop(
        np.int32(0),
        number,
        lambda i, state: back(state, last - i),
        (reverse.after_end, end.step_state, cotangent, zeros),
    )
    total, cotangents = _if_retraced(
        stepper.succeeded(end),
        stepper.plain.system,
        first.state,
        start.step_state.state,
        (cotangent, row_cotangents),
        (total, cotangents),
    )
    of_start = jax.tree.map(lambda _: None, eqx.filter(start, eqx.is_inexact_array))
    of_start = eqx.tree_at(
        stepper.differentiable, of_start, cotangents, is_leaf=lambda leaf: leaf is None
    )
    return replace(total, meter=jax.tree.map(lambda _: None, meter)), of_start


def _if_retraced(
    successful: BoolScalar,
    system: AbstractMechanicalSystem,
    reached: State,
    start: State,
    cotangents: PyTree[Array],
    gradient: PyTree[Array],
) -> PyTree[Array]:
    """Return the gradient, or NaN if the run failed or could not be retraced.

    A run counts as retraced if the backward pass has `reached` a state that agrees with
    the state at the `start` of the run. If all cotangents are zero, the gradient is
    zero in any case.
    """
    manifold = system.manifold_of(start.q)
    xi = manifold.local(manifold.compose(manifold.inverse(start.q), reached.q))
    small = float(jnp.finfo(start.p.dtype).eps) ** 0.375
    retraced = (max_norm(xi) <= small * (1 + max_norm(*jax.tree.leaves(start.q)))) & (
        relative(max_norm(reached.p - start.p), max_norm(start.p)) <= small
    )
    nonzero = [jnp.any(leaf != 0) for leaf in jax.tree.leaves(cotangents)]
    any_nonzero = jnp.any(jnp.stack(nonzero))

    def nan_unless_retraced(x):
        x = jnp.where(successful & retraced, x, jnp.nan)
        return jnp.where(any_nonzero, x, 0)

    return jax.tree.map(nan_unless_retraced, gradient)


def _filled(cotangents: PyTree[Any], like: PyTree[Any]) -> PyTree[Any]:
    """Replace missing cotangents of floating-point arrays by zeros.

    Missing cotangents of other arrays, such as integers, stay None.
    """

    def fill(cotangent, x):
        if cotangent is not None or x is None:
            return cotangent
        is_number = jnp.issubdtype(x.dtype, jnp.inexact)
        return jnp.zeros(x.shape, x.dtype) if is_number else None

    return jax.tree.map(fill, cotangents, like, is_leaf=lambda leaf: leaf is None)
