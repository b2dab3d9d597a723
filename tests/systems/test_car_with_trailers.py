"""Cars with trailers against their reduced equations, and on circles."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import CarWithTrailers
from support.cars import Train
from support.library_motion import library_motion
from support.long import long
from support.orders import Ladder


def some_car(num_trailers, seed, same_trailers=False):
    random = np.random.default_rng(seed)
    shape = () if same_trailers else (num_trailers,)

    def about(value, shape=()):
        return value * random.uniform(0.7, 1.3, shape)

    return CarWithTrailers(
        num_trailers,
        wheelbase=about(2.7),
        centre=about(1.4),
        mass=about(1500.0),
        inertia=about(2500.0),
        steer_inertia=about(40.0),
        trailer_length=about(3.0, shape),
        trailer_hitch=about(1.0, shape),
        trailer_centre=about(0.3, shape),
        trailer_mass=about(700.0, shape),
        trailer_inertia=about(800.0, shape),
        q0=np.concatenate(
            [random.uniform(-2.0, 2.0, 3), random.uniform(-0.7, 0.7, 1 + num_trailers)]
        ),
    )


@pytest.mark.parametrize(
    ("num_trailers", "seed", "same"),
    [(0, 1, False), (3, 2, False), (3, 3, False), (2, 4, True)],
)
def test_accelerations_and_ground_forces_equal_reduced_equations(
    num_trailers, seed, same
):
    car = some_car(num_trailers, seed, same)
    train = Train(car)
    speed, rate, drive, torque = 3.2, -0.6, 900.0, 30.0
    v = car.velocity(car.q0, speed, rate)
    expected, ground = train.accelerations(
        np.asarray(car.q0), speed, rate, drive, torque
    )
    args = (jnp.asarray(drive), jnp.asarray(torque))
    acceleration, multiplier = library_motion(car, 0.0, car.q0, v, args)
    np.testing.assert_allclose(acceleration, expected, rtol=0, atol=2e-12)
    scale = np.max(np.abs(ground))
    np.testing.assert_allclose(multiplier, ground, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("speed", [4.0, -1.5])
def test_velocity_from_speed_and_steer_rate_does_not_slip(speed):
    car = some_car(3, 5)
    v = car.velocity(car.q0, speed, 0.4)
    slips = car.constraint(0.0, car.q0, v, None)
    np.testing.assert_allclose(slips, 0.0, rtol=0, atol=1e-14 * abs(speed) * 10)
    assert v[3] == 0.4
    heading = car.q0[2]
    assert v[0] * jnp.cos(heading) + v[1] * jnp.sin(heading) == pytest.approx(speed)
    expected = Train(car).velocity(np.asarray(car.q0), speed, 0.4)
    np.testing.assert_allclose(v, expected, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("steer", [0.4, -0.25, 0.0])
def test_car_in_a_turn_moves_on_circles(steer):
    car = CarWithTrailers.turning(
        3, 6.0, steer, trailer_length=(3.0, 2.0, 4.0), trailer_hitch=(1.0, 0.0, 0.5)
    )
    acceleration, multiplier = library_motion(car, 0.0, car.q0, car.v0, None)
    np.testing.assert_allclose(acceleration[2:], 0.0, rtol=0, atol=1e-12)
    rate = 6.0 * np.tan(steer) / 2.7
    np.testing.assert_allclose(
        car.v0[jnp.array([2, 4, 5, 6])], rate, rtol=1e-13, atol=0
    )
    # Each axle moves on a circle with R² = (R in front)² + h² - d².
    points = car.points(0.0, car.q0)
    if steer == 0:
        np.testing.assert_allclose([p[1] for p in points.values()], 0.0, atol=1e-15)
        np.testing.assert_allclose(multiplier, 0.0, rtol=0, atol=1e-9)
        return
    centre = np.array([0.0, 2.7 / np.tan(steer)])
    square = centre[1] ** 2
    for i, (d, h) in enumerate(zip((3.0, 2.0, 4.0), (1.0, 0.0, 0.5), strict=True)):
        square += h**2 - d**2
        away = np.asarray(points[f"axle_{i + 1}"]) - centre
        assert away @ away == pytest.approx(square, rel=1e-13)


# A drive and a torque on a car with two trailers.
CONTROLS = (1200.0, 15.0)
DURATION, FINEST = 2.0, 0.01
LADDERS = {
    2: Ladder((0.02, 0.01), 200, DURATION, FINEST),
    3: Ladder((0.08, 0.04), 50, DURATION, FINEST),
}


def driven():
    q0 = (0.0, 0.0, 0.3, 0.2, 0.5, 0.1)
    return CarWithTrailers(2, steer_inertia=40.0, q0=q0)


@cache
def runs(stages, free=False):
    """Times, states and continuous multipliers, with one lane for each step size."""
    car = driven()
    args = tuple(jnp.asarray(0.0 if free else x) for x in CONTROLS)
    y0 = nhjax.initial_state(car.system, car.q0, car.v0, args=args)
    method = nhjax.LobattoIIIAB(stages)
    return LADDERS[stages].climb(car.system, method, y0, args)


@cache
def reference():
    """(q, v, forces of the ground) at the nodes of all runs, by the oracle."""
    car = driven()
    times = np.arange(201) * FINEST
    return Train(car).trajectory(np.asarray(car.q0), 5.0, 0.0, times, *CONTROLS)


@pytest.mark.parametrize("stages", [long(2), 3])
@pytest.mark.parametrize("part", range(3), ids=["q", "v", "multiplier"])
def test_motion_converges_to_reduced_equations(stages, part):
    _, states, continuous = runs(stages)
    found = (states.q, states.v, continuous)[part]
    LADDERS[stages].assert_order(2 * stages - 2, found, reference()[part])


def test_energy_equals_the_work_of_the_controls():
    car = driven()
    q, v, _ = reference()
    energy = [float(car.energy(0.0, q[k], v[k])) for k in (0, -1)]
    speed = v[:, 0] * np.cos(q[:, 2]) + v[:, 1] * np.sin(q[:, 2])
    # Simpson's rule.
    weights = np.array([1.0, *[4.0, 2.0] * 99, 4.0, 1.0]) * FINEST / 3
    work = CONTROLS[0] * weights @ speed + CONTROLS[1] * (q[-1, 3] - q[0, 3])
    assert energy[1] - energy[0] == pytest.approx(work, rel=1e-9)
    _, states, _ = runs(3)
    end = float(car.energy(0.0, states.q[1, -1], states.v[1, -1]))
    assert end - energy[0] == pytest.approx(work, rel=1e-6)


def test_invariants_without_controls_are_conserved_and_no_axle_slips():
    car = driven()
    _, states, _ = runs(3, free=True)
    q, v = states.q[0], states.v[0]
    start = car.invariants(0.0, car.q0, car.v0)
    values = jax.jit(jax.vmap(car.invariants, in_axes=(None, 0, 0)))(0.0, q, v)
    bounds = {"energy": 1e-6, "steer_momentum": 1e-12}
    for name, bound in bounds.items():
        error = np.asarray(values[name]) / float(start[name]) - 1
        assert np.max(np.abs(error)) < bound, name
    slips = jax.jit(jax.vmap(car.constraint, in_axes=(None, 0, 0, None)))(
        0.0, q, v, None
    )
    np.testing.assert_allclose(slips, 0.0, rtol=0, atol=2e-13)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_system_computes_in_precision_of_the_state(dtype):
    car = some_car(2, 6)
    t, q, v = jnp.zeros((), dtype), car.q0.astype(dtype), car.v0.astype(dtype)
    values = (
        car.lagrangian(t, q, v, None),
        car.constraint(t, q, v, None),
        car.force(t, q, v, (1.0, 2.0)),
        car.velocity(q, 3.0),
        *car.points(t, q).values(),
    )
    assert {value.dtype for value in values} == {jnp.dtype(dtype)}


def test_car_points_lie_along_the_train():
    car = CarWithTrailers(2, q0=(1.0, 2.0, 0.0, 0.3, 0.0, np.pi / 2))
    expected = {
        "rear_axle": (1.0, 2.0),
        "front_axle": (3.7, 2.0),
        "centre": (2.4, 2.0),
        "hitch_1": (0.0, 2.0),
        "axle_1": (-3.0, 2.0),
        "centre_1": (-2.7, 2.0),
        "hitch_2": (-4.0, 2.0),
        "axle_2": (-4.0, -1.0),
        "centre_2": (-4.0, -0.7),
    }
    points = car.points(0.0, car.q0)
    assert points.keys() == expected.keys()
    for name, point in points.items():
        np.testing.assert_allclose(point, expected[name], rtol=0, atol=1e-14)


def test_gradients_in_every_parameter_are_not_zero():
    car = some_car(2, 7)

    def value(car):
        slips = car.constraint(0.0, car.q0, car.v0 + 1.0, None)
        return car.lagrangian(0.0, car.q0, car.v0, None) + jnp.sum(slips**2)

    gradient = jax.jit(jax.grad(value))(car)
    # Nothing depends on where the car is.
    gradient = eqx.tree_at(lambda car: car.q0, gradient, gradient.q0[2:])
    for leaf in jax.tree.leaves(gradient):
        assert np.all(np.asarray(leaf) != 0)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: CarWithTrailers(-1), r"`num_trailers` must not be negative, got -1"),
        (lambda: CarWithTrailers(wheelbase=0.0), r"`wheelbase` must be positive"),
        (lambda: CarWithTrailers(mass=-1.0), r"`mass` must be positive, got -1"),
        (lambda: CarWithTrailers(trailer_length=0.0), r"`trailer_length` must be pos"),
        (
            lambda: CarWithTrailers(2, trailer_hitch=(1.0, 2.0, 3.0)),
            r"`trailer_hitch` must have shape \(2,\), got \(3,\)",
        ),
        (lambda: CarWithTrailers(q0=(0.0,) * 4), r"`q0` must have shape \(5,\)"),
        (lambda: CarWithTrailers(v0=(0.0,) * 4), r"`v0` must have shape \(5,\)"),
    ],
)
def test_car_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
