from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import BoolScalar
from .._numerics import max_norm, relative
from .._system import AbstractMechanicalSystem, State
from ._adjoint import AbstractAdjoint, count, DirectAdjoint
from ._loop import Loop
from ._progress_meter import NoProgressMeter
from ._saving import Rows
from ._stepper import Carry
from ._way_back import way_back


class ReversibleAdjoint(AbstractAdjoint):
    """Keep the end of the run alone and retrace the steps from there: memory O(1).

    A symmetric step of -h leads back to where a step of h came from. With the
    consistent closure, and on a group with the chart at the start of a step, it leads
    back up to a small error only, and the step is inverted by an iteration that starts
    from the step of -h.

    The states that are retraced differ by round-off from those of the run. Where the
    motion is attracted to some set, as that of a sleigh is, it is repelled in reversed
    time, and the differences grow as fast as the motion decays; prefer
    `RecursiveCheckpointAdjoint` there. This adjoint allows reverse mode and forward
    over reverse mode alone: `jax.jvp` needs one of the other two adjoints. It gives
    gradients also if `num_steps` is an array.

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

    def run(self, loop: Loop, carry: Carry) -> tuple[Carry, Rows]:
        """Run all steps of the loop from `carry`; return its end and all saved rows."""
        return _run((loop, carry))


@eqx.filter_custom_vjp
def _run(arguments: tuple[Loop, Carry]) -> tuple[Carry, Rows]:
    return DirectAdjoint().run(*arguments)


@_run.def_fwd
def _run_fwd(perturbed, arguments):
    del perturbed
    # A call of `_run` would refuse forward mode over this reverse mode.
    carry, rows = DirectAdjoint().run(*arguments)
    # The backward pass needs the shapes of the buffers alone, so these are not kept,
    # but for the log of events.
    shapes = jax.eval_shape(lambda: rows)
    return (carry, rows), (carry, shapes, rows.log)


@_run.def_bwd
def _run_bwd(residuals, cotangents, perturbed, arguments):
    del perturbed
    (end, shapes, log), (loop, start) = residuals, arguments
    meter = eqx.filter(loop.meter, eqx.is_inexact_array)
    loop = replace(loop, meter=NoProgressMeter())  # the forward pass has shown all
    of_end, row_cotangents = cotangents
    way = way_back(loop, start, end, log)
    cotangent = _filled(way.differentiable_part(of_end), way.differentiable_part(end))
    row_cotangents = _filled(row_cotangents, shapes)
    parameters, fixed = eqx.partition(loop, eqx.is_inexact_array)
    nothing = jax.tree.map(jnp.zeros_like, parameters)

    def retrace(state, k):
        place, step_state, cotangent, total = state
        place, step_state = way.back(place, step_state, k)

        def forward(parameters, part):
            loop = eqx.combine(parameters, fixed)
            carry, rows = way.rerun(loop, place, step_state, part, k)
            return way.differentiable_part(carry), eqx.filter(
                rows, eqx.is_inexact_array
            )

        part = way.differentiable_part_at(place, step_state)
        _, pullback = jax.vjp(forward, parameters, part)
        row = eqx.filter(way.rows(row_cotangents, place, k), eqx.is_inexact_array)
        change, cotangent = pullback((cotangent, row))
        return place, step_state, cotangent, jax.tree.map(jnp.add, total, change)

    last, state = (
        count(loop.num_iterations) - np.int32(1),
        (way.place_at_end, end.step_state, cotangent, nothing),
    )
    _, first, cotangents, total = jax.lax.fori_loop(
        np.int32(0),
        count(loop.num_iterations),
        lambda i, state: retrace(state, last - i),
        state,
    )
    total, cotangents = _if_retraced(
        way.went_well,
        loop.stepping.system,
        first.state,
        start.step_state.state,
        (cotangent, row_cotangents),
        (total, cotangents),
    )
    cotangent = cotangents if loop.events is None else cotangents[0]
    of_start = jax.tree.map(lambda _: None, eqx.filter(start, eqx.is_inexact_array))
    of_start = eqx.tree_at(
        lambda carry: carry.step_state.state,
        of_start,
        cotangent,
        is_leaf=lambda leaf: leaf is None,
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

    A run counts as retraced if the state that was `reached` agrees with the `start`.
    The gradient is zero where all cotangents are, since then nothing depends on it.
    """
    manifold = system.manifold_of(start.q)
    xi = manifold.local(manifold.compose(manifold.inverse(start.q), reached.q))
    small = float(jnp.finfo(start.p.dtype).eps) ** 0.375
    retraced = (max_norm(xi) <= small * (1 + max_norm(*jax.tree.leaves(start.q)))) & (
        relative(max_norm(reached.p - start.p), max_norm(start.p)) <= small
    )
    asked = [jnp.any(leaf != 0) for leaf in jax.tree.leaves(cotangents)]
    asked = jnp.any(jnp.stack(asked))

    def judged(x):
        x = jnp.where(successful & retraced, x, jnp.nan)
        return jnp.where(asked, x, 0)

    return jax.tree.map(judged, gradient)


def _filled(cotangents: PyTree[Any], like: PyTree[Any]) -> PyTree[Any]:
    """Fill in zeros for missing cotangents of arrays of inexact numbers.

    The missing cotangents of other arrays, such as integers, stay None.
    """

    def fill(cotangent, x):
        if cotangent is not None or x is None:
            return cotangent
        is_number = jnp.issubdtype(x.dtype, jnp.inexact)
        return jnp.zeros(x.shape, x.dtype) if is_number else None

    return jax.tree.map(fill, cotangents, like, is_leaf=lambda leaf: leaf is None)
