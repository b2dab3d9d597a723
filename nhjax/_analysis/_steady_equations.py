"""The equations of steady motions, in chosen coordinates or along symmetries."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Int

from .._compile import as_cpu_kernel, tracked_jit
from .._custom_types import BoolScalar, FloatScalar
from .._errors import Check, NewtonError
from .._numerics import frozen, max_norm
from .._system import linearise, State
from ._nearest_root import nearest_root
from ._perturbation import Indices, perturbed
from ._symmetry import lifted


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
