"""Which zeros are events, which event fires first, and how failures are reported."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import Event, LobattoIIIAB, RESULTS, SaveAt
from support.helpers import scalar


METHOD = LobattoIIIAB(2)
# In unit time, FREE moves by its velocity, and BALL falls half a unit from rest.
FREE = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v)
BALL = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - q[0])
GO = nhjax.initial_state(FREE, jnp.zeros(1), jnp.ones(1))
FALL = nhjax.initial_state(BALL, jnp.array([0.5]), jnp.zeros(1))


def at(place, **options):
    return Event(lambda t, y, args: y.q[0] - place, **options)


def run(event, dt=1.0, num_steps=3, system=FREE, y0=GO, **options):
    return nhjax.integrate(
        system, METHOD, y0, dt=dt, num_steps=num_steps, event=event, **options
    )


def bounce(restitution=1.0, **options):
    return Event(
        lambda t, y, args: y.q[0],
        direction=False,
        reset=lambda t, y, args: (y.q, -restitution * y.v),
        **options,
    )


def reported(sol):
    num = int(sol.events.num)
    return sol.events.ts[:num], list(map(int, sol.events.which[:num]))


def test_event_pair_in_one_step_fires_the_first():
    sol = run([at(0.7), at(0.3)])
    np.testing.assert_allclose(sol.t1, 0.3, rtol=1e-15)
    np.testing.assert_allclose(sol.ys.q[0], 0.3, rtol=1e-15)
    assert reported(sol)[1] == [1]
    assert sol.result == RESULTS.event_occurred


def test_event_without_action_does_not_change_the_run():
    """Zeros in the other direction do not fire; the last event ends the run."""
    watched = [at(x, terminate=False) for x in (0.7, 0.3, 1.0)]
    away = at(2.2, terminate=False, direction=False)
    saveat = SaveAt(t0=True, steps=True)
    sol = run([*watched, away, at(2.5)], num_steps=4, saveat=saveat)
    times, which = reported(sol)
    np.testing.assert_allclose(times, [0.3, 0.7, 1.0, 2.5], rtol=1e-15)
    assert which == [1, 0, 2, 4]
    np.testing.assert_allclose(sol.ts, [0.0, 1.0, 2.0, 2.5, 2.5], rtol=1e-15)
    np.testing.assert_allclose(sol.ys.q[:, 0], sol.ts, rtol=1e-15)
    assert int(sol.stats["num_steps"]) == 2
    assert int(sol.stats["num_events"]) == 4


def test_event_condition_zero_at_start_does_not_fire():
    """A motion that comes back to the surface fires the event when it returns."""
    assert reported(run(at(0.0)))[1] == []
    y0 = nhjax.initial_state(BALL, jnp.zeros(1), jnp.ones(1))
    sol = run(bounce(), dt=1.5, system=BALL, y0=y0)
    np.testing.assert_allclose(reported(sol)[0], [2.0, 4.0], rtol=1e-15)


def test_event_that_never_fires_does_not_change_the_run():
    sol = run([at(5.0), bounce()], num_steps=4)
    plain = nhjax.integrate(FREE, METHOD, GO, dt=1.0, num_steps=4)
    for x, y in zip(jax.tree.leaves(sol.ys), jax.tree.leaves(plain.ys), strict=True):
        np.testing.assert_array_equal(x, y)
    assert reported(sol)[1] == []
    assert np.all(np.isinf(sol.events.ts))
    assert sol.result == RESULTS.successful
    assert sol.t1 == 4.0


def test_event_condition_without_sign_change_does_not_fire():
    sol = run(Event(lambda t, y, args: (y.q[0] - 0.5) ** 2))
    assert reported(sol)[1] == []
    assert sol.result == RESULTS.successful


def test_event_condition_without_slope_fires_with_nan_derivative():
    def time(place, weight=1.0):
        event = Event(lambda t, y, args: (y.q[0] - args) ** 3)
        return weight * run(event, args=place).t1

    @jax.jit
    def program(place, weight):
        found = jax.value_and_grad(time)(place, weight)
        return found, jax.jvp(lambda x: time(x, weight), (place,), (1.0,))[1]

    (value, reverse), forward = program(0.5, 1.0)
    assert value == 0.5
    assert np.isnan(reverse)
    assert np.isnan(forward)
    assert program(0.5, 0.0)[0][1] == 0.0


@pytest.mark.parametrize("dt", [0.31, 5.1])
def test_event_resets_within_one_step_all_fire(dt):
    """A ball falls from 1/2 in time 1, and comes back every 2."""
    sol = run(bounce(), dt=dt, num_steps=round(10.2 / dt), system=BALL, y0=FALL)
    times, _ = reported(sol)
    np.testing.assert_allclose(times, np.arange(1, 10, 2), rtol=1e-14)
    np.testing.assert_allclose(sol.events.after.v[:5], 1.0, rtol=1e-13)
    # Steps that were tried and then repeated have not failed.
    assert int(sol.stats["failed_step"]) == -1
    assert int(sol.stats["worst_coordinate"]) == -1


def test_event_at_a_node_fires_once():
    saveat = SaveAt(t0=True, steps=True)
    event = at(1.0, reset=lambda t, y, args: (y.q, -y.v))
    sol = run(event, saveat=saveat, num_steps=4)
    assert reported(sol)[1] == [0]
    np.testing.assert_allclose(sol.ys.q[:, 0], [0.0, 1.0, 0.0, -1.0, -2.0], atol=1e-15)


def test_event_pair_at_one_time_fires_both():
    def wall(i):
        def reset(t, y, args):
            return y.q, y.v.at[i].multiply(-1.0)

        return Event(lambda t, y, args: y.q[i], direction=True, reset=reset)

    y0 = nhjax.initial_state(FREE, jnp.array([-0.3, -0.3]), jnp.ones(2))
    sol = run([wall(0), wall(1)], dt=0.1, num_steps=10, y0=y0)
    assert reported(sol)[1] == [0, 1]
    np.testing.assert_allclose(sol.ys.q[0], -0.7, rtol=1e-14)


def test_event_pair_at_the_last_node_fires_both():
    """The row of the node has the state after both resets."""

    def wall(i):
        def reset(t, y, args):
            return y.q, y.v.at[i].multiply(-1.0)

        return Event(lambda t, y, args: y.q[i], direction=True, reset=reset)

    y0 = nhjax.initial_state(FREE, jnp.array([-0.5, -0.5]), jnp.ones(2))
    saveat = SaveAt(steps=True)
    sol = run([wall(0), wall(1)], dt=0.25, num_steps=2, y0=y0, saveat=saveat)
    assert reported(sol)[1] == [0, 1]
    np.testing.assert_array_equal(sol.ys.v, [[1.0, 1.0], [-1.0, -1.0]])


def test_event_condition_with_infinite_rate_keeps_its_sign():
    """The square root of time has an infinite rate at the start."""
    sol = run(Event(lambda t, y, args: 0.5 - jnp.sqrt(t)))
    np.testing.assert_allclose(sol.t1, 0.25, rtol=1e-15)


def test_event_with_negative_dt_fires():
    sol = run(at(-0.4, direction=False), dt=-0.25)
    np.testing.assert_allclose(sol.t1, -0.4, rtol=1e-15)


def test_event_accumulation_fails_with_too_many_events():
    sol = run(bounce(0.5), dt=0.3, num_steps=12, system=BALL, y0=FALL, throw=False)
    assert sol.result == RESULTS.too_many_events
    assert int(sol.events.num) == 32
    assert int(sol.stats["failed_step"]) == 9
    np.testing.assert_allclose(sol.events.ts[-1], 3.0, rtol=1e-9)
    ((_, step, reason),) = sol.failures()
    assert step == 9
    assert "max_events" in reason
    assert "accumulate" in reason


@pytest.mark.parametrize("floor", [0.0, 1 / 3])
def test_event_of_a_bouncing_ball_is_never_missed_by_round_off(floor):
    """The bounces accumulate until the speed is below the round-off of positions."""
    event = Event(
        lambda t, y, args: y.q[0] - args,
        direction=False,
        reset=lambda t, y, args: (y.q, -0.05 * y.v),
        max_events=100,
    )
    y0 = nhjax.initial_state(BALL, jnp.array([0.5 + floor]), jnp.zeros(1))
    options = {"dt": 0.3, "num_steps": 12, "system": BALL, "throw": False}
    sol = run(event, y0=y0, args=floor, **options)
    assert sol.result == RESULTS.too_many_events
    assert int(sol.events.num) < 20
    np.testing.assert_allclose(sol.ys.q[0], floor, rtol=1e-15, atol=1e-30)


def test_event_condition_not_finite_fails_with_its_result():
    event = Event(lambda t, y, args: jnp.log(1.5 - y.q[0]) - 9.0)
    sol = run(event, throw=False)
    assert sol.result == RESULTS.nonfinite_event
    assert int(sol.stats["failed_step"]) == 1
    assert sol.ys.q[0, 0] == 1.0
    start = Event(lambda t, y, args: jnp.log(y.q[0] - 1.0))
    for wrong in (event, start):
        with pytest.raises(nhjax.IntegrationError, match="condition of an event"):
            run(wrong)


def test_event_reset_that_violates_a_constraint_fails():
    disc = nhjax.systems.VerticalRollingDisc()
    y0 = disc.initial_state()
    event = Event(
        lambda t, y, args: t - 0.25,
        reset=lambda t, y, args: (y.q, y.v + args),
    )

    def end(push):
        return nhjax.integrate(
            disc.system,
            METHOD,
            y0,
            dt=0.1,
            num_steps=5,
            event=event,
            args=push,
            throw=False,
        ).result

    assert end(jnp.zeros(4)) == RESULTS.successful
    assert end(jnp.array([1.0, 0.0, 0.0, 0.0])) == RESULTS.inconsistent_reset


_NUMBER: Any = 0.0
WRONG = {
    "shape (1,)": Event(lambda t, y, args: y.q),
    "dtype bool": Event(lambda t, y, args: y.q[0] > 0),
    "dtype int32": Event(lambda t, y, args: jnp.ones((), jnp.int32)),
    "got None: is a `return` missing": Event(lambda t, y, args: None),
    "a pair (q, v)": at(0.5, reset=lambda t, y, args: y.q),
    "`v` with an array of shape ()": at(0.5, reset=lambda t, y, args: (y.q, y.v[0])),
    "`q` with an array of shape (1, 1)": at(
        0.5, reset=lambda t, y, args: (y.q[None], y.v)
    ),
    "`v` of dtype float32": at(
        0.5, reset=lambda t, y, args: (y.q, y.v.astype(jnp.float32))
    ),
    "returned the `p` 0.0 of type float": at(
        0.5, reset=lambda t, y, args: nhjax.State(y.q, y.v, _NUMBER, y.multiplier)
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_event_function_with_wrong_output_raises(message):
    with pytest.raises((nhjax.ShapeError, nhjax.DTypeError, TypeError)) as error:
        run([at(0.7), WRONG[message]])
    assert "vent 1" in str(error.value)
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"saveat": SaveAt(ts=[0.5])}, "Save at `steps`"),
        (
            {"saveat": SaveAt(t1=True, checkpoint=True)},
            "Start another run from the last state",
        ),
    ],
)
def test_event_with_unsupported_option_raises(options, advice):
    with pytest.raises(ValueError, match=f"together with `event`.*{advice}"):
        run(at(0.5), **options)


@pytest.mark.usefixtures("optimised_kernels")
@pytest.mark.long
def test_event_runs_by_native_engine_equal_xla(monkeypatch):
    """Values and gradients of nine members with up to six bounces."""

    def value(speed, restitution):
        y0 = nhjax.initial_state(BALL, jnp.array([0.5]), speed[None])
        sol = nhjax.integrate(
            BALL,
            METHOD,
            y0,
            dt=0.3,
            num_steps=12,
            event=bounce(restitution, max_events=6),
            saveat=SaveAt(steps=3),
        )
        times = jnp.where(jnp.isinf(sol.events.ts), 0.0, sol.events.ts)
        return scalar((times, sol.ys.q)), sol.events.num

    given = jnp.linspace(-1.0, 1.0, 9), jnp.linspace(0.6, 0.9, 9)

    def by_engine(engine):
        monkeypatch.setenv("NHJAX_ENGINE", engine)
        program = jax.vmap(jax.value_and_grad(value, (0, 1), has_aux=True))
        return jax.jit(lambda *x: program(*x))(*given)

    lanes = by_engine("lanes")
    used = nhjax.engines(jax.vmap(lambda *x: value(*x)[1]), *given)
    assert {use.engine for use in used} == {"lanes"}
    expected = by_engine("xla")
    (_, counts), _ = lanes
    assert len(set(map(int, counts))) > 1
    for x, y in zip(jax.tree.leaves(lanes), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-12)
