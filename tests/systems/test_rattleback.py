"""The rattleback against Newton and Euler, and against Kane and Levinson (1982)."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import make_interp_spline

import nhjax
from nhjax.systems import Rattleback
from support.machines import (
    accelerations,
    assert_orders,
    drifts,
    runs_of_three_stages,
    stack,
)
from support.rolling_bodies import (
    assert_newton_and_euler,
    ellipsoid,
    errors_of,
    kane_levinson,
    kane_levinson_field,
    matrix_of,
    random_states,
    RollingBody,
)


# a, b, c, h, M, A, B, C, D, σ, g, in the units of the paper: cm, kg and s.
PAPER = (20, 3, 2, 1, 1, 2, 16, 17, -0.2, 1, 981)
DAMPING = 1e-4


def newton_euler(stone):
    return RollingBody(
        float(stone.mass),
        np.asarray(stone.inertia),
        float(stone.gravity),
        ellipsoid(np.asarray(stone.semiaxes), float(stone.depth)),
        0.0 if stone.damping is None else float(stone.damping),
    )


STONES = {
    "default": Rattleback(),
    "damped": Rattleback(damping=DAMPING),
    "heavy": Rattleback(
        2.3, (0.15, 0.04, 0.03), 0.013, (3e-4, 2e-3, 1.9e-3), -1e-4, 1.6, 3e-4
    ),
}
DURATION = 0.5
COUNTS = (100, 200, 400)


@pytest.fixture(scope="module")
def found():
    return runs_of_three_stages(STONES["default"], COUNTS, DURATION)


@pytest.fixture(scope="module")
def errors_at():
    stone = STONES["default"]
    start = np.asarray(stone.q0[:4]), np.asarray(stone.v0[3:])
    return errors_of(newton_euler(stone), start, DURATION, COUNTS[-1])


@pytest.mark.parametrize("stone", STONES.values(), ids=STONES)
def test_accelerations_and_forces_equal_newton_euler(stone):
    body, states = newton_euler(stone), list(random_states(20))
    assert_newton_and_euler(stone, body, states, accelerations)


def test_accelerations_equal_equations_of_the_paper():
    stone, rng = STONES["damped"], np.random.default_rng(3)
    tilts, omegas = rng.uniform(-20, 20, (20, 2)), 3 * rng.standard_normal((20, 3))
    states, expected = [], []
    for tilt, omega in zip(tilts, omegas, strict=True):
        rolling = stone.rolling(Rattleback.spinning(0.0, tilt).q0[:4], omega)
        states.append((rolling.q0, rolling.v0))
        # Their second and third axes are the opposite of ours.
        state = (*np.deg2rad(tilt), *(omega * [1, -1, -1]))
        expected.append(kane_levinson(PAPER, state) * [1, -1, -1])
    slope, _, _ = accelerations(stone.system, *stack(states))
    size = np.max(np.abs(expected), axis=1, keepdims=True)
    np.testing.assert_allclose(slope[:, 3:] / size, expected / size, rtol=0, atol=1e-11)


def test_rattleback_default_parameters_equal_the_paper():
    stone = Rattleback()
    a, b, c, h, M, A, B, C, D, _, g = PAPER
    np.testing.assert_allclose(stone.semiaxes * 100, [a, b, c], rtol=1e-15)
    np.testing.assert_allclose(stone.moments * 1e4, [A, B, C], rtol=1e-15)
    np.testing.assert_allclose(stone.product * 1e4, -D, rtol=1e-15)
    np.testing.assert_allclose(stone.depth * 100, h, rtol=1e-15)
    np.testing.assert_allclose(stone.gravity * 100, g, rtol=1e-15)
    assert stone.mass == M


def test_rattleback_tilts_equal_angles_of_the_paper():
    stone = Rattleback.spinning(1.0, (8.0, 5.0))
    a, b = np.deg2rad([8.0, 5.0])
    up = matrix_of(stone.q0[:4])[2]
    expected = [np.cos(a) * np.sin(b), np.sin(a), np.cos(a) * np.cos(b)]
    np.testing.assert_allclose(up, expected, rtol=0, atol=1e-15)


def test_rattleback_at_rest_rocks_at_frequency_of_its_curvature():
    a, b, c, h, m, g, e = 0.2, 0.03, 0.02, 0.01, 1.0, 9.81, 1e-5
    rocking = []
    for turn in (*np.eye(2), *-np.eye(2)):
        quaternion = (np.cos(e / 2), *(np.sin(e / 2) * turn), 0.0)
        rolling = Rattleback().rolling(quaternion, (0.0, 0.0, 0.0))
        rocking.append((rolling.q0, rolling.v0))
    slope, _, _ = accelerations(Rattleback().system, *stack(rocking))
    stiffness = -(slope[:2, 3:5] - slope[2:, 3:5]).T / (2 * e)
    # About the first axis it rolls along the second one, and vice versa.
    lever = m * g * np.diag([b**2 / c - (c - h), a**2 / c - (c - h)])
    inertia = np.array([[2e-4, 2e-5], [2e-5, 1.6e-3]]) + m * (c - h) ** 2 * np.eye(2)
    expected = np.linalg.solve(inertia, lever)
    np.testing.assert_allclose(stiffness, expected, rtol=2e-6, atol=0)


@pytest.mark.long
def test_run_converges_with_method_order(found, errors_at):
    assert_orders(found, 4, errors_at, floor=1e-11)


@pytest.mark.long
def test_constraints_hold_to_round_off_and_energy_is_conserved(found):
    assert np.max(found.violation) < 1e-13
    drift = drifts(STONES["default"], found)["energy"]
    # Drifts of the spin's energy of 0.02 J; the coarsest runs take four times the
    # duration.
    largest = (5e-4, 2e-7, 5e-9)
    assert np.all(drift < largest), drift


@pytest.fixture(scope="module")
def first_reversal():
    """When and how the spin first vanishes, by the equations of the paper."""
    angle = np.deg2rad(0.5)

    def spin(t, y):
        return y[4]

    sol = solve_ivp(
        kane_levinson_field(PAPER),
        (0.0, 3.0),
        [angle, angle, 0.0, 0.0, -5.0],
        method="DOP853",
        rtol=1e-12,
        atol=1e-13,
        events=spin,
    )
    first = np.flatnonzero(np.diff(sol.t >= sol.t_events[0][0]))[0]
    assert np.all(sol.y[4, : first + 1] < 0)
    return sol.t_events[0][0], sol.y_events[0][0], sol.y[4, -1]


@pytest.fixture(scope="module")
def spins(first_reversal):
    """Damped stones that spin in both senses, until the first one stops spinning."""
    steps, (end, _, _) = 2000, first_reversal
    stones = [
        Rattleback.spinning(spin, (0.5, 0.5), damping=DAMPING) for spin in (5.0, -5.0)
    ]
    y0 = jax.tree.map(lambda *x: jnp.stack(x), *(s.initial_state() for s in stones))

    @eqx.filter_jit
    def run(stone, y0, dt):
        def along(y0):
            sol = nhjax.integrate(
                stone.system,
                nhjax.LobattoIIIAB(4),
                y0,
                dt=dt,
                num_steps=steps,
                saveat=nhjax.SaveAt(t0=True, steps=True),
            )
            q, v = sol.ys.q, sol.ys.v
            return sol.ts, v, jax.vmap(stone.energy)(sol.ts, q, v)

        return jax.vmap(along)(y0)

    return jax.tree.map(np.asarray, run(stones[0], y0, jnp.asarray(end / steps)))


@pytest.mark.long
def test_spin_reverses_at_the_time_of_the_paper(first_reversal, spins):
    _, v, _ = spins
    end, state, afterwards = first_reversal
    assert end == pytest.approx(2.38, abs=0.01)
    assert afterwards > 0
    np.testing.assert_allclose(v[0, -1, 3:], state[2:] * [1, -1, -1], atol=1e-5)
    assert abs(v[0, -1, 5]) < 1e-6


@pytest.mark.long
def test_spin_in_the_other_sense_does_not_reverse(spins):
    _, v, _ = spins
    assert np.all(v[1, :, 5] < -4.0)


@pytest.mark.long
def test_energy_lost_by_damping_equals_its_power(spins):
    for ts, v, energy in zip(*spins, strict=True):
        power = -DAMPING * np.sum(v[:, 3:] ** 2, axis=1)
        work = make_interp_spline(ts, power, k=7).integrate(ts[0], ts[-1])
        assert work < -1e-3
        np.testing.assert_allclose(energy[-1] - energy[0], work, rtol=1e-6)
    damped = STONES["damped"]
    assert damped.invariants(0.0, damped.q0, damped.v0) == {}


def test_rattleback_points_are_on_the_stone_and_on_the_plane():
    stone = Rattleback.spinning(0.0, (7.0, -4.0))
    points = stone.points(0.0, stone.q0)
    assert set(points) == {"centre_of_mass", "contact", "front", "back"}
    np.testing.assert_allclose(points["contact"], 0.0, rtol=0, atol=1e-17)
    span = points["front"] - points["back"]
    assert jnp.linalg.norm(span) == pytest.approx(0.4, rel=1e-14)
    middle = 0.5 * (points["front"] + points["back"]) - points["centre_of_mass"]
    assert jnp.linalg.norm(middle) == pytest.approx(0.01, rel=1e-12)
    # Every point of the ellipsoid is above the plane.
    rng = np.random.default_rng(0).standard_normal((500, 3))
    skin = rng / np.linalg.norm(rng, axis=1, keepdims=True) * [0.2, 0.03, 0.02]
    R = matrix_of(stone.q0[:4])
    heights = points["centre_of_mass"][2] + (skin + np.array([0, 0, 0.01])) @ R[2]
    assert np.min(heights) > 0


def test_system_computes_in_precision_of_the_state():
    stone = STONES["damped"]
    y0 = stone.initial_state(jnp.float32)
    assert y0.q.dtype == y0.v.dtype == y0.multiplier.dtype == jnp.float32
    wide = stone.initial_state()
    np.testing.assert_allclose(y0.multiplier, wide.multiplier, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Rattleback(mass=0.0), r"`mass` must be positive, got 0"),
        (lambda: Rattleback(gravity=-1.0), r"`gravity` must be positive, got -1"),
        (lambda: Rattleback(semiaxes=(1.0, 2.0)), r"`semiaxes` must have shape \(3,\)"),
        (lambda: Rattleback(moments=(1.0, -2.0, 1.0)), r"`moments` must be positive"),
        (lambda: Rattleback(product=1e-3), r"`product` must be smaller than .* 0\.001"),
        (lambda: Rattleback(damping=-1.0), r"`damping` must not be negative, got -1"),
        (
            lambda: replace(
                Rattleback(), v0=(0.0, 0.0, 0.0, 1.0, 0.0, 0.0)
            ).initial_state(),
            "constraint",
        ),
    ],
)
def test_rattleback_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
