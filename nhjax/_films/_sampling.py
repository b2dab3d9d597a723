"""The configurations of a solution at the times of a film's frames."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from .._integrate import Solution
from .._manifold import AbstractLieGroup, Euclidean
from .._system import State


def check_solution(who: str, sol: Any) -> None:
    """Raise if `sol` is not the solution of one run."""
    if not isinstance(sol, Solution):
        raise TypeError(
            f"{who}: `sol` must be a Solution of nhjax.integrate, got "
            f"{type(sol).__name__}."
        )
    if jnp.ndim(sol.t0):
        raise ValueError(
            f"{who}: `sol` is a batch of shape {jnp.shape(sol.t0)}. Select one member: "
            "`jax.tree.map(lambda x: x[0], sol)`."
        )
    if sol.interpolation is None and not isinstance(sol.ys, State):
        raise ValueError(
            f"{who}: `sol` has no saved states. Pass `saveat=nhjax.SaveAt(dense=True)` "
            "or `nhjax.SaveAt(t0=True, steps=True)`, without `fn`, to integrate."
        )


def ends_of_output(who: str, sol: Solution) -> tuple[float, float]:
    """Return the first and the last time at which the configuration is known."""
    if sol.interpolation is not None:
        return float(sol.t0), float(sol.t1)
    saved, _ = _rows(who, sol)
    return float(saved[0]), float(saved[-1])


def frame_times(who: str, sol: Solution, spacing: float) -> np.ndarray:
    """Return the times of the frames, equally spaced from the start of the output."""
    first, last = ends_of_output(who, sol)
    duration = abs(last - first)
    # Without the factor, round-off could remove the last frame.
    steps = np.arange(int(duration / spacing * (1 + 1e-9)) + 1)
    return first + np.sign(last - first) * np.minimum(steps * spacing, duration)


def configurations(
    who: str,
    sol: Solution,
    times: np.ndarray,
    manifold: AbstractLieGroup | None,
) -> PyTree[Array]:
    """Compute the configurations at given times, stacked along the first axis.

    If `sol` has dense output, this output is evaluated. Otherwise, between two saved
    states, q follows a cubic polynomial in the chart at the earlier state. The
    polynomial matches the configurations and the velocities of both states.
    """
    if sol.interpolation is not None:
        evaluate = jax.jit(jax.vmap(lambda t: sol.evaluate(t).q))
        q = evaluate(jnp.asarray(times, sol.interpolation.t0.dtype))
    else:
        q = _between_rows(who, sol, times, manifold)
    if not all(np.all(np.isfinite(x)) for x in jax.tree.leaves(q)):
        raise ValueError(
            f"{who}: `sol` has configurations that are not finite. If the run has "
            "failed, draw the part before the failure."
        )
    return q


def _rows(who: str, sol: Solution) -> tuple[np.ndarray, State]:
    """Return the times and the states that were saved, without unused entries."""
    ts = np.asarray(sol.ts)
    used = np.isfinite(ts)
    # After an event that ends the run, all later entries repeat its time.
    used[1:] &= ts[1:] != ts[:-1]
    if not np.any(used):
        raise ValueError(f"{who}: `sol` has no saved states: it is empty.")
    return ts[used], jax.tree.map(lambda x: x[used], sol.ys)


def _between_rows(
    who: str, sol: Solution, times: np.ndarray, manifold: AbstractLieGroup | None
) -> PyTree[Array]:
    ts, ys = _rows(who, sol)
    if len(ts) == 1:
        return jax.tree.map(lambda x: jnp.repeat(x, len(times), axis=0), ys.q)
    if manifold is None:
        if not isinstance(ys.q, jax.Array):
            raise ValueError(
                f"{who}: the configurations are tuples. Give the Looks their "
                "`manifold`, or save dense output: `saveat=nhjax.SaveAt(dense=True)`."
            )
        manifold = Euclidean(ys.q.shape[1])
    group = manifold
    starts = jax.tree.map(lambda x: x[:-1], ys)
    ends = jax.tree.map(lambda x: x[1:], ys)
    steps = jnp.asarray(np.diff(ts))

    @jax.jit
    @jax.vmap
    def polynomials(start, end, step):
        chord = group.local(group.compose(group.inverse(start.q), end.q))
        first, last = step * start.v, step * end.v
        return chord, first, group.dtau_inv(chord, last), last

    chords, first, last, travel = polynomials(starts, ends, steps)
    spacing = float(np.min(np.abs(np.diff(times)))) if len(times) > 1 else np.inf
    if float(np.max(np.abs(np.diff(ts)))) > 1.01 * spacing:
        _check_spacing(who, np.asarray(chords), np.asarray(first), np.asarray(travel))
    forward = 1 if ts[-1] > ts[0] else -1
    place = np.searchsorted(forward * ts, forward * times, side="right") - 1
    place = np.clip(place, 0, len(ts) - 2)
    share = jnp.asarray((times - ts[place]) / np.diff(ts)[place])

    @jax.jit
    @jax.vmap
    def interpolate(q, chord, first, last, s):
        # The cubic polynomial has the values 0 and `chord` and the derivatives `first`
        # and `last` at s = 0 and s = 1.
        xi = s * (1 - s) * ((1 - s) * first - s * last) + s * s * (3 - 2 * s) * chord
        return group.compose(q, group.retract(xi))

    at = jax.tree.map(lambda x: x[place], (starts.q, chords, first, last))
    return interpolate(*at, share)


# The travel between two saved states is the mean of their velocities times the time
# between them. The defect is the displacement minus the travel, relative to the travel.
# A harmonic motion with four saved states in a period has the defect
# tan(π/4) / (π/4) - 1 = 0.27, which is just too large.
_LARGEST_DEFECT = 0.25


def _check_spacing(
    who: str, chords: np.ndarray, first: np.ndarray, last: np.ndarray
) -> None:
    """Raise if the saved states are so far apart that their velocities contradict q."""
    travel = (first + last) / 2
    sizes = np.sqrt(np.mean(travel**2, axis=0))
    defects = np.sqrt(np.mean((chords - travel) ** 2, axis=0))
    counts = sizes > 1e-3 * np.max(sizes, initial=0.0)
    if np.any(defects[counts] > _LARGEST_DEFECT * sizes[counts]):
        worst = int(np.argmax(np.where(counts, defects / np.maximum(sizes, 1e-300), 0)))
        raise ValueError(
            f"{who}: the saved states of `sol` are too far apart: coordinate {worst} "
            "moves differently between them than its saved velocities say. Pass "
            "`saveat=nhjax.SaveAt(dense=True)` to integrate, or save more states."
        )
