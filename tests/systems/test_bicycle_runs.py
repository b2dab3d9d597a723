"""Runs of the bicycle against Kane's method, free and with a rider who steers."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax.systems import LeanToSteer, WhippleBicycle
from support import bicycle as oracle
from support.library_motion import library_motion
from support.orders import Ladder


GAINS = np.array([-3.0, 5.0])
STEERED = LeanToSteer(*GAINS)


def test_rider_that_steers_into_the_fall_adds_its_torque():
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


def test_rider_with_default_gains_stabilises_slow_bicycle():
    gains = (float(LeanToSteer().lean_gain), float(LeanToSteer().lean_rate_gain))
    for speed in (2.0, 3.0, 4.0, 5.0, 6.0):
        steered = oracle.linear_motion(oracle.BENCHMARK, speed, gains)
        assert np.max(np.linalg.eigvals(steered).real) < 0
    free = oracle.linear_motion(oracle.BENCHMARK, 2.0)
    assert np.max(np.linalg.eigvals(free).real) > 2


# The run of the IFToMM benchmark library, 5 s from 4.6 m/s with a lean rate of 0.5
# rad/s, and its first half with half of the step. With two stages a rider steers.
BICYCLES = {2: WhippleBicycle(steering=STEERED), 3: WhippleBicycle()}
DURATION, FINEST = 2.5, 0.0025
LADDERS = {
    2: Ladder((0.005, 0.0025), 1000, DURATION, FINEST),
    3: Ladder((0.025, 0.0125), 200, DURATION, FINEST),
}


@cache
def runs(stages):
    """Times, states and continuous multipliers, with one lane for each step size."""
    bicycle = BICYCLES[stages]
    method, y0 = nhjax.LobattoIIIAB(stages), bicycle.initial_state()
    return LADDERS[stages].climb(bicycle.system, method, y0)


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
        oracle.forces(
            oracle.accelerations(oracle.BENCHMARK, *state, torque(0.0, *state))[1]
        )
        for state in zip(q, v, strict=True)
    ]
    return q, v, np.array(reactions)


each_bicycle = pytest.mark.parametrize("stages", [2, 3], ids=["steered-2", "free-3"])


@pytest.mark.long
@each_bicycle
@pytest.mark.parametrize("part", range(3), ids=["q", "v", "multiplier"])
def test_motion_converges_to_kanes_equations(stages, part):
    _, states, continuous = runs(stages)
    found = (states.q, states.v, continuous)[part]
    LADDERS[stages].assert_order(2 * stages - 2, found, reference(stages)[part])


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


@pytest.mark.long
@each_bicycle
def test_constraints_in_a_run_of_five_seconds_hold(stages):
    _, slip, depth, _ = checks(stages)
    np.testing.assert_allclose(slip, 0.0, atol=2e-13)
    np.testing.assert_allclose(depth, 0.0, atol=2e-15)


@pytest.mark.long
def test_energy_in_a_run_of_five_seconds_is_conserved():
    energy, _, _, start = checks(3)
    # The benchmark library allows 1e-5.
    assert np.max(np.abs(energy / start - 1)) < 5e-7


@pytest.mark.long
def test_energy_gain_equals_the_work_of_the_rider():
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
