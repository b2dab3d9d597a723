"""Linkages with one degree of freedom in the angle of the crank.

The closed loop is solved for the other angles by trigonometry, Kane's equation gives
the acceleration of the crank, and the Newton-Euler equations give the force in the last
joint.
"""

from typing import NamedTuple

import numpy as np


GRAVITY = 9.81
WEIGHT = np.array([0.0, -GRAVITY])


class Body(NamedTuple):
    """A body while the crank moves at θ̇ with acceleration θ̈.

    Its centre at c has the velocity w θ̇ and acceleration w θ̈ + b; its angular
    velocity is k θ̇, and its angular acceleration k θ̈ + d.
    """

    mass: float
    inertia: float
    path: np.ndarray  # c, w and b
    k: float
    d: float

    @property
    def c(self):
        return self.path[0]

    @property
    def w(self):
        return self.path[1]

    @property
    def b(self):
        return self.path[2]

    def moment(self, pivot, acceleration):
        """The moment about a pivot that the joints must exert on the body."""
        load = self.mass * (self.w * acceleration + self.b - WEIGHT)
        turning = self.inertia * (self.k * acceleration + self.d)
        return turning + cross(self.c - pivot, load)


def cross(first, second):
    return first[0] * second[1] - first[1] * second[0]


def unit(angle):
    return np.array([np.cos(angle), np.sin(angle)])


def normal(angle):
    return np.array([-np.sin(angle), np.cos(angle)])


def bar_inertia(mass, length):
    return mass * length**2 / 12


def inertia(bodies):
    """I in the kinetic energy ½ I(θ) θ̇²."""
    return sum(x.mass * x.w @ x.w + x.inertia * x.k**2 for x in bodies)


def potential(bodies):
    return -sum(x.mass * x.c @ WEIGHT for x in bodies)


def crank_acceleration(bodies, torque):
    """Kane's equation: the work of all loads on the motion per θ̇ vanishes."""
    load = sum(x.mass * (x.b - WEIGHT) @ x.w + x.inertia * x.d * x.k for x in bodies)
    return (torque - load) / inertia(bodies)


def _bar(length, angle, rate, k, d):
    """A bar's vector with its w and b, as in `Body`."""
    bend = normal(angle) * d - unit(angle) * (k * rate) ** 2
    return length * np.stack([unit(angle), normal(angle) * k, bend])


class SliderCrank:
    """Crank r, rod l and slider along y = e."""

    def __init__(self, r, l, e, masses, torque):
        self.r, self.l, self.e, self.masses, self.torque = r, l, e, masses, torque

    def angles(self, theta):
        phi = np.arcsin((self.e - self.r * np.sin(theta)) / self.l)
        ratio = -self.r * np.cos(theta) / (self.l * np.cos(phi))
        return phi, ratio

    def bodies(self, theta, rate):
        r, l = self.r, self.l
        crank, rod, slider = self.masses
        phi, k = self.angles(theta)
        # From d²/dt² (r sin θ + l sin φ) = 0.
        d = (r * np.sin(theta) + l * np.sin(phi) * k**2) * rate**2 / (l * np.cos(phi))
        pin, arm = _bar(r, theta, rate, 1.0, 0.0), _bar(l, phi, rate, k, d)
        return (
            Body(crank, bar_inertia(crank, r), 0.5 * pin, 1.0, 0.0),
            Body(rod, bar_inertia(rod, l), pin + 0.5 * arm, k, d),
            # Its height is constant except for rounding errors.
            Body(slider, 0.0, pin + arm, 0.0, 0.0),
        )

    def state(self, theta, rate):
        phi, k = self.angles(theta)
        slider = self.bodies(theta, rate)[2]
        return np.array([theta, phi, slider.c[0]]), rate * np.array([1, k, slider.w[0]])

    def motion(self, theta, rate):
        """(q̈, λ), with λ the force on the rod at the slider."""
        bodies = self.bodies(theta, rate)
        _, rod, slider = bodies
        acceleration = crank_acceleration(bodies, self.torque)
        slide = slider.w[0] * acceleration + slider.b[0]
        pin = self.r * unit(theta)
        arm = slider.c - pin
        across = -slider.mass * slide
        up = (rod.moment(pin, acceleration) + arm[1] * across) / arm[0]
        turning = rod.k * acceleration + rod.d
        return np.array([acceleration, turning, slide]), np.array([across, up])


class FourBar:
    """Bars l₁, l₂, l₃ on the ground l₄."""

    def __init__(self, lengths, masses, torque):
        self.lengths, self.masses, self.torque = lengths, masses, torque

    def angles(self, theta):
        """The angles of coupler and rocker, and their rates per rate of the crank."""
        l1, l2, l3, l4 = self.lengths
        # Freudenstein's equation for the rocker, by the half-angle.
        k1, k2 = l4 / l1, l4 / l3
        k3 = (l1**2 - l2**2 + l3**2 + l4**2) / (2 * l1 * l3)
        a = np.cos(theta) * (1 - k2) - k1 + k3
        b, c = -2 * np.sin(theta), k1 - (1 + k2) * np.cos(theta) + k3
        rocker = 2 * np.arctan2(-b - np.sqrt(b**2 - 4 * a * c), 2 * a)
        tip = np.array([l4, 0.0]) + l3 * unit(rocker) - l1 * unit(theta)
        coupler = np.arctan2(tip[1], tip[0])
        matrix = np.stack([l2 * normal(coupler), -l3 * normal(rocker)], axis=1)
        ratios = np.linalg.solve(matrix, -l1 * normal(theta))
        return coupler, np.mod(rocker, 2 * np.pi), matrix, ratios

    def bodies(self, theta, rate):
        l1, l2, l3, l4 = self.lengths
        coupler, rocker, matrix, (k2, k3) = self.angles(theta)
        known = (
            l1 * unit(theta) + l2 * unit(coupler) * k2**2 - l3 * unit(rocker) * k3**2
        )
        d2, d3 = np.linalg.solve(matrix, known * rate**2)
        crank = _bar(l1, theta, rate, 1.0, 0.0)
        coupler = _bar(l2, coupler, rate, k2, d2)
        rocker = _bar(l3, rocker, rate, k3, d3)
        centres = 0.5 * crank, crank + 0.5 * coupler, 0.5 * rocker
        centres[2][0, 0] += l4
        m1, m2, m3 = self.masses
        return (
            Body(m1, bar_inertia(m1, l1), centres[0], 1.0, 0.0),
            Body(m2, bar_inertia(m2, l2), centres[1], k2, d2),
            Body(m3, bar_inertia(m3, l3), centres[2], k3, d3),
        )

    def state(self, theta, rate):
        coupler, rocker, _, ratios = self.angles(theta)
        return np.array([theta, coupler, rocker]), rate * np.array([1.0, *ratios])

    def motion(self, theta, rate):
        """(q̈, λ), with λ the force on the coupler at the rocker."""
        bodies = self.bodies(theta, rate)
        acceleration = crank_acceleration(bodies, self.torque)
        pin, ground = self.lengths[0] * unit(theta), np.array([self.lengths[3], 0.0])
        (_, _, rocker), coupler = bodies, bodies[1]
        tip = ground + 2 * (rocker.c - ground)
        first, second = tip - pin, ground - tip
        matrix = np.array([[-first[1], first[0]], [-second[1], second[0]]])
        moments = [
            coupler.moment(pin, acceleration),
            rocker.moment(ground, acceleration),
        ]
        turning = [x.k * acceleration + x.d for x in bodies]
        return np.array(turning), np.linalg.solve(matrix, moments)
