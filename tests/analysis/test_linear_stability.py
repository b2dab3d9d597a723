"""Eigenvalues of linearised motions compared with closed forms and one-step maps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import (
    ChaplyginSleigh,
    FreeRigidBody,
    RollingTorus,
    SphericalPendulum,
)
from support.polar_pendulum import GRAVITY, polar_pendulum


def conical(system, angle):
    rate = jnp.sqrt(GRAVITY / jnp.cos(angle))
    q, v = jnp.stack([angle, jnp.zeros_like(angle)]), jnp.stack([0 * rate, rate])
    return nhjax.initial_state(system, q, v)


@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_linear_stability_of_a_conical_pendulum_has_the_exact_frequency(form):
    system, angle = polar_pendulum()[form], jnp.asarray(0.7)

    def frequency(angle):
        y = conical(system, angle)
        # The angle around the vertical is ignorable, and all velocities independent.
        stability = nhjax.linear_stability(
            system, 0.0, y, positions=(0,), velocities=(0, 1)
        )
        assert stability.matrix.shape == (3, 3)
        return jnp.max(stability.eigenvalues.imag)

    def expected(angle):
        return jnp.sqrt(GRAVITY / jnp.cos(angle) * (1 + 3 * jnp.cos(angle) ** 2))

    found, slope = jax.value_and_grad(frequency)(angle)
    np.testing.assert_allclose(found, expected(angle), rtol=1e-13)
    np.testing.assert_allclose(slope, jax.grad(expected)(angle), rtol=1e-12)


def test_linear_stability_with_holonomic_constraint_is_reduced():
    pendulum = SphericalPendulum(
        2.0, 0.5, GRAVITY, q0=(0.0, 0.0, -0.5), v0=(0.0, 0.0, 0.0)
    )
    y = pendulum.initial_state()
    whole = nhjax.linear_stability(pendulum.system, 0.0, y)
    chosen = nhjax.linear_stability(
        pendulum.system, 0.0, y, positions=(0, 1), velocities=(0, 1)
    )
    rate = np.sqrt(GRAVITY / 0.5)
    expected = [-1j * rate, -1j * rate, 1j * rate, 1j * rate]
    for stability in (whole, chosen):
        found = np.asarray(stability.eigenvalues)
        found = found[np.argsort(np.imag(found))]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)
    np.testing.assert_allclose(chosen.matrix[:2, 2:], np.eye(2), atol=1e-15)
    np.testing.assert_allclose(
        chosen.matrix[2:, :2], -(rate**2) * np.eye(2), rtol=1e-14
    )


def test_linear_stability_of_rotation_about_the_middle_axis_is_unstable():
    moments = i1, i2, i3 = np.array([3.0, 2.0, 1.0])
    body = FreeRigidBody(moments, v0=(0.0, 1.3, 0.0))
    stability = nhjax.linear_stability(body.system, 0.0, body.initial_state())
    growth = 1.3 * np.sqrt((i1 - i2) * (i2 - i3) / (i1 * i3))
    found = np.asarray(stability.eigenvalues)
    # Attitude perturbations rotate with the body at its rate; three more are neutral.
    expected = [-growth, growth, 0, 0, -1.3j, 1.3j]
    distance = np.abs(found[:, None] - np.asarray(expected))
    assert np.max(np.min(distance, axis=0)) < 1e-7
    assert np.max(np.min(distance, axis=1)) < 1e-7
    values, modes = stability.modes
    fastest = np.argmax(values.real)
    mode = modes[3:, fastest] / modes[3, fastest]
    ratio = growth * i1 / ((i2 - i3) * 1.3)
    np.testing.assert_allclose(mode, [1, 0, ratio], rtol=0, atol=1e-13)


def test_linear_stability_eigenvalues_agree_with_step_derivative():
    sleigh = ChaplyginSleigh(q0=(0.0, 0.0, 0.0), v0=(1.2, 0.0, 0.0))
    system, y = sleigh.system, sleigh.initial_state()
    # In straight motion, only the turning rate has a nonzero eigenvalue.
    stability = nhjax.linear_stability(system, 0.0, y, positions=(), velocities=(0, 2))

    def turned(rate):
        v = jnp.stack([jnp.asarray(1.2), jnp.asarray(0.0), rate])
        start = nhjax.initial_state(system, y.q, v, project=True)
        end = nhjax.step(system, nhjax.LobattoIIIAB(5), 0.0, 0.1, start)
        return end.v[2]

    multiplier = jax.jacfwd(turned)(jnp.asarray(0.0))
    rate = float(np.log(multiplier)) / 0.1
    found = np.sort(np.real(np.asarray(stability.eigenvalues)))
    np.testing.assert_allclose(found, [rate, 0.0], rtol=0, atol=1e-11)


def test_linear_stability_derivative_agrees_with_differences():
    def fastest(gravity):
        pendulum = SphericalPendulum(
            gravity=gravity, q0=(0.0, 0.0, -1.0), v0=(0.0, 0.0, 0.0)
        )
        y = pendulum.initial_state()
        matrix = nhjax.linear_stability(pendulum.system, 0.0, y).matrix
        # The sum of the squares of the eigenvalues, which is -4 g.
        return jnp.trace(matrix @ matrix)

    np.testing.assert_allclose(jax.grad(fastest)(jnp.asarray(2.0)), -4.0, rtol=1e-13)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"positions": (0,)}, "`velocities` is missing"),
        ({"velocities": (0,)}, "`positions` is missing"),
        ({"positions": (0,), "velocities": (0, 1, 2)}, "3 with 1|have 2 independent"),
        ({"positions": (0, 1, 2), "velocities": (0, 1)}, "have 2 independent ones"),
        ({"positions": (0, 0), "velocities": (0, 1)}, "twice"),
        ({"positions": (0, 3), "velocities": (0, 1)}, "index 3, but .* from 0 to 2"),
        ({"positions": (0, -1), "velocities": (0, 1)}, "index -1"),
        ({"positions": (0, 1), "velocities": (0, 2)}, "do not determine"),
    ],
)
def test_linear_stability_with_wrong_coordinates_raises_naming_them(chosen, message):
    pendulum = SphericalPendulum(q0=(0.0, 0.0, -1.0), v0=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=message):
        nhjax.linear_stability(pendulum.system, 0.0, pendulum.initial_state(), **chosen)


def test_linear_stability_with_noninteger_indices_raises():
    pendulum = SphericalPendulum(q0=(0.0, 0.0, -1.0), v0=(0.0, 0.0, 0.0))
    with pytest.raises(TypeError, match="`positions` must be a sequence of integers"):
        nhjax.linear_stability(
            pendulum.system,
            0.0,
            pendulum.initial_state(),
            positions=(0.5,),  # pyright: ignore[reportArgumentType]
            velocities=(0, 1),
        )


def test_linear_stability_of_an_unsteady_motion_raises():
    pendulum = SphericalPendulum()
    y = pendulum.initial_state()
    with pytest.raises(ValueError, match=r"not steady: .* changes at the rate"):
        nhjax.linear_stability(pendulum.system, 0.0, y)
    instant = nhjax.linear_stability(pendulum.system, 0.0, y, must_be_steady=False)
    assert np.all(np.isfinite(instant.matrix))
    # The body axes rotate relative to the motion, which is steady in space.
    torus = RollingTorus.steady(1.0, 2.0, tube_radius=0.1)
    with pytest.raises(ValueError, match="not steady"):
        nhjax.linear_stability(torus.system, 0.0, torus.initial_state())


def test_linear_stability_with_singular_mass_matrix_raises():
    def half(t, q, v, args):
        return 0.5 * v[0] ** 2 - q @ q

    system = nhjax.LagrangianSystem(half)
    y = nhjax.State(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2), jnp.zeros(0))
    with pytest.raises(nhjax.IrregularLagrangianError, match="singular at"):
        nhjax.linear_stability(system, 0.0, y)


def test_linear_stability_in_single_precision_or_vmap_is_accurate():
    def frequencies(gravity):
        pendulum = SphericalPendulum(
            gravity=gravity, q0=(0.0, 0.0, -1.0), v0=(0.0, 0.0, 0.0)
        )
        y = pendulum.initial_state(gravity.dtype)
        matrix = nhjax.linear_stability(pendulum.system, 0.0, y).matrix
        return jnp.trace(matrix @ matrix)

    gravities = jnp.asarray([1.0, 2.0, 5.0])
    many = jax.jit(jax.vmap(frequencies))(gravities)
    np.testing.assert_allclose(many, -4 * gravities, rtol=1e-13)
    single = frequencies(jnp.asarray(2.0, jnp.float32))
    assert single.dtype == jnp.float32
    np.testing.assert_allclose(single, -8.0, rtol=1e-5)
