"""Andrews' squeezing mechanism by the published equations of its seven angles.

Mass matrix, forces, constraints and their derivatives are those of Hairer and Wanner,
*Solving Ordinary Differential Equations II*, equations (VII.7.1) to (VII.7.8), and of
the Test Set for IVP Solvers; the multiplier has the opposite sign there.
"""

import numpy as np
from numpy import cos, sin

from support.mechanisms import saddle


M2, M4, M6 = 0.00365, 0.00706, 0.00706
I1, I2, I3, I4, I5, I6, I7 = (
    *(2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7),
    *(1.169e-5, 5.667e-7, 1.912e-5),
)
M1, M3, M5, M7 = 0.04325, 0.02373, 0.07050, 0.05498
XA, YA, XB, YB, XC, YC = -0.06934, -0.00227, -0.03635, 0.03273, 0.014, 0.072
D, DA, E, EA, RR, RA = 28e-3, 115e-4, 2e-2, 1421e-5, 7e-3, 92e-5
SS, SA, SB, SC, SD = 35e-3, 1874e-5, 1043e-5, 18e-3, 2e-2
TA, TB, U, UA, UB = 2308e-5, 916e-5, 4e-2, 1228e-5, 449e-5
ZF, ZT, FA = 2e-2, 4e-2, 1421e-5
STIFFNESS, LENGTH, TORQUE = 4530.0, 7785e-5, 33e-3


def mass_matrix(q):
    theta, phi, omega = q[1], q[3], q[5]
    m = np.zeros((7, 7))
    m[0, 0] = M1 * RA**2 + M2 * (RR**2 - 2 * DA * RR * cos(theta) + DA**2) + I1 + I2
    m[1, 0] = m[0, 1] = M2 * (DA**2 - DA * RR * cos(theta)) + I2
    m[1, 1] = M2 * DA**2 + I2
    m[2, 2] = M3 * (SA**2 + SB**2) + I3
    m[3, 3] = M4 * (E - EA) ** 2 + I4
    m[4, 3] = m[3, 4] = M4 * ((E - EA) ** 2 + ZT * (E - EA) * sin(phi)) + I4
    m[4, 4] = M4 * (ZT**2 + 2 * ZT * (E - EA) * sin(phi) + (E - EA) ** 2)
    m[4, 4] += M5 * (TA**2 + TB**2) + I4 + I5
    m[5, 5] = M6 * (ZF - FA) ** 2 + I6
    m[6, 5] = m[5, 6] = M6 * ((ZF - FA) ** 2 - U * (ZF - FA) * sin(omega)) + I6
    m[6, 6] = M6 * ((ZF - FA) ** 2 - 2 * U * (ZF - FA) * sin(omega) + U**2)
    m[6, 6] += M7 * (UA**2 + UB**2) + I6 + I7
    return m


def forces(q, v):
    _, theta, gamma, phi, _, omega, _ = q
    bep, thp, _, php, dep, omp, epp = v
    xd = SD * cos(gamma) + SC * sin(gamma) + XB
    yd = SD * sin(gamma) - SC * cos(gamma) + YB
    length = np.hypot(xd - XC, yd - YC)
    force = -STIFFNESS * (length - LENGTH) / length
    fx, fy = force * (xd - XC), force * (yd - YC)
    return np.array(
        [
            TORQUE - M2 * DA * RR * thp * (thp + 2 * bep) * sin(theta),
            M2 * DA * RR * bep**2 * sin(theta),
            fx * (SC * cos(gamma) - SD * sin(gamma))
            + fy * (SD * cos(gamma) + SC * sin(gamma)),
            M4 * ZT * (E - EA) * dep**2 * cos(phi),
            -M4 * ZT * (E - EA) * php * (php + 2 * dep) * cos(phi),
            -M6 * U * (ZF - FA) * epp**2 * cos(omega),
            M6 * U * (ZF - FA) * omp * (omp + 2 * epp) * cos(omega),
        ]
    )


def spring_energy(q):
    x = SD * cos(q[2]) + SC * sin(q[2]) + XB - XC
    y = SD * sin(q[2]) - SC * cos(q[2]) + YB - YC
    return 0.5 * STIFFNESS * (np.hypot(x, y) - LENGTH) ** 2


def constraints(q):
    beta, theta, gamma, phi, delta, omega, epsilon = q
    x, y = (
        RR * cos(beta) - D * cos(beta + theta),
        RR * sin(beta) - D * sin(beta + theta),
    )
    return np.array(
        [
            x - SS * sin(gamma) - XB,
            y + SS * cos(gamma) - YB,
            x - E * sin(phi + delta) - ZT * cos(delta) - XA,
            y + E * cos(phi + delta) - ZT * sin(delta) - YA,
            x - ZF * cos(omega + epsilon) - U * sin(epsilon) - XA,
            y - ZF * sin(omega + epsilon) + U * cos(epsilon) - YA,
        ]
    )


def jacobian(q):
    beta, theta, gamma, phi, delta, omega, epsilon = q
    g = np.zeros((6, 7))
    g[0::2, 0] = -RR * sin(beta) + D * sin(beta + theta)
    g[0::2, 1] = D * sin(beta + theta)
    g[1::2, 0] = RR * cos(beta) - D * cos(beta + theta)
    g[1::2, 1] = -D * cos(beta + theta)
    g[0:2, 2] = -SS * cos(gamma), -SS * sin(gamma)
    g[2:4, 3] = -E * cos(phi + delta), -E * sin(phi + delta)
    g[2:4, 4] = g[2:4, 3] + [ZT * sin(delta), -ZT * cos(delta)]
    g[4:6, 5] = ZF * sin(omega + epsilon), -ZF * cos(omega + epsilon)
    g[4:6, 6] = g[4:6, 5] + [-U * cos(epsilon), -U * sin(epsilon)]
    return g


def curvature(q, v):
    """The part of the second time derivative of the constraints without q̈."""
    beta, theta, gamma, phi, delta, omega, epsilon = q
    bep, thp, gap, php, dep, omp, epp = v
    x = -RR * cos(beta) * bep**2 + D * cos(beta + theta) * (bep + thp) ** 2
    y = -RR * sin(beta) * bep**2 + D * sin(beta + theta) * (bep + thp) ** 2
    return np.array(
        [
            x + SS * sin(gamma) * gap**2,
            y - SS * cos(gamma) * gap**2,
            x + E * sin(phi + delta) * (php + dep) ** 2 + ZT * cos(delta) * dep**2,
            y - E * cos(phi + delta) * (php + dep) ** 2 + ZT * sin(delta) * dep**2,
            x
            + ZF * cos(omega + epsilon) * (omp + epp) ** 2
            + U * sin(epsilon) * epp**2,
            y
            + ZF * sin(omega + epsilon) * (omp + epp) ** 2
            - U * cos(epsilon) * epp**2,
        ]
    )


def motion(q, v):
    """(q̈, λ) of the index-reduced equations, with the sign M q̈ = f + Gᵀ λ."""
    return saddle(mass_matrix(q), forces(q, v), jacobian(q), -curvature(q, v))


def velocity_field(_, y):
    q, v = np.split(y, 2)
    return np.concatenate([v, motion(q, v)[0]])
