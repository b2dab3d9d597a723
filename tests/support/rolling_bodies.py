"""Rigid bodies that roll on a horizontal plane, by Newton and Euler in body axes.

Forces are eliminated by hand. The state is (R, ω, x, y), with the attitude as a matrix,
the body angular velocity and the point of contact. γ = Rᵀ e₃ is the upward vertical in
the body, and s the contact as seen from the centre of mass. In NumPy alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation


def cross(x, y):
    """The product x × y; `np.cross` takes ten times as long for one pair."""
    a, b, c = x
    d, e, f = y
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def hat(x):
    """The matrix of y -> x × y."""
    return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0.0]])


@dataclass(frozen=True)
class RollingBody:
    """A body of given shape: `shape(γ)` is s with its derivative ∂s/∂γ."""

    mass: float
    inertia: np.ndarray
    gravity: float
    shape: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
    damping: float = 0.0

    def accelerations(self, R, omega):
        """(v̇, ω̇, F) of the body velocities, with the force F of the plane in space.

        From m (v̇ + ω × v + g γ) = F and J ω̇ + ω × J ω = s × F - σ ω with v = -ω × s.
        """
        J, m = self.inertia, self.mass
        up = R[2]
        s, slope = self.shape(up)
        s_dot = slope @ cross(up, omega)
        v = -cross(omega, s)
        # v̇ + ω × v + g γ without its term -ω̇ × s.
        known = -cross(omega, s_dot) + cross(omega, v) + self.gravity * up
        torque = -cross(omega, J @ omega) - self.damping * omega
        matrix = J - m * hat(s) @ hat(s)
        omega_dot = np.linalg.solve(matrix, torque + m * cross(s, known))
        v_dot = -cross(omega_dot, s) - cross(omega, s_dot)
        force = m * (known - cross(omega_dot, s))
        return v_dot, omega_dot, R @ force

    def centre(self, R, contact):
        """The centre of mass in space, for the contact (x, y)."""
        return np.append(contact, 0.0) - R @ self.shape(R[2])[0]

    def trajectory(self, quaternion, omega, contact, times, **options):
        """(R, ω, contact) at each of the times, and SciPy's solution."""

        def field(_, y):
            R, omega = y[:9].reshape(3, 3), y[9:12]
            _, slope = self.shape(R[2])
            # The body rolls, so the contact moves at the velocity R ṡ.
            path = R @ slope @ cross(R[2], omega)
            _, omega_dot, _ = self.accelerations(R, omega)
            return np.concatenate([(R @ hat(omega)).ravel(), omega_dot, path[:2]])

        start = np.concatenate([matrix_of(quaternion).ravel(), omega, contact])
        sol = solve_ivp(
            field,
            (0.0, times[-1]),
            start,
            t_eval=times,
            **{"method": "DOP853", "rtol": 3e-14, "atol": 1e-14} | options,
        )
        assert sol.success
        y = sol.y.T
        return y[:, :9].reshape(-1, 3, 3), y[:, 9:12], y[:, 12:], sol


def matrix_of(quaternion):
    """The rotation matrix of (w, x, y, z)."""
    return Rotation.from_quat(np.roll(np.asarray(quaternion), -1)).as_matrix()


def ellipsoid(semiaxes, depth):
    """The shape of an ellipsoid whose centre is above the centre of mass by `depth`."""
    A = np.diag(np.square(semiaxes))

    def shape(up):
        scaled = A @ up
        size = np.sqrt(up @ scaled)
        s = -scaled / size + np.array([0.0, 0.0, depth])
        return s, -A / size + np.outer(scaled, scaled) / size**3

    return shape


def sphere(radius, centre):
    """The shape of a sphere with its `centre` as seen from the centre of mass."""

    def shape(up):
        return np.asarray(centre) - radius * up, -radius * np.eye(3)

    return shape


def torus(radius, tube_radius):
    """The shape of a torus about the third axis; `radius` is the radius of its core."""

    def shape(up):
        across = np.array([up[0], up[1], 0.0])
        size = np.hypot(up[0], up[1])
        slope = np.diag([1.0, 1.0, 0.0]) / size - np.outer(across, across) / size**3
        return (
            -radius * across / size - tube_radius * up,
            -radius * slope - tube_radius * np.eye(3),
        )

    return shape


def kane_levinson(parameters, state):
    """ω̇ of the rattleback by the printed equations of Kane and Levinson (1982).

    `parameters` are their (a, b, c, h, M, A, B, C, D, σ, g), and `state` their (α, β,
    ω₁, ω₂, ω₃). Their third axis is downward, and so is their μ. The numbers of their
    equations are in brackets.
    """
    a, b, c, h, M, A, B, C, D, sigma, g = parameters
    alpha, beta, w1, w2, w3 = state
    # (37), (23)
    mu = np.array(
        [-np.cos(alpha) * np.sin(beta), np.sin(alpha), np.cos(alpha) * np.cos(beta)]
    )
    mu_dot = np.array(
        [w3 * mu[1] - w2 * mu[2], w1 * mu[2] - w3 * mu[0], w2 * mu[0] - w1 * mu[1]]
    )
    # (16) to (20)
    squares = np.array([a, b, c]) ** 2
    epsilon = np.sqrt(squares @ mu**2)
    epsilon_dot = squares @ (mu * mu_dot) / epsilon
    x1, x2, x3 = squares * mu / epsilon
    dx1, dx2, dx3 = squares * (epsilon * mu_dot - epsilon_dot * mu) / epsilon**2
    # (26), and the velocities in (32) to (34)
    d1, d2, d3 = (
        w2 * (h - x3) + w3 * x2 - dx1,
        -w3 * x1 - w1 * (h - x3) - dx2,
        -w1 * x2 + w2 * x1 - dx3,
    )
    zeta = np.array([w2 * d3 - w3 * d2, w3 * d1 - w1 * d3, w1 * d2 - w2 * d1])
    # (47) to (49), (53) to (55), (64) to (66)
    weight = (
        M
        * g
        * np.array(
            [
                (x3 - h) * mu[1] - x2 * mu[2],
                (h - x3) * mu[0] + x1 * mu[2],
                x2 * mu[0] - x1 * mu[1],
            ]
        )
    )
    gyroscopic = np.array(
        [
            (D * w1 + (B - C) * w2) * w3,
            ((C - A) * w1 - D * w2) * w3,
            D * (w2**2 - w1**2) + (A - B) * w1 * w2,
        ]
    )
    S = M * np.array(
        [
            (h - x3) * zeta[1] + x2 * zeta[2],
            (x3 - h) * zeta[0] - x1 * zeta[2],
            x1 * zeta[1] - x2 * zeta[0],
        ]
    )
    # (58) to (63)
    inertia = np.array(
        [
            [A + M * (x2**2 + (h - x3) ** 2), D - M * x1 * x2, M * (h - x3) * x1],
            [D - M * x1 * x2, B + M * (x1**2 + (h - x3) ** 2), M * (h - x3) * x2],
            [M * (h - x3) * x1, M * (h - x3) * x2, C + M * (x1**2 + x2**2)],
        ]
    )
    torque = weight + gyroscopic + S - sigma * np.array([w1, w2, w3])
    return np.linalg.solve(inertia, torque)


def kane_levinson_field(parameters):
    """The rates of (α, β, ω₁, ω₂, ω₃) as a function of (t, y)."""

    def field(_, y):
        alpha, beta, w1, w2, w3 = y
        # (40), (41)
        alpha_dot = w3 * np.sin(beta) + w1 * np.cos(beta)
        beta_dot = (-w3 * np.cos(beta) + w1 * np.sin(beta)) * np.tan(alpha) + w2
        return np.array([alpha_dot, beta_dot, *kane_levinson(parameters, y)])

    return field


def random_states(number, seed=0, tilt=0.6, rates=2.0):
    """Some (quaternion, ω, contact), with the third axis within `tilt` of the vertical.

    The heading and the contact are anywhere.
    """
    rng = np.random.default_rng(seed)
    for _ in range(number):
        heading, about, angle = rng.uniform(-np.pi, np.pi, 3) * (1, 1, tilt / np.pi)
        axis = np.array([np.cos(about), np.sin(about), 0.0])
        turned = Rotation.from_rotvec(angle * axis)
        attitude = Rotation.from_rotvec([0.0, 0.0, heading]) * turned
        quaternion = np.roll(attitude.as_quat(), 1)
        yield quaternion, rates * rng.standard_normal(3), rng.standard_normal(2)


def pose_and_twist(body, quaternion, omega, contact):
    """(q, v) on SE(3) as in the library, with v from the constraints."""
    R = matrix_of(quaternion)
    v = -cross(omega, body.shape(R[2])[0])
    q = np.append(quaternion, body.centre(R, contact))
    return q, np.append(v, omega)


def errors_of(body, start, duration, finest):
    """Return a function from nodes on SE(3) to errors; `start` is (quaternion, ω).

    The reference is taken at the nodes of the finest run, with `finest` steps.
    """
    times = duration * np.arange(1, finest + 1) / finest
    R, omega, contact, _ = body.trajectory(*start, (0.0, 0.0), times)
    force = [body.accelerations(*pair)[2] for pair in zip(R, omega, strict=True)]
    x = [body.centre(*pair) for pair in zip(R, contact, strict=True)]
    v = [-cross(w, body.shape(r[2])[0]) for r, w in zip(R, omega, strict=True)]
    references = R, np.array(x), np.array(v), omega, np.array(force)

    def errors_at(t, y, multiplier):
        stride = finest // len(t)
        nodes = slice(stride - 1, None, stride)
        np.testing.assert_allclose(t, times[nodes], rtol=1e-12)
        R, x, v, omega, force = (reference[nodes] for reference in references)
        attitude = Rotation.from_quat(np.roll(y.q[:, :4], -1, axis=1)).as_matrix()
        return {
            "attitude": attitude - R,
            "position": y.q[:, 4:] - x,
            "velocity": y.v[:, :3] - v,
            "angular velocity": y.v[:, 3:] - omega,
            "multiplier": multiplier - force,
        }

    return errors_at


def assert_newton_and_euler(example, body, states, accelerations, atol=1e-11):
    """Check v̇, ω̇ and the force of the plane at `states`, (quaternion, ω, contact)s.

    `accelerations` maps a system and states (q, v) to (v̇, λ, violation).
    """
    expected = [body.accelerations(matrix_of(state[0]), state[1]) for state in states]
    v_dot, omega_dot, force = map(np.array, zip(*expected, strict=True))
    poses = [pose_and_twist(body, *state) for state in states]
    q, v = map(np.array, zip(*poses, strict=True))
    slope, multiplier, violation = accelerations(example.system, q, v)
    np.testing.assert_allclose(violation, 0.0, rtol=0, atol=1e-14)
    for found, wanted in (
        (slope[:, :3], v_dot),
        (slope[:, 3:], omega_dot),
        (multiplier, force),
    ):
        scale = np.max(np.abs(wanted), axis=1, keepdims=True)
        np.testing.assert_allclose(found / scale, wanted / scale, rtol=0, atol=atol)
