from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree
import numpy as np

from ._custom_types import FloatScalar
from ._errors import is_traced
from ._state import as_floats, State


def save_state(t: FloatScalar, y: State, args: Any) -> State:
    """Save the whole state."""
    del t, args
    return y


class SaveAt(eqx.Module):
    """What to save of a trajectory, with diffrax's meanings.

    **Arguments:**

    - `t0`: save the initial state.
    - `t1`: save the final state.
    - `ts`: save at these times, by the collocation polynomials; sorted in the direction
        of time.
    - `steps`: save after every step (True), or after every k-th step (an int k). With
        `t1=True` the final state is saved too, but not twice.
    - `dense`: save the collocation polynomials for `Solution.evaluate`.
    - `fn`: save `fn(t, y, args)` instead of y.

    The output has exactly as many entries as are saved. Thinned saving (`steps=k`) and
    `ts` keep no buffer of the length of the run, unless `dense` does. Differentiating
    in reverse mode with respect to samples at `ts` needs `dense=True` beside it.

    **Raises:** `ValueError` if nothing is saved, `steps` is not a bool or an int >= 1,
    `ts` is not a sorted vector, or `ts` and `steps` are given together.

    !!! example

        >>> import nhjax
        >>> nhjax.SaveAt(t0=True, steps=10).steps
        10
    """

    t0: bool = eqx.field(static=True, default=False)
    t1: bool = eqx.field(static=True, default=False)
    ts: Float[Array, " k"] | None = None
    steps: int = eqx.field(static=True, default=0)
    dense: bool = eqx.field(static=True, default=False)
    fn: Callable[[Any, Any, Any], PyTree[Array]] = save_state

    def __init__(
        self,
        *,
        t0: bool = False,
        t1: bool = False,
        ts: Float[Array, " k"] | list[float] | None = None,
        steps: bool | int = False,
        dense: bool = False,
        fn: Callable[[Any, Any, Any], PyTree[Array]] = save_state,
    ):
        self.t0, self.t1, self.dense, self.fn = t0, t1, dense, fn
        self.ts = None if ts is None else as_floats("ts", jnp.asarray(ts))
        if not isinstance(steps, int) or steps < 0:
            raise ValueError(
                f"SaveAt: `steps` must be a bool or an int >= 1, got {steps!r}."
            )
        self.steps = int(steps)
        if not (t0 or t1 or dense or self.steps or ts is not None):
            raise ValueError(
                "SaveAt: nothing is saved. Ask for some of `t0`, `t1`, `ts`, `steps`, "
                "`dense`."
            )
        if not callable(fn):
            raise ValueError(
                f"SaveAt: `fn` must be a function (t, y, args), got {fn!r}."
            )
        if self.ts is not None:
            self._check_ts(self.ts)

    def _check_ts(self, ts: Array) -> None:
        if self.steps:
            raise ValueError(
                "SaveAt: give `ts` or `steps`, not both; with `dense=True` the solution "
                "can be evaluated anywhere afterwards."
            )
        if ts.ndim != 1 or ts.shape[0] == 0:
            raise ValueError(f"SaveAt: `ts` must have shape (k,), got {ts.shape}.")
        if not is_traced(ts):
            gaps = np.diff(np.asarray(ts))
            if not (np.all(gaps >= 0) or np.all(gaps <= 0)):
                raise ValueError(
                    "SaveAt: `ts` must be sorted in the direction of time."
                )

    def num_saved(self, num_steps: int) -> int:
        """The length of the output for a run of `num_steps` steps."""
        sampled = 0 if self.ts is None else self.ts.shape[0]
        strided = num_steps // self.steps if self.steps else 0
        return self.t0 + sampled + strided + self.saves_end(num_steps)

    def saves_end(self, num_steps: int) -> bool:
        """Whether the final state is saved on its own."""
        last_is_saved = bool(self.steps) and num_steps % self.steps == 0
        return self.t1 and not last_is_saved


def stack_saved(pieces: list[PyTree[Array]]) -> PyTree[Array]:
    """Join pieces that have a leading time axis."""
    if len(pieces) == 1:
        return pieces[0]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pieces)
