"""Gradients of failed trajectories: NaN for the failed member, and for no other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, SaveAt, systems


ADJOINTS = {
    "direct": nhjax.DirectAdjoint(),
    "checkpoints": nhjax.RecursiveCheckpointAdjoint(3),
    "reversible": nhjax.ReversibleAdjoint(),
}
SUCCESSFUL = nhjax.RESULTS.successful
NOT_CONVERGED = nhjax.RESULTS.nonlinear_divergence
SINGULAR = nhjax.RESULTS.singular_stage_matrix
NONFINITE = nhjax.RESULTS.nonfinite_state
LEFT = nhjax.RESULTS.left_chart
INCONSISTENT = nhjax.RESULTS.inconsistent_start


def assert_lanes(loss, lanes, others, reasons):
    """Some of `lanes` fail, for the `reasons`; `others` has good ones in their place.

    `loss(x)` returns a number and the solution behind it.
    """
    failed = np.array([reason is not None for reason in reasons])

    def chosen(x, masked):
        value, sol = loss(x)
        left_out = masked & (sol.result != SUCCESSFUL)
        return jnp.where(left_out, 0.0, value), sol.result._value

    program = jax.jit(jax.vmap(jax.grad(chosen, has_aux=True), in_axes=(0, None)))
    no, yes = jnp.asarray(False), jnp.asarray(True)
    got, codes = program(lanes, no)
    got_masked, _ = program(lanes, yes)
    expected, none = program(others, no)
    reached = [SUCCESSFUL if reason is None else reason for reason in reasons]
    np.testing.assert_array_equal(codes, [int(x._value) for x in reached])
    np.testing.assert_array_equal(none, int(SUCCESSFUL._value))
    assert np.all(np.isfinite(expected))
    assert np.all(np.any(expected.reshape(len(reasons), -1) != 0, axis=1))
    failed = failed.reshape(-1, *[1] * (expected.ndim - 1))
    np.testing.assert_array_equal(got, np.where(failed, np.nan, expected))
    # A loss of a NaN state has no derivative, even if it is left out.
    finite = np.all(np.isfinite(lanes.reshape(len(reasons), -1)), axis=1)
    left_out = np.where(failed, 0.0, expected)
    np.testing.assert_array_equal(got_masked[finite], left_out[finite])


def lossy_lagrangian(t, q, v, args):
    """A mass that changes and a wall, beyond which values are NaN."""
    mass = args["mass"] + args["change"] * t
    wall = 1e-3 * jnp.sqrt(args["wall"] - q[0])
    return 0.5 * mass * (v @ v) - 0.5 * (q @ q) + wall


LOSSY = nhjax.LagrangianSystem(
    lossy_lagrangian, nonholonomic=lambda t, q, v, args: v[2] - q[1] * v[0]
)


@pytest.mark.parametrize("name", ADJOINTS)
def test_gradient_of_members_that_fail_is_nan_for_them_only(name):
    def loss(x):
        shift, wall, mass, change, off = x
        q, v = jnp.array([0.2, 0.5, 0.1]), jnp.array([1.0, 0.6, 0.5])
        q = q + shift * jnp.array([1.0, 0.0, 0.0])
        v = v + off * jnp.array([0.0, 0.0, 1.0])
        sol = nhjax.integrate(
            LOSSY,
            LobattoIIIAB(2),
            nhjax.State(q, v, mass * v, jnp.zeros(1)),
            dt=0.1,
            num_steps=7,
            args={"wall": wall, "mass": mass, "change": change},
            throw=False,
            adjoint=ADJOINTS[name],
            saveat=SaveAt(steps=2, t1=True),
        )
        return jnp.sum(jnp.sin(sol.ys.q)) + jnp.sum(sol.ys.p**2), sol

    good = [0.0, 2.0, 1.0, 0.1, 0.0]
    lanes = [
        (good, None),
        ([jnp.nan, 2.0, 1.0, 0.1, 0.0], NONFINITE),
        ([0.0, 0.5, 1.0, 0.1, 0.0], NONFINITE),
        ([0.0, 2.0, 0.0, 0.1, 0.0], SINGULAR),
        ([0.0, 2.0, 1.0, -2.0, 0.0], NOT_CONVERGED),
        ([0.0, 2.0, 1.0, 0.1, 0.3], INCONSISTENT),
        ([0.1, 2.1, 1.2, 0.2, 0.0], None),
    ]
    others = [good if reason is not None else lane for lane, reason in lanes]
    reasons = [reason for _, reason in lanes]
    assert_lanes(
        loss, jnp.array([lane for lane, _ in lanes]), jnp.array(others), reasons
    )


@pytest.mark.parametrize("name", ADJOINTS)
def test_gradient_of_a_member_that_leaves_the_chart_is_nan_for_it_only(name):
    system = nhjax.LagrangianSystem(
        lambda t, q, v, args: 0.5 * v @ v + 0.1 * jnp.cos(q[0]), manifold=nhjax.SO2()
    )

    def loss(speed):
        q, v = jnp.array([0.3]), jnp.stack([speed])
        sol = nhjax.integrate(
            system,
            LobattoIIIAB(2),
            nhjax.State(q, v, v, jnp.zeros(0)),
            dt=0.1,
            num_steps=3,
            throw=False,
            adjoint=ADJOINTS[name],
        )
        return jnp.sum(jnp.sin(sol.ys.q)), sol

    lanes, others = jnp.array([1.0, 3000.0]), jnp.array([1.0, 2.0])
    assert_lanes(loss, lanes, others, [None, LEFT])


def give_up(dt, adjoint):
    """A run that fails at once, because it may take only two iterations."""
    particle = systems.NonholonomicParticle()
    return jnp.sum(
        nhjax.integrate(
            particle.system,
            LobattoIIIAB(2),
            particle.initial_state(),
            dt=dt,
            num_steps=2,
            stage_solver=nhjax.SimplifiedNewton(max_iterations=2),
            adjoint=adjoint,
        ).ys.q
    )


@pytest.mark.parametrize("name", ADJOINTS)
@pytest.mark.parametrize("compiled", [False, True], ids=["eager", "jit"])
def test_gradient_of_a_run_that_throws_raises(name, compiled):
    gradient = jax.grad(lambda dt: give_up(dt, ADJOINTS[name]))
    gradient = jax.jit(gradient) if compiled else gradient
    error = jax.errors.JaxRuntimeError if compiled else Exception
    with pytest.raises(error, match="within the `max_iterations`"):
        jax.block_until_ready(gradient(0.1))
