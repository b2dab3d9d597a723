"""The nodes of a run, and the checks of the arguments that determine the nodes."""

from dataclasses import replace
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .._custom_types import FloatScalar, FloatScalarLike
from .._errors import Check, is_traced, ShapeError
from .._system import finite, real_scalar, real_vector
from ._interpolation import is_within
from ._saving import SaveAt
from ._step_sizes import (
    AbstractStepSizeController,
    ConstantStepSize,
    GivenStepSizes,
)


class TimeGrid(eqx.Module):
    """The nodes t_k = t0 + k dt of a run, for k = 0, ..., num_steps."""

    t0: FloatScalar
    dt: FloatScalar
    num_steps: Any

    @property
    def most_steps(self) -> Any:
        """Return the number of steps."""
        return self.num_steps

    @property
    def typical_size(self) -> FloatScalar:
        """Return the size of all steps."""
        return self.dt

    def of_length(self, num_steps: Any) -> "TimeGrid":
        """Return the grid of a run with another number of steps."""
        return replace(self, num_steps=num_steps)


class VariableGrid(eqx.Module):
    """The nodes of a run with variable steps, that is, steps of different sizes.

    - `dt`: the step size that the user gave (the first one of an array), or None.
    - `t1`: the end, or None for a run of `num_steps` steps.
    - `direction`: 1.0 for a run forward in time, -1.0 for a run backward in time.
    - `num_steps`: the number of steps, or None for a run to `t1`.
    - `max_steps`: the largest number of attempted steps, accepted or rejected.
    """

    t0: FloatScalar
    dt: FloatScalar | None
    t1: FloatScalar | None
    direction: FloatScalar
    num_steps: Any
    max_steps: Any

    @property
    def most_steps(self) -> Any:
        """Return the largest number of steps that the run may have."""
        return self.max_steps if self.num_steps is None else self.num_steps

    def of_length(self, num_steps: Any) -> "VariableGrid":
        """Return the same grid, with its numbers of steps and attempts as arrays."""
        del num_steps
        numbers = self.num_steps, self.max_steps
        number, most = (
            jax.device_put(np.array(x, np.int32)) if isinstance(x, int) else x
            for x in numbers
        )
        return replace(self, num_steps=number, max_steps=most)

    @property
    def typical_size(self) -> FloatScalar:
        """Return a typical size of a step, for estimates of the round-off in a step."""
        if self.dt is not None:
            return self.dt
        return self.direction if self.t1 is None else 1e-2 * (self.t1 - self.t0)


Grid: TypeAlias = TimeGrid | VariableGrid


# The default limit of attempted steps. It is also the default limit of diffrax.
_MOST_STEPS = 4096
_NEEDS_SIZE = (
    "`dt` is missing: nhjax.ConstantStepSize needs it. To let the size be chosen, pass "
    "`stepsize_controller=nhjax.PIDController(rtol=1e-6, atol=1e-6)`."
)


def variable_grid(
    controller: AbstractStepSizeController,
    t0: FloatScalar,
    dt: Any,
    t1: FloatScalarLike | None,
    num_steps: Any,
    max_steps: int | None,
) -> tuple[AbstractStepSizeController, VariableGrid, list[Check]]:
    """Return the controller, the nodes and the checks of a run with variable steps.

    **Raises:** `TypeError` and `ValueError` for arguments that cannot be combined.
    """
    dtype, checks = t0.dtype, [finite("t0", t0)]
    if np.ndim(dt) > 1:
        raise ShapeError(
            f"`dt` has shape {np.shape(dt)}: give one size for all steps, or an array "
            "of shape (num_steps,). For many runs, use `jax.vmap`."
        )
    number, most = _numbers(t1, num_steps, max_steps, np.ndim(dt) == 1)
    if np.ndim(dt) == 1:
        if not isinstance(controller, ConstantStepSize):
            raise ValueError(
                "`dt` is an array, which gives the size of each step, together with a "
                "`stepsize_controller` that chooses the sizes. Leave one of them out."
            )
        sizes = real_vector("dt", dt, dtype)
        length = sizes.shape[0]
        if number is not None and number != length:
            raise ValueError(
                f"`dt` has {length} sizes, but `num_steps` is {number}. Leave out "
                "`num_steps` to take these steps one after the other. For runs with "
                "different sizes use `jax.vmap`."
            )
        known: Any = sizes if is_traced(sizes) else np.asarray(sizes)
        numpy: Any = jnp if is_traced(sizes) else np
        same = numpy.all(known != 0) & numpy.all(known * known[0] > 0)
        checks += [finite("dt", sizes), Check(same, _mixed_sizes, (sizes,))]
        direction = jax.lax.stop_gradient(jnp.sign(sizes[0]))
        grid = VariableGrid(t0, sizes[0], None, direction, length, length)
        return GivenStepSizes(sizes), grid, checks
    size = None
    if dt is not None:
        size = real_scalar("dt", dt, dtype)
        checks.append(finite("dt", size))
    elif isinstance(controller, ConstantStepSize):
        raise TypeError(_NEEDS_SIZE)
    end = None if t1 is None else real_scalar("t1", t1, dtype)
    values = [x for x in (t0, size, end) if x is not None]
    # On known values, operations of NumPy take a tenth of the time of JAX operations.
    numpy = jnp if is_traced(*values) else np
    first, step = numpy.asarray(t0), numpy.asarray(1 if size is None else size)
    forward = step if end is None else numpy.asarray(end) - first
    direction = numpy.where(forward < 0, -1, 1).astype(dtype)
    if end is not None:
        checks += [finite("t1", end), Check(forward != 0, _no_time, (t0, end))]
    if size is not None:
        agree = step * direction > 0
        checks.append(Check(agree, _wrong_sign, (size, t0, t0 if end is None else end)))
    checks += controller.checks()
    if most is None:
        most = _default_limit(controller, t0, size, end, number)
    # Tolerances are passed as arrays, so that changing them does not recompile.
    known, rest = eqx.partition((controller, direction), _is_known_number)
    known = jax.tree.map(lambda x: np.asarray(x, dtype), known)
    with jax.ensure_compile_time_eval():
        known = jax.device_put(known)
    controller, direction = eqx.combine(known, rest)
    grid = VariableGrid(t0, size, end, direction, number, most)
    return controller, grid, checks


def _is_known_number(x: Any) -> bool:
    """Return whether a leaf of a controller is a real number that is not traced."""
    if isinstance(x, float | int):
        return not isinstance(x, bool)
    is_array = isinstance(x, np.ndarray | np.generic | jax.Array)
    return is_array and not is_traced(x) and jnp.issubdtype(x.dtype, jnp.inexact)


def _numbers(
    t1: Any, num_steps: Any, max_steps: Any, is_given: bool
) -> tuple[int | None, int | None]:
    """Return the number of steps and the limit of attempts, if they are given."""
    if t1 is not None and is_given:
        raise ValueError(
            "`t1` is given together with an array `dt`, which gives all steps. Leave "
            "out `t1`."
        )
    if t1 is not None and num_steps is not None:
        raise ValueError(
            "`t1` and `num_steps` are both given, and either one ends the run. Leave "
            "one of them out."
        )
    if t1 is None and num_steps is None and not is_given:
        raise TypeError(
            "`t1` is missing: give the end of the run, or `num_steps`, the number of "
            "steps."
        )
    for name, x in (("num_steps", num_steps), ("max_steps", max_steps)):
        if x is None:
            continue
        if isinstance(x, bool) or not isinstance(x, int | np.integer):
            raise TypeError(
                f"`{name}` must be an int that is known when tracing, got {x!r} of "
                f"type {type(x).__name__}."
            )
        if not 1 <= x <= 2**31 - 1:
            raise ValueError(f"`{name}` must be in 1..2^31 - 1, got {x}.")
    number = None if num_steps is None else int(num_steps)
    return number, None if max_steps is None else int(max_steps)


def _default_limit(
    controller: AbstractStepSizeController,
    t0: FloatScalar,
    size: FloatScalar | None,
    end: FloatScalar | None,
    num_steps: int | None,
) -> int:
    """Return the limit of attempts if the user gives none."""
    if num_steps is not None:
        if not controller.estimates_errors:
            return num_steps
        # The limit exceeds `num_steps`, because steps may be repeated.
        return min(max(_MOST_STEPS, 4 * num_steps), 2**31 - 1)
    if not isinstance(controller, ConstantStepSize) or size is None or end is None:
        return _MOST_STEPS
    if not is_traced(t0, size, end):
        number = abs((float(end) - float(t0)) / float(size)) if float(size) else 0.0
        return int(min(np.ceil(number) + 1, 2**31 - 1)) if np.isfinite(number) else 1
    return _MOST_STEPS


def checks_of_output(
    saveat: SaveAt, grid: VariableGrid, controller: AbstractStepSizeController
) -> list[Check]:
    """Return the checks of `SaveAt(ts=...)` in a run with variable steps."""
    if saveat.ts is None:
        return []
    end = grid.t1
    if isinstance(controller, GivenStepSizes):
        end = grid.t0 + jnp.sum(controller.sizes)
    if end is None:
        raise ValueError(
            "SaveAt: `ts` needs `t1`, the end of the run, if a `stepsize_controller` "
            "chooses the sizes of `num_steps` steps."
        )
    ts = saveat.ts.astype(grid.t0.dtype)
    inside = jnp.all(is_within(ts, grid.t0, end))
    is_sorted = jnp.all(jnp.diff(ts) * grid.direction >= 0)
    return [
        Check(inside, _outside, (ts, grid.t0, end)),
        Check(is_sorted, _unsorted, (grid.direction,)),
    ]


def _outside(ts: np.ndarray, t0: np.ndarray, t1: np.ndarray) -> ValueError:
    return ValueError(
        f"SaveAt: `ts` reaches from {float(np.min(ts))} to {float(np.max(ts))}, "
        f"outside the run from {float(t0)} to {float(t1)}."
    )


def _unsorted(direction: np.ndarray) -> ValueError:
    return ValueError(
        "SaveAt: `ts` must be sorted in the direction of time, which runs "
        f"{'forward' if direction > 0 else 'backward'} here."
    )


def _mixed_sizes(sizes: np.ndarray) -> ValueError:
    return ValueError(
        "`dt`: all step sizes must be positive, or all negative to integrate "
        f"backwards, got sizes from {float(np.min(sizes))} to {float(np.max(sizes))}."
    )


def _no_time(t0: np.ndarray, t1: np.ndarray) -> ValueError:
    return ValueError(f"`t1` = {float(t1)} equals `t0` = {float(t0)}: no time passes.")


def _wrong_sign(size: np.ndarray, t0: np.ndarray, t1: np.ndarray) -> ValueError:
    return ValueError(
        f"`dt` = {float(size)} does not lead from `t0` = {float(t0)} to `t1` = "
        f"{float(t1)}: give it the sign of t1 - t0, and not zero."
    )
