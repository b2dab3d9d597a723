"""The positions of stages, nodes and ends of a step, and their coordinates."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._numerics import small_einsum
from ._chart import AbstractChart
from ._stage_system import StageEquations
from ._unknowns import StageUnknowns


def in_stages(
    stages: StageEquations, x: StageUnknowns
) -> tuple[AbstractChart, Float[Array, "s n"]]:
    """Make the chart and the coordinates y^i of the stages, from h Σ a_ij H^j."""
    return _in_chart(stages, x, stages.method.a)


def in_nodes(
    stages: StageEquations, x: StageUnknowns
) -> tuple[AbstractChart, Float[Array, "r n"]]:
    """Make the chart and the coordinates of the nodes with momenta of their own."""
    return _in_chart(stages, x, stages.node_rows)


def stage_positions(
    stages: StageEquations, chart: AbstractChart, y: Float[Array, "s n"]
) -> PyTree[Array]:
    """Compute the positions of the stages, the first of which is q_k if c_1 = 0."""
    if np.any(stages.method.a[0]):
        return chart.positions(y)
    return jax.tree.map(
        lambda start, others: jnp.concatenate([start[None], others]),
        stages.q,
        chart.positions(y[1:]),
    )


def end_position(stages: StageEquations, x: StageUnknowns) -> PyTree[Array]:
    """Compute the configuration q_{k+1} at the end of the step."""
    chart = stages.chart(x)
    return chart.position(chart.ends[1])


def _in_chart(
    stages: StageEquations, x: StageUnknowns, rows: np.ndarray
) -> tuple[AbstractChart, Float[Array, "r n"]]:
    chart = stages.chart(x)
    start, end = chart.ends
    # A node at an end of the step is given the very coordinates that the chart has for
    # this end, so that the compiler computes once what depends on them.
    first = 0 if np.any(rows[0]) else 1
    last = len(rows) - int(np.array_equal(rows[-1], stages.method.b))
    parts = [start[None]] * first
    if first < last:
        inner = jnp.asarray(rows[first:last], stages.p.dtype)
        increments = stages.h * small_einsum("ij,jn->in", inner, x.velocity)
        parts.append(chart.coordinates(increments))
    if last < len(rows):
        parts.append(end[None])
    return chart, jnp.concatenate(parts)
