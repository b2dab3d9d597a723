"""Andrews' squeezing mechanism against the published equations and numbers."""

import numpy as np
import pytest

from nhjax.systems import AndrewsSqueezer
from support import andrews
from support.flow import flow
from support.library_motion import library_motion
from support.long import long
from support.mechanisms import (
    assert_motion,
    assert_order,
    assert_single_precision,
    invariants,
    runs,
)


SQUEEZER = AndrewsSqueezer()
END = 0.03
COUNTS = (400, 600, 1200, 1800)

# Test Set for IVP Solvers, problem "andrews": initial values, and (q, v, q̈, λ) at 0.03
# by PSIDE with tolerances 1e-14. The multiplier has the opposite sign there.
PUBLISHED_ACCELERATION = (
    14222.4439199541138705911625887,
    -10666.8329399655854029433719415,
)
PUBLISHED_MULTIPLIER = (
    98.5668703962410896057654982170,
    -6.12268834425566265503114393122,
)
PUBLISHED_Q = [
    *(0.1581077119629904e2, -0.1575637105984298e2, 0.4082224013073101e-1),
    *(-0.5347301163226948e0, 0.5244099658805304e0, 0.5347301163226948e0),
    0.1048080741042263e1,
]
PUBLISHED_V = [
    *(0.1139920302151208e4, -0.1424379294994111e4, 0.1103291221937134e2),
    *(0.1929337464421385e2, 0.5735699284790808e0, -0.1929337464421385e2),
    0.3231791658026955e0,
]
PUBLISHED_END_ACCELERATION = [
    *(-0.2463176316945196e5, 0.5185037701610329e5, 0.3241025686413781e6),
    *(0.5667493645176213e6, 0.1674362929479361e5, -0.5667493645176222e6),
    0.9826520791458422e4,
]
PUBLISHED_END_MULTIPLIER = [
    *(0.1991753333731910e3, -0.2975531228015052e2, 0.2306654119098399e2),
    *(0.3145271365475927e2, 0.2264249232082739e2, 0.1161740700019673e2),
]


@pytest.fixture(scope="module")
def reference():
    start = np.concatenate([SQUEEZER.q0, SQUEEZER.v0])
    end = flow(andrews.velocity_field, start, np.array([0.0, END]))[-1]
    q, v = np.split(end, 2)
    return {"q": q, "v": v, "multiplier": andrews.motion(q, v)[1]}


@pytest.fixture(scope="module", params=(long(2), long(3)))
def lanes(request):
    return request.param, runs(SQUEEZER, request.param, COUNTS, END)


def test_acceleration_and_multiplier_equal_published_equations():
    rng = np.random.default_rng(0)
    for _ in range(6):
        q = np.asarray(SQUEEZER.q0) + rng.normal(size=7)
        v = 100 * rng.normal(size=7)
        found = library_motion(SQUEEZER, 0.0, q, v)
        assert_motion(found, andrews.motion(q, v), 1e-12)


def test_squeezer_initial_values_equal_published_ones():
    np.testing.assert_allclose(andrews.constraints(SQUEEZER.q0), 0, rtol=0, atol=1e-16)
    found = library_motion(SQUEEZER, 0.0, SQUEEZER.q0, SQUEEZER.v0)
    expected = [*PUBLISHED_ACCELERATION, 0, 0, 0, 0, 0]
    multiplier = [*PUBLISHED_MULTIPLIER, 0, 0, 0, 0]
    assert_motion(found, (np.array(expected), -np.array(multiplier)), 3e-13)


def test_run_ends_at_the_published_solution(lanes):
    stages, found = lanes
    if stages == 2:
        # The error of this run is 1e-4.
        np.testing.assert_allclose(found.lanes[-1].q[-1], PUBLISHED_Q, rtol=2e-4)
        return
    # The published numbers have errors of 1e-10 in the angles, 5e-8 in the velocities
    # and 1e-6 in the multiplier: see the next two tests.
    np.testing.assert_allclose(found.lanes[-1].q[-1], PUBLISHED_Q, rtol=5e-10)
    np.testing.assert_allclose(found.lanes[-1].v[-1], PUBLISHED_V, rtol=6e-8)
    end = found.lanes[-1].multiplier[-1]
    np.testing.assert_allclose(-end, PUBLISHED_END_MULTIPLIER, rtol=2e-6)


def test_published_solution_has_nine_digits(reference):
    # The published velocities violate the differentiated constraints; ours do not.
    violation = andrews.jacobian(PUBLISHED_Q) @ PUBLISHED_V
    assert 5e-10 < np.max(np.abs(violation)) < 2e-9
    own = andrews.jacobian(reference["q"]) @ reference["v"]
    np.testing.assert_allclose(own, 0.0, rtol=0, atol=5e-13)
    np.testing.assert_allclose(reference["q"], PUBLISHED_Q, rtol=3e-10)
    np.testing.assert_allclose(reference["v"], PUBLISHED_V, rtol=6e-8)


def test_published_end_has_six_digits_of_acceleration_and_multiplier():
    # By the published equations, at the published angles and velocities.
    q, v = np.array(PUBLISHED_Q), np.array(PUBLISHED_V)
    acceleration, multiplier = andrews.motion(q, v)
    np.testing.assert_allclose(acceleration, PUBLISHED_END_ACCELERATION, rtol=2e-6)
    np.testing.assert_allclose(-multiplier, PUBLISHED_END_MULTIPLIER, rtol=2e-6)
    assert_motion(library_motion(SQUEEZER, 0.0, q, v), (acceleration, multiplier))


@pytest.mark.parametrize("name", ["q", "v", "multiplier"])
def test_run_converges_with_method_order(lanes, reference, name):
    stages, found = lanes
    assert_order(2 * stages - 2, COUNTS, found.errors(name, reference[name]))


def test_constraints_hold_to_round_off_along_a_run(lanes):
    _, found = lanes
    lane = found.lanes[0]
    for q, v in zip(lane.q[::20], lane.v[::20], strict=True):
        np.testing.assert_allclose(andrews.constraints(q), 0.0, rtol=0, atol=1e-15)
        np.testing.assert_allclose(andrews.jacobian(q) @ v, 0, rtol=0, atol=5e-12)


def test_energy_gain_equals_the_work_of_the_motor(lanes):
    stages, found = lanes
    lane = found.lanes[-1]
    balance = [
        0.5 * v @ andrews.mass_matrix(q) @ v + andrews.spring_energy(q)
        - andrews.TORQUE * q[0]
        for q, v in zip(lane.q, lane.v, strict=True)
    ]  # fmt: skip
    own = invariants(SQUEEZER, lane.t, lane.q, lane.v)["energy_less_work"]
    work = andrews.TORQUE * lane.q[-1][0]
    np.testing.assert_allclose(own, balance, rtol=0, atol=1e-13 * work)
    drift = np.ptp(balance) / work
    assert drift < (3e-4 if stages == 2 else 2e-9), drift


def test_squeezer_points_lie_on_the_bodies():
    points = SQUEEZER.points(0.0, SQUEEZER.q0)
    bars = {("O", "K1"): 7e-3, ("K1", "P"): 28e-3, ("B", "P"): 35e-3, ("A", "K5"): 4e-2}
    bars |= {("K5", "P"): 2e-2, ("A", "K7"): 4e-2, ("K7", "P"): 2e-2}
    bars |= {("B", "D"): np.hypot(18e-3, 2e-2)}
    for (first, second), length in bars.items():
        distance = np.linalg.norm(points[first] - points[second])
        assert distance == pytest.approx(length, rel=1e-14), (first, second)
    np.testing.assert_array_equal(points["C"], [0.014, 0.072])


def test_system_in_single_precision_keeps_dtype():
    assert_single_precision(SQUEEZER)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"masses": (1.0,)}, r"`masses` must have shape \(7,\)"),
        ({"inertias": -np.ones(7)}, r"`inertias` must be positive"),
        ({"arms": np.ones((7, 3))}, r"`arms` must have shape \(7, 2\)"),
        ({"hook": np.ones(3)}, r"`hook` must have shape \(2,\)"),
        ({"stiffness": 0.0}, r"`stiffness` must be positive, got 0"),
    ],
)
def test_squeezer_parameter_out_of_range_raises(parameters, message):
    with pytest.raises(ValueError, match=message):
        AndrewsSqueezer(**parameters)
