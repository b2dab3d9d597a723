"""Solutions of linear differential equations, and attitudes, to round-off."""

import math
from collections.abc import Callable

import numpy as np
import scipy
from numpy.polynomial import legendre

from ._base import NODES, WEIGHTS


def _integration_matrix() -> np.ndarray:
    """Compute the map from values at the nodes to integrals from -1 to each node."""
    degrees = np.arange(NODES.size)
    projection = legendre.legvander(NODES, NODES.size - 1).T * WEIGHTS
    projection *= (degrees + 0.5)[:, None]
    return legendre.legval(NODES, legendre.legint(projection, lbnd=-1)).T


_INTEGRATION = _integration_matrix()


def linear_flow(
    matrix: Callable[[np.ndarray], np.ndarray], start: np.ndarray, t: float, rate: float
) -> np.ndarray:
    """Compute the solution at `t` of u' = A u, u(0) = `start`, of shape (n,) or (n, k).

    The method is Gauss collocation of order 40 on panels of length 1/`rate` or less.
    `matrix` maps times of shape (k,) to A of shape (k, n, n); `rate` is the inverse of
    the shortest time scale of A and of u.
    """
    panels = math.ceil(abs(t) * rate) + 1
    half_width = 0.5 * t / panels
    u = np.asarray(start, dtype=np.float64)
    n, stages = u.shape[0], NODES.size
    for panel in range(panels):
        a = half_width * matrix(half_width * (2 * panel + 1 + NODES))
        implicit = np.einsum("ij,jkl->ikjl", _INTEGRATION, a)
        stage_system = np.eye(stages * n) - implicit.reshape(stages * n, stages * n)
        initial = np.tile(u.reshape(n, -1), (stages, 1))
        values = np.linalg.solve(stage_system, initial).reshape(stages, *u.shape)
        u = u + np.einsum("j,jkl,jl...->k...", WEIGHTS, a, values)
    return u


def attitude(
    quaternion: np.ndarray,
    body_velocity: Callable[[np.ndarray], np.ndarray],
    t: float,
    rate: float,
) -> np.ndarray:
    """Compute the attitude at `t` of a body that turns with a known angular velocity.

    `quaternion` is the attitude (w, x, y, z) at time 0; `body_velocity` maps times of
    shape (k,) to body angular velocities of shape (3, k); `rate` is as for
    `linear_flow`.
    """

    def matrix(times):
        return 0.5 * _product_matrix(body_velocity(times), 1.0)

    return _unit(linear_flow(matrix, quaternion, t, rate))


def attitude_in_space(
    quaternion: np.ndarray,
    space_velocity: Callable[[np.ndarray], np.ndarray],
    t: float,
    rate: float,
) -> np.ndarray:
    """Compute the attitude at `t` of a body whose spatial angular velocity is known."""

    def matrix(times):
        return 0.5 * _product_matrix(space_velocity(times), -1.0)

    return _unit(linear_flow(matrix, quaternion, t, rate))


def rotation(quaternion: np.ndarray) -> np.ndarray:
    """Compute the rotation matrix of a quaternion (w, x, y, z), on the host."""
    turn = scipy.spatial.transform.Rotation.from_quat(np.roll(quaternion, -1))
    return turn.as_matrix()


def _product_matrix(omega: np.ndarray, side: float) -> np.ndarray:
    """Create the matrix that multiplies a quaternion by (0, ω).

    The factor (0, ω) is on the right if `side` is 1, and on the left if it is -1.
    """
    a, b, c = omega
    zero = np.zeros_like(a)
    rows = (
        (zero, -a, -b, -c),
        (a, zero, side * c, -side * b),
        (b, -side * c, zero, side * a),
        (c, side * b, -side * a, zero),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def _unit(quaternion: np.ndarray) -> np.ndarray:
    return quaternion / np.linalg.norm(quaternion)
