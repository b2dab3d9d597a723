"""The equations of one step, as functions of its unknowns."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from .._custom_types import BoolScalar
from .._numerics import small_einsum
from .._system import motion_residual, whole_force
from ._chart import positions
from ._stage_system import StageSystem
from ._unknowns import StageForces, Stages


def stage_velocities(stages: StageSystem, x: Stages) -> Float[Array, "s n"]:
    """The chart velocities dτ_Ξ⁻¹ D2H(Q^i, P^i) of a Hamiltonian system."""
    xi = stages.stage_increments(x)
    v = jax.vmap(lambda t, q, u: stages.system.velocity(t, q, u, stages.args))(
        stages.stage_times, positions(stages.chart, xi), x.momentum
    )
    return stages.chart.chart_velocities(xi, v)


def stage_forces(stages: StageSystem, x: Stages) -> StageForces:
    """n^i, Λ^i, and the residuals of the stage momenta."""
    h, a_hat, b = stages.h, stages.coefficients("a_hat"), stages.coefficients("b")
    multiplier = stages.multipliers(x)
    xi = stages.stage_increments(x)
    q = positions(stages.chart, xi)
    u = (
        x.momentum
        if stages.hamiltonian
        else stages.chart.body_velocities(xi, x.velocity)
    )
    force, momentum = jax.vmap(
        lambda t, q, u, lam: (
            whole_force(stages.system, t, q, u, lam, stages.args),
            stages.system.momentum(t, q, u, stages.args),
        )
    )(stages.stage_times, q, u, multiplier)
    momentum, chart_force = stages.chart.to_chart(xi, x.velocity, momentum, force)
    transported = stages.chart.to_start(xi, force)
    base = stages.chart.base_momentum(
        stages.increment(x),
        stages.p,
        h * small_einsum("s,sn->n", b, transported),
        h * small_einsum("s,sn->n", b, chart_force),
    )
    residual = momentum - (
        base[None] + h * small_einsum("ij,jn->in", a_hat, chart_force)
    )
    return StageForces(transported, multiplier, residual, momentum)


def node_positions(stages: StageSystem, x: Stages) -> PyTree[Array]:
    """q^i at the nodes; the last is q_{k+1}."""
    return positions(stages.chart, stages.node_increments(x))


def node_residual(
    stages: StageSystem, x: Stages, force: Float[Array, "s n"]
) -> Float[Array, "r n"]:
    """p(q^i, u^i) - Ad^*_{τ(Ξ^i)} (p_k + h Σ a_ij n^j) at the nodes."""
    momentum = jax.vmap(lambda t, q, u: stages.system.momentum(t, q, u, stages.args))(
        stages.node_times, node_positions(stages, x), x.node_fibre_coordinate
    )
    known = stages.p[None] + stages.h * small_einsum(
        "ij,jn->in", stages.node_weights, force
    )
    carried = jax.vmap(stages.chart.to_end)(stages.node_increments(x), known)
    return momentum - carried


def node_constraint(stages: StageSystem, x: Stages) -> Float[Array, "r m"]:
    """Φ(q^i, u^i) of the nonholonomic constraints at the nodes."""
    return jax.vmap(
        lambda t, q, u: stages.system.kinematic_constraint(t, q, u, stages.args)
    )(stages.node_times, node_positions(stages, x), x.node_fibre_coordinate)


def holonomic_constraint(stages: StageSystem, x: Stages) -> Float[Array, "s k"]:
    """Γ(Q^i) / h, i >= 2, and the tangency at the end of the step.

    Divided by h they are of the size of velocities, as the tangency is.
    """
    nodes = positions(stages.chart, stages.stage_increments(x)[1:])
    on_positions = jax.vmap(
        lambda t, q: stages.system.position_constraint(t, q, stages.args)
    )(stages.stage_times[1:], nodes)
    end = jax.tree.map(lambda leaf: leaf[-1], nodes)
    tangency = stages.system.tangency(
        stages.t + stages.h, end, x.node_fibre_coordinate[-1], stages.args
    )
    return jnp.concatenate([on_positions / stages.h, tangency[None]])


def constraint_jacobian(stages: StageSystem, x: Stages) -> Float[Array, "s-1 l n"]:
    """B = ∂Φ/∂u of all constraints on velocities at the nodes i >= 2."""
    times, fibre = stages.stage_times[1:], x.node_fibre_coordinate
    if not stages.num_nonholonomic:
        fibre = jnp.broadcast_to(fibre, (stages.method.stages - 1, fibre.shape[1]))
    nodes = positions(stages.chart, stages.stage_increments(x)[1:])
    return jax.vmap(
        lambda t, q, u: jax.jacrev(stages.system.constraint, argnums=2)(
            t, q, u, stages.args
        )
    )(times, nodes, fibre)


def end_residual(
    stages: StageSystem, x: Stages
) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
    """Residuals of the equations of motion at the end, whose root is λ_c there."""
    return motion_residual(
        stages.system,
        stages.t + stages.h,
        stages.chart.manifold.act(stages.q, stages.increment(x)),
        x.node_fibre_coordinate[-1],
        x.end_acceleration,
        x.end_multiplier,
        stages.args,
    )


def in_chart(stages: StageSystem, x: Stages) -> BoolScalar:
    """Whether stages, nodes and end lie where the chart is invertible."""
    increments = [stages.stage_increments(x), stages.increment(x)[None]]
    return stages.chart.in_domain(jnp.concatenate(increments))
