"""The coefficients of methods to the last bit, and the orders found from them.

Identities are checked in exact rational arithmetic on the float64 coefficients, so that
the only error in them is the rounding of the coefficients themselves.
"""

import math
from fractions import Fraction

import mpmath
import numpy as np
import pytest

from nhjax._method import AbstractMethod, Gauss, LobattoIIIAB, PartitionedRungeKutta
from nhjax._method._tableau import gauss_tableau, lobatto_tableau
from support.tableaux import (
    assert_holds_exactly_up_to,
    b_defect,
    c_defect,
    d_defect,
    exact,
    EXPLICIT_EULER,
    IMPLICIT_EULER,
    is_symplectic_pair,
    mixed_defect,
    RADAU_IIA,
    RK4,
    STAGES,
    TWO_ULP,
)


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
def test_method_nodes_are_the_zeros_rounded_to_nearest(s: int):
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
def test_lobatto_coefficients_at_the_ends_are_exact(s: int):
    method = LobattoIIIAB(s)
    assert not method.a[0].any()
    assert method.a[-1].tolist() == method.b.tolist()
    assert not method.a_hat[:, -1].any()
    assert method.a_hat[:, 0].tolist() == [method.b[0]] * s
    assert method.b.tolist() == method.b[::-1].tolist()


@pytest.mark.parametrize("method", [LobattoIIIAB(5), Gauss(4), RK4])
def test_method_coefficients_are_read_only_float64(method: AbstractMethod):
    s = method.stages
    shapes = [(s, s), (s,), (s,), (s, s)]
    arrays = [method.a, method.b, method.c, method.a_hat]
    for array, shape in zip(arrays, shapes, strict=True):
        assert (array.dtype, array.shape) == (np.float64, shape)
        assert not array.flags.writeable


def test_method_coefficients_do_not_depend_on_the_users_mpmath_context():
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
def test_method_pair_is_symplectic_to_two_ulp(s: int, kind: type):
    method = kind(s)
    a, a_hat, b = exact(method.a), exact(method.a_hat), exact(method.b)
    for i in range(s):
        for j in range(s):
            defect = b[i] * a_hat[i][j] + b[j] * a[j][i] - b[i] * b[j]
            assert abs(defect) <= TWO_ULP


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_method_tableau_is_symmetric_to_two_ulp(s: int, kind: type):
    method = kind(s)
    a, b = exact(method.a), exact(method.b)
    for i in range(s):
        for j in range(s):
            assert abs(a[s - 1 - i][s - 1 - j] + a[i][j] - b[j]) <= TWO_ULP
    assert method.is_symmetric


def test_symplecticity_check_of_other_pairs_detects_defects():
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
def test_tableau_rounded_to_float64_keeps_its_properties(s: int):
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


def test_tableau_of_classical_methods_has_known_orders():
    assert RK4.orders == (4, 1, 1, 1)
    assert RK4.order == 4
    assert RADAU_IIA.orders[:3] == (3, 2, 1)
    assert IMPLICIT_EULER.order == EXPLICIT_EULER.order == 1
    assert not RK4.is_symmetric
