"""The spatial slider-crank against Kane's equation and published solutions."""

import numpy as np
import pytest
from scipy.integrate import quad

from nhjax.systems import SpatialSliderCrank
from support.flow import flow
from support.library_motion import library_motion
from support.mechanisms import (
    assert_motion,
    assert_order,
    assert_single_precision,
    invariants,
    runs,
)
from support.spatial_linkage import SpatialSliderCrank as Oracle


MACHINE = SpatialSliderCrank()
ORACLE = Oracle(
    *(0.08, 0.3, (0.1, 0.12), (1e-4, 4e-4, 4e-3), (0.12, 0.5, 2.0), 9.81, 0.5)
)
END = 0.5
COUNTS = (100, 150, 225, 338)

# The solution by González of the IFToMM library: the place of the slider. Other
# submitted solutions differ from it by 2e-4 at 0.3 s; its own error is below 5e-5.
PUBLISHED = {
    0.1: 0.226785384,
    0.2: 0.263034975,
    0.3: 0.28194126,
    0.5: 0.184952803,
    1.0: 0.211754668,
    2.0: 0.289063554,
    3.0: 0.228450093,
    5.0: 0.240761815,
}
# The angle of the crank by Masarati.
PUBLISHED_ANGLES = {0.1: 0.5600213536265, 0.2: 1.287191842519}


def velocity_field(_, y):
    inertia, load, _ = ORACLE.crank(*y)
    return np.array([y[1], load / inertia])


@pytest.fixture(scope="module")
def reference():
    end = flow(velocity_field, [0.0, 6.0], np.array([0.0, END]))[-1]
    (q, v), (_, multiplier) = ORACLE.state(*end), ORACLE.motion(*end)
    return {"q": q, "v": v, "multiplier": multiplier}


@pytest.fixture(scope="module")
def found():
    return runs(MACHINE, 3, COUNTS, END)


def test_acceleration_and_multiplier_equal_crank_equations():
    rng = np.random.default_rng(0)
    for _ in range(8):
        theta, rate = rng.uniform(0, 2 * np.pi), 3 * rng.normal()
        found = library_motion(MACHINE, 0.0, *ORACLE.state(theta, rate))
        assert_motion(found, ORACLE.motion(theta, rate), 1e-12)


def test_independent_equations_reproduce_the_published_solution():
    times = np.array([0.0, *PUBLISHED])[:6]
    ends = flow(velocity_field, [0.0, 6.0], times)[1:]
    places = [ORACLE.state(*end)[0][3] for end in ends]
    np.testing.assert_allclose(places, list(PUBLISHED.values())[:5], rtol=0, atol=5e-5)
    angles = ends[: len(PUBLISHED_ANGLES), 0]
    np.testing.assert_allclose(
        angles, list(PUBLISHED_ANGLES.values()), rtol=0, atol=6e-5
    )


def test_run_passes_through_the_published_solution():
    (lane,) = runs(MACHINE, 3, (2000,), 5.0).lanes
    for t, place in PUBLISHED.items():
        (k,) = np.flatnonzero(np.isclose(lane.t, t))
        assert lane.q[k, 3] == pytest.approx(place, rel=0, abs=5e-5)
    energy = invariants(MACHINE, lane.t, lane.q, lane.v)["energy"]
    start = float(MACHINE.energy(0.0, MACHINE.q0, MACHINE.v0))
    assert np.max(np.abs(energy - start)) < 3e-7


def test_crank_turns_in_the_time_of_the_quadrature(reference):
    mass, _, height = ORACLE.crank(0.0, 6.0)
    energy = 0.5 * mass * 36 + height

    def slowness(theta):
        inertia, _, potential = ORACLE.crank(theta, 0.0)
        return np.sqrt(0.5 * inertia / (energy - potential))

    end = reference["q"][0]
    time, _ = quad(slowness, 0.0, end, epsabs=1e-14, epsrel=1e-13, limit=400)
    assert time == pytest.approx(END, rel=1e-11)


@pytest.mark.parametrize("name", ["q", "v", "multiplier"])
def test_run_converges_with_method_order(found, reference, name):
    assert_order(4, COUNTS, found.errors(name, reference[name]))


def test_slider_crank_loop_stays_closed_along_a_run(found):
    lane = found.lanes[0]
    for q, v in zip(lane.q[::5], lane.v[::5], strict=True):
        other_q, other_v = ORACLE.state(q[0], v[0])
        np.testing.assert_allclose(q, other_q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(v, other_v, rtol=0, atol=1e-12)


def test_slider_crank_defaults_equal_turning_crank():
    data = SpatialSliderCrank.turning(0.0, 6.0)
    np.testing.assert_allclose(data.q0, MACHINE.q0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(data.v0, MACHINE.v0, rtol=0, atol=1e-14)


def test_slider_crank_points_are_at_the_joints():
    points = MACHINE.points(0.0, MACHINE.q0)
    np.testing.assert_allclose(points["pin"], [0.0, 0.1, 0.2], rtol=1e-15)
    np.testing.assert_array_equal(points["axle"], [0.0, 0.1, 0.12])
    assert np.linalg.norm(points["slider"] - points["pin"]) == pytest.approx(0.3)


def test_system_in_single_precision_keeps_dtype():
    assert_single_precision(MACHINE)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SpatialSliderCrank(rod_mass=0.0), r"`rod_mass` must be positive"),
        (lambda: SpatialSliderCrank(axle=(0.1,)), r"`axle` must have shape \(2,\)"),
        (
            lambda: SpatialSliderCrank.turning(0.0, 1.0, rod_length=0.2),
            r"`angle` 0\.0 leaves the rod too short",
        ),
    ],
)
def test_slider_crank_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
