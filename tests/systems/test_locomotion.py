"""Snakeboard and roller racer against reduced equations of motion."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax.systems import RollerRacer, Snakeboard
from support import locomotion
from support.flow import flow
from support.library_motion import library_motion
from support.mechanisms import (
    assert_motion,
    assert_order,
    assert_single_precision,
    invariants,
    runs,
)


END = 1.5
COUNTS = (40, 60, 90, 135)
BOARD = locomotion.Snakeboard(5.0, 0.03, 0.08, 0.002, 0.25)
BOARD_PARAMETERS = (5.0, 0.03, 0.08, 0.002, 0.25)
RACER = locomotion.RollerRacer((8.0, 1.5), (0.9, 0.2), (0.5, 0.3))
RACER_PARAMETERS = {
    "masses": (8.0, 1.5),
    "inertias": (0.9, 0.2),
    "distances": (0.5, 0.3),
}
NAMES = ("mass", "inertia", "rotor_inertia", "axle_inertia", "half_length")
BOARD_FIELDS = dict(zip(NAMES, BOARD_PARAMETERS, strict=True))

BOARD_GAIT = (np.array([0.7, 0.3, -0.4]), np.array([2.0, 3.0, 2.5]), np.arange(3.0))
BOARD_TORQUES = np.array([0.05, 0.0004, -0.0005])
RACER_GAIT, RACER_TORQUE = (0.6, 4.0, 0.3), -0.4
SPEED = 0.8


class Case(NamedTuple):
    """An example with `args`, and its motion by the oracle from the same data.

    `field` gives the rates of the oracle's state, whose last row is the work of the
    joints; `result` turns the state into (q, v, multiplier).
    """

    example: Snakeboard | RollerRacer
    args: np.ndarray | None
    start: np.ndarray
    field: object
    result: object


def driven_board():
    example = Snakeboard.driving(*BOARD_GAIT, speed=SPEED, **BOARD_FIELDS)
    joints = locomotion.Sine(*BOARD_GAIT)

    def parts(t, y):
        angles, rates, accelerations = joints(t)
        s = BOARD.speed(y[3], angles, rates)
        ds = BOARD.driven_acceleration(s, angles, rates, accelerations)
        motion = BOARD.motion(y[:3], s, angles, rates, ds, accelerations)
        return BOARD.state(y[:3], s, angles, rates), motion, s

    def field(t, y):
        angles, rates, _ = joints(t)
        (_, v), (_, _, torques), s = parts(t, y)
        change = BOARD.momentum_rate(s, angles, rates)
        return np.array([*v[:3], change, torques @ rates])

    def result(t, y):
        (q, v), (_, axles, torques), _ = parts(t, y)
        return q, v, np.concatenate([axles, torques])

    momentum = BOARD.momentum(SPEED, *joints(0.0)[:2])
    start = np.array([0.0, 0.0, 0.0, momentum, 0.0])
    return Case(example, None, start, field, result)


def driven_racer():
    example = RollerRacer.driving(*RACER_GAIT, speed=SPEED, **RACER_PARAMETERS)
    pivot = locomotion.Sine(*RACER_GAIT)

    def parts(t, y):
        angle, rate, acceleration = pivot(t)
        ds = RACER.driven_acceleration(y[3], angle, rate, acceleration)
        motion = RACER.motion(y[:3], y[3], angle, rate, ds, acceleration)
        return RACER.state(y[:3], y[3], angle, rate), motion, ds

    def field(t, y):
        (_, v), (_, _, torque), ds = parts(t, y)
        return np.array([*v[:3], ds, torque * v[3]])

    def result(t, y):
        (q, v), (_, axles, torque), _ = parts(t, y)
        return q, v, np.array([*axles, torque])

    return Case(example, None, np.array([0.0, 0.0, 0.0, SPEED, 0.0]), field, result)


def free_board():
    joints, rates = np.array([0.2, 0.1, 0.2]), np.array([1.0, -0.3, 0.4])
    example = Snakeboard.rolling(SPEED, joints, rates, **BOARD_FIELDS)

    def result(t, y):
        place, joints, s, rates = np.split(y[:10], [3, 6, 7])
        motion = BOARD.free_acceleration(s[0], joints, rates, BOARD_TORQUES)
        q, v = BOARD.state(place, s[0], joints, rates)
        return q, v, BOARD.motion(place, s[0], joints, rates, *motion)[1]

    def field(t, y):
        _, joints, s, rates = np.split(y[:10], [3, 6, 7])
        ds, accelerations = BOARD.free_acceleration(s[0], joints, rates, BOARD_TORQUES)
        v = result(t, y)[1]
        return np.array([*v, ds, *accelerations, BOARD_TORQUES @ rates])

    start = np.array([0.0, 0.0, 0.0, *joints, SPEED, *rates, 0.0])
    return Case(example, BOARD_TORQUES, start, field, result)


def free_racer():
    example = RollerRacer.rolling(SPEED, 0.3, 1.0, **RACER_PARAMETERS)

    def result(t, y):
        place, (angle, s, rate) = y[:3], y[3:6]
        motion = RACER.free_acceleration(s, angle, rate, RACER_TORQUE)
        q, v = RACER.state(place, s, angle, rate)
        return q, v, RACER.motion(place, s, angle, rate, *motion)[1]

    def field(t, y):
        angle, s, rate = y[3:6]
        motion = RACER.free_acceleration(s, angle, rate, RACER_TORQUE)
        return np.array([*result(t, y)[1], *motion, RACER_TORQUE * rate])

    start = np.array([0.0, 0.0, 0.0, 0.3, SPEED, 1.0, 0.0])
    return Case(example, np.asarray(RACER_TORQUE), start, field, result)


CASES = {f.__name__: f() for f in (driven_board, free_board, driven_racer, free_racer)}


@pytest.fixture(scope="module", params=CASES, ids=str)
def case(request):
    return CASES[request.param]


@pytest.fixture(scope="module")
def reference(case):
    end = flow(case.field, case.start, np.array([0.0, END]))[-1]
    q, v, multiplier = case.result(END, end)
    return {"q": q, "v": v, "multiplier": multiplier, "work": end[-1]}


@pytest.fixture(scope="module")
def found(case):
    return runs(case.example, 3, COUNTS, END, case.args)


def test_free_snakeboard_accelerates_by_reduced_equations():
    rng = np.random.default_rng(0)
    for _ in range(5):
        place, s, rates, torques = rng.normal(size=3), *(rng.normal(size=(3, 3)))
        joints, s = 0.5 * rng.normal(size=3), s[0]
        ds, accelerations = BOARD.free_acceleration(s, joints, rates, torques)
        expected = BOARD.motion(place, s, joints, rates, ds, accelerations)[:2]
        state = BOARD.state(place, s, joints, rates)
        found = library_motion(CASES["free_board"].example, 0.0, *state, torques)
        assert_motion(found, expected, 1e-12)


def test_driven_snakeboard_accelerates_by_momentum_equation():
    rng = np.random.default_rng(1)
    joints = locomotion.Sine(*BOARD_GAIT)
    for _ in range(5):
        t, s, place = rng.uniform(0, 5), rng.normal(), rng.normal(size=3)
        angles, rates, accelerations = joints(t)
        ds = BOARD.driven_acceleration(s, angles, rates, accelerations)
        parts = BOARD.motion(place, s, angles, rates, ds, accelerations)
        state = BOARD.state(place, s, angles, rates)
        found = library_motion(CASES["driven_board"].example, t, *state)
        assert_motion(found, (parts[0], np.concatenate(parts[1:])), 1e-12)


def test_free_roller_racer_accelerates_by_reduced_equations():
    rng = np.random.default_rng(2)
    for _ in range(5):
        place, (s, rate, torque) = rng.normal(size=3), rng.normal(size=3)
        angle = 0.6 * rng.normal()
        motion = RACER.free_acceleration(s, angle, rate, torque)
        *expected, own = RACER.motion(place, s, angle, rate, *motion)
        assert own == pytest.approx(torque, rel=0, abs=1e-13)
        state = RACER.state(place, s, angle, rate)
        found = library_motion(CASES["free_racer"].example, 0.0, *state, torque)
        assert_motion(found, expected, 1e-12)


def test_driven_roller_racer_accelerates_by_reduced_equations():
    rng = np.random.default_rng(3)
    pivot = locomotion.Sine(*RACER_GAIT)
    for _ in range(5):
        t, s, place = rng.uniform(0, 5), rng.normal(), rng.normal(size=3)
        angle, rate, acceleration = pivot(t)
        ds = RACER.driven_acceleration(s, angle, rate, acceleration)
        a, axles, torque = RACER.motion(place, s, angle, rate, ds, acceleration)
        state = RACER.state(place, s, angle, rate)
        found = library_motion(CASES["driven_racer"].example, t, *state)
        assert_motion(found, (a, np.array([*axles, torque])), 1e-12)


@pytest.mark.parametrize("name", ["q", "v", "multiplier"])
def test_run_converges_with_method_order(found, reference, name):
    assert_order(4, COUNTS, found.errors(name, reference[name]))


def test_axles_do_not_slip_along_a_run(case, found):
    assert max(found.violations) < 1e-13
    example = case.example
    lane = found.lanes[0]
    for q, v in zip(lane.q[::8], lane.v[::8], strict=True):
        # Differences along the velocity give the speeds of both points.
        h, t = 1e-6, 0.0
        ahead, behind = (example.points(t, jnp.asarray(q + k * h * v)) for k in (1, -1))
        names = ("rear", "front") if "rear" in ahead else ("seat", "handlebar")
        angles = q[2] + q[4:6] if "rear" in ahead else q[2] + np.array([0.0, q[3]])
        for name, angle in zip(names, angles, strict=True):
            velocity = np.asarray(ahead[name] - behind[name]) / (2 * h)
            sideways = velocity @ [-np.sin(angle), np.cos(angle)]
            assert abs(sideways) < 1e-9


def test_energy_gain_equals_the_work_of_the_joints(case, found, reference):
    lane, example = found.lanes[-1], case.example
    gained = example.energy(END, lane.q[-1], lane.v[-1])
    gained = gained - example.energy(0.0, example.q0, example.v0)
    assert abs(reference["work"]) > 0.005
    bound = 1e-8
    assert gained == pytest.approx(reference["work"], rel=0, abs=bound)


def test_invariants_change_only_by_the_torques(case, found):
    example, lane = case.example, found.lanes[-1]
    values = invariants(example, lane.t, lane.q, lane.v)
    if case.args is None:
        assert values == {}
        return
    start = example.invariants(0.0, example.q0, example.v0)
    work = (lane.q[:, 3:] - np.asarray(example.q0[3:])) @ np.atleast_1d(case.args)
    drift = values.pop("energy") - float(start["energy"]) - work
    assert np.max(np.abs(drift)) < 1e-8
    momenta = ("rotor_momentum", "rear_momentum", "front_momentum")
    assert set(values) == (set(momenta) if isinstance(example, Snakeboard) else set())
    for name, torque in zip(momenta[: len(values)], BOARD_TORQUES, strict=False):
        expected = float(start[name]) + torque * lane.t
        np.testing.assert_allclose(values[name], expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "example",
    [Snakeboard(), RollerRacer(), CASES["driven_board"].example],
    ids=["board", "racer", "own board"],
)
def test_joints_follow_their_gaits_from_the_start(example):
    gait = example.gait
    angles, rates, _ = locomotion.Sine(gait.amplitude, gait.rate, gait.phase)(0.0)
    np.testing.assert_allclose(example.q0[3:], np.atleast_1d(angles), rtol=1e-15)
    np.testing.assert_allclose(example.v0[3:], np.atleast_1d(rates), rtol=0, atol=3e-16)
    assert example.initial_state().multiplier.shape == (2 + rates.size,)


def test_gait_of_any_function_of_time_is_accepted():
    amplitude, rate, phase = RACER_GAIT
    driven = CASES["driven_racer"].example
    own = RollerRacer(
        **RACER_PARAMETERS,
        gait=lambda t: amplitude * jnp.sin(rate * t + phase),
        q0=driven.q0,
        v0=driven.v0,
    )
    expected = library_motion(driven, 0.0, driven.q0, driven.v0)
    assert_motion(library_motion(own, 0.0, driven.q0, driven.v0), expected, 1e-15)


def test_system_in_single_precision_keeps_dtype(case):
    assert_single_precision(case.example)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Snakeboard(mass=0.0), r"`mass` must be positive, got 0"),
        (lambda: Snakeboard(half_length=-1.0), r"`half_length` must be positive"),
        (lambda: Snakeboard(q0=(0.0,) * 3), r"`q0` must have shape \(6,\)"),
        (lambda: RollerRacer((1.0,)), r"`masses` must have shape \(2,\)"),
        (lambda: RollerRacer((1.0, -1.0)), r"`masses` must not be negative"),
        (lambda: RollerRacer((0.0, 1.0)), r"`masses` must be positive"),
        (lambda: RollerRacer(inertias=(0.0, 1.0)), r"`inertias` must be positive"),
        (
            lambda: Snakeboard(gait=None).holonomic(0.0, jnp.zeros(6), None),
            r"joints of this snakeboard move freely",
        ),
        (
            lambda: RollerRacer(gait=None).holonomic(0.0, jnp.zeros(4), None),
            r"pivot of this racer moves freely",
        ),
    ],
)
def test_locomotion_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
