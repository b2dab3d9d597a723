"""Steady motions: equilibria, and motions that are steady up to symmetries."""

from collections.abc import Sequence
from typing import overload

import equinox as eqx
from jaxtyping import Array, Float

from .._custom_types import Args, FloatScalarLike
from .._errors import require
from .._numerics import frozen
from .._system import (
    AbstractMechanicalSystem,
    parameters,
    State,
)
from ._arguments import checked_count, checked_time
from ._permitted import orthonormal_basis
from ._perturbation import Indices, indices
from ._slopes import size_of, Slopes, slopes_along_symmetry
from ._steady_equations import steady_along, steady_in_indices
from ._symmetry import check_symmetry, checks_of, judged, Symmetry, Verdict


@overload
def steady_motion(
    system: AbstractMechanicalSystem,
    t: FloatScalarLike,
    y: State,
    args: Args = None,
    *,
    positions: Sequence[int],
    velocities: Sequence[int],
    held_positions: Sequence[int] = (),
    held_velocities: Sequence[int] = (),
    max_iterations: int = 50,
) -> State: ...


@overload
def steady_motion(
    system: AbstractMechanicalSystem,
    t: FloatScalarLike,
    y: State,
    args: Args = None,
    *,
    symmetry: Symmetry,
    held_positions: Sequence[int] = (),
    held_velocities: Sequence[int] = (),
    max_iterations: int = 50,
) -> tuple[State, Float[Array, " k"]]: ...


def steady_motion(
    system: AbstractMechanicalSystem,
    t: FloatScalarLike,
    y: State,
    args: Args = None,
    *,
    positions: Sequence[int] | None = None,
    velocities: Sequence[int] | None = None,
    symmetry: Symmetry | None = None,
    held_positions: Sequence[int] = (),
    held_velocities: Sequence[int] = (),
    max_iterations: int = 50,
) -> State | tuple[State, Float[Array, " k"]]:
    """Find the steady motion, or relative equilibrium, that is near to a given state.

    There are two ways to say what is steady. With `positions` and `velocities` it is a
    consistent state at which the chosen positions do not change, and the rates of
    change of the chosen velocities vanish,

    v_j = 0 for j in `positions`,   u̇_i = 0 for i in `velocities`,

    u being the velocity or for a Hamiltonian system the momentum. The other coordinates
    may change, as the place of a bicycle that runs in a circle does.

    With `symmetry` it is a consistent state that moves as symmetries of the system move
    it: with x = (q, u), the equations of motion ẋ = f(x) and the generators X_k,

    f(x) = Σ c_k X_k(x).

    The state and the rates c are found together. So a wheel rolls on a circle, or a top
    precesses, though no coordinates of their attitude are constant.

    Where these equations leave a family of steady motions, the result is the one that
    Newton's method with the smallest increments leads to; `held_...` picks another one,
    such as that of a given speed or lean. What symmetries do to a state is left
    undone, as far as what is held allows it.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time at which functions that depend on time are taken.
    - `y`: a state from which the search starts.
    - `args`: passed on to the functions of the system.
    - `positions`, `velocities`: the indices of what is to be steady. Leave out what
        follows from the rest: positions that holonomic constraints tie, velocities that
        follow from nonholonomic ones, and a speed whose rate vanishes with the others
        because energy is conserved.
    - `symmetry`: generators of symmetries, as `linear_stability` takes them, in place
        of `positions` and `velocities`.
    - `held_positions`, `held_velocities`: the indices of what keeps its value in `y`.
        On a group a position is held if ξ has no such component in q τ(ξ), where q is
        the configuration of `y`.
    - `max_iterations`: the largest number of iterations.

    **Returns:** a consistent `State`, and with `symmetry` a pair of it and the rates c
    of the generators, shape (k,), in units of the velocity over those of a generator.
    `linear_stability` with the same `symmetry` takes the state. Both are twice
    differentiable with respect to `y` and `args` by the implicit function theorem,
    where the steady motion is the only one with the held values, or one of a family
    that differs in what nothing depends on. In other families the derivative is that of
    one more increment of Newton's method.

    **Raises:** `NewtonError` if there is none near to `y`; `ValueError` or `TypeError`
    if an index is wrong; `ValueError` if neither or both of the two ways are chosen,
    or if generators are dependent, not closed, or no symmetries, which is checked as
    `linear_stability` does it; `DependentConstraintsError` if constraints are dependent
    and there is a `symmetry`; `TypeError` if `system` is no system, `y` no `State` or
    `symmetry` no function; `ShapeError` if `y` is no state of this system, or many, or
    generators no velocities. Under `jit` what depends on values comes as an error of
    JAX with the same message.

    !!! example

        A pendulum of length 1 m under unit gravity goes round on a cone at the rate
        (g / l cos θ)^½:

        >>> import jax.numpy as jnp, nhjax
        >>> pendulum = nhjax.systems.SphericalPendulum(
        ...     q0=(0.9682458365518543, 0.0, -0.25), v0=(0.0, 1.0, 0.0))
        >>> y, rates = nhjax.steady_motion(
        ...     pendulum.system, 0.0, pendulum.initial_state(),
        ...     symmetry=lambda q: jnp.stack([-q[1], q[0], 0 * q[2]]),
        ...     held_positions=(2,))
        >>> [round(float(rate), 12) for rate in rates]
        [2.0]
    """
    args, max_iterations = (
        parameters(args),
        checked_count("max_iterations", max_iterations),
    )
    t, dim = checked_time("steady_motion", system, t, y, args), y.p.shape[0]
    held = (
        *indices("held_positions", held_positions, dim),
        *(dim + i for i in indices("held_velocities", held_velocities, dim)),
    )
    if symmetry is None:
        steady = _chosen(positions, velocities, dim)
        outcome = steady_in_indices(system, t, y, args, steady, held, max_iterations)
        return require(outcome.state, *outcome.checks)
    if positions is not None or velocities is not None:
        raise ValueError(
            "Give either `symmetry`, along which the state is to move, or `positions` "
            "and `velocities`, not both."
        )
    check_symmetry(symmetry, y)
    outcome = steady_along(system, t, y, args, symmetry, held, max_iterations)
    # What tells symmetries is the program of `linear_stability`, which mostly follows.
    given = frozen((system, t, outcome.state, args))
    verdict = _verdict(slopes_along_symmetry(*given, symmetry), given[2])
    return require(
        (outcome.state, outcome.rates),
        *outcome.checks,
        *checks_of(frozen(verdict)),
    )


def _chosen(
    positions: Sequence[int] | None, velocities: Sequence[int] | None, dim: int
) -> tuple[Indices, Indices]:
    if positions is None or velocities is None:
        missing = "positions" if positions is None else "velocities"
        raise ValueError(
            f"`{missing}` is missing: give `positions` and `velocities` together, the "
            "indices of what is to be steady, or a `symmetry`."
        )
    return indices("positions", positions, dim), indices("velocities", velocities, dim)


@eqx.filter_jit
def _verdict(slopes: Slopes, y: State) -> Verdict:
    """Judge the generators at a state."""
    orbit = slopes.orbit
    assert orbit is not None
    permitted = orthonormal_basis(slopes.rows, orbit.directions)
    return judged(orbit, slopes.rows, permitted, size_of(y))
