"""Operations that are replaced by simpler ones: factorisations, and foreign ones."""

import jax
import jax.extend
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from jax import lax
from jax.interpreters import mlir

from nhjax import lanes
from support import lanes_run


RNG = np.random.default_rng(7)


def _matrices(*shape, dtype="float64"):
    # Entries of different sizes, so that rows are exchanged.
    return (RNG.normal(size=(5, *shape)) ** 3).astype(dtype)


def _assert_same(function, *operands):
    got = lanes_run.run_batched(function, 4, *operands)
    expected = jax.vmap(function)(*operands)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        scale = (
            np.nanmax(np.abs(y)) * np.finfo(y.dtype).eps if y.dtype.kind == "f" else 0
        )
        np.testing.assert_allclose(x, y, rtol=0, atol=1000 * scale)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("shape", [(1, 1), (5, 5), (3, 5), (5, 3)])
def test_lu_in_lanes_equals_lapack(shape, dtype):
    _assert_same(lax.linalg.lu, _matrices(*shape, dtype=dtype))


def test_lu_of_singular_matrix_in_lanes_equals_lapack():
    a = _matrices(4, 4)
    a[:, :, 1] = 0.0
    a[1] = 0.0
    _assert_same(lax.linalg.lu, a)


@pytest.mark.parametrize("transpose_a", [False, True])
@pytest.mark.parametrize("lower", [False, True])
@pytest.mark.parametrize("unit_diagonal", [False, True])
@pytest.mark.parametrize("left_side", [False, True])
def test_triangular_solve_in_lanes_equals_lapack(
    left_side, unit_diagonal, lower, transpose_a
):
    def solve(a, b):
        return lax.linalg.triangular_solve(
            a,
            b,
            left_side=left_side,
            lower=lower,
            transpose_a=transpose_a,
            unit_diagonal=unit_diagonal,
        )

    a = _matrices(3, 3) + 4 * np.eye(3)
    _assert_same(solve, a, _matrices(*((3, 2) if left_side else (2, 3))))


@pytest.mark.parametrize("function", [jnp.linalg.inv, jnp.linalg.det])
def test_functions_of_matrices_in_lanes_equal_jax(function):
    _assert_same(function, _matrices(4, 4) + 3 * np.eye(4))


def test_solved_equations_in_lanes_equal_jax():
    _assert_same(jnp.linalg.solve, _matrices(4, 4) + 3 * np.eye(4), _matrices(4))


@pytest.mark.parametrize(
    "function", [jnp.linalg.solve, jax.vmap(lax.linalg.lu), jax.vmap(jnp.linalg.inv)]
)
def test_several_matrices_at_once_in_lanes_equal_jax(function):
    a = _matrices(3, 4, 4) + 3 * np.eye(4)
    given = (a, _matrices(3, 4, 2)) if function is jnp.linalg.solve else (a,)
    _assert_same(function, *given)


def test_transposed_solve_in_lanes_equals_jax():
    """The transpose of a solve sorts the permutation of the rows."""

    def pulled(a, b):
        return jax.vjp(lambda b: jnp.linalg.solve(a, b), b)[1](b)[0]

    _assert_same(pulled, _matrices(4, 4) + 3 * np.eye(4), _matrices(4))
    a, b = _matrices(3, 4, 4) + 3 * np.eye(4), _matrices(3, 4)
    _assert_same(jax.vmap(pulled), a, b)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("size", [1, 2, 3, 7, 12])
def test_eigenvectors_in_lanes_diagonalise_matrix(size, dtype):
    """The signs of vectors, and their choice for equal eigenvalues, are not unique."""
    a = _matrices(size, size, dtype=dtype)
    a[0] = np.eye(size)  # equal eigenvalues
    a[1] = np.outer(a[1, 0], a[1, 0])  # rank one
    a[2] *= np.float32(1e15) ** 2 if dtype == "float64" else 1e10
    symmetric = a + a.transpose(0, 2, 1)
    # Only one triangle is read.
    values, vectors = lanes_run.run_batched(
        lambda a: jnp.linalg.eigh(a, symmetrize_input=False), 4, np.tril(symmetric)
    )
    eps = np.finfo(dtype).eps
    for matrix, w, v in zip(symmetric, values, vectors, strict=True):
        scale = 100 * eps * np.max(np.abs(matrix))
        expected = np.linalg.eigvalsh(matrix.astype(float))
        np.testing.assert_allclose(w, expected, rtol=0, atol=scale)
        np.testing.assert_allclose(v @ np.diag(w) @ v.T, matrix, rtol=0, atol=scale)
        np.testing.assert_allclose(v.T @ v, np.eye(size), atol=100 * eps)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_eigenvectors_in_lanes_of_a_matrix_that_is_not_finite_are_nan(number):
    a = np.array([[2.0, number, 0.0], [number, 3.0, 1.0], [0.0, 1.0, 4.0]])
    for found in lanes_run.run_batched(jnp.linalg.eigh, 4, a[None]):
        assert np.all(np.isnan(found))


def _singular_values(a):
    return jnp.linalg.svd(a, compute_uv=False)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 4), (2, 2), (3, 7), (7, 3), (12, 12)])
def test_singular_values_in_lanes_equal_lapack(shape, dtype):
    a = _matrices(*shape, dtype=dtype)
    a[0] = np.eye(*shape)  # equal singular values
    a[1] = np.outer(a[1, :, 0], a[1, 0])  # rank one
    a[2] *= 1e150 if dtype == "float64" else 1e30
    a[3] *= 1e-150 if dtype == "float64" else 1e-30
    a[4] = 0
    found = lanes_run.run_batched(_singular_values, 4, a)
    for matrix, values in zip(a, found, strict=True):
        expected = np.linalg.svd(matrix.astype(float), compute_uv=False)
        scale = 10 * max(shape) * np.finfo(dtype).eps * expected[0]
        np.testing.assert_allclose(values, expected, rtol=0, atol=scale)


def test_small_singular_values_in_lanes_of_rows_of_different_size_are_accurate():
    """LAPACK finds the small ones only up to the round-off of the largest."""
    rows = _matrices(5, 6) * np.logspace(0, -40, 5)[:, None]
    found = lanes_run.run_batched(_singular_values, 4, rows)
    with mpmath.workdps(80):
        for matrix, values in zip(rows, found, strict=True):
            expected = mpmath.svd_r(mpmath.matrix(matrix.tolist()), compute_uv=False)
            np.testing.assert_allclose(values, [float(x) for x in expected], rtol=1e-14)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_singular_values_in_lanes_of_a_matrix_that_is_not_finite_are_nan(number):
    a = np.array([[2.0, number, 0.0], [0.5, 3.0, 1.0], [0.0, 1.0, 4.0]])
    found = lanes_run.run_batched(_singular_values, 4, a[None])
    assert np.all(np.isnan(found))


def test_singular_values_in_lanes_near_the_largest_number_are_finite():
    largest = np.finfo(float).max
    a = np.array([np.diag([largest, largest / 2]), [[largest, 0.0], [largest, 1.0]]])
    found = lanes_run.run_batched(_singular_values, 4, a)
    np.testing.assert_allclose(found[0], [largest, largest / 2], rtol=1e-15)
    # The largest one is larger than every number.
    assert found[1][0] == np.inf


def test_singular_values_of_many_rows_are_left_to_xla():
    """LAPACK needs less time, also with the time to compile the call."""
    with pytest.raises(lanes.Unsupported, match="svd"):
        lanes_run.run_batched(_singular_values, 4, _matrices(13, 20))


@pytest.mark.parametrize(
    "function",
    [
        jnp.sort,
        jnp.argsort,
        lambda x: jnp.linalg.solve(jnp.outer(x, x), x),
        lambda x: jnp.linalg.det(jnp.outer(x, x)),
        lambda x: jnp.linalg.eigh(jnp.outer(x, x)),
        lambda x: _singular_values(jnp.outer(jnp.ones(3), x)),
        lambda x: jax.scipy.linalg.solve_triangular(jnp.outer(x, x), x),
    ],
    ids=["sort", "argsort", "solve", "det", "eigh", "svd", "triangular"],
)
def test_operations_on_empty_arrays_are_left_to_xla(function):
    def both(x):
        return x * 2.0, function(x[:0])

    x = np.ones((5, 3))
    found = jax.jit(lanes.vmap(both))(x)
    expected = jax.vmap(both)(x)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)


def test_singular_vectors_are_left_to_xla():
    a = _matrices(3, 3)
    with pytest.raises(lanes.Unsupported, match="svd"):
        lanes_run.run_batched(jnp.linalg.svd, 4, a)


def test_eigenvalues_and_pseudoinverse_in_lanes_equal_jax():
    a = _matrices(3, 6, 6)
    a = a + a.transpose(0, 1, 3, 2)
    _assert_same(jnp.linalg.eigvalsh, a)
    thin = _matrices(6, 3)
    gram = thin @ thin.transpose(0, 2, 1)

    def inverse(a):
        return jnp.linalg.pinv(a, rtol=1e-10, hermitian=True)

    np.testing.assert_allclose(
        lanes_run.run_batched(inverse, 4, gram),
        np.linalg.pinv(gram, rtol=1e-10, hermitian=True),
        rtol=1e-9,
        atol=1e-9,
    )
    along = gram * np.arange(6)
    _assert_same(jax.vmap(lambda x: jnp.sum(jnp.linalg.eigvalsh(x))), a)
    # The derivative of a pseudoinverse on matrices of the same rank.
    change = np.matmul(along, gram) + np.matmul(along, gram).transpose(0, 2, 1)
    change = np.matmul(gram, np.matmul(change, gram))
    size = np.max(np.abs(change))

    def derivative(a, b):
        return jax.jvp(inverse, (a,), (b,))[1]

    got = lanes_run.run_batched(derivative, 4, gram, change / size)
    expected = jax.vmap(derivative)(gram, change / size)
    np.testing.assert_allclose(
        got, expected, rtol=0, atol=1e-9 * np.max(np.abs(expected))
    )


def test_eigenvalues_of_matrix_with_nan_in_lanes_are_nan():
    a = np.ones((5, 3, 3))
    a[1, 0, 0] = np.nan
    values = lanes_run.run_batched(jnp.linalg.eigvalsh, 4, a)
    assert np.all(np.isnan(values[1]))
    assert np.all(np.isfinite(values[[0, 2, 3, 4]]))


@pytest.mark.parametrize("num_operands", [1, 2])
def test_sorted_real_numbers_in_lanes_equal_jax(num_operands):
    keys = RNG.integers(-2, 3, size=(5, 8)).astype("float64")
    keys[:, 2], keys[:, 5], keys[0, 1], keys[1, 4] = np.nan, -np.inf, np.inf, np.nan
    values = RNG.normal(size=(5, 8))
    given = (keys, values)[:num_operands]

    def ordered(*x):
        return lax.sort(x, num_keys=1)

    got, expected = lanes_run.run_batched(ordered, 4, *given), jax.vmap(ordered)(*given)
    for x, y in zip(got, expected, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize("shape", [(1,), (7,), (3, 5)])
@pytest.mark.parametrize("num_operands", [1, 2])
def test_sorted_integers_in_lanes_equal_jax(shape, num_operands):
    keys = RNG.integers(-3, 3, size=(5, *shape)).astype("int32")
    values = RNG.normal(size=(5, *shape))
    given = (keys, values)[:num_operands]
    _assert_same(lambda *x: lax.sort(x, num_keys=1), *given)


@pytest.mark.parametrize(
    "function",
    [
        jnp.log2,
        jax.grad(lambda x: jnp.sum(jnp.tanh(x) + jnp.arctanh(x))),
        jax.grad(lambda x: jnp.sum(jnp.arcsin(x) * jnp.log2(x))),
        lambda x: jnp.polyval(x, x),
        jax.grad(lambda x: jnp.sum(jnp.polyval(x[:3], x))),
        *(
            jax.grad(lambda x, f=f: jnp.sum(f(x, [1.0, *x, *x, *x])))
            for f in filter(None, [getattr(lax, "polynomial", None)])
        ),
    ],
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_functions_with_operations_of_jax_0_12_in_lanes_equal_jax(function, dtype):
    x = RNG.uniform(0.1, 0.9, size=(5, 4)).astype(dtype)
    _assert_same(function, x)


def test_loop_with_a_condition_for_each_element_in_lanes_equals_jax():
    def halvings(x):
        def body(carry):
            y, count, row = carry
            return y / 2, count + 1, row + y

        start = (x, 0, jnp.zeros(2))
        return lax.while_loop(lambda carry: carry[0] > 1, body, start)

    x = np.array([[8.0, 0.5, 3.0], [1.0, 100.0, 2.0]])
    _assert_same(jax.vmap(halvings), x)
    _assert_same(jax.vmap(jax.vmap(halvings)), np.stack([x, 2 * x]))


# Operations of another library.


def _foreign(name, implementation):
    primitive = jax.extend.core.Primitive(name)
    primitive.def_impl(implementation)
    primitive.def_abstract_eval(lambda x: x)
    mlir.register_lowering(
        primitive, mlir.lower_fun(implementation, multiple_results=False)
    )
    return primitive


def test_foreign_operation_in_loop_is_compiled():
    doubled = _foreign("doubled", lambda x: 2 * x)

    def function(x):
        return lax.fori_loop(0, 20, lambda _, y: lax.sin(doubled.bind(y)), x)

    (use,) = lanes.engines(lanes.jit(function), 0.3)
    assert use.engine == "lanes"
    np.testing.assert_allclose(
        lanes.jit(function)(0.3), jax.jit(function)(0.3), rtol=1e-13
    )


def test_foreign_operation_that_needs_numbers_is_refused_by_name():
    on_host = _foreign("on_host", lambda x: jnp.asarray(np.sin(np.asarray(x))))
    with pytest.raises(lanes.Unsupported, match="the primitive on_host"):
        lanes_run.run_batched(on_host.bind, 4, np.ones((2, 3)))


def test_foreign_operation_that_repeats_itself_is_refused_by_name():
    again = _foreign("again", lambda x: again.bind(x))
    with pytest.raises(lanes.Unsupported, match="the primitive again"):
        lanes_run.run_batched(again.bind, 4, np.ones((2, 3)))
