"""Inverses of small matrices that are written out agree with those of libraries."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax import lanes
from nhjax._numerics._inverse import compiled_once_inverse, inverse


@pytest.mark.parametrize("size", [0, 1, 2, 7, 8, 16, 33, 51])
def test_inverse_of_any_size_solves(size):
    matrix = np.random.default_rng(size).normal(size=(size, size))
    got = inverse(jnp.asarray(matrix))
    np.testing.assert_allclose(got @ matrix, np.eye(size), rtol=0, atol=1e-12)


def with_pivots_off_diagonal(size):
    """Return a matrix whose rows must be exchanged at most steps of an elimination."""
    rng = np.random.default_rng(size)
    tiny = 1e-18 * rng.normal(size=(size, size))
    return tiny + np.diag(rng.uniform(1.0, 2.0, size))[rng.permutation(size)]


@pytest.mark.parametrize("compute", [inverse, lanes.jit(inverse), jax.jit(inverse)])
@pytest.mark.parametrize("size", [3, 8, 20])
def test_inverse_with_small_pivots_exchanges_rows(size, compute):
    matrix = with_pivots_off_diagonal(size)
    got = compute(jnp.asarray(matrix)) @ matrix
    np.testing.assert_allclose(got, np.eye(size), rtol=0, atol=1e-14)


@pytest.mark.parametrize("compute", [inverse, lanes.jit(inverse), jax.jit(inverse)])
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
def test_inverse_of_batch_in_lanes_equals_operations_on_whole_matrices(dtype):
    """Each member exchanges other rows, in the compiler's loops over rows."""
    matrices = np.stack([with_pivots_off_diagonal(12) for _ in range(3)])
    matrices += np.random.default_rng(0).normal(size=(3, 12, 12))
    matrices = jnp.asarray(matrices, dtype)
    expected = jax.vmap(compiled_once_inverse)(matrices)
    rtol = 1000 * float(jnp.finfo(dtype).eps)
    for function in (
        lanes.vmap(inverse),
        jax.vmap(inverse),
        jax.jit(jax.vmap(inverse)),
    ):
        got = function(matrices)
        assert got.dtype == dtype
        np.testing.assert_allclose(got, expected, rtol=rtol, atol=rtol)


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
    assert str(program).count("small_inverse") == 1
    assert "while" not in str(program)


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


@pytest.mark.parametrize("size", [4, 9])
def test_derivative_of_inverse_equals_formula(size):
    matrix, rate = np.random.default_rng(0).normal(size=(2, size, size))
    x, change = jax.jvp(inverse, (jnp.asarray(matrix),), (jnp.asarray(rate),))
    np.testing.assert_allclose(change, -x @ rate @ x, rtol=1e-11)
    gradient = jax.grad(lambda m: jnp.sum(inverse(m) ** 2))(jnp.asarray(matrix))
    expected = np.sum(2 * np.asarray(x) * change)
    np.testing.assert_allclose(np.sum(gradient * rate), expected, rtol=1e-11)
