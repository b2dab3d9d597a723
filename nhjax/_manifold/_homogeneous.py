import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def homogeneous(
    corner: Float[Array, "n n"], column: Float[Array, " n"], last: float
) -> Float[Array, "n+1 n+1"]:
    """Assemble the matrix [[corner, column], [0, last]] in homogeneous coordinates.

    With last = 1 it is that of a motion, with last = 0 that of a velocity.
    """
    rows = jnp.concatenate([corner, column[:, None]], axis=1)
    n = column.shape[0]
    row = np.zeros((1, n + 1), column.dtype)
    row[0, n] = last
    return jnp.concatenate([rows, row])
