"""Methods: coefficients, order conditions, hypotheses, closures, dense-output basis.

Identities are checked in exact rational arithmetic on the float64 coefficients, so that
the only error in them is the rounding of the coefficients themselves.
"""

import math
from collections.abc import Callable
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from nhjax._method import AbstractMethod, Gauss, LobattoIIIAB, PartitionedRungeKutta
from nhjax._method._conditions import is_symplectic_pair
from nhjax._method._tableau import gauss_tableau, lobatto_tableau


STAGES = range(2, 9)
TWO_ULP = Fraction(2, 2**52)
CLOSURES = ("propagated", "consistent", "symmetric")

RK4 = PartitionedRungeKutta(
    [[0, 0, 0, 0], [0.5, 0, 0, 0], [0, 0.5, 0, 0], [0, 0, 1, 0]],
    [1 / 6, 1 / 3, 1 / 3, 1 / 6],
)
IMPLICIT_EULER = PartitionedRungeKutta([[1.0]], [1.0])
EXPLICIT_EULER = PartitionedRungeKutta([[0.0]], [1.0])
RADAU_IIA = PartitionedRungeKutta([[5 / 12, -1 / 12], [0.75, 0.25]], [0.75, 0.25])


def exact(array: np.ndarray) -> list:
    """The entries of a float64 array as fractions, nested as the array is."""
    return [
        exact(entry) if isinstance(entry, np.ndarray) else Fraction(float(entry))
        for entry in array
    ]


def matmul(x: list, y: list) -> list:
    columns = list(zip(*y, strict=True))
    return [[sum(p * q for p, q in zip(r, c, strict=True)) for c in columns] for r in x]


def b_defect(b: list, c: list, k: int) -> Fraction:
    return abs(
        sum(w * x ** (k - 1) for w, x in zip(b, c, strict=True)) - Fraction(1, k)
    )


def c_defect(a: list, c: list, k: int) -> Fraction:
    powers = [[x ** (k - 1)] for x in c]
    return max(
        abs(left[0] - x**k / k) for left, x in zip(matmul(a, powers), c, strict=True)
    )


def d_defect(a: list, b: list, c: list, k: int) -> Fraction:
    weighted = [[w * x ** (k - 1) for w, x in zip(b, c, strict=True)]]
    (sums,) = matmul(weighted, a)
    return max(
        abs(left - w * (1 - x**k) / k) for left, w, x in zip(sums, b, c, strict=True)
    )


def mixed_defect(a: list, a_hat: list, c: list, k: int) -> Fraction:
    powers = [[x ** (k - 2)] for x in c]
    sums = matmul(a, matmul(a_hat, powers))
    return max(
        abs(left[0] - x**k / (k * (k - 1))) for left, x in zip(sums, c, strict=True)
    )


def assert_holds_exactly_up_to(
    defect: Callable[[int], Fraction], order: int, first: int = 1
) -> None:
    for k in range(first, order + 1):
        assert defect(k) <= TWO_ULP, k
    assert defect(order + 1) > 2**10 * TWO_ULP


# --- coefficients ---------------------------------------------------------------------


def test_lobatto_of_two_stages_is_the_trapezoidal_rule_with_its_conjugate():
    method = LobattoIIIAB(2)
    assert method.a.tolist() == [[0, 0], [0.5, 0.5]]
    assert method.a_hat.tolist() == [[0.5, 0], [0.5, 0]]
    assert method.b.tolist() == [0.5, 0.5]
    assert method.c.tolist() == [0, 1]


def test_lobatto_of_three_stages_is_simpsons_rule_with_its_conjugate():
    method = LobattoIIIAB(3)
    sixth, third = 1 / 6, 1 / 3
    assert method.a.tolist() == [
        [0, 0, 0],
        [5 / 24, third, -1 / 24],
        [sixth, 2 / 3, sixth],
    ]
    assert method.a_hat.tolist() == [
        [sixth, -sixth, 0],
        [sixth, third, 0],
        [sixth, 5 / 6, 0],
    ]
    assert method.b.tolist() == [sixth, 2 / 3, sixth]
    assert method.c.tolist() == [0, 0.5, 1]


def test_lobatto_of_four_stages_has_the_closed_form_to_the_last_bit():
    with mpmath.workdps(50):
        r = mpmath.sqrt(5)
        a = [
            [0, 0, 0, 0],
            [(11 + r) / 120, (25 - r) / 120, (25 - 13 * r) / 120, (r - 1) / 120],
            [(11 - r) / 120, (25 + 13 * r) / 120, (25 + r) / 120, (-1 - r) / 120],
            [mpmath.mpf(1) / 12, mpmath.mpf(5) / 12, mpmath.mpf(5) / 12, 1 / 12],
        ]
        expected = [[float(x) for x in row] for row in a]
        nodes = [0, float((1 - 1 / r) / 2), float((1 + 1 / r) / 2), 1]
    method = LobattoIIIAB(4)
    assert method.a.tolist() == expected
    assert method.b.tolist() == expected[-1]
    assert method.c.tolist() == nodes


def test_gauss_has_the_closed_forms_to_the_last_bit():
    with mpmath.workdps(50):
        r, w = mpmath.sqrt(3), mpmath.sqrt(15)
        n = [mpmath.mpf(5), mpmath.mpf(2), mpmath.mpf(4)]
        two = [[1 / mpmath.mpf(4), 1 / mpmath.mpf(4) - r / 6]]
        two.append([1 / mpmath.mpf(4) + r / 6, 1 / mpmath.mpf(4)])
        three = [
            [n[0] / 36, n[1] / 9 - w / 15, n[0] / 36 - w / 30],
            [n[0] / 36 + w / 24, n[1] / 9, n[0] / 36 - w / 24],
            [n[0] / 36 + w / 30, n[1] / 9 + w / 15, n[0] / 36],
        ]
        expected = [[[float(x) for x in row] for row in a] for a in (two, three)]
        nodes = [float((1 - r / 3) / 2), float((1 + r / 3) / 2)]
    assert (Gauss(1).a.tolist(), Gauss(1).b.tolist()) == ([[0.5]], [1.0])
    assert Gauss(1).c.tolist() == [0.5]
    assert Gauss(2).a.tolist() == expected[0]
    assert Gauss(2).c.tolist() == nodes
    assert Gauss(3).a.tolist() == expected[1]
    assert Gauss(3).b.tolist() == [5 / 18, 4 / 9, 5 / 18]


def legendre_and_slope(n: int, x: Fraction) -> tuple[Fraction, Fraction]:
    p, q, dp, dq = Fraction(1), x, Fraction(0), Fraction(1)
    for k in range(1, n):
        p, q = q, ((2 * k + 1) * x * q - k * p) / (k + 1)
        dp, dq = dq, dp + (2 * k + 1) * p
    return q, dq


@pytest.mark.parametrize("s", range(2, 13))
def test_nodes_are_the_zeros_rounded_to_nearest(s: int):
    # The polynomial changes sign between the midpoints to the neighbouring floats.
    def changes_sign(node: float, degree: int, derivative: bool) -> bool:
        ends = [
            (Fraction(node) + Fraction(math.nextafter(node, d))) / 2 for d in (0, 1)
        ]
        low, high = (
            legendre_and_slope(degree, 2 * end - 1)[int(derivative)] for end in ends
        )
        return low * high < 0

    lobatto, gauss = LobattoIIIAB(s).c.tolist(), Gauss(s).c.tolist()
    assert (lobatto[0], lobatto[-1]) == (0, 1)
    assert all(changes_sign(node, s - 1, True) for node in lobatto[1:-1])
    assert all(changes_sign(node, s, False) for node in gauss)
    assert np.all(np.diff(lobatto) > 0)
    assert np.all(np.diff(gauss) > 0)


@pytest.mark.parametrize("s", range(2, 13))
def test_lobatto_ends_are_exact(s: int):
    method = LobattoIIIAB(s)
    assert not method.a[0].any()
    assert method.a[-1].tolist() == method.b.tolist()
    assert not method.a_hat[:, -1].any()
    assert method.a_hat[:, 0].tolist() == [method.b[0]] * s
    assert method.b.tolist() == method.b[::-1].tolist()


@pytest.mark.parametrize("method", [LobattoIIIAB(5), Gauss(4), RK4])
def test_coefficients_are_read_only_float64(method: AbstractMethod):
    s = method.stages
    shapes = [(s, s), (s,), (s,), (s, s)]
    arrays = [method.a, method.b, method.c, method.a_hat]
    for array, shape in zip(arrays, shapes, strict=True):
        assert (array.dtype, array.shape) == (np.float64, shape)
        assert not array.flags.writeable


def test_precision_does_not_depend_on_the_users_context():
    lobatto_tableau.cache_clear()
    with mpmath.workdps(5):
        coarse = LobattoIIIAB(6).a.tolist()
    lobatto_tableau.cache_clear()
    assert LobattoIIIAB(6).a.tolist() == coarse
    assert LobattoIIIAB(6).orders.B == 10


# --- order conditions -----------------------------------------------------------------


@pytest.mark.parametrize("s", STAGES)
def test_lobatto_iiia_satisfies_its_simplifying_assumptions_to_two_ulp(s: int):
    method = LobattoIIIAB(s)
    a, b, c = exact(method.a), exact(method.b), exact(method.c)
    assert_holds_exactly_up_to(lambda k: b_defect(b, c, k), 2 * s - 2)
    assert_holds_exactly_up_to(lambda k: c_defect(a, c, k), s)
    assert_holds_exactly_up_to(lambda k: d_defect(a, b, c, k), s - 2)


@pytest.mark.parametrize("s", STAGES)
def test_lobatto_iiib_satisfies_its_simplifying_assumptions_to_two_ulp(s: int):
    method = LobattoIIIAB(s)
    a_hat, b, c = exact(method.a_hat), exact(method.b), exact(method.c)
    assert_holds_exactly_up_to(lambda k: c_defect(a_hat, c, k), s - 2)
    assert_holds_exactly_up_to(lambda k: d_defect(a_hat, b, c, k), s)


@pytest.mark.parametrize("s", STAGES)
def test_lobatto_pair_satisfies_the_mixed_assumption_to_two_ulp(s: int):
    method = LobattoIIIAB(s)
    a, a_hat, c = exact(method.a), exact(method.a_hat), exact(method.c)
    assert_holds_exactly_up_to(lambda k: mixed_defect(a, a_hat, c, k), s, first=2)


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_the_pair_is_symplectic_to_two_ulp(s: int, kind: type):
    method = kind(s)
    a, a_hat, b = exact(method.a), exact(method.a_hat), exact(method.b)
    for i in range(s):
        for j in range(s):
            defect = b[i] * a_hat[i][j] + b[j] * a[j][i] - b[i] * b[j]
            assert abs(defect) <= TWO_ULP


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_the_tableau_is_symmetric_to_two_ulp(s: int, kind: type):
    method = kind(s)
    a, b = exact(method.a), exact(method.b)
    for i in range(s):
        for j in range(s):
            assert abs(a[s - 1 - i][s - 1 - j] + a[i][j] - b[j]) <= TWO_ULP
    assert method.is_symmetric


def test_symplecticity_of_a_pair_is_recognised():
    gauss, lobatto = gauss_tableau(3), lobatto_tableau(3)
    assert is_symplectic_pair(gauss, gauss.mp_a)
    assert is_symplectic_pair(lobatto, lobatto.mp_a_hat)
    assert not is_symplectic_pair(lobatto, lobatto.mp_a)


@pytest.mark.parametrize("s", range(2, 13))
def test_lobatto_reports_its_orders(s: int):
    method = LobattoIIIAB(s)
    assert method.orders == (2 * s - 2, s, s - 2, s)
    assert method.orders._fields == ("B", "C", "D", "mixed")
    assert method.order == 2 * s - 2


@pytest.mark.parametrize("s", range(1, 13))
def test_gauss_reports_its_orders(s: int):
    method = Gauss(s)
    assert method.orders == (2 * s, s, s, s)
    assert method.order == 2 * s


@pytest.mark.parametrize("s", range(2, 11))
def test_a_tableau_rounded_to_float64_keeps_its_properties(s: int):
    built_in = LobattoIIIAB(s)
    method = PartitionedRungeKutta(built_in.a, built_in.b)
    assert method.orders == built_in.orders
    assert method.order == built_in.order
    assert method.hypotheses == built_in.hypotheses
    assert method.is_symmetric
    assert method.stability_at_infinity == pytest.approx((-1) ** (s - 1), abs=1e-12)
    np.testing.assert_allclose(method.c, built_in.c, rtol=0, atol=2**-52)
    np.testing.assert_allclose(method.a_hat, built_in.a_hat, rtol=0, atol=2**-51)
    np.testing.assert_array_equal(method.closure_weights.E, built_in.closure_weights.E)


def test_orders_of_classical_tableaux():
    assert RK4.orders == (4, 1, 1, 1)
    assert RK4.order == 2
    assert RADAU_IIA.orders[:3] == (3, 2, 1)
    assert IMPLICIT_EULER.order == EXPLICIT_EULER.order == 1
    assert not RK4.is_symmetric


# --- hypotheses and stability ---------------------------------------------------------


@pytest.mark.parametrize("s", STAGES)
def test_lobatto_satisfies_the_hypotheses_of_constrained_systems(s: int):
    method = LobattoIIIAB(s)
    assert method.hypotheses == (True, True, True)
    assert method.hypotheses._fields == ("H1", "H2", "H3")
    # H1' and H2', those of the conjugate.
    assert not method.a_hat[:, -1].any()
    assert (method.a_hat[:, 0] == method.b[0]).all()


def test_hypotheses_of_other_tableaux():
    assert Gauss(1).hypotheses == (False, True, False)
    assert Gauss(3).hypotheses == (False, True, False)
    assert RADAU_IIA.hypotheses == (False, True, True)
    assert RK4.hypotheses == (True, False, False)


@pytest.mark.parametrize("s", range(2, 13))
def test_stability_at_infinity_of_lobatto_and_gauss(s: int):
    assert LobattoIIIAB(s).stability_at_infinity == (-1) ** (s - 1)
    assert Gauss(s).stability_at_infinity == (-1) ** s


def test_stability_at_infinity_of_classical_tableaux():
    assert RK4.stability_at_infinity == math.inf
    assert EXPLICIT_EULER.stability_at_infinity == math.inf
    assert IMPLICIT_EULER.stability_at_infinity == 0
    assert RADAU_IIA.stability_at_infinity == 0
    # The implicit midpoint rule twice: a common factor cancels in R.
    twice = PartitionedRungeKutta([[0.5, 0], [0, 0.5]], [0.5, 0.5])
    assert twice.stability_at_infinity == -1


@pytest.mark.parametrize("s", STAGES)
def test_order_of_the_multiplier(s: int):
    assert LobattoIIIAB(s, "propagated").multiplier_order == (
        s if s % 2 == 0 else s - 1
    )
    assert LobattoIIIAB(s, "consistent").multiplier_order == 2 * s - 2
    assert LobattoIIIAB(s, "symmetric").multiplier_order == 2 * s - 2


# --- closures -------------------------------------------------------------------------


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("multiplier", ["propagated", "consistent"])
def test_carried_closures_give_the_first_multiplier_and_solve_for_the_rest(
    s: int, multiplier: str
):
    closure = LobattoIIIAB(s, multiplier).closure_weights
    np.testing.assert_array_equal(closure.E, np.eye(s)[:, 1:])
    np.testing.assert_array_equal(closure.start, np.eye(s)[0])
    np.testing.assert_array_equal(closure.end, np.zeros(s))


@pytest.mark.parametrize("s", STAGES)
def test_symmetric_closure_shifts_both_ends_by_one_unknown(s: int):
    closure = LobattoIIIAB(s, "symmetric").closure_weights
    expected = np.eye(s)[:, : s - 1]
    expected[-1, 0] = (-1) ** s
    np.testing.assert_array_equal(closure.E, expected)
    np.testing.assert_array_equal(closure.start, np.eye(s)[0])
    np.testing.assert_array_equal(closure.end, np.eye(s)[-1])


@pytest.mark.parametrize("s", STAGES)
def test_symmetric_closure_is_its_own_reverse(s: int):
    # Reversed in time, the unknowns are σν and the inner multipliers in reverse order.
    closure = LobattoIIIAB(s, "symmetric").closure_weights
    reverse = np.zeros((s - 1, s - 1))
    reverse[0, 0] = (-1) ** s
    reverse[1:, 1:] = np.eye(s - 2)[::-1]
    np.testing.assert_array_equal(closure.E[::-1], closure.E @ reverse)
    np.testing.assert_array_equal(closure.start[::-1], closure.end)


@pytest.mark.parametrize(
    ("s", "symmetric", "carried"),
    [(2, 1, 1), (3, 3.4, 6.9), (4, 7.1, 14), (5, 11, 22), (6, 16, 32)],
)
def test_symmetric_closure_is_the_better_conditioned(
    s: int, symmetric: float, carried: float
):
    for multiplier, expected in (("symmetric", symmetric), ("propagated", carried)):
        method = LobattoIIIAB(s, multiplier)
        condition = np.linalg.cond(method.a[1:] @ method.closure_weights.E)
        assert condition == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("s", STAGES)
def test_the_other_sign_of_the_symmetric_closure_is_singular(s: int):
    # The solution of Σ_j a_ij Λ^j = 0, i >= 2, has Λ^s = R_A(∞) Λ^1: a closure of that
    # sign contains it and cannot determine the multipliers.
    method = LobattoIIIAB(s)
    other = method.closure_weights.E.copy()
    other[-1, 0] *= -1
    smallest = np.linalg.svd(method.a[1:] @ other, compute_uv=False)[-1]
    assert smallest < 1e-15
    assert (
        np.linalg.svd(method.a[1:] @ method.closure_weights.E, compute_uv=False)[-1]
        > 1e-2
    )


@pytest.mark.parametrize("s", STAGES)
def test_a_multiplier_error_is_orthogonal_to_smooth_reactions(s: int):
    # Why an error O(h^s) of the multipliers does not lower the order 2s - 2.
    method = LobattoIIIAB(s)
    inner = np.linalg.solve(method.a[1:, 1:], -method.a[1:, 0])
    w = np.concatenate([[1.0], inner])
    moments = [np.sum(method.b * method.c**l * w) for l in range(s)]
    np.testing.assert_allclose(moments[:-1], 0, atol=1e-15)
    assert abs(moments[-1]) > 1e-6


@pytest.mark.parametrize("multiplier", CLOSURES)
def test_closure_is_cached_hashable_and_read_only(multiplier: str):
    closure = LobattoIIIAB(4, multiplier).closure_weights
    assert closure is LobattoIIIAB(4, multiplier).closure_weights
    assert hash(closure) == hash(LobattoIIIAB(4, multiplier).closure_weights)
    for array in (closure.E, closure.start, closure.end):
        assert array.dtype == np.float64
        assert not array.flags.writeable


# --- refusals -------------------------------------------------------------------------


def test_constraints_are_refused_naming_the_first_hypothesis_that_fails():
    lobatto = LobattoIIIAB(3)
    singular = PartitionedRungeKutta([[0, 0], [1, 0]], [1 - 2**-40, 2**-40])
    loose = PartitionedRungeKutta([[0, 0], [0.25, 0.25]], [0.5, 0.5])
    for method, reason in (
        (
            Gauss(2),
            r"^Gauss\(stages=2\) cannot integrate a constrained system: hypothesis H1 "
            r"\(a_1j = 0, first stage at t_k\) fails; use LobattoIIIAB$",
        ),
        (singular, r"^PartitionedRungeKutta\(stages=2\) .* hypothesis H2 .* fails"),
        (loose, r"hypothesis H3 \(a_sj = b_j, last stage at t_\{k\+1\}\) fails"),
    ):
        with pytest.raises(ValueError, match=reason):
            method.require_constraint_hypotheses()
        with pytest.raises(ValueError, match=reason):
            _ = method.closure_weights
        with pytest.raises(ValueError, match=reason):
            _ = method.multiplier_order
    lobatto.require_constraint_hypotheses()


@pytest.mark.parametrize("b", [(0.4, 0.6), (0.6, 0.4)])
def test_symmetric_multiplier_is_refused_without_unit_stability_at_infinity(
    b: tuple[float, float],
):
    method = PartitionedRungeKutta([[0, 0], b], b)
    assert method.stability_at_infinity == pytest.approx(-b[0] / b[1])
    with pytest.raises(ValueError, match=r"needs \|R_A\(∞\)\| = 1, and it is"):
        method.require_constraint_hypotheses()
    PartitionedRungeKutta([[0, 0], b], b, "consistent").require_constraint_hypotheses()


def test_symmetric_multiplier_is_refused_for_an_asymmetric_tableau():
    b = [1 / 6, 2 / 3, 1 / 6]
    method = PartitionedRungeKutta([[0, 0, 0], [0.2, 0.4, 0], b], b)
    assert method.stability_at_infinity == pytest.approx(1)
    with pytest.raises(ValueError, match="needs a symmetric tableau"):
        method.require_constraint_hypotheses()


def test_propagated_multiplier_is_refused_where_its_errors_grow():
    damped = PartitionedRungeKutta([[0, 0], [0.4, 0.6]], [0.4, 0.6], "propagated")
    grows = PartitionedRungeKutta([[0, 0], [0.6, 0.4]], [0.6, 0.4], "propagated")
    assert damped.multiplier_order == damped.orders.C
    with pytest.raises(ValueError, match=r"needs \|R_A\(∞\)\| <= 1.* it is 1\.5;"):
        grows.require_constraint_hypotheses()


@pytest.mark.parametrize("stages", [2.0, "3", None, True])
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_stages_must_be_an_int(kind: type, stages: object):
    message = f"^stages of {kind.__name__} must be an int, got {stages!r} of type "
    with pytest.raises(TypeError, match=message):
        kind(stages)


@pytest.mark.parametrize(("kind", "minimum"), [(LobattoIIIAB, 2), (Gauss, 1)])
def test_too_few_stages_are_refused(kind: type, minimum: int):
    for stages in (minimum - 1, -3):
        message = f"^stages of {kind.__name__} must be >= {minimum}, got {stages}$"
        with pytest.raises(ValueError, match=message):
            kind(stages)
    assert kind(np.int64(minimum)) == kind(minimum)
    assert type(kind(np.int64(minimum)).stages) is int


def test_an_unknown_multiplier_is_refused_with_the_choices():
    message = (
        "^multiplier must be one of 'propagated', 'consistent', 'symmetric', got 'x'$"
    )
    with pytest.raises(ValueError, match=message):
        LobattoIIIAB(3, closure="x")
    with pytest.raises(ValueError, match=message):
        PartitionedRungeKutta([[0.5]], [1.0], closure="x")


@pytest.mark.parametrize(
    ("a", "b", "message"),
    [
        ([[0.5]], [0.5, 0.5], r"^a must have shape \(2, 2\) to match b, got \(1, 1\)$"),
        ([0.5, 0.5], [0.5, 0.5], r"^a must have shape \(2, 2\) .* got \(2,\)$"),
        ([[0.5]], 1.0, r"^b must have shape \(s,\) with s >= 1, got \(\)$"),
        ([], [], r"^b must have shape \(s,\) with s >= 1, got \(0,\)$"),
        ([[math.nan]], [1.0], r"^a must be finite, got \[\[nan\]\]$"),
        ([[0.5]], [math.inf], r"^b must be finite, got \[inf\]$"),
        (np.eye(2), [1.0, 0.0], r"^b must have no zero weight, got \[1\.0, 0\.0\]"),
        (np.eye(2), [0.5, 0.6], r"^b must sum to 1, got 1\.1$"),
    ],
)
def test_malformed_tableaux_are_refused(a: list, b: list, message: str):
    with pytest.raises(ValueError, match=message):
        PartitionedRungeKutta(a, b)


# --- the basis of dense output --------------------------------------------------------


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_basis_reproduces_the_coefficients_at_the_nodes(s: int, kind: type):
    method = kind(s)
    # Rounding the node alone moves ℓ_j by up to ℓ_j' 2^-53: over 1e-15 at the outer
    # nodes of Gauss, where ℓ_j is steep.
    slopes = jax.vmap(jax.jacfwd(method.basis))(jnp.asarray(method.c))
    bound = 1e-15 + 2.0**-53 * np.abs(slopes)
    assert (np.abs(method.basis(method.c) - np.eye(s)) <= bound).all()
    np.testing.assert_allclose(
        method.integrated_basis(method.c), method.a, rtol=0, atol=2e-16
    )


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_integrated_basis_is_exact_at_both_ends(s: int, kind: type):
    method = kind(s)
    assert not np.asarray(method.integrated_basis(0)).any()
    assert method.integrated_basis(1).tolist() == method.b.tolist()


@pytest.mark.parametrize(
    "method", [LobattoIIIAB(2), LobattoIIIAB(5), Gauss(1), RADAU_IIA]
)
def test_basis_is_the_derivative_of_the_integrated_basis(method: AbstractMethod):
    theta = jnp.linspace(-0.25, 1.5, 8)
    slopes = jax.vmap(jax.jacfwd(method.integrated_basis))(theta)
    np.testing.assert_allclose(slopes, method.basis(theta), rtol=1e-12, atol=1e-13)


def test_basis_integrates_polynomials_beyond_the_step():
    method = LobattoIIIAB(6)
    values = 1 + method.c - 3 * method.c**5
    theta = jnp.array([-0.5, 0.3, 2.0])
    np.testing.assert_allclose(
        method.integrated_basis(theta) @ values,
        theta + theta**2 / 2 - theta**6 / 2,
        rtol=1e-12,
    )


def test_basis_of_one_stage_is_constant():
    assert Gauss(1).basis(0.3).tolist() == [1.0]
    assert Gauss(1).integrated_basis(0.25).tolist() == [0.25]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_basis_follows_the_dtype_and_shape_of_theta(
    dtype: type, shape: tuple[int, ...]
):
    method = LobattoIIIAB(4)
    theta = jnp.full(shape, 0.3, dtype)
    tolerance = 4 * float(jnp.finfo(dtype).eps)
    for function in (method.basis, method.integrated_basis):
        value = jax.jit(function)(theta)
        assert (value.dtype, value.shape) == (dtype, (*shape, 4))
        reference = np.broadcast_to(function(0.3), value.shape)
        np.testing.assert_allclose(value, reference, rtol=0, atol=tolerance)


def test_basis_of_an_integer_is_floating():
    assert LobattoIIIAB(3).basis(1).dtype == jnp.float64
    assert LobattoIIIAB(2).integrated_basis(jnp.array(1)).tolist() == [0.5, 0.5]


def test_basis_needs_distinct_nodes():
    message = r"c = \[0\.0, 0\.5, 0\.5, 1\.0\] has equal entries c_2 and c_3"
    with pytest.raises(ValueError, match=message):
        RK4.basis(0.5)


# --- methods as values ----------------------------------------------------------------


def test_methods_compare_and_hash_by_value():
    lobatto = LobattoIIIAB(3)
    user = PartitionedRungeKutta(lobatto.a, lobatto.b)
    assert lobatto == LobattoIIIAB(stages=3, closure="symmetric")
    assert hash(lobatto) == hash(LobattoIIIAB(3))
    assert user == PartitionedRungeKutta(lobatto.a.tolist(), lobatto.b.tolist())
    assert hash(user) == hash(PartitionedRungeKutta(lobatto.a, lobatto.b))
    for other in (LobattoIIIAB(4), LobattoIIIAB(3, "consistent"), user, Gauss(3)):
        assert lobatto != other


@pytest.mark.parametrize("method", [LobattoIIIAB(3), Gauss(2), RK4])
def test_methods_have_no_leaves(method: AbstractMethod):
    assert jax.tree.leaves(method) == []


def test_equal_methods_share_one_compilation():
    traces = []

    def weights(method: AbstractMethod, x: jax.Array) -> jax.Array:
        traces.append(method)
        return x * jnp.asarray(method.b, x.dtype)

    jitted = jax.jit(weights, static_argnums=0)
    x = jnp.ones(3)
    np.testing.assert_array_equal(jitted(LobattoIIIAB(3), x), LobattoIIIAB(3).b)
    jitted(LobattoIIIAB(3), x)
    assert len(traces) == 1
    jitted(Gauss(3), x)
    assert len(traces) == 2
