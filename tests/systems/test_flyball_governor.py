"""The flyball governor against Kane's equations in the turning frame."""

import numpy as np
import pytest

import nhjax
from nhjax.systems import FlyballGovernor
from support import governor
from support.flow import flow
from support.library_motion import library_motion
from support.mechanisms import (
    assert_motion,
    assert_order,
    assert_single_precision,
    invariants,
    runs,
)


RIGID = FlyballGovernor.turning(0.6, 5.0, 0.7, arm=0.08, coupler_length=0.55)
RIGID_PARAMETERS = governor.Parameters(arm=0.08, coupler_length=0.55)
SPRUNG = FlyballGovernor(couplers="springs")
SPRUNG_PARAMETERS = governor.Parameters()
TORQUE = 3.0
END = 0.4
COUNTS = (60, 90, 135, 200)


@pytest.fixture(scope="module")
def reference():
    def field(_, y):
        q, v = np.split(y, 2)
        return np.concatenate([v, governor.rigid_motion(RIGID_PARAMETERS, q, v)[0]])

    end = flow(field, np.concatenate([RIGID.q0, RIGID.v0]), np.array([0.0, END]))[-1]
    q, v = np.split(end, 2)
    multiplier = governor.rigid_motion(RIGID_PARAMETERS, q, v)[1]
    return {"q": q, "v": v, "multiplier": multiplier}


@pytest.fixture(scope="module")
def found():
    return runs(RIGID, 3, COUNTS, END)


def test_rigid_governor_acceleration_equals_kanes_equations():
    rng = np.random.default_rng(0)
    for _ in range(6):
        turn, spin, rate, torque = rng.normal(size=4) * [1, 4, 2, 3]
        beta = rng.uniform(0.1, 1.2)
        state = governor.consistent(RIGID_PARAMETERS, turn, spin, beta, rate)
        found = library_motion(RIGID, 0.0, *state, torque)
        expected = governor.rigid_motion(RIGID_PARAMETERS, *state, torque)
        assert_motion(found, expected, 1e-11)


def test_elastic_governor_acceleration_equals_kanes_equations():
    rng = np.random.default_rng(1)
    for _ in range(6):
        q = np.asarray(SPRUNG.q0) + 0.1 * rng.normal(size=4)
        v, torque = rng.normal(size=4), rng.normal()
        acceleration, multiplier = library_motion(SPRUNG, 0.0, q, v, torque)
        expected = governor.sprung_acceleration(SPRUNG_PARAMETERS, q, v, torque)
        assert_motion((acceleration,), (expected,), 1e-11)
        assert multiplier.shape == (0,)


@pytest.mark.parametrize("name", ["q", "v", "multiplier"])
def test_run_converges_with_method_order(found, reference, name):
    assert_order(4, COUNTS, found.errors(name, reference[name]))


def test_governor_couplers_keep_their_length_along_a_run(found):
    assert max(found.violations) < 1e-14
    lane = found.lanes[0]
    for q in lane.q[::6]:
        points = RIGID.points(0.0, q)
        for k in (1, 2):
            coupler = np.asarray(points[f"middle_{k}"] - points[f"slider_{k}"])
            assert np.linalg.norm(coupler) == pytest.approx(0.55, rel=1e-14)


def test_energy_and_momentum_of_the_governor_are_conserved(found):
    lane = found.lanes[-1]
    values = invariants(RIGID, lane.t, lane.q, lane.v)
    start = RIGID.invariants(0.0, RIGID.q0, RIGID.v0)
    own = [
        governor.energy(RIGID_PARAMETERS, q, v)
        for q, v in zip(lane.q, lane.v, strict=True)
    ]
    np.testing.assert_allclose(values["energy"], own, rtol=1e-13)
    momentum, drift = (
        np.max(np.abs(values[name] - float(start[name])))
        for name in ("vertical_momentum", "energy")
    )
    assert momentum < 1e-12
    assert drift < 2e-9


@pytest.mark.long
def test_governor_with_stiff_springs_and_motor_moves_by_kanes_equations():
    def field(_, y):
        q, v = np.split(y, 2)
        a = governor.sprung_acceleration(SPRUNG_PARAMETERS, q, v, TORQUE)
        return np.concatenate([v, a])

    start, duration = np.concatenate([SPRUNG.q0, SPRUNG.v0]), 0.1
    q, v = np.split(flow(field, start, np.array([0.0, duration]))[-1], 2)
    counts = (50, 75, 112)
    # The simplified iteration does not contract: its matrix leaves out the dampers.
    solver = nhjax.Newton()
    found = runs(SPRUNG, 3, counts, duration, np.asarray(TORQUE), solver)
    assert_order(4, counts, found.errors("q", q))
    assert_order(4, counts, found.errors("v", v))
    lane = found.lanes[-1]
    values = invariants(SPRUNG, lane.t, lane.q, lane.v)
    assert set(values) == {"vertical_momentum"}
    first = SPRUNG.invariants(0.0, SPRUNG.q0, SPRUNG.v0)["vertical_momentum"]
    gained = values["vertical_momentum"] - float(first)
    np.testing.assert_allclose(gained, TORQUE * lane.t, rtol=0, atol=1e-12)


def test_governor_defaults_equal_the_published_start():
    data = FlyballGovernor.turning(np.pi / 6, 2 * np.pi)
    published = FlyballGovernor()
    np.testing.assert_allclose(data.q0, published.q0, rtol=0, atol=2e-16)
    np.testing.assert_allclose(data.v0, published.v0, rtol=0, atol=2e-16)
    assert published.initial_state().multiplier.shape == (2,)


def test_governor_points_are_at_hinges_and_balls():
    points = FlyballGovernor().points(0.0, FlyballGovernor().q0)
    np.testing.assert_allclose(points["hinge_2"], [-0.05, 0.0, 1.0], atol=1e-16)
    ball = [0.05 + np.sqrt(0.75), 0.0, 0.5]
    np.testing.assert_allclose(points["ball_1"], ball, rtol=0, atol=2e-16)


@pytest.mark.parametrize("example", [RIGID, SPRUNG], ids=["rods", "springs"])
def test_system_in_single_precision_keeps_dtype(example):
    assert_single_precision(example)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"ball_mass": 0.0}, r"`ball_mass` must be positive, got 0"),
        ({"rod_inertias": (1.0,)}, r"`rod_inertias` must have shape \(2,\)"),
        ({"v0": (0.0,)}, r"`v0` must have shape \(4,\)"),
        ({"couplers": "ropes"}, r'`couplers` must be "rods" or "springs", got \'ropes'),
    ],
)
def test_governor_parameter_out_of_range_raises(parameters, message):
    with pytest.raises(ValueError, match=message):
        FlyballGovernor(**parameters)


def test_governor_with_too_short_couplers_raises():
    with pytest.raises(ValueError, match=r"`coupler_length` 0\.3 does not reach"):
        FlyballGovernor.turning(0.1, 1.0, coupler_length=0.3)
