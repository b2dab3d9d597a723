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
    iterate,
    jacobian_and_value,
    max_norm,
    nonzero_or_one,
    Solved,
    stop_gradient,
    UpdateNorms,
)
from .._system import (
    AbstractMechanicalSystem,
    linearise,
    parameters,
    State,
    with_kept_functions,
)
from ._linearisation import (
    check_relative_equilibrium,
    check_symmetry,
    Indices,
    indices,
    lift_generators,
    linearise_along_symmetry,
    LinearisedEquations,
    orthonormal_basis,
    perturb,
    state_size,
    Symmetry,
    symmetry_checks,
    SymmetryConditions,
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
    """Find a steady motion, or relative equilibrium, near a given state.

    There are two ways to define a steady motion. With `positions` and `velocities`, the
    result is a consistent state at which the rates of the chosen positions and of the
    chosen velocities vanish,

    v_j = 0 for j in `positions`,   u̇_i = 0 for i in `velocities`,

    where u is the velocity, or the momentum of a Hamiltonian system. The other
    coordinates may change, such as the position of a bicycle on a circle.

    With `symmetry`, the result is a consistent state whose motion is an orbit of
    symmetries of the system. Let x = (q, u), let ẋ = f(x) be the equations of motion,
    and let X_k be the generators. Then

    f(x) = Σ c_k X_k(x).

    The state and the rates c are computed together. Choose this way if no coordinates
    of the attitude are constant, as for a wheel that rolls on a circle or a precessing
    top.

    If these equations have a family of solutions, the result is the solution to
    which Newton's method with least-norm increments converges. The `held_...` arguments
    select another solution, for instance a motion with a given speed or lean. The
    increments have no component along the symmetries, except where held coordinates
    require it.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time at which functions of time are evaluated.
    - `y`: a state from which the search starts.
    - `args`: passed on to the functions of the system.
    - `positions`, `velocities`: the indices of the components that must be constant.
        Leave out components that follow from the others: positions that follow from
        holonomic constraints, velocities that follow from nonholonomic constraints, and
        a speed that is constant because energy is conserved.
    - `symmetry`: generators of symmetries, as `linear_stability` takes them, in place
        of `positions` and `velocities`.
    - `held_positions`, `held_velocities`: the indices of the positions and velocities
        that keep their values in `y`. On a group with the retraction τ, the result has
        the configuration q τ(ξ), where q is the configuration of `y`. Holding position
        i then means ξ_i = 0.
    - `max_iterations`: the largest number of iterations.

    **Returns:** a consistent `State`. With `symmetry`, a pair of the state and the
    rates c of the generators, shape (k,). The unit of a rate is the unit of the
    velocity divided by the unit of the generator. Pass the state to `linear_stability`
    with the same `symmetry`. Both results are twice differentiable with respect to `y`
    and `args` by the implicit function theorem, if the steady motion is unique for the
    held values, or unique up to ignorable coordinates. In any other family of
    solutions, the increment to `y` has the least-norm derivative that satisfies the
    differentiated equations.

    **Raises:** `NewtonError` if no steady motion is found near `y`. `ValueError` or
    `TypeError` if an index is wrong. `ValueError` if neither or both of the two ways
    are chosen, or if generators are dependent, not closed, or not symmetries, as in
    `linear_stability`. `DependentConstraintsError` if constraints are dependent and
    `symmetry` is given. `TypeError` if `system` is not a system, `y` is not a `State`,
    or `symmetry` is not a function. `ShapeError` if `y` is not a single state of this
    system, or a generator does not have the shape of a velocity. Under `jit`, errors
    that depend on values are raised as JAX errors with the same message.

    !!! example

        A pendulum of length 1 m under unit gravity moves on a cone at the rate
        (g / (l cos θ))^½:

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
        steady = _checked_coordinates(positions, velocities, dim)
        outcome = solve_in_coordinates(system, t, y, args, steady, held, max_iterations)
        return require(outcome.state, *outcome.checks)
    if positions is not None or velocities is not None:
        raise ValueError(
            "Pass either `symmetry` or `positions` and `velocities`, not both: both "
            "define which motion is steady."
        )
    check_symmetry(symmetry, y)
    outcome = solve_along_symmetry(system, t, y, args, symmetry, held, max_iterations)
    # The symmetries are checked by a compiled program that `linear_stability` uses too,
    # so that a later call of `linear_stability` does not compile it again.
    given = stop_gradient((system, t, outcome.state, args))
    conditions = _symmetry_conditions(
        linearise_along_symmetry(*given, symmetry), given[2]
    )
    return require(
        (outcome.state, outcome.rates),
        *outcome.checks,
        *symmetry_checks(stop_gradient(conditions)),
    )


def _checked_coordinates(
    positions: Sequence[int] | None, velocities: Sequence[int] | None, dim: int
) -> tuple[Indices, Indices]:
    if positions is None or velocities is None:
        missing = "positions" if positions is None else "velocities"
        raise ValueError(
            f"`{missing}` is missing: pass `positions` and `velocities` together, the "
            "indices of steady coordinates, or pass `symmetry`."
        )
    return indices("positions", positions, dim), indices("velocities", velocities, dim)


@eqx.filter_jit
def _symmetry_conditions(
    linearised: LinearisedEquations, y: State
) -> SymmetryConditions:
    """Compute the conditions on the generators at a state."""
    orbit = linearised.orbit
    assert orbit is not None
    permitted = orthonormal_basis(linearised.all_constraints, orbit.directions)
    return check_relative_equilibrium(
        orbit, linearised.all_constraints, permitted, state_size(y)
    )


class SteadyMotionResult(NamedTuple):
    """The state, the rates of the generators, and the outcome of Newton's method."""

    state: State
    rates: Float[Array, " k"]
    residual: FloatScalar
    converged: BoolScalar
    num_iterations: Int[Array, ""]

    @property
    def checks(self) -> tuple[Check, ...]:
        """Return the check that the iteration found a steady motion."""
        values = (self.num_iterations, self.residual, self.state)
        return (Check(self.converged, _not_found, values),)


def _not_found(count: np.ndarray, residual: np.ndarray, y: State) -> NewtonError:
    return NewtonError(
        f"No steady motion was found from `y` in {int(count)} iterations: Newton's "
        f"method stopped at q = {y.q}, v = {y.v} with the residual "
        f"{float(residual):.3g}. Start nearer to a steady motion, hold fewer indices, "
        "or omit an index whose rate follows from others."
    )


@tracked_jit("system", "args")
def solve_in_coordinates(
    system, t, y, args, steady, held, max_iterations
) -> SteadyMotionResult:
    """Solve for a state whose chosen positions and velocities do not change."""
    positions, velocities = (jnp.asarray(x, int) for x in steady)
    system = with_kept_functions(system, t, y.q, system.fibre_coordinate(y), args)

    def residual(x):
        q, u = perturb(system, y, x)
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
    return _solve(system, t, y, args, held, max_iterations, residual, none)


@tracked_jit("system", "args", "symmetry")
def solve_along_symmetry(
    system, t, y, args, symmetry, held, max_iterations
) -> SteadyMotionResult:
    """Solve for a state that moves along symmetries, and for the generators' rates."""
    dim = y.p.shape[0]
    system = with_kept_functions(system, t, y.q, system.fibre_coordinate(y), args)

    def fields(x):
        q, u = perturb(system, y, x)
        rate = linearise(system, t, q, u, args).acceleration
        motion = jnp.concatenate([system.velocity(t, q, u, args), rate])
        lifts = lift_generators(system, symmetry, t, q, u, args)
        constraints = [
            system.position_constraint(t, q, args),
            system.constraint(t, q, u, args),
        ]
        return motion, jnp.concatenate(lifts, axis=1), constraints

    # Start from the rates c for which Σ c_k X_k is closest to the velocity.
    here = stop_gradient(
        lift_generators(system, symmetry, t, y.q, system.fibre_coordinate(y), args)
    )
    guess = jnp.linalg.pinv(here[0].T) @ stop_gradient(y.v)
    phase_conditions = _phase_conditions(jnp.concatenate(here, axis=1), held)

    def residual(z):
        motion, directions, constraints = fields(z[: 2 * dim])
        left = motion - (guess + z[2 * dim :]) @ directions
        return jnp.concatenate([*constraints, left, phase_conditions @ z[: 2 * dim]])

    return _solve(system, t, y, args, held, max_iterations, residual, guess)


def _phase_conditions(
    directions: Float[Array, "k x"], held: Indices
) -> Float[Array, "k x"]:
    """Compute phase conditions, which exclude perturbations along symmetries.

    Steady motions that differ by symmetries form a family, and phase conditions select
    one member of it. A perturbation must be orthogonal to each row. Combinations of
    generators that change held coordinates are omitted, because the held coordinates
    already exclude them.
    """
    moved = directions[:, jnp.asarray(held, int)]
    unit = jnp.eye(directions.shape[0], dtype=directions.dtype)
    return (unit - moved @ jnp.linalg.pinv(moved)) @ directions


def _solve(
    system, t, y, args, held, max_iterations, residual, guess: Float[Array, " k"]
) -> SteadyMotionResult:
    """Solve for the increments to the state `y` and to the rates `guess`."""
    dim, count = y.p.shape[0], guess.shape[0]

    def in_one_program(z):
        return as_cpu_kernel(residual, z)

    free = jnp.ones(2 * dim + count, y.p.dtype).at[jnp.asarray(held, int)].set(0)
    is_flat = system.manifold_of(y.q).is_flat
    positions_here = ravel_pytree(y.q)[0] if is_flat else jnp.ones_like(y.p)
    start = jnp.concatenate([positions_here, system.fibre_coordinate(y), guess])
    z, left, solved = least_norm_root(
        in_one_program, free, start, (dim, dim, count), max_iterations
    )
    q, u = perturb(system, y, z[: 2 * dim])

    def multiplier(q, u):
        return linearise(system, t, q, u, args).multiplier

    found = State(
        q=q,
        v=system.velocity(t, q, u, args),
        p=system.momentum(t, q, u, args),
        multiplier=as_cpu_kernel(multiplier, q, u),
    )
    return SteadyMotionResult(
        found,
        guess + z[2 * dim :],
        max_norm(left),
        solved.converged,
        solved.num_iterations,
    )


def least_norm_root(
    residual: Callable[[Array], Array],
    free: Float[Array, " k"],
    start: Float[Array, " k"],
    groups: Sequence[int],
    max_iterations: int,
) -> tuple[Float[Array, " k"], Array, Solved[Array, Any]]:
    """Find a root by Newton's method from zero, with least-norm increments.

    The equations may be fewer than the unknowns, and may be dependent at the root.

    **Arguments:**

    - `residual`: the function whose root is computed.
    - `free`: 1 for each unknown that may change, and 0 for the others.
    - `start`: the values to which the unknowns are added.
    - `groups`: the numbers of unknowns of each kind (such as positions), in order. The
        round-off of an unknown is proportional to the largest unknown of its kind.
    - `max_iterations`: the largest number of iterations.

    **Returns:** the root, the residual at the root, and the result of the iteration.
    """
    residual = ClosureConverted(residual, start)
    # Derivatives come from the two steps of `refined` below. Without `stop_gradient`,
    # JAX would also differentiate the loop, which jax 0.10.1 cannot do twice.
    fixed_residual, start = stop_gradient((residual, start))

    def newton_step(x):
        jacobian, value, _ = jacobian_and_value(lambda x: (fixed_residual(x), None), x)
        # The pseudo-inverse ignores dependent equations.
        inverse = free[:, None] * jnp.linalg.pinv(jacobian * free[None, :])
        increment = inverse @ value
        return x - increment, UpdateNorms(max_norm(increment)), (inverse, jacobian)

    solved = iterate(
        newton_step,
        jnp.zeros_like(free),
        nonzero_or_one(max_norm(start)),
        max_iterations=max_iterations,
    )
    x, (inverse, jacobian) = stop_gradient((solved.x, solved.aux))

    # Each step with the fixed Jacobian makes one more order of derivatives correct.
    def refined(x, _):
        left = residual(x)
        return x - inverse @ left, left

    x, left = jax.lax.scan(refined, x, length=2)
    # An increment also vanishes if the free unknowns do not influence the residual, so
    # that the residual must be checked too. It is compared with the sum of its
    # absolute derivatives, each multiplied by the size of its unknown. An unknown
    # without influence has size zero.
    sizes = jnp.where(
        jnp.any(jacobian != 0, axis=0), jnp.abs(start) + jnp.abs(stop_gradient(x)), 0
    )
    eps = float(jnp.finfo(x.dtype).eps)
    # All unknowns of one kind get the largest of their sizes. If all these sizes are
    # zero, as at rest or at the origin, a small positive size is used.
    ends = np.cumsum(groups)
    kinds = jnp.split(sizes, ends[:-1])
    sizes = jnp.concatenate(
        [
            jnp.full_like(kind, jnp.maximum(jnp.max(kind, initial=0), eps**0.5))
            for kind in kinds
        ]
    )
    is_root = jnp.all(jnp.abs(left[0]) <= eps**0.5 * (jnp.abs(jacobian) @ sizes))
    return x, left[0], solved._replace(converged=solved.converged & is_root)


def checked_count(name: str, value: Any) -> int:
    """Return `value` as an int >= 1, or raise a `ValueError`."""
    try:
        count = operator.index(value)
    except TypeError:
        count = 0
    if count < 1 or isinstance(value, bool):
        raise ValueError(f"`{name}` must be an int >= 1, got {value!r}.")
    return count
