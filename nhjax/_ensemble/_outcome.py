import os
from typing import Any

import equinox as eqx
import numpy as np

from .._results import messages, RESULTS


class EnsembleOutcome(eqx.Module):
    """The outcome of `nhjax.ensemble`.

    - `num_members`: how many members were run, those that failed included.
    - `values`: what `run` returned, with the members as leading axis, in arrays of
        NumPy; None if it was reduced or written to a store.
    - `statistics`: what the reductions made of it, in the tree that `reduce` was.
    - `failed`: the indices of the members that failed, in rising order.
    - `failed_step`: the steps at which they failed, -1 where this is not known.
    - `failed_result`: how they failed, an array of `nhjax.RESULTS`.
    - `path`: the store, if there is one.
    """

    num_members: int = eqx.field(static=True)
    values: Any
    statistics: Any
    failed: np.ndarray
    failed_step: np.ndarray
    failed_result: RESULTS
    path: str | os.PathLike[str] | None = eqx.field(static=True, default=None)

    def failures(self) -> list[tuple[int, int, str]]:
        """List the members that failed, each as (index, step, reason).

        `reason` is the message of its `RESULTS`; the step is -1 where it is not known.

        !!! example

            >>> import jax.numpy as jnp, nhjax
            >>> nhjax.ensemble(jnp.sin, jnp.arange(3.0)).failures()
            []
        """
        texts, codes = messages(), np.asarray(self.failed_result._value)
        return [
            (int(index), int(step), texts[int(code)])
            for index, step, code in zip(
                self.failed, self.failed_step, codes, strict=True
            )
        ]
