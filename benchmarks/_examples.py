"""Systems that several benchmarks run, each with a state to start from."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

import nhjax
from nhjax._manifold import AbstractRetraction


_INERTIA = ((1.0, 0.1, 0.2), (0.1, 1.4, -0.15), (0.2, -0.15, 0.8))


def of_the_gallery(kind: Callable[..., Any]) -> Callable[..., Any]:
    """A function of an example's parameters that makes its system and state."""

    def build(**parameters):
        example = kind(**parameters)
        return example.system, example.initial_state()

    return build


def suslov_in_a_potential(
    retraction: AbstractRetraction = nhjax.Cayley(),  # noqa: B008 -- immutable
) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Suslov's problem with a full matrix of inertia and V = 0.3 R₃₃."""
    inertia, manifold = jnp.asarray(_INERTIA), nhjax.SO3(retraction)

    def lagrangian(t, q, v, args):
        return 0.5 * v @ inertia @ v - 0.3 * manifold.matrix(q)[2, 2]

    system = nhjax.LagrangianSystem(
        lagrangian, nonholonomic=lambda t, q, v, args: v[2], manifold=manifold
    )
    q0 = nhjax.SO3(nhjax.Exponential()).retract(jnp.array([0.2, -0.4, 0.5]))
    return system, nhjax.initial_state(system, q0, jnp.array([0.6, -0.9, 0.0]))
