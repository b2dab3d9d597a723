"""Shared by tests of machines: the motion by the library and by other equations."""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import nhjax
from support import orders
from support.orders import runs_of_all_steps


def assert_motion(found, expected, tolerance=1e-11):
    """Compare (a, λ) with those expected, relative to their largest entries."""
    for actual, desired in zip(found, expected, strict=True):
        error = np.max(np.abs(actual - desired))
        assert error <= tolerance * np.max(np.abs(desired)), (actual, desired)


def saddle(mass, force, jacobian, hidden):
    """(a, λ) with M a - Jᵀ λ = f and J a = h, by one dense matrix."""
    n, k = len(force), len(hidden)
    matrix = np.zeros((n + k, n + k))
    matrix[:n, :n], matrix[:n, n:], matrix[n:, :n] = mass, -jacobian.T, jacobian
    solution = np.linalg.solve(matrix, np.concatenate([force, hidden]))
    return solution[:n], solution[n:]


class Lane(NamedTuple):
    """The nodes of a run: times, and q, v, p, continuous multiplier at each."""

    t: np.ndarray
    q: np.ndarray
    v: np.ndarray
    p: np.ndarray
    multiplier: np.ndarray


class Runs(NamedTuple):
    """A run of N = counts[k] steps over one duration for each lane k."""

    lanes: list[Lane]
    violations: list[float]

    def errors(self, name, expected):
        """The largest error at the end, of each lane."""
        return [np.max(np.abs(getattr(x, name)[-1] - expected)) for x in self.lanes]


def runs(example, stages, counts, duration, args=None, solver=None):
    """Runs from the initial state of an example, as one program."""
    y0, method = example.initial_state(), nhjax.LobattoIIIAB(stages)
    solver = nhjax.SimplifiedNewton() if solver is None else solver
    dts = duration / jnp.asarray(counts, float)
    sol = runs_of_all_steps(example.system, method, y0, dts, max(counts), args, solver)
    ts, (y, multipliers), stats = jax.tree.map(np.asarray, (sol.ts, sol.ys, sol.stats))
    lanes, violations = [], []
    for k, count in enumerate(counts):
        assert not 0 <= stats["failed_step"][k] < count
        lanes.append(Lane(*(x[k, :count] for x in (ts, y.q, y.v, y.p, multipliers))))
        violations.append(stats["max_constraint_violation"][k])
    return Runs(lanes, violations)


# Compare the observed order from each N to the next with the expected one.
assert_order = partial(orders.assert_order, floor=0.0, tolerance=0.2)


@eqx.filter_jit
def invariants(example, t, q, v):
    """The conserved quantities of an example along the nodes of a run."""
    return jax.vmap(example.invariants)(t, q, v)


def assert_single_precision(example):
    """All that an example computes is in float32 for a state in float32."""

    def values():
        y0 = example.initial_state(jnp.float32)
        t = jnp.zeros((), jnp.float32)
        lagrangian = example.lagrangian(t, y0.q, y0.v, None)
        return (
            y0,
            lagrangian,
            example.invariants(t, y0.q, y0.v),
            example.points(t, y0.q),
        )

    leaves = jax.tree.leaves(jax.eval_shape(values))
    assert {x.dtype for x in leaves} == {jnp.dtype(jnp.float32)}
