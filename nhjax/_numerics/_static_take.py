"""Elements of an array at places that are known when a program is traced."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int


# With more pieces than this the program would be long, and an indexed read is better.
_MOST_PIECES = 16
_PERIODS = (1, 2, 3, 4, 6)


def static_take(x: Array, index: Int[np.ndarray, " k"]) -> Array:
    """Compute `x[..., index]` for indices that are known, by slices if there are few.

    Indices of regular structures are arithmetic sequences, or a few of them that take
    turns. Slices can be a part of one kernel, which an indexed read cannot.
    """
    if np.array_equal(index, np.arange(x.shape[-1])):
        return x
    best: tuple[int, list[list[np.ndarray]]] | None = None
    for period in _PERIODS:
        if len(index) % period:
            continue
        turns = [_runs(index[r::period]) for r in range(period)]
        count = sum(map(len, turns))
        if best is None or count < best[0]:
            best = count, turns
    if best is None or best[0] > _MOST_PIECES:
        return x[..., jnp.asarray(index)]
    parts = [
        jnp.concatenate([_piece(x, run) for run in runs], axis=-1) for runs in best[1]
    ]
    if len(parts) == 1:
        return parts[0]
    return jnp.stack(parts, axis=-1).reshape(*x.shape[:-1], len(index))


def _runs(index: Sequence[int] | np.ndarray) -> list[np.ndarray]:
    """Cut a sequence of indices into arithmetic sequences."""
    runs, start = [], 0
    while start < len(index):
        end = start + 1
        while end < len(index) and (
            end == start + 1
            or index[end] - index[end - 1] == index[start + 1] - index[start]
        ):
            end += 1
        # A step back is a run of its own: slices go forward.
        if end > start + 1 and index[start + 1] < index[start]:
            end = start + 1
        runs.append(np.asarray(index[start:end]))
        start = end
    return runs


def _piece(x: Array, run: np.ndarray) -> Array:
    first, count = int(run[0]), len(run)
    step = int(run[1] - run[0]) if count > 1 else 1
    if step == 0:
        return jnp.broadcast_to(x[..., first : first + 1], (*x.shape[:-1], count))
    last = first + (count - 1) * step + 1
    return jax.lax.slice_in_dim(x, first, last, step, axis=x.ndim - 1)
