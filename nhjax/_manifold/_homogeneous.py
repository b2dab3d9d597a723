import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def homogeneous(
    corner: Float[Array, "n n"], column: Float[Array, " n"], last: float
) -> Float[Array, "n+1 n+1"]:
    """[[corner, column], [0, last]]: a motion (last = 1) or its velocity (last = 0)."""
    rows = jnp.concatenate([corner, column[:, None]], axis=1)
    n = column.shape[0]
    row = np.zeros((1, n + 1), column.dtype)
    row[0, n] = last
    return jnp.concatenate([rows, row])
