"""Small products that are written out agree with those of libraries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._numerics._contraction import small_einsum, with_small_products


def assert_same(got, expected):
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize(
    "subscripts", ["ij,jk->ik", "i,ij->j", "i,i->", "jnm,jm->jn", "ij,ijab->iajb"]
)
@pytest.mark.parametrize("size", [3, 20])
def test_small_einsum_of_any_size_equals_einsum(subscripts, size):
    operands = [
        np.random.default_rng(k).normal(
            size=[2 if i in "ab" else size for i in indices]
        )
        for k, indices in enumerate(subscripts.split("->")[0].split(","))
    ]
    got = small_einsum(subscripts, *map(jnp.asarray, operands))
    expected = np.einsum(subscripts, *operands)
    np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("size", [3, 20])
def test_small_einsum_under_vmap_and_grad_equals_einsum(size):
    """Include reverse over forward mode, and an operand without a batch axis."""
    a, b, c = np.random.default_rng(0).normal(size=(3, size, size, size))

    def derivatives(contract):
        def loss(x, y):
            rows = jax.vmap(lambda x: contract("nm,m->n", x, y[0]), in_axes=2)
            each = jax.vmap(lambda x, y: contract("ij,jk->ki", x, y), (1, 2))(x, x)
            return jnp.sum(jnp.sin(rows(x))) + jnp.sum(each**3)

        def pushed(x, y):
            return jax.jvp(loss, (x, y), (c, c[0]))[1]

        return jax.jit(jax.value_and_grad(pushed, (0, 1)))(a, b[0])

    for x, y in zip(
        jax.tree.leaves(derivatives(small_einsum)),
        jax.tree.leaves(derivatives(jnp.einsum)),
        strict=True,
    ):
        np.testing.assert_allclose(x, y, rtol=1e-10, atol=1e-10)


def test_small_einsum_before_lowering_is_one_operation():
    def gradient(x):
        return jax.grad(lambda x: jnp.sum(small_einsum("ij,jk->ik", x, x)))(x)

    program = jax.make_jaxpr(gradient)(jnp.ones((3, 3)))
    names = [equation.primitive.name for equation in program.eqns]
    assert names.count("small_product") <= 3
    assert not {"mul", "dot_general"} & set(names)
    text = jax.jit(gradient).lower(jnp.ones((3, 3))).as_text()
    assert "multiply" in text
    assert "dot_general" not in text


@pytest.mark.parametrize("mode", ["auto", "explicit"])
def test_small_einsum_of_sharded_arrays_equals_einsum(mode):
    kind = getattr(jax.sharding.AxisType, mode.capitalize())
    mesh = jax.make_mesh((1,), ("x",), axis_types=(kind,))
    spec = jax.sharding.PartitionSpec("x")
    a, b = np.random.default_rng(0).normal(size=(2, 4, 3, 3))
    a, b = (jax.device_put(x, jax.NamedSharding(mesh, spec)) for x in (a, b))

    def function(a, b):
        product = jax.vmap(lambda x, y: small_einsum("ij,jk->ik", x, y))
        return jax.grad(lambda a: jnp.sum(product(a, b) ** 2))(a)

    with jax.set_mesh(mesh):
        mapped = jax.shard_map(
            function, mesh=mesh, in_specs=(spec, spec), out_specs=spec
        )
        got = jax.jit(mapped)(a, b)
    np.testing.assert_allclose(got, jax.jit(function)(*map(np.asarray, (a, b))))


def test_small_einsum_of_wrong_shapes_raises():
    with pytest.raises(ValueError, match="do not fit ij,jk"):
        small_einsum("ij,jk->ik", jnp.ones((2, 1)), jnp.ones((3, 2)))


def test_small_products_of_jaxpr_are_expanded():
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


def test_sum_over_members_of_batch_is_not_expanded():
    """The gradient in an operand that all members share has a term for each member."""
    matrix, vectors = jnp.ones((40, 40)), jnp.arange(40000.0).reshape(1000, 40)

    @jax.jit
    @jax.grad
    def gradient(matrix):
        products = jax.vmap(lambda x: small_einsum("ij,j->i", matrix, x))
        return products(vectors).sum()

    assert gradient.lower(matrix).as_text().count("\n") < 1000
    expected = jnp.broadcast_to(vectors.sum(axis=0), (40, 40))
    np.testing.assert_allclose(gradient(matrix), expected, rtol=1e-13)
