"""Groups as matrices and systems on them, written by hand in plain NumPy.

A group is a set of matrices with a basis of its algebra; τ, dτ, ddτ, Ad and ad come
from their definitions on matrices, by exact matrix formulas. The derivatives of the
systems are written by hand. `paper_group_equations` says which conventions hold.
"""

import abc
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import expm


@dataclass(frozen=True)
class MatrixGroup:
    """A matrix group with the basis E_a of its algebra, shape (n, N, N), and a τ.

    The basis must be orthogonal in Σ_ij X_ij Y_ij.
    """

    basis: np.ndarray
    retraction: Literal["cayley", "exponential"]

    def hat(self, xi) -> np.ndarray:
        """Σ ξ_a E_a."""
        return np.einsum("a,aij->ij", xi, self.basis)

    def vee(self, X) -> np.ndarray:
        """The coordinates of matrices X of the algebra, with any leading axes."""
        weights = np.einsum("aij,aij->a", self.basis, self.basis)
        return np.einsum("aij,...ij->...a", self.basis, X) / weights

    def tau(self, xi) -> np.ndarray:
        """exp(X), or cay(X) = (I - X/2)^{-1} (I + X/2)."""
        X = self.hat(xi)
        if self.retraction == "exponential":
            return np.asarray(expm(X))
        unit = np.eye(len(X))
        return np.linalg.solve(unit - X / 2, unit + X / 2)

    def _first(self, X, Y):
        """The derivative of τ at X along each of the matrices Y.

        exp of [[X, Y], [0, X]]; or S Y S with S = (I - X/2)^{-1}, as cay = 2 S - I.
        """
        size = len(X)
        if self.retraction == "exponential":
            block = np.kron(np.eye(2), X) + np.kron(np.eye(2, k=1), Y)
            return np.asarray(expm(block))[..., :size, size:]
        S = np.linalg.inv(np.eye(size) - X / 2)
        return S @ Y @ S

    def _second(self, X, Y, Z):
        """The second derivative of τ at X along Y and each of the matrices Z.

        The coefficient of εδ in τ(X + εY + δZ) if ε² = δ² = 0; ε and δ are matrices.
        """
        size = len(X)
        if self.retraction == "exponential":
            epsilon = np.kron(np.eye(2), np.eye(2, k=1))
            delta = np.kron(np.eye(2, k=1), np.eye(2))
            block = np.kron(np.eye(4), X) + np.kron(epsilon, Y) + np.kron(delta, Z)
            return np.asarray(expm(block))[..., :size, 3 * size :]
        S = np.linalg.inv(np.eye(size) - X / 2)
        return (S @ Z @ S @ Y @ S + S @ Y @ S @ Z @ S) / 2

    def dtau(self, xi) -> np.ndarray:
        """The matrix of η -> dτ_ξ η = τ(ξ)^{-1} d/dε τ(ξ + εη)."""
        first = self._first(self.hat(xi), self.basis)
        return self.vee(np.linalg.solve(self.tau(xi), first)).T

    def dtau_inv(self, xi) -> np.ndarray:
        """The matrix of dτ_ξ^{-1}."""
        return np.linalg.inv(self.dtau(xi))

    def ddtau(self, xi, eta) -> np.ndarray:
        """The matrix of δ -> ddτ_ξ(η, δ), where ∂_ξ(dτ_ξ η) δ = dτ_ξ ddτ_ξ(η, δ)."""
        X, Y, tau = self.hat(xi), self.hat(eta), self.tau(xi)
        along_eta = np.linalg.solve(tau, self._first(X, Y))
        along_basis = np.linalg.solve(tau, self._first(X, self.basis))
        mixed = np.linalg.solve(tau, self._second(X, Y, self.basis))
        slope = self.vee(mixed - along_basis @ along_eta).T
        return np.linalg.solve(self.dtau(xi), slope)

    def Ad(self, g) -> np.ndarray:
        """The matrix of ξ -> g ξ g^{-1}."""
        return self.vee(g @ self.basis @ np.linalg.inv(g)).T

    def ad(self, xi) -> np.ndarray:
        """The matrix of η -> [ξ, η]."""
        X = self.hat(xi)
        return self.vee(X @ self.basis - self.basis @ X).T


def _entries(size, *elements):
    """Basis matrices from lists of (row, column, value)."""
    basis = np.zeros((len(elements), size, size))
    for matrix, element in zip(basis, elements, strict=True):
        for i, j, value in element:
            matrix[i, j] = value
    return basis


_TURNS = ([(2, 1, 1), (1, 2, -1)], [(0, 2, 1), (2, 0, -1)], [(1, 0, 1), (0, 1, -1)])
SO3 = _entries(3, *_TURNS)
SE2 = _entries(3, [(0, 2, 1)], [(1, 2, 1)], _TURNS[2])  # (v1, v2, ω)
SE3 = _entries(4, *([(i, 3, 1)] for i in range(3)), *_TURNS)  # (v, ω)
# SO(3) x R², (ω, v), as diag(R, [[1, x], [0, 1]]).
SO3_R2 = _entries(6, *_TURNS, [(3, 5, 1)], [(4, 5, 1)])


def translations(n: int) -> np.ndarray:
    """The basis of R^n as matrices [[1, q], [0, 1]]."""
    return _entries(n + 1, *([(i, n, 1)] for i in range(n)))


@dataclass(frozen=True)
class Mechanics(abc.ABC):
    """ℓ = ½ η·M(g) η + A(g)·η - U(g), φ(g, η) and Φ(g) through their derivatives.

    The Hamiltonian side is its Legendre transform: h(g, μ) = <μ, η> - ℓ(g, η) and
    ψ(g, μ) = φ(g, η) where μ = D2ℓ(g, η).
    """

    group: MatrixGroup | None  # None on a vector space

    def position(self, g) -> np.ndarray:
        """The vector q of an element of R^n, in either form."""
        return g if self.group is None else g[:-1, -1]

    @abc.abstractmethod
    def inertia(self, g) -> np.ndarray:
        """M = D2D2ℓ, shape (n, n)."""

    @abc.abstractmethod
    def d1l(self, g, eta) -> np.ndarray:
        """L_g^* D1ℓ, shape (n,)."""

    def shift(self, g) -> np.ndarray:
        """A = D2ℓ(g, 0), shape (n,)."""
        return np.zeros(len(self.inertia(g)))

    def phi(self, g, eta) -> np.ndarray:
        """φ, shape (m,); linear in η unless overridden."""
        return self.d2phi(g, eta) @ eta

    def d2phi(self, g, eta) -> np.ndarray:
        """D2φ, shape (m, n)."""
        return np.zeros((0, len(eta)))

    def holonomic(self, g) -> np.ndarray:
        """Φ, shape (k,)."""
        return np.zeros(0)

    def d_holonomic(self, g) -> np.ndarray:
        """L_g^* DΦ, shape (k, n)."""
        return np.zeros((0, len(self.inertia(g))))

    def d2l(self, g, eta) -> np.ndarray:
        """D2ℓ = M η + A."""
        return self.inertia(g) @ eta + self.shift(g)

    def d1h(self, g, mu) -> np.ndarray:
        """L_g^* D1h = -L_g^* D1ℓ at the same point."""
        return -self.d1l(g, self.d2h(g, mu))

    def d2h(self, g, mu) -> np.ndarray:
        """D2h = η = M^{-1} (μ - A)."""
        return np.linalg.solve(self.inertia(g), mu - self.shift(g))

    def d2d2h(self, g, mu) -> np.ndarray:
        """D2D2h = M^{-1}."""
        return np.linalg.inv(self.inertia(g))

    def psi(self, g, mu) -> np.ndarray:
        """ψ, shape (m,)."""
        return self.phi(g, self.d2h(g, mu))

    def d2psi(self, g, mu) -> np.ndarray:
        """D2ψ = D2φ D2D2h, shape (m, n)."""
        return self.d2phi(g, self.d2h(g, mu)) @ self.d2d2h(g, mu)

    def flat(self, g, mu, covectors) -> np.ndarray:
        """♭_h of each row, (D2D2h)^{-1} times it: vectors become covectors."""
        return np.linalg.solve(self.d2d2h(g, mu), covectors.T).T

    def acceleration(self, g, eta) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(η', λ, λ_hol) of the continuous equations with differentiated constraints.

        (D2ℓ)' = ad*_η D2ℓ + D1ℓ + λ D2φ + λ_hol DΦ, φ' = 0, (DΦ η)' = 0. The rates
        along g' = g η at fixed η come from complex steps, exact to round-off.
        """
        M, B, C = self.inertia(g), self.d2phi(g, eta), self.d_holonomic(g)
        force, direction = self.d1l(g, eta), eta
        if self.group is not None:
            force = force + self.group.ad(eta).T @ self.d2l(g, eta)
            direction = g @ self.group.hat(eta)
        step = 1e-30
        moved = g + 1j * step * direction
        force = force - np.imag(self.d2l(moved, eta)) / step
        rows = np.concatenate([B, C])
        held = np.append(self.phi(moved, eta), self.d_holonomic(moved) @ eta)
        zero = np.zeros((len(rows), len(rows)))
        matrix = np.block([[M, -rows.T], [rows, zero]])
        solution = np.linalg.solve(matrix, np.append(force, -np.imag(held) / step))
        n, m = len(M), len(B)
        return solution[:n], solution[n : n + m], solution[n + m :]


def _axial(A):
    """The ω-gradient of Σ_ij A_ij (ω^)_ij."""
    return np.array([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])


@dataclass(frozen=True)
class Constant(Mechanics):
    """½ η·M η - U(g) with a constant M, and φ = rows η with constant rows."""

    M: np.ndarray
    rows: np.ndarray

    def inertia(self, g):
        return self.M

    def d2phi(self, g, eta):
        return self.rows


@dataclass(frozen=True)
class Unicycle(Constant):
    """On SE(2) with a spring, U = ½ k |x|²: M = diag(m, m, J), φ = v2, rows (0 1 0)."""

    k: float

    def d1l(self, g, eta):
        return np.append(-self.k * g[:2, :2].T @ g[:2, 2], 0.0)


@dataclass(frozen=True)
class RigidBody(Constant):
    """On SO(3), U = Σ_ij C_ij R_ij.

    With one row it is Suslov's problem; without rows and with C = m g e3 Xᵀ, a heavy
    top.
    """

    C: np.ndarray

    def d1l(self, g, eta):
        return -_axial(g.T @ self.C)


@dataclass(frozen=True)
class HeavyTop(Constant):
    """On SE(3), U = m g x_3, with Φ = x - R X."""

    weight: float
    X: np.ndarray

    def d1l(self, g, eta):
        return np.append(-self.weight * g[2, :3], np.zeros(3))

    def holonomic(self, g):
        return g[:3, 3] - g[:3, :3] @ self.X

    def d_holonomic(self, g):
        """R [1, X^], from x' - R' X = R (v + X × ω)."""
        cross = np.einsum("a,aij->ij", self.X, SO3)
        return g[:3, :3] @ np.concatenate([np.eye(3), cross], axis=1)


@dataclass(frozen=True)
class Ball(Mechanics):
    """Ball on a turntable, SO(3) x R²: ½ ω·I ω + ½ |v|², with w = R ω in space

    φ = (v_x + Ω y - r w_2, v_y - Ω x + r w_1).
    """

    moments: np.ndarray  # the paper's r² diag(a, b, c)
    r: float
    Omega: float

    def inertia(self, g):
        M = np.eye(5)
        M[:3, :3] = self.moments
        return M

    def d1l(self, g, eta):
        return np.zeros(5)

    def phi(self, g, eta):
        return self.d2phi(g, eta) @ eta + self.Omega * np.array([g[4, 5], -g[3, 5]])

    def d2phi(self, g, eta):
        rows = self.r * np.stack([-g[1, :3], g[0, :3]])
        return np.concatenate([rows, np.eye(2)], axis=1)


@dataclass(frozen=True)
class Anisotropic(Mechanics):
    """½ ω·(I + Rᵀ S R) ω - Σ_ij C_ij R_ij on SO(3), where D1ℓ depends on ω.

    φ = ½ ω·B ω + b·R ω + Σ_ij F_ij R_ij - level: nonlinear, not homogeneous.
    """

    moments: np.ndarray
    S: np.ndarray
    C: np.ndarray
    B: np.ndarray
    b: np.ndarray
    F: np.ndarray
    level: float

    def inertia(self, g):
        return self.moments + g.T @ self.S @ g

    def d1l(self, g, eta):
        return np.cross(eta, g.T @ self.S @ g @ eta) - _axial(g.T @ self.C)

    def phi(self, g, eta):
        value = eta @ self.B @ eta / 2 + self.b @ g @ eta + np.sum(self.F * g)
        return np.array([value - self.level])

    def d2phi(self, g, eta):
        return (self.B @ eta + g.T @ self.b)[None]


@dataclass(frozen=True)
class VaryingMass(Mechanics):
    """On R³: ½ v·M(q) v + β x v_y - ½ |q|² - ¼ x⁴, φ = ż - y ẋ + κ sin x ẏ,

    M = [[1 + y², .3 x, 0], [.3 x, 2 + sin z, .2], [0, .2, 1 + ½ cos x]].
    """

    beta: float
    kappa: float

    def inertia(self, g):
        x, y, z = self.position(g)
        rows = [1 + y**2, 0.3 * x, 0], [0.3 * x, 2 + np.sin(z), 0.2]
        return np.array([*rows, [0, 0.2, 1 + 0.5 * np.cos(x)]])

    def _inertia_slopes(self, g):
        x, y, z = self.position(g)
        slopes = np.zeros((3, 3, 3), x.dtype)
        slopes[0, 0, 1] = slopes[0, 1, 0] = 0.3
        slopes[0, 2, 2] = -0.5 * np.sin(x)
        slopes[1, 0, 0] = 2 * y
        slopes[2, 1, 1] = np.cos(z)
        return slopes

    def shift(self, g):
        return np.array([0.0, self.beta * self.position(g)[0], 0.0])

    def d1l(self, g, eta):
        kinetic = np.einsum("iab,a,b->i", self._inertia_slopes(g), eta, eta) / 2
        q = self.position(g)
        return kinetic - q + np.array([self.beta * eta[1] - q[0] ** 3, 0.0, 0.0])

    def d2phi(self, g, eta):
        x, y, _ = self.position(g)
        return np.array([[-y, self.kappa * np.sin(x), 1.0]])


@dataclass(frozen=True)
class Sphere(Mechanics):
    """On R^n: ½ m |v|² - ½ q·K q - w·q with Φ = ½ (|q|² - 1), φ_a = (B_a q)·v.

    The spherical pendulum for n = 3, K = 0, w = m g e3 and no φ.
    """

    mass: float
    K: np.ndarray
    w: np.ndarray
    B: np.ndarray  # (m, n, n)

    def inertia(self, g):
        return self.mass * np.eye(len(self.w))

    def d1l(self, g, eta):
        return -self.K @ self.position(g) - self.w

    def d2phi(self, g, eta):
        return self.B @ self.position(g)

    def holonomic(self, g):
        return np.array([(self.position(g) @ self.position(g) - 1) / 2])

    def d_holonomic(self, g):
        return self.position(g)[None]
