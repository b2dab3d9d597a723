"""Inverses of small matrices that are written out agree with those of libraries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax import lanes
from nhjax._numerics._inverse import (
    _inverse_by_rows,
    compiled_once_inverse,
    inverse,
)


@pytest.mark.parametrize("size", [0, 1, 2, 7, 8, 16, 33, 51])
def test_inverse_of_any_size_solves(size):
    matrix = np.random.default_rng(size).normal(size=(size, size))
    got = inverse(jnp.asarray(matrix))
    np.testing.assert_allclose(got @ matrix, np.eye(size), rtol=0, atol=1e-12)


def with_pivots_off_diagonal(size, seed=0):
    """Return a matrix whose rows must be exchanged at most steps of an elimination."""
    rng = np.random.default_rng(seed)
    tiny = 1e-18 * rng.normal(size=(size, size))
    return tiny + np.diag(rng.uniform(1.0, 2.0, size))[rng.permutation(size)]


@pytest.mark.parametrize(
    "compute", [inverse, lanes.jit(inverse), jax.jit(_inverse_by_rows)]
)
@pytest.mark.parametrize("size", [3, 8, 20])
def test_inverse_with_small_pivots_exchanges_rows(size, compute):
    matrix = with_pivots_off_diagonal(size)
    got = compute(jnp.asarray(matrix)) @ matrix
    np.testing.assert_allclose(got, np.eye(size), rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "compute", [inverse, lanes.jit(inverse), jax.jit(_inverse_by_rows)]
)
def test_inverse_of_singular_matrix_is_not_finite(compute):
    for matrix in (
        jnp.zeros((1, 1)),
        jnp.ones((2, 2)),
        jnp.diag(jnp.arange(3.0)),
        jnp.ones((9, 9)),
        jnp.zeros((9, 9)),
        jnp.eye(9).at[4, 7].set(jnp.nan),
    ):
        assert not np.all(np.isfinite(compute(matrix)))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("size", [8, 15, 36])
def test_inverse_of_batch_equals_numpy(size, dtype):
    """Each member exchanges other rows."""
    matrices = np.stack([with_pivots_off_diagonal(size, seed) for seed in range(3)])
    matrices += 0.1 * np.random.default_rng(0).normal(size=matrices.shape)
    expected = np.linalg.inv(matrices)
    atol = 100 * float(jnp.finfo(dtype).eps) * np.max(np.abs(expected))
    for function in (
        lanes.vmap(inverse),
        jax.vmap(inverse),
        jax.jit(jax.vmap(inverse)),
    ):
        got = function(jnp.asarray(matrices, dtype))
        assert got.dtype == dtype
        np.testing.assert_allclose(got, expected, rtol=0, atol=atol)


def test_inverse_of_matrix_with_nan_is_nan_in_the_same_places_as_the_whole_matrix():
    for place in ((0, 0), (4, 7), (8, 2)):
        matrix = jnp.asarray(with_pivots_off_diagonal(9)).at[place].set(jnp.nan)
        expected = np.isfinite(compiled_once_inverse(matrix))
        assert not expected.all()
        np.testing.assert_array_equal(np.isfinite(_inverse_by_rows(matrix)), expected)


def test_inverse_of_36_rows_in_lanes_is_short_program():
    """Loops over rows need a few lines for each column, not for each element."""
    texts = {}
    for size in (18, 36):
        program = jax.make_jaxpr(inverse)(jnp.eye(size))
        text = lanes.llvm_ir(program, (True,), 4)
        texts[size] = text[text.index("@member") :].count("\n")
    assert texts[36] < 2.2 * texts[18]


def test_inverse_before_lowering_is_one_operation():
    program = jax.make_jaxpr(inverse)(jnp.eye(8))
    inner = program.eqns[0].params["call_jaxpr"]
    assert [equation.primitive.name for equation in inner.eqns] == ["small_inverse"]


@pytest.mark.parametrize("mode", ["auto", "explicit"])
def test_inverse_of_sharded_matrices_equals_numpy(mode):
    kind = getattr(jax.sharding.AxisType, mode.capitalize())
    mesh = jax.make_mesh((1,), ("x",), axis_types=(kind,))
    spec = jax.sharding.PartitionSpec("x")
    matrices = np.random.default_rng(0).normal(size=(4, 9, 9))
    placed = jax.device_put(matrices, jax.NamedSharding(mesh, spec))
    with jax.set_mesh(mesh):
        mapped = jax.shard_map(
            jax.vmap(inverse),
            mesh=mesh,
            in_specs=spec,
            out_specs=spec,
            check_vma=False,
        )
        got = jax.jit(mapped)(placed)
    np.testing.assert_allclose(got, np.linalg.inv(matrices), rtol=1e-11, atol=1e-12)


def test_inverse_with_sharded_rows_equals_numpy():
    kind = jax.sharding.AxisType.Explicit
    mesh = jax.make_mesh((1,), ("x",), axis_types=(kind,))
    spec = jax.sharding.PartitionSpec("x", None)
    matrix = np.random.default_rng(0).normal(size=(9, 9))
    placed = jax.device_put(matrix, jax.NamedSharding(mesh, spec))
    for compute in (inverse, jax.jit(inverse)):
        got = compute(placed)
        np.testing.assert_allclose(got, np.linalg.inv(matrix), rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("size", [4, 9])
def test_derivative_of_inverse_equals_formula(size):
    matrix, rate = np.random.default_rng(0).normal(size=(2, size, size))
    x, change = jax.jvp(inverse, (jnp.asarray(matrix),), (jnp.asarray(rate),))
    np.testing.assert_allclose(change, -x @ rate @ x, rtol=1e-11)
    gradient = jax.grad(lambda m: jnp.sum(inverse(m) ** 2))(jnp.asarray(matrix))
    expected = np.sum(2 * np.asarray(x) * change)
    np.testing.assert_allclose(np.sum(gradient * rate), expected, rtol=1e-11)
