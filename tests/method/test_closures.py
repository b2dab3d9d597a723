"""Hypotheses of constrained systems, multiplier closures, and invalid methods."""

import math

import numpy as np
import pytest

from nhjax._method import Gauss, LobattoIIIAB, PartitionedRungeKutta
from support.tableaux import (
    CLOSURES,
    EXPLICIT_EULER,
    IMPLICIT_EULER,
    RADAU_IIA,
    RK4,
    STAGES,
)


# --- hypotheses and stability ---------------------------------------------------------


@pytest.mark.parametrize("s", STAGES)
def test_lobatto_satisfies_the_hypotheses_of_constrained_systems(s: int):
    method = LobattoIIIAB(s)
    assert method.hypotheses == (True, True, True)
    assert method.hypotheses._fields == ("H1", "H2", "H3")
    # H1' and H2' are the hypotheses of the conjugate.
    assert not method.a_hat[:, -1].any()
    assert (method.a_hat[:, 0] == method.b[0]).all()


def test_hypotheses_of_other_tableaux_fail_as_expected():
    assert Gauss(1).hypotheses == (False, True, False)
    assert Gauss(3).hypotheses == (False, True, False)
    assert RADAU_IIA.hypotheses == (False, True, True)
    assert RK4.hypotheses == (True, False, False)


@pytest.mark.parametrize("s", range(2, 13))
def test_stability_at_infinity_of_lobatto_and_gauss_is_plus_minus_one(s: int):
    assert LobattoIIIAB(s).stability_at_infinity == (-1) ** (s - 1)
    assert Gauss(s).stability_at_infinity == (-1) ** s


def test_stability_at_infinity_of_classical_tableaux_is_exact():
    assert RK4.stability_at_infinity == math.inf
    assert EXPLICIT_EULER.stability_at_infinity == math.inf
    assert IMPLICIT_EULER.stability_at_infinity == 0
    assert RADAU_IIA.stability_at_infinity == 0
    # The implicit midpoint rule twice: a common factor cancels in R.
    twice = PartitionedRungeKutta([[0.5, 0], [0, 0.5]], [0.5, 0.5])
    assert twice.stability_at_infinity == -1


@pytest.mark.parametrize("s", STAGES)
def test_multiplier_order_of_each_closure_equals_theory(s: int):
    assert LobattoIIIAB(s, "propagated").multiplier_order == (
        s if s % 2 == 0 else s - 1
    )
    assert LobattoIIIAB(s, "consistent").multiplier_order == 2 * s - 2
    assert LobattoIIIAB(s, "symmetric").multiplier_order == 2 * s - 2


# --- closures -------------------------------------------------------------------------


@pytest.mark.parametrize("s", STAGES)
@pytest.mark.parametrize("multiplier", ["propagated", "consistent"])
def test_propagated_and_consistent_closures_fix_the_first_multiplier(
    s: int, multiplier: str
):
    closure = LobattoIIIAB(s, multiplier).closure_weights
    np.testing.assert_array_equal(closure.E, np.eye(s)[:, 1:])
    np.testing.assert_array_equal(closure.start, np.eye(s)[0])
    np.testing.assert_array_equal(closure.end, np.zeros(s))


@pytest.mark.parametrize("s", STAGES)
def test_symmetric_closure_weights_shift_both_ends(s: int):
    closure = LobattoIIIAB(s, "symmetric").closure_weights
    expected = np.eye(s)[:, : s - 1]
    expected[-1, 0] = (-1) ** s
    np.testing.assert_array_equal(closure.E, expected)
    np.testing.assert_array_equal(closure.start, np.eye(s)[0])
    np.testing.assert_array_equal(closure.end, np.eye(s)[-1])


@pytest.mark.parametrize("s", STAGES)
def test_symmetric_closure_reversed_is_itself(s: int):
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
def test_symmetric_closure_is_better_conditioned(
    s: int, symmetric: float, carried: float
):
    for multiplier, expected in (("symmetric", symmetric), ("propagated", carried)):
        method = LobattoIIIAB(s, multiplier)
        condition = np.linalg.cond(method.a[1:] @ method.closure_weights.E)
        assert condition == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("s", STAGES)
def test_symmetric_closure_with_the_other_sign_is_singular(s: int):
    # The solution of Σ_j a_ij Λ^j = 0, i >= 2, has Λ^s = R_A(∞) Λ^1: a closure with
    # that sign contains it and cannot determine the multipliers.
    method = LobattoIIIAB(s)
    other = method.closure_weights.E.copy()
    other[-1, 0] *= -1
    smallest = np.linalg.svd(method.a[1:] @ other, compute_uv=False)[-1]
    assert smallest < 1e-15
    assert (
        np.linalg.svd(method.a[1:] @ method.closure_weights.E, compute_uv=False)[-1]
        > 1e-2
    )


@pytest.mark.parametrize("multiplier", CLOSURES)
def test_closure_weights_are_cached_hashable_and_read_only(multiplier: str):
    closure = LobattoIIIAB(4, multiplier).closure_weights
    assert closure is LobattoIIIAB(4, multiplier).closure_weights
    assert hash(closure) == hash(LobattoIIIAB(4, multiplier).closure_weights)
    for array in (closure.E, closure.start, closure.end):
        assert array.dtype == np.float64
        assert not array.flags.writeable


# --- refusals -------------------------------------------------------------------------


def test_constraint_hypotheses_that_fail_raise_naming_the_first():
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
def test_symmetric_closure_without_unit_stability_at_infinity_raises(
    b: tuple[float, float],
):
    method = PartitionedRungeKutta([[0, 0], b], b)
    assert method.stability_at_infinity == pytest.approx(-b[0] / b[1])
    with pytest.raises(ValueError, match=r"needs \|R_A\(∞\)\| = 1, but it is"):
        method.require_constraint_hypotheses()
    PartitionedRungeKutta([[0, 0], b], b, "consistent").require_constraint_hypotheses()


def test_symmetric_closure_with_asymmetric_tableau_raises():
    b = [1 / 6, 2 / 3, 1 / 6]
    method = PartitionedRungeKutta([[0, 0, 0], [0.2, 0.4, 0], b], b)
    assert method.stability_at_infinity == pytest.approx(1)
    with pytest.raises(ValueError, match="needs a symmetric tableau"):
        method.require_constraint_hypotheses()


def test_propagated_closure_with_growing_errors_raises():
    damped = PartitionedRungeKutta([[0, 0], [0.4, 0.6]], [0.4, 0.6], "propagated")
    grows = PartitionedRungeKutta([[0, 0], [0.6, 0.4]], [0.6, 0.4], "propagated")
    assert damped.multiplier_order == damped.orders.C
    with pytest.raises(ValueError, match=r"needs \|R_A\(∞\)\| <= 1.* it is 1\.5;"):
        grows.require_constraint_hypotheses()


@pytest.mark.parametrize("stages", [2.0, "3", None, True])
@pytest.mark.parametrize("kind", [LobattoIIIAB, Gauss])
def test_method_stages_not_an_int_raise(kind: type, stages: object):
    message = f"^stages of {kind.__name__} must be an int, got {stages!r} of type "
    with pytest.raises(TypeError, match=message):
        kind(stages)


@pytest.mark.parametrize(("kind", "minimum"), [(LobattoIIIAB, 2), (Gauss, 1)])
def test_method_with_too_few_stages_raises(kind: type, minimum: int):
    for stages in (minimum - 1, -3):
        message = f"^stages of {kind.__name__} must be >= {minimum}, got {stages}$"
        with pytest.raises(ValueError, match=message):
            kind(stages)
    assert kind(np.int64(minimum)) == kind(minimum)
    assert type(kind(np.int64(minimum)).stages) is int


def test_method_with_unknown_closure_raises_with_the_choices():
    message = (
        "^closure must be one of 'propagated', 'consistent', 'symmetric', got 'x'$"
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
        (np.eye(2), [1.0, 0.0], r"^every weight in b must be nonzero"),
    ],
)
def test_tableau_malformed_raises(a: list, b: list, message: str):
    with pytest.raises(ValueError, match=message):
        PartitionedRungeKutta(a, b)


@pytest.mark.parametrize("s", STAGES)
def test_closure_response_keeps_the_momenta_at_nodes(s: int):
    # If λ_{k+1} changes by one, and y by the response, the multipliers change by z.
    method = LobattoIIIAB(s, "symmetric")
    closure = method.closure_weights
    z = closure.E @ closure.response + closure.end
    np.testing.assert_allclose(method.a[1:] @ z, 0, atol=1e-14)
    np.testing.assert_allclose(method.a_hat @ z, closure.stage_response, atol=1e-14)
    assert np.max(np.abs(closure.stage_response)) > 1e-3
    for carried in ("propagated", "consistent"):
        weights = LobattoIIIAB(s, carried).closure_weights
        np.testing.assert_array_equal(weights.response, np.zeros(s - 1))
