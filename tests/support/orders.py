"""Errors of runs of N steps over a fixed duration, and their observed orders."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import nhjax


SLOPE_TOLERANCE = 0.3
DURATION = 2.0
EXACT_FLOOR, SCIPY_FLOOR = 1e-14, 4e-13


def solver_for(stages):
    # Large steps, for which the simplified iteration does not contract.
    return nhjax.Newton() if stages >= 5 else nhjax.SimplifiedNewton()


@eqx.filter_jit
def runs_of_all_steps(
    system, method, y0, dts, num_steps, args, solver, invariants=None
):
    """One lane for each dt, with the continuous multiplier and the state."""

    def with_multiplier(t, y, args):
        return y, nhjax.continuous_multiplier(system, t, y, args)

    def run(dt):
        return nhjax.integrate(
            system,
            method,
            y0,
            dt=dt,
            num_steps=num_steps,
            args=args,
            stage_solver=solver,
            invariants=invariants,
            throw=False,  # Coarse runs go on beyond the duration.
            saveat=nhjax.SaveAt(steps=True, fn=with_multiplier),
        )

    return jax.vmap(run)(dts)


def trajectories(
    system, method, y0, counts, args=None, stage_solver=None, invariants=None
):
    """Nodes of runs of N = counts[lane] steps over the duration, as one program."""
    dts = DURATION / jnp.asarray(counts, float)
    if stage_solver is None:
        stage_solver = solver_for(method.stages)
    options = args, stage_solver, invariants
    sol = runs_of_all_steps(system, method, y0, dts, max(counts), *options)
    # Each index into a JAX array would compile a separate program.
    ts, ys, failed = jax.tree.map(
        np.asarray, (sol.ts, sol.ys, sol.stats["failed_step"])
    )
    lanes = []
    for lane, count in enumerate(counts):
        assert not 0 <= failed[lane] < count
        y, continuous = jax.tree.map(lambda x, k=lane, n=count: x[k, :n], ys)
        lanes.append((ts[lane, :count], y, continuous))
    return lanes


def rms(error):
    return np.sqrt(np.mean(np.max(np.abs(error), axis=-1) ** 2))


def slopes(counts, errors):
    """Orders of convergence from each N to the next."""
    errors = np.asarray(errors)
    return np.log(errors[:-1] / errors[1:]) / np.log(np.divide(counts[1:], counts[:-1]))


def assert_order(order, counts, errors, floor=EXACT_FLOOR, tolerance=SLOPE_TOLERANCE):
    assert min(errors) > floor, f"errors too near those of the reference: {errors}"
    observed = slopes(counts, errors)
    np.testing.assert_allclose(
        observed, order, rtol=0, atol=tolerance, err_msg=f"errors {errors}"
    )


class Ladder(NamedTuple):
    """The step sizes of runs with N steps each, and the nodes of a reference.

    All lanes take the same number of steps; only those up to the `duration` count. The
    reference is known at multiples of the `finest` step.
    """

    step_sizes: tuple[float, ...]
    num_steps: int
    duration: float
    finest: float

    def climb(self, system, method, y0, args=None, solver=None):
        """Times, states and continuous multipliers, with one lane for each size."""
        solver = solver_for(method.stages) if solver is None else solver
        dts = jnp.array(self.step_sizes)
        sol = runs_of_all_steps(system, method, y0, dts, self.num_steps, args, solver)
        assert np.all(np.asarray(sol.stats["failed_step"]) == -1)
        return jax.tree.map(np.asarray, (sol.ts, *sol.ys))

    def assert_order(self, order, found, expected, floor=1e-11):
        """Check the order at which `found` converges to `expected`."""
        counts, errors = [], []
        for lane, h in enumerate(self.step_sizes):
            count, stride = round(self.duration / h), round(h / self.finest)
            counts.append(count)
            errors.append(rms(found[lane, :count] - expected[stride::stride]))
        assert_order(order, counts, errors, floor=floor)
