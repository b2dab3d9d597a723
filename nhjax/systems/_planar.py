"""Functions for planar mechanisms: rotations and kinetic energy of rigid bodies."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def direction(angles: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """Compute the unit vectors at angles from the horizontal."""
    return jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)


def turned(
    angles: Float[Array, "*batch"], vectors: Float[Array, "*batch 2"]
) -> Float[Array, "*batch 2"]:
    """Turn plane vectors anticlockwise, each by its angle."""
    cos, sin = jnp.cos(angles), jnp.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def kinetic_energy(
    masses: Float[Array, " bodies"],
    inertias: Float[Array, " bodies"],
    velocities: Float[Array, "bodies 2"],
    rates: Float[Array, " bodies"],
) -> Float[Array, ""]:
    """Sum ½ m |ċ|² + ½ I ω² over bodies, from velocities of centres and turning rates.

    `inertias` are the moments of inertia about the centres of mass.
    """
    moving = masses @ jnp.sum(velocities**2, axis=1)
    return 0.5 * (moving + inertias @ rates**2)
