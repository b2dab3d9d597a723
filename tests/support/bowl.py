"""A ball in a turning bowl, by Newton and Euler in space, in NumPy alone.

The ball is (x, w, R): its centre, its angular velocity in space and its attitude as a
matrix. The centre moves on z = κ/2 (x² + y² + ε z²), whose unit normal is n.
"""

from dataclasses import dataclass

import numpy as np

from support.flow import flow
from support.rolling_bodies import cross, hat


UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Bowl:
    """`inertia` is the ball's moment of inertia, `radius` that of the ball."""

    mass: float
    radius: float
    inertia: float
    curvature: float
    rate: float
    gravity: float
    epsilon: float

    def normal(self, x):
        """(∇Φ, n) at a centre of the ball."""
        slope = UP - self.curvature * x * [1, 1, self.epsilon]
        return slope, slope / np.sqrt(slope @ slope)

    def velocity(self, x, w):
        """The velocity of the centre, as the ball rolls on the turning bowl."""
        _, n = self.normal(x)
        return self.rate * cross(UP, x - self.radius * n) + self.radius * cross(w, n)

    def accelerations(self, x, w):
        """(ẍ, w', F) with the force F of the bowl.

        They solve m (ẍ + g e₃) = F, I w' = -a n × F and the differentiated velocity,
        ẍ = k + a w' × n; (n × y) × n is y without its part along n.
        """
        m, a, g = self.mass, self.radius, self.gravity * UP
        slope, n = self.normal(x)
        v = self.velocity(x, w)
        turn = -self.curvature * v * [1, 1, self.epsilon]
        n_dot = (turn - n * (n @ turn)) / np.sqrt(slope @ slope)
        known = self.rate * cross(UP, v - a * n_dot) + a * cross(w, n_dot)
        share = m * a**2 / self.inertia * (np.eye(3) - np.outer(n, n))
        x_ddot = np.linalg.solve(np.eye(3) + share, known - share @ g)
        force = m * (x_ddot + g)
        return x_ddot, -a * cross(n, force) / self.inertia, force

    def multipliers(self, x, force):
        """(λ₁, λ₂, μ) with F = (λ₁, λ₂, 0) + μ ∇Φ."""
        slope, _ = self.normal(x)
        normal = force[2] / slope[2]
        return np.append(force[:2] - normal * slope[:2], normal)

    def trajectory(self, x, w, R, times):
        """(x, w, R) at each of the times."""

        def field(_, y):
            x, w, R = y[:3], y[3:6], y[6:].reshape(3, 3)
            return np.concatenate(
                [self.velocity(x, w), self.accelerations(x, w)[1], (hat(w) @ R).ravel()]
            )

        y = flow(field, [*x, *w, *R.ravel()], times, start=0.0)
        return y[:, :3], y[:, 3:6], y[:, 6:].reshape(-1, 3, 3)
