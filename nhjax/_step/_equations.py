"""The equations of one step: their unknowns, their data and their residuals."""

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from .._compile import vmapped
from .._custom_types import Args, BoolScalar, FloatScalar
from .._manifold import AbstractLieGroup, unframed
from .._method import AbstractMethod
from .._numerics import (
    jacobian_by_rows,
    max_norm,
    nonzero_or_one,
    small_einsum,
    sparse_jacobian,
    SparseMatrix,
    SparsityPattern,
    stop_gradient,
    uneven_perturbations,
)
from .._system import (
    AbstractMechanicalSystem,
    force_by_multiplier,
    FunctionNoise,
    Linearisation,
    motion_residual,
    State,
    total_force,
    with_frames,
)
from ._chart import AbstractChart, chart_of_step
from ._invariants import InvariantCorrection, InvariantsAtStart, moving_part
from ._redundancy import Redundancy


T = TypeVar("T")


class StageUnknowns(eqx.Module):
    """The unknowns of one step: velocities, momenta and multipliers.

    An unknown that does not occur with the given system or closure is an empty array.

    - `velocity`: H^1..H^s, the stage velocities in the chart (V^i on R^n).
    - `momentum`: the stage momenta in the body frame, for Hamiltonian systems. For
        Lagrangian systems they follow from the velocities.
    - `node_fibre_coordinate`: u^2..u^s (v or p) at the nodes. The last node is the end
        of the step. Without nonholonomic constraints there is only u_{k+1}.
    - `closure`: y, the unknowns of the closure. The nonholonomic multipliers are
        Λ = (start) λ_k + (end) λ_{k+1} + E y, where start, end and E are the constant
        matrices of `method.closure_weights`.
    - `holonomic`: the holonomic multipliers Λ^1..Λ^s.
    - `end_acceleration`, `end_multiplier`: u̇ and λ_c, the acceleration and multiplier
        of the continuous equations at the end of the step; only the symmetric closure
        has these unknowns.
    - `impulse`: ε, the factors of the impulses ε ω at both ends of the step, with ω
        from `Directions`; None if the run keeps no invariants.
    """

    velocity: Float[Array, "s n"]
    momentum: Float[Array, "s p"]
    node_fibre_coordinate: Float[Array, "r n"]
    closure: Float[Array, "c m"]
    holonomic: Float[Array, "s k"]
    end_acceleration: Float[Array, " a"]
    end_multiplier: Float[Array, " e"]
    # The type is `PyTree`, so that None, an empty tree, is allowed.
    impulse: PyTree[Float[Array, " i"]] = None


class StageForces(NamedTuple):
    """The forces, multipliers and momenta at the stages i = 1..s, with residuals.

    `StageEquations` explains the symbols.
    """

    force: Float[Array, "s n"]  # n^i, the body force w^i carried to the chart's origin
    multiplier: Float[Array, "s l"]  # Λ^i
    residual: Float[Array, "s n"]  # Π^i - base - h Σ â_ij F^j
    momentum: Float[Array, "s n"]  # Π^i, the scale of the residuals


class StageEquations(eqx.Module):
    """The discrete equations of one step from (q_k, p_k, λ_k).

    These are the equations of the four Summaries of the paper, for the `StageUnknowns`
    in the chart of the method. Let y^i be the coordinates of stage i in the chart, and
    Π^i its momentum in the chart. Let w^i be the body force at stage i, including
    reactions, let n^i = Ad^*_{τ(y^i)⁻¹} w^i be this force carried to the origin of the
    chart, and let F^i be the force in the chart, from `AbstractChart.to_chart`. Let μ^i
    be the body momentum at node i, and M the momentum μ_k at the start of the step,
    carried to the origin. With `base` from `AbstractChart.base_momentum`, the equations
    are

    Π^i = base + h Σ â_ij F^j,    μ^i = Ad^*_{τ(y^i)} (M + h Σ a_ij n^j),

    the nonholonomic constraints at the nodes (q^i, μ^i), the holonomic constraints at
    the positions Q^i, i >= 2, and the time derivative of the holonomic constraints at
    the end. The first node is the start of the step (hypothesis H1, see `Hypotheses`),
    where the constraints hold already. The last node is the end (H3). With redundant
    constraints, only as many equations as are independent are enforced; see
    `Redundancy`.

    The closure of the multiplier enters in three places:

    - the constant matrices of `method.closure_weights`;
    - the multiplier of a `State`, which is Λ^s for the propagated closure and λ_c for
        the other closures (`end_state`, `first_step_state`);
    - two more unknowns and equations if the closure uses λ_c at the end
        (`end_multiplier_is_unknown`).

    If the run keeps invariants, the momenta receive impulses at both ends of the step;
    see `InvariantCorrection`.
    """

    system: AbstractMechanicalSystem
    method: AbstractMethod = eqx.field(static=True)
    t: FloatScalar
    h: FloatScalar
    q: PyTree[Array]
    p: Float[Array, " n"]
    multiplier: Float[Array, " l"]
    args: Args
    redundancy: Redundancy | None = None
    invariants: InvariantsAtStart | None = None
    noise: FunctionNoise | None = None

    @classmethod
    def at(
        cls,
        system: AbstractMechanicalSystem,
        method: AbstractMethod,
        t: FloatScalar,
        h: FloatScalar,
        y: State,
        args: Args,
        lin: Linearisation,
        invariants: InvariantsAtStart | None = None,
        noise: FunctionNoise | None = None,
    ) -> "StageEquations":
        """Build the equations of a step of size h from the state y at t."""
        system, q = with_frames(system, y.q)
        given = t, h, q, y.p, y.multiplier, args
        stages = cls(system, method, *given, invariants=invariants, noise=noise)
        if system.constraints != "redundant" or not stages.constrained:
            return stages
        redundancy = Redundancy.at(lin, stages.num_nonholonomic)
        return replace(stages, redundancy=redundancy)

    @property
    def num_holonomic(self) -> int:
        """Return k, the number of holonomic constraints."""
        if self.system.holonomic is None:
            return 0
        return jax.eval_shape(
            lambda t, q: self.system.position_constraint(t, q, self.args),
            self.t,
            self.q,
        ).shape[0]

    @property
    def num_nonholonomic(self) -> int:
        """Return m, the number of nonholonomic constraints."""
        return self.multiplier.shape[0] - self.num_holonomic

    @property
    def constrained(self) -> bool:
        """Return whether there are constraints, and therefore multipliers."""
        return self.multiplier.shape[0] > 0

    @property
    def end_multiplier_is_unknown(self) -> bool:
        """Return whether λ_c at the end of the step is an unknown.

        Only the symmetric closure has this unknown.
        """
        return self.num_nonholonomic > 0 and self.method.closure == "symmetric"

    @property
    def hamiltonian(self) -> bool:
        """Return whether the system is Hamiltonian.

        In a Hamiltonian system the stage momenta are unknowns, in addition to the stage
        velocities.
        """
        return self.system.fibre_coordinate_name == "p"

    @property
    def manifold(self) -> AbstractLieGroup:
        """Return the configuration space."""
        return self.system.manifold_of(self.q)

    def chart(self, x: StageUnknowns) -> AbstractChart:
        """Build the chart in which the step is written."""
        return chart_of_step(
            self.manifold, self.method.chart, self.q, self.increment(x)
        )

    def coefficients(self, name: str) -> Array:
        """Return the array `name` of the method in the working precision."""
        return jnp.asarray(getattr(self.method, name), self.p.dtype)

    def closure_weights(self, name: str) -> Array:
        """Return the array `name` of the closure's weights in the working precision."""
        return jnp.asarray(getattr(self.method.closure_weights, name), self.p.dtype)

    @property
    def stage_times(self) -> Float[Array, " s"]:
        """Return the times t_k + h c_i of the stages."""
        return self.t + self.h * self.coefficients("c")

    @property
    def node_weights(self) -> Float[Array, "r s"]:
        """Return `node_rows` in the working precision."""
        return jnp.asarray(self.node_rows, self.p.dtype)

    @property
    def node_rows(self) -> np.ndarray:
        """Return the rows of a_ij for the nodes at which momenta are computed.

        With nonholonomic constraints these are the nodes i >= 2. Otherwise the end of
        the step is the only such node, and its row contains the weights b.
        """
        method = self.method
        return method.a[1:] if self.num_nonholonomic else method.b[None]

    @property
    def node_times(self) -> Float[Array, " r"]:
        """Return the times of the nodes at which momenta are computed."""
        nodes = (
            self.coefficients("c")[1:]
            if self.num_nonholonomic
            else jnp.ones((1,), self.p.dtype)
        )
        return self.t + self.h * nodes

    def multipliers(self, x: StageUnknowns) -> Float[Array, "s l"]:
        """Compute the multipliers Λ^1..Λ^s of all constraints at the stages."""
        change = self.multiplier_change(x)
        if not self.num_nonholonomic:
            return change
        return self._padded("start", self.multiplier) + change

    def multiplier_change(self, dx: StageUnknowns) -> Float[Array, "s l"]:
        """Compute the part of the multipliers Λ that is linear in the unknowns."""
        change = self.free_multipliers(dx.closure, dx.holonomic)
        if self.end_multiplier_is_unknown:
            change = change + self._padded("end", dx.end_multiplier)
        return change

    def free_multipliers(
        self, closure: Float[Array, "c m"], holonomic: Float[Array, "s k"]
    ) -> Float[Array, "s l"]:
        """Join the nonholonomic multipliers E y and the holonomic multipliers."""
        if not self.num_nonholonomic:
            return holonomic
        kinematic = small_einsum("sr,rm->sm", self.closure_weights("E"), closure)
        if not self.num_holonomic:
            return kinematic
        return jnp.concatenate([kinematic, holonomic], axis=1)

    def _padded(self, weights: str, multiplier: Float[Array, " l"]) -> Array:
        """Compute the part of Λ that comes from `multiplier`, λ_k or λ_{k+1}.

        The holonomic multipliers do not depend on it.
        """
        known = multiplier[: self.num_nonholonomic]
        part = jnp.outer(self.closure_weights(weights), known)
        return jnp.pad(part, ((0, 0), (0, self.num_holonomic)))

    def increment(self, x: StageUnknowns) -> Float[Array, " n"]:
        """Compute the increment ξ = h Σ b_j H^j from q_k to q_{k+1}."""
        # The product is h * (b @ H). The rounding errors of precomputed coefficients
        # h b_j would be the same in every step, and add up.
        return self.h * small_einsum("s,sn->n", self.coefficients("b"), x.velocity)


def stage_velocities(stages: StageEquations, x: StageUnknowns) -> Float[Array, "s n"]:
    """Compute the chart velocities dτ_y⁻¹ D2H(Q^i, P^i) of a Hamiltonian system."""
    chart, y = stage_coordinates(stages, x)
    v = vmapped(
        lambda t, q, u: stages.system.velocity(t, q, u, stages.args),
        stages.stage_times,
        stage_positions(stages, chart, y),
        x.momentum,
    )
    return chart.chart_velocities(y, v)


def stage_forces(stages: StageEquations, x: StageUnknowns) -> StageForces:
    """Compute the forces n^i, multipliers Λ^i and residuals of the stage momenta."""
    h, a_hat, b = stages.h, stages.coefficients("a_hat"), stages.coefficients("b")
    multiplier = stages.multipliers(x)
    chart, y = stage_coordinates(stages, x)
    q = stage_positions(stages, chart, y)
    u = x.momentum if stages.hamiltonian else chart.body_velocities(y, x.velocity)
    force, momentum = vmapped(
        lambda t, q, u, lam: (
            total_force(stages.system, t, q, u, lam, stages.args),
            stages.system.momentum(t, q, u, stages.args),
        ),
        stages.stage_times,
        q,
        u,
        multiplier,
    )
    momentum, chart_force = chart.to_chart(y, x.velocity, momentum, force)
    transported = chart.to_origin(y, force)
    base = chart.base_momentum(
        chart.momentum_at_origin(start_momentum(stages, x)),
        h * small_einsum("s,sn->n", b, transported),
        h * small_einsum("s,sn->n", b, chart_force),
    )
    residual = momentum - (
        base[None] + h * small_einsum("ij,jn->in", a_hat, chart_force)
    )
    return StageForces(transported, multiplier, residual, momentum)


def forces_by_multiplier(
    stages: StageEquations, x: StageUnknowns
) -> Float[Array, "s l n"] | None:
    """Compute ∂F/∂Λ at the stages, a row for each multiplier.

    The result is None if the forces do not depend on the multipliers.
    """
    if not stages.system.force_takes_multipliers or not stages.constrained:
        return None
    chart, y = stage_coordinates(stages, x)
    u = x.momentum if stages.hamiltonian else chart.body_velocities(y, x.velocity)
    return vmapped(
        lambda t, q, u, lam: (
            force_by_multiplier(stages.system, t, q, u, lam, stages.args).T
        ),
        stages.stage_times,
        stage_positions(stages, chart, y),
        u,
        stages.multipliers(x),
    )


def momenta_of_forces(
    stages: StageEquations, x: StageUnknowns, forces: Float[Array, "s n c"]
) -> tuple[Float[Array, "s n c"], Float[Array, "r n c"]]:
    """Compute 1/h times the momenta that stage forces cause at stages and nodes.

    On a Lie group, the chart transports the forces between stages, which adds a term of
    order h.
    """
    a_hat, b = stages.coefficients("a_hat"), stages.coefficients("b")
    if stages.manifold.is_flat:
        return (
            small_einsum("ij,jnc->inc", a_hat, forces),
            small_einsum("ij,jnc->inc", stages.node_weights, forces),
        )
    chart, y = stage_coordinates(stages, x)
    nodes = node_coordinates(stages, x)[1]

    def one(force):
        zero = jnp.zeros_like(force)
        _, chart_force = chart.to_chart(y, zero, zero, force)
        carried = chart.to_origin(y, force)
        sums = (
            small_einsum("ij,jn->in", b[None], part)[0]
            for part in (carried, chart_force)
        )
        base = chart.base_momentum(zero[0], *sums)
        on_nodes = chart.from_origin(
            nodes, small_einsum("ij,jn->in", stages.node_weights, carried)
        )
        return base[None] + small_einsum("ij,jn->in", a_hat, chart_force), on_nodes

    return jax.vmap(one, in_axes=2, out_axes=2)(forces)


def node_residual(
    stages: StageEquations, x: StageUnknowns, force: Float[Array, "s n"]
) -> Float[Array, "r n"]:
    """Compute the residuals of the momentum equations at the nodes.

    They are p(q^i, u^i) - Ad^*_{τ(y^i)} (M + h Σ a_ij n^j). At the end of the step the
    impulse is subtracted too.
    """
    chart, y = node_coordinates(stages, x)
    momentum = vmapped(
        lambda t, q, u: stages.system.momentum(t, q, u, stages.args),
        stages.node_times,
        chart.positions(y),
        x.node_fibre_coordinate,
    )
    start = chart.momentum_at_origin(start_momentum(stages, x))
    gained = stages.h * small_einsum("ij,jn->in", stages.node_weights, force)
    residual = momentum - chart.from_origin(y, start[None] + gained)
    if stages.invariants is None:
        return residual
    last = residual[-1:] - end_impulse(stages, x)[None]
    return jnp.concatenate([residual[:-1], last])


def constraint_values(stages: StageEquations, x: StageUnknowns) -> tuple[Array, Array]:
    """Compute the values of the nonholonomic and of the holonomic constraints."""
    none = jnp.zeros((0,), stages.p.dtype)
    return (
        node_constraint(stages, x) if stages.num_nonholonomic else none,
        holonomic_constraint(stages, x) if stages.num_holonomic else none,
    )


def node_constraint(stages: StageEquations, x: StageUnknowns) -> Float[Array, "r m"]:
    """Compute the nonholonomic constraints Φ(q^i, u^i) at the nodes."""
    chart, y = node_coordinates(stages, x)
    values = vmapped(
        lambda t, q, u: stages.system.kinematic_constraint(t, q, u, stages.args),
        stages.node_times,
        chart.positions(y),
        x.node_fibre_coordinate,
    )
    if stages.redundancy is None:
        return values
    return stages.redundancy.reduced(values, stages.h * x.closure, 0)


def holonomic_constraint(
    stages: StageEquations, x: StageUnknowns
) -> Float[Array, "s k"]:
    """Compute Γ(Q^i) / h for i >= 2, and the rate dΓ/dt at the end of the step.

    The division by h gives all values the unit of dΓ/dt.
    """
    chart, y = stage_coordinates(stages, x)
    nodes = chart.positions(y[1:])
    on_positions = vmapped(
        lambda t, q: stages.system.position_constraint(t, q, stages.args),
        stages.stage_times[1:],
        nodes,
    )
    end = jax.tree.map(lambda leaf: leaf[-1], nodes)
    rate = stages.system.holonomic_rate(
        stages.t + stages.h, end, x.node_fibre_coordinate[-1], stages.args
    )
    values = jnp.concatenate([on_positions / stages.h, rate[None]])
    if stages.redundancy is None:
        return values
    m = stages.num_nonholonomic
    return stages.redundancy.reduced(values, stages.h * x.holonomic, m)


def end_residual(
    stages: StageEquations, x: StageUnknowns
) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
    """Compute the residuals of the equations of motion at the end of the step.

    They vanish if `x` has the acceleration and the continuous multiplier λ_c there.
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


def invariant_errors(stages: StageEquations, x: StageUnknowns) -> Float[Array, " k"]:
    """Compute the errors of the invariants at the end of a step."""
    assert stages.invariants is not None
    return stages.invariants.functions.tangent_error(*_end_point(stages, x))


def constraint_jacobian(
    stages: StageEquations, x: StageUnknowns
) -> Float[Array, "r l n"]:
    """Compute B = ∂Φ/∂u at the nodes i >= 2, where Φ are all velocity constraints."""
    return _at_nodes(
        stages, x, lambda constraint: lambda u: jacobian_by_rows(constraint, u)
    )


def sparse_constraint_jacobian(
    stages: StageEquations, x: StageUnknowns, pattern: SparsityPattern
) -> SparseMatrix:
    """Compute B = ∂Φ/∂u at the nodes i >= 2 as a sparse matrix of known `pattern`."""
    return _at_nodes(
        stages,
        x,
        lambda constraint: lambda u: sparse_jacobian(constraint, u, pattern),
    )


def _at_nodes(
    stages: StageEquations,
    x: StageUnknowns,
    differentiated: Callable[..., Callable[..., T]],
) -> T:
    times, u = stages.stage_times[1:], x.node_fibre_coordinate
    if not stages.num_nonholonomic:
        u = jnp.broadcast_to(u, (stages.method.stages - 1, u.shape[1]))
    chart, y = stage_coordinates(stages, x)
    nodes = chart.positions(y[1:])
    return vmapped(
        lambda t, q, u: differentiated(
            lambda u: stages.system.constraint(t, q, u, stages.args)
        )(u),
        times,
        nodes,
        u,
    )


def start_impulse(stages: StageEquations, x: StageUnknowns) -> Float[Array, " n"]:
    """Compute the impulse ε ω_k at the start of a step; see `Directions` for ω."""
    assert stages.invariants is not None
    return small_einsum("k,kn->n", x.impulse, stages.invariants.covectors)


def start_momentum(stages: StageEquations, x: StageUnknowns) -> Float[Array, " n"]:
    """Compute the momentum after the impulse at the start of the step."""
    return (
        stages.p if stages.invariants is None else stages.p + start_impulse(stages, x)
    )


def end_impulse(stages: StageEquations, x: StageUnknowns) -> Float[Array, " n"]:
    """Compute the impulse ε ω_{k+1} at the end of the step; see `Directions` for ω."""
    _, covectors = end_slopes(stages, x)
    return small_einsum("k,kn->n", x.impulse, covectors)


def end_slopes(
    stages: StageEquations, x: StageUnknowns
) -> tuple[Float[Array, "k n"], Float[Array, "k n"]]:
    """Compute the slopes and covectors of `Directions` at the end of a step."""
    assert stages.invariants is not None
    found = stages.invariants.functions.directions(*_end_point(stages, x))
    return found.slopes, found.covectors


def invariant_correction(
    stages: StageEquations, x: StageUnknowns
) -> InvariantCorrection:
    """Linearise the equations for the impulses of a step, near the given stages."""
    assert stages.invariants is not None
    slopes, covectors = end_slopes(stages, x)
    moving = moving_part(slopes, x.node_fibre_coordinate[-1])
    given = slopes, covectors, moving, stages.hamiltonian
    return InvariantCorrection.at(stages.invariants, *given)


def _end_point(stages: StageEquations, x: StageUnknowns) -> tuple[Any, ...]:
    """Return (system, t, q, u, args) at the end of the step."""
    assert stages.invariants is not None
    end = stages.chart(x).advance(*stages.invariants.position)
    q = stages.manifold.wrapped(*end)
    u = x.node_fibre_coordinate[-1]
    return stages.system, stages.t + stages.h, q, u, stages.args


def is_in_chart(stages: StageEquations, x: StageUnknowns) -> BoolScalar:
    """Return whether the stages and the end lie where the chart is invertible."""
    chart, y = stage_coordinates(stages, x)
    return chart.in_domain(jnp.concatenate([y, chart.ends[1][None]]))


def stage_coordinates(
    stages: StageEquations, x: StageUnknowns
) -> tuple[AbstractChart, Float[Array, "s n"]]:
    """Return the chart and the coordinates y^i of the stages, from h Σ a_ij H^j."""
    return _coordinates(stages, x, stages.method.a)


def node_coordinates(
    stages: StageEquations, x: StageUnknowns
) -> tuple[AbstractChart, Float[Array, "r n"]]:
    """Return the chart and the coordinates of the nodes of `node_rows`."""
    return _coordinates(stages, x, stages.node_rows)


def _coordinates(
    stages: StageEquations, x: StageUnknowns, rows: np.ndarray
) -> tuple[AbstractChart, Float[Array, "r n"]]:
    chart = stages.chart(x)
    start, end = chart.ends
    # A node at an end of the step uses the same array of coordinates as the chart, so
    # that the compiler merges the operations on both.
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


def stage_positions(
    stages: StageEquations, chart: AbstractChart, y: Float[Array, "s n"]
) -> PyTree[Array]:
    """Compute the positions of the stages. If c_1 = 0, the first one is q_k."""
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


def with_moved_positions(stages: StageEquations, nudge: FloatScalar) -> StageEquations:
    """Return the equations with q_k moved by about `nudge` times its size.

    The resulting change of the solution, divided by `nudge` and multiplied by the unit
    round-off, estimates the effect of the round-off of positions. The coordinates move
    by different amounts, so that the moves do not cancel in a difference of two
    coordinates.
    """
    if stages.manifold.is_flat:
        moves = uneven_perturbations(stages.q)
        moved = jax.tree.map(lambda x, dx: x + nudge * dx, stages.q, moves)
    else:
        size = max_norm(*jax.tree.leaves(unframed(stages.q)))
        xi = nudge * uneven_perturbations(jnp.broadcast_to(size, stages.p.shape))
        moved = stages.manifold.act(stages.q, xi)
    return replace(stages, q=moved)


class Evaluation(NamedTuple):
    """The stage equations, evaluated by a stage solver at its last iterate.

    `newton` says whether Newton's method had to take over from simplified Newton.
    """

    forces: StageForces
    node_residual: Float[Array, "r n"]
    newton: BoolScalar


class StageResiduals(NamedTuple):
    """The residuals of all equations of a step.

    If the step does not have the equations of a field, the field is None, or an empty
    array for `kinematic` and `holonomic`.

    - `momentum`, `node`: of the momentum equations at the stages and nodes.
    - `velocity`: of the stage velocities, for Hamiltonian systems.
    - `kinematic`, `holonomic`: the values of the constraints.
    - `end`: of the equations of motion at the end, for the symmetric closure.
    - `impulse`: of the equations for the impulses that keep invariants.
    """

    momentum: Float[Array, "s n"]
    node: Float[Array, "r n"]
    velocity: Float[Array, "s n"] | None
    kinematic: Float[Array, "r m"] | Float[Array, "0"]
    holonomic: Float[Array, "s k"] | Float[Array, "0"]
    end: tuple[Float[Array, " n"], Float[Array, " l"]] | None
    impulse: Float[Array, " i"] | None


def stage_residuals(
    stages: StageEquations, x: StageUnknowns
) -> tuple[StageResiduals, Evaluation]:
    """Evaluate all equations of a step at the unknowns x."""
    forces = stage_forces(stages, x)
    r_nodes = node_residual(stages, x, forces.force)
    velocity = end = impulse = None
    if stages.hamiltonian:
        velocity = x.velocity - stage_velocities(stages, x)
    kinematic, holonomic = constraint_values(stages, x)
    if stages.end_multiplier_is_unknown:
        end = end_residual(stages, x)
    if stages.invariants is not None:
        # Simplified Newton solves the same equation for the impulses.
        weights = stop_gradient(invariant_correction(stages, x))
        impulse = -weights.change(x.impulse, invariant_errors(stages, x))
    given = forces.residual, r_nodes, velocity, kinematic, holonomic, end, impulse
    return (
        StageResiduals(*given),
        Evaluation(forces, r_nodes, jnp.asarray(False)),
    )


def stage_residual(
    stages: StageEquations, x: StageUnknowns
) -> tuple[Float[Array, " k"], Evaluation]:
    """Evaluate all equations of a step in one vector.

    The paper lists these equations in its four summaries. Your own stage solver looks
    for the x at which this vector vanishes; see the page on extending in the
    documentation.

    **Arguments:**

    - `stages`: the equations of the step, an argument of `AbstractStageSolver.solve`.
    - `x`: the unknowns, a pytree with the structure of the starting values, which are
        another argument of `solve`.

    **Returns:** the residuals, of shape (k,) if `x` has k numbers, in the units of
    momenta and of the constraints; and intermediate values, which `solve` must return
    in the field `aux` of `Solved`.

    !!! example

        >>> import nhjax
        >>> import equinox as eqx
        >>> class Checked(nhjax.AbstractStageSolver):
        ...     solver: nhjax.Newton = nhjax.Newton()
        ...     max_iterations: int = eqx.field(static=True, default=30)
        ...     tolerance: float = 0.0
        ...     def solve(self, stages, x0, lin, skip):
        ...         r, _ = nhjax.stage_residual(stages, x0)
        ...         assert r.shape == (20,)
        ...         return self.solver.solve(stages, x0, lin, skip)
        ...     def frozen_newton_map(self, stages, lin, x):
        ...         return self.solver.frozen_newton_map(stages, lin, x)
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...     disc.initial_state(), dt=0.1, num_steps=1, stage_solver=Checked())
        >>> int(sol.stats["num_steps"])
        1
    """
    residuals, evaluation = stage_residuals(stages, x)
    return ravel_pytree(residuals)[0], evaluation


def unknown_units(stages: StageEquations, lin: Linearisation) -> list[FloatScalar]:
    """Return how much each field of `StageUnknowns` must change to change u by one.

    Multipliers are measured by their effect h N⁻¹ R δΛ on u, with the matrices of
    `Linearisation`. The round-off of a multiplier grows like 1 / h. If changes were
    measured relative to the multiplier itself, this round-off would look like an
    iteration that does not converge.
    """
    h = jnp.abs(stages.h)
    one = jnp.ones_like(h)
    velocity = one
    if stages.hamiltonian:
        velocity = 1 / nonzero_or_one(lin.fibre_hessian_inverse.largest_entry_bound())
    multiplier = 1 / nonzero_or_one(h * lin.reaction.largest_entry_bound())
    units = {
        "velocity": velocity,
        "momentum": one,
        "node_fibre_coordinate": one,
        "closure": multiplier,
        "holonomic": multiplier,
        "end_acceleration": 1 / nonzero_or_one(h),
        "end_multiplier": multiplier,
    }
    if stages.invariants is not None:
        largest = max_norm(lin.momentum_inverse.matvec(stages.invariants.covectors))
        units["impulse"] = 1 / nonzero_or_one(largest)
    names = [field.name for field in dataclasses.fields(StageUnknowns)]
    return [units[name] for name in names if name in units]
