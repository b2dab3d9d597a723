"""Events with other methods and systems, checkpoints, meters, files and data sets."""

import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from nhjax import Event, LobattoIIIAB, SaveAt


METHOD = LobattoIIIAB(2)
# It falls by half a unit in unit time, from rest.
BALL = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - q[0])
FALL = nhjax.initial_state(BALL, jnp.array([0.5]), jnp.zeros(1))
BOUNCE = Event(
    lambda t, y, args: y.q[0],
    direction=False,
    reset=lambda t, y, args: (y.q, -y.v),
    max_events=3,
)


def run(y0=FALL, num_steps=12, **options):
    options = {"dt": 0.3, "event": BOUNCE} | options
    return nhjax.integrate(BALL, METHOD, y0, num_steps=num_steps, **options)


def test_event_run_from_a_checkpoint_has_the_events_of_one_run():
    first = nhjax.integrate(
        BALL, METHOD, FALL, dt=0.3, num_steps=2, saveat=SaveAt(checkpoint=True)
    )
    sol = run(first.checkpoint, num_steps=10)
    np.testing.assert_allclose(sol.events.ts[:2], [1.0, 3.0], rtol=1e-15)
    np.testing.assert_allclose(sol.ys.q, run().ys.q, rtol=1e-15)


def test_event_with_gauss_method_ends_the_run():
    sol = nhjax.integrate(
        BALL, nhjax.Gauss(2), FALL, dt=0.3, num_steps=12, event=BOUNCE
    )
    np.testing.assert_allclose(sol.events.ts[:2], [1.0, 3.0], rtol=1e-15)
    # At t = 3.6 it has risen for 0.6.
    np.testing.assert_allclose(sol.ys.q[0], 0.6 - 0.18, rtol=1e-14)


def test_event_reset_of_hamiltonian_system_sets_momentum():
    """A ball of mass 2 keeps half its momentum: v = 1/2 after the first impact."""
    system = nhjax.HamiltonianSystem(lambda t, q, p, args: 0.25 * p @ p + 2 * q[0])
    y0 = nhjax.initial_state(system, jnp.array([0.5]), p=jnp.zeros(1))
    event = Event(BOUNCE.cond_fn, reset=lambda t, y, args: (y.q, -0.5 * y.p))
    sol = nhjax.integrate(system, METHOD, y0, dt=0.3, num_steps=4, event=event)
    assert int(sol.events.num) == 1
    np.testing.assert_allclose(sol.events.before.p[0], -2.0, rtol=1e-14)
    np.testing.assert_allclose(sol.events.after.p[0], 1.0, rtol=1e-14)
    np.testing.assert_allclose(sol.events.after.v[0], 0.5, rtol=1e-14)
    np.testing.assert_allclose(sol.ys.v[0], 0.3, rtol=1e-14)


class Recorder(nhjax.AbstractProgressMeter):
    def update(self, done, total):
        seen.append((done, total))


seen: list[tuple[int, int]] = []


def test_event_run_in_a_batch_reports_progress_once():
    seen.clear()

    def end(height):
        y0 = nhjax.initial_state(BALL, height[None], jnp.zeros(1))
        event = [BOUNCE, Event(lambda t, y, args: t - 3.5)]
        options = {"dt": 0.01, "num_steps": 400, "progress_meter": Recorder()}
        return run(y0, event=event, **options).t1

    jax.block_until_ready(jax.vmap(end)(jnp.array([0.5, 0.7])))
    jax.effects_barrier()
    assert seen == [(done, 400) for done in (1, *range(4, 401, 4))]


def test_event_log_in_files_and_datasets_is_complete(tmp_path):
    sol = run(saveat=SaveAt(steps=True))
    nhjax.save(tmp_path / "run.npz", sol)
    got = nhjax.load(tmp_path / "run.npz")
    assert jax.tree.structure(got) == jax.tree.structure(sol)
    np.testing.assert_array_equal(got.events.ts, sol.events.ts)
    np.testing.assert_array_equal(got.events.after.v, sol.events.after.v)
    data = sol.to_xarray(units={"event_t": "s"})
    np.testing.assert_array_equal(data.event_t, sol.events.ts)
    assert data.event_which.values.tolist() == [0, 0, -1]
    assert data.event_t.attrs["units"] == "s"
