"""Stability of relative equilibria, compared with closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

import nhjax
from nhjax.systems import FreeRigidBody, HeavyTop, RollingTorus, SphericalPendulum
from support.group_problems import both_forms
from support.rolling_bodies import matrix_of, RollingBody, torus


AXIS = jnp.asarray([0.0, 0.0, 1.0])
# A flat disc and a tyre. Their parameters are arguments of one compiled program.
DISC = RollingTorus(1.3, 0.4, 0.0, 0.05, 0.11)
TYRE = RollingTorus(1.7, 0.4, 0.06, 0.15, 0.28)


def about_vertical(q):
    """The generator of the rotations of space about the vertical, on SO(3)."""
    return nhjax.SO3().Ad(nhjax.SO3().inverse(q), AXIS)


def on_axis(q):
    return AXIS


def assert_eigenvalues(stability, expected, atol=1e-12):
    found, expected = np.asarray(stability.eigenvalues), np.asarray(expected)
    assert found.shape == expected.shape
    distance = np.abs(found[:, None] - expected)
    assert np.max(distance[linear_sum_assignment(distance)]) < atol


def rolling(body, attitude, omega):
    body = body.rolling(attitude, omega)
    return nhjax.linear_stability(
        body.system, 0.0, body.initial_state(), symmetry=body.symmetry
    )


def numbers(body):
    names = ["mass", "radius", "diametral_inertia", "axial_inertia", "gravity"]
    return (float(getattr(body, name)) for name in names)


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_linear_stability_of_a_rolling_disc_has_the_critical_speed(ratio):
    # λ² (I + m a²) = m g a - J (J + m a²) ω² / I: Neimark and Fufaev.
    m, a, diametral, axial, g = numbers(DISC)
    contact = axial + m * a**2
    omega = ratio * np.sqrt(m * g * a * diametral / (axial * contact))
    square = m * g * a * (1 - ratio**2) / (diametral + m * a**2)
    root = np.sqrt(complex(square))
    half = np.sqrt(0.5)
    stability = rolling(DISC, (half, half, 0.0, 0.0), (0.0, 0.0, omega))
    # The two zero eigenvalues change the speed and the turning rate.
    assert_eigenvalues(stability, [root, -root, 0, 0])


@pytest.mark.parametrize("ratio", [0.9, 1.1])
def test_linear_stability_of_a_spinning_disc_has_the_critical_rate(ratio):
    # λ² = m g a / (I + m a²) - Ω²
    m, a, diametral, _, g = numbers(DISC)
    square = m * g * a / (diametral + m * a**2)
    root = np.sqrt(complex(square * (1 - ratio**2)))
    # The direction of the axle in the plane and the angle of the wheel are arbitrary.
    attitude = np.array([0.5, 0.5, 0.5, 0.5])
    up = matrix_of(attitude)[2]
    stability = rolling(DISC, attitude, ratio * np.sqrt(square) * up)
    assert_eigenvalues(stability, [root, -root, 0, 0])


def rates_in_angles(oracle, state):
    """The rates of the tilt and of ω along the axes (horizontal, up the disc, axle).

    These axes do not roll with the body, but turn with its plane.
    """
    tilt, omega = state[0], state[1:]
    c, s = np.cos(tilt), np.sin(tilt)
    attitude = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    _, slope, _ = oracle.accelerations(attitude, omega)
    # ω = (θ̇, Ω sin θ, Ω cos θ + ψ̇) with the rate ψ̇ of rolling.
    roll = np.array([0, 0, omega[2] - omega[1] * c / s])
    return np.append(omega[0], slope + np.cross(roll, omega))


@pytest.mark.parametrize("body", [DISC, TYRE], ids=["disc", "tyre"])
def test_linear_stability_of_circling_wheels_agrees_with_newton_euler(body):
    steady = type(body).steady(
        1.2,
        2.5,
        mass=body.mass,
        radius=body.radius,
        tube_radius=body.tube_radius,
        diametral_inertia=body.diametral_inertia,
        axial_inertia=body.axial_inertia,
    )
    oracle = RollingBody(
        float(body.mass),
        np.asarray(body.inertia),
        float(body.gravity),
        torus(float(body.radius), float(body.tube_radius)),
    )
    state, h = np.append(1.2, steady.v0[3:]), 1e-3
    np.testing.assert_allclose(rates_in_angles(oracle, state), 0, atol=1e-13)
    columns = []
    for e in h * np.eye(4):
        # Differences of the sixth order.
        at = {k: rates_in_angles(oracle, state + k * e) for k in (-3, -2, -1, 1, 2, 3)}
        odd = [at[k] - at[-k] for k in (1, 2, 3)]
        columns.append((45 * odd[0] - 9 * odd[1] + odd[2]) / (60 * h))
    # The wheel has an arbitrary angle and its circle an arbitrary position.
    turned = nhjax.SO3().compose(steady.q0[:4], jnp.asarray([0.6, 0.0, 0.0, 0.8]))
    back = matrix_of([0.6, 0.0, 0.0, 0.8]).T
    moved = steady.rolling(turned, back @ np.asarray(steady.v0[3:]), (0.3, -0.7))
    stability = nhjax.linear_stability(
        moved.system, 0.0, moved.initial_state(), symmetry=moved.symmetry
    )
    # Round-off of the differences moves a double zero by the square root of it.
    expected = np.linalg.eigvals(np.stack(columns, axis=1))
    expected[np.abs(expected) < 1e-4] = 0
    assert np.sum(expected == 0) == 2
    assert_eigenvalues(stability, expected, 1e-9)


@pytest.mark.long
def test_steady_motion_of_a_wheel_along_symmetry_is_a_circle():
    wheel = RollingTorus.circling(1.2, 0.6, tube_radius=0.04)
    moved = wheel.manifold.act(wheel.q0, 0.05 * jnp.asarray([2, -1, 1, 3, 0, 0.0]))
    start = nhjax.initial_state(wheel.system, moved, wheel.v0, project=True)
    y, rates = nhjax.steady_motion(
        wheel.system, 0.0, start, symmetry=wheel.symmetry, held_velocities=(5,)
    )
    # The balance of moments gives ω₃ in closed form from the tilt and turning rate.
    up, turn = matrix_of(np.asarray(y.q[:4]))[2], rates[2]
    tilt = np.arccos(up[2])
    assert abs(tilt - 1.2) > 0.01
    expected = RollingTorus.steady(tilt, turn, tube_radius=0.04)
    spin = y.v[5]
    np.testing.assert_allclose(spin, start.v[5], rtol=1e-15)
    np.testing.assert_allclose(spin, expected.v0[5], rtol=1e-12)
    np.testing.assert_allclose(y.q[6], expected.q0[6], rtol=1e-13)
    rolling = spin - turn * up[2]
    np.testing.assert_allclose(y.v[3:], turn * up + rolling * AXIS, atol=1e-12)
    np.testing.assert_allclose(rates[3], rolling, rtol=1e-12)
    # The rotation is about the centre of the circle.
    middle = np.array([-rates[1], rates[0]]) / turn
    distance = np.linalg.norm(np.asarray(y.q[4:6]) - middle)
    path = -(spin / turn) * (0.5 + 0.04 * np.sin(tilt))
    path = path + 0.04 * np.sin(tilt) * np.cos(tilt)
    np.testing.assert_allclose(distance, path, rtol=1e-12)


def sleeping(rate, gravity, form="lagrangian"):
    top = HeavyTop(gravity=gravity)
    arm = float(top.centre[2])
    moments = top.moments + top.mass * arm**2 * jnp.asarray([1.0, 1.0, 0.0])
    weight = top.mass * gravity * arm
    system = both_forms(
        lambda t, q: jnp.diag(moments),
        lambda t, q: weight * top.manifold.Ad(q, AXIS)[2],
        inverse=lambda M: jnp.diag(1 / jnp.diagonal(M)),
        manifold=top.manifold,
    )[form]
    q, v = jnp.asarray([0.8, 0.0, 0.0, 0.6]), jnp.stack([0 * rate, 0 * rate, rate])
    y = nhjax.State(q, v, moments * v, jnp.zeros(0))
    return system, y


# J₁ about the pivot, J₃ and m l of this top.
FIRST, THIRD, ARM = 0.55, 0.4, 0.5


@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_linear_stability_of_a_sleeping_top_has_exact_frequencies(form):
    # J₁ ν² - J₃ ω ν + m g l = 0 in space; it sleeps where (J₃ ω)² > 4 J₁ m g l.
    for ratio in (0.9, 1.1):
        rate = ratio * np.sqrt(4 * FIRST * ARM * 9.81) / THIRD
        system, y = sleeping(jnp.asarray(rate), 9.81, form)
        found = nhjax.linear_stability(system, 0.0, y, symmetry=on_axis)
        nu = np.roots([FIRST, -THIRD * rate, ARM * 9.81])
        expected = 1j * np.array([*nu, *-np.conj(nu), 0])
        assert_eigenvalues(found, expected)
        # In the frame of the body the frequency is ν - ω, with the same growth rate.
        found = nhjax.linear_stability(system, 0.0, y, symmetry=about_vertical)
        turned = 1j * np.array([*(nu - rate), *-np.conj(nu - rate), 0])
        assert_eigenvalues(found, turned)


def test_linear_stability_derivative_along_symmetry_is_exact():
    def squares(rate, gravity):
        system, y = sleeping(rate, gravity)
        matrix = nhjax.linear_stability(system, 0.0, y, symmetry=on_axis).matrix
        return jnp.trace(matrix @ matrix)

    rate, gravity = jnp.asarray(30.0), jnp.asarray(9.81)
    found = jax.value_and_grad(squares, argnums=(0, 1))(rate, gravity)
    # The sum of the squares of both roots, which occur twice.
    sums = (THIRD * rate / FIRST) ** 2 - 2 * ARM * gravity / FIRST
    slopes = 2 * (THIRD / FIRST) ** 2 * rate, -2 * ARM / FIRST
    for x, y in zip(jax.tree.leaves(found), (sums, *slopes), strict=True):
        np.testing.assert_allclose(x, -2 * y, rtol=1e-12)


def test_linear_stability_under_left_translations_gives_euler_equations():
    def everywhere(q):
        return jax.vmap(lambda xi: nhjax.SO3().Ad(nhjax.SO3().inverse(q), xi))(
            jnp.eye(3)
        )

    i1, i2, i3 = moments = np.array([3.0, 2.0, 1.0])
    body = FreeRigidBody(moments, v0=(0.0, 1.3, 0.0))
    y = body.initial_state()
    stability = nhjax.linear_stability(body.system, 0.0, y, symmetry=everywhere)
    growth = 1.3 * np.sqrt((i1 - i2) * (i2 - i3) / (i1 * i3))
    assert_eigenvalues(stability, [growth, -growth, 0])


def turn(q):
    return jnp.stack([-q[1], q[0], 0 * q[2]])


@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_linear_stability_of_a_pendulum_cone_in_space_is_exact(form):
    g, angle = 9.81, 0.7
    rate = np.sqrt(g / np.cos(angle))
    system = both_forms(
        lambda t, q: jnp.eye(3, dtype=q.dtype),
        lambda t, q: g * q[2],
        holonomic=lambda t, q, args: 0.5 * (q @ q - 1),
    )[form]
    q = jnp.asarray([np.sin(angle), 0.0, -np.cos(angle)])
    v = jnp.asarray([0.0, rate * np.sin(angle), 0.0])
    # The mass is one: momenta are velocities.
    y = nhjax.initial_state(system, q, *((v,) if form == "lagrangian" else (None, v)))
    stability = nhjax.linear_stability(system, 0.0, y, symmetry=turn)
    frequency = rate * np.sqrt(1 + 3 * np.cos(angle) ** 2)
    assert_eigenvalues(stability, [1j * frequency, -1j * frequency, 0])
    with pytest.raises(ValueError, match="velocity or chosen position changes"):
        nhjax.linear_stability(system, 0.0, y)


def test_linear_stability_along_symmetry_under_vmap_and_single_precision():
    @jax.jit
    @jax.vmap
    def squares(cosine):
        sine, zero = jnp.sqrt(1 - cosine**2), 0 * cosine
        pendulum = SphericalPendulum(
            gravity=1.0,
            q0=jnp.stack([sine, zero, -cosine]),
            v0=jnp.stack([zero, sine / jnp.sqrt(cosine), zero]),
        )
        y = pendulum.initial_state(cosine.dtype)
        found = nhjax.linear_stability(pendulum.system, 0.0, y, symmetry=turn)
        return jnp.trace(found.matrix @ found.matrix)

    cosines = jnp.asarray([0.3, 0.6], jnp.float32)
    expected = -2 * (1 / cosines + 3 * cosines)
    np.testing.assert_allclose(squares(cosines), expected, rtol=1e-4)
