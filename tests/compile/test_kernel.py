"""Programs in one kernel, and their derivatives, give the same results as elsewhere."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import nhjax
from nhjax import LobattoIIIAB, systems
from nhjax._compile import as_cpu_kernel, TraceCache


MARK = 'xla_cpu_small_call = "true"'


def pendulum(parameters, x, empty, unused, count):
    """Some steps of a pendulum, with all kinds of operands."""
    del empty, unused

    def step(x, k):
        velocity = x[1] - 0.1 * parameters["g"] * jnp.sin(x[0])
        x = jnp.stack([x[0] + 0.1 * velocity, velocity])
        return x, (x[0], k + count)

    return jax.lax.scan(step, x, jnp.arange(5, dtype=jnp.int32))


OPERANDS = (
    {"g": jnp.asarray(9.81)},
    jnp.array([0.3, -0.2]),
    jnp.zeros((0, 3)),
    jnp.ones(2),
    jnp.asarray(7, jnp.int32),
)


def in_kernel(*operands):
    return as_cpu_kernel(pendulum, *operands)


def height(function):
    def loss(g, x):
        parameters, _, *rest = OPERANDS
        (end, (path, _)) = function(
            eqx.tree_at(lambda p: p["g"], parameters, g), x, *rest
        )
        return jnp.sum(path**2) + end[1] ** 3

    return loss


def assert_same(got, expected):
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize("compiled", [False, True])
def test_kernel_of_a_function_equals_it(compiled):
    function = jax.jit(in_kernel) if compiled else in_kernel
    assert_same(function(*OPERANDS), pendulum(*OPERANDS))


def test_engine_chosen_by_environment_variable_is_used(engine):
    (use,) = nhjax.engines(in_kernel, *OPERANDS)
    assert (use.engine, use.members) == (engine, None)
    text = jax.jit(lambda *x: in_kernel(*x)).lower(*OPERANDS).as_text()
    assert (MARK in text) == (engine == "kernels")
    assert ("nhjax_lanes_" in text) == (engine == "lanes")


def test_unknown_engine_raises_with_known_ones(monkeypatch):
    monkeypatch.setenv("NHJAX_ENGINE", "lane")
    with pytest.raises(ValueError, match="is 'lane', which is none of 'lanes'"):
        nhjax.engines(in_kernel, *OPERANDS)


def test_engine_chosen_for_large_arrays_is_used(monkeypatch):
    def run(x):
        return as_cpu_kernel(lambda x: x * x + x, x)

    x = jnp.ones(200)
    (use,) = nhjax.engines(run, x)
    assert use.engine == "kernels"
    assert "so large" in use.reason
    monkeypatch.setenv("NHJAX_ENGINE", "lanes")
    (use,) = nhjax.engines(run, x)
    assert use.engine == "lanes"


@pytest.mark.usefixtures("engine")
@pytest.mark.parametrize(
    "transform",
    [
        lambda f: jax.grad(f, argnums=(0, 1)),
        lambda f: jax.jacfwd(f, argnums=(0, 1)),
        lambda f: lambda *x: jax.jvp(f, x, (jnp.ones(()), jnp.ones(2))),
        lambda f: lambda *x: jax.linearize(f, *x)[1](jnp.ones(()), jnp.ones(2)),
        lambda f: jax.hessian(f, argnums=(0, 1)),
        lambda f: jax.jacrev(jax.jacfwd(f, argnums=1), argnums=0),
        lambda f: jax.jacrev(jax.grad(f, argnums=1), argnums=0),
        lambda f: jax.grad(jax.checkpoint(f), argnums=1),
    ],
    ids=[
        "grad",
        "jacfwd",
        "jvp",
        "linearize",
        "forward over reverse",
        "reverse over forward",
        "reverse over reverse",
        "checkpoint",
    ],
)
def test_kernel_has_derivatives_of_its_function(transform):
    point = OPERANDS[0]["g"], OPERANDS[1]
    got = jax.jit(transform(height(in_kernel)))(*point)
    assert_same(got, transform(height(pendulum))(*point))


def test_kernel_derivatives_store_no_constants():
    matrix = jnp.arange(16.0).reshape(4, 4)

    def f(x):
        return jnp.sin(jnp.sum(2 * matrix.T * x[None], axis=1))

    def pulled(x):
        return jax.vjp(lambda x: as_cpu_kernel(f, x), x)[1](x)

    program = jax.make_jaxpr(pulled)(jnp.ones(4))
    kernels = [x for x in program.eqns if x.primitive.name == "cpu_kernel"]
    assert len(kernels) == 2
    assert all(x.aval.shape != matrix.shape for x in kernels[0].outvars)
    assert_same(jax.jit(pulled)(jnp.ones(4)), (jax.vjp(f, jnp.ones(4))[1](jnp.ones(4))))


def test_kernel_with_while_loop_has_forward_mode():
    def grown(x):
        return jax.lax.while_loop(lambda x: x < 10, lambda x: x * x, x)

    got = jax.jit(lambda x: jax.jvp(lambda x: as_cpu_kernel(grown, x), (x,), (x,)))(2.0)
    assert_same(got, jax.jvp(grown, (2.0,), (2.0,)))


@pytest.mark.parametrize("axes", [(0, None), (None, 1), (0, 1)])
def test_kernel_under_vmap_computes_each_member(axes):
    g, x = jnp.array([9.0, 10.0, 11.0]), jnp.arange(6.0).reshape(2, 3) / 10
    point = g if axes[0] == 0 else g[0], x if axes[1] == 1 else x[:, 0]

    def both(f):
        values = jax.vmap(height(f), in_axes=axes)
        gradients = jax.vmap(jax.grad(height(f), argnums=(0, 1)), in_axes=axes)
        return lambda *point: (values(*point), gradients(*point))

    assert_same(jax.jit(both(in_kernel))(*point), both(pendulum)(*point))


def test_kernel_under_two_vmaps_computes_each_member():
    def nested(f):
        inner = jax.vmap(height(f), in_axes=(None, 0))
        return jax.vmap(inner, in_axes=(0, None))

    g, x = jnp.array([9.0, 10.0]), jnp.arange(6.0).reshape(3, 2) / 10
    assert_same(jax.jit(nested(in_kernel))(g, x), nested(pendulum)(g, x))


def sorts(x):
    return jnp.sort(x)


def scatters(x):
    return x.at[jnp.array([0, 2])].add(1.0)


def multiplies(x):
    return jnp.outer(x, x) @ jnp.outer(x, x)


def sums_much(x):
    return jnp.sum(jnp.tile(x, 1000)) + x


def factorises(x):
    return jnp.linalg.cholesky(jnp.diag(x + 2))


def is_large(x):
    return jnp.sin(jnp.tile(x, 1000))[:7] + x


@pytest.mark.parametrize(
    "function", [sorts, scatters, multiplies, sums_much, factorises, is_large]
)
def test_kernel_of_unsupported_function_is_computed_by_xla(function):
    x = jnp.linspace(0.0, 1.0, 7)
    program = jax.jit(lambda x: as_cpu_kernel(function, x))
    assert MARK not in program.lower(x).as_text()
    assert_same(program(x), function(x))
    xs = jnp.stack([x, x + 1, x + 2])
    assert_same(jax.jit(jax.vmap(program))(xs), jnp.stack([function(x) for x in xs]))


def test_random_keys_as_operands_are_computed_by_xla():
    key = jax.random.key(0)
    got = jax.jit(lambda key: as_cpu_kernel(lambda key: key, key))(key)
    assert_same(jax.random.key_data(got), jax.random.key_data(key))


def test_kernel_with_debug_print_prints(capfd):
    def loud(x):
        jax.debug.print("x = {}", x)
        return 2 * x

    assert as_cpu_kernel(loud, jnp.asarray(1.5)) == 3
    jax.effects_barrier()
    assert "x = 1.5" in capfd.readouterr().out


def test_run_without_factorisation_is_one_kernel():
    def taken(system):
        y0 = nhjax.initial_state(system, q=jnp.ones(2), v=jnp.zeros(2))

        def run(y0):
            method = LobattoIIIAB(2)
            return nhjax.integrate(
                system, method, y0, dt=0.1, num_steps=3, throw=False
            ).ys

        return nhjax.engines(run, y0)

    def plain(t, q, v, args):
        return 0.5 * v @ jnp.array([[2.0, 0.5], [0.5, 1.0]]) @ v - 0.5 * q @ q

    def factorised(t, q, v, args):
        root = jnp.linalg.cholesky(jnp.array([[2.0, 0.5], [0.5, 1.0]]) + 0 * q[0])
        return 0.5 * jnp.sum((root.T @ v) ** 2) - 0.5 * q @ q

    # The first kernel measures round-off.
    _, use = taken(nhjax.LagrangianSystem(plain))
    assert use.engine == "lanes"
    # The operations within are compiled apart.
    use, *_ = taken(nhjax.LagrangianSystem(factorised))
    assert use.engine == "xla"
    assert "calls a library" in use.reason


@pytest.mark.parametrize(
    ("example", "stages", "engine"),
    [
        (systems.TurntableBall(), 8, "lanes"),
        (systems.HeavyTopSE3(), 8, "lanes"),
        (systems.ChaoticSystem(50), 3, "kernels"),
        (systems.ChaoticSystem(20), 8, "kernels"),
    ],
    ids=["ball", "top", "101 coordinates", "41 coordinates"],
)
def test_run_with_large_arrays_is_one_program_of_an_engine(example, stages, engine):
    def run(y0):
        method = LobattoIIIAB(stages)
        return nhjax.integrate(
            example.system, method, y0, dt=0.05, num_steps=3, throw=False
        ).ys

    y0 = example.initial_state()
    use = nhjax.engines(run, y0)[-1]
    assert use.engine == engine
    if engine == "kernels":
        assert "arrays are so large" in use.reason
        assert MARK in jax.jit(run).lower(y0).as_text()


def test_trace_cache_traces_once_for_each_kind_of_arguments():
    traced = []

    def scaled(x, factor):
        traced.append(x.shape)
        return factor * jnp.sin(x)

    programs = TraceCache()

    def value(x, factor=2.0):
        return jnp.sum(as_cpu_kernel(scaled, x, factor, programs=programs))

    x = jnp.arange(3.0)
    np.testing.assert_allclose(value(x), 2 * np.sum(np.sin(x)), rtol=1e-15)
    found = jax.grad(lambda x: value(x) + value(x + 1))(x)
    np.testing.assert_allclose(found, 2 * (np.cos(x) + np.cos(x + 1)), rtol=1e-15)
    assert traced == [(3,)]
    value(x[:2])
    value(x, 3.0)
    assert traced == [(3,), (2,), (3,)]


def test_trace_cache_does_not_keep_tracers_of_other_traces():
    programs = TraceCache()

    def value(x):
        return as_cpu_kernel(lambda y, x=x: x * y, jnp.ones(()), programs=programs)

    assert float(jax.jit(value)(2.0)) == 2.0
    assert float(jax.jit(value)(3.0)) == 3.0
    assert float(jax.grad(value)(2.0)) == 1.0


def test_lanes_chosen_for_a_program_they_cannot_compile_raise_with_reason(monkeypatch):
    def run(x):
        return as_cpu_kernel(lambda x: jnp.linalg.svd(x)[1], x)

    x = jnp.eye(3)
    for engine in (None, "kernels", "xla"):
        if engine is not None:
            monkeypatch.setenv("NHJAX_ENGINE", engine)
        (use,) = nhjax.engines(run, x)
        assert use.engine == "xla"
    monkeypatch.setenv("NHJAX_ENGINE", "lanes")
    with pytest.raises(RuntimeError, match=r"NHJAX_ENGINE is 'lanes'.*svd"):
        jax.jit(run)(x)
