"""Order conditions, hypotheses, symmetry and stability of a tableau.

The simplifying assumptions B, C and D are due to Butcher (Hairer, Lubich, Wanner,
"Geometric Numerical Integration", II.1), and the mixed assumption CĈ is due to L. Jay
("Symplectic partitioned Runge-Kutta methods for constrained Hamiltonian systems", SIAM
J. Numer. Anal. 33, 1996):

    B(p):  Σ_i b_i c_i^{k-1} = 1/k                               k = 1..p
    C(q):  Σ_j a_ij c_j^{k-1} = c_i^k / k                        k = 1..q
    D(r):  Σ_i b_i c_i^{k-1} a_ij = b_j (1 - c_j^k) / k          k = 1..r
    CĈ(Q): Σ_j Σ_l a_ij â_jl c_l^{k-2} = c_i^k / (k (k-1))       k = 2..Q

A pair (a, â) with common weights b solves q' = f(q, p), p' = g(q, p). Its order
conditions belong to rooted trees whose edges have two colours, because a stage computes
q with a and p with â. Let τ_k be the subtrees at the root of a tree τ. The colour of
the edge to τ_k selects a matrix a^(k), which is a or â. With
φ_i(τ) = Π_k Σ_j a^(k)_ij φ_j(τ_k), the pair has order p if

    Σ_i b_i φ_i(τ) = 1 / γ(τ),    γ(τ) = |τ| Π_k γ(τ_k),

for all trees τ with |τ| <= p vertices (ibid., III.2.2).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from ._tableau import context, Matrix, Number, Tableau


class SimplifyingAssumptions(NamedTuple):
    """The largest p, q, r and Q for which B(p), C(q), D(r) and CĈ(Q) hold.

    `mixed` is Q. If the condition fails for k = 2, Q is 1, because CĈ(1) is an empty
    assumption. The search stops at 2s, the largest order of a quadrature with s nodes.
    """

    B: int
    C: int
    D: int
    mixed: int


class Hypotheses(NamedTuple):
    """The hypotheses for systems with constraints: whether each holds for (a, b).

    - `H1`: a_1j = 0, so that the first stage is the state at t_k.
    - `H2`: the submatrix (a_ij), i, j >= 2, is invertible.
    - `H3`: a_sj = b_j, so that the last stage is the state at t_{k+1}.
    """

    H1: bool
    H2: bool
    H3: bool


@lru_cache(maxsize=128)
def simplifying_assumptions(t: Tableau) -> SimplifyingAssumptions:
    """Find the largest p, q, r and Q for which B(p), C(q), D(r) and CĈ(Q) hold.

    The first three are conditions on (a, b, c); the last is a condition on the pair (a,
    â).

    **Arguments:**

    - `t`: the tableau.

    **Returns:**

    A `SimplifyingAssumptions`.

    !!! example

        >>> from nhjax._method._tableau import lobatto_tableau
        >>> simplifying_assumptions(lobatto_tableau(3))
        SimplifyingAssumptions(B=4, C=3, D=1, mixed=3)
    """
    a, a_hat, b, c = t.mp_a, t.mp_a_hat, t.mp_b, t.mp_c

    def quadrature(k: int) -> list[Number]:
        return [
            context().fdot(zip(b, _power(c, k - 1), strict=True)) - context().one / k
        ]

    def stage(k: int) -> list[Number]:
        sums = _matvec(a, _power(c, k - 1))
        return [left - x / k for left, x in zip(sums, _power(c, k), strict=True)]

    def transposed(k: int) -> list[Number]:
        bc = [w * x for w, x in zip(b, _power(c, k - 1), strict=True)]
        ends = zip(_matvec(a.T, bc), b, _power(c, k), strict=True)
        return [left - w * (1 - x) / k for left, w, x in ends]

    def mixed(k: int) -> list[Number]:
        sums = _matvec(a, _matvec(a_hat, _power(c, k - 2)))
        ends = zip(sums, _power(c, k), strict=True)
        return [left - x / (k * (k - 1)) for left, x in ends]

    return SimplifyingAssumptions(
        B=_largest_order(quadrature, 1, t),
        C=_largest_order(stage, 1, t),
        D=_largest_order(transposed, 1, t),
        mixed=_largest_order(mixed, 2, t),
    )


# The largest order that is determined from trees.
_MAX_TREE_ORDER = 8


@lru_cache(maxsize=128)
def order(t: Tableau) -> int:
    """Find the order of the pair (a, â) in systems without constraints.

    The conditions of trees are checked in float64 to 1e-12. If all conditions up to
    order 8 hold, the order is min(p, 2r + 2), but at least 8, with the largest p and r
    for which B(p) and D(r) hold. This is the order of Gauss and Lobatto methods; for
    other tableaux, measurements confirm it.
    """
    found = partitioned_order((t.a, t.a_hat), t.b, 1e-12, _MAX_TREE_ORDER)
    if found < _MAX_TREE_ORDER:
        return found
    assumptions = simplifying_assumptions(t)
    return max(found, min(assumptions.B, 2 * assumptions.D + 2))


@lru_cache(maxsize=128)
def hypotheses(t: Tableau) -> Hypotheses:
    """Find which of H1, H2 and H3 hold, the hypotheses of constrained systems.

    **Arguments:**

    - `t`: the tableau.

    **Returns:**

    A `Hypotheses` of booleans.

    !!! example

        >>> from nhjax._method._tableau import gauss_tableau
        >>> hypotheses(gauss_tableau(2))
        Hypotheses(H1=False, H2=True, H3=False)
    """
    s, a, b = t.stages, t.mp_a, t.mp_b
    first = all(abs(a[0, j]) <= t.tolerance for j in range(s))
    last = all(abs(a[s - 1, j] - b[j]) <= t.tolerance for j in range(s))
    degree, _ = _leading_term(a.tolist(), range(1, s), t.tolerance)
    return Hypotheses(H1=first, H2=degree == s - 1, H3=last)


@lru_cache(maxsize=128)
def is_symmetric(t: Tableau) -> bool:
    """Return whether a_{s+1-i,s+1-j} + a_ij = b_j: the method is its own adjoint.

    See Hairer, Lubich, Wanner, V.2.1. The conjugate â is then symmetric too. Applying
    the identity twice gives b_{s+1-j} = b_j.

    **Arguments:**

    - `t`: the tableau.

    **Returns:**

    A bool.
    """
    s, a, b = t.stages, t.mp_a, t.mp_b
    return all(
        abs(a[s - 1 - i, s - 1 - j] + a[i, j] - b[j]) <= t.tolerance
        for i in range(s)
        for j in range(s)
    )


@lru_cache(maxsize=128)
def stability_at_infinity(t: Tableau) -> float:
    """Compute R_A(∞), the limit of the stability function of a tableau as z → ∞.

    The stability function is R(z) = det(I - zA + z 1 bᵀ) / det(I - zA) (Hairer, Wanner,
    "Solving Ordinary Differential Equations II", IV.3). Its limit is the ratio of the
    leading coefficients, whether A is singular or not.

    **Arguments:**

    - `t`: the tableau.

    **Returns:**

    A float: `inf` if the numerator has the higher degree (R is unbounded), and 0 if the
    denominator has the higher degree.

    !!! example

        >>> from nhjax._method._tableau import lobatto_tableau
        >>> [stability_at_infinity(lobatto_tableau(s)) for s in (2, 3, 4)]
        [-1.0, 1.0, -1.0]
    """
    a, b, every = t.mp_a.tolist(), t.mp_b, range(t.stages)
    shifted = [[x - w for x, w in zip(row, b, strict=True)] for row in a]
    top, numerator = _leading_term(shifted, every, t.tolerance)
    bottom, denominator = _leading_term(a, every, t.tolerance)
    if top > bottom:
        return math.inf
    return float(numerator / denominator) if top == bottom else 0.0


class _Branch(NamedTuple):
    """A tree τ that is joined to a new root by an edge of one of the two colours.

    The fields are |τ|, γ(τ) and Σ_j m_ij φ_j(τ), with m = a or m = â by the colour.
    """

    size: int
    gamma: int
    values: np.ndarray


def partitioned_order(
    matrices: Sequence[np.ndarray], b: np.ndarray, tolerance: Any, max_order: int
) -> int:
    """Find the order of a partitioned pair, up to `max_order`.

    **Arguments:**

    - `matrices`: a and â, as arrays of floats, or of objects for exact numbers.
    - `b`: the common weights.
    - `tolerance`: the defect up to which a condition counts as satisfied.
    - `max_order`: the largest order to test. There are 9498 trees with 8 vertices.

    **Returns:** the largest order up to `max_order` whose conditions hold, or 0.
    """
    branches: list[_Branch] = []
    for size in range(1, max_order + 1):
        trees = list(_products(branches, size - 1, len(branches), b * 0 + 1))
        for gamma, values in trees:
            if abs(np.dot(b, values) * gamma * size - 1) > tolerance * gamma * size:
                return size - 1
        branches += [
            _Branch(size, gamma * size, np.dot(a, values))
            for gamma, values in trees
            for a in matrices
        ]
    return max_order


def _products(
    branches: list[_Branch], size: int, end: int, values: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    """Generate all trees with `size` vertices besides the root.

    The branches at the root are taken from `branches[:end]`. For each tree τ, the
    function yields the product of the γ of its branches, and `values` times φ(τ).
    """
    if size == 0:
        yield 1, values
        return
    for index in range(end):
        branch = branches[index]
        if branch.size > size:
            # The branches are sorted by size.
            return
        rest = size - branch.size
        for gamma, product in _products(
            branches, rest, index + 1, values * branch.values
        ):
            yield gamma * branch.gamma, product


def _power(c: list[Number], exponent: int) -> list[Number]:
    return [x**exponent if exponent else context().mpf(1) for x in c]


def _matvec(a: Matrix, x: list[Number]) -> list[Number]:
    return [context().fdot(zip(row, x, strict=True)) for row in a.tolist()]


def _largest_order(
    defects: Callable[[int], list[Number]], first: int, t: Tableau
) -> int:
    """Find the largest k for which the conditions `first`..k hold to round-off."""
    k = first
    while k <= 2 * t.stages and all(abs(d) <= t.tolerance for d in defects(k)):
        k += 1
    return k - 1


def _leading_term(
    rows: list[list[Number]], keep: range, tolerance: float
) -> tuple[int, Number]:
    """Compute the degree and the leading coefficient of the polynomial det(I - zM).

    M is the matrix of `rows`, restricted to the rows and columns in `keep`. By the
    algorithm of Faddeev and LeVerrier, det(I - zM) = 1 + f_1 z + ... + f_n z^n with
    f_k = -tr(M N_k) / k, N_1 = I, N_{k+1} = M N_k + f_k I.
    """
    n = len(keep)
    degree, leading = 0, context().one
    if n == 0:
        return degree, leading
    m = context().matrix([[rows[i][j] for j in keep] for i in keep])
    sums: list[Number] = [context().fsum(row, absolute=True) for row in m.tolist()]
    norm = max(sums)
    auxiliary = context().eye(n)
    for k in range(1, n + 1):
        product = m * auxiliary
        f = -context().fsum(product[i, i] for i in range(n)) / k
        # f_k scales like the k-th power of M, and the coefficients decrease like
        # 1/(2n)!. Therefore f_k counts as zero if it is small relative to the last
        # nonzero coefficient, not on an absolute scale.
        if abs(f) > tolerance * abs(leading) * norm ** (k - degree):
            degree, leading = k, f
        auxiliary = product + f * context().eye(n)
    return degree, leading
