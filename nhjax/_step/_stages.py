from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, BoolScalar, FloatScalar
from .._method import AbstractMethod
from .._numerics import max_norm, small_einsum
from .._system import AbstractMechanicalSystem, Linearisation, motion_residual, State
from ._chart import Chart


class Stages(eqx.Module):
    """The unknowns of one step; those that a system or closure lacks are empty.

    - `velocity`: H^1..H^s, the stage velocities in the chart (V^i on R^n).
    - `momentum`: the stage momenta in the body frame, of a Hamiltonian system; those of
        a Lagrangian one follow from the velocities.
    - `node_fibre`: u^2..u^s (v or p) at the nodes, the last of them at the end of the
        step; without nonholonomic constraints only u_{k+1}.
    - `closure`: y, which gives the nonholonomic multipliers
        Λ = (start) λ_k + (end) λ_{k+1} + E y.
    - `holonomic`: the holonomic multipliers Λ^1..Λ^s.
    - `end_acceleration`, `end_multiplier`: u̇ and λ_c at the end of the step, unknowns
        of the symmetric closure alone.
    """

    velocity: Float[Array, "s n"]
    momentum: Float[Array, "s n"]
    node_fibre_coordinate: Float[Array, "r n"]
    closure: Float[Array, "s-1 m"]
    holonomic: Float[Array, "s k"]
    end_acceleration: Float[Array, " n"]
    end_multiplier: Float[Array, " l"]


class StageForces(NamedTuple):
    """The equations of the stages i = 1..s, evaluated."""

    force: Float[Array, "s n"]  # n^i, the force W^i carried to the start of the step
    multiplier: Float[Array, "s l"]  # Λ^i
    residual: Float[Array, "s n"]  # Π^i - base - h Σ â_ij F^j
    momentum: Float[Array, "s n"]  # Π^i, by whose size residuals are judged


class StageSystem(eqx.Module):
    """The discrete equations of one step from (q_k, p_k, λ_k).

    The paper's four Summaries in the unknowns of `Stages`. With w^i the body force at
    stage i (reactions included), n^i = Ad^*_{τ(Ξ^i)⁻¹} w^i and F^i the same force in
    the chart, they read

    Π^i = base + h Σ â_ij F^j,    μ^i = Ad^*_{τ(Ξ^i)} (μ_k + h Σ a_ij n^j),

    with the nonholonomic constraints at the nodes (q^i, μ^i), the holonomic ones at the
    positions Q^i, i >= 2, and their tangency at the end. The constraints at the first
    node hold by hypothesis H1; the last node is the end of the step by H3. The three
    closures differ in the constant matrices of `method.closure_weights` alone.
    """

    system: AbstractMechanicalSystem
    method: AbstractMethod = eqx.field(static=True)
    t: FloatScalar
    h: FloatScalar
    q: PyTree[Array]
    p: Float[Array, " n"]
    multiplier: Float[Array, " l"]
    args: Args

    @classmethod
    def at(
        cls,
        system: AbstractMechanicalSystem,
        method: AbstractMethod,
        t: FloatScalar,
        h: FloatScalar,
        y: State,
        args: Args,
    ) -> "StageSystem":
        """The equations of a step of size h from the state y at t."""
        return cls(system, method, t, h, y.q, y.p, y.multiplier, args)

    def nudged(self, nudge: FloatScalar) -> "StageSystem":
        """The equations with q_k moved by about `nudge` times its size.

        What that changes, over `nudge`, is what the round-off of positions may change,
        over the unit round-off. The moves differ between coordinates, so that they do
        not cancel in the distance of two.
        """
        manifold, n = self.chart.manifold, self.p.shape[0]
        size = max_norm(*jax.tree.leaves(self.q))
        if manifold.is_flat:
            size = jnp.abs(self.q)
        k = np.arange(n)
        moves = (-1.0) ** k * (1 - 0.5 * (0.618 * k % 1))
        xi = nudge * size * jnp.asarray(moves, self.p.dtype)
        return eqx.tree_at(lambda z: z.q, self, manifold.act(self.q, xi))

    @property
    def num_holonomic(self) -> int:
        """k, the number of holonomic constraints."""
        if self.system.holonomic is None:
            return 0
        return jax.eval_shape(
            lambda t, q: self.system.position_constraint(t, q, self.args),
            self.t,
            self.q,
        ).shape[0]

    @property
    def num_nonholonomic(self) -> int:
        """m, the number of nonholonomic constraints."""
        return self.multiplier.shape[0] - self.num_holonomic

    @property
    def constrained(self) -> bool:
        """Whether there are constraints, and so multipliers."""
        return self.multiplier.shape[0] > 0

    @property
    def symmetric(self) -> bool:
        """Whether the continuous multiplier at the end of the step is an unknown."""
        return self.num_nonholonomic > 0 and self.method.closure == "symmetric"

    @property
    def hamiltonian(self) -> bool:
        """Whether stage momenta are unknowns beside the stage velocities."""
        return self.system.fibre_coordinate_name == "p"

    @property
    def chart(self) -> Chart:
        """The chart around q_k."""
        return Chart(self.system.manifold_of(self.q), self.q)

    def coefficients(self, name: str) -> Array:
        """The array `name` of the method, in the working precision."""
        return jnp.asarray(getattr(self.method, name), self.p.dtype)

    def closure_weights(self, name: str) -> Array:
        """The array `name` of the method's closure, in the working precision."""
        return jnp.asarray(getattr(self.method.closure_weights, name), self.p.dtype)

    @property
    def stage_times(self) -> Float[Array, " s"]:
        """t_k + h c_i."""
        return self.t + self.h * self.coefficients("c")

    @property
    def node_weights(self) -> Float[Array, "r s"]:
        """Rows of a_ij at which node momenta are formed: i >= 2, or the weights b."""
        return (
            self.coefficients("a")[1:]
            if self.num_nonholonomic
            else self.coefficients("b")[None]
        )

    @property
    def node_times(self) -> Float[Array, " r"]:
        """Times of those nodes."""
        nodes = (
            self.coefficients("c")[1:]
            if self.num_nonholonomic
            else jnp.ones((1,), self.p.dtype)
        )
        return self.t + self.h * nodes

    def starting_values(self, u: Array, lin: Linearisation) -> Stages:
        """Stages to first order in h, from the acceleration and λ_c at the start.

        They need no memory of the step before, so a step is a function of its state.
        """
        m, s = self.num_nonholonomic, self.method.stages
        push = self.h * lin.acceleration
        stage_times = jnp.sum(self.coefficients("a_hat"), axis=1)
        node_times = jnp.sum(self.node_weights, axis=1)
        # ν of the symmetric closure vanishes with h, all others are multipliers.
        free = (jnp.arange(s - 1) >= int(self.symmetric)).astype(u.dtype)
        nothing = jnp.zeros((0,), u.dtype)
        fibre = u[None] + jnp.outer(stage_times, push)
        velocity, momentum = fibre, jnp.zeros((s, 0), u.dtype)
        if self.hamiltonian:
            velocity, momentum = self._starting_velocities(u, lin, stage_times), fibre
        return Stages(
            velocity=velocity,
            momentum=momentum,
            node_fibre_coordinate=u[None] + jnp.outer(node_times, push),
            closure=jnp.outer(free, lin.multiplier[:m]),
            holonomic=jnp.outer(jnp.ones((s,), u.dtype), lin.multiplier[m:]),
            end_acceleration=lin.acceleration if self.symmetric else nothing,
            end_multiplier=lin.multiplier if self.symmetric else nothing,
        )

    def _starting_velocities(self, u, lin: Linearisation, times) -> Array:
        v = self.system.velocity(self.t, self.q, u, self.args)
        _, rate = jax.jvp(
            lambda t, xi, u: self.system.velocity(
                t, self.chart.manifold.act(self.q, xi), u, self.args
            ),
            (self.t, jnp.zeros_like(u), u),
            (jnp.ones_like(self.t), v, lin.acceleration),
        )
        return v[None] + jnp.outer(times, self.h * rate)

    def multipliers(self, x: Stages) -> Float[Array, "s l"]:
        """Λ^1..Λ^s, from the unknowns of the closure and the holonomic ones."""
        change = self.multiplier_change(x)
        if not self.num_nonholonomic:
            return change
        return self._padded("start", self.multiplier) + change

    def multiplier_change(self, dx: Stages) -> Float[Array, "s l"]:
        """The part of Λ that is linear in the unknowns."""
        change = self.free_multipliers(dx.closure, dx.holonomic)
        if self.symmetric:
            change = change + self._padded("end", dx.end_multiplier)
        return change

    def free_multipliers(
        self, closure: Float[Array, "s-1 m"], holonomic: Float[Array, "s k"]
    ) -> Float[Array, "s l"]:
        """E y beside the holonomic multipliers."""
        if not self.num_nonholonomic:
            return holonomic
        kinematic = small_einsum("sr,rm->sm", self.closure_weights("E"), closure)
        if not self.num_holonomic:
            return kinematic
        return jnp.concatenate([kinematic, holonomic], axis=1)

    def _padded(self, weights: str, multiplier: Float[Array, " l"]) -> Array:
        """What a known multiplier adds to Λ; its holonomic part adds nothing."""
        known = multiplier[: self.num_nonholonomic]
        part = jnp.outer(self.closure_weights(weights), known)
        return jnp.pad(part, ((0, 0), (0, self.num_holonomic)))

    def increment(self, x: Stages) -> Float[Array, " n"]:
        """ξ = h Σ b_j H^j, which takes q_k to q_{k+1}."""
        # h * (b @ H): rounding h b_j once and for all would bias every step.
        return self.h * small_einsum("s,sn->n", self.coefficients("b"), x.velocity)

    def stage_increments(self, x: Stages) -> Float[Array, "s n"]:
        """Ξ^i = h Σ a_ij H^j."""
        return self.h * small_einsum("ij,jn->in", self.coefficients("a"), x.velocity)

    def _node_increments(self, x: Stages) -> Float[Array, "r n"]:
        return self.h * small_einsum("ij,jn->in", self.node_weights, x.velocity)

    def in_chart(self, x: Stages) -> BoolScalar:
        """Whether stages, nodes and end lie where the chart is invertible."""
        increments = [self.stage_increments(x), self.increment(x)[None]]
        return self.chart.in_domain(jnp.concatenate(increments))

    def stage_velocities(self, x: Stages) -> Float[Array, "s n"]:
        """The chart velocities dτ_Ξ⁻¹ D2H(Q^i, P^i) of a Hamiltonian system."""
        xi = self.stage_increments(x)
        v = jax.vmap(lambda t, q, u: self.system.velocity(t, q, u, self.args))(
            self.stage_times, self.chart.positions(xi), x.momentum
        )
        return self.chart.chart_velocities(xi, v)

    def evaluate(self, x: Stages) -> StageForces:
        """n^i, Λ^i, and the residuals of the stage momenta."""
        h, a_hat, b = self.h, self.coefficients("a_hat"), self.coefficients("b")
        multiplier = self.multipliers(x)
        xi = self.stage_increments(x)
        q = self.chart.positions(xi)
        u = (
            x.momentum
            if self.hamiltonian
            else self.chart.body_velocities(xi, x.velocity)
        )
        force, momentum = jax.vmap(
            lambda t, q, u, lam: (
                self.system.stage_force(t, q, u, lam, self.args),
                self.system.momentum(t, q, u, self.args),
            )
        )(self.stage_times, q, u, multiplier)
        momentum, chart_force = self.chart.to_chart(xi, x.velocity, momentum, force)
        transported = self.chart.to_start(xi, force)
        base = self.chart.base_momentum(
            self.increment(x),
            self.p,
            h * small_einsum("s,sn->n", b, transported),
            h * small_einsum("s,sn->n", b, chart_force),
        )
        residual = momentum - (
            base[None] + h * small_einsum("ij,jn->in", a_hat, chart_force)
        )
        return StageForces(transported, multiplier, residual, momentum)

    def node_positions(self, x: Stages) -> PyTree[Array]:
        """q^i at the nodes; the last is q_{k+1}."""
        return self.chart.positions(self._node_increments(x))

    def node_residual(
        self, x: Stages, force: Float[Array, "s n"]
    ) -> Float[Array, "r n"]:
        """p(q^i, u^i) - Ad^*_{τ(Ξ^i)} (p_k + h Σ a_ij n^j) at the nodes."""
        momentum = jax.vmap(lambda t, q, u: self.system.momentum(t, q, u, self.args))(
            self.node_times, self.node_positions(x), x.node_fibre_coordinate
        )
        known = self.p[None] + self.h * small_einsum(
            "ij,jn->in", self.node_weights, force
        )
        carried = jax.vmap(self.chart.to_end)(self._node_increments(x), known)
        return momentum - carried

    def node_constraint(self, x: Stages) -> Float[Array, "r m"]:
        """Φ(q^i, u^i) of the nonholonomic constraints at the nodes."""
        return jax.vmap(
            lambda t, q, u: self.system.kinematic_constraint(t, q, u, self.args)
        )(self.node_times, self.node_positions(x), x.node_fibre_coordinate)

    def holonomic_constraint(self, x: Stages) -> Float[Array, "s k"]:
        """Γ(Q^i) / h, i >= 2, and the tangency at the end of the step.

        Divided by h they are of the size of velocities, as the tangency is.
        """
        positions = self.chart.positions(self.stage_increments(x)[1:])
        on_positions = jax.vmap(
            lambda t, q: self.system.position_constraint(t, q, self.args)
        )(self.stage_times[1:], positions)
        end = jax.tree.map(lambda leaf: leaf[-1], positions)
        tangency = self.system.tangency(
            self.t + self.h, end, x.node_fibre_coordinate[-1], self.args
        )
        return jnp.concatenate([on_positions / self.h, tangency[None]])

    def constraint_jacobian(self, x: Stages) -> Float[Array, "s-1 l n"]:
        """B = ∂Φ/∂u of all constraints on velocities at the nodes i >= 2."""
        times, fibre = self.stage_times[1:], x.node_fibre_coordinate
        if not self.num_nonholonomic:
            fibre = jnp.broadcast_to(fibre, (self.method.stages - 1, fibre.shape[1]))
        positions = self.chart.positions(self.stage_increments(x)[1:])
        return jax.vmap(
            lambda t, q, u: jax.jacrev(self.system.constraint, argnums=2)(
                t, q, u, self.args
            )
        )(times, positions, fibre)

    def end_residual(self, x: Stages) -> tuple[Float[Array, " n"], Float[Array, " l"]]:
        """Residuals of the equations of motion at the end, whose root is λ_c there."""
        return motion_residual(
            self.system,
            self.t + self.h,
            self.chart.manifold.act(self.q, self.increment(x)),
            x.node_fibre_coordinate[-1],
            x.end_acceleration,
            x.end_multiplier,
            self.args,
        )
