"""Chaplygin's top and Routh's sphere against Newton and Euler."""

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax.systems import ChaplyginSphere, ChaplyginTop
from support.machines import accelerations, assert_orders, drifts, runs_of_three_stages
from support.rolling_bodies import (
    assert_newton_and_euler,
    cross,
    errors_of,
    matrix_of,
    random_states,
    RollingBody,
    sphere,
)


TOPS = {
    "Routh": ChaplyginTop(),
    "uneven": ChaplyginTop(1.6, 0.3, -0.08, (0.05, 0.03, 0.07), 3.0),
}
DURATION, COUNTS = 1.0, (20, 40, 80)


def newton_euler(top):
    moments, centre = np.asarray(top.moments), np.array([0, 0, float(top.offset)])
    shape = sphere(float(top.radius), centre)
    return RollingBody(float(top.mass), np.diag(moments), float(top.gravity), shape)


@pytest.fixture(scope="module")
def found():
    return runs_of_three_stages(TOPS["Routh"], COUNTS, DURATION)


@pytest.mark.parametrize("top", TOPS.values(), ids=TOPS)
def test_accelerations_and_forces_equal_newton_euler(top):
    states = list(random_states(20, tilt=3.0))
    assert_newton_and_euler(top, newton_euler(top), states, accelerations)


@pytest.mark.long
def test_run_converges_with_method_order(found):
    top = TOPS["Routh"]
    start = np.asarray(top.q0[:4]), np.asarray(top.v0[3:])
    errors_at = errors_of(newton_euler(top), start, DURATION, COUNTS[-1])
    assert_orders(found, 4, errors_at, floor=1e-11)


@pytest.mark.long
def test_constraints_hold_to_round_off_and_energy_is_conserved(found):
    # Drifts of an energy of 12 J; the coarsest runs take four times the duration.
    largest = (3e-6, 2e-7, 1e-8)
    assert np.max(found.violation) < 1e-13
    drift = drifts(TOPS["Routh"], found)["energy"]
    assert np.all(drift < largest), drift


def test_invariants_of_routh_by_independent_equations_are_constant():
    top = TOPS["Routh"]
    oracle, moments = newton_euler(top), np.asarray(top.moments)
    jellett, routh = map(float, top.integrals_of_routh(top.q0, top.v0))
    start = np.asarray(top.q0[:4]), np.asarray(top.v0[3:])
    R, omega, _, _ = oracle.trajectory(*start, (0, 0), [1.0, 3.0])
    assert np.min(np.abs(R[:, 2, 2] - 0.28)) > 0.05, "it does not nutate"
    for rotation, w in zip(R, omega, strict=True):
        s, _ = oracle.shape(rotation[2])
        # m s × v with v = -ω × s, about the contact.
        momentum = moments * w + cross(s, cross(w, s))
        assert momentum @ s == pytest.approx(jellett, rel=1e-12)
        # The usual form for m = r = 1, here times √I₁.
        sin, f = np.hypot(*rotation[2, :2]), rotation[2, 2] - 0.25
        value = moments[2] + sin**2 + moments[2] / moments[0] * f**2
        assert w[2] * np.sqrt(moments[0] * value) == pytest.approx(routh, rel=1e-12)


@pytest.mark.long
def test_invariant_errors_of_routh_converge_with_method_order(found):
    top = TOPS["Routh"]
    start = np.array(top.integrals_of_routh(top.q0, top.v0))
    errors = []
    for lane in range(len(COUNTS)):
        _, y, _ = found.until_the_duration(lane)
        end = top.integrals_of_routh(jnp.asarray(y.q[-1]), jnp.asarray(y.v[-1]))
        errors.append(np.abs(np.array(end) - start))
    assert np.min(errors) > 1e-12
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(orders > 3.7), (orders, errors)


def test_chaplygin_top_without_offset_equals_chaplygin_sphere():
    numbers = (1.6, 0.3), ((0.05, 0.03, 0.07), 3.0)
    top = ChaplyginTop(*numbers[0], 0.0, *numbers[1])
    ball = ChaplyginSphere(*numbers[0], *numbers[1])
    data = (0.7, -0.3, 0.5, 0.4), (1.0, -2.0, 3.0)
    top, ball = top.rolling(*data), ball.rolling(*data)
    np.testing.assert_array_equal(top.q0, ball.q0)
    found = accelerations(top.system, top.q0[None], top.v0[None])
    expected = accelerations(ball.system, ball.q0[None], ball.v0[None])
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


def test_chaplygin_top_points_are_on_the_sphere_and_on_the_plane():
    top = TOPS["uneven"].rolling((0.7, -0.3, 0.5, 0.4), (1.0, 0.0, 0.0), (0.5, 0.2))
    points = top.points(0.0, top.q0)
    assert set(points) == {"centre_of_mass", "centre", "contact", "pole"}
    np.testing.assert_allclose(points["contact"], [0.5, 0.2, 0], rtol=0, atol=1e-16)
    np.testing.assert_allclose(points["centre"], [0.5, 0.2, 0.3], rtol=0, atol=1e-15)
    axis = matrix_of(top.q0[:4])[:, 2]
    np.testing.assert_allclose(
        points["pole"] - points["centre"], 0.3 * axis, rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(
        points["centre"] - points["centre_of_mass"], -0.08 * axis, rtol=0, atol=1e-15
    )


def test_system_computes_in_precision_of_the_state():
    top = TOPS["Routh"]
    y0 = top.initial_state(jnp.float32)
    assert y0.q.dtype == y0.v.dtype == y0.multiplier.dtype == jnp.float32
    for value in top.integrals_of_routh(y0.q, y0.v):
        assert value.dtype == jnp.float32


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ChaplyginTop(mass=0.0), r"`mass` must be positive, got 0"),
        (lambda: ChaplyginTop(radius=-1.0), r"`radius` must be positive, got -1"),
        (lambda: ChaplyginTop(offset=1.0), r"`offset` must be smaller .* got 1"),
        (lambda: ChaplyginTop(moments=(1.0,)), r"`moments` must have shape \(3,\)"),
        (lambda: ChaplyginTop(moments=(1.0, 0.0, 1.0)), r"`moments` must be pos"),
        (lambda: ChaplyginTop(gravity=0.0), r"`gravity` must be positive, got 0"),
        (lambda: ChaplyginTop(offset=0.1).initial_state(), "constraint"),
    ],
)
def test_chaplygin_top_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
