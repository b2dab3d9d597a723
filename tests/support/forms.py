"""Systems in Lagrangian and in Hamiltonian form, and where they start."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax._system import State
from support.group_problems import (
    both_forms,
    E3,
    INERTIA,
    inverse_of_three,
    QUATERNION,
    RETRACTIONS,
    ROTATION,
    TORQUE,
    varying_inertia,
)


STEP = 0.1
LOBATTO = [nhjax.LobattoIIIAB(stages) for stages in (2, 3, 4)]
GAUSS = nhjax.Gauss(2)


class Start(NamedTuple):
    """A system in both forms, and where it starts."""

    forms: dict[str, nhjax.LagrangianSystem | nhjax.HamiltonianSystem]
    q: np.ndarray
    v: np.ndarray
    num_constraints: int = 0

    @property
    def y0(self):
        """The state; its multiplier is zero, which the default closure ignores."""
        q, v = jnp.asarray(self.q), jnp.asarray(self.v)
        p = self.forms["lagrangian"].momentum(jnp.zeros(()), q, v, None)
        return State(q, v, p, jnp.zeros(self.num_constraints))


def growth(t, in_time):
    """A factor of the kinetic energy."""
    return 1 + 0.3 * jnp.sin(t) if in_time else 1.0


def drag(t, q, v, args):
    """A force that depends on everything."""
    return -0.2 * (1 + 0.5 * jnp.cos(t)) * v + 0.1 * q[:3]


def in_space(constraint="none", in_time=False):
    """A particle in R^3 with position-dependent mass in a magnetic field."""
    q, v = np.array([0.6, 0.0, -0.8]), np.array([0.4, 0.5, 0.3])
    constraints = {
        "none": {},
        "holonomic": {"holonomic": lambda t, q, args: 0.5 * (q @ q - 1)},
        "nonholonomic": {
            "nonholonomic": lambda t, q, v, args: (
                v[2] - q[1] * v[0] - 0.3 * growth(t, in_time)
            )
        },
    }[constraint]
    forms = both_forms(
        lambda t, q: growth(t, in_time) * varying_inertia(q),
        lambda t, q: 0.5 * q @ q + 0.25 * q[0] ** 4,
        inverse=inverse_of_three,
        shift=lambda t, q: 0.4 * q[0] * jnp.asarray([0.0, 1.0, 0.0]),
        force=drag if in_time else None,
        **constraints,
    )
    return Start(forms, q, v, len(constraints))


def in_rotation(constraint="none", in_time=False, retraction="cayley"):
    """A rotating body whose kinetic energy depends on the attitude."""
    group = nhjax.SO3(RETRACTIONS[retraction])
    S = np.diag([0.3, 0.1, 0.5]) + 0.05
    level = float(ROTATION[2, 2])
    # Turns about the vertical and about e3 keep the angle between these axes.
    v = np.array([0.7, -0.4, 0.0])
    if constraint == "holonomic":
        v = 0.8 * ROTATION[2] - 0.5 * E3
    constraints = {
        "none": {},
        "holonomic": {"holonomic": lambda t, q, args: group.matrix(q)[2, 2] - level},
        "nonholonomic": {
            "nonholonomic": lambda t, q, v, args: (
                v[2] * (2 + q[1]) - (growth(t, in_time) - 1)
            )
        },
    }[constraint]

    def inertia(t, q):
        R = group.matrix(q)
        return growth(t, in_time) * (INERTIA + R.T @ S @ R)

    forms = both_forms(
        inertia,
        lambda t, q: jnp.sum(TORQUE * group.matrix(q)),
        inverse=inverse_of_three,
        force=drag if in_time else None,
        manifold=group,
        **constraints,
    )
    return Start(forms, QUATERNION, v, len(constraints))


def free_forms(group, inertia, potential=None):
    """½ v·M v - U with a constant M."""
    inverse = np.linalg.inv(inertia)
    return both_forms(
        lambda t, q: jnp.asarray(inertia),
        lambda t, q: jnp.zeros(()) if potential is None else potential(q),
        inverse=lambda M: inverse,
        manifold=group,
    )
