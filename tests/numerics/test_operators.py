"""Operators act as their matrices do, and diagonal mass matrices are recognised."""

import ast
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax._numerics import (
    block_tridiagonal_inverse,
    compressed_products,
    DenseMatrix,
    DiagonalMatrix,
    max_norm,
    sparse_jacobian,
    SparseMatrix,
    SparsityPattern,
    square_jacobian,
)
from nhjax._system import linearise


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
def test_square_jacobian_of_separate_terms_is_diagonal(name):
    momentum = jax.grad(SEPARATE[name])
    found = square_jacobian(momentum, U)
    assert found.is_diagonal
    expected = jax.jacfwd(momentum)(U)
    np.testing.assert_allclose(found.as_matrix(), expected, rtol=1e-15)


@pytest.mark.parametrize("name", COUPLED)
def test_square_jacobian_of_coupled_terms_is_dense(name):
    momentum = jax.grad(COUPLED[name])
    found = square_jacobian(momentum, U)
    assert not found.is_diagonal
    expected = jax.jacfwd(momentum)(U)
    np.testing.assert_allclose(found.as_matrix(), expected, rtol=1e-15)


def test_square_jacobian_of_custom_rule_or_reference_is_dense():
    matrix = jnp.arange(16.0).reshape(4, 4)

    @jax.custom_jvp
    def squared(v):
        return v**2

    squared.defjvp(lambda primals, tangents: (squared(*primals), matrix @ tangents[0]))
    np.testing.assert_array_equal(square_jacobian(squared, U).as_matrix(), matrix)

    def by_reference(v):
        reference = jax.new_ref(jnp.zeros(4))
        reference[...] = v
        return matrix @ reference[...]

    np.testing.assert_array_equal(square_jacobian(by_reference, U).as_matrix(), matrix)
    sliced = square_jacobian(lambda u: jax.lax.slice(u[0], (), ()) * u, U)
    assert not sliced.is_diagonal


@pytest.mark.parametrize("flip", [False, True])
def test_diagonal_mass_matrix_is_recognised_in_both_forms(flip):
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
    assert lin.fibre_hessian_inverse.is_diagonal
    assert system.metric(0.0, q, system.fibre_coordinate(y0)).shape == (3, 3)
    full = system.metric(0.0, q, system.fibre_coordinate(y0))
    found = lin.fibre_hessian_inverse.inverse().as_matrix()
    np.testing.assert_allclose(found, full, rtol=1e-15)


def test_square_jacobian_of_fewer_or_constant_values_has_right_shape():
    assert square_jacobian(lambda u: u[:2], U).as_matrix().shape == (2, 4)
    assert not square_jacobian(lambda u: jnp.full((4,), u[0]), U).is_diagonal
    constant = square_jacobian(lambda u: M, U)
    assert constant.is_diagonal
    np.testing.assert_array_equal(constant.as_matrix(), jnp.zeros((4, 4)))


def test_diagonal_operator_acts_as_dense_matrix():
    x = np.arange(24.0).reshape(2, 3, 4)
    diagonal, dense = DiagonalMatrix(-M), DenseMatrix(jnp.diag(-M))
    for vectors in (x[0, 0], x[0], x):
        for operator in (diagonal, dense):
            found = operator.matvec(jnp.asarray(vectors))
            np.testing.assert_allclose(found, vectors * -np.asarray(M))
    for name in ("absolute", "inverse"):
        found, expected = (getattr(x, name)().as_matrix() for x in (diagonal, dense))
        np.testing.assert_allclose(found, expected, rtol=1e-15)
    for name in ("absolute_row_sums", "largest_entry_bound"):
        found, expected = (getattr(x, name)() for x in (diagonal, dense))
        np.testing.assert_array_equal(found, expected)


def test_derivative_of_diagonal_inverse_equals_dense():
    _, rate = jax.jvp(lambda m: DiagonalMatrix(m).inverse().as_matrix(), (M,), (U,))
    full, change = jnp.diag(M), jnp.diag(U)
    _, full_rate = jax.jvp(
        lambda m: DenseMatrix(m).inverse().entries, (full,), (change,)
    )
    np.testing.assert_allclose(rate, full_rate, atol=1e-16)


def test_dense_stack_multiplies_each_vector_by_its_matrix():
    numbers = np.random.default_rng(0)
    stack, x, y = (numbers.normal(size=n) for n in ((3, 2, 4), (3, 4), (2,)))
    operator = DenseMatrix(jnp.asarray(stack))
    found = operator.matvec(jnp.asarray(x))
    np.testing.assert_allclose(found, [a @ b for a, b in zip(stack, x, strict=True)])
    last = operator[-1]
    np.testing.assert_allclose(last.rmatvec(jnp.asarray(y)), stack[-1].T @ y)
    np.testing.assert_allclose(last.first_columns(2).as_matrix(), stack[-1][:, :2])
    weights = np.arange(1.0, 5.0)
    found = operator.weighted_transpose(DiagonalMatrix(jnp.asarray(weights)))
    expected = weights[:, None] * np.swapaxes(stack, 1, 2)
    np.testing.assert_allclose(found.as_matrix(), expected)


def test_max_norm_equivalent_of_one_column_gives_same_largest_product():
    column = DenseMatrix(jnp.array([[0.5], [-3.0], [1.0]]))
    numbers = jnp.array([[0.25], [-2.0]])
    short = column.max_norm_equivalent()
    assert short.as_matrix().shape == (1, 1)
    assert max_norm(short.matvec(numbers)) == max_norm(column.matvec(numbers)) == 6
    wide = DenseMatrix(jnp.eye(3))
    assert wide.max_norm_equivalent() is wide


# Places of entries: neighbours in a row; scattered ones; a row without entries.
ROWS = 7
NEIGHBOURS = np.eye(ROWS, ROWS + 1) + np.eye(ROWS, ROWS + 1, 1) > 0
PLACES = {
    "neighbours": NEIGHBOURS,
    "permuted": NEIGHBOURS[np.random.default_rng(1).permutation(ROWS)],
    "wide": np.kron(NEIGHBOURS, [[True, False, True]]),
    "empty row": NEIGHBOURS & (np.arange(ROWS) != 3)[:, None],
}


def sparse_and_dense(name, count=None):
    """Compute a stack of random matrices as an operator and as an array."""
    places = PLACES[name]
    shape = places.shape if count is None else (count, *places.shape)
    full = np.where(places, np.random.default_rng(2).normal(size=shape), 0.0)
    pattern = SparsityPattern(places)
    taken = np.take_along_axis(
        full,
        np.broadcast_to(pattern.columns.T, (*shape[:-1], len(pattern.columns))),
        -1,
    )
    values = np.where(pattern.present, np.swapaxes(taken, -1, -2), 0.0)
    return SparseMatrix(jnp.asarray(values), pattern), full


@pytest.mark.parametrize("name", PLACES)
def test_sparse_operator_acts_as_dense_matrix(name):
    sparse, full = sparse_and_dense(name)
    numbers = np.random.default_rng(3)
    x, y = (numbers.normal(size=(2, n)) for n in full.shape[::-1])
    w = numbers.uniform(1, 2, full.shape[1])
    np.testing.assert_array_equal(sparse.as_matrix(), full)
    np.testing.assert_allclose(sparse.matvec(jnp.asarray(x)), x @ full.T, atol=1e-15)
    np.testing.assert_allclose(sparse.rmatvec(jnp.asarray(y)), y @ full, atol=1e-15)
    sums = np.abs(full).sum(axis=1)
    np.testing.assert_allclose(sparse.absolute_row_sums(), sums, rtol=1e-15)
    transposed = sparse.weighted_transpose(DiagonalMatrix(jnp.asarray(-w)))
    expected = -w[:, None] * full.T
    np.testing.assert_allclose(transposed.as_matrix(), expected, rtol=1e-15)
    found = transposed.absolute().matvec(jnp.asarray(y))
    np.testing.assert_allclose(found, y @ np.abs(expected).T, atol=1e-15)
    assert np.abs(expected).max() <= transposed.largest_entry_bound()


@pytest.mark.parametrize("name", PLACES)
def test_sparse_jacobian_equals_dense_jacobian(name):
    sparse, full = sparse_and_dense(name)
    u = jnp.linspace(0.3, 1.4, full.shape[1])

    def function(u):
        return jnp.asarray(full) @ jnp.sin(u)

    found = sparse_jacobian(function, u, sparse.pattern)
    expected = jax.jacfwd(function)(u)
    np.testing.assert_allclose(found.as_matrix(), expected, atol=1e-16)


@pytest.mark.parametrize("name", ["neighbours", "permuted", "wide"])
def test_inverse_of_sparse_product_equals_dense_inverse(name):
    sparse, full = sparse_and_dense(name)
    w = np.random.default_rng(4).uniform(1, 2, full.shape[1])
    weights = DiagonalMatrix(jnp.asarray(w))
    right = sparse.weighted_transpose(weights)
    found = sparse.inverse_of_product(right)
    matrix = full @ (w[:, None] * full.T)
    round_off = 10 * np.finfo(float).eps * np.linalg.cond(matrix)
    one = found.as_matrix() @ matrix
    np.testing.assert_allclose(one, np.eye(ROWS), rtol=0, atol=round_off)
    dense = DenseMatrix(jnp.asarray(full))
    dense_right = dense.weighted_transpose(weights)
    expected = dense.inverse_of_product(dense_right)
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), rtol=1e-8)
    assert not found.is_nearly_singular(sparse, right)
    assert not expected.is_nearly_singular(dense, dense_right)


def test_dependent_rows_are_nearly_singular_in_sparse_and_dense_form():
    sparse, full = sparse_and_dense("neighbours")
    # Rows 1 to 3 have entries in columns 2 and 3 alone.
    full[1:4] = 0.0
    full[1, 2], full[2, 2], full[2, 3], full[3, 3] = 0.3, 0.7, 1.1, 0.9
    pattern = sparse.pattern
    values = full[np.arange(ROWS), pattern.columns]
    sparse = SparseMatrix(jnp.asarray(np.where(pattern.present, values, 0)), pattern)
    np.testing.assert_array_equal(sparse.as_matrix(), full)
    weights = DiagonalMatrix(jnp.ones(full.shape[1]))
    for matrix in (sparse, DenseMatrix(jnp.asarray(full))):
        right = matrix.weighted_transpose(weights)
        assert matrix.inverse_of_product(right).is_nearly_singular(matrix, right)


def test_block_tridiagonal_inverse_of_several_unknowns_per_row_equals_dense():
    sparse, full = sparse_and_dense("permuted", count=2)
    numbers = np.random.default_rng(5)
    w = numbers.uniform(1, 2, full.shape[-1])
    right = sparse.weighted_transpose(DiagonalMatrix(jnp.asarray(w)))
    products = compressed_products(sparse, right)
    mixed = np.eye(2) * 5 + numbers.normal(size=(2, 2))
    combined = jnp.einsum("ij,ij...->ij...", jnp.asarray(mixed), products)
    found = block_tridiagonal_inverse(combined, sparse.pattern)
    matrix = np.einsum("ij,ian,n,jbn->iajb", mixed, full, w, full)
    matrix = matrix.reshape(2 * ROWS, 2 * ROWS)
    expected = np.linalg.inv(matrix)
    np.testing.assert_allclose(found.as_matrix(), expected, rtol=1e-8, atol=1e-10)
    r = numbers.normal(size=2 * ROWS)
    found_x = found.matvec(jnp.asarray(r))
    np.testing.assert_allclose(found_x, expected @ r, rtol=1e-8, atol=1e-10)


def test_absolute_of_inverse_of_springs_in_a_row_is_exact():
    entries = np.eye(ROWS, ROWS + 1) - np.eye(ROWS, ROWS + 1, 1)
    pattern = SparsityPattern(NEIGHBOURS)
    values = entries[np.arange(ROWS), pattern.columns]
    sparse = SparseMatrix(jnp.asarray(values), pattern)
    weights = DiagonalMatrix(jnp.ones(ROWS + 1))
    inverse = sparse.inverse_of_product(sparse.weighted_transpose(weights))
    x = np.random.default_rng(6).uniform(size=ROWS)
    expected = np.abs(np.linalg.inv(entries @ entries.T)) @ x
    estimate = inverse.absolute()
    np.testing.assert_allclose(estimate.matvec(jnp.asarray(x)), expected, rtol=1e-12)
    np.testing.assert_allclose(estimate.as_matrix() @ x, expected, rtol=1e-12)
    assert estimate.absolute() is estimate


@pytest.mark.parametrize("size", [1, 2, 5, 30])
def test_definite_matrices_are_distinguished_from_indefinite_ones(size):
    numbers = np.random.default_rng(size)
    for _ in range(20):
        q, _ = np.linalg.qr(numbers.normal(size=(size, size)))
        values = 10 ** numbers.uniform(-6, 0, size)
        assert DenseMatrix(jnp.asarray(q * values @ q.T)).is_definite()
        assert DenseMatrix(jnp.asarray(-(q * values) @ q.T)).is_definite()
        if size > 1:
            values[numbers.integers(size)] *= -1
            assert not DenseMatrix(jnp.asarray(q * values @ q.T)).is_definite()


@pytest.mark.parametrize(
    ("diagonal", "expected"),
    [
        pytest.param([1.0, 2.0], True, id="positive"),
        pytest.param([-1.0, -2.0], True, id="negative"),
        pytest.param([1.0, -2.0], False, id="mixed"),
        pytest.param([1.0, 0.0], False, id="singular"),
    ],
)
def test_diagonal_matrix_with_entries_of_one_sign_is_definite(diagonal, expected):
    assert bool(DiagonalMatrix(jnp.array(diagonal)).is_definite()) is expected


@pytest.mark.parametrize(
    "entries",
    [
        pytest.param([[0.0, 1.0], [1.0, 0.0]], id="no first pivot"),
        pytest.param([[1.0, 1.0], [1.0, 1.0]], id="singular"),
        pytest.param([[1.0, np.nan], [np.nan, 1.0]], id="not finite"),
    ],
)
def test_matrix_without_definite_pivots_is_not_definite(entries):
    assert not DenseMatrix(jnp.array(entries)).is_definite()


@pytest.mark.parametrize("closure", ["propagated", "symmetric"])
def test_diagonal_mass_written_as_matrix_gives_same_motion(closure):
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
def test_max_norm_equals_largest_float(dtype):
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


# The classes of matrices, and the names by which an array is recognised.
CLASSES = {
    "AbstractOperator",
    "BlockTridiagonalInverse",
    "DenseMatrix",
    "DiagonalMatrix",
    "SparseMatrix",
    "WeightedTranspose",
}
ARRAYS = {"Array", "ndarray"}
PACKAGE = Path(nhjax.__file__).parent


def class_queries(text, names):
    """List the lines of `isinstance` calls that name one of the classes."""
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "isinstance":
            asked = {getattr(x, "id", None) for x in ast.walk(node.args[1])}
            asked |= {getattr(x, "attr", None) for x in ast.walk(node.args[1])}
            found += [node.lineno] if asked & names else []
    return found


@pytest.mark.parametrize("room", ["_step", "_system", "_initial", "_analysis"])
def test_operator_class_is_not_queried_by_other_rooms(room):
    found = [
        f"{path.name}:{line}"
        for path in (PACKAGE / room).rglob("*.py")
        for line in class_queries(path.read_text("utf-8"), CLASSES | ARRAYS)
    ]
    assert found == []


def test_operator_class_is_queried_only_in_its_own_file():
    asking = {
        path.name
        for path in PACKAGE.rglob("*.py")
        if class_queries(path.read_text("utf-8"), CLASSES)
    }
    assert asking == {"_operators.py"}


@pytest.mark.parametrize(
    "text",
    [
        "isinstance(x, SparseMatrix)",
        "assert not isinstance(lin.jacobian, numerics.SparseMatrix)",
        "isinstance(x, jax.Array | WeightedTranspose)",
        "isinstance(x, (int, jax.Array))",
    ],
)
def test_operator_class_query_in_source_is_detected(text):
    assert class_queries(text, CLASSES | ARRAYS) == [1]
