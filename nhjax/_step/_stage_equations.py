"""The equations of one step, as functions of the unknowns of the step."""

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import BoolScalar
from .._numerics import Pattern, small_einsum, sparse_jacobian, SparseMatrix
from .._system import motion_residual, whole_force
from ._stage_system import StageSystem
from ._unknowns import StageForces, Stages


T = TypeVar("T")


def stage_velocities(stages: StageSystem, x: Stages) -> Float[Array, "s n"]:
    """Compute the chart velocities dτ_y⁻¹ D2H(Q^i, P^i) of a Hamiltonian system."""
    chart, y = stages.in_stages(x)
    v = jax.vmap(lambda t, q, u: stages.system.velocity(t, q, u, stages.args))(
        stages.stage_times, chart.positions(y), x.momentum
    )
    return chart.chart_velocities(y, v)


def stage_forces(stages: StageSystem, x: Stages) -> StageForces:
    """Compute the forces n^i, multipliers Λ^i and residuals of the stage momenta."""
    h, a_hat, b = stages.h, stages.coefficients("a_hat"), stages.coefficients("b")
    multiplier = stages.multipliers(x)
    chart, y = stages.in_stages(x)
    q = chart.positions(y)
    u = x.momentum if stages.hamiltonian else chart.body_velocities(y, x.velocity)
    force, momentum = jax.vmap(
        lambda t, q, u, lam: (
            whole_force(stages.system, t, q, u, lam, stages.args),
            stages.system.momentum(t, q, u, stages.args),
        )
    )(stages.stage_times, q, u, multiplier)
    momentum, chart_force = chart.to_chart(y, x.velocity, momentum, force)
    transported = chart.to_origin(y, force)
    base = chart.base_momentum(
        chart.momentum_at_origin(stages.p),
        h * small_einsum("s,sn->n", b, transported),
        h * small_einsum("s,sn->n", b, chart_force),
    )
    residual = momentum - (
        base[None] + h * small_einsum("ij,jn->in", a_hat, chart_force)
    )
    return StageForces(transported, multiplier, residual, momentum)


def node_residual(
    stages: StageSystem, x: Stages, force: Float[Array, "s n"]
) -> Float[Array, "r n"]:
    """Compute the residuals of the momentum equations at the nodes.

    They are p(q^i, u^i) - Ad^*_{τ(y^i)} (M + h Σ a_ij n^j).
    """
    chart, y = stages.in_nodes(x)
    momentum = jax.vmap(lambda t, q, u: stages.system.momentum(t, q, u, stages.args))(
        stages.node_times, chart.positions(y), x.node_fibre_coordinate
    )
    known = chart.momentum_at_origin(stages.p)[None] + stages.h * small_einsum(
        "ij,jn->in", stages.node_weights, force
    )
    return momentum - chart.from_origin(y, known)


def node_constraint(stages: StageSystem, x: Stages) -> Float[Array, "r m"]:
    """Compute the nonholonomic constraints Φ(q^i, u^i) at the nodes."""
    chart, y = stages.in_nodes(x)
    values = jax.vmap(
        lambda t, q, u: stages.system.kinematic_constraint(t, q, u, stages.args)
    )(stages.node_times, chart.positions(y), x.node_fibre_coordinate)
    if stages.redundancy is None:
        return values
    return stages.redundancy.reduced(values, stages.h * x.closure, 0)


def holonomic_constraint(stages: StageSystem, x: Stages) -> Float[Array, "s k"]:
    """Compute Γ(Q^i) / h for i >= 2, and the tangency dΓ/dt at the end of the step.

    The division by h makes the values the size of velocities, as the tangency is.
    """
    chart, y = stages.in_stages(x)
    nodes = chart.positions(y[1:])
    on_positions = jax.vmap(
        lambda t, q: stages.system.position_constraint(t, q, stages.args)
    )(stages.stage_times[1:], nodes)
    end = jax.tree.map(lambda leaf: leaf[-1], nodes)
    tangency = stages.system.tangency(
        stages.t + stages.h, end, x.node_fibre_coordinate[-1], stages.args
    )
    values = jnp.concatenate([on_positions / stages.h, tangency[None]])
    if stages.redundancy is None:
        return values
    m = stages.num_nonholonomic
    return stages.redundancy.reduced(values, stages.h * x.holonomic, m)


def constraint_jacobian(stages: StageSystem, x: Stages) -> Float[Array, "r l n"]:
    """Compute B = ∂Φ/∂u of all constraints on velocities at the nodes i >= 2."""
    return _at_nodes(stages, x, jax.jacrev)


def sparse_constraint_jacobian(
    stages: StageSystem, x: Stages, pattern: Pattern
) -> SparseMatrix:
    """Compute what `constraint_jacobian` does, for a B whose pattern is known."""
    return _at_nodes(
        stages,
        x,
        lambda constraint: lambda u: sparse_jacobian(constraint, u, pattern),
    )


def _at_nodes(
    stages: StageSystem, x: Stages, differentiated: Callable[..., Callable[..., T]]
) -> T:
    times, fibre = stages.stage_times[1:], x.node_fibre_coordinate
    if not stages.num_nonholonomic:
        fibre = jnp.broadcast_to(fibre, (stages.method.stages - 1, fibre.shape[1]))
    chart, y = stages.in_stages(x)
    nodes = chart.positions(y[1:])
    return jax.vmap(
        lambda t, q, u: differentiated(
            lambda u: stages.system.constraint(t, q, u, stages.args)
        )(u)
    )(times, nodes, fibre)


def end_residual(
    stages: StageSystem, x: Stages
) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
    """Compute the residuals of the equations of motion at the end of the step.

    Their root gives the continuous multiplier λ_c there.
    """
    on_momentum, hidden = motion_residual(
        stages.system,
        stages.t + stages.h,
        stages.end_position(x),
        x.node_fibre_coordinate[-1],
        x.end_acceleration,
        x.end_multiplier,
        stages.args,
    )
    if stages.redundancy is not None:
        hidden = stages.redundancy.reduced(hidden[None], x.end_multiplier[None], 0)[0]
    return on_momentum, hidden


def in_chart(stages: StageSystem, x: Stages) -> BoolScalar:
    """Tell whether stages, nodes and end lie where the chart is invertible."""
    chart, y = stages.in_stages(x)
    end = chart.coordinates(stages.increment(x)[None])
    return chart.in_domain(jnp.concatenate([y, end]))
