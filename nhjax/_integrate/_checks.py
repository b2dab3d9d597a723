"""What can be wrong with the options of a run, beside its system and its state."""

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
from .._errors import Check, is_traced, ShapeError


# Steps are counted in int32.
_MOST_STEPS = 2**31 - 1


def check_num_steps(num_steps: Any, needed_by: str | None) -> int | IntScalar:
    """`num_steps` as an int >= 1, or as an array if nothing needs to know it.

    **Arguments:**

    - `num_steps`: that of the user.
    - `needed_by`: the option whose output has a shape that depends on it, if any.
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
    if not 1 <= num_steps <= _MOST_STEPS:
        raise _count_error(num_steps)


def _count_error(num_steps: Any) -> ValueError:
    return ValueError(f"`num_steps` must be in 1..2^31 - 1, got {num_steps}.")


def known(num_steps: int | IntScalar) -> int:
    """A number of steps that is an int, where `check_num_steps` has seen to that."""
    assert isinstance(num_steps, int)
    return num_steps


def countable(num_steps: int | IntScalar) -> list[Check]:
    """The check of a traced number of steps; that of an int is done already."""
    if isinstance(num_steps, int) or not is_traced(num_steps):
        return []
    ok = num_steps >= 1
    if jnp.iinfo(num_steps.dtype).max > _MOST_STEPS:
        ok = ok & (num_steps <= _MOST_STEPS)
    return [Check(ok, _count_error, (num_steps,))]


def advancing(t0: FloatScalar, dt: FloatScalar) -> Check:
    """The check that the first step changes t."""
    # On the host where it is known: an operation there takes a tenth of the time.
    numpy: Any = jnp if is_traced(t0, dt) else np
    first, h = numpy.asarray(t0), numpy.asarray(dt)
    # What is infinite has a check of its own.
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
    """Raise unless what `SaveAt(fn=...)` returns can be saved."""
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


# JAX keeps what is being traced, if anything, in a state that can only be compared.
# Releases that have no such function in public count as always tracing.
_trace_state = getattr(jax.extend.core, "get_opaque_trace_state", lambda **_: object())
with jax.ensure_compile_time_eval():
    # Also where this is imported inside of a transformation.
    _NOT_TRACING = _trace_state(convention="nhjax")


def is_tracing() -> bool:
    """Whether this is called inside a transformation such as jit, vmap or grad."""
    return _trace_state(convention="nhjax") != _NOT_TRACING
