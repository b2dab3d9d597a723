"""Steady motions: equilibria, and motions that are steady up to symmetries."""

import operator
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._compile import as_cpu_kernel, tracked_jit
from .._custom_types import Args, BoolScalar, FloatScalar, FloatScalarLike
from .._errors import Check, NewtonError, require
from .._numerics import (
    ClosureConverted,
    frozen,
    iterate,
    jacobian_and_value,
    max_norm,
    Sizes,
    Solved,
    unit,
)
from .._system import AbstractMechanicalSystem, linearise, parameters, State
from ._linearisation import (
    check_symmetry,
    checks_of,
    Indices,
    indices,
    judged,
    lifted,
    orthonormal_basis,
    perturbed,
    size_of,
    Slopes,
    slopes_along_symmetry,
    Symmetry,
    Verdict,
)
from ._motion import checked_time


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


class Outcome(NamedTuple):
    """The state, the rates of generators, and how Newton's method ended."""

    state: State
    rates: Float[Array, " k"]
    residual: FloatScalar
    converged: BoolScalar
    num_iterations: Int[Array, ""]

    @property
    def checks(self) -> tuple[Check, ...]:
        """Return the condition that a steady motion was found."""
        values = (self.num_iterations, self.residual, self.state)
        return (Check(self.converged, _not_found, values),)


def _not_found(count: np.ndarray, residual: np.ndarray, y: State) -> NewtonError:
    return NewtonError(
        f"No steady motion was found from `y` in {int(count)} iterations: Newton's "
        f"method stopped at q = {y.q}, v = {y.v} with the residual "
        f"{float(residual):.3g}. Start nearer to one, hold fewer indices, or leave out "
        "one whose rate follows from others."
    )


@tracked_jit("system", "args")
def steady_in_indices(system, t, y, args, steady, held, max_iterations) -> Outcome:
    """Solve for a state whose chosen positions and velocities do not change."""
    positions, velocities = (jnp.asarray(x, int) for x in steady)

    def residual(x):
        q, u = perturbed(system, y, x)
        rate = linearise(system, t, q, u, args).acceleration
        return jnp.concatenate(
            [
                system.position_constraint(t, q, args),
                system.constraint(t, q, u, args),
                system.velocity(t, q, u, args)[positions],
                rate[velocities],
            ]
        )

    none = jnp.zeros(0, y.p.dtype)
    return _outcome(system, t, y, args, held, max_iterations, residual, none)


@tracked_jit("system", "args", "symmetry")
def steady_along(system, t, y, args, symmetry, held, max_iterations) -> Outcome:
    """Solve for a state that moves along generators of symmetries, and their rates."""
    dim = y.p.shape[0]

    def fields(x):
        q, u = perturbed(system, y, x)
        rate = linearise(system, t, q, u, args).acceleration
        motion = jnp.concatenate([system.velocity(t, q, u, args), rate])
        lifts = lifted(system, symmetry, t, q, u, args)
        constraints = [
            system.position_constraint(t, q, args),
            system.constraint(t, q, u, args),
        ]
        return motion, jnp.concatenate(lifts, axis=1), constraints

    # The rates with which the generators move the configuration as nearly as it moves.
    here = frozen(lifted(system, symmetry, t, y.q, system.fibre_coordinate(y), args))
    guess = jnp.linalg.pinv(here[0].T) @ frozen(y.v)
    phases = _phases(jnp.concatenate(here, axis=1), held)

    def residual(z):
        motion, ways, constraints = fields(z[: 2 * dim])
        left = motion - (guess + z[2 * dim :]) @ ways
        return jnp.concatenate([*constraints, left, phases @ z[: 2 * dim]])

    return _outcome(system, t, y, args, held, max_iterations, residual, guess)


def _phases(ways: Float[Array, "k x"], held: Indices) -> Float[Array, "k x"]:
    """Compute phase conditions, which keep perturbations from going along symmetries.

    Steady motions come in families that differ by symmetries, and nothing else tells
    Newton's method which one of a family to find. Each row is a direction in which a
    perturbation must have no part. Combinations of generators that change what is held
    are left out, since holding it excludes them already.
    """
    moved = ways[:, jnp.asarray(held, int)]
    unit = jnp.eye(ways.shape[0], dtype=ways.dtype)
    return (unit - moved @ jnp.linalg.pinv(moved)) @ ways


def _outcome(
    system, t, y, args, held, max_iterations, residual, guess: Float[Array, " k"]
) -> Outcome:
    """Solve for the perturbation of the state `y` and that of the rates `guess`."""
    dim, count = y.p.shape[0], guess.shape[0]

    def in_one_program(z):
        return as_cpu_kernel(residual, z)

    free = jnp.ones(2 * dim + count, y.p.dtype).at[jnp.asarray(held, int)].set(0)
    is_flat = system.manifold_of(y.q).is_flat
    positions_here = ravel_pytree(y.q)[0] if is_flat else jnp.ones_like(y.p)
    start = jnp.concatenate([positions_here, system.fibre_coordinate(y), guess])
    z, left, solved = nearest_root(
        in_one_program, free, start, (dim, dim, count), max_iterations
    )
    q, u = perturbed(system, y, z[: 2 * dim])

    def multiplier(q, u):
        return linearise(system, t, q, u, args).multiplier

    found = State(
        q=q,
        v=system.velocity(t, q, u, args),
        p=system.momentum(t, q, u, args),
        multiplier=as_cpu_kernel(multiplier, q, u),
    )
    return Outcome(
        found,
        guess + z[2 * dim :],
        max_norm(left),
        solved.converged,
        solved.num_iterations,
    )


def nearest_root(
    residual: Callable[[Array], Array],
    free: Float[Array, " k"],
    start: Float[Array, " k"],
    groups: Sequence[int],
    max_iterations: int,
) -> tuple[Float[Array, " k"], Array, Solved[Array, Any]]:
    """Find a root by Newton's method from zero, with the smallest increments.

    There may be fewer equations than unknowns, and equations may depend on each other
    at the root.

    **Arguments:**

    - `residual`: the function that is to vanish.
    - `free`: one for each component that may be changed, and zero for the others.
    - `start`: the numbers to which the unknowns are increments.
    - `groups`: how many unknowns of each kind there are, one kind after the other.
        Those of one kind are rounded by the size of the largest of them.
    - `max_iterations`: the largest number of iterations.

    **Returns:** the root, the residual there, and how the method ended.
    """
    residual = ClosureConverted(residual, start)
    # Derivatives come from the two steps after the iteration. Without this they would
    # also be traced through its loop, which jax 0.10.1 cannot do twice.
    fixed_residual, start = frozen((residual, start))

    def sweep(x):
        slopes, value, _ = jacobian_and_value(lambda x: (fixed_residual(x), None), x)
        # Where the equations are dependent, the pseudo-inverse leaves them out.
        inverse = free[:, None] * jnp.linalg.pinv(slopes * free[None, :])
        increment = inverse @ value
        return x - increment, Sizes(max_norm(increment)), (inverse, slopes)

    solved = iterate(
        sweep,
        jnp.zeros_like(free),
        unit(max_norm(start)),
        max_iterations=max_iterations,
    )
    x, (inverse, slopes) = frozen((solved.x, solved.aux))

    # With the slopes frozen, each step more makes one more order of derivatives right.
    def refined(x, _):
        left = residual(x)
        return x - inverse @ left, left

    x, left = jax.lax.scan(refined, x, length=2)
    # An increment also vanishes where the unknowns that may change have no influence:
    # the residual is checked too. It is compared with the sum of the derivatives, each
    # times the size of its unknown; an unknown without influence has size zero.
    sizes = jnp.where(
        jnp.any(slopes != 0, axis=0), jnp.abs(start) + jnp.abs(frozen(x)), 0
    )
    eps = float(jnp.finfo(x.dtype).eps)
    # Unknowns of one kind share the largest of their sizes. Where all are zero, as at
    # rest or at the origin, a small part of a unit stands for them.
    ends = np.cumsum(groups)
    kinds = jnp.split(sizes, ends[:-1])
    sizes = jnp.concatenate(
        [
            jnp.full_like(kind, jnp.maximum(jnp.max(kind, initial=0), eps**0.5))
            for kind in kinds
        ]
    )
    is_root = jnp.all(jnp.abs(left[0]) <= eps**0.5 * (jnp.abs(slopes) @ sizes))
    return x, left[0], solved._replace(converged=solved.converged & is_root)


def checked_count(name: str, value: Any) -> int:
    """Return a number of iterations, or raise a `ValueError`."""
    try:
        count = operator.index(value)
    except TypeError:
        count = 0
    if count < 1 or isinstance(value, bool):
        raise ValueError(f"`{name}` must be an int >= 1, got {value!r}.")
    return count
