"""Checks of the options of a run; the system and the state are checked elsewhere."""

import reprlib
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._custom_types import Args, FloatScalar, IntScalar
from .._errors import Check, is_traced, naming, ShapeError


# Steps are counted in int32.
MOST_STEPS = 2**31 - 1


def check_num_steps(num_steps: Any, needed_by: str | None) -> int | IntScalar:
    """Return `num_steps` as an int >= 1, or as an array if no option needs its value.

    **Arguments:**

    - `num_steps`: the argument of the user.
    - `needed_by`: the name of an option that needs the number of steps when tracing,
        for instance because the shape of its output depends on it; None if there is
        none.
    """
    if isinstance(num_steps, jax.Array | np.ndarray):
        return _traced_count(num_steps, needed_by)
    if isinstance(num_steps, bool) or not isinstance(num_steps, int | np.integer):
        raise TypeError(
            "`num_steps` must be an int, or an integer array of shape (), got "
            f"{num_steps!r} of type {type(num_steps).__name__}."
        )
    _require_count(int(num_steps))
    return int(num_steps)


def _traced_count(num_steps: Array | np.ndarray, needed_by: str | None) -> IntScalar:
    if not jnp.issubdtype(num_steps.dtype, jnp.integer):
        raise TypeError(
            "`num_steps` must be an int, or an integer array of shape (), got "
            f"{num_steps!r} of dtype {num_steps.dtype}."
        )
    if num_steps.shape != ():
        raise ShapeError(
            f"`num_steps` has shape {num_steps.shape}, but a scalar is needed; for "
            "runs of several lengths use `jax.vmap`."
        )
    if needed_by is not None:
        raise TypeError(
            f"`num_steps` must be an int known when tracing (under `jax.jit` a static "
            f"argument), because {needed_by} depends on it; got {num_steps!r} of type "
            f"{type(num_steps).__name__}."
        )
    if not is_traced(num_steps):
        _require_count(int(num_steps))
    return jnp.asarray(num_steps)


def _require_count(num_steps: int) -> None:
    if not 1 <= num_steps <= MOST_STEPS:
        raise _count_error(num_steps)


def _count_error(num_steps: Any) -> ValueError:
    return ValueError(f"`num_steps` must be in 1..2^31 - 1, got {num_steps}.")


def static_length(num_steps: int | IntScalar) -> int:
    """Return a number of steps that `check_num_steps` has made an int, as an int."""
    assert isinstance(num_steps, int)
    return num_steps


def countable(num_steps: int | IntScalar) -> list[Check]:
    """Make the check that a traced number of steps is in its range.

    The list is empty for a number that is known, which `check_num_steps` has checked.
    """
    if isinstance(num_steps, int) or not is_traced(num_steps):
        return []
    ok = num_steps >= 1
    if jnp.iinfo(num_steps.dtype).max > MOST_STEPS:
        ok = ok & (num_steps <= MOST_STEPS)
    return [Check(ok, _count_error, (num_steps,))]


def advancing(t0: FloatScalar, dt: FloatScalar) -> Check:
    """Make the check that t0 + dt differs from t0, so that time advances."""
    # Known values are compared on the host with NumPy, where an operation takes a tenth
    # of the time.
    numpy: Any = jnp if is_traced(t0, dt) else np
    first, h = numpy.asarray(t0), numpy.asarray(dt)
    # Infinite numbers have a check of their own.
    with np.errstate(over="ignore", invalid="ignore"):
        ok = first + h != first
    return Check(ok, _standstill_error, (first, h))


def _standstill_error(first: Any, h: Any) -> ValueError:
    return ValueError(
        f"`dt` = {h} is below the round-off of the time `t0` = {first} in {h.dtype}: "
        "t0 + dt equals t0, and time would not advance. Measure time from a later "
        "origin, or take larger steps."
    )


def check_saved(
    fn: Callable[[Any, Any, Any], PyTree[Array]], t: FloatScalar, y: Any, args: Args
) -> None:
    """Raise a `TypeError` unless `SaveAt(fn=...)` returns what can be saved, arrays."""
    with naming("SaveAt: fn(t, y, args)", fn, args):
        leaves = jax.tree.leaves(eqx.filter_eval_shape(fn, t, y, args))
    wrong = [
        leaf
        for leaf in leaves
        if not (isinstance(leaf, jax.ShapeDtypeStruct) or eqx.is_array_like(leaf))
    ]
    if leaves and not wrong:
        return
    got = "nothing: does it lack a `return`?"
    if wrong:
        got = f"{reprlib.repr(wrong[0])} of type {type(wrong[0]).__name__}."
    raise TypeError(
        f"SaveAt: `fn(t, y, args)` must return an array, or a tree of arrays, got {got}"
    )


# JAX keeps what is being traced, if anything, in a state that can only be compared
# with another. In releases of JAX that do not make this function public, `is_tracing`
# always returns True.
_trace_state = getattr(jax.extend.core, "get_opaque_trace_state", lambda **_: object())
with jax.ensure_compile_time_eval():
    # This gives the state outside of all transformations also if this module is
    # imported inside of one.
    _NOT_TRACING = _trace_state(convention="nhjax")


def is_tracing() -> bool:
    """Tell whether this is called inside a transformation such as jit, vmap or grad."""
    return _trace_state(convention="nhjax") != _NOT_TRACING
