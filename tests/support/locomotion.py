"""Snakeboard and roller racer by reduced equations.

The snakeboard uses the nonholonomic momentum equation ṗ = μ · ċ of Bloch,
Krishnaprasad, Marsden and Murray (1996): p is the component of the body momentum μ
along c(φ), the only body velocity that the axles permit. The roller racer uses the
Gibbs-Appell equations in the speed of the seat and the rate of the pivot. Forces follow
from Newton's equations.
"""

import numpy as np


class Sine:
    """a sin(ωt + β) with two derivatives."""

    def __init__(self, amplitude, rate, phase):
        self.values = tuple(np.asarray(x, float) for x in (amplitude, rate, phase))

    def __call__(self, t):
        a, w, b = self.values
        turn = w * t + b
        return a * np.sin(turn), a * w * np.cos(turn), -a * w**2 * np.sin(turn)


class Snakeboard:
    """State (x, y, θ) with the joints (ψ, φ_b, φ_f), and the speed s ahead."""

    def __init__(self, mass, inertia, rotor, axle, half_length):
        self.m, self.J, self.l = mass, inertia, half_length
        self.spins = np.array([rotor, axle, axle])

    def permitted(self, joints, rates):
        """The body velocity c per speed, and its time derivative."""
        tangent = np.tan(joints[1:])
        slope = rates[1:] * (1 + tangent**2)
        c = np.array([1.0, tangent.mean(), (tangent[1] - tangent[0]) / (2 * self.l)])
        dc = np.array([0.0, slope.mean(), (slope[1] - slope[0]) / (2 * self.l)])
        return c, dc

    def metric(self, c, spin):
        """The mass that belongs to the speed, with the joints at rest."""
        return self.m * (1 + c[1] ** 2) + (self.J + spin) * c[2] ** 2

    def speed(self, p, joints, rates):
        """The speed s for the momentum p, with prescribed joints."""
        c, _ = self.permitted(joints, rates)
        return (p - c[2] * self.spins @ rates) / self.metric(c, self.spins.sum())

    def momentum(self, s, joints, rates):
        c, _ = self.permitted(joints, rates)
        return self.metric(c, self.spins.sum()) * s + c[2] * self.spins @ rates

    def momentum_rate(self, s, joints, rates):
        """ṗ = μ · ċ: [ξ, c] vanishes, as ξ is along c."""
        c, dc = self.permitted(joints, rates)
        turning = (self.J + self.spins.sum()) * c[2] * s + self.spins @ rates
        return self.m * c[1] * s * dc[1] + turning * dc[2]

    def driven_acceleration(self, s, joints, rates, accelerations):
        """ṡ with prescribed joints, from the momentum equation."""
        c, dc = self.permitted(joints, rates)
        total = self.spins.sum()
        change = 2 * self.m * c[1] * dc[1] + 2 * (self.J + total) * c[2] * dc[2]
        load = self.momentum_rate(s, joints, rates) - change * s
        load -= dc[2] * self.spins @ rates + c[2] * self.spins @ accelerations
        return load / self.metric(c, total)

    def free_acceleration(self, s, joints, rates, torques):
        """(ṡ, ψ̈, φ̈_b, φ̈_f) under torques, which alone change the joints' momenta."""
        c, dc = self.permitted(joints, rates)
        load = (
            -s * (self.m * c[1] * dc[1] + self.J * c[2] * dc[2]) - c[2] * torques.sum()
        )
        ds = load / self.metric(c, 0.0)
        return ds, torques / self.spins - (c[2] * ds + dc[2] * s)

    def state(self, place, s, joints, rates):
        """(q, v) in space."""
        c, _ = self.permitted(joints, rates)
        return np.concatenate([place, joints]), np.concatenate(
            [rotated(place[2], s * c[:2]), [s * c[2]], rates]
        )

    def motion(self, place, s, joints, rates, ds, accelerations):
        """(q̈, λ of the axles, torques of the joints), by Newton's equations."""
        c, dc = self.permitted(joints, rates)
        (vx, vy, turning), (ax, ay, spin) = s * c, ds * c + s * dc
        body = np.array([ax - turning * vy, ay + turning * vx])
        torques = self.spins * (spin + accelerations)
        lateral, moment = self.m * body[1], (self.J * spin + torques.sum()) / self.l
        axles = 0.5 * np.array([lateral - moment, lateral + moment])
        q = np.concatenate([rotated(place[2], body), [spin], accelerations])
        return q, axles / np.cos(joints[1:]), torques


class RollerRacer:
    """State (x, y, θ) with the pivot φ, and the speed s ahead of the seat."""

    def __init__(self, masses, inertias, distances):
        (self.m1, self.m2), (self.I1, self.I2) = masses, inertias
        self.d1, self.d2 = distances

    def ratios(self, phi):
        """θ̇ = k s + h φ̇, with the slopes of k and h."""
        reach = self.d1 * np.cos(phi) + self.d2
        k, h = np.sin(phi) / reach, -self.d2 / reach
        bend = self.d1 * np.sin(phi) / reach
        return k, h, np.cos(phi) / reach + k * bend, h * bend

    def _kinematics(self, s, phi, rate):
        """θ̇; for θ̈ and the bar's accelerations, factors of ṡ and φ̈; remainders."""
        k, h, dk, dh = self.ratios(phi)
        turning = k * s + h * rate
        bend = (dk * s + dh * rate) * rate
        sine, cosine = np.sin(phi), np.cos(phi)
        by_speed = np.array([k, cosine + self.d1 * k * sine, k])
        by_rate = np.array([h, self.d1 * h * sine, 1 + h])
        remainder = self.d1 * (bend * sine + turning * cosine * rate) - s * sine * rate
        return turning, by_speed, by_rate, np.array([bend, remainder, bend])

    def equations(self, s, phi, rate):
        """Matrix and load of (ṡ, φ̈), without a torque."""
        _, by_speed, by_rate, remainder = self._kinematics(s, phi, rate)
        weights = np.array([self.I1, self.m2, self.I2])
        parts = np.stack([by_speed, by_rate])
        matrix = (parts * weights) @ parts.T
        matrix[0, 0] += self.m1
        return matrix, -(parts * weights) @ remainder

    def driven_acceleration(self, s, phi, rate, acceleration):
        matrix, load = self.equations(s, phi, rate)
        return (load[0] - matrix[0, 1] * acceleration) / matrix[0, 0]

    def free_acceleration(self, s, phi, rate, torque):
        matrix, load = self.equations(s, phi, rate)
        return np.linalg.solve(matrix, load + np.array([0.0, torque]))

    def state(self, place, s, phi, rate):
        turning = self._kinematics(s, phi, rate)[0]
        v = [*rotated(place[2], np.array([s, 0.0])), turning, rate]
        return np.array([*place, phi]), np.array(v)

    def motion(self, place, s, phi, rate, ds, acceleration):
        """(q̈, λ of the axles, torque of the pivot), by moments about the pivot."""
        turning, by_speed, by_rate, bend = self._kinematics(s, phi, rate)
        spin, gain, spin2 = by_speed * ds + by_rate * acceleration + bend
        spin2 = spin2 + 0.0
        speed2 = s * np.cos(phi) + self.d1 * turning * np.sin(phi)
        sine, cosine = np.sin(phi), np.cos(phi)
        # The handlebar's acceleration along and across itself, then across the seat.
        across = speed2 * (turning + rate)
        side = gain * sine + across * cosine
        moment = self.I1 * spin + self.I2 * spin2
        moment += self.m2 * (self.d2 * across + self.d1 * side)
        front = moment / (self.d2 + self.d1 * cosine)
        torque = self.I2 * spin2 + self.d2 * (self.m2 * across - front)
        rear = self.m1 * s * turning + self.m2 * side - front * cosine
        a = [*rotated(place[2], np.array([ds, s * turning])), spin, acceleration]
        return np.array(a), np.array([rear, front]), torque


def rotated(angle, vector):
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array(
        [cos * vector[0] - sin * vector[1], sin * vector[0] + cos * vector[1]]
    )
