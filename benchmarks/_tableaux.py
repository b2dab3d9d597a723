"""Collocation methods other than Lobatto and Gauss, and their measured orders."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax._numerics import max_norm


def collocation(
    nodes: Sequence[float] | np.ndarray, closure: str = "consistent"
) -> nhjax.PartitionedRungeKutta:
    """Create the collocation method with the given nodes, paired with its conjugate."""
    c = np.asarray(nodes, dtype=np.float64)
    powers = np.arange(1, c.size + 1)
    inverse = np.linalg.inv(np.vander(c, increasing=True))
    a, b = (c[:, None] ** powers / powers) @ inverse, (1 / powers) @ inverse
    if (c[0], c[-1]) == (0, 1):
        # Set the rows at the nodes 0 and 1 exactly, as hypotheses H1 and H3 require.
        a[0], a[-1] = 0.0, b
    return nhjax.PartitionedRungeKutta(a, b, closure=closure)


RK4 = nhjax.PartitionedRungeKutta(
    [[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1, 0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
)
# Nodes that include both ends of the step, for systems with and without constraints.
CLOSED = {
    "0, 1/3, 2/3, 1": (0, 1 / 3, 2 / 3, 1),
    "0, .25, .5, .75, 1": (0, 0.25, 0.5, 0.75, 1),
    "0, .4, 1": (0, 0.4, 1),
    "0, .2, 2/3, 1": (0, 0.2, 2 / 3, 1),
    "Chebyshev, s = 5": (1 - np.cos(np.pi * np.arange(5) / 4)) / 2,
    "0, .35, .7, 1": (0, 0.35, 0.7, 1),
    "0, .1, .4, .6, .9, 1": (0, 0.1, 0.4, 0.6, 0.9, 1),
}
# Nodes that do not include both ends, for systems without constraints only.
OPEN = {
    "Radau, s = 2": (1 / 3, 1),
    "1/4, 3/4": (0.25, 0.75),
    "1/6, 1/2, 5/6": (1 / 6, 0.5, 5 / 6),
}


class Slopes(NamedTuple):
    """Observed orders of q, p and the multiplier; NaN for a missing multiplier."""

    q: float
    p: float
    multiplier: float


def pendulum() -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create a pendulum on a slide: its mass matrix depends on q; no constraints."""

    def lagrangian(t, q, v, args):
        mixed = 0.6 * jnp.cos(q[1]) * v[0] * v[1]
        return v @ v + mixed + 1.3 * jnp.cos(q[1]) - 0.4 * q[0] ** 2

    system = nhjax.LagrangianSystem(lagrangian)
    start = jnp.array([0.3, 0.8]), jnp.array([0.5, -0.4])
    return system, nhjax.initial_state(system, *start)


def rolling(quadratic: float = 0.2) -> tuple[nhjax.LagrangianSystem, nhjax.State]:
    """Create a system with a mass that depends on q, and one nonholonomic constraint.

    The constraint has a term that is quadratic in v, with the factor `quadratic`.
    """

    def lagrangian(t, q, v, args):
        return (
            0.5 * (1 + 0.3 * q[1] ** 2) * v @ v
            + 0.2 * jnp.sin(q[0]) * v[0] * v[2]
            - 0.5 * q @ q
        )

    def constraint(t, q, v, args):
        return (v[2] - q[1] * v[0] - quadratic * v[0] * v[1])[None]

    system = nhjax.LagrangianSystem(lagrangian, nonholonomic=constraint)
    start = jnp.array([0.5, 0.4, -0.3]), jnp.array([0.7, -0.6, 0.2])
    return system, nhjax.initial_state(system, *start, project=True)


def observed(
    system: Any, y0: nhjax.State, method: Any, counts: tuple[int, int], duration: float
) -> Slopes:
    """Measure the orders of a run between two numbers of steps."""

    def end(method: Any, count: Any) -> nhjax.State:
        return nhjax.integrate(
            system,
            method,
            y0,
            dt=duration / count,
            num_steps=count,
            stage_solver=nhjax.SimplifiedNewton(max_iterations=300),
        ).ys

    exact = end(nhjax.LobattoIIIAB(6, "symmetric"), 4 * counts[-1])
    errors = []
    for count in counts:
        found = end(method, count)
        apart = jax.tree.map(lambda a, b: max_norm(a - b), found, exact)
        errors.append([float(x) for x in (apart.q, apart.p, apart.multiplier)])
    first, last = np.asarray(errors)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Slopes(*(np.log(first / last) / np.log(counts[1] / counts[0])))
