"""The equations of one step, as functions of the unknowns of the step."""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import BoolScalar
from .._numerics import Pattern, small_einsum, sparse_jacobian, SparseMatrix
from .._system import motion_residual, total_force
from ._invariants import InvariantCorrection, moving_part
from ._positions import end_position, in_nodes, in_stages, stage_positions
from ._stage_system import StageEquations
from ._unknowns import StageForces, StageUnknowns


T = TypeVar("T")


def stage_velocities(stages: StageEquations, x: StageUnknowns) -> Float[Array, "s n"]:
    """Compute the chart velocities dτ_y⁻¹ D2H(Q^i, P^i) of a Hamiltonian system."""
    chart, y = in_stages(stages, x)
    v = jax.vmap(lambda t, q, u: stages.system.velocity(t, q, u, stages.args))(
        stages.stage_times, stage_positions(stages, chart, y), x.momentum
    )
    return chart.chart_velocities(y, v)


def stage_forces(stages: StageEquations, x: StageUnknowns) -> StageForces:
    """Compute the forces n^i, multipliers Λ^i and residuals of the stage momenta."""
    h, a_hat, b = stages.h, stages.coefficients("a_hat"), stages.coefficients("b")
    multiplier = stages.multipliers(x)
    chart, y = in_stages(stages, x)
    q = stage_positions(stages, chart, y)
    u = x.momentum if stages.hamiltonian else chart.body_velocities(y, x.velocity)
    force, momentum = jax.vmap(
        lambda t, q, u, lam: (
            total_force(stages.system, t, q, u, lam, stages.args),
            stages.system.momentum(t, q, u, stages.args),
        )
    )(stages.stage_times, q, u, multiplier)
    momentum, chart_force = chart.to_chart(y, x.velocity, momentum, force)
    transported = chart.to_origin(y, force)
    base = chart.base_momentum(
        chart.momentum_at_origin(_start_momentum(stages, x)),
        h * small_einsum("s,sn->n", b, transported),
        h * small_einsum("s,sn->n", b, chart_force),
    )
    residual = momentum - (
        base[None] + h * small_einsum("ij,jn->in", a_hat, chart_force)
    )
    return StageForces(transported, multiplier, residual, momentum)


def node_residual(
    stages: StageEquations, x: StageUnknowns, force: Float[Array, "s n"]
) -> Float[Array, "r n"]:
    """Compute the residuals of the momentum equations at the nodes.

    They are p(q^i, u^i) - Ad^*_{τ(y^i)} (M + h Σ a_ij n^j), at the end of the step less
    the impulse there.
    """
    chart, y = in_nodes(stages, x)
    momentum = jax.vmap(lambda t, q, u: stages.system.momentum(t, q, u, stages.args))(
        stages.node_times, chart.positions(y), x.node_fibre_coordinate
    )
    start = chart.momentum_at_origin(_start_momentum(stages, x))
    gained = stages.h * small_einsum("ij,jn->in", stages.node_weights, force)
    residual = momentum - chart.from_origin(y, start[None] + gained)
    if stages.invariants is None:
        return residual
    last = residual[-1:] - end_impulse(stages, x)[None]
    return jnp.concatenate([residual[:-1], last])


def node_constraint(stages: StageEquations, x: StageUnknowns) -> Float[Array, "r m"]:
    """Compute the nonholonomic constraints Φ(q^i, u^i) at the nodes."""
    chart, y = in_nodes(stages, x)
    values = jax.vmap(
        lambda t, q, u: stages.system.kinematic_constraint(t, q, u, stages.args)
    )(stages.node_times, chart.positions(y), x.node_fibre_coordinate)
    if stages.redundancy is None:
        return values
    return stages.redundancy.reduced(values, stages.h * x.closure, 0)


def holonomic_constraint(stages: StageEquations, x: StageUnknowns) -> Float[Array, "s k"]:
    """Compute Γ(Q^i) / h for i >= 2, and the tangency dΓ/dt at the end of the step.

    The division by h makes the values the size of velocities, as the tangency is.
    """
    chart, y = in_stages(stages, x)
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


def constraint_values(stages: StageEquations, x: StageUnknowns) -> tuple[Array, Array]:
    """Compute the nonholonomic constraints at the nodes and the holonomic ones."""
    none = jnp.zeros((0,), stages.p.dtype)
    return (
        node_constraint(stages, x) if stages.num_nonholonomic else none,
        holonomic_constraint(stages, x) if stages.num_holonomic else none,
    )


def constraint_jacobian(stages: StageEquations, x: StageUnknowns) -> Float[Array, "r l n"]:
    """Compute B = ∂Φ/∂u of all constraints on velocities at the nodes i >= 2."""
    return _at_nodes(stages, x, jax.jacrev)


def sparse_constraint_jacobian(
    stages: StageEquations, x: StageUnknowns, pattern: Pattern
) -> SparseMatrix:
    """Compute B = ∂Φ/∂u at the nodes i >= 2 as a sparse matrix of a known pattern."""
    return _at_nodes(
        stages,
        x,
        lambda constraint: lambda u: sparse_jacobian(constraint, u, pattern),
    )


def _at_nodes(
    stages: StageEquations, x: StageUnknowns, differentiated: Callable[..., Callable[..., T]]
) -> T:
    times, u = stages.stage_times[1:], x.node_fibre_coordinate
    if not stages.num_nonholonomic:
        u = jnp.broadcast_to(u, (stages.method.stages - 1, u.shape[1]))
    chart, y = in_stages(stages, x)
    nodes = chart.positions(y[1:])
    return jax.vmap(
        lambda t, q, u: differentiated(
            lambda u: stages.system.constraint(t, q, u, stages.args)
        )(u)
    )(times, nodes, u)


def end_residual(
    stages: StageEquations, x: StageUnknowns
) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
    """Compute the residuals of the equations of motion at the end of the step.

    Their root gives the continuous multiplier λ_c there.
    """
    on_momentum, hidden = motion_residual(
        stages.system,
        stages.t + stages.h,
        end_position(stages, x),
        x.node_fibre_coordinate[-1],
        x.end_acceleration,
        x.end_multiplier,
        stages.args,
    )
    if stages.redundancy is not None:
        hidden = stages.redundancy.reduced(hidden[None], x.end_multiplier[None], 0)[0]
    return on_momentum, hidden


def start_impulse(stages: StageEquations, x: StageUnknowns) -> Float[Array, " n"]:
    """Compute the impulse ε ω_k at the start of a step that keeps invariants."""
    assert stages.invariants is not None
    return small_einsum("k,kn->n", x.impulse, stages.invariants.covectors)


def _start_momentum(stages: StageEquations, x: StageUnknowns) -> Float[Array, " n"]:
    """Compute the momentum after the impulse at the start of the step."""
    return stages.p if stages.invariants is None else stages.p + start_impulse(stages, x)


def end_impulse(stages: StageEquations, x: StageUnknowns) -> Float[Array, " n"]:
    """Compute the impulse ε ω_{k+1} at the end of the step."""
    _, covectors = end_slopes(stages, x)
    return small_einsum("k,kn->n", x.impulse, covectors)


def end_slopes(
    stages: StageEquations, x: StageUnknowns
) -> tuple[Float[Array, "k n"], Float[Array, "k n"]]:
    """Compute ∂I/∂u and ω of the invariants at the end of a step; see `Directions`."""
    assert stages.invariants is not None
    found = stages.invariants.invariants.directions(*_end_point(stages, x))
    return found.slopes, found.covectors


def invariant_errors(stages: StageEquations, x: StageUnknowns) -> Float[Array, " k"]:
    """Compute the errors of the invariants at the end of a step."""
    assert stages.invariants is not None
    return stages.invariants.invariants.tangent_error(*_end_point(stages, x))


def impulse_weights(stages: StageEquations, x: StageUnknowns) -> InvariantCorrection:
    """Weigh the equations for the impulses of a step, near the given stages."""
    assert stages.invariants is not None
    slopes, covectors = end_slopes(stages, x)
    moving = moving_part(slopes, x.node_fibre_coordinate[-1])
    given = slopes, covectors, moving, stages.hamiltonian
    return InvariantCorrection.at(stages.invariants, *given)


def _end_point(stages: StageEquations, x: StageUnknowns) -> tuple[Any, ...]:
    """Return what functions of the system are given at the end of the step."""
    assert stages.invariants is not None
    end = stages.chart(x).advance(*stages.invariants.position)
    q = stages.manifold.wrapped(*end)
    u = x.node_fibre_coordinate[-1]
    return stages.system, stages.t + stages.h, q, u, stages.args


def in_chart(stages: StageEquations, x: StageUnknowns) -> BoolScalar:
    """Tell whether stages, nodes and end lie where the chart is invertible."""
    chart, y = in_stages(stages, x)
    return chart.in_domain(jnp.concatenate([y, chart.ends[1][None]]))
