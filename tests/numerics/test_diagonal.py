"""Diagonal mass matrices are recognised, and only those."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax._numerics import jacobian, max_norm
from nhjax._numerics._contraction import inverse, matvec
from nhjax._system import linearise


def dense(diagonal):
    return jnp.diag(diagonal)


U = jnp.array([0.3, -0.4, 0.5, 1.1])
M = jnp.array([1.0, 2.0, 3.0, 4.0])

SEPARATE = {
    "square": lambda v: 0.5 * v @ v,
    "sum": lambda v: 0.5 * jnp.sum(M * v * v),
    "product": lambda v: 0.5 * jnp.dot(v, M * v),
    "named": lambda v: 0.5 * (v[0] ** 2 + 2 * v[1] ** 2) + v[2] ** 4 + v[-1] ** 2,
    "parts": lambda v: jnp.sum(v[:2] ** 2) + 3 * jnp.sum(v[2:] ** 2),
    "relativistic": lambda v: -jnp.sum(jnp.sqrt(1 - 0.1 * v**2)),
    "numbered": lambda v: jnp.sum(jnp.arange(1.0, 5.0) * v**2),
    "unused": lambda v: v[1] ** 2 + v[2] ** 2,
    "jit": jax.jit(lambda v: 0.5 * v @ v),
    "checkpoint": jax.checkpoint(lambda v: jnp.sum(v**2)),
    "joined": lambda v: jnp.sum(jnp.concatenate([v[:1], v[1:]]) ** 2),
}
COUPLED = {
    "matrix": lambda v: 0.5 * v @ (jnp.eye(4) + 0.1) @ v,
    "neighbours": lambda v: v[0] * v[1] + jnp.sum(v**2),
    "shifted": lambda v: jnp.sum(v[1:] * v[:-1]),
    "rolled": lambda v: jnp.sum(v * jnp.roll(v, 1)),
    "reversed": lambda v: v[::-1] @ v,
    "strided": lambda v: jnp.sum(v[::2] * v[1::2]),
    "norm": lambda v: jnp.sqrt(1 + v @ v),
    "mean": lambda v: jnp.sum(v) ** 2,
    "swapped": lambda v: jnp.concatenate([v[2:], v[:2]]) @ v,
    "reshaped": lambda v: jnp.sum(v.reshape(2, 2) @ v.reshape(2, 2)),
    "scan": lambda v: jax.lax.scan(lambda c, x: (c * x + x, c), 1.0, v)[0],
}


@pytest.mark.parametrize("name", SEPARATE)
def test_separate_terms_give_a_diagonal(name):
    momentum = jax.grad(SEPARATE[name])
    found = jacobian(momentum, U)
    assert found.shape == U.shape
    np.testing.assert_allclose(dense(found), jax.jacfwd(momentum)(U), rtol=1e-15)


@pytest.mark.parametrize("name", COUPLED)
def test_coupled_terms_give_a_matrix(name):
    momentum = jax.grad(COUPLED[name])
    found = jacobian(momentum, U)
    assert found.shape == (4, 4)
    np.testing.assert_allclose(found, jax.jacfwd(momentum)(U), rtol=1e-15)


def test_what_a_derivative_is_made_of_decides():
    matrix = jnp.arange(16.0).reshape(4, 4)

    @jax.custom_jvp
    def squared(v):
        return v**2

    squared.defjvp(lambda primals, tangents: (squared(*primals), matrix @ tangents[0]))
    np.testing.assert_array_equal(jacobian(squared, U), matrix)

    def by_reference(v):
        reference = jax.new_ref(jnp.zeros(4))
        reference[...] = v
        return matrix @ reference[...]

    np.testing.assert_array_equal(jacobian(by_reference, U), matrix)
    assert jacobian(lambda u: jax.lax.slice(u[0], (), ()) * u, U).shape == (4, 4)


@pytest.mark.parametrize("flip", [False, True])
def test_both_forms_recognise_a_diagonal(flip):
    m = M[:3]

    def kinetic(u):
        return 0.5 * jnp.sum(u**2 / m if flip else m * u**2)

    def generator(t, q, u, args):
        return kinetic(u) + 0.5 * (q @ q) * (1 if flip else -1)

    make = nhjax.HamiltonianSystem if flip else nhjax.LagrangianSystem
    system = make(generator, nonholonomic=lambda t, q, u, args: u[2] - q[1] * u[0])
    q, v = jnp.array([0.1, 0.5, 0.2]), jnp.array([1.0, -0.3, 0.5])
    y0 = nhjax.initial_state(system, q=q, v=v, project=True)
    lin = linearise(system, jnp.asarray(0.0), q, system.fibre_coordinate(y0), None)
    assert lin.metric_inverse.shape == (3,)
    assert system.metric(0.0, q, system.fibre_coordinate(y0)).shape == (3, 3)
    full = system.metric(0.0, q, system.fibre_coordinate(y0))
    np.testing.assert_allclose(dense(1 / lin.metric_inverse), full, rtol=1e-15)


def test_values_of_a_function_may_be_fewer_or_the_same_for_all():
    assert jacobian(lambda u: u[:2], U).shape == (2, 4)
    assert jacobian(lambda u: jnp.full((4,), u[0]), U).shape == (4, 4)
    np.testing.assert_array_equal(jacobian(lambda u: M, U), jnp.zeros(4))


def test_a_diagonal_acts_as_its_matrix_does():
    x = jnp.arange(24.0).reshape(2, 3, 4)
    full = jnp.diag(M)
    for vectors in (x[0, 0], x[0], x):
        np.testing.assert_allclose(matvec(M, vectors), matvec(full, vectors))
    np.testing.assert_allclose(dense(inverse(M)), inverse(full), rtol=1e-15)
    rate = jax.jvp(inverse, (M,), (U,))[1]
    full_rate = jax.jvp(inverse, (full,), (jnp.diag(U),))[1]
    np.testing.assert_allclose(dense(rate), full_rate, atol=1e-16)


@pytest.mark.parametrize("closure", ["propagated", "symmetric"])
def test_a_diagonal_written_as_a_matrix_gives_the_same_motion(closure):
    def phi(t, q, v, args):
        return v[2] - q[1] * v[0]

    def lagrangian(kinetic):
        return lambda t, q, v, args: kinetic(v) - 0.5 * q @ q - q[0] * q[1]

    m = M[:3]
    runs = []
    for kinetic in (lambda v: 0.5 * m @ v**2, lambda v: 0.5 * v @ jnp.diag(m) @ v):
        system = nhjax.LagrangianSystem(lagrangian(kinetic), nonholonomic=phi)
        y0 = nhjax.initial_state(
            system, q=jnp.array([0.1, 0.5, 0.2]), v=jnp.array([1.0, -0.3, 0.5])
        )
        method = nhjax.LobattoIIIAB(3, closure=closure)
        runs.append(nhjax.integrate(system, method, y0, dt=0.1, num_steps=50).ys)
    for leaf, other in zip(*map(jax.tree.leaves, runs), strict=True):
        np.testing.assert_allclose(leaf, other, atol=1e-13)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_largest_number_is_that_of_floats(dtype):
    x = jnp.array([[0.5, -3.0, -0.0], [1.0, 2.0, 1e-310]], dtype)
    assert max_norm(x) == 3
    assert max_norm(x).dtype == dtype
    assert max_norm(x, 4 * x[:, :1]) == 4
    assert max_norm(-x[0, 2:]) == 0
    assert max_norm(jnp.zeros((0,), dtype)) == 0
    assert max_norm(x, jnp.zeros((2, 0), dtype)) == 3
    assert max_norm(x, jnp.array([-jnp.inf], dtype)) == jnp.inf
    for nan in (jnp.nan, -jnp.nan):
        assert jnp.isnan(max_norm(x, jnp.array([jnp.inf, nan], dtype)))
