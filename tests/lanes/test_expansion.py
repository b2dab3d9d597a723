"""Operations that are replaced by simpler ones: factorisations, and foreign ones."""

import jax
import jax.extend
import jax.numpy as jnp
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
