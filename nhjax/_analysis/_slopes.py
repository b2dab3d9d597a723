"""The derivatives of the equations of motion and of the constraints at one state."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._compile import as_cpu_kernel, tracked_jit
from .._numerics import jacobian_and_value, max_norm, unit
from .._system import linearise, State
from ._perturbation import perturbed, rates_of_change
from ._symmetry import lifted, Orbit, steps_along


class Slopes(NamedTuple):
    """The derivatives of the equations with respect to perturbations x = (ξ, w).

    - `rates`: those of the rates of x in the frame that moves along.
    - `velocity`: the rates (v, u̇) of the state itself.
    - `on_velocities`, `on_positions`: those of the constraints.
    - `orbit`: what is known of the symmetries along which the frame moves, if any are
        named. Otherwise it moves with the velocity v, as a left translation does.
    """

    rates: Float[Array, "x x"]
    velocity: Float[Array, " x"]
    on_velocities: Float[Array, "l x"]
    on_positions: Float[Array, "k n"]
    orbit: Orbit | None

    @property
    def rows(self) -> Float[Array, "r x"]:
        """Return the derivatives of all constraints."""
        dim = self.on_positions.shape[1]
        on_positions = jnp.pad(self.on_positions, ((0, 0), (0, dim)))
        return jnp.concatenate([self.on_velocities, on_positions])


def size_of(y: State) -> Array:
    """Return the size of the numbers in a state, in which its errors are measured."""
    return unit(max_norm(*jax.tree.leaves(y.q), y.v, y.p))


@tracked_jit("system", "args")
def slopes_along_velocity(system, t, y, args) -> Slopes:
    """Differentiate the equations in the frame that moves with the velocity."""
    dim, count = y.p.shape[0], y.multiplier.shape[0]

    def equations(x):
        rates = rates_of_change(system, t, y, args)(x)
        return jnp.concatenate([rates, _constraints(system, t, y, args, x)])

    slopes, value, _ = jacobian_and_value(
        lambda x: (as_cpu_kernel(equations, x), None), jnp.zeros(2 * dim, y.p.dtype)
    )
    velocity = jnp.concatenate([y.v, value[dim : 2 * dim]])
    rates, on_velocities, rest = jnp.split(slopes, [2 * dim, 2 * dim + count])
    return Slopes(rates, velocity, on_velocities, rest[:, :dim], None)


@tracked_jit("system", "args", "symmetry")
def slopes_along_symmetry(system, t, y, args, symmetry) -> Slopes:
    """Differentiate the equations and the generators of symmetries.

    Both are vector fields on states, in the chart x -> (q τ(ξ), u + w).
    """
    dim, count = y.p.shape[0], y.multiplier.shape[0]
    manifold = system.manifold_of(y.q)

    def fields(x):
        q, u = perturbed(system, y, x)
        xi, change = lifted(system, symmetry, t, q, u, args)
        velocity = system.velocity(t, q, u, args)
        in_chart = jax.vmap(lambda v: manifold.dtau_inv(x[:dim], v))(
            jnp.concatenate([velocity[None], xi])
        )
        rates = linearise(system, t, q, u, args).acceleration
        change = jnp.concatenate([rates[None], change])
        both = jnp.concatenate([in_chart, change], axis=1)
        constraints = _constraints(system, t, y, args, x)
        return jnp.concatenate([both.reshape(-1), constraints])

    def at(x):
        return jacobian_and_value(lambda x: (as_cpu_kernel(fields, x), None), x)[:2]

    zero = jnp.zeros(2 * dim, y.p.dtype)
    u = system.fibre_coordinate(y)
    ways = jnp.concatenate(lifted(system, symmetry, t, y.q, u, args), axis=1)
    steps = steps_along(ways, size_of(y))
    moved = jnp.stack([steps, -steps], axis=1)[:, :, None] * ways[:, None, :]
    places = jnp.concatenate([zero[None], moved.reshape(-1, 2 * dim)])
    # One program serves all places: most of the time goes into compiling it.
    samples, values = jax.lax.map(at, places)
    number = 2 * dim * (1 + len(ways))
    slopes = samples[0, :number].reshape(-1, 2 * dim, 2 * dim)
    found = values[0, :number].reshape(-1, 2 * dim)
    on_velocities, rest = jnp.split(samples[0, number:], [count])
    nearby = samples[1:, :number]
    orbit = Orbit(found[1:], slopes[1:], found[0], slopes[0], nearby, steps)
    return Slopes(orbit.rates, found[0], on_velocities, rest[:, :dim], orbit)


def _constraints(system, t, y, args, x):
    q, u = perturbed(system, y, x)
    on_positions = system.position_constraint(t, q, args)
    return jnp.concatenate([system.constraint(t, q, u, args), on_positions])
