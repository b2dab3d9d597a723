import reprlib
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._custom_types import FloatScalar, IntScalar
from .._errors import Check, DTypeError, is_traced, NonFiniteError
from .._system import check_signature, State
from ._checks import static_length
from ._interpolation import step_position


def save_state(t: FloatScalar, y: State, args: Any) -> State:
    """Return the whole state `y`: the default of `fn` in `SaveAt`."""
    del t, args
    return y


class SaveAt(eqx.Module):
    """The choice of what `integrate` saves of a trajectory.

    The options have the same meanings as those of `diffrax.SaveAt`.

    **Arguments:**

    - `t0`: save the initial state.
    - `t1`: save the final state.
    - `ts`: save at these times, by the collocation polynomials; sorted in the
        direction of time.
    - `steps`: save after every step (True), or after every k-th step (an int k). With
        `t1=True` the final state is saved too, but not twice.
    - `dense`: save the collocation polynomials for `Solution.evaluate`.
    - `fn`: save `fn(t, y, args)` instead of y.
    - `checkpoint`: save as `Solution.checkpoint` what a later run needs to go on bit
        for bit; see `nhjax.Checkpoint`.

    The output has exactly as many entries as are saved. Saving every k-th step
    (`steps=k`) and saving at given times (`ts`) need no buffer of the length of the
    run, unless `dense` asks for one. The samples at `ts` are computed after the run,
    from the records of the steps that contain them.

    **Raises:** `ValueError` if nothing is saved, a flag is not a bool, `steps` is not a
    bool or an int >= 1, `ts` is not a sorted vector, or `ts` and `steps` are given
    together; `DTypeError` if `ts` is not real; `TypeError` if `fn` is not a function of
    (t, y, args). `integrate` raises a `TypeError` if `fn` returns something that is not
    an array or a tree of arrays.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(2),
        ...     disc.initial_state(), dt=0.1, num_steps=100,
        ...     saveat=nhjax.SaveAt(t0=True, steps=10))
        >>> sol.ts.shape
        (11,)
    """

    t0: bool = eqx.field(static=True, default=False)
    t1: bool = eqx.field(static=True, default=False)
    ts: Float[Array, " k"] | None = None
    steps: int = eqx.field(static=True, default=0)
    dense: bool = eqx.field(static=True, default=False)
    fn: Callable[[Any, Any, Any], PyTree[Array]] = save_state
    checkpoint: bool = eqx.field(static=True, default=False)

    def __init__(
        self,
        *,
        t0: bool = False,
        t1: bool = False,
        ts: Float[Array, " k"] | np.ndarray | Sequence[float] | None = None,
        steps: bool | int = False,
        dense: bool = False,
        fn: Callable[[Any, Any, Any], PyTree[Array]] = save_state,
        checkpoint: bool = False,
    ):
        flags = {"t0": t0, "t1": t1, "dense": dense, "checkpoint": checkpoint}
        for name, flag in flags.items():
            if not isinstance(flag, bool):
                raise ValueError(
                    f"SaveAt: `{name}` must be True or False, got {flag!r}; times "
                    "belong in `ts`, and `integrate` sets the ends of the run."
                )
        if not isinstance(steps, int | np.integer) or steps < 0:
            raise ValueError(
                f"SaveAt: `steps` must be a bool or an int >= 1, got {steps!r}."
            )
        if not (t0 or t1 or dense or steps or checkpoint or ts is not None):
            raise ValueError(
                "SaveAt: nothing is saved. Ask for some of `t0`, `t1`, `ts`, `steps`, "
                "`dense`, `checkpoint`."
            )
        if ts is not None and steps:
            raise ValueError(
                "SaveAt: give `ts` or `steps`, not both; with `dense=True` the "
                "solution can be evaluated anywhere afterwards."
            )
        check_signature("SaveAt", "fn", fn, ("t", "y", "args"))
        self.t0, self.t1, self.dense, self.fn = t0, t1, dense, fn
        self.checkpoint = checkpoint
        self.steps = int(steps)
        self.ts = None if ts is None else _times(ts)

    def within(self, dt: FloatScalar) -> "SaveAt":
        """Return the options with `ts` in the dtype of a run."""
        if self.ts is None:
            return self
        return eqx.tree_at(lambda s: s.ts, self, self.ts.astype(dt.dtype))

    def checks(
        self, t0: FloatScalar, dt: FloatScalar, num_steps: int | IntScalar
    ) -> list[Check]:
        """Make the checks of `ts` against a run; raise if nothing is saved in it."""
        if self.num_saved(num_steps) == 0 and not (self.dense or self.checkpoint):
            raise ValueError(
                f"SaveAt: `steps={self.steps}` saves nothing in a run of {num_steps} "
                "steps. Add `t1=True`."
            )
        if self.ts is None:
            return []
        ts = self.ts.astype(dt.dtype)
        # Positions in units of steps make the checks the same for both directions of
        # time and for all dtypes.
        position, inside = step_position(ts, t0, dt, static_length(num_steps))
        return [
            Check(jnp.all(inside), _outside, (ts, t0, dt, num_steps)),
            Check(jnp.all(jnp.diff(position) >= 0), _unsorted, (dt,)),
        ]

    def num_saved(self, num_steps: int | IntScalar) -> int:
        """Return the number of entries of the output for a run of `num_steps` steps."""
        sampled = 0 if self.ts is None else self.ts.shape[0]
        strided = static_length(num_steps) // self.steps if self.steps else 0
        return self.t0 + sampled + strided + self.saves_end(num_steps)

    def saves_end(self, num_steps: int | IntScalar) -> bool:
        """Tell whether `t1` adds an entry for a final state that `steps` leaves out."""
        last_is_saved = bool(self.steps) and static_length(num_steps) % self.steps == 0
        return self.t1 and not last_is_saved


def stack_saved(pieces: list[PyTree[Array]]) -> PyTree[Array]:
    """Concatenate pieces of the output along their leading axis, the time axis."""
    if len(pieces) == 1:
        return pieces[0]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *pieces)


def _outside(
    ts: np.ndarray, t0: np.ndarray, dt: np.ndarray, num_steps: int
) -> ValueError:
    return ValueError(
        f"SaveAt: `ts` reaches from {float(np.min(ts))} to {float(np.max(ts))}, "
        f"outside the run from {float(t0)} to {float(t0 + num_steps * dt)}."
    )


def _unsorted(dt: np.ndarray) -> ValueError:
    return ValueError(
        "SaveAt: `ts` must be sorted in the direction of time, which runs "
        f"{'forward' if dt > 0 else 'backward'} here."
    )


def _times(ts: Any) -> Float[Array, " k"]:
    try:
        if is_traced(*jax.tree.leaves(ts)):
            ts = jnp.asarray(ts)
        else:
            # Known times stay known inside of `jit`.
            with jax.ensure_compile_time_eval():
                ts = jnp.asarray(ts)
    except (TypeError, ValueError):
        raise DTypeError(
            f"SaveAt: `ts` must be a vector of real numbers, got {reprlib.repr(ts)} of "
            f"type {type(ts).__name__}."
        ) from None
    if jnp.issubdtype(ts.dtype, jnp.integer):
        ts = ts.astype(jnp.result_type(float))
    if not jnp.issubdtype(ts.dtype, jnp.floating):
        raise DTypeError(f"SaveAt: `ts` must be real, got dtype {ts.dtype}.")
    if ts.ndim != 1 or ts.shape[0] == 0:
        raise ValueError(f"SaveAt: `ts` must have shape (k,), k >= 1, got {ts.shape}.")
    if not is_traced(ts):
        # By NumPy: inside of `jit` operations of JAX on known numbers give none.
        known = np.asarray(ts)
        if not np.all(np.isfinite(known)):
            raise NonFiniteError(f"SaveAt: `ts` is not finite: {ts}.")
        gaps = np.diff(known)
        if not (np.all(gaps >= 0) or np.all(gaps <= 0)):
            raise ValueError("SaveAt: `ts` must be sorted in the direction of time.")
    return ts
