"""The charts in which the equations of a step are written, on matrices, in NumPy.

One is the paper's, around the start of the step; the other has its origin between the
start and the end. `paper_group_equations` uses them.
"""

import numpy as np

from support.group_mechanics import MatrixGroup


def rows(function, *arguments):
    """The function at every stage, stacked."""
    return np.stack([function(*row) for row in zip(*arguments, strict=True)])


def dual(matrices, covectors):
    """The transposes of the matrices times the covectors, stage by stage."""
    return np.einsum("...ij,...i->...j", matrices, covectors)


class AtStart:
    """The paper's chart: the maps at Ξ^i = h Σ a_ij H^j and at ξ_{k,k+1} = h Σ b_j H^j.

    The maps of all stages are stacked.
    """

    def __init__(self, group: MatrixGroup, tableau, h, g, H):
        self.tableau, self.h = tableau, h
        xi = h * (tableau.b @ H)
        self._at_stages(group, g, self.coordinates(tableau, h, H), H)
        self.g_next = g @ group.tau(xi)
        self.end_dtau_inv = group.dtau_inv(xi)
        self.end_dtau_inv_minus = group.dtau_inv(-xi)
        self.end_Ad = group.Ad(group.tau(xi))

    @staticmethod
    def coordinates(tableau, h, H) -> np.ndarray:
        """The coordinates of the stages, Ξ^i."""
        return h * (tableau.a @ H)

    def _at_stages(self, group, origin, y, H):
        self.G = rows(lambda x: origin @ group.tau(x), y)
        self.dtau = rows(group.dtau, y)
        self.dtau_inv = rows(group.dtau_inv, y)
        self.dtau_inv_minus = rows(group.dtau_inv, -y)
        self.ddtau = rows(group.ddtau, y, H)  # ddτ_y(H, ·)
        self.Ad = rows(lambda x: group.Ad(group.tau(x)), y)

    def momenta(self, found, mu, N, Pi, mu_next):
        """The equations for M_k^i and μ_{k+1}; N with the Lagrangian sign. Returns μ^i.

        They are the third, fifth and fourth lines of both Lie-group summaries. The
        definition of M_k^i in the second half is substituted into the third line.
        """
        a, b, h = self.tableau.a, self.tableau.b, self.h
        ratio = a.T / b[:, None]  # a_ji / b_i
        curvature = h * np.einsum("ij,j,jn->in", ratio, b, dual(self.ddtau, Pi))
        body = dual(self.dtau_inv_minus, N)
        start = np.broadcast_to(mu, Pi.shape)
        found.add(
            "M^i = (dτ^-1_ξ)*[Π^i + h Σ b_j a_ji / b_i ddτ*_Ξj(H^j, Π^j)]"
            " = Ad*_τ(ξ)[μ_k + h Σ b_j (dτ^-1_-Ξj - a_ji / b_i dτ^-1_-ξ)* N^j]",
            Pi @ self.end_dtau_inv,
            curvature @ self.end_dtau_inv,
            -start @ self.end_Ad,
            -np.broadcast_to(h * (b @ body), Pi.shape) @ self.end_Ad,
            h * (ratio @ (b[:, None] * (N @ self.end_dtau_inv_minus))) @ self.end_Ad,
        )
        found.add(
            "μ_{k+1} = Ad*_τ(ξ)[μ_k + h Σ b_j (dτ^-1_-Ξj)* N^j]",
            mu_next,
            -mu @ self.end_Ad,
            -h * (b @ body) @ self.end_Ad,
        )
        return dual(self.Ad, mu + h * (a @ body))


class InTheMiddle(AtStart):
    """The chart around an origin from which g_k is τ(-ξ/2) and g_{k+1} is τ(ξ/2)."""

    def __init__(self, group: MatrixGroup, tableau, h, g, H):
        self.tableau, self.h = tableau, h
        half = h * (tableau.b @ H) / 2
        origin = g @ np.linalg.inv(group.tau(-half))
        self._at_stages(group, origin, self.coordinates(tableau, h, H), H)
        self.g_next = origin @ group.tau(half)
        self.start_dtau, self.end_dtau = group.dtau(-half), group.dtau(half)
        self.start_Ad = group.Ad(group.tau(-half))
        self.end_Ad = group.Ad(group.tau(half))

    @staticmethod
    def coordinates(tableau, h, H) -> np.ndarray:
        """The coordinates of the stages, Ξ^i - ξ/2."""
        return h * ((tableau.a - tableau.b / 2) @ H)

    def momenta(self, found, mu, N, Pi, mu_next):
        """The equations that make the discrete action stationary. Returns μ^i.

        ξ enters the action through the coordinates y^i = Ξ^i - ξ/2 and the origin.
        """
        a, b, h = self.tableau.a, self.tableau.b, self.h
        M = np.linalg.solve(self.start_Ad.T, mu)  # Ad*_τ(-ξ/2) M = μ_k
        body = dual(self.dtau_inv_minus, N)
        force = N + dual(self.ddtau, Pi)
        found.add(
            "Π^i + h Σ b_j a_ji / b_i F^j = ½ (dτ_-ξ/2* μ_k + dτ_ξ/2* μ_{k+1}"
            " + h Σ b_j F^j)",
            Pi,
            h * np.einsum("ij,j,jn->in", a.T / b[:, None], b, force),
            np.broadcast_to(-mu @ self.start_dtau / 2, Pi.shape),
            np.broadcast_to(-mu_next @ self.end_dtau / 2, Pi.shape),
            np.broadcast_to(-h * (b @ force) / 2, Pi.shape),
        )
        found.add(
            "μ_{k+1} = Ad*_τ(ξ/2)[M + h Σ b_j (dτ^-1_-yj)* N^j]",
            mu_next,
            -M @ self.end_Ad,
            -h * (b @ body) @ self.end_Ad,
        )
        return dual(self.Ad, M + h * (a @ body))


CHARTS = {"start": AtStart, "middle": InTheMiddle}
