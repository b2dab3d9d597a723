"""The wheelset benchmark against Newton's and Euler's equations.

The equations here are written with vectors in space: forces and torques on a body, with
contacts that a root finder locates. They share no formula with the benchmark.
"""

import numpy as np
import pytest
from scipy.optimize import root
from scipy.spatial.transform import Rotation

import nhjax
from benchmarks.wheelset import START, Wheelset


MASS, G, V, R0, I1, I2 = 16.08, 9.81, 30.0, 0.1, 0.0605, 0.366
UP, AHEAD = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


def _frame(theta, phi):
    return Rotation.from_euler("YZ", [theta, phi]).as_matrix().T


def _rail(x):
    u = abs(x) - 0.1506 - 0.06 * np.sin(0.0262)
    depth = np.sqrt(0.06**2 - u**2)
    return depth - R0 - 0.06 * np.cos(0.0262), -np.sign(x) * u / depth


class _Contact:
    """The point on the cone of a side where the cone is tangent to the rail."""

    def __init__(self, q, side):
        self.q, self.taper = q, -side * np.tan(0.0262)
        self.xi, self.psi = root(self._tangents, [0.15 * side, 0.0], tol=1e-14).x
        self.radius = R0 + np.tan(0.0262) * 0.1506 + self.taper * self.xi
        self.arm = self._arm(*q[3:5])
        rail, self.slope = _rail(q[0] + self.arm[0])
        self.gap = rail - q[1] - self.arm[1]
        self.normal = np.array([self.slope, -1.0, 0.0])

    def _arm(self, theta, phi):
        i, j, k = _frame(theta, phi)
        return self.xi * i - self.radius * (np.cos(self.psi) * j + np.sin(self.psi) * k)

    def _tangents(self, unknowns):
        xi, psi = unknowns
        i, j, k = _frame(*self.q[3:5])
        radius = R0 + np.tan(0.0262) * 0.1506 + self.taper * xi
        out = -np.cos(psi) * j - np.sin(psi) * k
        slope = _rail(self.q[0] + xi * i[0] + radius * out[0])[1]
        normal = np.array([slope, -1.0, 0.0])
        return normal @ (i + self.taper * out), normal @ np.cross(i, out)

    def creep(self, v, reaction):
        delta = np.arctan(self.slope)
        yaw = self.q[3] / np.cos(delta)
        i, _, k = _frame(yaw, self.q[4])
        omega = v[3] * UP + v[4] * k + (V / R0 + v[5]) * i
        spinning = np.cross(omega, self._arm(yaw, self.q[4]))
        going = v[:3] + V * AHEAD
        rolling = np.linalg.norm(spinning - going) / 2
        _, across, along = Rotation.from_euler("YZ", [yaw, delta]).as_matrix().T
        across = np.cross(across, along)
        slip = (spinning + going) / rolling
        pivot = np.cos(delta) * v[3] - np.sin(delta) * (V / R0 + v[5])
        load = np.linalg.norm(reaction)
        bend = 0.5 / 0.06 + 0.5 / (self.radius * np.sqrt(1 + np.tan(0.0262) ** 2))
        size = 3 * load * 0.72 * 1.3537956
        size /= 2 * 3.1415926 * bend * 7.92e10 * np.sqrt(0.7115218)
        size = np.cbrt(size)
        most = 0.12 * load
        pull = np.array([4.72772197 * slip @ along, 4.27526987 * slip @ across])
        pull[1] += 1.97203505 * size * pivot / rolling
        pull = -most * np.tanh(7.92e10 * size**2 * pull / most)
        pull *= min(1, most / np.linalg.norm(pull))
        return pull[0] * along + pull[1] * across


def _imbalance(q, v, a, multiplier):
    """Mass times acceleration minus force, and the same for rotation."""
    force = -MASS * G * UP - 2 * 6400.0 * np.array([q[0], 0.0, q[2]])
    torque = -2 * 0.19**2 * 6400.0 * q[3] * UP
    for at, size in zip(_contacts(q), multiplier, strict=True):
        reaction = size * at.normal
        total = reaction + at.creep(v, reaction)
        force, torque = force + total, torque + np.cross(at.arm, total)
    i, _, k = _frame(*q[3:5])
    carried = v[3] * UP + v[4] * k
    spin = V / R0 + v[5]
    omega, i_dot = carried + spin * i, np.cross(carried, i)
    omega_dot = a[3] * UP + a[4] * k + a[5] * i + spin * i_dot
    omega_dot = omega_dot + v[3] * v[4] * np.cross(UP, k)
    along, rate = omega @ i, omega_dot @ i + omega @ i_dot
    turning = I2 * omega_dot + (I1 - I2) * (rate * i + along * i_dot)
    return np.concatenate([MASS * a[:3] - force, turning - torque])


def _contacts(q):
    return [_Contact(q, side) for side in (1.0, -1.0)]


def test_equations_of_this_test_have_the_published_start():
    a = [-1.975258894011285, -1.0898297102811276e-3, 7.8855083626142589e-2]
    a += [-5.533362821731549, -0.3487021489546511, -2.132968724380927]
    multiplier = [-83.593, -74.144]
    imbalance = _imbalance(START, np.zeros(6), np.array(a), multiplier)
    np.testing.assert_allclose(imbalance, 0, atol=1e-9)
    left, right = _contacts(START)
    found = [right.psi, right.xi, left.psi, left.xi]
    published = [-7.4122380357667139e-6, -0.1521364296121248]
    published += [7.5634406395172940e-6, 0.1490635714733819]
    np.testing.assert_allclose(found, published, rtol=0, atol=1e-13)


# The derivative of a function from its values at nine points.
STENCIL = np.array([3, -32, 168, -672, 0, 672, -168, 32, -3]) / 840


def test_wheelset_satisfies_the_equations_at_first():
    machine, dt = Wheelset(), 5e-5
    sol = nhjax.integrate(
        machine.system,
        nhjax.LobattoIIIAB(4),
        machine.y0,
        dt=dt,
        num_steps=800,
        args=machine.gaps,
        saveat=nhjax.SaveAt(t0=True, steps=True),
    )
    q, v = np.asarray(sol.ys.q), np.asarray(sol.ys.v)
    multiplier = np.asarray(sol.ys.multiplier)
    # One wheel begins to slide after 2 ms, the other after 4 ms; k avoids both times.
    for k in (10, 20, 60, 200, 500, 790):
        a = STENCIL @ v[k - 4 : k + 5] / dt
        imbalance = _imbalance(q[k], v[k], a, multiplier[k])
        np.testing.assert_allclose(imbalance, 0, atol=1e-8)
        drift = np.array([at.gap for at in _contacts(q[k])]) - np.asarray(machine.gaps)
        np.testing.assert_allclose(drift, 0, atol=1e-15)


@pytest.mark.long
def test_wheelset_agrees_with_an_explicit_method():
    machine = Wheelset()
    ours = machine.run(4, 4000, duration=0.2)
    theirs = machine.reduced_run(1e-12, duration=0.2)
    np.testing.assert_allclose(ours.unknowns, theirs.unknowns, rtol=1e-8, atol=2e-9)
