"""The paper's equations on Lie groups, and with holonomic constraints, in plain NumPy.

An oracle that shares no code with the library. A group is a set of matrices with a
basis of its algebra; τ, dτ, ddτ, Ad and ad come from their definitions on matrices, by
exact matrix formulas. The derivatives of the systems are written by hand. Every
equation of the paper's summaries is evaluated as a residual, as printed but for one
erratum (see `hamiltonian_group_residuals`).

Conventions: D1 is left-trivialised, <D1ℓ, δ> = d/dε ℓ(g τ(εδ), η). A covector is the
array of its values on the basis, so that the dual of a map is the transpose of its
matrix. On a vector space g is q itself, a vector, with η = v and μ = p.
"""

import abc
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from scipy.linalg import expm


@dataclass(frozen=True)
class Tableau:
    """Lobatto IIIA (a, b, c) and its symplectic conjugate a_hat, Lobatto IIIB."""

    a: np.ndarray
    a_hat: np.ndarray
    b: np.ndarray
    c: np.ndarray


def lobatto(stages: int) -> Tableau:
    """Lobatto IIIA for 2, 3 and 4 stages, and b_i â_ij + b_j a_ji = b_i b_j."""
    r = np.sqrt(5.0)
    c, a = {
        2: ([0, 1], [[0, 0], [1 / 2, 1 / 2]]),
        3: (
            [0, 1 / 2, 1],
            [[0, 0, 0], [5 / 24, 1 / 3, -1 / 24], [1 / 6, 2 / 3, 1 / 6]],
        ),
        4: (
            [0, (5 - r) / 10, (5 + r) / 10, 1],
            [
                [0, 0, 0, 0],
                [(11 + r) / 120, (25 - r) / 120, (25 - 13 * r) / 120, (r - 1) / 120],
                [(11 - r) / 120, (25 + 13 * r) / 120, (25 + r) / 120, (-1 - r) / 120],
                [1 / 12, 5 / 12, 5 / 12, 1 / 12],
            ],
        ),
    }[stages]
    a, c = np.array(a, dtype=float), np.array(c, dtype=float)
    b = a[-1]
    return Tableau(a, b[None, :] * (1 - a.T / b[:, None]), b, c)


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
        """The coordinates of matrices X of the algebra, any leading axes."""
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

        With ε² = δ² = 0 the coefficient of εδ in τ(X + εY + δZ); ε and δ as matrices.
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
        """φ, shape (m,); unless overridden linear in η."""
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
        """♭_h of the rows, (D2D2h)^{-1} times each: vectors become covectors."""
        return np.linalg.solve(self.d2d2h(g, mu), covectors.T).T

    def acceleration(self, g, eta) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(η', λ, λ_hol) of the continuous equations, constraints differentiated.

        (D2ℓ)' = ad*_η D2ℓ + D1ℓ + λ D2φ + λ_hol DΦ, φ' = 0, (DΦ η)' = 0. The rates
        along g' = g η at fixed η are complex steps, exact to round-off.
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

    Suslov's problem with one row; a heavy top with none and C = m g e3 Xᵀ.
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


@dataclass(frozen=True)
class Stages:
    """One step from (g_k, μ_k). On a vector space H = V, g = q and μ = p."""

    H: np.ndarray  # (s, n)
    Lambda: np.ndarray  # (s, m), Λ^1 = λ_k
    Lambda_hol: np.ndarray  # (s, k)
    g_next: np.ndarray
    mu_next: np.ndarray  # (n,)

    def perturbed(self, name: str, size: float) -> Self:
        """A copy in which the last entry of an array is off by `size`, relatively."""
        array = getattr(self, name).copy()
        array[(-1,) * array.ndim] += size * (1 + abs(array[(-1,) * array.ndim]))
        return replace(self, **{name: array})


@dataclass(frozen=True)
class LagrangianStages(Stages):
    """With the node velocities η^i, on a vector space v^i."""

    eta_nodes: np.ndarray  # (s, n)


@dataclass(frozen=True)
class HamiltonianStages(Stages):
    """With the stage momenta Π^i, on a vector space P^i; see `chart_momenta`."""

    Pi: np.ndarray  # (s, n)


class Residuals(dict[str, np.ndarray]):
    """Residuals by equation, and the size of the terms that they are sums of."""

    def __init__(self):
        super().__init__()
        self.sizes: dict[str, float] = {}

    def add(self, name: str, *terms, size: float | None = None):
        """The equation Σ terms = 0, each term of shape (s, ...), (n,) or (N, N)."""
        self[name] = np.asarray(sum(terms))
        if size is None:
            size = float(np.max(sum(np.abs(term) for term in terms), initial=0.0))
        self.sizes[name] = size

    def relative(self) -> dict[str, float]:
        """The largest entry of each residual over the largest size of its terms."""
        largest = {key: np.max(np.abs(x), initial=0.0) for key, x in self.items()}
        return {key: float(x / (self.sizes[key] or 1)) for key, x in largest.items()}

    def vector(self) -> np.ndarray:
        """All residuals in one array."""
        return np.concatenate([x.ravel() for x in self.values()])


def _rows(function, *arguments):
    """The function at every stage, stacked."""
    return np.stack([function(*row) for row in zip(*arguments, strict=True)])


def _dual(matrices, covectors):
    """The transposes of the matrices times the covectors, stage by stage."""
    return np.einsum("...ij,...i->...j", matrices, covectors)


class _Geometry:
    """The maps at Ξ^i = h Σ a_ij H^j, stacked, and at ξ_{k,k+1} = h Σ b_j H^j."""

    def __init__(self, group: MatrixGroup, tableau: Tableau, h, g, H):
        Xi, xi = h * (tableau.a @ H), h * (tableau.b @ H)
        self.G = _rows(lambda x: g @ group.tau(x), Xi)
        self.dtau = _rows(group.dtau, Xi)
        self.dtau_inv = _rows(group.dtau_inv, Xi)
        self.dtau_inv_minus = _rows(group.dtau_inv, -Xi)
        self.ddtau = _rows(group.ddtau, Xi, H)  # ddτ_Ξ(H, ·)
        self.Ad = _rows(lambda x: group.Ad(group.tau(x)), Xi)
        self.g_next = g @ group.tau(xi)
        self.end_dtau_inv = group.dtau_inv(xi)
        self.end_dtau_inv_minus = group.dtau_inv(-xi)
        self.end_Ad = group.Ad(group.tau(xi))


def _momenta(found, tableau, h, at: _Geometry, mu, N, Pi, mu_next):
    """The equations for M_k^i and μ_{k+1}; N with the Lagrangian sign. Returns μ^i.

    Both Lie-group summaries: the third, fifth and fourth lines, with the definition of
    M_k^i in the second half substituted into the third.
    """
    a, b = tableau.a, tableau.b
    ratio = a.T / b[:, None]  # a_ji / b_i
    curvature = h * np.einsum("ij,j,jn->in", ratio, b, _dual(at.ddtau, Pi))
    body = _dual(at.dtau_inv_minus, N)
    start = np.broadcast_to(mu, Pi.shape)
    found.add(
        "M^i = (dτ^-1_ξ)*[Π^i + h Σ b_j a_ji / b_i ddτ*_Ξj(H^j, Π^j)]"
        " = Ad*_τ(ξ)[μ_k + h Σ b_j (dτ^-1_-Ξj - a_ji / b_i dτ^-1_-ξ)* N^j]",
        Pi @ at.end_dtau_inv,
        curvature @ at.end_dtau_inv,
        -start @ at.end_Ad,
        -np.broadcast_to(h * (b @ body), Pi.shape) @ at.end_Ad,
        h * (ratio @ (b[:, None] * (N @ at.end_dtau_inv_minus))) @ at.end_Ad,
    )
    found.add(
        "μ_{k+1} = Ad*_τ(ξ)[μ_k + h Σ b_j (dτ^-1_-Ξj)* N^j]",
        mu_next,
        -mu @ at.end_Ad,
        -h * (b @ body) @ at.end_Ad,
    )
    return _dual(at.Ad, mu + h * (a @ body))


def _constraints(found, mechanics: Mechanics, name, G, velocities, values):
    """φ or ψ at the nodes, relative to |D2φ| |η| and the part that η does not enter."""
    slopes = _rows(mechanics.d2phi, G, velocities)
    rest = _rows(mechanics.phi, G, np.zeros_like(velocities))
    speed = np.max(np.abs(velocities))
    size = np.sum(np.abs(slopes), axis=-1) * speed + np.abs(rest)
    found.add(name, values, size=float(np.max(size, initial=0.0)))


def _holonomic(found, mechanics: Mechanics, G, g_next, mu_next):
    """Φ(G^i) = 0 and the tangency condition at the end."""
    slopes = np.abs(_rows(mechanics.d_holonomic, G))
    reach = np.max(np.sum(slopes, axis=-1), initial=0.0) * np.max(np.abs(G))
    found.add("Φ(G^i) = 0", _rows(mechanics.holonomic, G), size=float(reach))
    rows, velocity = mechanics.d_holonomic(g_next), mechanics.d2h(g_next, mu_next)
    size = np.max(np.abs(rows) @ np.abs(velocity), initial=0.0)
    found.add("<DΦ, D2h>(g_{k+1}, μ_{k+1}) = 0", rows @ velocity, size=float(size))


def _lagrangian_force(mechanics: Mechanics, G, eta, stages: Stages):
    """D1ℓ + Λ D2φ + Λ_hol DΦ at the stages, left-trivialised."""
    reaction = _dual(_rows(mechanics.d2phi, G, eta), stages.Lambda)
    holonomic = _dual(_rows(mechanics.d_holonomic, G), stages.Lambda_hol)
    return _rows(mechanics.d1l, G, eta) + reaction + holonomic


def _hamiltonian_force(mechanics: Mechanics, G, mu, stages: Stages):
    """D1h - Λ ♭_h(D2ψ) - Λ_hol DΦ at the stages, left-trivialised."""
    flat = _rows(lambda g, m: mechanics.flat(g, m, mechanics.d2psi(g, m)), G, mu)
    holonomic = _dual(_rows(mechanics.d_holonomic, G), stages.Lambda_hol)
    return _rows(mechanics.d1h, G, mu) - _dual(flat, stages.Lambda) - holonomic


def chart_momenta(mechanics: Mechanics, tableau: Tableau, h, H, mu_hat) -> np.ndarray:
    """Π^i = (dτ_Ξi)* of the body momenta μ^i of the stages; those of h at (G^i, ·)."""
    if mechanics.group is None:
        return mu_hat
    return _dual(_rows(mechanics.group.dtau, h * (tableau.a @ H)), mu_hat)


def lagrangian_group_residuals(
    mechanics: Mechanics, tableau: Tableau, h: float, g, mu, stages: LagrangianStages
) -> Residuals:
    """Summary "Discrete nonholonomic Lagrangian equations. Lie group".

    With N^i + T^i of the section "Holonomic constraints" in place of N^i, Φ(G^i) = 0
    and the tangency condition. μ^i = D2ℓ(g_k τ(ξ^i), η^i) is substituted.
    """
    assert mechanics.group is not None
    at, found = _Geometry(mechanics.group, tableau, h, g, stages.H), Residuals()
    eta = np.einsum("inm,im->in", at.dtau, stages.H)  # dτ_Ξ H
    Pi = _dual(at.dtau, _rows(mechanics.d2l, at.G, eta))
    N = _dual(at.dtau, _lagrangian_force(mechanics, at.G, eta, stages))

    mu_nodes = _momenta(found, tableau, h, at, mu, N, Pi, stages.mu_next)
    found.add(
        "μ^i = D2ℓ(g_k τ(ξ^i), η^i) = Ad*_τ(Ξi)[μ_k + h Σ a_ij (dτ^-1_-Ξj)* N^j]",
        _rows(mechanics.d2l, at.G, stages.eta_nodes),
        -mu_nodes,
    )
    values = _rows(mechanics.phi, at.G, stages.eta_nodes)
    name = "φ(g_k τ(ξ^i), η^i) = 0"
    _constraints(found, mechanics, name, at.G, stages.eta_nodes, values)
    _holonomic(found, mechanics, at.G, stages.g_next, stages.mu_next)
    found.add("g_{k+1} = g_k τ(ξ)", stages.g_next, -at.g_next)
    return found


def hamiltonian_group_residuals(
    mechanics: Mechanics, tableau: Tableau, h: float, g, mu, stages: HamiltonianStages
) -> Residuals:
    """Summary "Discrete nonholonomic Hamiltonian equations. Lie group".

    Erratum: its last line reads H^i = (dτ_Ξ)* D2h, which maps duals; it must be
    H^i = dτ_Ξ^{-1} D2h. Holonomic constraints as on the Lagrangian side.
    """
    assert mechanics.group is not None
    at, found = _Geometry(mechanics.group, tableau, h, g, stages.H), Residuals()
    mu_hat = _dual(at.dtau_inv, stages.Pi)
    N = _dual(at.dtau, _hamiltonian_force(mechanics, at.G, mu_hat, stages))

    mu_nodes = _momenta(found, tableau, h, at, mu, -N, stages.Pi, stages.mu_next)
    velocity = _rows(mechanics.d2h, at.G, mu_hat)
    found.add(
        "H^i = dτ^-1_Ξi D2h(g_k τ(Ξ^i), (dτ^-1_Ξi)* Π^i)",
        stages.H,
        -np.einsum("inm,im->in", at.dtau_inv, velocity),
    )
    velocities = _rows(mechanics.d2h, at.G, mu_nodes)
    values = _rows(mechanics.psi, at.G, mu_nodes)
    name = "ψ(g_k τ(ξ^i), μ^i) = 0"
    _constraints(found, mechanics, name, at.G, velocities, values)
    _holonomic(found, mechanics, at.G, stages.g_next, stages.mu_next)
    found.add("g_{k+1} = g_k τ(ξ)", stages.g_next, -at.g_next)
    return found


def _vector_space(found, mechanics, tableau, h, q, p, P, W, stages: Stages):
    """q_{k+1}, p_{k+1} and P^i of both vector-space summaries. Returns p^i."""
    start = np.broadcast_to(p, P.shape)
    found.add("P^i = p_k + h Σ â_ij W^j", P, -start, -h * (tableau.a_hat @ W))
    found.add("p_{k+1} = p_k + h Σ b_j W^j", stages.mu_next, -p, -h * (tableau.b @ W))
    end = h * (tableau.b @ stages.H)
    found.add("q_{k+1} = q_k + h Σ b_j V^j", stages.g_next, -q, -end)
    return p + h * (tableau.a @ W)


def lagrangian_residuals(
    mechanics: Mechanics, tableau: Tableau, h: float, q, p, stages: LagrangianStages
) -> Residuals:
    """Summary "Discrete nonholonomic Lagrangian equations. Vector space".

    With the terms of the holonomic integrator (RATTLE for 2 stages): Λ_hol DΦ(Q^i) in
    W^i, Φ(Q^i) = 0 and the tangency condition. P^i and W^i are substituted.
    """
    found = Residuals()
    Q = q + h * (tableau.a @ stages.H)
    W = _lagrangian_force(mechanics, Q, stages.H, stages)
    P = _rows(mechanics.d2l, Q, stages.H)
    p_nodes = _vector_space(found, mechanics, tableau, h, q, p, P, W, stages)
    found.add(
        "p^i = D2L(q^i, v^i) = p_k + h Σ a_ij W^j",
        _rows(mechanics.d2l, Q, stages.eta_nodes),
        -p_nodes,
    )
    values = _rows(mechanics.phi, Q, stages.eta_nodes)
    _constraints(found, mechanics, "Φ(q^i, v^i) = 0", Q, stages.eta_nodes, values)
    _holonomic(found, mechanics, Q, stages.g_next, stages.mu_next)
    return found


def hamiltonian_residuals(
    mechanics: Mechanics, tableau: Tableau, h: float, q, p, stages: HamiltonianStages
) -> Residuals:
    """Summary "Discrete nonholonomic Hamiltonian equations. Vector space".

    W^i here has the sign of the Lagrangian side, minus the printed one. Holonomic
    constraints as there.
    """
    found = Residuals()
    Q = q + h * (tableau.a @ stages.H)
    W = -_hamiltonian_force(mechanics, Q, stages.Pi, stages)
    p_nodes = _vector_space(found, mechanics, tableau, h, q, p, stages.Pi, W, stages)
    velocity = _rows(mechanics.d2h, Q, stages.Pi)
    found.add("V^i = D2H(Q^i, P^i)", stages.H, -velocity)
    velocities = _rows(mechanics.d2h, Q, p_nodes)
    values = _rows(mechanics.psi, Q, p_nodes)
    _constraints(found, mechanics, "Ψ(q^i, p^i) = 0", Q, velocities, values)
    _holonomic(found, mechanics, Q, stages.g_next, stages.mu_next)
    return found
