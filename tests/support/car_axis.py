"""The car axis in two coordinates without constraints, by Newton's equations.

The line of the wheels turns by the known angle φ(t). The left end is at s n, where n is
the unit vector perpendicular to this line; the axle has the angle α.
"""

import numpy as np


M, EPSILON, L, L0, R, OMEGA, G = 10.0, 1e-2, 1.0, 0.5, 0.1, 10.0, 1.0
MASS = 0.5 * M * EPSILON**2


def wheel_angle(t):
    """φ with its two derivatives, sin φ = r/l sin ωt."""
    sine = R / L * np.sin(OMEGA * t)
    first, second = R / L * OMEGA * np.cos(OMEGA * t), -(OMEGA**2) * sine
    cosine = np.sqrt(1 - sine**2)
    rate = first / cosine
    return np.arcsin(sine), rate, (second + sine * rate**2) / cosine


def axes(angle):
    """The unit vector at an angle, and the one perpendicular to it."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([cos, sin]), np.array([-sin, cos])


def spring_force(end, wheel):
    spring = end - wheel
    length = np.hypot(*spring)
    return (L0 - length) / length * spring - MASS * G * np.array([0.0, 1.0])


def motion(t, y):
    """(r̈_l, r̈_r), (s̈, α̈) and (λ1, λ2) at y = (s, α, ṡ, α̇)."""
    s, alpha, ds, dalpha = y
    phi, dphi, ddphi = wheel_angle(t)
    e, n = axes(phi)
    u, w = axes(alpha)
    left = -s * dphi**2 * n - (2 * ds * dphi + s * ddphi) * e
    right = left - L * dalpha**2 * u
    force_left = spring_force(s * n, np.zeros(2))
    force_right = spring_force(s * n + L * u, L * e)
    matrix = np.array([[2.0, L * (w @ n)], [n @ w, L]])
    loads = np.array(
        [
            (force_left + force_right) @ n / MASS - (left + right) @ n,
            force_right @ w / MASS - right @ w,
        ]
    )
    dds, ddalpha = np.linalg.solve(matrix, loads)
    left, right = left + dds * n, right + dds * n + L * ddalpha * w
    reaction = MASS * (left + right) - force_left - force_right
    multiplier = [reaction @ e / L, (MASS * right - force_right) @ u / (2 * L)]
    return np.concatenate([left, right]), (dds, ddalpha), np.array(multiplier)


def velocity_field(t, y):
    """The rates of (s, α, ṡ, α̇) and of the work that the road does."""
    s, _, ds, dalpha, _ = y
    phi, dphi, _ = wheel_angle(t)
    e, n = axes(phi)
    _, (dds, ddalpha), (reaction, _) = motion(t, y[:4])
    # The reaction acts at the left end along e. The spring acts at the wheel, which
    # moves along n.
    end = s * n + L * axes(y[1])[0]
    pull = (spring_force(end, L * e) + MASS * G * np.array([0.0, 1.0])) @ n
    power = reaction * L * (e @ (-s * dphi * e)) + pull * L * dphi
    return np.array([ds, dalpha, dds, ddalpha, power])


def state(t, y):
    """(q, v) of the axle at y = (s, α, ṡ, α̇)."""
    s, alpha, ds, dalpha = y[:4]
    phi, dphi, _ = wheel_angle(t)
    e, n = axes(phi)
    u, w = axes(alpha)
    left, dleft = s * n, ds * n - s * dphi * e
    return np.array([*left, *(left + L * u)]), np.array(
        [*dleft, *(dleft + L * dalpha * w)]
    )
