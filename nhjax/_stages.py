from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._custom_types import Args, FloatScalar
from ._linearisation import Linearisation, motion_residual
from ._method import AbstractMethod
from ._system import LagrangianSystem


class Stages(eqx.Module):
    """The unknowns of one step; those that a system or closure lacks are empty.

    - `velocity`: V^1..V^s, the stage velocities.
    - `node_velocity`: v^2..v^s at the constrained nodes, the last of them v_{k+1};
        without constraints only v_{k+1}.
    - `closure`: y, which gives Λ = (start) λ_k + (end) λ_{k+1} + E y.
    - `end_acceleration`, `end_multiplier`: the acceleration and λ_c at
        (q_{k+1}, v_{k+1}), unknowns of the symmetric closure alone.
    """

    velocity: Float[Array, "s n"]
    node_velocity: Float[Array, "r n"]
    closure: Float[Array, "s-1 m"]
    end_acceleration: Float[Array, " n"]
    end_multiplier: Float[Array, " m"]


class StageForces(NamedTuple):
    """The equations of the stages i = 1..s, evaluated."""

    force: Float[Array, "s n"]  # W^i
    multiplier: Float[Array, "s m"]  # Λ^i
    residual: Float[Array, "s n"]  # P^i - p_k - h Σ â_ij W^j
    momentum_scale: FloatScalar  # the size of momenta, to judge residuals by


class StageSystem(eqx.Module):
    """The discrete nonholonomic equations of one step from (q_k, p_k, λ_k).

    Paper, "Summary: Discrete nonholonomic Lagrangian equations. Vector space", in the
    unknowns V^i, v^i (i >= 2) and the free part of Λ. The constraint at the first node
    holds by hypothesis H1; the last node is the end of the step by H3. The three
    multiplier closures differ in the constant matrices of `method.closure` alone.
    """

    system: LagrangianSystem
    method: AbstractMethod = eqx.field(static=True)
    t: FloatScalar
    h: FloatScalar
    q: Array
    p: Float[Array, " n"]
    multiplier: Float[Array, " m"]
    args: Args

    @property
    def constrained(self) -> bool:
        """Whether there are constraints, and so multipliers."""
        return self.multiplier.shape[0] > 0

    @property
    def symmetric(self) -> bool:
        """Whether the continuous multiplier at the end of the step is an unknown."""
        return self.constrained and self.method.multiplier == "symmetric"

    def coefficients(self, name: str) -> Array:
        """The array `name` of the method, in the working precision."""
        return jnp.asarray(getattr(self.method, name), self.p.dtype)

    def closure(self, name: str) -> Array:
        """The array `name` of the method's closure, in the working precision."""
        return jnp.asarray(getattr(self.method.closure, name), self.p.dtype)

    @property
    def node_weights(self) -> Float[Array, "r s"]:
        """Rows of a_ij at which node momenta are formed: i >= 2, or the weights b."""
        return (
            self.coefficients("a")[1:]
            if self.constrained
            else (self.coefficients("b")[None])
        )

    @property
    def node_times(self) -> Float[Array, " r"]:
        """Times of those nodes."""
        nodes = (
            self.coefficients("c")[1:]
            if self.constrained
            else (jnp.ones((1,), self.p.dtype))
        )
        return self.t + self.h * nodes

    def starting_values(self, v: Array, lin: Linearisation) -> Stages:
        """Stages to first order in h, from the acceleration and λ_c at the start.

        They need no memory of the step before, so a step is a function of its state.
        """
        push = self.h * lin.acceleration
        stage_times = jnp.sum(self.coefficients("a_hat"), axis=1)
        node_times = jnp.sum(self.node_weights, axis=1)
        free = jnp.ones((self.method.stages - 1,), self.p.dtype)
        if self.symmetric:
            free = free.at[0].set(0)  # ν vanishes with h, the others are multipliers
        nothing = jnp.zeros((0,), self.p.dtype)
        return Stages(
            velocity=v[None] + jnp.outer(stage_times, push),
            node_velocity=v[None] + jnp.outer(node_times, push),
            closure=jnp.outer(free, lin.multiplier),
            end_acceleration=lin.acceleration if self.symmetric else nothing,
            end_multiplier=lin.multiplier if self.symmetric else nothing,
        )

    def multipliers(self, x: Stages) -> Float[Array, "s m"]:
        """Λ^1..Λ^s from the unknowns of the closure."""
        if not self.constrained:
            return jnp.zeros((self.method.stages, 0), self.p.dtype)
        start = jnp.outer(self.closure("start"), self.multiplier)
        return start + self.multiplier_change(x)

    def multiplier_change(self, dx: Stages) -> Float[Array, "s m"]:
        """The part of Λ that is linear in the unknowns."""
        change = self.closure("E") @ dx.closure
        if self.symmetric:
            change = change + jnp.outer(self.closure("end"), dx.end_multiplier)
        return change

    def _positions(self, increments: Float[Array, "r n"]) -> Array:
        manifold = self.system.manifold_of(self.q)
        return jax.vmap(lambda xi: manifold.act(self.q, xi))(increments)

    def increment(self, x: Stages) -> Float[Array, " n"]:
        """ξ = h Σ b_j V^j, which takes q_k to q_{k+1}."""
        # h * (b @ V): rounding h b_j once and for all would bias every step.
        return self.h * (self.coefficients("b") @ x.velocity)

    def evaluate(self, x: Stages) -> StageForces:
        """W^i, Λ^i, and the residuals of the stage momenta P^i = D2L(Q^i, V^i)."""
        h, a_hat = self.h, self.coefficients("a_hat")
        multiplier = self.multipliers(x)
        q = self._positions(h * (self.coefficients("a") @ x.velocity))
        t = self.t + h * self.coefficients("c")
        force, momentum = jax.vmap(
            lambda t, q, v, lam: self.system.force_and_momentum(t, q, v, lam, self.args)
        )(t, q, x.velocity, multiplier)
        residual = momentum - (self.p[None] + h * (a_hat @ force))
        scale = jnp.max(jnp.abs(momentum)) + jnp.max(jnp.abs(h * force))
        return StageForces(force, multiplier, residual, scale)

    def node_positions(self, x: Stages) -> Array:
        """q^i at the nodes; the last is q_{k+1}."""
        return self._positions(self.h * (self.node_weights @ x.velocity))

    def node_residual(
        self, x: Stages, force: Float[Array, "s n"]
    ) -> Float[Array, "r n"]:
        """D2L(q^i, v^i) - p_k - h Σ a_ij W^j at the nodes."""
        momentum = jax.vmap(lambda t, q, v: self.system.momentum(t, q, v, self.args))(
            self.node_times, self.node_positions(x), x.node_velocity
        )
        return momentum - (self.p[None] + self.h * (self.node_weights @ force))

    def node_constraint(self, x: Stages) -> Float[Array, "r m"]:
        """Φ(q^i, v^i) at the nodes."""
        return jax.vmap(lambda t, q, v: self.system.constraint(t, q, v, self.args))(
            self.node_times, self.node_positions(x), x.node_velocity
        )

    def node_jacobian(self, x: Stages) -> Float[Array, "r m n"]:
        """B = D2Φ(q^i, v^i) at the nodes."""
        return jax.vmap(
            lambda t, q, v: jax.jacrev(self.system.constraint, argnums=2)(
                t, q, v, self.args
            )
        )(self.node_times, self.node_positions(x), x.node_velocity)

    def end_residual(self, x: Stages) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
        """Residuals of the equations of motion at the end, whose root is λ_c there."""
        q = self.node_positions(x)[-1]
        return motion_residual(
            self.system,
            self.t + self.h,
            q,
            x.node_velocity[-1],
            x.end_acceleration,
            x.end_multiplier,
            self.args,
        )
