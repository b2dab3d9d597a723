"""Derivatives of event times and states by every adjoint, and in batches."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import Event, LobattoIIIAB, SaveAt
from support.helpers import central_difference, direction, dot, moved, scalar
from support.impacts import rod_run, SLIDE, slide, START
from support.long import long


DIRECT, CHECKPOINTS, REVERSIBLE = (
    nhjax.DirectAdjoint(),
    nhjax.RecursiveCheckpointAdjoint(),
    nhjax.ReversibleAdjoint(),
)
GIVEN = {
    "q": jnp.asarray(START[0]),
    "v": jnp.asarray(START[1]),
    "dt": jnp.asarray(0.1),
    "restitution": jnp.asarray(0.7),
}


def times_places_and_rows(given, on_group, adjoint):
    """The output of a run in which one tip of the rod touches the floor twice."""
    dt = given["dt"]
    args = given["q"], given["v"], given["restitution"]
    options = {"saveat": SaveAt(t0=True, steps=True), "adjoint": adjoint}
    sol = rod_run(on_group, LobattoIIIAB(2), dt, 22, *args, tips=[-1], **options)
    log = jax.tree.map(lambda x: x[:2], (sol.events.ts, sol.events.before))
    return scalar((log, sol.ys.q, sol.ys.v, sol.events.after.v[:2])), sol.events.num


@pytest.mark.parametrize("on_group", [False, long(True)])
def test_event_gradients_match_finite_differences(on_group):
    along = direction(GIVEN)
    adjoints = [DIRECT, REVERSIBLE] if on_group else [DIRECT, CHECKPOINTS, REVERSIBLE]

    def value(given, adjoint: Any = DIRECT):
        return times_places_and_rows(given, on_group, adjoint)

    @jax.jit
    def gradients(given):
        return [jax.grad(value, has_aux=True)(given, adjoint) for adjoint in adjoints]

    run = jax.jit(lambda given: value(given)[0])
    expected = central_difference(lambda e: run(moved(GIVEN, along, e)), 1e-4)
    for gradient, count in gradients(GIVEN):
        assert count == 2
        np.testing.assert_allclose(dot(gradient, along), expected, rtol=1e-7)


@pytest.mark.long
def test_event_derivatives_of_members_on_a_group_match_single_runs():
    """Forward mode with checkpoints, for one start with two restitutions."""
    along = direction(GIVEN)

    def value(given):
        return times_places_and_rows(given, True, CHECKPOINTS)[0]

    def rate(given):
        return jax.jvp(value, (given,), (along,))

    members = [GIVEN, GIVEN | {"restitution": jnp.asarray(0.6)}]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *members)
    values, rates = jax.jit(jax.vmap(rate))(batch)
    run = jax.jit(value)
    for given, got, found in zip(members, values, rates, strict=True):
        np.testing.assert_allclose(got, run(given), rtol=1e-13)
        expected = central_difference(lambda e, y=given: run(moved(y, along, e)), 1e-4)
        np.testing.assert_allclose(found, expected, rtol=1e-7)


@pytest.mark.long
def test_event_second_derivatives_match_closed_forms():
    """A ball falls from the height 1/2 until T = g^(-1/2), and keeps half its speed.

    So its height at t = 1.5 is g T/2 (1.5 - T) - g/2 (1.5 - T)².
    """
    ball = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v - args * q[0])
    event = Event(
        lambda t, y, args: y.q[0],
        direction=False,
        reset=lambda t, y, args: (y.q, -0.5 * y.v),
        max_events=2,
    )
    y0 = nhjax.initial_state(ball, jnp.array([0.5]), jnp.zeros(1), args=1.0)

    def found(gravity, adjoint: Any = DIRECT):
        sol = nhjax.integrate(
            ball,
            LobattoIIIAB(2),
            y0,
            dt=0.3,
            num_steps=5,
            args=gravity,
            event=event,
            adjoint=adjoint,
        )
        return jnp.stack([sol.events.ts[0], sol.ys.q[-1, 0]])

    def expected(gravity):
        fall = gravity**-0.5
        rest = 1.5 - fall
        height = 0.5 * gravity * fall * rest - 0.5 * gravity * rest**2
        return jnp.stack([fall, height])

    @jax.jit
    def program(x):
        forward = jax.jacfwd(found)(x)
        return forward, [
            jax.jacfwd(jax.jacrev(lambda x: found(x, REVERSIBLE)))(x),
            jax.jacrev(jax.jacrev(lambda x: found(x, CHECKPOINTS)))(x),
        ]

    x = jnp.asarray(1.1)
    first, second = program(x)
    np.testing.assert_allclose(found(x), expected(x), rtol=0, atol=1e-15)
    np.testing.assert_allclose(first, jax.jacfwd(expected)(x), rtol=0, atol=1e-13)
    for one in second:
        np.testing.assert_allclose(one, jax.hessian(expected)(x), rtol=0, atol=1e-12)


@pytest.mark.parametrize("adjoint", [DIRECT, REVERSIBLE])
def test_event_next_to_a_node_has_its_derivative(adjoint):
    """The time x/v at which a free motion reaches x, just after a node."""
    free, place = nhjax.LagrangianSystem(lambda t, q, v, args: 0.5 * v @ v), 0.5 + 1e-12

    def time(v):
        return nhjax.integrate(
            free,
            LobattoIIIAB(2),
            nhjax.initial_state(free, jnp.zeros(1), v[None]),
            dt=0.25,
            num_steps=4,
            event=Event(lambda t, y, args: y.q[0] - place),
            adjoint=adjoint,
        ).t1

    np.testing.assert_allclose(jax.grad(time)(jnp.ones(())), -place, rtol=1e-12)


def test_event_at_a_vanishing_multiplier_has_exact_gradient():
    """The exact place is (2 cos α + ω²/g) / 3; differentiate in g."""
    place = jax.jit(jax.grad(lambda gravity: slide(4, 0.1, gravity).ys.q[-1, 2]))
    expected = -(SLIDE.rate**2) / 3
    np.testing.assert_allclose(place(jnp.asarray(1.0)), expected, rtol=0, atol=2e-8)


def test_event_gradients_in_a_batch_equal_single_runs():
    """100 oscillators x = cos(ωt) end where x = 0, t = π/(2ω); one never does."""
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * (v @ v - args**2 * (q @ q))
    )
    y0 = nhjax.initial_state(system, jnp.ones(1), jnp.zeros(1), args=1.0)
    event = Event(lambda t, y, args: y.q[0], direction=False)

    def end(frequency, adjoint: Any = DIRECT):
        sol = nhjax.integrate(
            system,
            LobattoIIIAB(5),
            y0,
            dt=0.1,
            num_steps=30,
            args=frequency,
            event=event,
            adjoint=adjoint,
        )
        return sol.t1, sol.events.num

    frequencies = jnp.linspace(0.6, 2.5, 100).at[17].set(0.1)
    both = jax.jit(jax.vmap(jax.value_and_grad(end, has_aux=True)))
    (times, counts), rates = both(frequencies)
    met = np.arange(100) != 17
    expected = np.pi / (2 * np.asarray(frequencies))
    np.testing.assert_array_equal(counts, met)
    np.testing.assert_allclose(times[met], expected[met], rtol=0, atol=1e-12)
    np.testing.assert_allclose(rates[met], (-expected / frequencies)[met], rtol=1e-9)
    assert times[17] == 3.0
    assert rates[17] == 0.0
    alone = jax.jit(jax.value_and_grad(end, has_aux=True))
    for i in (3, 17, 96):
        (time, count), rate = alone(frequencies[i])
        np.testing.assert_allclose((time, count), (times[i], counts[i]), rtol=1e-15)
        np.testing.assert_allclose(rate, rates[i], rtol=1e-12)
