"""Methods of others for nonholonomic systems, to compare with; no part of the library.

All are for one constraint linear in the velocities and a Lagrangian of unit mass,

    L = ½ |v|² - V(q),   Φ = b(q)·v,   f = -∇V,

which is what the paper's experiments on vector spaces have. A step maps (q, v) to
(q, v) with b(q)·v = 0 at both ends. The equations are derived from the definitions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nhjax


Step = Callable[[Array, Array, Array], tuple[Array, Array]]

# A sweep on the multipliers gains a factor O(h²): at h = 0.3 these are some twenty.
MOST_SWEEPS = 60


class Natural(NamedTuple):
    """The force f(q) and the direction b(q) of the constraint."""

    force: Callable[[Array], Array]
    direction: Callable[[Array], Array]


def natural(system: nhjax.LagrangianSystem) -> Natural:
    """Read f and b off a system of unit mass with one constraint linear in v."""

    def force(q: Array) -> Array:
        return jax.grad(system.lagrangian, argnums=1)(0.0, q, jnp.zeros_like(q), None)

    def direction(q: Array) -> Array:
        def phi(v):
            return jnp.sum(system.constraint(0.0, q, v, None))

        return jax.grad(phi)(jnp.zeros_like(q))

    return Natural(force, direction)


def projected(nat: Natural, q: Array, v: Array) -> Array:
    """Project v onto b(q)·v = 0."""
    b = nat.direction(q)
    return v - b * (b @ v) / (b @ b)


def solved(residual: Callable[[Array], tuple[Array, Any]], start: Array) -> Any:
    """Sweep x -= r(x) until r is round-off, and return what comes with r."""
    eps = float(jnp.finfo(start.dtype).eps)

    def body(carry):
        x, size, _, k = carry
        r, _ = residual(x)
        return x - r, jnp.max(jnp.abs(r)), size, k + 1

    def goes_on(carry):
        x, size, before, k = carry
        # Far from round-off a sweep may be larger than that before it.
        near = size <= 1e3 * eps * (1.0 + jnp.max(jnp.abs(x)))
        return (size > 0) & ~(near & (size >= before)) & (k < MOST_SWEEPS)

    infinite = jnp.asarray(jnp.inf, start.dtype)
    x, *_ = jax.lax.while_loop(goes_on, body, (start, infinite, infinite, 0))
    return residual(x)[1]


def discrete_lagrange_dalembert(nat: Natural) -> Step:
    """Make the step of the discrete Lagrange-d'Alembert method, as a leapfrog.

    Cortés and Martínez (2001): with a discrete Lagrangian L_d(q_k, q_{k+1}) and a
    discrete constraint ω_d(q_k, q_{k+1}) = 0,

        D₁L_d(q_k, q_{k+1}) + D₂L_d(q_{k-1}, q_k) + λ_k b(q_k) = 0.

    Here L_d = h (½ |Δq/h|² - ½ V(q_k) - ½ V(q_{k+1})), ω_d = b((q_k + q_{k+1})/2)·Δq,
    which McLachlan and Perlmutter (2006) write as a leapfrog: half a kick by f + λ b
    at q_k such that the drift to q_{k+1} satisfies ω_d = 0, the drift, and half a kick
    by f. The velocity at a node is then projected on the constraint there; that moves
    it along b(q_k), which the next λ_k makes up for: positions do not depend on it.
    """

    def step(q: Array, v: Array, h: Array) -> tuple[Array, Array]:
        b = nat.direction(q)
        kicked = v + 0.5 * h * nat.force(q)

        def residual(impulse):
            half = kicked + impulse * b
            end = q + h * half
            r = nat.direction(0.5 * (q + end)) @ half
            return r / (b @ b), (end, half)

        end, half = solved(residual, jnp.zeros((), q.dtype))
        return end, projected(nat, end, half + 0.5 * h * nat.force(end))

    return step


def leapfrog_at_nodes(nat: Natural) -> Step:
    """Make the step of the leapfrog that takes the constraint at the nodes.

    Ferraro, Iglesias and Martín de Diego (2008): b(q_k)·(v_{k-1/2} + v_{k+1/2}) = 0,
    v_{k+1/2} - v_{k-1/2} = h (f + λ b)(q_k). The second argument and result of the step
    are v_{k-1/2} and v_{k+1/2}: it maps (q_k, v_{k-1/2}) to (q_{k+1}, v_{k+1/2}).
    """

    def step(q: Array, v: Array, h: Array) -> tuple[Array, Array]:
        middle = projected(nat, q, v + 0.5 * h * nat.force(q))
        half = 2.0 * middle - v
        return q + h * half, half

    return step


def spark(nat: Natural, stages: int) -> Step:
    """Make the step of the Lobatto IIIA-B SPARK method with s stages.

    Reconstructed from the definition of Jay's methods for DAEs of index 2, without his
    report of 2009, which was not at hand: the stages

        Q_i = q_0 + h Σ_j a_ij V_j,  V_i = v_0 + h Σ_j â_ij (f + Λ_j b)(Q_j)

    with s multipliers of their own in each step, and the constraint at the end of the
    step and in s - 1 means over its stages,

        Σ_j b_j c_j^l b(Q_j)·V_j = 0,  l = 0..s-2,    b(q_1)·v_1 = 0.

    No multiplier is carried from one step to the next.
    """
    method = nhjax.LobattoIIIAB(stages)
    powers = np.vander(method.c, stages - 1, increasing=True).T
    inverse = np.linalg.inv(np.vstack([(method.b * powers) @ method.a_hat, method.b]))
    a, a_hat, weights, moments, inverse = (
        jnp.asarray(x, float)
        for x in (method.a, method.a_hat, method.b, method.b * powers, inverse)
    )

    def step(q: Array, v: Array, h: Array) -> tuple[Array, Array]:
        b0 = nat.direction(q)
        forces, directions = jax.vmap(nat.force), jax.vmap(nat.direction)

        def residual(x):
            impulses, velocities = x[:, 0], x[:, 1:]
            positions = q[None] + h * (a @ velocities)
            b = directions(positions)
            kicks = h * forces(positions) + impulses[:, None] * b
            stage_v, end_v = v[None] + a_hat @ kicks, v + weights @ kicks
            means = moments @ jnp.sum(b * stage_v, axis=1)
            r = jnp.append(means, b[-1] @ end_v)
            change = inverse @ r / (b0 @ b0)
            return (
                jnp.concatenate([change[:, None], velocities - stage_v], axis=1),
                (positions[-1], end_v),
            )

        start = jnp.concatenate(
            [jnp.zeros((stages, 1), q.dtype), jnp.broadcast_to(v, (stages, *v.shape))],
            axis=1,
        )
        return solved(residual, start)

    return step


def projected_rk4(nat: Natural) -> Step:
    """Make the step of the classical Runge-Kutta method, projected on the constraint.

    It integrates q̈ = f + λ b, λ = -(b·f + v·b'(q)v)/(b·b), and projects v at the end.
    """

    def field(q: Array, v: Array) -> tuple[Array, Array]:
        b, turning = jax.jvp(nat.direction, (q,), (v,))
        force = nat.force(q)
        return v, force - b * (b @ force + turning @ v) / (b @ b)

    def step(q: Array, v: Array, h: Array) -> tuple[Array, Array]:
        slopes = [field(q, v)]
        for weight in (0.5, 0.5, 1.0):
            dq, dv = slopes[-1]
            slopes.append(field(q + weight * h * dq, v + weight * h * dv))
        dq, dv = (
            (first + 2.0 * second + 2.0 * third + fourth) / 6.0
            for first, second, third, fourth in zip(*slopes, strict=True)
        )
        end = q + h * dq
        return end, projected(nat, end, v + h * dv)

    return step


def run(
    step: Step,
    q: Array,
    v: Array,
    h: Any,
    num_steps: int,
    every: int = 1,
    observe: Callable[[Array, Array], Any] = lambda q, v: (q, v),
) -> Any:
    """Run a method and save what `observe` makes of every so many steps."""
    h = jnp.asarray(h, q.dtype)

    def block(state, _):
        state = jax.lax.fori_loop(0, every, lambda _, s: step(s[0], s[1], h), state)
        return state, observe(*state)

    return jax.lax.scan(block, (q, v), length=num_steps // every)[1]
