"""Motion on groups and with holonomic constraints, without the library's integrator.

SciPy solves the index-reduced ODE; brackets and tangents of the groups are written out
here.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy.integrate import solve_ivp

from nhjax import ProductGroup, SE2, SE3, SO3


def turned(q, eta):
    """dq/dt of a quaternion, q ∘ (0, ω/2)."""
    w, u = q[0], q[1:]
    return 0.5 * jnp.concatenate([-(u @ eta)[None], w * eta + jnp.cross(u, eta)])


def rotated(q, x):
    return x + 2 * jnp.cross(q[1:], q[0] * x + jnp.cross(q[1:], x))


def velocity_of(group, q, eta):
    """dq/dt for the body velocity η."""
    match group:
        case SO3():
            return turned(q, eta)
        case SE2():
            c, s = jnp.cos(q[2]), jnp.sin(q[2])
            return jnp.stack([c * eta[0] - s * eta[1], s * eta[0] + c * eta[1], eta[2]])
        case SE3():
            return jnp.concatenate([turned(q[:4], eta[3:]), rotated(q[:4], eta[:3])])
        case ProductGroup():
            ends = np.cumsum([factor.dim for factor in group.factors])[:-1]
            parts = zip(group.factors, q, jnp.split(eta, ends), strict=True)
            return tuple(velocity_of(*part) for part in parts)
    return eta


def coadjoint(group, eta, mu):
    """ad*_η μ."""
    match group:
        case SO3():
            return jnp.cross(mu, eta)
        case SE2():
            v1, v2, omega = eta
            return jnp.stack(
                [omega * mu[1], -omega * mu[0], v2 * mu[0] - v1 * mu[1]],
            )
        case SE3():
            force, torque = mu[:3], mu[3:]
            v, omega = eta[:3], eta[3:]
            moment = jnp.cross(force, v) + jnp.cross(torque, omega)
            return jnp.concatenate([jnp.cross(force, omega), moment])
        case ProductGroup():
            ends = np.cumsum([factor.dim for factor in group.factors])[:-1]
            parts = zip(
                group.factors, jnp.split(eta, ends), jnp.split(mu, ends), strict=True
            )
            return jnp.concatenate([coadjoint(*part) for part in parts])
    return jnp.zeros_like(mu)


def constraints_of(system, q, v):
    """Nonholonomic constraints, d/dt of the holonomic ones, and the holonomic ones."""
    values, tangency, positions = jnp.zeros(0), jnp.zeros(0), jnp.zeros(0)
    if system.nonholonomic is not None:
        values = jnp.atleast_1d(system.nonholonomic(0.0, q, v, None))
    if system.holonomic is not None:
        positions, tangency = jax.jvp(
            lambda q: jnp.atleast_1d(system.holonomic(0.0, q, None)),
            (q,),
            (velocity_of(system.manifold, q, v),),
        )
    return values, tangency, positions


@eqx.filter_jit
def acceleration_and_multiplier(system, q, v):
    """Solve d/dt D2L = ad* D2L + L* D1L + λᵀ D2Φ with d/dt Φ = 0 for (dv/dt, λ)."""

    def lagrangian(q, v):
        return system.lagrangian(0.0, q, v, None)

    def constraint(q, v):
        return jnp.concatenate(constraints_of(system, q, v)[:2])

    def along_motion(function):
        return jax.jvp(
            lambda q: function(q, v), (q,), (velocity_of(system.manifold, q, v),)
        )[1]

    momentum = jax.grad(lagrangian, argnums=1)
    M = jax.jacfwd(momentum, argnums=1)(q, v)
    B = jax.jacfwd(constraint, argnums=1)(q, v)
    _, pull_back = jax.vjp(lambda eta: velocity_of(system.manifold, q, eta), v)
    free = pull_back(jax.grad(lagrangian)(q, v))[0] - along_motion(momentum)
    free = free + coadjoint(system.manifold, v, momentum(q, v))
    m = B.shape[0]
    matrix = jnp.block([[M, -B.T], [B, jnp.zeros((m, m))]])
    rest = jnp.concatenate([free, -along_motion(constraint)])
    solution = jnp.linalg.solve(matrix, rest)
    return solution[: v.size], solution[v.size :]


@eqx.filter_jit
def vector_field(system, like, y):
    """dy/dt for y = (q, v), flat; `like` is any configuration."""
    flat, unravel = ravel_pytree(like)
    q, v = unravel(y[: flat.size]), y[flat.size :]
    slope, _ = ravel_pytree(velocity_of(system.manifold, q, v))
    return jnp.concatenate([slope, acceleration_and_multiplier(system, q, v)[0]])


def oracle(example, t):
    """(q, v, λ) at the last of the times `t`, and (q, v) at each of them."""
    system = example.system
    flat_q0, unravel = ravel_pytree(example.q0)
    size = flat_q0.size
    times = np.atleast_1d(t)
    solution = solve_ivp(
        lambda _, y: np.asarray(vector_field(system, example.q0, jnp.asarray(y))),
        (0.0, times[-1]),
        np.concatenate([flat_q0, example.v0]),
        method="DOP853",
        t_eval=times,
        rtol=3e-14,
        atol=1e-14,
    )
    states = [(unravel(jnp.asarray(y[:size])), y[size:]) for y in solution.y.T]
    q, v = states[-1]
    return q, v, acceleration_and_multiplier(system, q, v)[1], states
