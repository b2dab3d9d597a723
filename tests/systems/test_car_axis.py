"""The car axis against Newton's equations in two coordinates and published numbers."""

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax.systems import CarAxis
from support import car_axis
from support.flow import flow
from support.library_motion import library_motion
from support.mechanisms import (
    assert_motion,
    assert_order,
    assert_single_precision,
    runs,
)


AXIS = CarAxis()
END = 3.0
COUNTS = (2000, 4000, 8000)
# s = 0.5 and the axle level, without work done.
START = (0.5, 0.0, 0.0, 0.0, 0.0)

# Test Set for IVP Solvers, problem "caraxis": (q, v, λ) at 3.
PUBLISHED_Q = [
    *(0.4934557842755629e-1, 0.4969894602303324),
    *(0.1041742524885400e1, 0.3739110272652214),
]
PUBLISHED_V = [
    *(-0.7705836840321485e-1, 0.7446866596327776e-2),
    *(0.1755681574942899e-1, 0.7703410437794031),
]
PUBLISHED_MULTIPLIER = [-0.4736886750784630e-2, -0.1104680411345730e-2]


@pytest.fixture(scope="module")
def reference():
    end = flow(car_axis.velocity_field, START, np.array([0.0, END]))[-1]
    q, v = car_axis.state(END, end)
    multiplier = car_axis.motion(END, end[:4])[2]
    return {"q": q, "v": v, "multiplier": multiplier, "work": end[4]}


@pytest.fixture(scope="module")
def found():
    return runs(AXIS, 3, COUNTS, END)


def test_acceleration_and_multiplier_equal_newtons_equations():
    rng = np.random.default_rng(0)
    for _ in range(6):
        t, y = rng.uniform(0, 2), START[:4] + 0.3 * rng.normal(size=4)
        acceleration, _, multiplier = car_axis.motion(t, y)
        found = library_motion(AXIS, t, *car_axis.state(t, y))
        assert_motion(found, (acceleration, multiplier), 1e-13)


def test_independent_equations_reproduce_the_published_solution(reference):
    np.testing.assert_allclose(reference["q"], PUBLISHED_Q, rtol=0, atol=2e-12)
    np.testing.assert_allclose(reference["v"], PUBLISHED_V, rtol=0, atol=2e-11)
    # The published multiplier agrees with the published state only to 1e-10.
    found = reference["multiplier"]
    np.testing.assert_allclose(found, PUBLISHED_MULTIPLIER, rtol=0, atol=2e-10)
    _, own = library_motion(AXIS, END, PUBLISHED_Q, PUBLISHED_V)
    np.testing.assert_allclose(own, found, rtol=0, atol=1e-12)


def test_run_ends_at_the_published_solution(found):
    bounds = {"q": 1e-10, "v": 6e-9, "multiplier": 2e-10}
    published = (PUBLISHED_Q, PUBLISHED_V, PUBLISHED_MULTIPLIER)
    for (name, bound), expected in zip(bounds.items(), published, strict=True):
        assert found.errors(name, np.array(expected))[-1] < bound, name


@pytest.mark.parametrize("name", ["q", "v", "multiplier"])
def test_run_converges_with_method_order(found, reference, name):
    assert_order(4, COUNTS, found.errors(name, reference[name]))


def test_constraints_hold_to_round_off_along_a_run(found):
    lane = found.lanes[0]
    left, right = lane.q[:, :2], lane.q[:, 2:]
    length = np.hypot(*(left - right).T)
    np.testing.assert_allclose(length, 1.0, rtol=0, atol=1e-15)
    sine = 0.1 * np.sin(10 * lane.t)
    along = np.sqrt(1 - sine**2) * left[:, 0] + sine * left[:, 1]
    np.testing.assert_allclose(along, 0.0, rtol=0, atol=1e-15)


def test_energy_gain_equals_the_work_of_the_road(found, reference):
    end = found.lanes[-1]
    gained = AXIS.energy(END, jnp.asarray(end.q[-1]), jnp.asarray(end.v[-1]))
    gained = gained - AXIS.energy(0.0, AXIS.q0, AXIS.v0)
    bound = 2e-12
    assert gained == pytest.approx(reference["work"], rel=0, abs=bound)


def test_level_axle_with_other_parameters_is_consistent():
    axis = CarAxis.level(length=1.3, rest_length=0.4, amplitude=0.2, rate=7.0)
    assert axis.initial_state().multiplier.shape == (2,)
    published = CarAxis.level()
    np.testing.assert_array_equal(published.q0, AXIS.q0)
    np.testing.assert_array_equal(published.v0, AXIS.v0)


def test_car_axis_points_are_at_wheels_and_ends():
    t = 0.1
    points = AXIS.points(t, AXIS.q0)
    wheel = 0.1 * np.sin(1.0)
    np.testing.assert_allclose(points["right_wheel"], [np.sqrt(1 - wheel**2), wheel])
    np.testing.assert_array_equal(points["left_wheel"], [0.0, 0.0])
    np.testing.assert_array_equal(points["left_end"], [0.0, 0.5])
    np.testing.assert_array_equal(points["right_end"], [1.0, 0.5])


def test_car_axis_has_no_invariants():
    assert AXIS.invariants(0.0, AXIS.q0, AXIS.v0) == {}


def test_system_in_single_precision_keeps_dtype():
    assert_single_precision(AXIS)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"mass": 0.0}, r"`mass` must be positive, got 0"),
        ({"epsilon": -1.0}, r"`epsilon` must be positive, got -1"),
        (
            {"amplitude": -1.5},
            r"`amplitude` must be less than `length` 1\.0, got -1\.5",
        ),
        ({"q0": (0.0,)}, r"`q0` must have shape \(4,\)"),
    ],
)
def test_car_axis_parameter_out_of_range_raises(parameters, message):
    with pytest.raises(ValueError, match=message):
        CarAxis(**parameters)
