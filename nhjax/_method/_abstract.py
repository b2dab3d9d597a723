"""The interface of a method: its coefficients and the properties that follow."""

import abc
import math
import operator

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .._errors import check_choice
from . import _basis, _conditions
from ._closure import ClosureWeights, make_closure_weights
from ._conditions import Hypotheses, SimplifyingAssumptions
from ._tableau import Tableau


CLOSURES = ("propagated", "consistent", "symmetric")
CHARTS = ("middle", "start")

_STATEMENTS = {
    "H1": "H1 (a_1j = 0, first stage at t_k)",
    "H2": "H2 (the submatrix of a_ij with i, j >= 2 is invertible)",
    "H3": "H3 (a_sj = b_j, last stage at t_{k+1})",
}

# R_A(∞) of a user's tableau is a ratio of sums of products of float64 coefficients. At
# s = 12 the rounding of those of Lobatto IIIA moves it by less than 1e-10.
_UNIT_TOLERANCE = 1e-9

# At s = 32 the 60 digits still show every order condition, the rounded coefficients
# satisfy those of a stage to 2e-16, and runs end at round-off; but the defect of the
# multiplier, which at s = 16 is round-off, has grown sixfold, and the checks of a
# tableau, whose cost grows as s^4 and more, take 5 s (s = 20: 0.8 s; s = 100: minutes).
MOST_STAGES = 32


class AbstractMethod(eqx.Module):
    """A symplectic partitioned Runge-Kutta method: (a, b) for q, its conjugate for p.

    All data of a method is static: it is hashable, has no array leaves, can be a static
    argument of `jax.jit`, and equals any other method with the same data. Coefficients
    are computed in 60 digits and rounded once. A subclass defines `stages`, `closure`,
    `chart` and `_tableau`, and has no subclasses of its own.
    """

    stages: eqx.AbstractVar[int]
    closure: eqx.AbstractVar[str | None]
    chart: eqx.AbstractVar[str]

    @abc.abstractmethod
    def _tableau(self) -> Tableau:
        """Return the tableau of the method, the same object for all equal methods."""

    @property
    def a(self) -> np.ndarray:
        """Return the coefficients a_ij, a read-only float64 array of shape (s, s)."""
        return self._tableau().a

    @property
    def b(self) -> np.ndarray:
        """Return the weights b_j, a read-only float64 array of shape (s,)."""
        return self._tableau().b

    @property
    def c(self) -> np.ndarray:
        """Return the nodes c_i, a read-only float64 array of shape (s,)."""
        return self._tableau().c

    @property
    def a_hat(self) -> np.ndarray:
        """Return the symplectic conjugate â_ij = b_j (1 - a_ji / b_i).

        It is a read-only float64 array of shape (s, s).
        """
        return self._tableau().a_hat

    @property
    def orders(self) -> SimplifyingAssumptions:
        """Find the simplifying assumptions B(p), C(q), D(r) and CĈ(Q) that hold."""
        return _conditions.simplifying_assumptions(self._tableau())

    @property
    def order(self) -> int:
        """Return the order of q and p in systems without constraints.

        It is found from the order conditions of the pair (a, â) up to order 8, and is
        min(p, 2r + 2) of B(p) and D(r) beyond that, as measured.
        """
        return _conditions.order(self._tableau())

    @property
    def constrained_order(self) -> int:
        """Return the order of q and p in systems with constraints.

        It is min(p, 2r + 2) of B(p) and D(r), or the order without constraints if that
        is less. For collocation on nodes with both ends, such as Lobatto's, the page
        on closures proves that the order is at least 2r + 2; runs of many tableaux
        show that it is no more.

        **Raises:** a `ValueError` as `require_constraint_hypotheses` does.
        """
        self.require_constraint_hypotheses()
        return min(self.order, self.orders.B, 2 * self.orders.D + 2)

    @property
    def hypotheses(self) -> Hypotheses:
        """Find which of H1, H2, H3 hold, which systems with constraints need."""
        return _conditions.hypotheses(self._tableau())

    @property
    def is_symmetric(self) -> bool:
        """Tell if a_{s+1-i,s+1-j} + a_ij = b_j: a step of -h then undoes one of h."""
        return _conditions.is_symmetric(self._tableau())

    @property
    def stability_at_infinity(self) -> float:
        """Compute R_A(∞), the limit of the stability function; inf if unbounded."""
        return _conditions.stability_at_infinity(self._tableau())

    @property
    def multiplier_order(self) -> int:
        """Return the order of convergence of the multiplier that a solution reports.

        With `closure="propagated"` it is Q of CĈ(Q), less one if R_A(∞) = 1, and the
        next even number if the method is symmetric, as runs of many tableaux show. (The
        paper's theorem on global convergence has q of C(q) for Q, which is the same for
        Lobatto's nodes alone.) With the other closures the multiplier is the continuous
        one, and has the order of the state.

        **Raises:** a `ValueError` as `require_constraint_hypotheses` does.
        """
        self.require_constraint_hypotheses()
        if self.closure != "propagated":
            return self.constrained_order
        accumulates = abs(self.stability_at_infinity - 1) <= _UNIT_TOLERANCE
        order = min(self.orders.C, self.orders.mixed) - int(accumulates)
        if self.is_symmetric:
            order += order % 2
        return min(order, self.constrained_order)

    @property
    def embedded_difference(self) -> np.ndarray | None:
        """Return b less the weights of a quadrature that leaves out the last node.

        These weights are a multiple of the divided difference over all nodes. A
        quadrature with them is zero for polynomials of a degree less than s - 1, so
        that it shows how well the nodes resolve a function. Where nodes coincide, only
        the first of them has a weight. None if there is but one node.
        """
        nodes, first = np.unique(self.c, return_index=True)
        if len(nodes) == 1:
            return None
        apart = nodes[:, None] - nodes + np.eye(len(nodes))
        weights = 1 / np.prod(apart, axis=1)
        last = np.sum(self.b[self.c == nodes[-1]])
        difference = np.zeros(self.stages)
        difference[first] = last * weights / weights[-1]
        return difference

    @property
    def closure_weights(self) -> ClosureWeights:
        """Return the weights that give a step's multipliers, as in `ClosureWeights`.

        **Raises:** a `ValueError` as `require_constraint_hypotheses` does.
        """
        self.require_constraint_hypotheses()
        return make_closure_weights(self._tableau(), self.closure == "symmetric")

    def basis(self, theta: ArrayLike) -> Float[Array, "*batch s"]:
        """Evaluate the Lagrange basis ℓ_1(θ), ..., ℓ_s(θ) on the nodes c.

        **Arguments:**

        - `theta`: θ = (t - t_k) / h, of any shape, traceable; beyond [0, 1] it
            extrapolates.

        **Returns:**

        An array of shape `theta.shape + (s,)` and of the dtype of `theta`.

        **Raises:**

        A `ValueError` if two nodes coincide.
        """
        return _basis.lagrange(self._tableau(), theta)

    def integrated_basis(self, theta: ArrayLike) -> Float[Array, "*batch s"]:
        """Compute ∫_0^θ ℓ_j, the weights of a collocation polynomial at t_k + θ h.

        At θ = 0 they are exactly 0, and at θ = 1 exactly `b` for a collocation method,
        so that dense output agrees with the states at both ends of a step. Arguments,
        result and errors are those of `basis`.
        """
        return _basis.integrated_lagrange(self._tableau(), theta)

    def require_constraint_hypotheses(self) -> None:
        """Check that the method can integrate systems with constraints.

        H1, H2 and H3 (the paper's section on holonomic constraints) make the first and
        last stages the states at t_k and t_{k+1} and the multipliers solvable. Carried
        multipliers stay bounded if |R_A(∞)| <= 1; the symmetric closure needs a
        symmetric tableau and |R_A(∞)| = 1.

        **Raises:**

        A `ValueError` naming the first condition that fails.
        """
        for name, holds in self.hypotheses._asdict().items():
            if not holds:
                self._reject(f"hypothesis {_STATEMENTS[name]} fails; use LobattoIIIAB")
        size = abs(self.stability_at_infinity)
        if self.closure == "propagated" and size > 1 + _UNIT_TOLERANCE:
            self._reject(
                "closure='propagated' needs |R_A(∞)| <= 1, the factor that a step "
                f"applies to an error in the multiplier, and it is {size:.6g}; "
                "use closure='consistent'"
            )
        if self.closure != "symmetric":
            return
        alternatives = "use closure='propagated' or 'consistent'"
        if not math.isclose(size, 1, rel_tol=_UNIT_TOLERANCE):
            self._reject(
                f"closure='symmetric' needs |R_A(∞)| = 1, and it is {size:.6g}; "
                + alternatives
            )
        if not self.is_symmetric:
            self._reject(
                "closure='symmetric' needs a symmetric tableau "
                "(a_{s+1-i,s+1-j} + a_ij = b_j); " + alternatives
            )

    def _reject(self, reason: str) -> None:
        raise ValueError(
            f"{type(self).__name__}(stages={self.stages}) cannot integrate a "
            f"constrained system: {reason}"
        )


def check_stages(stages: int, minimum: int, method: str) -> int:
    """Return a number of stages as an int, or raise an error if it is not in range.

    **Arguments:**

    - `stages`: the number of stages s.
    - `minimum`: the fewest that the method can have.
    - `method`: its name, for the error.

    **Raises:**

    A `TypeError` if it is no integer, a `ValueError` if it is less than `minimum` or
    more than `MOST_STAGES`.
    """
    try:
        if isinstance(stages, bool):
            raise TypeError
        count = operator.index(stages)
    except TypeError:
        raise TypeError(
            f"stages of {method} must be an int, got {stages!r} of type "
            f"{type(stages).__name__}"
        ) from None
    if count < minimum:
        raise ValueError(f"stages of {method} must be >= {minimum}, got {count}")
    if count > MOST_STAGES:
        raise ValueError(
            f"stages of {method} must be <= {MOST_STAGES}, got {count}: more gain no "
            "digit in float64, and their coefficients take minutes to find and to "
            "check. Take smaller steps"
        )
    return count


def check_closure(closure: str) -> str:
    """Return `closure` if it is one of `CLOSURES`.

    **Raises:**

    A `ValueError` that lists the choices.
    """
    check_choice("closure", closure, CLOSURES)
    return closure


def check_chart(chart: str) -> str:
    """Return `chart` if it is one of `CHARTS`.

    **Raises:**

    A `ValueError` that lists the choices.
    """
    check_choice("chart", chart, CHARTS)
    return chart
