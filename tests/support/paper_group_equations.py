"""The paper's equations on Lie groups, and with holonomic constraints, in plain NumPy.

An oracle that shares no code with the library, for the groups and systems of
`group_mechanics`. Every equation of the paper's summaries is evaluated as a residual,
as printed except for one erratum (see `hamiltonian_group_residuals`).

Conventions: D1 is left-trivialised, <D1ℓ, δ> = d/dε ℓ(g τ(εδ), η). A covector is the
array of its values on the basis, so that the dual of a map is the transpose of its
matrix. On a vector space g is q itself, a vector, with η = v and μ = p.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from support.charts import CHARTS, dual, rows
from support.group_mechanics import Mechanics


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
    """With the node velocities η^i (v^i on a vector space)."""

    eta_nodes: np.ndarray  # (s, n)


@dataclass(frozen=True)
class HamiltonianStages(Stages):
    """With the stage momenta Π^i (P^i on a vector space); see `chart_momenta`."""

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


def _constraints(found, mechanics: Mechanics, name, G, velocities, values):
    """φ or ψ at the nodes, relative to |D2φ| |η| plus the part without η."""
    slopes = rows(mechanics.d2phi, G, velocities)
    rest = rows(mechanics.phi, G, np.zeros_like(velocities))
    speed = np.max(np.abs(velocities))
    size = np.sum(np.abs(slopes), axis=-1) * speed + np.abs(rest)
    found.add(name, values, size=float(np.max(size, initial=0.0)))


def _holonomic(found, mechanics: Mechanics, G, g_next, mu_next):
    """Φ(G^i) = 0 and the tangency condition at the end."""
    slopes = np.abs(rows(mechanics.d_holonomic, G))
    reach = np.max(np.sum(slopes, axis=-1), initial=0.0) * np.max(np.abs(G))
    found.add("Φ(G^i) = 0", rows(mechanics.holonomic, G), size=float(reach))
    slope, velocity = mechanics.d_holonomic(g_next), mechanics.d2h(g_next, mu_next)
    size = np.max(np.abs(slope) @ np.abs(velocity), initial=0.0)
    found.add("<DΦ, D2h>(g_{k+1}, μ_{k+1}) = 0", slope @ velocity, size=float(size))


def _lagrangian_force(mechanics: Mechanics, G, eta, stages: Stages):
    """D1ℓ + Λ D2φ + Λ_hol DΦ at the stages, left-trivialised."""
    reaction = dual(rows(mechanics.d2phi, G, eta), stages.Lambda)
    holonomic = dual(rows(mechanics.d_holonomic, G), stages.Lambda_hol)
    return rows(mechanics.d1l, G, eta) + reaction + holonomic


def _hamiltonian_force(mechanics: Mechanics, G, mu, stages: Stages):
    """D1h - Λ ♭_h(D2ψ) - Λ_hol DΦ at the stages, left-trivialised."""
    flat = rows(lambda g, m: mechanics.flat(g, m, mechanics.d2psi(g, m)), G, mu)
    holonomic = dual(rows(mechanics.d_holonomic, G), stages.Lambda_hol)
    return rows(mechanics.d1h, G, mu) - dual(flat, stages.Lambda) - holonomic


def chart_momenta(
    mechanics: Mechanics, tableau: Tableau, h, H, mu_hat, chart: str
) -> np.ndarray:
    """Π^i = (dτ_yi)* μ^i for the body momenta μ^i; h is evaluated at (G^i, μ^i)."""
    if mechanics.group is None:
        return mu_hat
    y = CHARTS[chart].coordinates(tableau, h, H)
    return dual(rows(mechanics.group.dtau, y), mu_hat)


def lagrangian_group_residuals(
    mechanics: Mechanics,
    tableau: Tableau,
    h: float,
    g,
    mu,
    stages: LagrangianStages,
    chart: str,
) -> Residuals:
    """Summary "Discrete nonholonomic Lagrangian equations. Lie group".

    For the chart at the start, these are the paper's. Holonomic constraints replace N^i
    by N^i + T^i (section "Holonomic constraints") and add Φ(G^i) = 0 and the tangency
    condition. μ^i = D2ℓ(g_k τ(ξ^i), η^i) is substituted.
    """
    assert mechanics.group is not None
    at = CHARTS[chart](mechanics.group, tableau, h, g, stages.H)
    found = Residuals()
    eta = np.einsum("inm,im->in", at.dtau, stages.H)  # dτ_Ξ H
    Pi = dual(at.dtau, rows(mechanics.d2l, at.G, eta))
    N = dual(at.dtau, _lagrangian_force(mechanics, at.G, eta, stages))

    mu_nodes = at.momenta(found, mu, N, Pi, stages.mu_next)
    found.add(
        "μ^i = D2ℓ(g_k τ(ξ^i), η^i) = Ad*_τ(Ξi)[μ_k + h Σ a_ij (dτ^-1_-Ξj)* N^j]",
        rows(mechanics.d2l, at.G, stages.eta_nodes),
        -mu_nodes,
    )
    values = rows(mechanics.phi, at.G, stages.eta_nodes)
    name = "φ(g_k τ(ξ^i), η^i) = 0"
    _constraints(found, mechanics, name, at.G, stages.eta_nodes, values)
    _holonomic(found, mechanics, at.G, stages.g_next, stages.mu_next)
    found.add("g_{k+1} = the end of the chart", stages.g_next, -at.g_next)
    return found


def hamiltonian_group_residuals(
    mechanics: Mechanics,
    tableau: Tableau,
    h: float,
    g,
    mu,
    stages: HamiltonianStages,
    chart: str,
) -> Residuals:
    """Summary "Discrete nonholonomic Hamiltonian equations. Lie group".

    Erratum: its last line reads H^i = (dτ_Ξ)* D2h, which maps duals; it must be
    H^i = dτ_Ξ^{-1} D2h. Holonomic constraints enter as on the Lagrangian side.
    """
    assert mechanics.group is not None
    at = CHARTS[chart](mechanics.group, tableau, h, g, stages.H)
    found = Residuals()
    mu_hat = dual(at.dtau_inv, stages.Pi)
    N = dual(at.dtau, _hamiltonian_force(mechanics, at.G, mu_hat, stages))

    mu_nodes = at.momenta(found, mu, -N, stages.Pi, stages.mu_next)
    velocity = rows(mechanics.d2h, at.G, mu_hat)
    found.add(
        "H^i = dτ^-1_Ξi D2h(g_k τ(Ξ^i), (dτ^-1_Ξi)* Π^i)",
        stages.H,
        -np.einsum("inm,im->in", at.dtau_inv, velocity),
    )
    velocities = rows(mechanics.d2h, at.G, mu_nodes)
    values = rows(mechanics.psi, at.G, mu_nodes)
    name = "ψ(g_k τ(ξ^i), μ^i) = 0"
    _constraints(found, mechanics, name, at.G, velocities, values)
    _holonomic(found, mechanics, at.G, stages.g_next, stages.mu_next)
    found.add("g_{k+1} = the end of the chart", stages.g_next, -at.g_next)
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
    P = rows(mechanics.d2l, Q, stages.H)
    p_nodes = _vector_space(found, mechanics, tableau, h, q, p, P, W, stages)
    found.add(
        "p^i = D2L(q^i, v^i) = p_k + h Σ a_ij W^j",
        rows(mechanics.d2l, Q, stages.eta_nodes),
        -p_nodes,
    )
    values = rows(mechanics.phi, Q, stages.eta_nodes)
    _constraints(found, mechanics, "Φ(q^i, v^i) = 0", Q, stages.eta_nodes, values)
    _holonomic(found, mechanics, Q, stages.g_next, stages.mu_next)
    return found


def hamiltonian_residuals(
    mechanics: Mechanics, tableau: Tableau, h: float, q, p, stages: HamiltonianStages
) -> Residuals:
    """Summary "Discrete nonholonomic Hamiltonian equations. Vector space".

    W^i here has the sign of the Lagrangian side, minus the printed one. Holonomic
    constraints enter as on that side.
    """
    found = Residuals()
    Q = q + h * (tableau.a @ stages.H)
    W = -_hamiltonian_force(mechanics, Q, stages.Pi, stages)
    p_nodes = _vector_space(found, mechanics, tableau, h, q, p, stages.Pi, W, stages)
    velocity = rows(mechanics.d2h, Q, stages.Pi)
    found.add("V^i = D2H(Q^i, P^i)", stages.H, -velocity)
    velocities = rows(mechanics.d2h, Q, p_nodes)
    values = rows(mechanics.psi, Q, p_nodes)
    _constraints(found, mechanics, "Ψ(q^i, p^i) = 0", Q, velocities, values)
    _holonomic(found, mechanics, Q, stages.g_next, stages.mu_next)
    return found
