"""The flyball governor by Kane's equations in the frame that turns with its shaft.

Vectors have the components (outward, ahead, up) of one rod. Each coupler exerts a force
along its line; for a rigid coupler, d²/dt² of its length gives this force.
"""

from typing import NamedTuple

import numpy as np


class Parameters(NamedTuple):
    """The parameters of the example."""

    shaft_inertia: float = 5e-6
    slider_inertia: float = 5e-3
    rod_inertias: tuple[float, float] = (5e-6, 0.0250025)
    slider_mass: float = 3.0
    rod_mass: float = 0.3
    ball_mass: float = 5.0
    rod_length: float = 1.0
    coupler_length: float = 0.5
    arm: float = 0.05
    height: float = 1.0
    stiffness: float = 8e5
    damping: float = 4e4
    gravity: float = 9.81


def _rod(p, beta, spin, rate):
    """Matrix and load of (φ̈, β̈) from one rod and its ball."""
    sine, cosine = np.sin(beta), np.cos(beta)
    matrix, load = np.zeros((2, 2)), np.zeros(2)
    for mass, reach in ((p.rod_mass, 0.5 * p.rod_length), (p.ball_mass, p.rod_length)):
        radius = p.arm + reach * cosine
        partial = np.array([[0, radius, 0], [-reach * sine, 0, -reach * cosine]])
        # Accelerations due to the rates, in cylindrical coordinates, and gravity.
        remainder = np.array(
            [
                -reach * cosine * rate**2 - radius * spin**2,
                -2 * reach * sine * rate * spin,
                reach * sine * rate**2 + p.gravity,
            ]
        )
        matrix += mass * partial @ partial.T
        load -= mass * partial @ remainder
    axial, transverse = p.rod_inertias
    u = np.array([cosine, 0.0, -sine])
    tensor = transverse * np.eye(3) + (axial - transverse) * np.outer(u, u)
    partial = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    omega = np.array([0.0, rate, spin])
    # The axis of the hinge turns with the shaft.
    remainder = tensor @ [-rate * spin, 0.0, 0.0] + np.cross(omega, tensor @ omega)
    return matrix + partial @ tensor @ partial.T, load - partial @ remainder


def coupler(p, beta, s, rate, ds):
    """Length d, its partials in β and s, rate ḋ, and d̈ without second derivatives."""
    half = 0.5 * p.rod_length
    x, z = half * np.cos(beta), p.height - half * np.sin(beta) - s
    dx, dz = -half * np.sin(beta) * rate, -half * np.cos(beta) * rate - ds
    ddx, ddz = -half * np.cos(beta) * rate**2, half * np.sin(beta) * rate**2
    d = np.hypot(x, z)
    change = (x * dx + z * dz) / d
    by_beta = (-x * half * np.sin(beta) - z * half * np.cos(beta)) / d
    bend = (x * ddx + z * ddz + dx**2 + dz**2 - change**2) / d
    return d, (by_beta, -z / d), change, bend


def free(p, q, v, torque):
    """Mass matrix and load of (φ̈, β̈₁, β̈₂, s̈) without the couplers."""
    matrix = np.zeros((4, 4))
    matrix[0, 0], matrix[3, 3] = p.shaft_inertia + p.slider_inertia, p.slider_mass
    load = np.array([torque, 0.0, 0.0, -p.slider_mass * p.gravity])
    for k in (1, 2):
        part, push = _rod(p, q[k], v[0], v[k])
        matrix[np.ix_([0, k], [0, k])] += part
        load[[0, k]] += push
    return matrix, load


def _couplers(p, q, v):
    """For both couplers the matrix of partials, and d, ḋ and d̈ as in `coupler`."""
    rows, values = np.zeros((2, 4)), []
    for k in (1, 2):
        d, (rows[k - 1, k], rows[k - 1, 3]), change, bend = coupler(
            p, q[k], q[3], v[k], v[3]
        )
        values.append((d, change, bend))
    return rows, *np.array(values).T


def sprung_acceleration(p, q, v, torque=0.0):
    matrix, load = free(p, q, v, torque)
    rows, d, change, _ = _couplers(p, q, v)
    pull = -p.stiffness * (d - p.coupler_length) - p.damping * change
    return np.linalg.solve(matrix, load + rows.T @ pull)


def rigid_motion(p, q, v, torque=0.0):
    """(q̈, λ) with couplers of constant lengths: forces 2 d λ along them."""
    matrix, load = free(p, q, v, torque)
    rows, d, _, bend = _couplers(p, q, v)
    inverse = np.linalg.inv(matrix)
    force = np.linalg.solve(rows @ inverse @ rows.T, -bend - rows @ inverse @ load)
    return inverse @ (load + rows.T @ force), force / (2 * d)


def energy(p, q, v):
    matrix, _ = free(p, q, v, 0.0)
    height = sum(
        mass * (p.height - reach * p.rod_length * np.sin(q[k]))
        for k in (1, 2)
        for mass, reach in ((p.rod_mass, 0.5), (p.ball_mass, 1.0))
    )
    return 0.5 * v @ matrix @ v + p.gravity * (p.slider_mass * q[3] + height)


def consistent(p, turn, spin, beta, rate):
    """(q, v) with rigid couplers and both rods alike."""
    half = 0.5 * p.rod_length
    fall = np.sqrt(p.coupler_length**2 - (half * np.cos(beta)) ** 2)
    # From fall² = d² - half² cos² β.
    dfall = half**2 * np.cos(beta) * np.sin(beta) * rate / fall
    s, ds = p.height - half * np.sin(beta) - fall, -half * np.cos(beta) * rate - dfall
    return np.array([turn, beta, beta, s]), np.array([spin, rate, rate, ds])
