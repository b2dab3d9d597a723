"""Butcher tableaux, computed in 60 digits and rounded to float64 once at the end.

A collocation tableau on nodes c_1 < ... < c_s has

    a_ij = ∫_0^{c_i} ℓ_j(θ) dθ,    b_j = ∫_0^1 ℓ_j(θ) dθ,

with ℓ_j the Lagrange basis on the nodes (Hairer, Lubich, Wanner, "Geometric Numerical
Integration", II.1.2). The symplectic conjugate is â_ij = b_j (1 - a_ji / b_i)
(ibid., VI.4.1); that of Lobatto IIIA is Lobatto IIIB.
"""

from dataclasses import dataclass
from functools import cache, cached_property, lru_cache

import numpy as np

from ._nodes import gauss_points, legendre, lobatto_points
from ._precision import CONTEXT, Matrix, Number, to_float64


BUILT_IN_TOLERANCE = CONTEXT.mpf("1e-40")
USER_TOLERANCE = CONTEXT.mpf("1e-13")


@dataclass(frozen=True, eq=False)
class Tableau:
    """A Runge-Kutta tableau (a, b, c) with its symplectic conjugate â.

    The fields hold mp numbers (`mp_a` an s x s matrix, `mp_b` and `mp_c` lists);
    `tolerance` is the defect below which an identity between them counts as satisfied:
    round-off of the 60 digits for built-in tableaux, of float64 for a user's.
    Instances compare and hash by identity; the functions that make them are cached.
    """

    mp_a: Matrix
    mp_b: list[Number]
    mp_c: list[Number]
    tolerance: Number

    @property
    def stages(self) -> int:
        """Return the number of stages s."""
        return len(self.mp_b)

    @cached_property
    def mp_a_hat(self) -> Matrix:
        """Compute the symplectic conjugate â_ij = b_j (1 - a_ji / b_i) as mp matrix."""
        a, b, s = self.mp_a, self.mp_b, self.stages
        a_hat = CONTEXT.matrix(s, s)
        for i in range(s):
            for j in range(s):
                # Where a_ji = b_i the entry is a true zero (hypothesis H1'), which
                # b_j - b_j a_ji / b_i would miss by one unit of the last digit.
                if a[j, i] != b[i]:
                    a_hat[i, j] = b[j] * (1 - a[j, i] / b[i])
        return a_hat

    @cached_property
    def a(self) -> np.ndarray:
        """Return the coefficients a_ij, a read-only float64 array of shape (s, s)."""
        return to_float64(self.mp_a)

    @cached_property
    def b(self) -> np.ndarray:
        """Return the weights b_j, a read-only float64 array of shape (s,)."""
        return to_float64(self.mp_b)

    @cached_property
    def c(self) -> np.ndarray:
        """Return the nodes c_i, a read-only float64 array of shape (s,)."""
        return to_float64(self.mp_c)

    @cached_property
    def a_hat(self) -> np.ndarray:
        """Return the symplectic conjugate â_ij, a read-only float64 (s, s) array."""
        return to_float64(self.mp_a_hat)


def lagrange_in_legendre(nodes: list[Number]) -> Matrix:
    """Expand the Lagrange basis in the shifted Legendre polynomials on [0, 1].

    The coefficients K_nj are those in ℓ_j(θ) = Σ_n K_nj P_n(2θ - 1), which means that
    K = V^{-1} with V_in = P_n(2 c_i - 1).

    **Arguments:**

    - `nodes`: the distinct nodes c_1..c_s in [0, 1], mp numbers.

    **Returns:**

    The s x s mp matrix K.
    """
    s = len(nodes)
    vandermonde = CONTEXT.matrix([legendre(s - 1, 2 * c - 1) for c in nodes])
    return CONTEXT.inverse(vandermonde)


def _integrated_legendre(degree: int, x: Number) -> list[Number]:
    """Compute ∫_0^θ P_n(2τ - 1) dτ for n = 0..degree, given x = 2θ - 1."""
    p = legendre(degree + 1, x)
    first = (x + 1) / 2
    return [first] + [
        (p[n + 1] - p[n - 1]) / (2 * (2 * n + 1)) for n in range(1, degree + 1)
    ]


def _collocation(points: list[Number]) -> Tableau:
    """Make the collocation tableau with nodes (1 + x) / 2, x in symmetric `points`."""
    s = len(points)
    nodes = [(1 + x) / 2 for x in points]
    k = lagrange_in_legendre(nodes)
    integrals = CONTEXT.matrix([_integrated_legendre(s - 1, x) for x in points])
    # P_0 alone has a non-zero integral over [0, 1].
    b = [(k[0, j] + k[0, s - 1 - j]) / 2 for j in range(s)]
    raw = integrals * k
    a = CONTEXT.matrix(s, s)
    for i in range(s):
        for j in range(s):
            # Reflection maps a_ij to b_j - a_{s+1-i,s+1-j}; the average is invariant.
            a[i, j] = (raw[i, j] + b[j] - raw[s - 1 - i, s - 1 - j]) / 2
    if points[0] == -1:
        # The integrals to c_1 = 0 and c_s = 1, without the last-digit error of a sum.
        for j in range(s):
            a[0, j], a[s - 1, j] = CONTEXT.mpf(0), b[j]
    return Tableau(a, b, nodes, BUILT_IN_TOLERANCE)


@cache
def lobatto_tableau(stages: int) -> Tableau:
    """Make the tableau of the Lobatto IIIA method with s stages.

    It is collocation at 0, 1 and the s - 2 zeros of P'_{s-1}(2c - 1) (Hairer, Lubich,
    Wanner, II.1.4). Its symplectic conjugate is Lobatto IIIB.

    **Arguments:**

    - `stages`: s >= 2.

    **Returns:**

    A `Tableau`, the same object at every call. Row 1 of `a` is zero and row s is `b`.

    !!! example

        >>> lobatto_tableau(2).a.tolist()
        [[0.0, 0.0], [0.5, 0.5]]
    """
    return _collocation(lobatto_points(stages))


@cache
def gauss_tableau(stages: int) -> Tableau:
    """Make the tableau of the Gauss method with s stages.

    It is collocation at the s zeros of P_s(2c - 1) (Hairer, Lubich, Wanner, II.1.3),
    and its own symplectic conjugate.

    **Arguments:**

    - `stages`: s >= 1.

    **Returns:**

    A `Tableau`, the same object at every call.

    !!! example

        >>> gauss_tableau(1).a.tolist(), gauss_tableau(1).b.tolist()
        ([[0.5]], [1.0])
    """
    return _collocation(gauss_points(stages))


@lru_cache(maxsize=128)
def user_tableau(a: tuple[tuple[float, ...], ...], b: tuple[float, ...]) -> Tableau:
    """Make a tableau with c_i = Σ_j a_ij from float64 coefficients, taken as exact.

    **Arguments:**

    - `a`: the rows of the coefficients.
    - `b`: the weights, none of them zero.

    **Returns:**

    A `Tableau` whose identities are checked to the accuracy of float64 coefficients.

    !!! example

        >>> user_tableau(((0.0, 0.0), (0.5, 0.5)), (0.5, 0.5)).c.tolist()
        [0.0, 1.0]
    """
    mp_a = CONTEXT.matrix([[CONTEXT.mpf(x) for x in row] for row in a])
    mp_b = [CONTEXT.mpf(x) for x in b]
    mp_c = [CONTEXT.fsum(mp_a[i, j] for j in range(len(b))) for i in range(len(b))]
    return Tableau(mp_a, mp_b, mp_c, USER_TOLERANCE)
