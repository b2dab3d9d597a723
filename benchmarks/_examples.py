"""Systems that several benchmarks use, each with an initial state."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

import nhjax
from nhjax._manifold import AbstractRetraction


_INERTIA = ((1.0, 0.1, 0.2), (0.1, 1.4, -0.15), (0.2, -0.15, 0.8))


def of_the_gallery(kind: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function from an example's parameters to its system and state."""

    def build(**parameters):
        example = kind(**parameters)
        return example.system, example.initial_state()

    return build


def suslov_in_a_potential(
    retraction: AbstractRetraction = nhjax.Cayley(),  # noqa: B008 -- immutable
) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create Suslov's problem with a full matrix of inertia, and L = T - 0.3 R₃₃."""
    inertia, manifold = jnp.asarray(_INERTIA), nhjax.SO3(retraction)

    def lagrangian(t, q, v, args):
        return 0.5 * v @ inertia @ v - 0.3 * manifold.matrix(q)[2, 2]

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=lambda t, q, v, args: v[2], manifold=manifold
    )
    q0 = nhjax.SO3(nhjax.Exponential()).retract(jnp.array([0.2, -0.4, 0.5]))
    return system, nhjax.initial_state(system, q0, jnp.array([0.6, -0.9, 0.0]))


def wheeled_inverted_pendulum() -> tuple[Any, Any, Any, Any]:
    """Create a robot that balances on two wheels by feedback.

    It is not a system of the gallery. Its six coordinates are x, y, the heading, the
    lean and the angles of the wheels. Returns the system, q, v, and the gains of the
    feedback, which are its `args`.
    """
    body, base, radius, height, track = 6.0, 1.5, 0.1, 0.35, 0.5
    inertia = jnp.array([0.05, 0.04, 0.03])

    def centre(q):
        out = height * jnp.sin(q[3])
        return jnp.array(
            [
                q[0] + out * jnp.cos(q[2]),
                q[1] + out * jnp.sin(q[2]),
                height * jnp.cos(q[3]),
            ]
        )

    def lagrangian(t, q, v, args):
        _, velocity = jax.jvp(centre, (q,), (v,))
        turn, lean = v[2], v[3]
        spin = jnp.array([-turn * jnp.sin(q[3]), lean, turn * jnp.cos(q[3])])
        kinetic = body * (velocity @ velocity) + spin @ (inertia * spin)
        kinetic += base * (v[0] ** 2 + v[1] ** 2) + 0.1 * turn**2
        kinetic += 0.002 * (v[4] ** 2 + v[5] ** 2)
        return 0.5 * kinetic - 9.81 * body * centre(q)[2]

    def rolling(t, q, v, args):
        sine, cosine = jnp.sin(q[2]), jnp.cos(q[2])
        forwards = 0.5 * radius * (v[4] + v[5])
        return jnp.array(
            [
                cosine * v[1] - sine * v[0],
                cosine * v[0] + sine * v[1] - forwards,
                v[2] - radius / track * (v[5] - v[4]),
            ]
        )

    def feedback(t, q, v, gains):
        speed = 0.5 * radius * (v[4] + v[5])
        torque = gains @ jnp.array([q[3], v[3], speed])
        return jnp.array([0, 0, 0, -2 * torque, torque + 0.1, torque - 0.1])

    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=rolling, force=feedback)
    q, v = jnp.array([0, 0, 0.1, 0.05, 0, 0]), jnp.array([0, 0, 0, 0, 0.5, 0.5])
    return system, q, v, jnp.array([6.0, 1.2, 0.4])
