"""A chain of pendula in the angles of its rods, without constraints."""

import numpy as np


UP = np.array([0.0, 1.0])


class Chain:
    """Masses m and rods of lengths l, at angles from the downward vertical."""

    def __init__(self, masses, lengths, gravity):
        self.masses, self.lengths = np.asarray(masses), np.asarray(lengths)
        self.gravity = gravity
        self.below = np.cumsum(self.masses[::-1])[::-1]

    def acceleration(self, angles, rates):
        n = len(angles)
        larger = np.maximum(*np.indices((n, n)))
        weight = self.below[larger] * np.outer(self.lengths, self.lengths)
        difference = angles[:, None] - angles[None, :]
        load = -(weight * np.sin(difference)) @ rates**2
        load -= self.gravity * self.below * self.lengths * np.sin(angles)
        return np.linalg.solve(weight * np.cos(difference), load)

    def velocity_field(self, _, y):
        angles, rates = np.split(y, 2)
        return np.concatenate([rates, self.acceleration(angles, rates)])

    def state(self, angles, rates):
        """(q, v) in Cartesian coordinates."""
        along, across = _axes(angles)
        q = np.cumsum(self.lengths[:, None] * along, axis=0)
        v = np.cumsum((self.lengths * rates)[:, None] * across, axis=0)
        return q.ravel(), v.ravel()

    def motion(self, angles, rates):
        """(q̈, λ): the tensions follow from the masses below, λ = -T / 2l."""
        along, across = _axes(angles)
        swing = self.lengths * self.acceleration(angles, rates)
        swing = swing[:, None] * across - (self.lengths * rates**2)[:, None] * along
        acceleration = np.cumsum(swing, axis=0)
        load = self.masses[:, None] * (acceleration + self.gravity * UP)
        tension = -np.sum(along * np.cumsum(load[::-1], axis=0)[::-1], axis=1)
        return acceleration.ravel(), -tension / (2 * self.lengths)


def _axes(angles):
    """Unit vectors along the rods, and across them, in the sense of their rates."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.stack([sin, -cos], axis=1), np.stack([cos, sin], axis=1)
