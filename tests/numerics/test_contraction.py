"""Small products and inverses that are written out give what libraries give."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._numerics._contraction import inverse, small_einsum, with_small_products


def assert_same(got, expected):
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    "subscripts", ["ij,jk->ik", "i,ij->j", "i,i->", "jnm,jm->jn", "ij,ijab->iajb"]
)
@pytest.mark.parametrize("size", [3, 20])
def test_contractions_are_those_of_einsum(subscripts, size):
    operands = [
        np.random.default_rng(k).normal(
            size=[2 if i in "ab" else size for i in indices]
        )
        for k, indices in enumerate(subscripts.split("->")[0].split(","))
    ]
    got = small_einsum(subscripts, *map(jnp.asarray, operands))
    expected = np.einsum(subscripts, *operands)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)


def test_products_of_a_program_are_written_out():
    def function(x, y):
        inner = jax.jit(lambda x: x @ y)
        batch = jnp.einsum("bij,bjk->bki", inner(x), y)
        return batch, jnp.vdot(y[0, 0], y[0, 1]), jnp.sin(x)

    x, y = np.random.default_rng(0).normal(size=(2, 4, 3, 3))
    program = jax.make_jaxpr(function)(x, y)
    written = with_small_products(program)
    assert "dot_general" in str(program)
    assert "dot_general" not in str(jax.make_jaxpr(written)(x, y))
    assert_same(written(jnp.asarray(x), jnp.asarray(y)), list(function(x, y)))


@pytest.mark.parametrize("size", [0, 1, 2, 7, 16, 32, 33])
def test_inverses(size):
    matrix = np.random.default_rng(size).normal(size=(size, size))
    got = inverse(jnp.asarray(matrix))
    np.testing.assert_allclose(got @ matrix, np.eye(size), rtol=0, atol=1e-12)


def test_inverses_need_rows_exchanged():
    matrix = jnp.array([[0.0, 2.0, 0.0], [1e-20, 1.0, 1.0], [3.0, 0.0, 0.0]])
    np.testing.assert_allclose(inverse(matrix) @ matrix, np.eye(3), rtol=0, atol=1e-14)


def test_a_singular_matrix_has_no_finite_inverse():
    for matrix in (jnp.zeros((1, 1)), jnp.ones((2, 2)), jnp.diag(jnp.arange(3.0))):
        assert not np.all(np.isfinite(inverse(matrix)))


def test_derivatives_of_inverses():
    matrix, rate = np.random.default_rng(0).normal(size=(2, 4, 4))
    x, change = jax.jvp(inverse, (jnp.asarray(matrix),), (jnp.asarray(rate),))
    np.testing.assert_allclose(change, -x @ rate @ x, rtol=1e-12)
    gradient = jax.grad(lambda m: jnp.sum(inverse(m) ** 2))(jnp.asarray(matrix))
    expected = np.sum(2 * np.asarray(x) * change)
    np.testing.assert_allclose(np.sum(gradient * rate), expected, rtol=1e-12)
