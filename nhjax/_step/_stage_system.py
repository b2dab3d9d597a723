"""What the equations of one step are made of, and how their unknowns are laid out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalar
from .._method import AbstractMethod
from .._numerics import max_norm, small_einsum
from .._system import AbstractMechanicalSystem, State
from ._chart import AbstractChart, chart_at
from ._unknowns import Stages


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
    def chart(self) -> AbstractChart:
        """The chart around q_k."""
        return chart_at(self.system.manifold_of(self.q), self.q)

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

    def node_increments(self, x: Stages) -> Float[Array, "r n"]:
        """h Σ a_ij H^j at the nodes."""
        return self.h * small_einsum("ij,jn->in", self.node_weights, x.velocity)


def nudged(stages: StageSystem, nudge: FloatScalar) -> StageSystem:
    """The equations with q_k moved by about `nudge` times its size.

    What that changes, over `nudge`, is what the round-off of positions may change,
    over the unit round-off. The moves differ between coordinates, so that they do not
    cancel in the distance of two.
    """
    manifold, n = stages.chart.manifold, stages.p.shape[0]
    size = max_norm(*jax.tree.leaves(stages.q))
    if manifold.is_flat:
        size = jnp.abs(stages.q)
    k = np.arange(n)
    moves = (-1.0) ** k * (1 - 0.5 * (0.618 * k % 1))
    xi = nudge * size * jnp.asarray(moves, stages.p.dtype)
    return eqx.tree_at(lambda z: z.q, stages, manifold.act(stages.q, xi))
