"""The discrete nonholonomic equations, written out from the paper in plain NumPy.

An oracle that shares no code with the library: the coefficients come from the paper's
definitions of continuous and discontinuous collocation (its appendix on the numerical
solution of ODEs), the derivatives of L and Φ are those of `paper_mechanics`, and each
equation of the section "Summary: Discrete nonholonomic Lagrangian equations. Vector
space" is evaluated with the stage data of a run, as a residual relative to its own
terms.
"""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.polynomial import legendre

from support.paper_mechanics import (
    largest,
    Mechanics,
)


@dataclass(frozen=True)
class Pair:
    """Lobatto IIIA (a, b, c) and Lobatto IIIB (a_hat, b)."""

    a: np.ndarray
    a_hat: np.ndarray
    b: np.ndarray
    c: np.ndarray


def _lagrange(nodes, j, x):
    """The j-th Lagrange polynomial on `nodes` at x, as a product."""
    value = np.ones_like(x)
    for k, node in enumerate(nodes):
        if k != j:
            value = value * (x - node) / (nodes[j] - node)
    return value


def _integral(nodes, j, upper):
    """∫_0^upper of the j-th Lagrange polynomial on `nodes`, by a Gauss rule."""
    x, w = legendre.leggauss(12)
    return 0.5 * upper * np.sum(w * _lagrange(nodes, j, 0.5 * upper * (x + 1)))


def _lobatto_nodes(stages):
    """0, 1, and the zeros of P'_{s-1} between."""
    derivative = legendre.Legendre.basis(stages - 1).deriv()
    x = np.sort(derivative.roots().real)
    for _ in range(3):
        x = x - derivative(x) / derivative.deriv()(x)
    x = 0.5 * (x - x[::-1])
    return np.concatenate([[0.0], 0.5 * (1 + x), [1.0]])


@cache
def lobatto(stages: int) -> Pair:
    """The pair with `stages` stages, each method from its own definition.

    IIIA is collocation at the Lobatto nodes. IIIB is discontinuous collocation: with
    u' = Σ f_j l_j over the inner nodes and u(0) = y_0 - h b_1 (u'(0) - f_1) its stages
    are u(c_i) = y_0 + h b_1 f_1 + h Σ (∫_0^{c_i} l_j - b_1 l_j(0)) f_j.
    """
    c = _lobatto_nodes(stages)
    a = np.array([[_integral(c, j, x) for j in range(stages)] for x in c])
    b = a[-1].copy()
    inner = c[1:-1]
    a_hat = np.zeros((stages, stages))
    a_hat[:, 0] = b[0]
    for i in range(stages):
        for j in range(stages - 2):
            start = _lagrange(inner, j, np.float64(0.0))
            a_hat[i, j + 1] = _integral(inner, j, c[i]) - b[0] * start
    return Pair(a, a_hat, b, c)


@dataclass(frozen=True)
class Run:
    """Node states k = 0..K, and stage data of the K steps between them."""

    t: np.ndarray  # (K+1,)
    h: float
    q: np.ndarray  # (K+1, n)
    v: np.ndarray
    p: np.ndarray
    multiplier: np.ndarray  # (K+1, m)
    V: np.ndarray  # (K, s, n)
    W: np.ndarray
    Lambda: np.ndarray  # (K, s, m)

    def perturbed(self, name: str, size: float) -> "Run":
        """A copy in which the last entry of an array is off by `size`, relatively."""
        array = getattr(self, name).copy()
        array[(-1,) * array.ndim] += size * (1 + abs(array[(-1,) * array.ndim]))
        return replace(self, **{name: array})


def _relative(*terms, total=None):
    """The largest |Σ terms| over all points, relative to the largest Σ |terms| there.

    The norm is the maximum over the components of an equation; `total` replaces Σ
    |terms|.
    """
    residual = np.max(np.abs(sum(terms)), axis=-1)
    if total is None:
        total = sum(np.abs(term) for term in terms)
    size = np.max(total, axis=-1)
    return float(np.max(residual / np.where(size > 0, size, 1)))


def residuals(mechanics: Mechanics, run: Run, closure: str) -> dict[str, float]:
    """How well each equation of the paper's summary holds.

    The order is that of the summary; the closure of the multipliers comes last. The
    definitions Q^i, P^i, q^i, p^i of the stages are substituted. The velocities v^i are
    computed from the momenta p^i, not taken from the library. Φ is relative to
    Σ_j |D2Φ_j| max |v|, since the components of v come out of one linear system.
    """
    stages = run.V.shape[1]
    pair, h = lobatto(stages), run.h
    q, p = run.q[:-1], run.p[:-1]
    t = run.t[:-1, None] + h * pair.c

    def increment(weights, x):
        return h * np.einsum("ij,kjn->kin", weights, x)

    def size(weights, x):
        return h * np.einsum("ij,kjn->kin", np.abs(weights), np.abs(x))

    b = pair.b[None]
    Q = q[:, None] + increment(pair.a, run.V)
    B = mechanics.d2phi(t, Q, run.V)
    reaction = np.einsum("kim,kimn->kin", run.Lambda, B)
    p_stage = p[:, None] + increment(pair.a, run.W)
    v_stage = mechanics.velocity(t, Q, p_stage)
    B_stage = mechanics.d2phi(t, Q, v_stage)
    v_node = mechanics.velocity(run.t, run.q, run.p)
    B_node = mechanics.d2phi(run.t, run.q, v_node)

    found = {
        "q_{k+1} = q_k + h Σ b V": _relative(
            run.q[1:],
            -q,
            -increment(b, run.V)[:, 0],
            total=np.abs(run.q[1:]) + np.abs(q) + size(b, run.V)[:, 0],
        ),
        "p_{k+1} = p_k + h Σ b W": _relative(
            run.p[1:],
            -p,
            -increment(b, run.W)[:, 0],
            total=np.abs(run.p[1:]) + np.abs(p) + size(b, run.W)[:, 0],
        ),
        "P^i = p_k + h Σ â W = D2L(Q^i, V^i)": _relative(
            mechanics.d2l(t, Q, run.V),
            -p[:, None],
            -increment(pair.a_hat, run.W),
            total=np.abs(mechanics.d2l(t, Q, run.V))
            + np.abs(p[:, None])
            + size(pair.a_hat, run.W),
        ),
        "W^i = D1L(Q^i, V^i) + Λ^i D2Φ(Q^i, V^i)": _relative(
            run.W,
            -mechanics.d1l(t, Q, run.V),
            -reaction,
            total=np.abs(run.W) + mechanics.d1l_size(t, Q, run.V) + np.abs(reaction),
        ),
        "p_k = D2L(q_k, v_k)": _relative(run.p, -mechanics.d2l(run.t, run.q, run.v)),
        "Φ(q^i, v^i) = 0": _relative(
            mechanics.phi(t, Q, v_stage),
            total=np.sum(np.abs(B_stage), axis=-1) * largest(v_stage)[..., None],
        ),
        "Φ(q_k, v_k) = 0": _relative(
            mechanics.phi(run.t, run.q, v_node),
            total=np.sum(np.abs(B_node), axis=-1) * largest(v_node)[..., None],
        ),
    }
    first, last = run.Lambda[:, 0], run.Lambda[:, -1]
    if closure == "propagated":
        found["λ_k = Λ^1"] = _relative(run.multiplier[:-1], -first)
        found["λ_{k+1} = Λ^s"] = _relative(run.multiplier[1:], -last)
        return found

    continuous, terms = mechanics.continuous_multiplier(run.t, run.q, run.p)
    found["λ_k = λ_c(q_k, p_k)"] = _relative(
        run.multiplier, -continuous, total=terms + np.abs(continuous)
    )
    if closure == "consistent":
        found["Λ^1 = λ_c(q_k, p_k)"] = _relative(
            first, -continuous[:-1], total=np.abs(first) + terms[:-1]
        )
        return found

    sign = (-1.0) ** stages
    found["Λ^1 - λ_c(q_k, p_k) = ν = (-1)^s (Λ^s - λ_c(q_{k+1}, p_{k+1}))"] = _relative(
        first - continuous[:-1],
        -sign * (last - continuous[1:]),
        total=np.abs(first) + terms[:-1] + np.abs(last) + terms[1:],
    )
    return found
