"""The bicycle against Kane's method, and against the two papers of the benchmark."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import LeanToSteer, SteerTorque, WhippleBicycle
from oracles import bicycle as oracle
from oracles.library_motion import library_motion, motion_at
from oracles.orders import assert_order, rms, runs_of_all_steps


# Meijaard et al. (2007), section 5(b): M, C1, K0 and K2.
MATRICES = (
    [[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]],
    [[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]],
    [[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]],
    [[0.0, 76.59734589573222], [0.0, 2.65431523794604]],
)
# Table 2: the two real eigenvalues and the pair, which is real in the first row. In 50
# digits, the linear equations have these to 1e-13 but for 18.15788466125202 at 7 m/s.
EIGENVALUES = (
    (-5.53094371765393, -3.13164324790656, (3.13164324790656, 5.53094371765393)),
    (-7.11008014637442, -3.13423125066578, 3.52696170990070 + 0.8077402751993j),
    (-8.67387984831735, -3.07158645641514, 2.68234517512745 + 1.68066296590675j),
    (-10.35101467245920, -2.63366137253667, 1.70675605663975 + 2.31582447384325j),
    (-12.15861426576447, -1.42944427361326, 0.41325331521125 + 3.07910818603206j),
    (-14.07838969279822, -0.32286642900409, -0.77534188219585 + 4.46486771378823j),
    (-16.0853712309803, -0.00406690076970, -1.52644486584142 + 5.87673060598709j),
    (-18.15788466125262, 0.10268170574766, -2.13875644258362 + 7.19525913329805j),
    (-20.27940894394569, 0.14327879765713, -2.69348683581097 + 8.46037971396931j),
    (-22.43788559040858, 0.15790184030917, -3.21675402252485 + 9.69377351531791j),
    (-24.62459635017404, 0.16105338653172, -3.72016840437287 + 10.90681139476287j),
)
WEAVE, CAPSIZE = 4.29238253634111, 6.02426201538837

# Basu-Mandal et al. (2007), table 1. Their angles are psi of the lean, theta of the
# yaw, phi of the pitch, psif of the steer, betar and betaf of the wheels; x, y and z
# are of the rear wheel's centre, z upwards and x backwards.
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


def forces(on_wheels):
    rear, front = on_wheels
    return np.concatenate([rear[:2], front])


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
def test_accelerations_and_forces_of_the_ground_are_those_of_kanes_method(seed):
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
        multiplier, forces(on_wheels), rtol=0, atol=1e-12 * weight
    )


@pytest.mark.parametrize("seed", range(2))
def test_a_running_bicycle_satisfies_the_constraints_and_has_the_given_rates(seed):
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


def test_the_state_of_table_1_of_basu_mandal_is_consistent():
    bicycle = table_1()
    pitch = np.pi - STATE["phi"]
    np.testing.assert_allclose(bicycle.q0[4], pitch, rtol=0, atol=1.5e-13)
    names = ("thetad", "psid", "phid", "psifd", "betard", "betafd")
    np.testing.assert_allclose(
        in_their_coordinates(bicycle.v0), [RATES[n] for n in names], rtol=0, atol=2e-13
    )


def test_accelerations_are_those_of_table_1_of_basu_mandal():
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


def test_the_linear_equations_of_the_oracle_are_those_of_meijaard():
    for matrix, printed in zip(
        oracle.canonical(oracle.BENCHMARK), MATRICES, strict=True
    ):
        np.testing.assert_allclose(matrix, printed, rtol=0, atol=1.5e-14 * 10)


@pytest.fixture(scope="module")
def multipliers():
    """A function (speeds, step sizes) -> eigenvalues of the linearised step.

    Lean, steer and their rates make a consistent state, a step follows, and its
    derivative is that of the same four numbers at its end. The mode exp(λ h) has the
    logarithm λ h.
    """
    system = WhippleBicycle().system
    method = nhjax.LobattoIIIAB(5)

    def monodromy(speed, h):
        def after(z):
            lean, steer, *rates = z
            start = WhippleBicycle.running(speed, *rates, lean=lean, steer=steer)
            q, v = start.q0, start.v0
            _, multiplier = motion_at(system, 0.0, q, v)
            p = system.momentum(0.0, q, v)
            y = nhjax.State(q, v, p, jax.lax.stop_gradient(multiplier))
            y = nhjax.step(system, method, 0.0, h, y, throw=False)
            return jnp.stack([y.q[3], y.q[5], y.v[3], y.v[5]])

        return jax.jacfwd(after)(jnp.zeros(4))

    @jax.jit
    def of_all(speeds, hs):
        return jax.vmap(lambda h: jax.vmap(monodromy, (0, None))(speeds, h))(hs)

    def eigenvalues(speeds, h):
        """Richardson's extrapolation from h, 3h/4 and h/2: the errors are h⁸, h¹⁰..."""
        hs = h * np.array([1.0, 0.75, 0.5])
        steps = np.asarray(of_all(jnp.asarray(speeds, float), jnp.asarray(hs)))
        found = [
            [np.sort_complex(np.log(np.linalg.eigvals(A).astype(complex))) for A in row]
            for row in steps
        ]
        rates = np.array(found) / hs[:, None, None]
        terms = (hs[:, None] / h) ** np.array([0, 8, 10])
        return np.einsum("h,hvk->vk", np.linalg.inv(terms)[0], rates)

    return eigenvalues


def printed_eigenvalues():
    rows = []
    for *real, pair in EIGENVALUES:
        both = pair if isinstance(pair, tuple) else (pair, np.conj(pair))
        rows.append(np.sort_complex(np.array([*real, *both])))
    return np.array(rows)


def test_eigenvalues_are_those_of_table_2_of_meijaard(multipliers):
    found = multipliers(np.arange(11.0), 0.015)
    np.testing.assert_allclose(found, printed_eigenvalues(), rtol=0, atol=2e-12)


def test_small_steps_have_derivatives_also_at_rest(multipliers):
    # At rest the derivatives of multipliers are smaller than their round-off, which
    # grows like 1 / h.
    found = multipliers(np.arange(11.0), 0.004)
    np.testing.assert_allclose(found, printed_eigenvalues(), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("printed", "first"),
    [(WEAVE, "complex"), (CAPSIZE, "real")],
    ids=["weave", "capsize"],
)
def test_the_speeds_at_which_it_is_as_stable_as_not_are_the_printed(
    multipliers, printed, first
):
    speeds = np.round(printed, 2) + 0.002 * np.arange(-5, 6)
    eigenvalues = multipliers(speeds, 0.015)
    oscillates = np.abs(eigenvalues.imag) > 1e-3
    assert np.all(oscillates.sum(axis=1) == 2)
    chosen = oscillates if first == "complex" else ~oscillates
    growth = np.max(np.where(chosen, eigenvalues.real, -np.inf), axis=1)
    # The speed as a polynomial in the growth rate, at zero.
    (speed,) = np.polynomial.Polynomial.fit(growth, speeds, 4)(np.zeros(1))
    assert speed == pytest.approx(printed, rel=0, abs=4e-12)


GAINS = np.array([-3.0, 5.0])
STEERED = LeanToSteer(*GAINS)


def test_a_rider_who_steers_into_the_fall_gives_that_torque():
    parameters = oracle.BENCHMARK

    def found(*where):
        bicycle = WhippleBicycle.running(4.0, *where[2:], lean=where[0], steer=where[1])
        q, v = bicycle.q0, bicycle.v0
        steered = WhippleBicycle(steering=STEERED)
        return np.asarray(q), np.asarray(v), library_motion(steered, 0.0, q, v)[0]

    q, v, acceleration = found(0.3, -0.2, 0.5, -0.4)
    expected, _ = oracle.accelerations(parameters, q, v, float(GAINS @ [q[3], v[3]]))
    np.testing.assert_allclose(acceleration, expected, rtol=0, atol=1e-11)
    small = 1e-4 * np.array([0.3, -0.2, 0.5, -0.4])
    linear = oracle.linear_motion(parameters, 4.0, GAINS)[2:] @ small
    acceleration = found(*small)[2][jnp.array([3, 5])]
    np.testing.assert_allclose(acceleration, linear, rtol=1e-6)


def test_the_default_lean_to_steer_makes_slow_running_stable():
    gains = (float(LeanToSteer().lean_gain), float(LeanToSteer().lean_rate_gain))
    for speed in (2.0, 3.0, 4.0, 5.0, 6.0):
        steered = oracle.linear_motion(oracle.BENCHMARK, speed, gains)
        assert np.max(np.linalg.eigvals(steered).real) < 0
    free = oracle.linear_motion(oracle.BENCHMARK, 2.0)
    assert np.max(np.linalg.eigvals(free).real) > 2


# The run of the library of benchmarks of IFToMM: 5 s from 4.6 m/s with a lean rate of
# 0.5 rad/s, and its half with half of the step; with two stages a rider steers.
BICYCLES = {2: WhippleBicycle(steering=STEERED), 3: WhippleBicycle()}
NUM_STEPS = {2: 1000, 3: 200}
STEP_SIZES = {2: (0.005, 0.0025), 3: (0.025, 0.0125)}
DURATION, FINEST = 2.5, 0.0025


@cache
def runs(stages):
    """Times, states and continuous multipliers, with one lane for each step size."""
    bicycle = BICYCLES[stages]
    sol = runs_of_all_steps(
        bicycle.system,
        nhjax.LobattoIIIAB(stages),
        bicycle.initial_state(),
        jnp.array(STEP_SIZES[stages]),
        NUM_STEPS[stages],
        None,
        nhjax.SimplifiedNewton(),
    )
    assert np.all(np.asarray(sol.stats["failed_step"]) == -1)
    return jax.tree.map(np.asarray, (sol.ts, *sol.ys))


def rider(_, q, v):
    """The torque of `STEERED`."""
    return float(GAINS @ [q[3], v[3]])


@cache
def reference(stages):
    """The motion by Kane's method at all nodes, and the forces of the ground."""
    bicycle = BICYCLES[stages]
    start = np.asarray(bicycle.q0), np.asarray(bicycle.v0)
    torque = (lambda t, q, v: 0.0) if bicycle.steering is None else rider
    times = np.arange(1001) * FINEST
    q, v = oracle.trajectory(oracle.BENCHMARK, *start, times, torque)
    reactions = [
        forces(oracle.accelerations(oracle.BENCHMARK, *state, torque(0.0, *state))[1])
        for state in zip(q, v, strict=True)
    ]
    return q, v, np.array(reactions)


@pytest.mark.parametrize("stages", [2, 3], ids=["steered-2", "free-3"])
@pytest.mark.parametrize("part", range(3), ids=["q", "v", "multiplier"])
def test_the_motion_converges_to_that_of_kanes_method(stages, part):
    _, states, continuous = runs(stages)
    found = (states.q, states.v, continuous)[part]
    counts, errors = [], []
    for lane, h in enumerate(STEP_SIZES[stages]):
        count, stride = round(DURATION / h), round(h / FINEST)
        expected = reference(stages)[part][stride::stride]
        counts.append(count)
        errors.append(rms(found[lane, :count] - expected))
    assert_order(2 * stages - 2, counts, errors, floor=1e-11)


@cache
def checks(stages):
    """Energy, slip and depth at the nodes of the longest run, and energy before it."""
    bicycle = BICYCLES[stages]

    @jax.jit
    @jax.vmap
    def at(q, v):
        slip = bicycle.constraint(0.0, q, v, None)
        return bicycle.energy(0.0, q, v), slip, bicycle.holonomic(0.0, q, None)

    _, states, _ = runs(stages)
    start = float(bicycle.energy(0.0, bicycle.q0, bicycle.v0))
    return *map(np.asarray, at(states.q[0], states.v[0])), start


@pytest.mark.parametrize("stages", [2, 3], ids=["steered-2", "free-3"])
def test_constraints_hold_in_a_run_of_five_seconds(stages):
    _, slip, depth, _ = checks(stages)
    np.testing.assert_allclose(slip, 0.0, atol=2e-13)
    np.testing.assert_allclose(depth, 0.0, atol=2e-15)


def test_energy_stays_in_a_run_of_five_seconds():
    energy, _, _, start = checks(3)
    # The library of benchmarks allows 1e-5.
    assert np.max(np.abs(energy / start - 1)) < 5e-7


def test_the_rider_does_the_work_that_becomes_energy():
    bicycle = BICYCLES[2]
    q, v, _ = reference(2)
    power = np.array([rider(0.0, *x) * x[1][5] for x in zip(q, v, strict=True)])
    # Simpson's rule.
    work = np.array([1.0, *[4.0, 2.0] * 499, 4.0, 1.0]) @ power * FINEST / 3
    start, end = (float(bicycle.energy(0.0, q[k], v[k])) for k in (0, -1))
    assert abs(work) > 0.1
    assert end - start == pytest.approx(work, rel=1e-6)
    _, states, _ = runs(2)
    coarse, fine = (
        float(bicycle.energy(0.0, states.q[lane, k], states.v[lane, k]))
        for lane, k in ((0, 499), (1, 999))
    )
    assert (4 * fine - coarse) / 3 - start == pytest.approx(work, rel=1e-3)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_it_computes_in_the_precision_of_the_state(dtype):
    bicycle = WhippleBicycle(steering=STEERED)
    t, q, v = jnp.zeros((), dtype), bicycle.q0.astype(dtype), bicycle.v0.astype(dtype)
    values = (
        bicycle.lagrangian(t, q, v, None),
        bicycle.constraint(t, q, v, None),
        bicycle.holonomic(t, q, None),
        bicycle.force(t, q, v, None),
        *bicycle.points(t, q).values(),
    )
    assert {value.dtype for value in values} == {jnp.dtype(dtype)}


def test_gradients_reach_every_parameter():
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


def test_its_points_are_those_of_the_upright_bicycle_and_turn_with_it():
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


def test_energy_is_an_invariant_only_without_a_torque():
    free, steered = WhippleBicycle(), WhippleBicycle(steering=STEERED)
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
def test_a_bad_parameter_is_named(parameters, message):
    with pytest.raises(ValueError, match=message):
        WhippleBicycle(**parameters)
