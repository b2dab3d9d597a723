"""The three adjoints in reverse mode, forward mode, and second derivatives."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems
from nhjax._step import first_step_state
from support.driven import Driven
from support.helpers import (
    central_difference,
    direction,
    dot,
    scalar,
)
from support.long import long


DIRECT = nhjax.DirectAdjoint()
CHECKPOINTS = nhjax.RecursiveCheckpointAdjoint()
REVERSIBLE = nhjax.ReversibleAdjoint()


def largest(tree):
    return max(float(jnp.max(jnp.abs(x), initial=0.0)) for x in jax.tree.leaves(tree))


def difference(got, expected):
    """Assert agreement relative to the largest number of all."""
    return largest(jax.tree.map(jnp.subtract, got, expected)) / largest(expected)


def assert_adjoints_agree(loss, given, adjoints):
    """Assert that gradients by `adjoints` and forward mode agree."""
    along = direction(given)

    @jax.jit
    def program(given):
        gradients = [jax.grad(loss)(given, adjoint) for adjoint in adjoints]
        return gradients, jax.jvp(lambda x: loss(x, DIRECT), (given,), (along,))[1]

    (first, *others), forward = program(given)
    for other in others:
        assert difference(other, first) < 1e-10
    assert abs(forward) > 1e-2
    np.testing.assert_allclose(dot(first, along), forward, rtol=1e-11)


GIVEN = {
    "q": jnp.array([0.5, -0.3, 0.2]),
    "v": jnp.array([0.4, 0.6, 1.38]),
    "dt": jnp.asarray(0.05),
    "mass": jnp.asarray(1.2),
    "args": {"friction": jnp.asarray(0.25)},
    "ts": jnp.array([0.101, 0.123, 0.31]),
    "fn": jnp.asarray(1.3),
}


def driven(given, adjoint, method, num_steps=10, samples=False, **options):
    """A run of a system with explicit time whose functions close over the mass."""
    driven = Driven(given["mass"])
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: driven.lagrangian(t, q, v, args),
        nonholonomic=driven.constraint,
        force=driven.friction,
    )
    args = given["args"]
    y0 = nhjax.initial_state(system, given["q"], given["v"], args=args, project=True)

    def fn(t, y, args):
        return given["fn"] * y.q * t, y, args

    times: dict[str, Any] = (
        {"ts": given["ts"], "dense": True} if samples else {"steps": 3}
    )
    sol = nhjax.integrate(
        system,
        method,
        y0,
        dt=given["dt"],
        num_steps=num_steps,
        args=args,
        saveat=SaveAt(t0=True, t1=True, fn=fn, **times),
        adjoint=adjoint,
        **options,
    )
    inside = sol.evaluate(0.222) if samples else sol.t1
    return scalar((sol.ts, sol.ys, inside))


@pytest.mark.long
@pytest.mark.parametrize(
    ("method", "options"),
    [
        (LobattoIIIAB(2), {"samples": True}),
        (LobattoIIIAB(2, "consistent"), {"stage_solver": nhjax.Newton()}),
        (LobattoIIIAB(2, "propagated"), {}),
    ],
    ids=["samples", "Newton", "propagated"],
)
def test_adjoints_of_a_run_give_equal_gradients(method, options):
    assert_adjoints_agree(
        lambda given, adjoint: driven(given, adjoint, method, **options),
        GIVEN,
        [DIRECT, CHECKPOINTS, REVERSIBLE],
    )


def test_adjoints_on_a_group_give_equal_gradients():
    suslov = systems.Suslov()
    parameters, fixed = eqx.partition(suslov.system, eqx.is_inexact_array)
    given = (parameters, jnp.zeros(3), suslov.initial_state().p, jnp.asarray(0.1))

    def loss(given, adjoint):
        parameters, xi, p, dt = given
        system = eqx.combine(parameters, fixed)
        y = suslov.initial_state()
        y0 = nhjax.State(suslov.manifold.act(y.q, xi), y.v, p, y.multiplier)
        sol = nhjax.integrate(
            system,
            LobattoIIIAB(2, "propagated"),
            y0,
            dt=dt,
            num_steps=10,
            adjoint=adjoint,
        )
        return scalar(sol.ys)

    assert_adjoints_agree(loss, given, [DIRECT, CHECKPOINTS, REVERSIBLE])


def swing(dt, num_steps, adjoint, saveat: Any = None):
    """An oscillator."""
    oscillator = systems.HarmonicOscillator()
    sol = nhjax.integrate(
        oscillator.system,
        LobattoIIIAB(2),
        oscillator.initial_state(),
        dt=dt,
        num_steps=num_steps,
        adjoint=adjoint,
        saveat=SaveAt(steps=3, t1=True) if saveat is None else saveat,
    )
    return scalar((sol.ts, sol.ys))


@pytest.mark.parametrize(("num_steps", "checkpoints"), [(1, None), (11, 2), (11, 21)])
def test_checkpoint_adjoint_with_any_block_length_gives_the_same_gradient(
    num_steps, checkpoints
):
    adjoint = nhjax.RecursiveCheckpointAdjoint(checkpoints)

    @jax.jit
    def program(dt):
        return [jax.value_and_grad(swing)(dt, num_steps, a) for a in (DIRECT, adjoint)]

    direct, blocks = program(0.1)
    np.testing.assert_allclose(blocks, direct, rtol=1e-13)


# Second derivatives -------------------------------------------------------------------


def curved(x, adjoint):
    """A few steps of a particle, in its mass, a velocity and the step."""
    example = systems.NonholonomicParticle(1.0 + x[0], 0.6)
    v = example.v0 + x[1] * jnp.array([1.0, 0.5, 0.3])
    y0 = nhjax.initial_state(example.system, example.q0, v)
    ys = nhjax.integrate(
        example.system,
        LobattoIIIAB(2),
        y0,
        dt=0.1 + 0.1 * x[2],
        num_steps=4,
        adjoint=adjoint,
    ).ys
    return scalar(ys)


@jax.jit
def gradient_of_curved(x):
    return jax.grad(curved)(x, DIRECT)


ORDERS = {
    "hessian": jax.hessian,
    "reverse over forward": lambda f: jax.jacrev(jax.jacfwd(f)),
    "reverse over reverse": lambda f: jax.jacrev(jax.jacrev(f)),
}


@pytest.mark.parametrize(
    ("adjoint", "order"),
    [
        long(DIRECT, "hessian"),
        long(DIRECT, "reverse over reverse"),
        long(CHECKPOINTS, "reverse over forward"),
        (REVERSIBLE, "hessian"),
    ],
    ids=["direct", "direct in reverse", "blocks", "reversible"],
)
def test_hessian_by_each_adjoint_matches_finite_differences(adjoint, order):
    x, along = jnp.array([0.3, 0.1, -0.2]), jnp.array([1.0, -0.7, 0.5])

    def f(x):
        return curved(x, adjoint)

    hessian = jax.jit(ORDERS[order](f))(x)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-9)
    expected = central_difference(lambda eps: gradient_of_curved(x + eps * along), 1e-3)
    np.testing.assert_allclose(hessian @ along, expected, rtol=1e-8)


# What is refused ----------------------------------------------------------------------


@pytest.mark.parametrize("adjoint", [nhjax.DirectAdjoint, 3])
def test_adjoint_of_a_wrong_type_raises(adjoint):
    with pytest.raises(TypeError, match="`adjoint` must be an"):
        swing(0.1, 2, adjoint)


@pytest.mark.parametrize("checkpoints", [0, -1, 2.5, True, "3"])
def test_number_of_checkpoints_out_of_range_raises(checkpoints):
    with pytest.raises(ValueError, match="`checkpoints` must be an int >= 2"):
        nhjax.RecursiveCheckpointAdjoint(checkpoints)


def test_reversible_adjoint_in_forward_mode_raises():
    with pytest.raises(TypeError, match=r"forward|jvp"):
        jax.jvp(lambda dt: swing(dt, 2, REVERSIBLE), (0.1,), (1.0,))


# Memory -------------------------------------------------------------------------------


@pytest.mark.long
def test_memory_of_each_adjoint_grows_as_documented():
    example = systems.NonholonomicParticle()
    y0 = example.initial_state()

    def temporary(adjoint, num_steps):
        def loss(y0):
            sol = nhjax.integrate(
                example.system,
                LobattoIIIAB(2),
                y0,
                dt=0.1,
                num_steps=num_steps,
                adjoint=adjoint,
            )
            return jnp.sum(sol.ys.q**2)

        memory = jax.jit(jax.grad(loss)).lower(y0).compile().memory_analysis()
        assert memory is not None
        return memory.temp_size_in_bytes

    # Each memory has a part that does not grow.
    assert temporary(REVERSIBLE, 10_000) == temporary(REVERSIBLE, 100)
    assert temporary(CHECKPOINTS, 10_000) <= 10 * temporary(CHECKPOINTS, 100)
    assert 50 * temporary(DIRECT, 100) < temporary(DIRECT, 10_000)


@pytest.mark.long
def test_direct_adjoint_stores_only_states_and_stages_of_each_step():
    example, stages = systems.ChaplyginSleigh(), 3
    y0, method = example.initial_state(), LobattoIIIAB(stages)
    n, m = y0.p.size, y0.multiplier.size

    def stored(num_steps):
        def loss(y0):
            sol = nhjax.integrate(
                example.system, method, y0, dt=0.1, num_steps=num_steps
            )
            return jnp.sum(sol.ys.q**2)

        memory = jax.jit(jax.grad(loss)).lower(y0).compile().memory_analysis()
        assert memory is not None
        return memory.temp_size_in_bytes

    first = first_step_state(example.system, method, jnp.zeros(()), y0, None)
    state = sum(x.size for x in jax.tree.leaves(first))
    # The unknowns are the stages, the nodes, the closure and the end of the step.
    unknowns = stages * n + (stages - 1) * (n + m) + n + m
    numbers = (stored(2000) - stored(1000)) / (1000 * y0.p.itemsize)
    # A few other numbers are stored too. The Jacobian of the stages alone has 81.
    assert numbers < 1.2 * (state + unknowns)
