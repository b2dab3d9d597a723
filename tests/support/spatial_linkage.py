"""The spatial slider-crank in the angle of its crank, by Kane's equation.

The connecting rod turns about the slider's axis and about a second axis across both, as
the universal joint at the slider allows. Newton's and Euler's equations of the rod and
the slider give the force in the spherical joint.
"""

import numpy as np


X = np.array([1.0, 0.0, 0.0])


class SpatialSliderCrank:
    """Crank r about the axle at (0, y, z), rod l, slider along the x-axis.

    `inertias` belong to the crank, and to the rod along and across its axis.
    """

    def __init__(self, r, l, axle, inertias, masses, gravity, centre=0.0):
        self.r, self.l, self.axle = r, l, np.array([0.0, *axle])
        self.crank_inertia, self.axial, self.transverse = inertias
        self.crank_mass, self.rod_mass, self.slider_mass = masses
        self.weight, self.centre = np.array([0.0, 0.0, -gravity]), centre

    def _motions(self, theta, rate):
        """(place, w, b) of pin and slider: velocity w θ̇, acceleration w θ̈ + b."""
        sine, cosine = np.sin(theta), np.cos(theta)
        arm = self.r * np.array([0.0, -sine, cosine])
        pin = [
            self.axle + arm,
            self.r * np.array([0.0, -cosine, -sine]),
            -arm * rate**2,
        ]
        p, w, b = pin
        x = np.sqrt(self.l**2 - p @ p)
        # From x ẋ = -p · ṗ and ẋ² + x ẍ = -p · p̈ - ṗ · ṗ.
        dx = -(p @ w) / x
        ddx = -(p @ b + (w @ w + dx**2) * rate**2) / x
        return np.stack(pin), np.stack([x * X, dx * X, ddx * X])

    def _rod(self, theta, rate):
        """Axis e, second joint axis n, ω = k θ̇ and ω̇ = k θ̈ + d of the rod.

        Then the two parts of k, about the x-axis and about n, with their remainders.
        """
        pin, slider = self._motions(theta, rate)
        e, w, b = (slider - pin) / self.l
        across = np.cross(X, e)
        size = np.sqrt(across @ across)
        n = across / size
        first, second = w @ n / size, w @ np.cross(n, e)
        k = first * X + second * n
        omega = k * rate
        bend = first * second * rate**2 * np.cross(X, n)
        rest = b - np.cross(omega, np.cross(omega, e)) - np.cross(bend, e)
        remainders = rest @ n / size, rest @ np.cross(n, e)
        d = bend + remainders[0] * X + remainders[1] * n
        return e, n, k, d, ((first, second), remainders)

    def _momentum(self, e, vector):
        return (
            self.transverse * vector + (self.axial - self.transverse) * (e @ vector) * e
        )

    def crank(self, theta, rate):
        """I(θ) and the load in I θ̈ = load, with the potential energy."""
        pin, slider = self._motions(theta, rate)
        e, _, k, d, _ = self._rod(theta, rate)
        centre, w, b = 0.5 * (pin + slider)
        omega = k * rate
        spin = self._momentum(e, d) + np.cross(omega, self._momentum(e, omega))
        inertia = self.rod_mass * w @ w + k @ self._momentum(e, k)
        inertia += self.crank_inertia + self.slider_mass * slider[1] @ slider[1]
        inertia += self.crank_mass * self.centre**2 * self.r**2
        load = -self.rod_mass * (b - self.weight) @ w - spin @ k
        load -= self.slider_mass * slider[2] @ slider[1]
        load += self.crank_mass * self.centre * self.weight @ pin[1]
        arm = self.axle + self.centre * (pin[0] - self.axle)
        heights = self.rod_mass * centre + self.crank_mass * arm
        return inertia, load, -heights @ self.weight

    def state(self, theta, rate):
        """(q, v), q = (θ, α, β, x), with e = (cos β, sin α sin β, -cos α sin β)."""
        _, slider = self._motions(theta, rate)
        e, _, _, _, ((first, second), _) = self._rod(theta, rate)
        tilt = np.arctan2(e[1], -e[2])
        q = np.array(
            [theta, tilt, np.arctan2(np.hypot(e[1], e[2]), e[0]), slider[0, 0]]
        )
        return q, rate * np.array([1.0, first, second, slider[1, 0]])

    def motion(self, theta, rate):
        """(q̈, λ), with λ the force of the pin on the rod."""
        pin, slider = self._motions(theta, rate)
        e, n, k, d, (parts, remainders) = self._rod(theta, rate)
        inertia, load, _ = self.crank(theta, rate)
        acceleration = load / inertia
        rod = self.rod_mass * (0.5 * (pin + slider)[1:].T @ [acceleration, 1.0])
        slide = self.slider_mass * (slider[1:].T @ [acceleration, 1.0])
        omega = k * rate
        spin = self._momentum(e, k * acceleration + d)
        spin = spin + np.cross(omega, self._momentum(e, omega))
        push = rod - self.rod_mass * self.weight
        moment = spin + np.cross(-0.5 * self.l * e, push)
        arm = -self.l * e
        rows = np.stack([X, np.cross(X, arm), np.cross(n, arm)])
        loads = [rod[0] + slide[0], moment @ X, moment @ n]
        angles = acceleration * np.array(parts) + remainders
        q = [acceleration, *angles, slider[1, 0] * acceleration + slider[2, 0]]
        return np.array(q), np.linalg.solve(rows, loads)
