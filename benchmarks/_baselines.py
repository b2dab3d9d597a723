"""Published methods for nonholonomic systems, for comparisons with nhjax.

All these methods are written for one constraint that is linear in the velocities, and a
Lagrangian with unit masses,

    L = ½ |v|² - V(q),   Φ = b(q)·v,   f = -∇V,

as in the paper's experiments on vector spaces. A step maps (q, v) at the start of the
step to (q, v) at its end; both satisfy b(q)·v = 0. The equations of each method are
derived from its definition.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

import nhjax


Step = Callable[[Array, Array, Array], tuple[Array, Array]]

# Each sweep on the multipliers reduces the error by a factor O(h²): at h = 0.3, about
# twenty sweeps reach round-off.
MOST_SWEEPS = 60


class Natural(NamedTuple):
    """The force f(q) and the direction b(q) of the constraint."""

    force: Callable[[Array], Array]
    direction: Callable[[Array], Array]


def natural(system: nhjax.LagrangianSystem) -> Natural:
    """Derive f and b from a system with unit masses and one constraint linear in v."""

    def force(q: Array) -> Array:
        return jax.grad(system.lagrangian, argnums=1)(0.0, q, jnp.zeros_like(q), None)

    def direction(q: Array) -> Array:
        def phi(v):
            return jnp.sum(system.constraint(0.0, q, v, None))

        return jax.grad(phi)(jnp.zeros_like(q))

    return Natural(force, direction)


def projected(nat: Natural, q: Array, v: Array) -> Array:
    """Project v onto the velocities with b(q)·v = 0."""
    b = nat.direction(q)
    return v - b * (b @ v) / (b @ b)


def solved(residual: Callable[[Array], tuple[Array, Any]], start: Array) -> Any:
    """Repeat x -= r(x) until r is round-off; return the second result of `residual`."""
    eps = float(jnp.finfo(start.dtype).eps)

    def body(carry):
        x, size, _, k = carry
        r, _ = residual(x)
        return x - r, jnp.max(jnp.abs(r)), size, k + 1

    def goes_on(carry):
        x, size, before, k = carry
        # The iteration stops if a change is not smaller than the change before it, but
        # only near round-off: far from round-off, changes may grow for some sweeps.
        near = size <= 1e3 * eps * (1.0 + jnp.max(jnp.abs(x)))
        return (size > 0) & ~(near & (size >= before)) & (k < MOST_SWEEPS)

    infinite = jnp.asarray(jnp.inf, start.dtype)
    x, *_ = jax.lax.while_loop(goes_on, body, (start, infinite, infinite, 0))
    return residual(x)[1]


def discrete_lagrange_dalembert(nat: Natural) -> Step:
    """Create the step of the discrete Lagrange-d'Alembert method, as a leapfrog.

    Cortés and Martínez (2001): with a discrete Lagrangian L_d(q_k, q_{k+1}) and a
    discrete constraint ω_d(q_k, q_{k+1}) = 0,

        D₁L_d(q_k, q_{k+1}) + D₂L_d(q_{k-1}, q_k) + λ_k b(q_k) = 0.

    Here Δq = q_{k+1} - q_k, L_d = h (½ |Δq/h|² - ½ V(q_k) - ½ V(q_{k+1})), and
    ω_d = b((q_k + q_{k+1})/2)·Δq. McLachlan and Perlmutter (2006) write this method as
    a leapfrog with three parts: half a kick by f + λ b at q_k, a drift to q_{k+1}, and
    half a kick by f. The multiplier λ is such that the drift satisfies ω_d = 0. The
    velocity at q_{k+1} is then projected onto the constraint. The projection changes
    the velocity by a multiple of b(q_{k+1}), and the next multiplier compensates this
    change, so that positions do not depend on the projection.
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
    """Create the step of the leapfrog that evaluates the constraint at the nodes.

    Ferraro, Iglesias and Martín de Diego (2008): b(q_k)·(v_{k-1/2} + v_{k+1/2}) = 0,
    v_{k+1/2} - v_{k-1/2} = h (f + λ b)(q_k). The step uses velocities in the middle
    between nodes: it maps (q_k, v_{k-1/2}) to (q_{k+1}, v_{k+1/2}).
    """

    def step(q: Array, v: Array, h: Array) -> tuple[Array, Array]:
        middle = projected(nat, q, v + 0.5 * h * nat.force(q))
        half = 2.0 * middle - v
        return q + h * half, half

    return step


def spark(nat: Natural, stages: int) -> Step:
    """Create the step of the Lobatto IIIA-B SPARK method with s stages.

    The method is reconstructed from the definition of Jay's methods for DAEs of index
    2, because his report of 2009 was not available. The stages are

        Q_i = q_0 + h Σ_j a_ij V_j,  V_i = v_0 + h Σ_j â_ij (f + Λ_j b)(Q_j)

    with s multipliers Λ_j. The s equations for them are the constraint at the end of
    the step, and s - 1 weighted means of the constraint over the stages,

        Σ_j b_j c_j^l b(Q_j)·V_j = 0,  l = 0..s-2,    b(q_1)·v_1 = 0.

    A step does not use multipliers of the previous step.
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
    """Create the step of the classical Runge-Kutta method, with a projection.

    The step integrates q̈ = f + λ b with λ = -(b·f + v·b'(q)v)/(b·b), and projects v
    onto the constraint at the end.
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
    """Run a method, and save `observe(q, v)` after each `every` steps."""
    h = jnp.asarray(h, q.dtype)

    def block(state, _):
        state = jax.lax.fori_loop(0, every, lambda _, s: step(s[0], s[1], h), state)
        return state, observe(*state)

    return jax.lax.scan(block, (q, v), length=num_steps // every)[1]
