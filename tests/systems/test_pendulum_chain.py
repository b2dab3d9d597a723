"""The chain of pendula against its equations in the angles of the rods."""

import jax.numpy as jnp
import numpy as np
import pytest

from nhjax.systems import DoublePendulum, PendulumChain
from support.flow import flow
from support.library_motion import library_motion
from support.mechanisms import (
    assert_motion,
    assert_order,
    assert_single_precision,
    invariants,
    runs,
)
from support.pendula import Chain


ANGLES, RATES = np.array([0.9, -0.4, 1.6]), np.array([0.5, 1.2, -0.8])
PARAMETERS = {"masses": (1.3, 0.7, 0.4), "lengths": (0.9, 0.6, 1.1), "gravity": 9.81}
CHAIN = PendulumChain.swinging(ANGLES, RATES, **PARAMETERS)
ORACLE = Chain(**PARAMETERS)
END = 1.0
COUNTS = (80, 120, 180, 270)


@pytest.fixture(scope="module")
def reference():
    start = np.concatenate([ANGLES, RATES])
    end = flow(ORACLE.velocity_field, start, np.array([0.0, END]))[-1]
    (q, v), (_, multiplier) = (
        f(*np.split(end, 2)) for f in (ORACLE.state, ORACLE.motion)
    )
    return {"q": q, "v": v, "multiplier": multiplier}


@pytest.fixture(scope="module")
def found():
    return runs(CHAIN, 3, COUNTS, END)


def test_acceleration_and_multiplier_equal_equations_in_angles():
    rng = np.random.default_rng(0)
    for _ in range(6):
        angles, rates = rng.uniform(-3, 3, 3), rng.normal(size=3)
        found = library_motion(CHAIN, 0.0, *ORACLE.state(angles, rates))
        assert_motion(found, ORACLE.motion(angles, rates), 1e-12)


def test_chain_of_eight_links_accelerates_as_in_angles():
    rng = np.random.default_rng(1)
    angles, rates = rng.uniform(-3, 3, 8), rng.normal(size=8)
    chain = PendulumChain.swinging(angles, rates)
    oracle = Chain(np.ones(8), np.ones(8), 9.81)
    found = library_motion(chain, 0.0, chain.q0, chain.v0)
    assert_motion(found, oracle.motion(angles, rates), 1e-11)


def test_chain_of_two_links_equals_double_pendulum():
    parameters = {"masses": (1.1, 0.8), "lengths": (0.7, 1.2), "gravity": 2.0}
    double = DoublePendulum.swinging((1.0, -0.5), (0.3, 0.8), **parameters)
    chain = PendulumChain.swinging((1.0, -0.5), (0.3, 0.8), **parameters)
    np.testing.assert_array_equal(chain.q0, double.q0)
    np.testing.assert_array_equal(chain.v0, double.v0)
    expected = library_motion(double, 0.0, double.q0, double.v0)
    assert_motion(library_motion(chain, 0.0, double.q0, double.v0), expected, 1e-14)


@pytest.mark.parametrize("name", ["q", "v", "multiplier"])
def test_run_converges_with_method_order(found, reference, name):
    assert_order(4, COUNTS, found.errors(name, reference[name]))


def test_chain_rods_keep_their_lengths_along_a_run(found):
    places = found.lanes[0].q.reshape(-1, 3, 2)
    lengths = np.linalg.norm(np.diff(places, axis=1, prepend=0.0), axis=2)
    expected = np.broadcast_to(PARAMETERS["lengths"], lengths.shape)
    np.testing.assert_allclose(lengths, expected, rtol=0, atol=1e-15)
    assert max(found.violations) < 1e-13


def test_energy_error_of_the_chain_is_bounded(found):
    lane = found.lanes[-1]
    energy = invariants(CHAIN, lane.t, lane.q, lane.v)["energy"]
    start = CHAIN.energy(0.0, CHAIN.q0, CHAIN.v0)
    assert np.max(np.abs(energy - start)) < 1.6e-7


def test_chain_with_default_data_hangs_straight_at_rest():
    chain = PendulumChain(num_links=4, lengths=(1.0, 0.5, 0.5, 2.0))
    points = chain.points(0.0, chain.q0)
    assert list(points) == ["pivot", "mass_1", "mass_2", "mass_3", "mass_4"]
    end = 4.0 * np.array([np.sin(0.5), -np.cos(0.5)])
    np.testing.assert_allclose(points["mass_4"], end, rtol=1e-15)
    assert chain.initial_state().multiplier.shape == (4,)
    assert not jnp.any(chain.v0)


def test_system_in_single_precision_keeps_dtype():
    assert_single_precision(CHAIN)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: PendulumChain(0), r"`num_links` must be at least 1, got 0"),
        (lambda: PendulumChain(2, (1.0,) * 3), r"`masses` must have shape \(2,\)"),
        (lambda: PendulumChain(2, lengths=-1.0), r"`lengths` must be positive"),
        (lambda: PendulumChain(2, q0=np.ones(3)), r"`q0` must have shape \(4,\)"),
        (
            lambda: PendulumChain.swinging((0.1, 0.2), (0.3,)),
            r"`rates` must have shape \(2,\)",
        ),
    ],
)
def test_chain_parameter_out_of_range_raises(build, message):
    with pytest.raises(ValueError, match=message):
        build()
