"""A particle and runs of it, into which tests put mistakes."""

from typing import Any

import equinox as eqx

import nhjax
from nhjax.systems import NonholonomicParticle


PARTICLE = NonholonomicParticle()
SYSTEM = PARTICLE.system
Q, V = PARTICLE.q0, PARTICLE.v0
METHOD = nhjax.LobattoIIIAB(2)
FREE = nhjax.LagrangianSystem(PARTICLE.lagrangian)
EXPLICIT_RK4 = nhjax.PartitionedRungeKutta(
    [[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1, 0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
)


def start(system: Any = SYSTEM, q: Any = Q, v: Any = V, **others):
    return nhjax.initial_state(system, q, v, **others)


def changed(state, **parts):
    names = tuple(parts)
    return eqx.tree_at(
        lambda y: tuple(getattr(y, name) for name in names),
        state,
        tuple(parts.values()),
    )


def kinetic(t, q, v, args):
    return 0.5 * v @ v


def system_with(**functions: Any):
    arguments: dict[str, Any] = {"lagrangian": kinetic} | functions
    return nhjax.LagrangianSystem(**arguments)


def run(y0, system: Any = SYSTEM, method: Any = METHOD, **others):
    arguments: dict[str, Any] = {"dt": 0.1, "num_steps": 4} | others
    return nhjax.integrate(system, method, y0, **arguments)
