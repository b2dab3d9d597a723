"""Runs of one machine at several step sizes, as one program, and their errors."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from support.library_motion import motion_at
from support.orders import slopes


class Runs(NamedTuple):
    """A lane for each step size; all take as many steps as the finest."""

    counts: tuple[int, ...]
    ts: np.ndarray  # (lanes, steps)
    ys: nhjax.State
    multiplier: np.ndarray  # of the continuous equations
    violation: np.ndarray  # the largest of each lane

    def until_the_duration(self, lane):
        """The nodes of one lane that lie in the duration, as (t, y, multiplier)."""
        count = self.counts[lane]
        part = jax.tree.map(lambda x: x[lane, :count], self.ys)
        return self.ts[lane, :count], part, self.multiplier[lane, :count]


@eqx.filter_jit
def _integrate(system, method, y0, dts, num_steps, args) -> Any:
    def run(dt):
        return nhjax.integrate(
            system,
            method,
            y0,
            dt=dt,
            num_steps=num_steps,
            args=args,
            throw=False,  # The assertion below reports failures.
            saveat=nhjax.SaveAt(steps=True),
        )

    return jax.vmap(run)(dts)


def runs(system, method, y0, counts, duration, args=None):
    """Run over the duration with N = counts[lane] steps.

    The multiplier is computed afterwards, so that it is not traced with the run.
    """
    dts = jnp.asarray(duration, float) / jnp.asarray(counts, float)
    sol = _integrate(system, method, y0, dts, max(counts), args)
    assert np.all(np.asarray(sol.stats["failed_step"]) < 0), "a run has failed"
    ts, ys, violation = jax.tree.map(
        np.asarray, (sol.ts, sol.ys, sol.stats["max_constraint_violation"])
    )

    def flat(x):
        return x.reshape(-1, *x.shape[2:])

    q, v = jax.tree.map(flat, (ys.q, ys.v))
    _, multiplier, _ = accelerations(system, q, v, args)
    multiplier = multiplier.reshape(*ts.shape, -1)
    return Runs(tuple(counts), ts, ys, multiplier, violation)


def runs_of_three_stages(example, counts, duration):
    """The runs of an example, of order 4.

    One number of stages suffices to test a system, since its equations do not depend on
    the method; `tests/integrate` tests the orders for other numbers of stages.
    """
    method = nhjax.LobattoIIIAB(3)
    return runs(example.system, method, example.initial_state(), counts, duration)


def assert_orders(runs: Runs, order: int, errors_at, floor: float, atol=0.3):
    """Check the slope of each error from each lane to the next.

    `errors_at(t, y, multiplier)` maps nodes to a dictionary of errors by name, and the
    largest along the run counts.
    """
    lanes = [errors_at(*runs.until_the_duration(k)) for k in range(len(runs.counts))]
    for name in lanes[0]:
        largest = [float(np.max(np.abs(lane[name]))) for lane in lanes]
        assert min(largest) > floor, f"{name}: too near the reference: {largest}"
        np.testing.assert_allclose(
            slopes(runs.counts, largest),
            order,
            rtol=0,
            atol=atol,
            err_msg=f"{name}: {largest}",
        )


@eqx.filter_jit
def _accelerations(system, q, u, args) -> tuple[Any, Any, Any]:
    def at(q, u):
        return (
            *motion_at(system, 0.0, q, u, args),
            system.constraint(jnp.zeros_like(u[0]), q, u, args),
        )

    return jax.vmap(at)(q, u)


def accelerations(system, q, v, args=None):
    """(v̇, λ, violation) of the library at time 0, at each of several states."""
    q, v = jax.tree.map(jnp.asarray, (q, v))
    return jax.tree.map(np.asarray, _accelerations(system, q, v, args))


@eqx.filter_jit
def _invariants(example, t, q, v) -> Any:
    return jax.vmap(jax.vmap(example.invariants))(t, q, v)


def drifts(example, runs: Runs):
    """The largest change of each invariant along all of each lane, by name."""
    y0 = example.initial_state()
    values = _invariants(example, *map(_device, (runs.ts, runs.ys.q, runs.ys.v)))
    start = example.invariants(jnp.zeros(()), y0.q, y0.v)
    return {
        name: np.max(np.abs(np.asarray(values[name]) - float(start[name])), axis=1)
        for name in values
    }


def _device(tree):
    return jax.tree.map(jnp.asarray, tree)


def stack(states):
    """One (q, v) with a leading axis, from several."""
    return jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *states)
