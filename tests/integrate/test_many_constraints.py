"""Many constraints with sparse matrices: the same steps as with dense ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import nhjax
from nhjax._system import linearise
from support import orders
from support.long import long


LINKS = 9
GRAVITY = 9.81
THREE = nhjax.LobattoIIIAB(3)


def lagrangian(t, q, v, args):
    return 0.5 * v @ v - GRAVITY * jnp.sum(q[1::2])


def rods(order):
    """The constraints of the chain, in an order that the user chose."""

    def holonomic(t, q, args):
        places = q.reshape(-1, 2)
        ends = jnp.diff(places, axis=0, prepend=jnp.zeros_like(places[:1]))
        return (jnp.sum(ends**2, axis=1) - 1.0)[order]

    return holonomic


def chain(order=None):
    holonomic = rods(np.arange(LINKS) if order is None else order)
    return nhjax.LagrangianSystem(lagrangian, holonomic=holonomic)


def dense_chain():
    """The same chain, written so that its sparsity cannot be detected."""
    plain = rods(np.arange(LINKS))
    return nhjax.LagrangianSystem(
        lagrangian, holonomic=lambda t, q, args: plain(t, q.at[0].add(0.0), args)
    )


ANGLES = 0.4 + 0.3 * np.cos(np.arange(LINKS))
PLACES = np.cumsum(np.stack([np.sin(ANGLES), -np.cos(ANGLES)], 1), axis=0)
AT_REST = jnp.zeros(2 * LINKS)
STATE = nhjax.State(jnp.asarray(PLACES.reshape(-1)), AT_REST, AT_REST, jnp.zeros(LINKS))


def is_sparse(system):
    y, t = STATE, jnp.zeros(())
    lin = linearise(system, t, y.q, y.v, None, may_be_sparse=True)
    return lin.is_sparse


def test_sparse_linearisation_of_a_chain_equals_dense():
    order = np.random.default_rng(1).permutation(LINKS)
    y, t = STATE, jnp.zeros(())
    v = jnp.asarray(np.random.default_rng(2).standard_normal(2 * LINKS))
    for system in (chain(), chain(order)):
        sparse, dense = (
            jax.jit(
                lambda v, s=system, m=may: linearise(
                    s, t, y.q, v, None, may_be_sparse=m
                )
            )(v)
            for may in (True, False)
        )
        assert sparse.is_sparse
        for name in ("acceleration", "multiplier", "violation"):
            got, expected = getattr(sparse, name), getattr(dense, name)
            np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-11)


def runs(system, num_steps=10):
    return nhjax.integrate(system, THREE, STATE, dt=0.02, num_steps=num_steps)


def test_sparse_steps_of_a_chain_equal_dense():
    assert is_sparse(chain())
    assert not is_sparse(dense_chain())
    sparse, dense = runs(chain()), runs(dense_chain())
    np.testing.assert_allclose(sparse.ys.q, dense.ys.q, rtol=0, atol=1e-13)
    np.testing.assert_allclose(sparse.ys.v, dense.ys.v, rtol=0, atol=1e-12)
    pair = [sol.ys.multiplier for sol in (sparse, dense)]
    np.testing.assert_allclose(*pair, rtol=1e-10)
    counts = [int(sol.stats["num_iterations"]) for sol in (sparse, dense)]
    assert abs(counts[0] - counts[1]) <= 2
    assert float(sparse.stats["max_constraint_violation"]) < 1e-13


def angles_rate(t, x):
    """The chain in the angles of its rods: Σ_j m_ij cos(θ_i - θ_j) θ̈_j + ... = 0."""
    theta, omega = np.split(x, 2)
    below = LINKS - np.maximum(*np.indices((LINKS, LINKS)))
    apart = theta[:, None] - theta[None]
    pull = below * np.sin(apart) @ omega**2
    weight = GRAVITY * np.diagonal(below) * np.sin(theta)
    acceleration = np.linalg.solve(below * np.cos(apart), -pull - weight)
    return np.concatenate([omega, acceleration])


def test_sparse_motion_of_a_chain_matches_equations_in_angles():
    counts, duration = (8, 16, 32), 0.4
    start = np.concatenate([ANGLES, np.zeros(LINKS)])
    end = solve_ivp(
        angles_rate, (0, duration), start, method="DOP853", rtol=1e-12, atol=1e-12
    ).y[:LINKS, -1]
    exact = np.cumsum(np.stack([np.sin(end), -np.cos(end)], 1), axis=0).reshape(-1)
    saveat = nhjax.SaveAt(t1=True)

    def run(dt, number):
        return nhjax.integrate(
            chain(), THREE, STATE, dt=dt, num_steps=number, saveat=saveat, throw=False
        ).ys.q[-1]

    dts = duration / jnp.asarray(counts, float)
    places = jax.jit(jax.vmap(run))(dts, jnp.asarray(counts))
    errors = [np.max(np.abs(place - exact)) for place in np.asarray(places)]
    orders.assert_order(4, counts, errors, orders.SCIPY_FLOOR)


def test_sparse_derivatives_of_a_chain_match_finite_differences():
    def loss(x):
        y = nhjax.State(STATE.q, STATE.v, STATE.p, STATE.multiplier)
        method = nhjax.LobattoIIIAB(2)
        sol = nhjax.integrate(chain(), method, y, dt=x, num_steps=3)
        return jnp.sum(jnp.sin(sol.ys.q)) + 1e-2 * jnp.sum(sol.ys.multiplier)

    value_and_slope = jax.jit(jax.value_and_grad(loss))
    _, slope = value_and_slope(0.05)
    above, below = (value_and_slope(0.05 + e)[0] for e in (1e-5, -1e-5))
    np.testing.assert_allclose(slope, (above - below) / 2e-5, rtol=1e-7)


# Skates that steer each other: nonholonomic constraints, whose closure has unknowns.


def skates(t, q, v, args):
    return v[:LINKS] - q[LINKS:] * jnp.roll(v[LINKS:], -1)


@pytest.mark.parametrize("form", [long("lagrangian"), "hamiltonian"])
def test_nonholonomic_constraints_and_both_forms_agree_with_dense_matrices(form):
    q = jnp.asarray(np.cos(np.arange(2.0 * LINKS)))
    v = jnp.asarray(0.5 * np.sin(2.0 * np.arange(2 * LINKS)))
    v = v.at[:LINKS].set(q[LINKS:] * jnp.roll(v[LINKS:], -1))
    ends = []
    for hidden in (False, True):

        def constraint(t, q, u, args, hidden=hidden):
            return skates(t, q, u.at[0].add(0.0) if hidden else u, args)

        if form == "lagrangian":
            system = nhjax.LagrangianSystem(
                lambda t, q, v, args: 0.5 * v @ v - 0.5 * q @ q, nonholonomic=constraint
            )
        else:
            system = nhjax.HamiltonianSystem(
                lambda t, q, p, args: 0.5 * p @ p + 0.5 * q @ q, nonholonomic=constraint
            )
        state = nhjax.State(q, v, v, jnp.zeros(LINKS))
        lin = linearise(system, jnp.zeros(()), q, v, None, may_be_sparse=True)
        assert lin.is_sparse != hidden
        method = nhjax.LobattoIIIAB(2)
        ends.append(nhjax.integrate(system, method, state, dt=0.05, num_steps=5).ys)
    for got, expected in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_allclose(got, expected, rtol=0, atol=1e-12)
