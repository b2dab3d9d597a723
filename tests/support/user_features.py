"""Shared by the features as users run them: their register, and short runs."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import LobattoIIIAB, systems


PARTICLE = systems.NonholonomicParticle()
DT, STEPS = 0.1, 10
TWO = LobattoIIIAB(2)
FEATURES: dict[str, Callable[[], None]] = {}


def feature(function: Callable[[], None]) -> Callable[[], None]:
    """A feature that is tested under the name of its function."""
    FEATURES[function.__name__] = function
    return function


def close(got, expected, atol=1e-12):
    """Compare trees."""
    pairs = zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True)
    for x, y in pairs:
        np.testing.assert_allclose(x, y, rtol=0, atol=atol)


def run(example: Any = PARTICLE, method: Any = None, **options: Any) -> nhjax.Solution:
    """A few steps from the state of an example."""
    arguments: dict[str, Any] = {"y0": example.initial_state(), "dt": DT}
    arguments |= {"num_steps": STEPS} | options
    system = arguments.pop("system", example.system)
    return nhjax.integrate(system, method or LobattoIIIAB(4), **arguments)


def assert_exact(example, sol, atol=1e-7):
    """Compare the end of a run with the exact solution; constraints hold."""
    q, v, _ = example.exact(DT * STEPS)
    close(jax.tree.map(lambda x: x[-1], (sol.ys.q, sol.ys.v)), (q, v), atol)
    assert float(sol.stats["max_constraint_violation"]) < 1e-13
    assert sol.result == nhjax.RESULTS.successful


def of_dt(adjoint=None):
    """A scalar function of the step size."""

    def loss(dt):
        options = {} if adjoint is None else {"adjoint": adjoint}
        return jnp.sum(jnp.sin(run(method=TWO, dt=dt, **options).ys.q))

    return loss
