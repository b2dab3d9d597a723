"""The spherical pendulum in its two angles, which moves steadily on a cone."""

import jax.numpy as jnp

from support.group_problems import both_forms


GRAVITY = 9.81


def polar_pendulum():
    """One angle from the vertical, one around it; a unit mass at a unit length."""
    return both_forms(
        lambda t, q: jnp.diag(jnp.stack([jnp.ones_like(q[0]), jnp.sin(q[0]) ** 2])),
        lambda t, q: -GRAVITY * jnp.cos(q[0]),
        inverse=lambda M: jnp.diag(1 / jnp.diagonal(M)),
    )
