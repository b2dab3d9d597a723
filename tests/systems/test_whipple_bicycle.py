"""The bicycle against Kane's method, and against accelerations in print."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax.systems import LeanToSteer, SteerTorque, WhippleBicycle
from support import bicycle as oracle
from support.library_motion import library_motion


# Basu-Mandal et al. (2007), table 1. Their angles are psi (lean), theta (yaw), phi
# (pitch), psif (steer), betar and betaf (wheels); x, y and z belong to the rear wheel's
# centre, z upwards and x backwards.
STATE = {"psi": 0.9501292851472, "phi": 3.1257073014894, "psif": 0.2311385135743}
RATES = {
    "xd": -2.8069345714545,
    "yd": -0.1480982396001,
    "zd": 0.1058778746261,
    "thetad": 0.7830033527065,
    "psid": 0.6068425835418,
    "phid": -0.0119185528069,
    "psifd": 0.4859824687093,
    "betard": 8.9129896614890,
    "betafd": 8.0133620584155,
}
ACCELERATIONS = {
    "xdd": -0.5041626315047,
    "ydd": -0.3449706619454,
    "zdd": -1.4604528332980,
    "thetadd": 0.8353281706379,
    "psidd": -7.8555281128244,
    "phidd": 0.1205543897884,
    "psifdd": -4.6198904039403,
    "betardd": 1.8472554144217,
    "betafdd": 2.4548072904550,
}
HEIGHT = 0.2440472102925


def other_bicycle(seed):
    """A bicycle that is not the benchmark, somewhere in the plane."""
    random = np.random.default_rng(seed)
    names = [name for name in WhippleBicycle.__dataclass_fields__ if name[1] != "0"]
    default = WhippleBicycle()
    changed = {
        name: getattr(default, name) * random.uniform(0.8, 1.25)
        for name in names
        if name != "steering"
    }
    lean, steer, lean_rate, steer_rate = random.uniform(-0.7, 0.7, 4)
    bicycle = WhippleBicycle.running(
        random.uniform(1.0, 8.0),
        lean_rate,
        steer_rate,
        lean=lean,
        steer=steer,
        steering=SteerTorque(),
        **changed,
    )
    x, y, yaw, rear, front = random.uniform(-3.0, 3.0, 5)
    cos, sin = np.cos(yaw), np.sin(yaw)
    dx, dy = bicycle.v0[:2]
    q = bicycle.q0.at[jnp.array([0, 1, 2, 6, 7])].set(
        jnp.array([x, y, yaw, rear, front])
    )
    v = bicycle.v0.at[:2].set(jnp.stack([cos * dx - sin * dy, sin * dx + cos * dy]))
    return bicycle, q, v, random.uniform(-5.0, 5.0)


@pytest.mark.parametrize("seed", range(6))
def test_accelerations_and_ground_forces_equal_kanes_method(seed):
    bicycle, q, v, torque = other_bicycle(seed)
    parameters = oracle.parameters_of(bicycle)
    expected, on_wheels = oracle.accelerations(
        parameters, np.asarray(q), np.asarray(v), torque
    )
    acceleration, multiplier = library_motion(bicycle, 0.0, q, v, jnp.asarray(torque))
    scale = np.max(np.abs(expected))
    np.testing.assert_allclose(acceleration, expected, rtol=0, atol=1e-12 * scale)
    weight = float(bicycle.gravity * bicycle.rear_frame_mass)
    np.testing.assert_allclose(
        multiplier, oracle.forces(on_wheels), rtol=0, atol=1e-12 * weight
    )


@pytest.mark.parametrize("seed", range(2))
def test_bicycle_with_given_rates_satisfies_its_constraints(seed):
    bicycle, q, v, _ = other_bicycle(seed)
    np.testing.assert_allclose(bicycle.constraint(0.0, q, v, None), 0.0, atol=2e-14)
    np.testing.assert_allclose(bicycle.holonomic(0.0, q, None), 0.0, atol=1e-15)
    track = oracle.rear_path_velocity(oracle.parameters_of(bicycle), q, v)
    np.testing.assert_allclose(v[:2], track, rtol=0, atol=2e-14)


def table_1():
    """The state of table 1, made from its lean, steer and their rates and the speed."""
    return WhippleBicycle.running(
        0.3 * RATES["betard"],
        -RATES["psid"],
        -RATES["psifd"],
        lean=np.pi / 2 - STATE["psi"],
        steer=-STATE["psif"],
    )


def in_their_coordinates(rates):
    """Rates of yaw, lean, pitch, steer and wheels, or their accelerations."""
    return -np.asarray(rates)[2:]


def test_published_bicycle_state_is_consistent():
    bicycle = table_1()
    pitch = np.pi - STATE["phi"]
    np.testing.assert_allclose(bicycle.q0[4], pitch, rtol=0, atol=1.5e-13)
    names = ("thetad", "psid", "phid", "psifd", "betard", "betafd")
    np.testing.assert_allclose(
        in_their_coordinates(bicycle.v0), [RATES[n] for n in names], rtol=0, atol=2e-13
    )


def test_accelerations_of_bicycle_equal_published_ones():
    bicycle = table_1()
    q, v = bicycle.q0, bicycle.v0
    a, _ = library_motion(bicycle, 0.0, q, v, None)
    names = ("thetadd", "psidd", "phidd", "psifdd", "betardd", "betafdd")
    # The digits of the state that are not printed amount to some 5e-13.
    np.testing.assert_allclose(
        in_their_coordinates(a), [ACCELERATIONS[n] for n in names], rtol=0, atol=2e-12
    )

    def hub(t):
        return bicycle.points(0.0, q + v * t + 0.5 * a * t**2)["rear_hub"]

    @jax.jit
    def derivatives(t):
        velocity = jax.jacfwd(hub)
        return hub(t), velocity(t), jax.jacfwd(velocity)(t)

    theirs = np.array([-1.0, -1.0, 1.0])
    position, velocity, acceleration = (theirs * x for x in derivatives(0.0))
    assert position[2] == pytest.approx(HEIGHT, rel=0, abs=1e-13)
    rates = [RATES[n] for n in ("xd", "yd", "zd")]
    np.testing.assert_allclose(velocity, rates, rtol=0, atol=2e-13)
    accelerations = [ACCELERATIONS[n] for n in ("xdd", "ydd", "zdd")]
    np.testing.assert_allclose(acceleration, accelerations, rtol=0, atol=2e-12)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_system_computes_in_precision_of_the_state(dtype):
    bicycle = WhippleBicycle(steering=LeanToSteer())
    t, q, v = jnp.zeros((), dtype), bicycle.q0.astype(dtype), bicycle.v0.astype(dtype)
    values = (
        bicycle.lagrangian(t, q, v, None),
        bicycle.constraint(t, q, v, None),
        bicycle.holonomic(t, q, None),
        bicycle.force(t, q, v, None),
        *bicycle.points(t, q).values(),
    )
    assert {value.dtype for value in values} == {jnp.dtype(dtype)}


def test_gradients_in_every_parameter_are_not_zero():
    bicycle, q, v, _ = other_bicycle(3)

    def value(bicycle):
        slip = bicycle.constraint(0.0, q, v, None)
        depth = bicycle.holonomic(0.0, q, None)
        return bicycle.energy(0.0, q, v) + jnp.sum(slip**2) + jnp.sum(slip) + depth[0]

    gradient = jax.jit(jax.grad(value))(bicycle)
    names = [name for name in WhippleBicycle.__dataclass_fields__ if name[1] != "0"]
    for name in names:
        if name != "steering":
            assert np.all(np.asarray(getattr(gradient, name)) != 0), name


def test_bicycle_points_rotate_with_the_upright_bicycle():
    bicycle = WhippleBicycle()
    points = bicycle.points(0.0, bicycle.q0)
    expected = {
        "rear_contact": (0.0, 0.0, 0.0),
        "rear_hub": (0.0, 0.0, 0.3),
        "rear_frame": (0.3, 0.0, 0.9),
        "head": (1.1 - 0.9 * np.tan(np.pi / 10), 0.0, 0.9),
        "front_frame": (0.9, 0.0, 0.7),
        "front_hub": (1.02, 0.0, 0.35),
        "front_contact": (1.02, 0.0, 0.0),
    }
    assert points.keys() == expected.keys()
    for name, point in points.items():
        np.testing.assert_allclose(point, expected[name], rtol=0, atol=1e-15)
    leaning = WhippleBicycle.running(lean=0.4, steer=0.2)
    points = leaning.points(0.0, leaning.q0)
    # To the right, which is where y is negative.
    assert points["rear_frame"][1] < -0.3
    for end, radius in (("rear", 0.3), ("front", 0.35)):
        spoke = points[f"{end}_hub"] - points[f"{end}_contact"]
        assert np.linalg.norm(spoke) == pytest.approx(radius, rel=1e-14)
        assert abs(points[f"{end}_contact"][2]) < 1e-15


def test_invariants_without_torque_contain_energy():
    free, steered = WhippleBicycle(), WhippleBicycle(steering=LeanToSteer())
    assert free.invariants(0.0, free.q0, free.v0).keys() == {"energy"}
    assert steered.invariants(0.0, free.q0, free.v0) == {}
    assert free.system.force is None
    np.testing.assert_array_equal(free.force(0.0, free.q0, free.v0, None), 0.0)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"wheelbase": 0.0}, r"`wheelbase` must be positive, got 0"),
        ({"gravity": -9.81}, r"`gravity` must be positive, got -9\.81"),
        ({"rear_radius": 0.0}, r"`rear_radius` must be positive"),
        ({"front_wheel_mass": -1.0}, r"`front_wheel_mass` must be positive"),
        ({"rear_frame_inertia": (9.2, 0.0, 2.8, 2.4)}, r"`rear_frame_inertia` must be"),
        ({"front_frame_inertia": (1.0, 2.0)}, r"`front_frame_inertia` .* shape \(4,\)"),
        (
            {"rear_frame_centre": (1.0, 0.0, 2.0)},
            r"`rear_frame_centre` .* shape \(2,\)",
        ),
        ({"front_wheel_inertia": (1.0,)}, r"`front_wheel_inertia` must have shape"),
        ({"v0": (1.0, 2.0)}, r"`v0` must have shape \(8,\), got \(2,\)"),
    ],
)
def test_bicycle_parameter_out_of_range_raises(parameters, message):
    with pytest.raises(ValueError, match=message):
        WhippleBicycle(**parameters)
