"""Events against motions in closed form: where runs end, and how they continue."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import Event, LobattoIIIAB, RESULTS, SaveAt, systems
from support.impacts import Latch, ROD, rod_run, SLIDE, slide, START, turned
from support.long import long


LATCH = Latch()


@pytest.mark.parametrize("on_group", [False, True])
def test_event_resets_of_a_bouncing_rod_match_closed_form(on_group):
    """On R^3 every method integrates the flight exactly; dt is as long as a flight."""
    method, dt, num_steps = (
        (LobattoIIIAB(6), 0.05, 60) if on_group else (LobattoIIIAB(2), 0.6, 5)
    )
    q, v = map(jnp.asarray, START)
    saveat = SaveAt(t0=True, steps=True)
    sol = rod_run(on_group, method, dt, num_steps, q, v, ROD.restitution, saveat=saveat)
    times, tips, before, (q, v) = ROD.bounces(START, 3.0)
    num = len(times)
    assert num >= 4
    assert int(sol.events.num) == num == int(sol.stats["num_events"])
    np.testing.assert_allclose(sol.events.ts[:num], times, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(sol.events.which[:num] * -2 + 1, tips)
    places = [z[0] for z in before]
    np.testing.assert_allclose(sol.events.before.q[:num], places, rtol=0, atol=1e-12)
    heights = [ROD.height(z, tip) for z, tip in zip(before, tips, strict=True)]
    np.testing.assert_allclose(heights, 0, atol=1e-15)
    np.testing.assert_allclose(sol.ys.q[-1], q, rtol=0, atol=1e-12)
    got = turned(sol.ys.q[-1], sol.ys.v[-1]) if on_group else sol.ys.v[-1]
    np.testing.assert_allclose(got, v, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(sol.ts, dt * np.arange(num_steps + 1))
    assert np.all(np.isinf(sol.events.ts[num:]))
    assert sol.ts.shape == sol.ys.q.shape[:1]


def test_event_reset_of_a_latching_joint_matches_closed_form():
    """The run ends where the rotors meet, and continues there with another system."""
    inertias = jnp.array([LATCH.first, LATCH.second])

    def lagrangian(t, q, v, args):
        return 0.5 * jnp.sum(inertias * v**2) - 0.5 * LATCH.stiffness * q[0] ** 2

    free = nhjax.LagrangianSystem(lagrangian)
    locked = nhjax.LagrangianSystem(
        lagrangian, holonomic=lambda t, q, args: q[0] - q[1]
    )
    y0 = nhjax.initial_state(free, jnp.array([-LATCH.a, LATCH.b]), jnp.zeros(2))
    method = LobattoIIIAB(6)
    met = nhjax.integrate(
        free,
        method,
        y0,
        dt=0.1,
        num_steps=40,
        event=Event(lambda t, y, args: y.q[1] - y.q[0]),
        saveat=SaveAt(steps=True),
    )
    t, rate, common = LATCH.meeting()
    assert met.result == RESULTS.event_occurred
    assert not met.failures()
    np.testing.assert_allclose(met.t1, t, rtol=0, atol=1e-12)
    np.testing.assert_allclose(met.ts[-1], met.t1, rtol=0)
    assert np.all(met.ts[:-1] <= met.t1)
    assert int(met.stats["num_steps"]) < 40
    end = jax.tree.map(lambda x: x[-1], met.ys)
    np.testing.assert_allclose(end.q, LATCH.b, rtol=0, atol=1e-12)
    np.testing.assert_allclose(end.v, [rate, 0.0], rtol=0, atol=1e-12)
    # The projection in the kinetic metric is the impact without rebound.
    y1 = nhjax.initial_state(locked, end.q, end.v, project=True)
    np.testing.assert_allclose(y1.v, common, rtol=0, atol=1e-12)
    sol = nhjax.integrate(locked, method, y1, t0=met.t1, dt=0.1, num_steps=20)
    q, v = LATCH.locked(2.0)
    np.testing.assert_allclose(sol.ys.q[0], q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sol.ys.v[0], v, rtol=0, atol=1e-12)


@pytest.mark.parametrize("closure", ["symmetric", "propagated"])
@pytest.mark.parametrize("stages", [long(2), 3])
def test_event_at_a_vanishing_multiplier_converges_with_method_order(stages, closure):
    """A particle that starts from rest on top leaves a sphere where cos θ = 2/3."""
    steps = [0.1, 0.05]
    sols = [slide(stages, dt, closure=closure) for dt in steps]
    errors = [abs(float(sol.t1) - SLIDE.time) for sol in sols]
    order = np.log2(errors[0] / errors[1])
    assert abs(order - (2 * stages - 2)) < 0.35
    for sol, dt in zip(sols, steps, strict=True):
        assert abs(float(sol.ys.q[0, 2]) - SLIDE.cosine) < 0.5 * dt ** (2 * stages - 2)
        assert float(sol.stats["max_constraint_violation"]) < 1e-15


def test_event_of_nonholonomic_motion_at_a_plane_matches_exact_time():
    particle = systems.NonholonomicParticle()
    event = Event(lambda t, y, args: y.q[0] - args)
    sol = nhjax.integrate(
        particle.system,
        LobattoIIIAB(6),
        particle.initial_state(),
        dt=0.1,
        num_steps=40,
        args=-0.4,
        event=event,
    )
    q, v, _ = particle.exact(float(sol.t1))
    assert sol.result == RESULTS.event_occurred
    assert abs(q[0] + 0.4) < 1e-12
    np.testing.assert_allclose(sol.ys.q[0], q, rtol=0, atol=1e-12)
    np.testing.assert_allclose(sol.ys.v[0], v, rtol=0, atol=1e-12)
    assert float(sol.stats["max_constraint_violation"]) < 1e-15
