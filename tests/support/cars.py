"""Cars and robots on wheels that do not slip, by reduced equations in NumPy.

The velocities follow from the speed by the geometry of the wheels, the speed from the
balance of power, and the forces of the ground from Newton's and Euler's laws, body by
body. No Lagrangian, multipliers or automatic derivatives are used.
"""

import math

import numpy as np

from support.flow import flow


def along(heading):
    return np.array([math.cos(heading), math.sin(heading)])


def left(heading):
    return np.array([-math.sin(heading), math.cos(heading)])


def per_trailer(car, name):
    value = np.asarray(getattr(car, f"trailer_{name}"), dtype=np.float64)
    return np.broadcast_to(value, (car.num_trailers,))


class Train:
    """A car with trailers: its state is (q, speed, steer rate)."""

    def __init__(self, car):
        self.n = car.num_trailers
        self.L, self.a = float(car.wheelbase), float(car.centre)
        self.m, self.I = float(car.mass), float(car.inertia)
        self.J = float(car.steer_inertia)
        names = ("length", "hitch", "centre", "mass", "inertia")
        self.trailers = [per_trailer(car, name) for name in names]

    def ratios(self, q, steer_rate_over_speed):
        """Speeds and turn rates of all axles per speed of the car, and their slopes.

        The slopes are derivatives by the distance that the car's rear axle has covered.
        """
        theta, delta = q[2], q[3]
        r, k = [1.0], [math.tan(delta) / self.L]
        dr = [0.0]
        dk = [steer_rate_over_speed / (self.L * math.cos(delta) ** 2)]
        for i in range(self.n):
            d, h = self.trailers[0][i], self.trailers[1][i]
            beta = theta - q[4 + i]
            theta = q[4 + i]
            s, c = math.sin(beta), math.cos(beta)
            r.append(r[i] * c + h * k[i] * s)
            k.append((r[i] * s - h * k[i] * c) / d)
            db = k[i] - k[i + 1]
            dr.append(dr[i] * c + h * dk[i] * s + (h * k[i] * c - r[i] * s) * db)
            change = dr[i] * s - h * dk[i] * c + (r[i] * c + h * k[i] * s) * db
            dk.append(change / d)
        return map(np.array, (r, k, dr, dk))

    def accelerations(self, q, speed, steer_rate, drive=0.0, torque=0.0):
        """(q̈, forces of the ground on the axles), at a speed that is not 0."""
        r, k, dr, dk = self.ratios(q, steer_rate / speed)
        m = np.array([self.m, *self.trailers[3]])
        inertia = np.array([self.I, *self.trailers[4]])
        ahead = np.array([self.a, *self.trailers[2]])
        own = inertia + m * ahead**2
        whole = np.sum(m * r**2 + own * k**2)
        slope = 2 * np.sum(m * r * dr + own * k * dk) * speed
        # `-torque * k[0]`: the torque's power (per speed) not spent on turning the
        # wheels.
        push = drive - torque * k[0] - 0.5 * slope * speed
        acceleration = push / whole
        turn = k * speed
        turning = k * acceleration + dk * speed**2
        steering = torque / self.J - turning[0]
        headings = [q[2], *q[4:]]
        forward = r * acceleration + dr * speed**2
        axles = [
            f * along(h) + rr * speed * w * left(h)
            for f, rr, w, h in zip(forward, r, turn, headings, strict=True)
        ]
        second = np.concatenate([axles[0], [turning[0], steering], turning[1:]])
        centres = [
            at + x * (dw * left(h) - w**2 * along(h))
            for at, x, w, dw, h in zip(
                axles, ahead, turn, turning, headings, strict=True
            )
        ]
        return second, self.ground(q, m, inertia, centres, turning, drive, torque)

    def ground(self, q, m, inertia, centres, turning, drive, torque):
        """Forces on the rear and front axles and on the axles of the trailers."""
        pulled = np.zeros(2)
        forces = []
        for i in reversed(range(self.n)):
            d, _, c, *_ = (x[i] for x in self.trailers)
            heading = q[4 + i]
            behind = self.trailers[1][i + 1] if i + 1 < self.n else 0.0
            total = m[i + 1] * centres[i + 1] - pulled
            moment = inertia[i + 1] * turning[i + 1]
            moment += (c + behind) * left(heading) @ pulled
            # The axle is c behind the centre and the hitch d - c ahead of it.
            sideways = left(heading) @ total
            axle = ((d - c) * sideways - moment) / d
            forces.append(axle)
            pulled = -(total - axle * left(heading))
        heading, delta = q[2], q[3]
        total = m[0] * centres[0] - pulled - drive * along(heading)
        behind = self.trailers[1][0] if self.n else 0.0
        moment = inertia[0] * turning[0] + torque
        moment += (self.a + behind) * left(heading) @ pulled
        across = left(heading) @ total
        # Only the sideways part of the front force has a moment about the rear axle.
        front = (moment + self.a * across) / self.L / math.cos(delta)
        rear = across - front * math.cos(delta)
        assert abs(along(heading) @ total + front * math.sin(delta)) < 1e-9 * (
            1 + abs(front) + abs(rear)
        )
        return np.array([rear, front, *forces[::-1]])

    def velocity(self, q, speed, steer_rate):
        _, k, *_ = self.ratios(q, steer_rate)
        return np.concatenate(
            [speed * along(q[2]), [speed * k[0], steer_rate], speed * k[1:]]
        )

    def trajectory(self, q0, speed, steer_rate, times, drive=0.0, torque=0.0):
        """(q, v, forces of the ground) at the times, by SciPy."""
        size = 4 + self.n

        def field(_, y):
            q, (speed, rate) = y[:size], y[size:]
            second, _ = self.accelerations(q, speed, rate, drive, torque)
            change = second[:2] @ along(q[2])
            return np.concatenate([self.velocity(q, speed, rate), [change, second[3]]])

        q, v, forces = [], [], []
        for y in flow(field, [*q0, speed, steer_rate], times):
            q.append(y[:size])
            speed, rate = y[size:]
            v.append(self.velocity(y[:size], speed, rate))
            second = self.accelerations(y[:size], speed, rate, drive, torque)
            forces.append(second[1])
        return tuple(map(np.array, (q, v, forces)))


class Robot:
    """A robot on two driven wheels: its state is (q, speed, turn rate).

    The rotation of the wheels eliminates the forward ground forces. Newton's and
    Euler's laws for the whole robot then give the rates of speed and turn rate
    (Dhaouadi and Abu Hatab, 2013).
    """

    def __init__(self, robot):
        self.m, self.I = float(robot.mass), float(robot.inertia)
        self.d, self.b = float(robot.offset), float(robot.half_track)
        self.r, self.mw = float(robot.radius), float(robot.wheel_mass)
        self.Iw, self.Im = float(robot.axle_inertia), float(robot.wheel_inertia)

    def changes(self, speed, turn, on_right, on_left):
        """The rates of speed and turn rate."""
        m = self.m + 2 * self.mw
        whole = self.I + self.m * self.d**2 + 2 * self.mw * self.b**2 + 2 * self.Im
        rolling = 2 * self.Iw / self.r**2
        ahead = (on_right + on_left) / self.r + self.m * self.d * turn**2
        moment = self.b * (on_right - on_left) / self.r - self.m * self.d * turn * speed
        return ahead / (m + rolling), moment / (whole + self.b**2 * rolling)

    def accelerations(self, q, speed, turn, on_right=0.0, on_left=0.0):
        """(q̈, ground forces: sideways, and forward on right and left wheel)."""
        push, twist = self.changes(speed, turn, on_right, on_left)
        axle = push * along(q[2]) + speed * turn * left(q[2])
        wheels = np.array([push + self.b * twist, push - self.b * twist]) / self.r
        ahead = (np.array([on_right, on_left]) - self.Iw * wheels) / self.r
        # Newton's law to the left of the heading; `twist` of the two wheels cancels.
        aside = (self.m + 2 * self.mw) * speed * turn + self.m * self.d * twist
        return np.concatenate([axle, [twist], wheels]), np.array([aside, *ahead])

    def velocity(self, q, speed, turn):
        wheels = np.array([speed + self.b * turn, speed - self.b * turn]) / self.r
        return np.concatenate([speed * along(q[2]), [turn], wheels])

    def trajectory(self, q0, speed, turn, times, torques):
        """(q, v, forces of the ground) at the times, by SciPy."""

        def field(t, y):
            q, (speed, turn) = y[:5], y[5:]
            changes = self.changes(speed, turn, *torques)
            return np.concatenate([self.velocity(q, speed, turn), changes])

        q, v, forces = [], [], []
        for y in flow(field, [*q0, speed, turn], times):
            speed, turn = y[5:]
            q.append(y[:5])
            v.append(self.velocity(y[:5], speed, turn))
            forces.append(self.accelerations(y[:5], speed, turn, *torques)[1])
        return tuple(map(np.array, (q, v, forces)))
