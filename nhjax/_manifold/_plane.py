import jax.numpy as jnp
from jaxtyping import Array, Float


def turn(v: Float[Array, "2 ..."]) -> Float[Array, "2 ..."]:
    """J v, the quarter turn of a vector of the plane (of the columns of a matrix)."""
    return jnp.concatenate([-v[1:], v[:1]])


def rotate(angle: Float[Array, ""], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """v turned by an angle."""
    return jnp.cos(angle) * v + jnp.sin(angle) * turn(v)
