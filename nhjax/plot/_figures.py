"""Figures of trajectories, of errors against time, and of convergence."""

from collections.abc import Sequence
from typing import Any, TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Float

from .._custom_types import Args
from .._integrate import Solution
from .._system import AbstractMechanicalSystem
from ..diagnostics import (
    check_is_system,
    energy_error,
    map_over_axes,
    real_array,
    saved_states,
)
from ._style import grey, new_axes, styled


if TYPE_CHECKING:
    from matplotlib.axes import Axes


@styled
def trajectory(
    sol: Solution,
    coordinates: Sequence[int | str] = (0, 1),
    *,
    names: Sequence[str] | None = None,
    ground: float | None = None,
    ax: "Axes | None" = None,
    **style: Any,
) -> "Axes":
    """Draw the path of two or three coordinates of a trajectory.

    One unit has the same length on all axes.

    **Arguments:**

    - `sol`: a `Solution` with saved states; for a batch, one path is drawn for each
        member.
    - `coordinates`: the indices of two or three entries of q, or their names if the
        system has `coordinates`. On a group, an index selects one entry of the
        flattened array of a group element. On a product of groups, the flattened arrays
        of all factors are joined in order.
    - `names`: the labels of the axes. The default is the names that the system has for
        its coordinates, or q₁, q₂, ....
    - `ground`: the value of the third coordinate at which a plane is drawn.
    - `ax`: the axes to draw into; three coordinates need a 3d projection.
    - `style`: passed on to `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` if `sol` has fewer than two states, if `coordinates` are
    out of range, or if `ground` is given for two coordinates.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), dt=0.1, num_steps=90,
        ...     saveat=nhjax.SaveAt(t0=True, steps=True))
        >>> ax = nhjax.plot.trajectory(sol, names=("x", "y"))
    """
    _, ys = saved_states(sol)
    lead = np.asarray(ys.p).shape[:-1]
    if lead[-1] < 2:
        raise ValueError(
            "The solution has only one state of each trajectory, but a path needs two: "
            "pass `saveat=nhjax.SaveAt(t0=True, steps=True)` to `integrate`."
        )
    parts = [np.asarray(leaf).reshape(*lead, -1) for leaf in jax.tree.leaves(ys.q)]
    q = np.concatenate(parts, axis=-1)
    n = q.shape[-1]
    # On a group, the names belong to the velocities. They are not used if an element of
    # the group has more numbers than there are velocities.
    known = sol.coordinates or ()
    known = known if len(known) == n else ()
    chosen = _indices(coordinates, n, known)
    names = _names(names, [known[i] if known else f"$q_{i % n + 1}$" for i in chosen])
    spatial = len(chosen) == 3
    if ground is not None and not spatial:
        raise ValueError("`ground` needs three coordinates, got two.")
    ax = new_axes(ax, projection="3d" if spatial else None)
    for path in q.reshape(-1, *q.shape[-2:])[..., chosen]:
        ax.plot(*path.T, **style)
    for letter, name in zip("xyz", names, strict=False):
        getattr(ax, f"set_{letter}label")(name)
    if spatial:
        _set_box(ax, ground)
    ax.set_aspect("equal", adjustable="datalim")
    if ground is not None:
        _add_ground(ax, ground)
    return ax


def _indices(coordinates: Any, n: int, known: tuple[str, ...]) -> list[int]:
    """Return the indices of the coordinates, which may be given by name."""
    if not isinstance(coordinates, Sequence | np.ndarray) or not all(
        isinstance(i, int | np.integer | str) for i in coordinates
    ):
        raise TypeError(
            "`coordinates` must be a sequence of ints, or of names of coordinates of "
            f"the system, got {coordinates!r}."
        )
    unknown = [x for x in coordinates if isinstance(x, str) and x not in known]
    if unknown:
        listed = f"the names are {', '.join(known)}" if known else "there are no names"
        raise ValueError(
            f"`coordinates` has {unknown[0]!r}, but {listed}. Names are the "
            "`coordinates` of the system."
        )
    chosen = [known.index(x) if isinstance(x, str) else int(x) for x in coordinates]
    if len(chosen) not in (2, 3) or not all(-n <= i < n for i in chosen):
        raise ValueError(
            f"`coordinates` must be two or three indices into the {n} coordinates of "
            f"the system, got {tuple(coordinates)}."
        )
    return chosen


def _set_box(ax: Any, ground: float | None) -> None:
    """Include the ground, and give the box the data's proportions, at most 2 : 1."""
    if ground is not None:
        low, high = ax.get_zlim()
        ax.set_zlim(min(low, ground), max(high, ground))
    sides = np.ptp([ax.get_xlim(), ax.get_ylim(), ax.get_zlim()], axis=1)
    ax.set_box_aspect(np.maximum(sides, 0.5 * np.max(sides)), zoom=0.8)
    ax.locator_params(nbins=5)


def _add_ground(ax: Any, height: float) -> None:
    """Draw a horizontal plane over the range of the axes."""
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    x, y = np.array([[x0, x1], [x0, x1]]), np.array([[y0, y0], [y1, y1]])
    z = np.full((2, 2), height)
    ax.plot_surface(x, y, z, color=grey(0.8), alpha=0.5, shade=False, zorder=0)


@styled
def energy(
    system: AbstractMechanicalSystem,
    sol: Solution,
    args: Args = None,
    *,
    ax: "Axes | None" = None,
    **style: Any,
) -> "Axes":
    """Draw the energy error E(t) - E(t0) against time.

    **Arguments:**

    - `system`, `sol`, `args`: as for `nhjax.energy_error`.
    - `ax`: the axes to draw into.
    - `style`: passed on to `Axes.plot`.

    **Returns:** the axes.

    **Raises:** the errors of `nhjax.energy_error`.
    """
    errors = energy_error(system, sol, args)
    ax = _against_time(sol.ts, errors, ax, style)
    ax.set_ylabel("$E(t) - E(t_0)$")
    return ax


@styled
def multiplier(sol: Solution, *, ax: "Axes | None" = None, **style: Any) -> "Axes":
    """Draw the multipliers λ_a against time, with a line for each constraint.

    **Arguments:**

    - `sol`: a `Solution` with saved states.
    - `ax`: the axes to draw into.
    - `style`: passed on to `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` if `sol` has no states, or the system has no constraints.
    """
    ts, ys = saved_states(sol)
    values = np.asarray(ys.multiplier)
    symbols = [rf"$\lambda_{a + 1}$" for a in range(values.shape[-1])]
    ax = _each_constraint(ts, values, symbols, ax, style)
    ax.set_ylabel("multiplier")
    return ax


@styled
def constraint(
    system: AbstractMechanicalSystem,
    sol: Solution,
    args: Args = None,
    *,
    ax: "Axes | None" = None,
    **style: Any,
) -> "Axes":
    """Draw the values of the constraint functions at the saved states against time.

    For each nonholonomic constraint the figure shows the value Φ_a, and for each
    holonomic constraint the value Γ_a and its time derivative dΓ_a/dt.

    **Arguments:**

    - `system`: the system that was integrated.
    - `sol`: a `Solution` with saved states.
    - `args`: the `args` of the integration.
    - `ax`: the axes to draw into.
    - `style`: passed on to `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` if `sol` has no states, or the system has no constraints.
    """
    check_is_system(system)
    ts, ys = saved_states(sol)

    violation = map_over_axes(
        ts.ndim, lambda t, y: system.constraint_violation(t, y, args)
    )
    values = np.asarray(violation(ts, ys))
    k = values.shape[-1] - ys.multiplier.shape[-1]
    m = values.shape[-1] - 2 * k
    symbols = [rf"$\Phi_{a + 1}$" for a in range(m)]
    symbols += [rf"$d\Gamma_{a + 1}/dt$" for a in range(k)]
    symbols += [rf"$\Gamma_{a + 1}$" for a in range(k)]
    ax = _each_constraint(ts, values, symbols, ax, style)
    ax.set_ylabel("constraint")
    return ax


@styled
def convergence(
    step_sizes: Float[np.ndarray, " k"] | Sequence[float],
    errors: Float[np.ndarray, " k"] | Sequence[float],
    *,
    order: int | None = None,
    ax: "Axes | None" = None,
    **style: Any,
) -> "Axes":
    """Draw errors against step sizes on logarithmic scales.

    **Arguments:**

    - `step_sizes`, `errors`: vectors of the same length; errors that are not positive
        or not finite are ignored.
    - `order`: the slope of a dashed reference line. The line is drawn below the errors
        and labelled with its slope.
    - `ax`: the axes to draw into.
    - `style`: passed on to `Axes.plot`.

    **Returns:** the axes.

    **Raises:** `ValueError` if the lengths differ, or if no error is positive.

    !!! example

        >>> import nhjax
        >>> ax = nhjax.plot.convergence([0.2, 0.1], [1.6e-3, 1e-4], order=4)
    """
    h, e = np.abs(real_array("step_sizes", step_sizes)), real_array("errors", errors)
    if h.ndim != 1 or h.shape != e.shape:
        raise ValueError(
            "`step_sizes` and `errors` must be vectors of the same length, got shapes "
            f"{h.shape} and {e.shape}."
        )
    shown = np.isfinite(e) & (e > 0)
    if not np.any(shown):
        raise ValueError(f"`errors` must contain a positive number, got {errors}.")
    h, e = h[shown], e[shown]
    ax = new_axes(ax)
    (line,) = ax.plot(h, e, **{"marker": "o", "markersize": 4, **style})
    if order is not None and not isinstance(order, int | float | np.number):
        raise TypeError(f"`order` must be a number or None, got {order!r}.")
    if order is not None:
        # The reference line is placed relative to the error at the middle step size,
        # because the largest step may not be in the asymptotic regime, and the error of
        # the smallest step may be round-off.
        middle = np.argsort(h)[len(h) // 2]
        reference = 0.3 * e[middle] * (h / h[middle]) ** order
        ax.plot(h, reference, linestyle="--", linewidth=0.8, color=line.get_color())
        last = np.argmin(h)
        ax.annotate(
            f"slope {order:g}",
            (h[last], reference[last]),
            textcoords="offset points",
            xytext=(4, -9),
            fontsize="small",
            color=line.get_color(),
        )
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("step size $h$")
    ax.set_ylabel("error")
    return ax


def _against_time(ts: Any, values: Any, ax: "Axes | None", style: Any) -> "Axes":
    ax = new_axes(ax)
    times, values = np.asarray(ts), np.asarray(values)
    # The members of a batch become columns, because matplotlib draws a line for each
    # column.
    ax.plot(_columns(times), _columns(values), **style)
    ax.set_xlabel("time $t$")
    return ax


def _each_constraint(
    ts: Any, values: np.ndarray, symbols: list[str], ax: "Axes | None", style: Any
) -> "Axes":
    count = values.shape[-1]
    if count == 0:
        raise ValueError("The system has no constraints.")
    for a in range(count):
        label = {"label": symbols[a]} if count > 1 else {}
        ax = _against_time(ts, values[..., a], ax, {**label, **style})
    assert ax is not None
    if count > 1:
        ax.legend()
    return ax


def _columns(x: np.ndarray) -> np.ndarray:
    return x.reshape(-1, x.shape[-1]).T


def _names(names: Sequence[str] | None, default: list[str]) -> Sequence[str]:
    if names is None:
        return default
    if len(names) != len(default):
        raise ValueError(f"`names` must have {len(default)} names, got {len(names)}.")
    return names
