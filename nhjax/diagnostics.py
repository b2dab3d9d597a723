"""Energy errors, momentum maps and convergence orders of computed trajectories."""

import reprlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._custom_types import Args
from ._errors import is_traced, naming, ShapeError
from ._integrate import Solution
from ._system import (
    AbstractMechanicalSystem,
    check_type,
    HamiltonianSystem,
    LagrangianSystem,
    State,
)


def energy_error(
    system: AbstractMechanicalSystem, sol: Solution, args: Args = None
) -> Float[Array, "... k"]:
    """Compute the energy error E(t) - E(t0) along a saved trajectory.

    The function works under `vmap`. It also works on a solution returned by `vmap`, if
    all members share `system` and `args`.

    **Arguments:**

    - `system`: the system that was integrated.
    - `sol`: a `Solution` whose first saved state is the initial state, for instance
        saved by `SaveAt(t0=True, steps=True)`.
    - `args`: the `args` of the integration.

    **Returns:** an array of the shape of `sol.ts`.

    **Raises:** `ValueError` if `sol` has no states, or lacks the initial one;
    `TypeError` if `system` is not a system or `sol` is not a solution.

    !!! example

        >>> import nhjax
        >>> disc = nhjax.systems.VerticalRollingDisc()
        >>> sol = nhjax.integrate(disc.system, nhjax.LobattoIIIAB(3),
        ...     disc.initial_state(), dt=0.1, num_steps=10,
        ...     saveat=nhjax.SaveAt(t0=True, steps=True))
        >>> nhjax.energy_error(disc.system, sol).shape
        (11,)
    """
    check_is_system(system)
    ts, ys = saved_states(sol)
    first = ts[..., 0]
    if not is_traced(first, sol.t0) and np.any(np.asarray(first != sol.t0)):
        raise ValueError(
            "The initial state was not saved, so that its energy is not known: "
            "pass `saveat=nhjax.SaveAt(t0=True, ...)` to `integrate`."
        )
    energy = map_over_axes(ts.ndim, lambda t, y: system.energy(t, y, args))(ts, ys)
    return energy - energy[..., :1]


def momentum_map(
    y: State, generator: Callable[[Any], Float[Array, " n"]]
) -> Float[Array, "..."]:
    """Compute the momentum p · ξ_Q(q) along an infinitesimal symmetry ξ_Q.

    The momentum is conserved under three conditions: ξ_Q is a symmetry of the
    Lagrangian; the constraints permit the virtual displacement ξ_Q, that is,
    D2Φ · ξ_Q = 0; and external forces do no work along ξ_Q. Otherwise the momentum
    satisfies the nonholonomic momentum equation.

    **Arguments:**

    - `y`: a state, or a trajectory of states such as `sol.ys`.
    - `generator`: the vector field ξ_Q, of shape (n,), called as `generator(q)` with
        one configuration. On a group it is left-trivialised like the velocity: for the
        symmetry g -> exp(εξ) g, return `manifold.Ad(manifold.inverse(q), xi)`.

    **Returns:** one number for each state.

    **Raises:** `ShapeError` if `generator` returns an array of another shape;
    `TypeError` if `y` is not a state or `generator` is not a function.

    !!! example

        The spin of a rolling disc about the vertical:

        >>> import jax.numpy as jnp, nhjax
        >>> y0 = nhjax.systems.VerticalRollingDisc().initial_state()
        >>> turn = lambda q: jnp.array([0.0, 0.0, 0.0, 1.0], q.dtype)
        >>> round(float(nhjax.momentum_map(y0, turn)), 6)
        0.175
    """
    check_type("y", y, State, "Pass for instance `sol.ys` or an entry of it.")
    if not callable(generator):
        raise TypeError(
            f"`generator` must be a function of q, got {reprlib.repr(generator)} of "
            f"type {type(generator).__name__}."
        )

    def pairing(q, p):
        with naming("generator(q)", generator):
            direction = jnp.asarray(generator(q))
        if direction.shape != p.shape:
            raise ShapeError(
                f"`generator(q)` has shape {direction.shape}, expected {p.shape}: one "
                "component for each velocity."
            )
        return p @ direction

    return map_over_axes(y.p.ndim - 1, pairing)(y.q, y.p)


def convergence_order(
    step_sizes: Float[np.ndarray, " k"] | list[float] | tuple[float, ...],
    errors: Float[np.ndarray, "k ..."] | list[float] | tuple[float, ...],
) -> Float[np.ndarray, "l ..."]:
    """Compute the observed orders Δ log(error) / Δ log(h) between successive steps h.

    **Arguments:**

    - `step_sizes`: at least two step sizes, shape (k,).
    - `errors`: the error for each step size, shape (k, ...).

    **Returns:** a NumPy array of shape (k - 1, ...).

    **Raises:** `ValueError` if successive step sizes are equal, if a step size is zero
    or not finite, or if errors are not positive and finite; `TypeError` if an argument
    has entries that are not numbers.

    !!! example

        >>> import nhjax
        >>> nhjax.convergence_order([0.2, 0.1, 0.05], [1.6e-3, 1e-4, 6.25e-6])
        array([4., 4.])
    """
    h = np.abs(real_array("step_sizes", step_sizes))
    e = real_array("errors", errors)
    if h.ndim != 1 or h.shape[0] < 2:
        raise ValueError(
            f"`step_sizes` must be a vector of at least two, got shape {h.shape}."
        )
    if e.shape[:1] != h.shape:
        raise ValueError(
            f"`errors` must have one entry for each of the {h.shape[0]} step sizes, "
            f"got shape {e.shape}."
        )
    if not np.all(np.isfinite(h) & (h > 0)):
        raise ValueError(f"`step_sizes` must be finite and nonzero, got {step_sizes}.")
    if np.any(h[1:] == h[:-1]):
        raise ValueError(
            f"`step_sizes` must differ from one to the next, got {step_sizes}."
        )
    bad = ~(np.isfinite(e) & (e > 0))
    if np.any(bad):
        where = tuple(int(i) for i in np.argwhere(bad)[0])
        raise ValueError(
            f"`errors` must be positive and finite, but errors{where} = {e[where]}. "
            "Omit this entry."
        )
    widths = np.diff(np.log(h)).reshape(-1, *([1] * (e.ndim - 1)))
    return np.diff(np.log(e), axis=0) / widths


def real_array(name: str, x: Any) -> np.ndarray:
    """Convert `x` to a float64 array on the host, or raise a `TypeError`."""
    try:
        return np.asarray(x, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(
            f"`{name}` must be an array of real numbers, got {reprlib.repr(x)} of type "
            f"{type(x).__name__}."
        ) from None


def check_is_system(system: Any) -> None:
    """Raise a `TypeError` if `system` is not a mechanical system of nhjax."""
    check_type("system", system, (LagrangianSystem, HamiltonianSystem))


def saved_states(sol: Solution) -> tuple[Float[Array, "... k"], State]:
    """Return the times and states of `sol`, or raise if states were not saved."""
    check_type("sol", sol, Solution, "`nhjax.integrate` returns one.")
    if sol.ts is None or not isinstance(sol.ys, State):
        held = "no values" if sol.ts is None else f"values of type {type(sol.ys)}"
        raise ValueError(
            f"The solution has {held} where states are needed: pass "
            "`saveat=nhjax.SaveAt(t0=True, steps=True)`, without `fn`, to `integrate`."
        )
    return sol.ts, sol.ys


def map_over_axes(axes: int, function: Callable[..., Array]) -> Callable[..., Array]:
    """Map a function over the given number of leading axes of its arguments."""
    for _ in range(axes):
        function = jax.vmap(function)
    return function
