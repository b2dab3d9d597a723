"""A short run of the nonholonomic particle, and how trees of arrays are compared."""

from typing import Any

import jax
import numpy as np

import nhjax
from nhjax.systems import NonholonomicParticle


PARTICLE = NonholonomicParticle()
STEPS, DT = 20, 0.1


def run(**others: Any) -> nhjax.Solution:
    """Integrate the particle; `others` replace the usual arguments."""
    arguments: dict[str, Any] = {
        "system": PARTICLE.system,
        "method": nhjax.LobattoIIIAB(3),
        "y0": PARTICLE.initial_state(),
        "dt": DT,
        "num_steps": STEPS,
    }
    return nhjax.integrate(**(arguments | others))


def assert_trees_equal(got, expected):
    """All numbers of two trees are the same, bit for bit."""
    jax.tree.map(np.testing.assert_array_equal, got, expected)


def assert_trees_close(got, expected, rtol, atol=0.0):
    """All numbers of two trees are the same up to a tolerance."""
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=atol),
        got,
        expected,
    )
