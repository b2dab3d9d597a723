"""A reference solution whose time steps do not use nhjax."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import nhjax


def reference(
    system: nhjax.LagrangianSystem, y0: nhjax.State, t: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute (q, v) at time t by DOP853 on the index-reduced equations of motion.

    The equations are M a - Bᵀλ = D1L + F - d/dt(D2L)|_{a=0} and B a = -dΦ/dt|_{a=0}, a
    dense linear system for the acceleration a and λ. All derivatives are automatic.
    """
    n = y0.v.shape[0]

    @eqx.filter_jit
    def field(time, state):
        q, v = state[:n], state[n:]

        def phi(time, q, v):
            return system.constraint(time, q, v, None)

        def momentum(time, q, v):
            return jax.grad(system.lagrangian, argnums=2)(time, q, v, None)

        directions = (jnp.ones_like(time), v, jnp.zeros_like(v))
        p_dot = jax.jvp(momentum, (time, q, v), directions)[1]
        phi_dot = jax.jvp(phi, (time, q, v), directions)[1]
        mass = jax.jacfwd(momentum, argnums=2)(time, q, v)
        b = jax.jacfwd(phi, argnums=2)(time, q, v)
        force = jax.grad(system.lagrangian, argnums=1)(time, q, v, None)
        if system.force is not None:
            force = force + system.force(time, q, v, None)
        zero = jnp.zeros((b.shape[0], b.shape[0]), v.dtype)
        matrix = jnp.block([[mass, -b.T], [b, zero]])
        right = jnp.concatenate([force - p_dot, -phi_dot])
        return jnp.concatenate([v, jnp.linalg.solve(matrix, right)[:n]])

    def python_field(time, state):
        return np.asarray(field(jnp.asarray(time), jnp.asarray(state)))

    start = np.concatenate([y0.q, y0.v])
    out = solve_ivp(
        python_field, (0.0, t), start, method="DOP853", rtol=1e-13, atol=1e-15
    )
    return out.y[:n, -1], out.y[n:, -1]
