"""The data of the equations of one step, and the layout of their unknowns."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import Args, FloatScalar
from .._manifold import AbstractLieGroup, unframed
from .._method import AbstractMethod
from .._numerics import max_norm, small_einsum, uneven_perturbations
from .._system import AbstractMechanicalSystem, Linearisation, State, with_frames
from ._chart import AbstractChart
from ._curved_chart import chart_of_step
from ._invariants import StartImpulses
from ._redundancy import Redundancy
from ._round_off import RoundOff
from ._unknowns import StageUnknowns


class StageEquations(eqx.Module):
    """The discrete equations of one step from (q_k, p_k, λ_k).

    These are the paper's four Summaries in the unknowns of `StageUnknowns`, in the chart of
    the method. With w^i the body force at stage i (reactions included), y^i the
    coordinates of the stage, n^i = Ad^*_{τ(y^i)⁻¹} w^i, F^i the same force in the chart
    and M the momentum μ_k carried to its origin, they read

    Π^i = base + h Σ â_ij F^j,    μ^i = Ad^*_{τ(y^i)} (M + h Σ a_ij n^j),

    together with the nonholonomic constraints at the nodes (q^i, μ^i), the holonomic
    ones at the positions Q^i, i >= 2, and their tangency at the end. The constraints at
    the first node hold by hypothesis H1; the last node is the end of the step by H3.
    Of redundant constraints as many are kept as are independent; see `Redundancy`.
    A closure of the multiplier enters in three places: by the constant matrices of
    `method.closure_weights`; by the multiplier that a state carries, Λ^s for the
    propagated closure and λ_c for the others (`end_state`, `first_step_state`); and, if
    it uses λ_c at the end, by two more unknowns and equations (`symmetric`). To keep
    invariants, momenta receive impulses at both ends of the step; see `InvariantCorrection`.
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
    kept: StartImpulses | None = None
    round_off: RoundOff | None = None

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
        kept: StartImpulses | None = None,
        round_off: RoundOff | None = None,
    ) -> "StageEquations":
        """Make the equations of a step of size h from the state y at t."""
        system, q = with_frames(system, y.q)
        given = t, h, q, y.p, y.multiplier, args
        stages = cls(system, method, *given, kept=kept, round_off=round_off)
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
        """Tell whether there are constraints, and so multipliers."""
        return self.multiplier.shape[0] > 0

    @property
    def symmetric(self) -> bool:
        """Tell whether the symmetric closure is in use.

        The continuous multiplier at the end of the step is then an unknown.
        """
        return self.num_nonholonomic > 0 and self.method.closure == "symmetric"

    @property
    def hamiltonian(self) -> bool:
        """Tell whether the system is Hamiltonian.

        The stage momenta are then unknowns, beside the stage velocities.
        """
        return self.system.fibre_coordinate_name == "p"

    @property
    def manifold(self) -> AbstractLieGroup:
        """Return the configuration space."""
        return self.system.manifold_of(self.q)

    def chart(self, x: StageUnknowns) -> AbstractChart:
        """Make the chart in which the step is written."""
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
        """Return the rows of a_ij for the nodes at which momenta are formed.

        With nonholonomic constraints these are the nodes i >= 2, otherwise only the end
        of the step, whose row is that of the weights b.
        """
        method = self.method
        return method.a[1:] if self.num_nonholonomic else method.b[None]

    @property
    def node_times(self) -> Float[Array, " r"]:
        """Return the times of the nodes at which momenta are formed."""
        nodes = (
            self.coefficients("c")[1:]
            if self.num_nonholonomic
            else jnp.ones((1,), self.p.dtype)
        )
        return self.t + self.h * nodes

    def multipliers(self, x: StageUnknowns) -> Float[Array, "s l"]:
        """Compute the multipliers Λ^1..Λ^s of all constraints at the stages.

        They follow from the unknowns of the closure and the holonomic multipliers.
        """
        change = self.multiplier_change(x)
        if not self.num_nonholonomic:
            return change
        return self._padded("start", self.multiplier) + change

    def multiplier_change(self, dx: StageUnknowns) -> Float[Array, "s l"]:
        """Compute the part of the multipliers Λ that is linear in the unknowns."""
        change = self.free_multipliers(dx.closure, dx.holonomic)
        if self.symmetric:
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
        """Compute what a known multiplier, such as λ_k, adds to Λ.

        Its holonomic part adds nothing.
        """
        known = multiplier[: self.num_nonholonomic]
        part = jnp.outer(self.closure_weights(weights), known)
        return jnp.pad(part, ((0, 0), (0, self.num_holonomic)))

    def increment(self, x: StageUnknowns) -> Float[Array, " n"]:
        """Compute the increment ξ = h Σ b_j H^j, which takes q_k to q_{k+1}."""
        # The product is formed as h * (b @ H): coefficients h b_j, rounded once and for
        # all, would bias every step in the same way.
        return self.h * small_einsum("s,sn->n", self.coefficients("b"), x.velocity)


def nudged(stages: StageEquations, nudge: FloatScalar) -> StageEquations:
    """Return the equations with q_k moved by about `nudge` times its size.

    The change of a solution by this move, divided by `nudge`, estimates its change by
    the round-off of positions, divided by the unit round-off. The coordinates are moved
    by different amounts, so that the moves do not cancel in the difference of two.
    """
    if stages.manifold.is_flat:
        moves = uneven_perturbations(stages.q)
        moved = jax.tree.map(lambda x, dx: x + nudge * dx, stages.q, moves)
    else:
        size = max_norm(*jax.tree.leaves(unframed(stages.q)))
        xi = nudge * uneven_perturbations(jnp.broadcast_to(size, stages.p.shape))
        moved = stages.manifold.act(stages.q, xi)
    return replace(stages, q=moved)
