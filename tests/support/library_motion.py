"""Accelerations and multipliers by the library, without its integrator."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import nhjax


def motion_at(system, t, q, v, args=None):
    """(v̇, λ) of `nhjax.motion`, for a Lagrangian system."""
    # `nhjax.motion` uses neither the momentum nor the multiplier of the state.
    multiplier = jnp.zeros_like(system.constraint(jnp.asarray(t, v.dtype), q, v, args))
    y = nhjax.State(q, v, jnp.zeros_like(v), multiplier)
    motion = nhjax.motion(system, t, y, args)
    return motion.acceleration, motion.multiplier


@eqx.filter_jit
def _motion_at(system, t, q, v, args):
    return motion_at(system, t, q, v, args)


def library_motion(example, t, q, v, args=None):
    """The same for an example of the gallery, as arrays of NumPy, in one program."""
    t, q, v = (jnp.asarray(x, float) for x in (t, q, v))
    return jax.tree.map(np.asarray, _motion_at(example.system, t, q, v, args))
