"""Systems through the derivatives of L and Φ, written by hand in plain NumPy."""

import abc
from dataclasses import dataclass

import numpy as np


def _vector(*entries):
    return np.stack(np.broadcast_arrays(*entries), axis=-1)


def _matrix(*rows):
    return np.stack([_vector(*row) for row in rows], axis=-2)


def _apply(matrix, vector):
    return np.einsum("...ij,...j->...i", matrix, vector)


def largest(vector):
    return np.max(np.abs(vector), axis=-1)


def _transpose(matrix):
    return np.swapaxes(matrix, -1, -2)


class Mechanics(abc.ABC):
    """L and Φ through their derivatives, at points with any leading axes.

    L is quadratic in v, so that D2L(t, q, v) = M(t, q) v + D2L(t, q, 0).
    """

    @abc.abstractmethod
    def d1l(self, t, q, v) -> np.ndarray:
        """D1L + F, shape (..., n)."""

    @abc.abstractmethod
    def d2l(self, t, q, v) -> np.ndarray:
        """D2L, shape (..., n)."""

    @abc.abstractmethod
    def mass(self, t, q) -> np.ndarray:
        """D2D2L, shape (..., n, n)."""

    @abc.abstractmethod
    def phi(self, t, q, v) -> np.ndarray:
        """Φ, shape (..., m)."""

    @abc.abstractmethod
    def d2phi(self, t, q, v) -> np.ndarray:
        """D2Φ, shape (..., m, n)."""

    @abc.abstractmethod
    def phi_rate(self, t, q, v) -> np.ndarray:
        """∂Φ/∂t + D1Φ v, shape (..., m)."""

    def d2l_rate(self, t, q, v) -> np.ndarray:
        """∂D2L/∂t + D1D2L v, shape (..., n); zero for a constant mass."""
        return np.zeros_like(v)

    def d1l_size(self, t, q, v) -> np.ndarray:
        """The size of the terms of D1L + F, where they can cancel."""
        return np.abs(self.d1l(t, q, v))

    def velocity(self, t, q, p) -> np.ndarray:
        """The solution v of D2L(t, q, v) = p."""
        offset = self.d2l(t, q, np.zeros_like(p))
        return np.linalg.solve(self.mass(t, q), (p - offset)[..., None])[..., 0]

    def continuous_multiplier(self, t, q, p):
        """λ_c(q, p), and the size of the terms that it is a sum of.

        From M a = D1L + F - (D2L)' + D2Φᵀ λ and dΦ/dt = 0.
        """
        return self._multiplier(t, q, self.velocity(t, q, p))

    def acceleration(self, t, q, v) -> np.ndarray:
        """The continuous equations of motion solved for a: the index-reduced ODE."""
        multiplier, _ = self._multiplier(t, q, v)
        reaction = _apply(_transpose(self.d2phi(t, q, v)), multiplier)
        force = self.d1l(t, q, v) - self.d2l_rate(t, q, v) + reaction
        return np.linalg.solve(self.mass(t, q), force[..., None])[..., 0]

    def _multiplier(self, t, q, v):
        B = self.d2phi(t, q, v)
        B_over_M = _transpose(np.linalg.solve(self.mass(t, q), _transpose(B)))
        C = B_over_M @ _transpose(B)
        force, rate = self.d1l(t, q, v), self.d2l_rate(t, q, v)
        hidden = self.phi_rate(t, q, v)
        right = -hidden - _apply(B_over_M, force - rate)
        size = np.abs(hidden) + _apply(np.abs(B_over_M), np.abs(force) + np.abs(rate))
        multiplier = np.linalg.solve(C, right[..., None])[..., 0]
        return multiplier, _apply(np.abs(np.linalg.inv(C)), size)


@dataclass(frozen=True)
class Particle(Mechanics):
    """L = m/2 |v|² - k/2 (x² + y²), Φ = ż - y ẋ."""

    m: float
    k: float

    def d1l(self, t, q, v):
        """(-k x, -k y, 0)."""
        return _vector(-self.k * q[..., 0], -self.k * q[..., 1], 0 * q[..., 2])

    def d2l(self, t, q, v):
        """m v."""
        return self.m * v

    def mass(self, t, q):
        """m I."""
        return np.broadcast_to(self.m * np.eye(3), (*q.shape, 3))

    def phi(self, t, q, v):
        """ż - y ẋ."""
        return _vector(v[..., 2] - q[..., 1] * v[..., 0])

    def d2phi(self, t, q, v):
        """(-y, 0, 1)."""
        y = q[..., 1]
        return _matrix((-y, 0.0, 1.0))

    def phi_rate(self, t, q, v):
        """-ẏ ẋ."""
        return _vector(-v[..., 1] * v[..., 0])


class Chaotic(Mechanics):
    """The paper's chaotic system with m = 3, indices from 1.

    L = ½ |v|² - ½ (|q|² + q5² q6² + q2² q5² + q3² q6² + q4² q7²),
    Φ = v1 + q5 v5 + q6 v6 + q7 v7.
    """

    def d1l(self, t, q, v):
        """-q_i (1 + the squares that multiply q_i²)."""
        q1, q2, q3, q4, q5, q6, q7 = np.moveaxis(q, -1, 0)
        return -_vector(
            q1,
            q2 + q2 * q5**2,
            q3 + q3 * q6**2,
            q4 + q4 * q7**2,
            q5 + q5 * q6**2 + q5 * q2**2,
            q6 + q6 * q5**2 + q6 * q3**2,
            q7 + q7 * q4**2,
        )

    def d2l(self, t, q, v):
        """The velocity itself."""
        return v

    def mass(self, t, q):
        """The unit matrix."""
        return np.broadcast_to(np.eye(7), (*q.shape, 7))

    def phi(self, t, q, v):
        """v1 + q5 v5 + q6 v6 + q7 v7."""
        return (v[..., 0] + np.sum(q[..., 4:] * v[..., 4:], axis=-1))[..., None]

    def d2phi(self, t, q, v):
        """(1, 0, 0, 0, q5, q6, q7)."""
        return _matrix((1.0, 0.0, 0.0, 0.0, q[..., 4], q[..., 5], q[..., 6]))

    def phi_rate(self, t, q, v):
        """v5² + v6² + v7²."""
        return np.sum(v[..., 4:] ** 2, axis=-1)[..., None]


@dataclass(frozen=True)
class Sleigh(Mechanics):
    """The Chaplygin sleigh in the coordinates (x, y, θ) of its blade.

    L = m/2 (ẋ² + ẏ²) + m a θ̇ (ẏ cos θ - ẋ sin θ) + (J + m a²)/2 θ̇²,
    Φ = ẏ cos θ - ẋ sin θ.
    """

    m: float
    J: float
    a: float

    def d1l(self, t, q, v):
        """(0, 0, -m a θ̇ (ẋ cos θ + ẏ sin θ))."""
        x, y, rate = np.moveaxis(v, -1, 0)
        c, s = np.cos(q[..., 2]), np.sin(q[..., 2])
        return _vector(0 * x, 0 * y, -self.m * self.a * rate * (x * c + y * s))

    def d1l_size(self, t, q, v):
        """m a |θ̇| |v|: ẋ cos θ + ẏ sin θ is lost to round-off where it vanishes."""
        x, _, rate = np.moveaxis(v, -1, 0)
        return _vector(0 * x, 0 * x, np.abs(self.m * self.a * rate) * largest(v))

    def d2l(self, t, q, v):
        """M v."""
        x, y, rate = np.moveaxis(v, -1, 0)
        c, s = np.cos(q[..., 2]), np.sin(q[..., 2])
        ma, inertia = self.m * self.a, self.J + self.m * self.a**2
        return _vector(
            self.m * x - ma * s * rate,
            self.m * y + ma * c * rate,
            ma * (c * y - s * x) + inertia * rate,
        )

    def mass(self, t, q):
        """The mass matrix, which depends on θ."""
        c, s = np.cos(q[..., 2]), np.sin(q[..., 2])
        ma, inertia = self.m * self.a, self.J + self.m * self.a**2
        return _matrix(
            (self.m, 0.0, -ma * s), (0.0, self.m, ma * c), (-ma * s, ma * c, inertia)
        )

    def d2l_rate(self, t, q, v):
        """θ̇ (dM/dθ) v."""
        x, y, rate = np.moveaxis(v, -1, 0)
        c, s = np.cos(q[..., 2]), np.sin(q[..., 2])
        ma = self.m * self.a
        return _vector(
            -ma * c * rate**2, -ma * s * rate**2, -ma * rate * (s * y + c * x)
        )

    def phi(self, t, q, v):
        """ẏ cos θ - ẋ sin θ."""
        return _vector(np.cos(q[..., 2]) * v[..., 1] - np.sin(q[..., 2]) * v[..., 0])

    def d2phi(self, t, q, v):
        """(-sin θ, cos θ, 0)."""
        return _matrix((-np.sin(q[..., 2]), np.cos(q[..., 2]), 0.0))

    def phi_rate(self, t, q, v):
        """-θ̇ (ẋ cos θ + ẏ sin θ)."""
        along = np.cos(q[..., 2]) * v[..., 0] + np.sin(q[..., 2]) * v[..., 1]
        return _vector(-v[..., 2] * along)


@dataclass(frozen=True)
class Disc(Mechanics):
    """The vertical rolling disc in (x, y, ψ, φ): two constraints.

    L = m/2 (ẋ² + ẏ²) + I/2 ψ̇² + J/2 φ̇²,  Φ = (ẋ - R ψ̇ cos φ, ẏ - R ψ̇ sin φ).
    """

    m: float
    I: float
    J: float
    R: float

    def d1l(self, t, q, v):
        """No force."""
        return np.zeros_like(q)

    def d2l(self, t, q, v):
        """M v."""
        return v * np.array([self.m, self.m, self.I, self.J])

    def mass(self, t, q):
        """diag(m, m, I, J)."""
        return np.broadcast_to(np.diag([self.m, self.m, self.I, self.J]), (*q.shape, 4))

    def phi(self, t, q, v):
        """(ẋ - R ψ̇ cos φ, ẏ - R ψ̇ sin φ)."""
        x, y, roll, _ = np.moveaxis(v, -1, 0)
        heading = q[..., 3]
        return _vector(
            x - self.R * roll * np.cos(heading), y - self.R * roll * np.sin(heading)
        )

    def d2phi(self, t, q, v):
        """Two rows."""
        c, s = np.cos(q[..., 3]), np.sin(q[..., 3])
        return _matrix((1.0, 0.0, -self.R * c, 0.0), (0.0, 1.0, -self.R * s, 0.0))

    def phi_rate(self, t, q, v):
        """R ψ̇ φ̇ (sin φ, -cos φ)."""
        turn = self.R * v[..., 2] * v[..., 3]
        return _vector(turn * np.sin(q[..., 3]), -turn * np.cos(q[..., 3]))


@dataclass(frozen=True)
class AppellSystem(Mechanics):
    """L = m/2 |v|² - m g z,  Φ = ½ (ẋ² + ẏ² - κ² ż²)."""

    m: float
    g: float
    kappa: float

    def d1l(self, t, q, v):
        """(0, 0, -m g)."""
        return _vector(0 * q[..., 0], 0 * q[..., 0], -self.m * self.g)

    def d2l(self, t, q, v):
        """m v."""
        return self.m * v

    def mass(self, t, q):
        """m I."""
        return np.broadcast_to(self.m * np.eye(3), (*q.shape, 3))

    def phi(self, t, q, v):
        """½ (ẋ² + ẏ² - κ² ż²)."""
        squares = v**2
        speed = squares[..., 0] + squares[..., 1] - self.kappa**2 * squares[..., 2]
        return _vector(0.5 * speed)

    def d2phi(self, t, q, v):
        """(ẋ, ẏ, -κ² ż)."""
        return _matrix((v[..., 0], v[..., 1], -(self.kappa**2) * v[..., 2]))

    def phi_rate(self, t, q, v):
        """Φ depends on neither t nor q."""
        return np.zeros_like(v[..., :1])


@dataclass(frozen=True)
class Driven(Mechanics):
    """All at once: a mass that varies, a magnetic field, friction, a moving constraint.

    L = ½ μ(t) (ẋ² + ẏ²) + ½ ż² + β x ẏ - ½ |q|²,  μ = 1 + ½ sin t,  F = -γ v,
    Φ = ż - y ẋ - (1 + x) cos t.
    """

    beta: float
    friction: float

    def d1l(self, t, q, v):
        """D1L + F."""
        field = _vector(self.beta * v[..., 1], 0 * v[..., 1], 0 * v[..., 1])
        return field - q - self.friction * v

    def d2l(self, t, q, v):
        """(μ ẋ, μ ẏ + β x, ż)."""
        mu = 1 + 0.5 * np.sin(t)
        y = mu * v[..., 1] + self.beta * q[..., 0]
        return _vector(mu * v[..., 0], y, v[..., 2])

    def mass(self, t, q):
        """diag(μ, μ, 1)."""
        mu = 1 + 0.5 * np.sin(t)
        return _matrix((mu, 0.0, 0.0), (0.0, mu, 0.0), (0.0, 0.0, 1.0 + 0 * mu))

    def d2l_rate(self, t, q, v):
        """(μ' ẋ, μ' ẏ + β ẋ, 0)."""
        rate = 0.5 * np.cos(t)
        x, y, _ = np.moveaxis(v, -1, 0)
        return _vector(rate * x, rate * y + self.beta * x, 0 * x)

    def phi(self, t, q, v):
        """ż - y ẋ - (1 + x) cos t."""
        x, y, _ = np.moveaxis(q, -1, 0)
        return _vector(v[..., 2] - y * v[..., 0] - (1 + x) * np.cos(t))

    def d2phi(self, t, q, v):
        """(-y, 0, 1)."""
        return _matrix((-q[..., 1], 0.0, 1.0))

    def phi_rate(self, t, q, v):
        """(1 + x) sin t - ẏ ẋ - ẋ cos t."""
        x, y, _ = np.moveaxis(v, -1, 0)
        return _vector((1 + q[..., 0]) * np.sin(t) - y * x - x * np.cos(t))


class SideBySide(Mechanics):
    """Several uncoupled systems, as one."""

    def __init__(self, parts: list[tuple[Mechanics, int]]):
        self.parts = [part for part, _ in parts]
        self.ends = np.cumsum([size for _, size in parts])[:-1]

    def _each(self, name, t, *points):
        pieces = zip(
            self.parts,
            *(np.split(x, self.ends, axis=-1) for x in points),
            strict=True,
        )
        return [getattr(part, name)(t, *piece) for part, *piece in pieces]

    def _vectors(self, name, t, *points):
        return np.concatenate(self._each(name, t, *points), axis=-1)

    def _blocks(self, name, t, *points):
        blocks = self._each(name, t, *points)
        rows = sum(block.shape[-2] for block in blocks)
        cols = sum(block.shape[-1] for block in blocks)
        whole = np.zeros((*blocks[0].shape[:-2], rows, cols))
        i = j = 0
        for block in blocks:
            whole[..., i : i + block.shape[-2], j : j + block.shape[-1]] = block
            i, j = i + block.shape[-2], j + block.shape[-1]
        return whole

    def d1l(self, t, q, v):
        """D1L + F of each."""
        return self._vectors("d1l", t, q, v)

    def d2l(self, t, q, v):
        """D2L of each."""
        return self._vectors("d2l", t, q, v)

    def mass(self, t, q):
        """A block-diagonal mass matrix."""
        return self._blocks("mass", t, q)

    def d2l_rate(self, t, q, v):
        """The rate of D2L of each."""
        return self._vectors("d2l_rate", t, q, v)

    def phi(self, t, q, v):
        """All constraints."""
        return self._vectors("phi", t, q, v)

    def d2phi(self, t, q, v):
        """A block-diagonal D2Φ."""
        return self._blocks("d2phi", t, q, v)

    def phi_rate(self, t, q, v):
        """The rates of all constraints."""
        return self._vectors("phi_rate", t, q, v)
