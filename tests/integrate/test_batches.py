"""Batches and ensembles, and programs that are compiled once."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import SaveAt
from nhjax.systems import (
    ChaoticSystem,
)
from support.driven import Driven
from support.particle_run import assert_trees_close, DT, PARTICLE, run


# Transformations ----------------------------------------------------------------------


def driven_run(mass, q, dt, t0, friction):
    system = Driven(mass).system
    args = {"friction": friction, "a name": "is static"}
    v = jnp.array([0.4, 0.6, 1.0])
    y0 = nhjax.initial_state(system, q, v, t=t0, args=args, project=True)
    sol = nhjax.integrate(
        system,
        nhjax.LobattoIIIAB(2),
        y0,
        dt=dt,
        num_steps=8,
        t0=t0,
        args=args,
        saveat=SaveAt(t0=True, steps=3, t1=True),
    )
    return sol.ts, sol.ys, sol.stats


LANES = {
    "mass": jnp.array([1.0, 1.5, 2.0]),
    "q": jnp.array([[0.5, -0.3, 0.2], [1.0, 0.0, 0.0], [-0.2, 0.8, 0.1]]),
    "dt": jnp.array([0.1, 0.05, -0.1]),
    "t0": jnp.array([0.0, 1.0, -2.0]),
    "friction": jnp.array([0.0, 0.1, 0.2]),
}


@pytest.fixture(scope="module")
def driven_single():
    return jax.jit(driven_run)


@pytest.mark.parametrize(
    "names", [["q"], ["dt", "t0"], ["mass", "friction"], list(LANES)]
)
def test_batch_under_vmap_equals_single_runs(names, driven_single):
    first = {name: values[0] for name, values in LANES.items()}
    axes = [0 if name in names else None for name in LANES]
    given = [LANES[name] if name in names else first[name] for name in LANES]
    batch = jax.jit(jax.vmap(driven_run, in_axes=axes))(*given)
    for k in range(3):
        lane = [LANES[name][k] if name in names else first[name] for name in LANES]
        (ts, ys, stats) = jax.tree.map(lambda x, k=k: x[k], batch)
        expected_ts, expected_ys, expected_stats = driven_single(*lane)
        np.testing.assert_array_equal(ts, expected_ts)
        assert_trees_close(ys, expected_ys, rtol=1e-13, atol=1e-14)
        assert set(stats) == set(expected_stats)
        assert int(stats["num_steps"]) == 8


def test_ensemble_of_runs_equals_single_runs():
    chaotic = ChaoticSystem()

    def member(q, v):
        y0 = nhjax.initial_state(chaotic.system, q, v)
        return run(system=chaotic.system, y0=y0, num_steps=10).ys

    q0, v0 = chaotic.ensemble(100)
    batch = jax.jit(jax.vmap(member))(q0, v0)
    single = jax.jit(member)
    singles = [single(q, v) for q, v in zip(q0, v0, strict=True)]
    expected = jax.tree.map(lambda *x: jnp.stack(x), *singles)
    assert batch.q.shape == (101, 1, 7)
    assert_trees_close(batch, expected, rtol=1e-13, atol=1e-13)


def test_solution_returned_from_jit_is_unchanged():
    # A jitted function cannot return functions as leaves.
    sol = jax.jit(lambda dt: run(dt=dt, saveat=SaveAt(dense=True)))(DT)
    again = eqx.filter_jit(lambda sol, t: sol.evaluate(t))(sol, 0.55)
    assert_trees_close(again, sol.evaluate(0.55), rtol=1e-15)


class Counted(eqx.Module):
    """A Lagrangian that counts how often it is traced."""

    stiffness: jax.Array

    def __call__(self, t, q, v, args):
        traces.append(1)
        return 0.5 * (v @ v) - 0.5 * args * self.stiffness * (q @ q)


traces: list[int] = []


def counted_run(dt=0.1, t0=0.0, args: Any = 1.0, tolerance=0.0, stiffness=1.0, q=1.0):
    system = nhjax.LagrangianSystem(
        Counted(jnp.asarray(stiffness)), nonholonomic=PARTICLE.constraint
    )
    y0 = PARTICLE.initial_state()
    y0 = eqx.tree_at(lambda y: y.q, y0, y0.q.at[0].set(q))
    return run(
        system=system,
        y0=y0,
        dt=dt,
        t0=t0,
        args=args,
        stage_solver=nhjax.SimplifiedNewton(tolerance=tolerance),
        saveat=SaveAt(ts=t0 + dt * jnp.array([0.5, 2.5])),
    ).ys


OTHER_VALUES = {
    "dt": 0.05,
    "t0": 1.0,
    "args": 2.0,
    "tolerance": 1e-8,
    "stiffness": 3.0,
    "q": 0.5,
}


def test_run_with_other_values_does_not_recompile():
    first = counted_run()
    count = len(traces)
    assert count > 0
    for name, value in OTHER_VALUES.items():
        other = counted_run(**{name: value})
        assert len(traces) == count, name
        if name != "t0":
            assert jnp.any(other.q != first.q), name


def test_run_with_other_values_under_jit_does_not_retrace():
    program = jax.jit(counted_run)
    program(**dict.fromkeys(OTHER_VALUES, 1.0))
    count = len(traces)
    program(**OTHER_VALUES)
    assert len(traces) == count
