"""A particle that falls, and how often its Lagrangian is traced."""

from typing import Any

import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import SaveAt


traces: list[int] = []


def end(lagrangian: Any, saveat: SaveAt | None = None, **parts: Any) -> np.ndarray:
    """The end of a particle that starts at rest: -½ g."""
    system = nhjax.LagrangianSystem(lagrangian, **parts)
    y0 = nhjax.initial_state(system, jnp.zeros(2), jnp.zeros(2))
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(2),
        y0,
        dt=0.1,
        num_steps=10,
        saveat=saveat or SaveAt(t1=True, fn=position),
    )
    return np.asarray(sol.ys)[-1]


def position(t, y, args):
    return y.q


def falling(v, q, g):
    traces.append(1)
    return 0.5 * v @ v - g * q[0]
