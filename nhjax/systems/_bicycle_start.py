"""Where a bicycle starts: a pitch and rates that satisfy the constraints."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array


@eqx.filter_jit
def rolling_start(
    bicycle: Any,
    lean: Array,
    steer: Array,
    lean_rate: Array,
    steer_rate: Array,
    speed: Array,
) -> tuple[Array, Array, Array]:
    """Compute (q0, v0): the pitch by Newton's method, the other rates linearly.

    The third result tells whether both wheels touch the ground.
    """

    def at(pitch):
        angles = jnp.stack([lean, pitch, steer])
        return jnp.concatenate([jnp.zeros(3), angles, jnp.zeros(2)])

    def depth(pitch):
        return bicycle.holonomic(0.0, at(pitch), None)[0]

    def improve(_, pitch):
        value, slope = jax.jvp(depth, (pitch,), (jnp.ones_like(pitch),))
        return pitch - value / slope

    q0 = at(jax.lax.fori_loop(0, 12, improve, jnp.zeros_like(lean)))

    def slip(v):
        _, sinking = jax.jvp(lambda q: bicycle.holonomic(0.0, q, None), (q0,), (v,))
        return jnp.concatenate([bicycle.constraint(0.0, q0, v, None), sinking])

    roll_rate = -speed / bicycle.rear_radius
    given = jnp.stack([lean_rate, steer_rate, roll_rate])
    free, bound = jnp.asarray([3, 5, 6]), jnp.asarray([0, 1, 2, 4, 7])
    v0 = jnp.zeros(8).at[free].set(given)
    slopes = jax.jacfwd(slip)(v0)
    v0 = v0.at[bound].set(jnp.linalg.solve(slopes[:, bound], -slip(v0)))
    near = jnp.abs(depth(q0[4])) < 1e-3 * bicycle.front_radius
    return q0, v0, near & (jnp.abs(q0[4]) < 0.5 * jnp.pi)
