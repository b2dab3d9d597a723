"""Imported models compared with results of SymPy and PyDy, and with the gallery."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import nhjax
from benchmarks import _sympy_models as sympy_models
from benchmarks.sympy_models import particles, seconds
from nhjax import LobattoIIIAB, systems
from support.rolling_bodies import kane_levinson_field


@pytest.fixture(scope="module")
def bicycle():
    return sympy_models.bicycle()


@pytest.fixture(scope="module")
def disc():
    return sympy_models.rolling_disc()


@pytest.fixture(scope="module")
def stone():
    return sympy_models.rattleback()


def printed_by_sympy(v):
    """The matrix of the linear equations for (lean, steer) and their rates at speed v.

    SymPy 1.14, sympy/physics/mechanics/tests/test_kane3.py, `Res`.
    """
    return np.array(
        [
            [0, 0, 1, 0],
            [0, 0, 0, 1],
            [
                9.48977444677355,
                -0.891197738059089 * v**2 - 0.571523173729245,
                -0.105522449805691 * v,
                -0.330515398992311 * v,
            ],
            [
                11.7194768719633,
                -1.97171508499972 * v**2 + 30.9087533932407,
                3.67680523332152 * v,
                -3.08486552743311 * v,
            ],
        ]
    )


@pytest.mark.long
@pytest.mark.parametrize("speed", range(6))
def test_sympy_bicycle_when_upright_has_published_coefficients(bicycle, speed):
    rolling = {"x": speed, "q3": speed / 0.3, "q6": speed / 0.35}
    y = bicycle.initial_state(q={}, v=rolling)
    place = [bicycle.coordinates.index(name) for name in ("q2", "q5", "q3")]
    found = nhjax.linear_stability(
        bicycle.system, 0.0, y, bicycle.args, positions=place[:2], velocities=place
    )
    expected = printed_by_sympy(speed)
    # SymPy's own test has the tolerance 1e-12.
    np.testing.assert_allclose(found.matrix[:4, :4], expected, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.matrix[4], 0, atol=1e-12)
    for value in np.linalg.eigvals(expected):
        assert np.min(np.abs(np.asarray(found.eigenvalues) - value)) < 1e-10


def test_sympy_benchmark_models_have_equal_accelerations():
    pair = particles()
    both = [system.energy(0.0, y) for system, y in (pair.by_hand, pair.imported)]
    np.testing.assert_allclose(both[0], both[1], rtol=1e-14)
    assert seconds(*pair.imported, "run") > 0


def accelerations_of(model):
    return jax.jit(lambda y: nhjax.motion(model.system, 0.0, y, model.args))


def rolling_state(model, q, v, free=("x", "y")):
    """The state whose velocities of `free` follow from the constraints."""
    place = [model.coordinates.index(name) for name in free]
    zero = jnp.zeros(())
    q, v = model._array("q", q), model._array("v", v)
    slopes = jax.jacfwd(lambda v: model.system.constraint(zero, q, v, model.args))
    violation = model.system.constraint(zero, q, v, model.args)
    v = v.at[jnp.array(place)].add(
        -jnp.linalg.solve(slopes(v)[:, jnp.array(place)], violation)
    )
    return nhjax.initial_state(model.system, q, v, args=model.args)


@pytest.mark.parametrize(("lean", "turn"), [(0.3, 1.7), (-0.8, 0.6), (1.1, -2.5)])
def test_sympy_disc_at_pydys_steady_turn_has_no_acceleration(disc, lean, turn):
    """PyDy, examples/rollingdisc/rollingdisc.py: Fr[0] + Fr_star_steady[0] = 0."""
    r, m, g, across, axial = (float(disc.args[x]) for x in ("r", "m", "g", "I", "J"))
    sin, cos = np.sin(lean), np.cos(lean)
    from_turn = g * m * r * sin + (axial - across + m * r**2) * sin * cos * turn**2
    spin = -from_turn / ((axial + m * r**2) * cos * turn)
    y = rolling_state(disc, {"q1": lean}, {"q0": turn, "q2": spin})
    # The contact point moves on a circle, and angles change at constant rates.
    found = accelerations_of(disc)(y).acceleration
    np.testing.assert_allclose(found[2:], 0, atol=1e-12)
    np.testing.assert_allclose(
        np.hypot(*found[:2]), np.abs(turn * np.hypot(*y.v[:2])), rtol=1e-12
    )


@pytest.mark.long
def test_sympy_disc_integrated_agrees_with_gallery(disc):
    """The gallery's disc uses SE(3), z upward, and the axle as third body axis."""
    q, v = {"q1": 0.4, "q0": 0.0, "q2": 0.0}, {"q0": 1.2, "q1": -0.3, "q2": 5.0}
    y0 = rolling_state(disc, q, v)
    attitude = Rotation.from_euler("x", 0.4).as_matrix()
    upward = np.diag([1.0, -1.0, -1.0])
    # The axes of the gallery's body in those of PyDy's: forward, down, axle.
    axes = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]).T
    omega = np.array([-0.3, 1.2 * np.sin(0.4) + 5.0, 1.2 * np.cos(0.4)])
    turned = Rotation.from_matrix(upward @ attitude @ axes)
    r, m, g, across, axial = (float(disc.args[x]) for x in ("r", "m", "g", "I", "J"))
    body = systems.RollingTorus(m, r, 0.0, across, axial, g).rolling(
        *map(jnp.asarray, (np.roll(turned.as_quat(), 1), axes.T @ omega))
    )
    method, options = LobattoIIIAB(5), {"dt": 0.02, "num_steps": 25}
    ours = nhjax.integrate(disc.system, method, y0, args=disc.args, **options)
    theirs = nhjax.integrate(body.system, method, body.initial_state(), **options)
    x, y, yaw, lean, _ = ours.ys.q[-1]
    sideways = r * np.sin(lean)
    centre = [x + sideways * -np.sin(yaw), y + sideways * np.cos(yaw)]
    centre = np.array([*centre, -r * np.cos(lean)]) * [1, -1, -1]
    np.testing.assert_allclose(theirs.ys.q[-1, 4:], centre, rtol=0, atol=1e-10)
    energies = [
        disc.system.energy(0.0, y0, disc.args),
        body.energy(0.0, body.q0, body.v0),
    ]
    np.testing.assert_allclose(energies[0], energies[1], rtol=1e-13)


# PyDy at 90305f0, examples/rattleback/ellipsoid_no_slip.py, with the parameters of
# cpp/ellipsoid_sim.cc: lean, pitch, ω in the body | its rate | the force of the plane |
# kinetic energy, from the expressions M_dyn, f_dyn, f_cf and ke that it prints.
PYDY = (
    (
        (0.008726646259971648, 0.008726646259971648, 0.0, 0.0, -5.0),
        (-2.595500960745649, -86.93138489997983, 4.775591138843424),
        (0.4528309540799537, -0.37755501084754695, -8.304712244227392),
        0.025030400273947637,
    ),
    (
        (0.3, -0.2, 0.7, -0.4, 1.5),
        (-10.148015053204151, 50.81803230351619, -16.46365035121413),
        (-1.382348161679493, 0.012730769882895926, -0.7633040803733162),
        0.03982848787819066,
    ),
)


def rates_of_angles(lean, pitch, omega):
    """The rates of yaw, lean and pitch that belong to ω in the body."""
    yaw = (omega[2] * np.cos(pitch) - omega[0] * np.sin(pitch)) / np.cos(lean)
    tilt = omega[0] * np.cos(pitch) + omega[2] * np.sin(pitch)
    return yaw, tilt, omega[1] - yaw * np.sin(lean)


def angular_velocity(q, v):
    (_, lean, pitch), (yaw, tilt, roll) = q[:3], v[:3]
    return jnp.stack(
        [
            tilt * jnp.cos(pitch) - yaw * jnp.cos(lean) * jnp.sin(pitch),
            roll + yaw * jnp.sin(lean),
            tilt * jnp.sin(pitch) + yaw * jnp.cos(lean) * jnp.cos(pitch),
        ]
    )


def stone_at(stone, lean, pitch, omega):
    yaw, tilt, roll = rates_of_angles(lean, pitch, np.array(omega))
    down = np.array(
        [-np.cos(lean) * np.sin(pitch), np.sin(lean), np.cos(lean) * np.cos(pitch)]
    )
    axes = np.array([0.2, 0.03, 0.02])
    height = np.sqrt(np.sum((axes * down) ** 2)) - 0.01 * down[2]
    q = {"q0": 0.4, "q1": lean, "q2": pitch, "z": -height}
    return rolling_state(stone, q, {"q0": yaw, "q1": tilt, "q2": roll}, ("x", "y", "z"))


@pytest.mark.parametrize("printed", PYDY)
def test_sympy_rattleback_agrees_with_pydy_accelerations_and_forces(stone, printed):
    (lean, pitch, *omega), rates, force, kinetic = printed
    y = stone_at(stone, lean, pitch, omega)
    found = accelerations_of(stone)(y)
    _, slope = jax.jvp(angular_velocity, (y.q, y.v), (y.v, found.acceleration))
    np.testing.assert_allclose(slope, rates, rtol=1e-11)
    np.testing.assert_allclose(found.multiplier, force, rtol=1e-11)
    np.testing.assert_allclose(0.5 * y.p @ y.v, kinetic, rtol=1e-13)


def test_sympy_rattleback_integrated_reverses_as_published(stone):
    angle = np.deg2rad(0.5)
    y0 = stone_at(stone, angle, angle, (0.0, 0.0, -5.0))
    options = {"dt": 0.001, "num_steps": 400, "args": stone.args}
    sol = nhjax.integrate(stone.system, LobattoIIIAB(4), y0, **options)
    field = kane_levinson_field((20, 3, 2, 1, 1, 2, 16, 17, -0.2, 1, 981))
    start = [angle, angle, 0.0, 0.0, -5.0]
    end = solve_ivp(field, (0.0, 0.4), start, method="DOP853", rtol=1e-11, atol=1e-13)
    q, v = sol.ys.q[-1], sol.ys.v[-1]
    found = [*q[1:3], *angular_velocity(q, v)]
    np.testing.assert_allclose(found, end.y[:, -1], rtol=0, atol=1e-8)
