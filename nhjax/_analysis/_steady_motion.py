"""Steady motions: equilibria, and motions that are steady up to symmetries."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._compile import as_cpu_kernel, tracked_jit
from .._custom_types import Args, FloatScalarLike
from .._errors import Check, NewtonError, require
from .._numerics import iterate, jacobian_and_value, max_norm, Sizes, Solved, unit
from .._system import (
    AbstractMechanicalSystem,
    linearise,
    parameters,
    State,
)
from ._arguments import checked_count, checked_time
from ._perturbation import indices, perturbed


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
) -> State:
    """Find the steady motion, or relative equilibrium, that is near to a given state.

    It is a consistent state at which the chosen `positions` do not change, and the
    rates of change of the chosen `velocities` vanish,

    v_j = 0 for j in `positions`,   u̇_i = 0 for i in `velocities`,

    u being the velocity or for a Hamiltonian system the momentum. The other coordinates
    may change, as the place of a bicycle that runs in a circle does. Where these
    equations leave a family of steady motions, the result is the one that Newton's
    method with the smallest increments leads to; `held_...` picks another one, such as
    that of a given speed or lean.

    **Arguments:**

    - `system`: the mechanical system.
    - `t`: the time at which functions that depend on time are taken.
    - `y`: a state from which the search starts.
    - `args`: passed on to the functions of the system.
    - `positions`, `velocities`: the indices of what is to be steady. Leave out what
        follows from the rest: positions that holonomic constraints tie, velocities that
        follow from nonholonomic ones, and a speed whose rate vanishes with the others
        because energy is conserved.
    - `held_positions`, `held_velocities`: the indices of what keeps its value in `y`.
    - `max_iterations`: the largest number of iterations.

    **Returns:** a consistent `State`, twice differentiable with respect to `y` and
    `args` by the implicit function theorem, where the steady motion is the only one
    with the held values, or one of a family that differs in what nothing depends on. In
    other families its derivative is that of one more increment of Newton's method.

    **Raises:** `NewtonError` if there is none near to `y`; `ValueError` or `TypeError`
    if an index is wrong; `TypeError` if `system` is no system or `y` no `State`. Under
    `jit` what depends on values comes as an error of JAX with the same message.
    `ShapeError` if `y` is no state of this system, or many.

    !!! example

        >>> import jax.numpy as jnp, nhjax
        >>> pendulum = nhjax.systems.SphericalPendulum.swinging(0.2)
        >>> y = nhjax.steady_motion(pendulum.system, 0.0, pendulum.initial_state(),
        ...     positions=(0, 1), velocities=(0, 1))
        >>> abs(y.q - jnp.array([0.0, 0.0, -1.0])).max() < 1e-6
        Array(True, dtype=bool)
    """
    args, max_iterations = (
        parameters(args),
        checked_count("max_iterations", max_iterations),
    )
    t, dim = checked_time("steady_motion", system, t, y, args), y.p.shape[0]
    steady = (
        indices("positions", positions, dim),
        indices("velocities", velocities, dim),
    )
    held = (
        *indices("held_positions", held_positions, dim),
        *(dim + i for i in indices("held_velocities", held_velocities, dim)),
    )
    found, residual, solved, count = _steady(
        system, t, y, args, steady, held, max_iterations
    )
    return require(found, Check(solved, _not_found, (count, residual, found)))


def _not_found(count: np.ndarray, residual: np.ndarray, y: State) -> NewtonError:
    return NewtonError(
        f"No steady motion was found from `y` in {int(count)} iterations: Newton's "
        f"method stopped at q = {y.q}, v = {y.v} with the residual "
        f"{float(residual):.3g}. Start nearer to one, or leave out an index whose rate "
        "follows from others."
    )


@tracked_jit("system", "args")
def _steady(system, t, y, args, steady, held, max_iterations):
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

    def in_one_program(x):
        return as_cpu_kernel(residual, x)

    free = jnp.ones(2 * y.p.shape[0], y.p.dtype).at[jnp.asarray(held, int)].set(0)
    positions_now = y.q if system.manifold_of(y.q).is_flat else jnp.ones_like(y.p)
    start = jnp.concatenate([positions_now, system.fibre_coordinate(y)])
    x, left, solved = _nearest_root(in_one_program, free, start, max_iterations)
    q, u = perturbed(system, y, x)

    def multiplier(q, u):
        return linearise(system, t, q, u, args).multiplier

    found = State(
        q=q,
        v=system.velocity(t, q, u, args),
        p=system.momentum(t, q, u, args),
        multiplier=as_cpu_kernel(multiplier, q, u),
    )
    return found, max_norm(left), solved.converged, solved.num_iterations


def _nearest_root(
    residual: Callable[[Array], Array],
    free: Float[Array, " k"],
    start: Float[Array, " k"],
    max_iterations: int,
) -> tuple[Float[Array, " k"], Array, Solved[Array, Any]]:
    """Find a root by Newton's method from zero, with the smallest increments.

    Only components at which `free` is one are changed. There may be fewer equations
    than unknowns, and equations may depend on each other at the root. `start` are the
    numbers to which the unknowns are increments. Returned are the root, the residual
    there, and how the method ended.
    """

    def sweep(x):
        slopes, value, _ = jacobian_and_value(lambda x: (residual(x), None), x)
        # Where the equations are dependent, the pseudo-inverse leaves them out.
        inverse = jnp.linalg.pinv(slopes * free[None, :])
        increment = inverse @ value
        return x - increment, Sizes(max_norm(increment)), (inverse, slopes)

    fixed = jax.lax.stop_gradient
    start = fixed(start)
    solved = iterate(
        sweep,
        jnp.zeros_like(free),
        unit(max_norm(start)),
        max_iterations=max_iterations,
    )
    x, (inverse, slopes) = fixed((solved.x, solved.aux))

    # With the slopes frozen, each step more makes one more order of derivatives right.
    def refined(x, _):
        left = residual(x)
        return x - inverse @ left, left

    x, left = jax.lax.scan(refined, x, length=2)
    # Increments vanish also where all that may change has no influence.
    # How large the terms of the equations are tells the size of what they depend on.
    sizes = jnp.where(
        jnp.any(slopes != 0, axis=0), jnp.abs(start) + jnp.abs(fixed(x)), 0
    )
    eps = float(jnp.finfo(x.dtype).eps)
    # At rest, and at the origin, nothing does: there it is a small part of a unit.
    sizes = jnp.maximum(jnp.max(sizes.reshape(2, -1), axis=1), eps**0.5)
    sizes = jnp.repeat(sizes, x.size // 2)
    is_root = jnp.all(jnp.abs(left[0]) <= eps**0.5 * (jnp.abs(slopes) @ sizes))
    return x, left[0], solved._replace(converged=solved.converged & is_root)
