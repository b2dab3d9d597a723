"""Slider-crank and four-bar linkage against their equations in the crank's angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

import nhjax
from nhjax.systems import FourBar, SliderCrank
from support import linkages
from support.flow import flow
from support.library_motion import library_motion
from support.mechanisms import (
    assert_motion,
    assert_order,
    assert_single_precision,
    invariants,
    runs,
)


SLIDER_CRANK = SliderCrank.turning(0.4, 50.0, offset=0.02, torque=0.15)
FOUR_BAR = FourBar.turning(0.4, 34.0, torque=0.05)
MACHINES = {
    "slider-crank": (
        SLIDER_CRANK,
        linkages.SliderCrank(0.08, 0.3, 0.02, (0.12, 0.5, 2.0), 0.15),
    ),
    "four-bar": (
        FOUR_BAR,
        linkages.FourBar((0.1, 0.4, 0.3, 0.4), (0.1, 0.4, 0.3), 0.05),
    ),
}
END = 0.25
COUNTS = (400, 600, 900, 1350)


@pytest.fixture(scope="module", params=MACHINES, ids=str)
def machine(request):
    return MACHINES[request.param]


@pytest.fixture(scope="module")
def reference(machine):
    example, oracle = machine

    def velocity_field(_, y):
        return np.array([y[1], oracle.motion(*y)[0][0]])

    start = [example.q0[0], example.v0[0]]
    end = flow(velocity_field, start, np.array([0.0, END]))[-1]
    (q, v), (_, multiplier) = oracle.state(*end), oracle.motion(*end)
    return {"q": q, "v": v, "multiplier": multiplier}


@pytest.fixture(scope="module")
def found(machine):
    return runs(machine[0], 3, COUNTS, END)


def test_acceleration_and_multiplier_equal_crank_equations(machine):
    example, oracle = machine
    rng = np.random.default_rng(0)
    for _ in range(8):
        theta, rate = rng.uniform(0, 2 * np.pi), 10 * rng.normal()
        found = library_motion(example, 0.0, *oracle.state(theta, rate))
        assert_motion(found, oracle.motion(theta, rate), 1e-12)


def test_crank_turns_in_the_time_of_the_quadrature(machine, reference):
    # t = ∫ √(I / 2(E + M θ - V)) dθ, with I and V from the oracle.
    example, oracle = machine
    start, rate = float(example.q0[0]), float(example.v0[0])

    def terms(theta):
        bodies = oracle.bodies(theta, 0.0)
        balance = linkages.potential(bodies) - oracle.torque * theta
        return linkages.inertia(bodies), balance

    mass, balance = terms(start)
    energy = 0.5 * mass * rate**2 + balance

    def slowness(theta):
        mass, balance = terms(theta)
        return np.sqrt(0.5 * mass / (energy - balance))

    end = reference["q"][0]
    time, _ = quad(slowness, start, end, epsabs=1e-14, epsrel=1e-13, limit=400)
    assert end - start > 2 * np.pi
    assert time == pytest.approx(END, rel=1e-12)


@pytest.mark.parametrize("name", ["q", "v", "multiplier"])
def test_run_converges_with_method_order(found, reference, name):
    assert_order(4, COUNTS, found.errors(name, reference[name]))


def test_linkage_loop_stays_closed_along_a_run(machine, found):
    _, oracle = machine
    assert max(found.violations) < 2e-12
    lane = found.lanes[0]
    for q, v in zip(lane.q[::10], lane.v[::10], strict=True):
        other_q, other_v = oracle.state(q[0], v[0])
        np.testing.assert_allclose(q, other_q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(v, other_v, rtol=0, atol=1e-12)


def test_energy_gain_equals_the_work_of_the_torque(machine, found):
    example, _ = machine
    lane = found.lanes[-1]
    balance = invariants(example, lane.t, lane.q, lane.v)["energy_less_work"]
    start = example.invariants(0.0, example.q0, example.v0)["energy_less_work"]
    assert np.max(np.abs(balance - start)) < 3e-7
    assert abs(float(example.energy(0.0, lane.q[-1], lane.v[-1]) - start)) > 0.1


def test_linkage_defaults_equal_turning_crank():
    for example, data in (
        (SliderCrank(), SliderCrank.turning(0.0, 60.0)),
        (FourBar(), FourBar.turning(np.pi, 20.0)),
    ):
        np.testing.assert_allclose(data.q0, example.q0, rtol=0, atol=1e-15)
        np.testing.assert_allclose(data.v0, example.v0, rtol=0, atol=1e-14)


def test_parallelogram_falls_as_a_pendulum():
    # 5/3 θ̈ = -2 g cos θ for bars of 1 m and 1 kg: ½ 5/3 θ̇² = E - 2 g sin θ.
    linkage = FourBar.parallelogram()
    found = runs(linkage, 3, (200,), 0.4)
    (lane,) = found.lanes
    angle = lane.q[-1, 0]
    energy = 5 / 6 + 2 * 9.81

    def slowness(theta):
        return np.sqrt(5 / 6 / (energy - 2 * 9.81 * np.sin(theta)))

    time, _ = quad(slowness, angle, np.pi / 2, epsabs=1e-14)
    assert time == pytest.approx(0.4, abs=1e-9)
    np.testing.assert_allclose(lane.q[:, 1], 0.0, rtol=0, atol=1e-14)
    np.testing.assert_allclose(lane.q[:, 2], lane.q[:, 0], rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "solver", [nhjax.SimplifiedNewton(fallback=False), nhjax.Newton()]
)
def test_parallelogram_passes_a_singular_configuration_as_a_parallelogram(solver):
    linkage = FourBar.parallelogram()
    system, start = linkage.system, linkage.initial_state()
    method, energy = nhjax.LobattoIIIAB(3), system.energy(0.0, start)
    options = {"dt": 0.01, "num_steps": 80, "stage_solver": solver}
    end = jax.tree.map(
        lambda x: x[-1], nhjax.integrate(system, method, start, **options).ys
    )
    assert end.q[0] < -0.5
    np.testing.assert_allclose(end.q[1], 0.0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(system.energy(0.8, end), energy, rtol=1e-6)
    flat = nhjax.check_system(system, jnp.zeros(3), jnp.zeros(3))
    assert flat.dependent == ("Γ[0]",)


def test_linkage_points_are_at_the_joints():
    points = SLIDER_CRANK.points(0.0, SLIDER_CRANK.q0)
    assert np.linalg.norm(points["pin"]) == pytest.approx(0.08)
    assert np.linalg.norm(points["slider"] - points["pin"]) == pytest.approx(0.3)
    assert points["slider"][1] == 0.02
    joints = FOUR_BAR.points(0.0, FOUR_BAR.q0)
    around = np.stack([joints[name] for name in ("O", "A", "B", "C")])
    sides = np.linalg.norm(np.roll(around, -1, axis=0) - around, axis=1)
    np.testing.assert_allclose(sides, [0.1, 0.4, 0.3, 0.4], rtol=1e-14)


def test_system_in_single_precision_keeps_dtype(machine):
    assert_single_precision(machine[0])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: SliderCrank(rod_length=0.0), r"`rod_length` must be positive, got 0"),
        (lambda: SliderCrank(slider_mass=-1.0), r"`slider_mass` must be positive"),
        (
            lambda: SliderCrank.turning(1.5, 1.0, rod_length=0.05),
            r"`angle` 1\.5 leaves the rod too short",
        ),
        (lambda: FourBar((1.0,) * 3), r"`lengths` must have shape \(4,\)"),
        (lambda: FourBar(masses=(1.0,) * 4), r"`masses` must have shape \(3,\)"),
        (lambda: FourBar(masses=(1.0, 0.0, 1.0)), r"`masses` must be positive"),
        (
            lambda: FourBar.turning(3.0, 1.0, lengths=(1.0, 1.0, 1.0, 3.0)),
            r"`angle` 3\.0 leaves the bars too short",
        ),
    ],
)
def test_linkage_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
