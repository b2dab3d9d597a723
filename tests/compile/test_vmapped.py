"""Functions that are computed for each row of an array, in a loop if they are long."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._compile import _rows, as_cpu_kernel, vmapped
from nhjax._numerics import (
    full_jacobian,
    inverse,
    jacobian_by_rows,
    small_einsum,
)
from nhjax.lanes import compile_single, llvm_ir, Unsupported


X = jnp.linspace(-1.0, 2.0, 12).reshape(4, 3)
TIMES = jnp.array([0.1, 0.4, 0.2, 0.9])
P = jnp.array([0.7, -0.3, 1.9])


@pytest.fixture(params=["loop", "written out"])
def form(request, monkeypatch):
    shortest = 0 if request.param == "loop" else 10**9
    monkeypatch.setattr(_rows, "SHORTEST_IN_LOOP", shortest)
    return request.param


def one(p, t, x):
    """A tree of results of one row; `p` is the same for all rows."""
    scale = jnp.sin(p) * jnp.exp(-t)
    rotated = jnp.sum(scale[:, None] * (x * jnp.cos(x))[None], axis=1)
    return {"vector": rotated, "number": jnp.sum(rotated) + t, "sign": x[0] > 0}


def by_rows(p, times, x):
    return vmapped(partial(one, p), times, x)


def by_jax(p, times, x):
    return jax.vmap(partial(one, p))(times, x)


def assert_close(got, expected):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-14), got, expected)


@pytest.mark.parametrize("engine", ["lanes", "kernels", "xla"])
def test_rows_by_each_engine_equal_vmap(form, monkeypatch, engine):
    monkeypatch.setenv("NHJAX_ENGINE", engine)
    got = jax.jit(lambda *args: as_cpu_kernel(by_rows, *args))(P, TIMES, X)
    assert_close(got, by_jax(P, TIMES, X))


def test_rows_outside_of_jit_equal_vmap(form):
    assert_close(by_rows(P, TIMES, X), by_jax(P, TIMES, X))


@pytest.mark.parametrize("axis", [0, -1])
def test_rows_with_an_axis_of_the_results_equal_vmap(form, axis):
    del form

    def rows(map_rows):
        return map_rows(lambda x: jnp.stack([jnp.sin(x), P * x]), X)

    got = rows(partial(vmapped, out_axis=axis))
    assert_close(got, rows(lambda f, x: jax.vmap(f, out_axes=axis)(x)))


def number(function, p, times, x):
    out = function(p, times, x)
    return jnp.sum(jnp.cos(out["vector"])) + jnp.sum(out["number"] ** 2)


@pytest.mark.parametrize("transform", [jax.grad, jax.jacfwd, jax.hessian])
@pytest.mark.parametrize("argument", [0, 1, 2])
def test_derivatives_of_rows_equal_those_of_vmap(form, transform, argument):
    del form

    def derivative(function):
        whole = transform(partial(number, function), argnums=argument)
        return jax.jit(lambda *args: as_cpu_kernel(whole, *args))(P, TIMES, X)

    np.testing.assert_allclose(
        derivative(by_rows), derivative(by_jax), rtol=1e-13, atol=1e-14
    )


@pytest.mark.parametrize("in_axes", [(0, None, None), (None, None, 1), (0, 0, 0)])
def test_vmap_of_rows_equals_vmap_of_vmap(form, in_axes):
    del form
    given = P, TIMES, X
    many = [
        jnp.stack([x, 2 * x], axis or 0)
        for x, axis in zip((P, TIMES, X), in_axes, strict=True)
    ]
    args = [
        x if axis is None else batch
        for x, batch, axis in zip(given, many, in_axes, strict=True)
    ]

    def run(function):
        return jax.vmap(lambda *args: as_cpu_kernel(function, *args), in_axes)(*args)

    assert_close(jax.jit(partial(run, by_rows))(), jax.vmap(by_jax, in_axes)(*args))


def test_rows_within_rows_equal_vmap_of_vmap(form):
    del form

    def nested(map_rows):
        return map_rows(lambda x: map_rows(lambda y: jnp.sin(y) * x @ P, X), X)

    got = jax.jit(lambda: as_cpu_kernel(partial(nested, vmapped)))()
    assert_close(got, nested(lambda f, x: jax.vmap(f)(x)))


def test_function_with_effects_is_computed_for_each_row(form, capfd):
    del form

    def shown(x):
        jax.debug.print("row {}", x[0])
        return 2 * x

    out = vmapped(shown, X)
    jax.effects_barrier()
    assert capfd.readouterr().out.count("row") == len(X)
    np.testing.assert_array_equal(out, 2 * X)


def test_values_that_all_rows_share_are_computed_once(form, monkeypatch):
    del form
    program = jax.make_jaxpr(lambda p, x: vmapped(lambda x: jnp.sin(p) * x, x))(P, X)
    assert [e.primitive.name for e in program.eqns].count("sin") == 1


def test_code_of_long_rows_does_not_grow_with_their_number():
    def long(x):
        matrix = jnp.outer(x, jnp.cos(x)) + jnp.eye(6)
        for _ in range(6):
            matrix = jnp.sin(matrix @ matrix)
        return matrix @ x

    def length(number):
        rows = jnp.linspace(0.0, 1.0, 6 * number).reshape(number, 6)
        program = jax.make_jaxpr(partial(vmapped, long))(rows)
        return llvm_ir(program, (False,), 1).count("\n")

    assert length(12) < 1.2 * length(4)


@pytest.mark.parametrize("shape", [(11, 12, 13), (3, 20, 20), (24, 24, 24)])
def test_long_products_in_native_code_equal_numpy(shape):
    i, j, k = shape
    keys = jax.random.split(jax.random.key(3))
    a, b = jax.random.normal(keys[0], (i, j)), jax.random.normal(keys[1], (j, k))
    for subscripts, operands in (
        ("ij,jk->ik", (a, b)),
        ("ij,jk->ki", (a, b)),
        ("ji,jk->ik", (a.T, b)),
        ("ij,ij->i", (a, a)),
        ("j,jk->k", (a[0], b)),
    ):
        product = partial(small_einsum, subscripts)
        compile_single(jax.make_jaxpr(product)(*operands))
        got = jax.jit(lambda *x, f=product: as_cpu_kernel(f, *x))(*operands)
        expected = np.einsum(subscripts, *operands)
        np.testing.assert_allclose(got, expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("rows", [33, 40, 50])
@pytest.mark.parametrize("engine", ["lanes", "kernels", "xla"])
def test_inverse_of_more_than_32_rows_is_native_and_right(monkeypatch, engine, rows):
    monkeypatch.setenv("NHJAX_ENGINE", engine)
    matrix = jax.random.normal(jax.random.key(rows), (rows, rows))
    compile_single(jax.make_jaxpr(inverse)(matrix))
    got = jax.jit(lambda x: as_cpu_kernel(inverse, x))(matrix)
    np.testing.assert_allclose(got @ matrix, np.eye(rows), atol=1e-11)


@pytest.mark.parametrize("jacobian", [full_jacobian, jacobian_by_rows])
def test_jacobian_in_a_loop_equals_jacfwd(form, jacobian):
    del form

    def function(u):
        return jnp.stack([jnp.sin(u @ P), u[0] * u[1], jnp.exp(u[2])])

    got = jax.jit(lambda u: as_cpu_kernel(jacobian, function, u))(X[2])
    np.testing.assert_allclose(got, jax.jacfwd(function)(X[2]), rtol=1e-14)


@pytest.mark.parametrize("shape", [(), (1,)])
def test_product_with_too_many_terms_is_refused_by_the_compiler(shape):
    left, right = jnp.ones((*shape, 70_000)), jnp.ones(70_000)
    with pytest.raises(Unsupported, match="a large product of matrices"):
        compile_single(jax.make_jaxpr(jnp.dot)(left, right))


@pytest.mark.parametrize("dtype", [bool, jnp.int32])
def test_long_products_of_other_types_in_native_code_equal_numpy(dtype):
    a = (jnp.arange(11 * 12).reshape(11, 12) % 7 > 3).astype(dtype)
    b = (jnp.arange(12 * 13).reshape(12, 13) % 5 > 3).astype(dtype)
    compile_single(jax.make_jaxpr(jnp.matmul)(a, b))
    got = jax.jit(lambda *x: as_cpu_kernel(jnp.matmul, *x))(a, b)
    np.testing.assert_array_equal(got, np.asarray(a) @ np.asarray(b))
