"""The methods: Lobatto IIIA-IIIB, Gauss, and partitioned methods from any tableau.

For each constraint, a step has s multipliers Λ^1, ..., Λ^s. By hypothesis H1, stage 1
is the state at t_k, where the constraint already holds. So there are only s - 1
equations for each constraint. A multiplier closure writes the multipliers in terms of s
- 1 unknowns y, and of multipliers λ_k and λ_{k+1} at the ends of the step, with
constant weights,

    (Λ^1, ..., Λ^s) = start λ_k + end λ_{k+1} + E y.

With A = (a_ij), the derivative of the constraints with respect to h y is then, for
small h, A_{2:,:} E times the compatibility matrix C.
"""

import abc
import math
import operator
from dataclasses import dataclass
from functools import lru_cache

import equinox as eqx
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float
from numpy.typing import ArrayLike as NumpyArrayLike

from .._errors import check_choice
from . import _order_conditions
from ._order_conditions import Hypotheses, SimplifyingAssumptions
from ._tableau import (
    context,
    gauss_tableau,
    integrated_lagrange,
    lagrange,
    lobatto_tableau,
    Tableau,
    to_float64,
    user_tableau,
)


CLOSURES = ("propagated", "consistent", "symmetric")
CHARTS = ("middle", "start")

_STATEMENTS = {
    "H1": "H1 (a_1j = 0, first stage at t_k)",
    "H2": "H2 (the submatrix of a_ij with i, j >= 2 is invertible)",
    "H3": "H3 (a_sj = b_j, last stage at t_{k+1})",
}

# The tolerance of conditions on R_A(∞). For a user's tableau, R_A(∞) is a ratio of sums
# of products of float64 coefficients. For Lobatto IIIA with s = 12, rounding the
# coefficients changes R_A(∞) by less than 1e-10.
_UNIT_TOLERANCE = 1e-9

# The largest number of stages. At s = 32, 60 digits still resolve every order
# condition, the rounded coefficients satisfy the stage conditions to 2e-16, and runs
# converge to round-off. Two things are worse than with fewer stages. The defect of the
# multiplier is six times as large as at s = 16, where it is round-off. The checks of a
# tableau take 5 s (s = 20: 0.8 s; s = 100: minutes), because their cost grows at least
# as s^4.
MAX_STAGES = 32


@dataclass(frozen=True, eq=False)
class ClosureWeights:
    """The weights that map a closure's unknowns to the multipliers of a step.

    All fields are read-only float64 arrays. Instances compare by identity.

    **Fields:**

    - `E`: shape (s, s-1), the weights of the unknowns y.
    - `start`: shape (s,), the weights of the multiplier λ_k at t_k.
    - `end`: shape (s,), the weights of λ_{k+1} = λ_c(q_{k+1}, p_{k+1}), the continuous
        multiplier.
    - `response`: shape (s-1,), the change of y that compensates a change of λ_{k+1} by
        one, so that the sums Σ_j a_ij Λ^j with i >= 2 stay the same.
    - `stage_response`: shape (s,), the change of Σ_j â_ij Λ^j if λ_{k+1} changes by one
        and y by `response`.
    """

    E: np.ndarray
    start: np.ndarray
    end: np.ndarray
    response: np.ndarray
    stage_response: np.ndarray


class AbstractMethod(eqx.Module):
    """A symplectic partitioned Runge-Kutta method: (a, b) for q, its conjugate for p.

    All data of a method is static: the method is hashable, has no array leaves, can be
    a static argument of `jax.jit`, and equals any other method with the same data.
    Coefficients are computed in 60 digits and rounded once. A subclass is final and
    defines `stages`, `closure`, `chart` and `_tableau`.
    """

    stages: eqx.AbstractVar[int]
    closure: eqx.AbstractVar[str | None]
    chart: eqx.AbstractVar[str]

    @abc.abstractmethod
    def _tableau(self) -> Tableau:
        """Return the tableau; equal methods return the same object."""

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
        """Find the simplifying assumptions B(p), C(q), D(r) and CĈ(Q) that hold.

        `_order_conditions` defines these conditions.
        """
        return _order_conditions.simplifying_assumptions(self._tableau())

    @property
    def order(self) -> int:
        """Return the order of q and p in systems without constraints.

        Up to 8, the order follows from the order conditions of the pair (a, â). Above
        8, the order is min(p, 2r + 2) with the largest p and r for which B(p) and D(r)
        hold, as measurements confirm.
        """
        return _order_conditions.order(self._tableau())

    @property
    def constrained_order(self) -> int:
        """Return the order of q and p in systems with constraints.

        With p and r as for `order`, it is min(p, 2r + 2), but at most the order without
        constraints. For collocation on nodes that include 0 and 1, such as Lobatto's,
        the page on closures proves that the order is at least 2r + 2; runs with many
        tableaux show that it is not higher. One case is excluded: with
        `closure="propagated"`, R_A(∞) = 1 and nodes that are not symmetric, errors of
        the multiplier add up, and the order is at most 2r + 1.

        **Raises:** `ValueError`, as `require_constraint_hypotheses` does.
        """
        self.require_constraint_hypotheses()
        lost = int(self._multiplier_errors_add_up and not self.is_symmetric)
        return min(self.order, self.orders.B, 2 * self.orders.D + 2 - lost)

    @property
    def _multiplier_errors_add_up(self) -> bool:
        """Return whether each step adds its error to the propagated multiplier."""
        is_one = abs(self.stability_at_infinity - 1) <= _UNIT_TOLERANCE
        return self.carries_multiplier and is_one

    @property
    def hypotheses(self) -> Hypotheses:
        """Find which of the hypotheses H1, H2 and H3 hold."""
        return _order_conditions.hypotheses(self._tableau())

    @property
    def is_symmetric(self) -> bool:
        """Return whether a_{s+1-i,s+1-j} + a_ij = b_j: a step -h undoes a step h."""
        return _order_conditions.is_symmetric(self._tableau())

    @property
    def stability_at_infinity(self) -> float:
        """Compute R_A(∞), the limit of the stability function; inf if unbounded."""
        return _order_conditions.stability_at_infinity(self._tableau())

    @property
    def multiplier_order(self) -> int:
        """Return the order of convergence of the multiplier that a solution reports.

        With `closure="propagated"` this order is min(q, Q) with the largest q and Q for
        which C(q) and CĈ(Q) hold. One is subtracted if R_A(∞) = 1. The result is then
        rounded up to an even number if the method is symmetric, and limited to
        `constrained_order`. Runs with many tableaux confirm this rule. (The paper's
        theorem on global convergence has q in place of min(q, Q), which is the same for
        Lobatto's nodes.) With the other closures the multiplier is the continuous
        multiplier, which has the order of the state.

        **Raises:** `ValueError`, as `require_constraint_hypotheses` does.
        """
        self.require_constraint_hypotheses()
        if not self.carries_multiplier:
            return self.constrained_order
        lost = int(self._multiplier_errors_add_up)
        order = min(self.orders.C, self.orders.mixed) - lost
        if self.is_symmetric:
            order += order % 2
        return min(order, self.constrained_order)

    @property
    def embedded_difference(self) -> np.ndarray | None:
        """Return b minus the weights of a quadrature without the last node.

        The difference is a multiple of the divided difference over all nodes. As a
        quadrature it vanishes for polynomials of degree less than s - 1, so that it
        measures how well the nodes resolve a function. If several nodes coincide, only
        the first has a weight. Returns None if there is only one distinct node.
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
    def carries_multiplier(self) -> bool:
        """Return whether a step passes its last multiplier Λ^s to the next step.

        Only steps with the propagated closure do so; the states of a run then have the
        multiplier Λ^s. With the other closures, states have the continuous multiplier.
        """
        return self.closure == "propagated"

    @property
    def closure_weights(self) -> ClosureWeights:
        """Return the `ClosureWeights`, which give a step's multipliers.

        **Raises:** `ValueError`, as `require_constraint_hypotheses` does.
        """
        self.require_constraint_hypotheses()
        return multiplier_closure_weights(self._tableau(), self.closure == "symmetric")

    def basis(self, theta: ArrayLike) -> Float[Array, "*batch s"]:
        """Evaluate the Lagrange basis ℓ_1(θ), ..., ℓ_s(θ) on the nodes c.

        **Arguments:**

        - `theta`: θ = (t - t_k) / h, of any shape. It may be traced. Values outside
            [0, 1] extrapolate.

        **Returns:**

        An array of shape `theta.shape + (s,)` and of the dtype of `theta`.

        **Raises:**

        `ValueError` if two nodes coincide.
        """
        return lagrange(self._tableau(), theta)

    def integrated_basis(self, theta: ArrayLike) -> Float[Array, "*batch s"]:
        """Compute ∫_0^θ ℓ_j, the weights of a collocation polynomial at t_k + θ h.

        The weights are exactly 0 at θ = 0. For a collocation method they are exactly
        `b` at θ = 1, so that dense output agrees with the states at both ends of a
        step. Arguments, result and errors are the same as for `basis`.
        """
        return integrated_lagrange(self._tableau(), theta)

    def require_constraint_hypotheses(self) -> None:
        """Check that the method can integrate systems with constraints.

        By H1, H2 and H3 (the paper's section on holonomic constraints), the first and
        last stages are the states at t_k and t_{k+1}, and the multipliers are
        determined. Propagated multipliers stay bounded if |R_A(∞)| <= 1. The symmetric
        closure needs a symmetric tableau and |R_A(∞)| = 1.

        **Raises:**

        `ValueError` that names the first condition that fails.
        """
        for name, holds in self.hypotheses._asdict().items():
            if not holds:
                self._reject(f"hypothesis {_STATEMENTS[name]} fails; use LobattoIIIAB")
        size = abs(self.stability_at_infinity)
        if self.carries_multiplier and size > 1 + _UNIT_TOLERANCE:
            self._reject(
                "closure='propagated' multiplies an error in the multiplier by R_A(∞) "
                f"in each step and needs |R_A(∞)| <= 1, but it is {size:.6g}; "
                "use closure='consistent'"
            )
        if self.closure != "symmetric":
            return
        alternatives = "use closure='consistent'"
        if size <= 1 + _UNIT_TOLERANCE:
            alternatives = "use closure='propagated' or 'consistent'"
        if not math.isclose(size, 1, rel_tol=_UNIT_TOLERANCE):
            self._reject(
                f"closure='symmetric' needs |R_A(∞)| = 1, but it is {size:.6g}; "
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


class LobattoIIIAB(AbstractMethod):
    """The symmetric Lobatto IIIA-IIIB pair of order 2s - 2, for every system.

    It integrates q by Lobatto IIIA (a, b) and p by its symplectic conjugate Lobatto
    IIIB (â, b). These are the paper's methods. For s = 2 the pair is the trapezoidal
    rule with its conjugate, which is the Störmer-Verlet method for a separable
    Lagrangian.

    !!! example

        >>> method = LobattoIIIAB(stages=3)
        >>> method.order, method.orders
        (4, SimplifyingAssumptions(B=4, C=3, D=1, mixed=3))
    """

    stages: int = eqx.field(static=True)
    closure: str = eqx.field(static=True)
    chart: str = eqx.field(static=True)

    def __init__(self, stages: int, closure: str = "symmetric", chart: str = "middle"):
        """
        **Arguments:**

        - `stages`: s from 2 to 32. More stages gain no accuracy in float64, and their
            coefficients take minutes to compute.
        - `closure`: how a step determines Λ^1, the first of its s multipliers, for
            which there is no equation. `"propagated"`, the choice of the paper, uses
            Λ^s of the previous step as Λ^1. `"consistent"` uses the continuous
            multiplier at the start of the step as Λ^1. `"symmetric"` uses the
            continuous multipliers at both ends of the step, with one more unknown that
            makes the step symmetric. With `"consistent"` and `"symmetric"`, a step does
            not depend on earlier steps.
        - `chart`: the origin of the chart of a step on a Lie group. With `"middle"` a
            step with the increment ξ leads from -ξ/2 to ξ/2 in its chart, which
            keeps the symmetry of the method and, without constraints, makes the step
            symplectic. With `"start"`, the choice of the paper, a step leads from 0 to
            ξ, and is not symmetric. On a vector space both choices are the same.

        **Raises:**

        `TypeError` if `stages` is not an integer; `ValueError` if it is out of range,
        or if `closure` or `chart` is not one of the choices.
        """
        self.stages = check_stages(stages, 2, "LobattoIIIAB")
        check_choice("closure", closure, CLOSURES)
        self.closure = closure
        check_choice("chart", chart, CHARTS)
        self.chart = chart

    @classmethod
    def for_tolerance(
        cls, rtol: float, closure: str = "symmetric", chart: str = "middle"
    ) -> "LobattoIIIAB":
        """Return the method whose number of stages suits a tolerance.

        With more stages, steps can be larger, which saves time if errors must be small.
        With the returned number of stages, the error at the end of a run was most often
        within a factor of ten of `rtol`. With one or two stages more, a run takes less
        time for the same error, but the error is often far smaller than `rtol`, so that
        a larger `rtol` must be chosen. `benchmarks.adaptive_steps` measured both facts.

        **Arguments:**

        - `rtol`: the relative tolerance of `nhjax.PIDController`, or the error that is
            allowed at the end of a run.
        - `closure`, `chart`: as for `nhjax.LobattoIIIAB`.

        **Returns:** a method with 3 to 7 stages.

        **Raises:** `ValueError` unless `rtol` is a finite positive number.

        !!! example

            >>> import nhjax
            >>> [nhjax.LobattoIIIAB.for_tolerance(rtol).stages
            ...     for rtol in (1e-3, 1e-6, 1e-12)]
            [3, 4, 7]
        """
        is_number = isinstance(rtol, float | int) and not isinstance(rtol, bool)
        if not is_number or not 0 < rtol < math.inf:
            raise ValueError(
                f"LobattoIIIAB.for_tolerance: `rtol` must be a finite positive number, "
                f"got {rtol!r}."
            )
        stages = 3 + sum(rtol < limit for limit in (1e-4, 1e-7, 1e-9, 1e-11))
        return cls(stages, closure, chart)

    @property
    def order(self) -> int:
        """Return the order 2s - 2."""
        return 2 * self.stages - 2

    def _tableau(self) -> Tableau:
        return lobatto_tableau(self.stages)


class Gauss(AbstractMethod):
    """The symplectic, symmetric Gauss method of order 2s, for unconstrained systems.

    Its tableau (a, b) is its own symplectic conjugate. The stages do not include the
    ends of the step (hypotheses H1 and H3 fail), so that `integrate` raises an error
    for systems with constraints.

    !!! example

        >>> method = Gauss(stages=2)
        >>> method.order, method.hypotheses
        (4, Hypotheses(H1=False, H2=True, H3=False))
    """

    stages: int = eqx.field(static=True)
    chart: str = eqx.field(static=True)

    def __init__(self, stages: int, chart: str = "middle"):
        """
        **Arguments:**

        - `stages`: s from 1 to 32. More stages gain no accuracy in float64, and their
            coefficients take minutes to compute.
        - `chart`: as for `LobattoIIIAB`.

        **Raises:**

        `TypeError` if `stages` is not an integer; `ValueError` if it is out of range,
        or if `chart` is not one of the two choices.
        """
        self.stages = check_stages(stages, 1, "Gauss")
        check_choice("chart", chart, CHARTS)
        self.chart = chart

    @property
    def closure(self) -> None:
        """Return None, because a method without constraints needs no closure."""
        return None

    @property
    def order(self) -> int:
        """Return the order 2s."""
        return 2 * self.stages

    def _tableau(self) -> Tableau:
        return gauss_tableau(self.stages)


class PartitionedRungeKutta(AbstractMethod):
    """A Runge-Kutta tableau (a, b) for q with its symplectic conjugate for p.

    The nodes c_i = Σ_j a_ij and the symplectic conjugate â_ij = b_j (1 - a_ji / b_i)
    follow from the tableau. The float64 coefficients are taken as exact, and conditions
    on them are checked to 1e-13. (With 12 or more stages, the lowest condition that
    fails can have a defect below 1e-13; `orders` is then too high.) For systems
    with constraints the tableau must satisfy H1, H2 and H3.

    !!! example

        >>> method = PartitionedRungeKutta(a=[[0, 0], [0.5, 0.5]], b=[0.5, 0.5])
        >>> method.order, method.a_hat.tolist()
        (2, [[0.5, 0.0], [0.5, 0.0]])
    """

    stages: int = eqx.field(static=True)
    closure: str = eqx.field(static=True)
    chart: str = eqx.field(static=True)
    _coefficients: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    _weights: tuple[float, ...] = eqx.field(static=True)

    def __init__(
        self,
        a: NumpyArrayLike,
        b: NumpyArrayLike,
        closure: str = "symmetric",
        chart: str = "middle",
    ):
        """
        **Arguments:**

        - `a`: the coefficients a_ij, shape (s, s); they cannot be traced.
        - `b`: the weights b_j, shape (s,), which are not zero and sum to 1.
        - `closure`, `chart`: as for `LobattoIIIAB`.

        **Raises:**

        `ValueError` if a shape is wrong, an entry is not finite, a weight is zero, the
        weights do not sum to 1, or `closure` or `chart` is not one of the choices.
        """
        a = np.asarray(a, dtype=np.float64)
        b = np.asarray(b, dtype=np.float64)
        if b.ndim != 1 or b.size == 0:
            raise ValueError(f"b must have shape (s,) with s >= 1, got {b.shape}")
        if a.shape != (b.size, b.size):
            raise ValueError(
                f"a must have shape {(b.size, b.size)} to match b, got {a.shape}"
            )
        for name, array in (("a", a), ("b", b)):
            if not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite, got {array.tolist()}")
        if (b == 0).any():
            raise ValueError(
                f"every weight in b must be nonzero, got {b.tolist()}: the symplectic "
                "conjugate b_j (1 - a_ji / b_i) would not exist"
            )
        if abs(b.sum() - 1) > 1e-13:
            raise ValueError(f"b must sum to 1, got {float(b.sum())!r}")
        self.stages = b.size
        check_choice("closure", closure, CLOSURES)
        self.closure = closure
        check_choice("chart", chart, CHARTS)
        self.chart = chart
        self._coefficients = tuple(tuple(row) for row in a.tolist())
        self._weights = tuple(b.tolist())

    def _tableau(self) -> Tableau:
        return user_tableau(self._coefficients, self._weights)


@lru_cache(maxsize=128)
def multiplier_closure_weights(t: Tableau, symmetric: bool) -> ClosureWeights:
    """Compute the closure weights of a tableau that satisfies H1, H2 and H3.

    The propagated and the consistent closure have Λ^1 = λ_k and y = (Λ^2, ..., Λ^s), as
    in the equations of the paper. The symmetric closure has y = (ν, Λ^2, ...,
    Λ^{s-1}), Λ^1 = λ_k + ν and Λ^s = λ_{k+1} + σ ν. A step back exchanges the two ends
    and maps ν to σ ν, so that it retraces the step if σ = ±1. Of these two
    values, only σ = -R_A(∞) makes A_{2:,:} E invertible, because the solutions of
    Σ_j a_ij Λ^j = 0, i >= 2, have Λ^s = R_A(∞) Λ^1.

    **Arguments:**

    - `t`: the tableau.
    - `symmetric`: whether to use the symmetric closure, which needs R_A(∞) = ±1.

    **Returns:**

    A `ClosureWeights`; equal calls return the same object.

    !!! example

        >>> from nhjax._method._tableau import lobatto_tableau
        >>> multiplier_closure_weights(lobatto_tableau(3), symmetric=True).E.tolist()
        [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]
    """
    s = t.stages
    e = context().matrix(s, s - 1)
    end = [context().mpf(0)] * s
    if symmetric:
        e[0, 0] = context().one
        e[s - 1, 0] = context().mpf(-round(_order_conditions.stability_at_infinity(t)))
        end[s - 1] = context().one
        for i in range(1, s - 1):
            e[i, i] = context().one
    else:
        for i in range(1, s):
            e[i, i - 1] = context().one
    # Both responses are used only in an approximate Jacobian: float64 suffices.
    weights, last = to_float64(e), to_float64(end)
    response = -np.linalg.solve(t.a[1:] @ weights, t.a[1:] @ last)
    return ClosureWeights(
        E=weights,
        start=to_float64([context().one] + [context().mpf(0)] * (s - 1)),
        end=last,
        response=to_float64(list(response)),
        stage_response=to_float64(list(t.a_hat @ (weights @ response + last))),
    )


def check_stages(stages: int, minimum: int, method: str) -> int:
    """Return a number of stages as an int, or raise an error if it is out of range.

    **Arguments:**

    - `stages`: the number of stages s.
    - `minimum`: the smallest number of stages of the method.
    - `method`: the name of the method, for the error message.

    **Raises:**

    `TypeError` if `stages` is not an integer; `ValueError` if it is less than `minimum`
    or more than `MAX_STAGES`.
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
    if count > MAX_STAGES:
        raise ValueError(
            f"stages of {method} must be <= {MAX_STAGES}, got {count}: more stages "
            "gain no accuracy in float64, and their coefficients take minutes to "
            "compute. Take smaller steps"
        )
    return count
