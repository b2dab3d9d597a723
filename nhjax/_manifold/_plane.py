import jax.numpy as jnp
from jaxtyping import Array, Float


def turn(v: Float[Array, "2 ..."]) -> Float[Array, "2 ..."]:
    """Compute J v, a vector of the plane (or the columns of a matrix) turned by π/2."""
    return jnp.concatenate([-v[1:], v[:1]])


def rotate(angle: Float[Array, ""], v: Float[Array, "2"]) -> Float[Array, "2"]:
    """Turn a vector v of the plane by an angle."""
    return jnp.cos(angle) * v + jnp.sin(angle) * turn(v)
