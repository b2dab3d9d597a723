"""Starts near zero of systems whose constraints have constants of their own.

The true round-off of a constraint at a state is the largest difference of its value in
float64 and in 50 digits, at nine states near by. A state is made that violates the
constraint by none, by ten and by a thousand of these units, and `initial_state` is
asked for it as it is.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import nhjax

from ._high_precision import evaluate, to_float


UNITS = 0, 10, 1000
SIZES = 1e-12, 1e-9, 1e-6, 1e-3


class Case(NamedTuple):
    """A holonomic constraint, and the coordinate that it determines.

    `constraint` is a function of q. It is linear in the coordinate `place`, with the
    given slope.
    """

    constraint: Callable[[Any], Any]
    num_coordinates: int
    place: int
    slope: float


def _wheel(q):
    """The height of a wheel of .3 m, upright but for a lean and a pitch."""
    axle = jnp.sin(q[1]) * jnp.cos(q[2])
    return q[0] + 0.3 - 0.3 * jnp.sqrt(1 - axle**2)


def _beside_a_constant(q):
    """Numbers that are added to 100 before they are squared."""
    return ((100 + q[1] / 100) ** 2 - 100**2) * jnp.cos(q[2]) - q[0]


CASES = {
    "height of a frame": Case(
        lambda q: (1.02 + q[1]) * jnp.cos(q[2]) - 1.02 - q[0], 3, 0, -1.0
    ),
    "height of a wheel": Case(_wheel, 3, 0, 1.0),
    "beside a constant": Case(_beside_a_constant, 3, 0, -1.0),
    "length of a rod": Case(
        lambda q: (1 + q[0]) ** 2 + q[1] ** 2 + q[2] ** 2 - 1 - 2 * q[3], 4, 3, -2.0
    ),
}


def exact(case: Case, q: np.ndarray) -> float:
    """Evaluate a constraint in 50 digits, rounded in the end."""
    return float(to_float(evaluate(case.constraint, jnp.asarray(q))))


def true_round_off(
    case: Case, q: np.ndarray, size: float, rng: np.random.Generator
) -> float:
    """Find the true round-off of a constraint near a state."""
    errors = []
    for _ in range(9):
        near = q + 0.3 * size * rng.uniform(-1, 1, q.size)
        errors.append(
            abs(float(case.constraint(jnp.asarray(near))) - exact(case, near))
        )
    return max(errors)


def count(case: Case, number: int) -> list[dict[str, Any]]:
    """Count, for each size of q and each violation, how many starts are refused."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v,
        holonomic=lambda t, q, args: case.constraint(q)[None],
    )
    start = jax.jit(
        lambda q: nhjax.initial_state(system, q, jnp.zeros_like(q), throw=False)
    )
    rng, rows = np.random.default_rng(0), []
    for size in SIZES:
        refused = dict.fromkeys(UNITS, 0)
        for _ in range(number):
            q = size * rng.uniform(-1, 1, case.num_coordinates)
            q[case.place] = 0.0
            q[case.place] -= exact(case, q) / case.slope
            unit = true_round_off(case, q, size, rng)
            for units in UNITS:
                moved = q.copy()
                moved[case.place] += units * unit / case.slope * rng.choice([-1, 1])
                y = start(jnp.asarray(moved))
                refused[units] += not bool(jnp.all(jnp.isfinite(y.q)))
        rows.append({"size": size, "number": number, "refused": refused})
    return rows
