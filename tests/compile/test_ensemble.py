"""Ensembles of programs, and their derivatives, equal those of single members."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import lanes
from nhjax._compile import as_cpu_kernel
from support.lane_kernels import kernel_ir, TRIPLE, WIDTH


def wanders(g, x, k):
    """Some steps of a pendulum, with an integer among operands and results."""

    def step(x, i):
        velocity = x[1] - 0.1 * g * jnp.sin(x[0])
        return jnp.stack([x[0] + 0.1 * velocity, velocity]), i + k

    return jax.lax.scan(step, x, jnp.arange(3, dtype=jnp.int32))


def in_kernel(g, x, k):
    return as_cpu_kernel(wanders, g, x, k)


G = jnp.array([9.0, 10.0, 11.0, 12.0])
X = jnp.arange(8.0).reshape(4, 2) / 10
K = jnp.arange(4, dtype=jnp.int32)
AXES = [(0, None, None), (None, 0, None), (0, 0, 0), (0, 1, None), (None, None, 0)]


def operands(axes):
    g = G if axes[0] == 0 else G[0]
    x = X[0] if axes[1] is None else jnp.moveaxis(X, 0, axes[1])
    return g, x, K if axes[2] == 0 else K[0]


def assert_same(got, expected):
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)


def cost(function, axes, k):
    def of_all(g, x):
        end, _ = jax.vmap(function, in_axes=axes)(g, x, k)
        return jnp.sum(end**3)

    return of_all


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("compiled", [False, True])
def test_ensemble_call_of_kernel_equals_its_members(axes, compiled):
    got = jax.vmap(in_kernel, in_axes=axes)
    got = jax.jit(got) if compiled else got
    assert_same(got(*operands(axes)), jax.vmap(wanders, axes)(*operands(axes)))


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize(
    "transform",
    [
        lambda f: jax.grad(f, argnums=(0, 1)),
        lambda f: lambda *x: jax.jvp(f, x, jax.tree.map(jnp.ones_like, x)),
        lambda f: lambda *x: jax.linearize(f, *x)[1](*jax.tree.map(jnp.ones_like, x)),
        lambda f: jax.hessian(f, argnums=(0, 1)),
        lambda f: jax.jacrev(jax.grad(f, argnums=1), argnums=0),
    ],
    ids=["grad", "jvp", "linearize", "hessian", "reverse over reverse"],
)
def test_ensemble_call_of_kernel_has_gradients_of_its_members(axes, transform):
    """An operand that the members share has the sum of their gradients."""
    g, x, k = operands(axes)
    got = jax.jit(transform(cost(in_kernel, axes, k)))(g, x)
    assert_same(got, jax.jit(transform(cost(wanders, axes, k)))(g, x))


def batched(shape, inner, outer, dtype):
    """Make numbers of this shape, with an axis for each given number of members."""
    shape = list(shape)
    for axis, size in ((inner, 4), (outer, 3)):
        if axis is not None:
            shape.insert(axis, size)
    numbers = np.arange(np.prod(shape, dtype=int)).reshape(shape)
    return jnp.asarray(numbers / 9 if dtype == "float64" else numbers, dtype)


@pytest.mark.parametrize("outer", [(0, None, None), (None, 0, None), (0, 1, None)])
@pytest.mark.parametrize("inner", [(None, 0, None), (0, 1, None), (0, None, 0)])
def test_ensemble_call_under_vmap_is_one_batch(outer, inner):
    types = ("float64", "float64", "int32")
    given = map(batched, ((), (2,), ()), inner, outer, types)

    def nested(f):
        return jax.jit(jax.vmap(jax.vmap(f, in_axes=inner), in_axes=outer))

    given = list(given)
    assert_same(nested(in_kernel)(*given), nested(wanders)(*given))


@pytest.mark.parametrize("members", [0, 1])
def test_ensemble_call_of_few_or_no_members_computes_each(members):
    g, x = jnp.ones(members), jnp.ones((members, 2))
    got = jax.jit(jax.vmap(in_kernel, (0, 0, None)))(g, x, K[1])
    assert_same(got, jax.vmap(wanders, (0, 0, None))(g, x, K[1]))


def test_ensemble_call_with_empty_operands_equals_jax():
    def function(x, empty):
        return 2 * x, jnp.sin(empty)

    def run(f):
        inner = jax.vmap(f, in_axes=(0, None))
        return jax.vmap(inner, in_axes=(None, 0))(G, jnp.zeros((3, 0, 2)))

    assert_same(run(lambda *x: as_cpu_kernel(function, *x)), run(function))


def test_ensemble_call_of_unsupported_function_is_batched_by_jax(monkeypatch):
    monkeypatch.setenv("NHJAX_ENGINE", "xla")
    (use,) = nhjax.engines(jax.vmap(in_kernel, (0, 0, None)), *operands((0, 0, None)))
    assert use == nhjax.EngineUse("xla", "chosen", 4)


@pytest.mark.parametrize("engine", ["lanes", "xla"])
def test_ensemble_call_with_operations_that_jax_expands_equals_jax(monkeypatch, engine):
    monkeypatch.setenv("NHJAX_ENGINE", engine)
    # Since JAX 0.12 a search in a table is such an operation.
    table = jnp.linspace(0.0, 1.0, 9)

    def read(x):
        return as_cpu_kernel(lambda x: 2 * jnp.interp(x, table, table**2), x)

    x = jnp.array([0.05, 0.3, 0.95])
    # The secants of 2 x² between k/8 and (k+1)/8 have the slopes (2k+1)/4.
    slopes = jnp.array([0.25, 1.25, 3.75])
    values = slopes * x - jnp.array([0.0, 0.1875, 1.75])
    total = jax.grad(lambda x: jnp.sum(read(x)))
    for transform in (lambda f: f, jax.jit, jax.vmap, lambda f: jax.jit(jax.vmap(f))):
        np.testing.assert_allclose(transform(read)(x), values, rtol=1e-14)
    for transform in (lambda f: f, jax.jit):
        np.testing.assert_allclose(transform(total)(x), slopes, rtol=1e-14)
    jacobian = jax.jit(jax.vmap(jax.vjp(jax.vmap(read), x)[1]))(jnp.eye(3))[0]
    np.testing.assert_allclose(jacobian, jnp.diag(slopes), rtol=1e-14)


def test_kernel_with_little_optimisation_has_different_code():
    # All but the last of these copies are superfluous.
    copies = [re.sub(r"%(value|tripled|._at)", rf"%\1_{k}", TRIPLE) for k in range(20)]
    text = kernel_ir("".join(copies))
    names, sizes = [], []
    try:
        for is_little in (False, True):
            jax.config.update("jax_disable_most_optimizations", is_little)
            before = lanes.compiled_code().bytes
            names.append(lanes.register_kernel(text, 1, 1, WIDTH, True))
            sizes.append(lanes.compiled_code().bytes - before)
    finally:
        jax.config.update("jax_disable_most_optimizations", True)
    assert sizes[1] > 1.2 * sizes[0] > 0
    out = jax.ShapeDtypeStruct(G.shape, G.dtype)
    for name in names:
        tripled = jax.jit(lambda x, name=name: jax.ffi.ffi_call(name, out)(x))(G)
        np.testing.assert_array_equal(tripled, 3 * G)
