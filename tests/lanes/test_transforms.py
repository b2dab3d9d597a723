"""`lanes.vmap` and `lanes.jit` of functions that nhjax did not write."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import nhjax
from nhjax import lanes
from nhjax.lanes import _engines


X = jnp.linspace(0.1, 2.0, 5)
ROWS = jnp.arange(10.0).reshape(5, 2) / 10


def root(x: Any, steps: Any = 20):
    """A loop of the user, with another number of iterations for each member."""

    def body(carry):
        y, k = carry
        return 0.5 * (y + x / y), k + 1

    def test(carry):
        y, k = carry
        return (jnp.abs(y * y - x) > 1e-12) & (k < steps)

    return lax.while_loop(test, body, (x, 0))


def assert_same(got, expected, weak_types=False):
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        # The tangents of integers have no values.
        if x.dtype != jax.dtypes.float0:
            np.testing.assert_allclose(x, y, rtol=1e-13, atol=1e-14)
            assert not weak_types or x.weak_type == y.weak_type


def use_of(function, *args):
    (use,) = nhjax.engines(function, *args)
    return use


def assert_equals_vmap(
    function: Any, *args: Any, in_axes: Any = 0, out_axes: Any = 0, **kwargs: Any
):
    ours = lanes.vmap(function, in_axes, out_axes)
    expected = jax.vmap(function, in_axes, out_axes)(*args, **kwargs)
    assert_same(ours(*args, **kwargs), expected, weak_types=True)
    assert_same(jax.jit(ours)(*args, **kwargs), expected, weak_types=True)
    assert use_of(partial(ours, **kwargs), *args).engine == "lanes"


# Equality with JAX


def test_lanes_vmap_of_loop_equals_jax_vmap():
    assert_equals_vmap(root, X)


def test_lanes_vmap_of_trees_equals_jax_vmap():
    def function(state, shared, factor):
        return {
            "sum": state["rows"] + shared[0] * factor,
            "pair": (state["x"], jnp.sum(state["rows"])),
            "none": None,
        }

    state = {"rows": ROWS.T, "x": X}
    assert_equals_vmap(
        function,
        state,
        [jnp.ones(2)],
        2.0,
        in_axes=({"rows": 1, "x": 0}, None, None),
        out_axes={"sum": 1, "pair": 0, "none": 0},
    )


def test_lanes_vmap_of_keyword_arguments_equals_jax_vmap():
    assert_equals_vmap(lambda x, *, y: x - y, X, y=ROWS[:, 0])


@pytest.mark.parametrize(
    "function",
    [
        lambda n: (n + 1, n // 2, n > 2, 1.5, 3),
        lambda n: jnp.where(n % 2 == 0, n, -n).astype(jnp.int8),
        lambda n: lax.fori_loop(0, n, lambda k, total: total + k, 0),
    ],
)
def test_lanes_vmap_of_integers_equals_jax_vmap(function):
    assert_equals_vmap(function, jnp.arange(5))


def test_lanes_vmap_of_booleans_equals_jax_vmap():
    assert_equals_vmap(lambda p, x: (~p, jnp.where(p, x, -x)), X > 1, X)


@pytest.mark.parametrize("shape", [(0, 3), (2, 0), (0, 0)])
def test_nested_lanes_vmap_without_members_equals_jax_vmap(shape):
    def table(transform):
        return transform(transform(lambda x: 2 * x))

    x = jnp.ones(shape)
    assert_same(table(lanes.vmap)(x), table(jax.vmap)(x))
    assert_same(lanes.jit(table(lanes.vmap))(x), table(jax.vmap)(x))


def test_lanes_vmap_with_shared_result_and_no_members_equals_jax_vmap():
    def mapped(transform):
        return transform(lambda x, y: (x, 2 * y), (0, None), (0, None))

    given = jnp.ones((0, 5)), X
    assert_same(mapped(lanes.vmap)(*given), mapped(jax.vmap)(*given))


def test_nested_lanes_vmap_equals_jax_vmap():
    def table(transform):
        inner = transform(lambda x, y: root(x + y)[0], (None, 0))
        return transform(inner, (0, None))

    args = X, jnp.linspace(1.0, 2.0, 3)
    assert_same(table(lanes.vmap)(*args), table(jax.vmap)(*args))
    assert use_of(table(lanes.vmap), *args).engine == "lanes"
    assert_same(
        jax.vmap(lanes.vmap(root))(ROWS + 1), jax.vmap(jax.vmap(root))(ROWS + 1)
    )


def test_lanes_vmap_with_axis_size_alone_equals_jax_vmap():
    assert_same(
        lanes.vmap(lambda x: 2 * x, None, axis_size=3)(X),
        jax.vmap(lambda x: 2 * x, None, axis_size=3)(X),
    )


def test_lanes_vmap_with_result_that_members_share_equals_jax_vmap():
    def function(x, y):
        return x + y, {"shared": 2 * y}

    assert_equals_vmap(
        function, X, 3 * X, in_axes=(0, None), out_axes=(0, {"shared": None})
    )


def test_lanes_vmap_passes_numbers_that_members_share_as_numbers():
    def function(x, count):
        return sum(k * x for k in range(count)), jnp.arange(count)

    axes = (0, None)
    got = lanes.vmap(function, axes, axes)(X, 3)
    assert_same(got, jax.vmap(function, axes, axes)(X, 3))


def test_lanes_vmap_of_collective_operation_equals_jax_vmap():
    def function(x):
        return root(x)[0] / lax.psum(x, "members")

    got = lanes.vmap(function, axis_name="members")(X)
    assert_same(got, jax.vmap(function, axis_name="members")(X))


def test_lanes_vmap_of_closed_over_arrays_equals_jax_vmap():
    table = jnp.arange(1000.0)

    def function(scale, transform):
        return transform(lambda k, x: table[k] * x * scale)(jnp.arange(5), X)

    for run in (function, jax.jit(function, static_argnums=1)):
        assert_same(run(2.0, lanes.vmap), run(2.0, jax.vmap))
    scaled = partial(function, transform=lanes.vmap)
    assert use_of(scaled, 2.0).engine == "lanes"
    got = jax.jit(jax.grad(lambda scale: jnp.sum(scaled(scale))))(2.0)
    assert_same(got, jax.grad(lambda s: jnp.sum(function(s, jax.vmap)))(2.0))


def test_lanes_vmap_of_object_with_functions_equals_jax_vmap():
    network = eqx.nn.MLP(2, 3, 4, 1, key=jax.random.key(0))
    ours = lanes.vmap(lambda net, x: net(x), (None, 0))
    assert_same(ours(network, ROWS), jax.vmap(network)(ROWS))
    assert use_of(partial(ours, network), ROWS).engine == "lanes"
    assert_same(lanes.jit(lambda net, x: net(x))(network, ROWS[0]), network(ROWS[0]))


def test_lanes_vmap_of_integrate_equals_jax_vmap():
    oscillator = nhjax.systems.HarmonicOscillator()

    def run(dt):
        y0 = oscillator.initial_state()
        method = nhjax.LobattoIIIAB(2)
        return nhjax.integrate(
            oscillator.system, method, y0, dt=dt, num_steps=3, throw=False
        ).ys.q

    assert_same(lanes.vmap(run)(X), jax.vmap(run)(X))


def test_lanes_jit_equals_jax_jit():
    def function(x, *, scale):
        return {"root": root(x["a"] * scale), "count": 3}

    args = {"a": jnp.asarray(2.0)}
    assert_same(
        lanes.jit(function)(args, scale=2.0), jax.jit(function)(args, scale=2.0)
    )
    assert use_of(partial(lanes.jit(function), scale=2.0), args).engine == "lanes"


def test_lanes_jit_traces_again_only_for_other_kinds_of_arguments():
    traces = []

    @lanes.jit
    def function(x, how):
        traces.append(how)
        return x + 1 if how == "up" else x - 1

    calls = [(1.0, "up"), (2.0, "up"), (2.0, "down"), (3.0, "up"), (3, "up")]
    got = [float(function(*call)) for call in calls]
    assert got == [2.0, 3.0, 1.0, 4.0, 4.0]
    assert traces == ["up", "down", "up"]


def test_lanes_functions_with_jit_disabled_run_operation_by_operation():
    seen = []

    def function(x):
        seen.append(x)
        return 2 * x

    with jax.disable_jit():
        lanes.jit(function)(1.5)
        assert_same(lanes.vmap(function)(X), 2 * X)
    assert seen[0] == 1.5


# Derivatives


def power(x, y):
    """A loop of known length, which has all derivatives."""
    return lax.fori_loop(0, 12, lambda _, z: jnp.sin(z * y["b"]) + x, x * y["a"])


Y = {"a": jnp.asarray(1.5), "b": jnp.asarray(0.7)}


@pytest.mark.parametrize("transform", [jax.jit, lambda f: f])
def test_lanes_vmap_gradient_equals_that_of_jax_vmap(transform):
    def loss(vmap, x, y):
        return jnp.sum(vmap(power, (0, None))(x, y) ** 2)

    got = transform(jax.grad(partial(loss, lanes.vmap), (0, 1)))(X, Y)
    assert_same(got, jax.grad(partial(loss, jax.vmap), (0, 1))(X, Y))
    uses = nhjax.engines(jax.grad(partial(loss, lanes.vmap), (0, 1)), X, Y)
    assert {use.engine for use in uses} == {"lanes"}


def test_lanes_vmap_of_gradient_equals_that_of_jax_vmap():
    slope = jax.grad(power)
    assert_equals_vmap(slope, X, Y, in_axes=(0, None))


def test_lanes_vmap_hessian_equals_that_of_jax_vmap():
    def loss(vmap, x):
        return jnp.sum(vmap(power, (0, None))(x, Y) ** 2)

    got = jax.hessian(partial(loss, lanes.vmap))(X)
    np.testing.assert_allclose(
        got, jax.hessian(partial(loss, jax.vmap))(X), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("function", [root, lambda x: power(x, Y)])
def test_lanes_vmap_jvp_equals_that_of_jax_vmap(function):
    got = jax.jvp(lanes.vmap(function), (X,), (X**2,))
    assert_same(got, jax.jvp(jax.vmap(function), (X,), (X**2,)))
    uses = nhjax.engines(lambda x: jax.jvp(lanes.vmap(function), (x,), (x,)), X)
    assert {use.engine for use in uses} == {"lanes"}


def test_lanes_jit_derivatives_equal_those_of_jax_jit():
    ours, theirs = lanes.jit(power), jax.jit(power)
    assert_same(jax.grad(ours, 1)(0.3, Y), jax.grad(theirs, 1)(0.3, Y))
    assert_same(jax.jvp(ours, (0.3, Y), (1.0, Y)), jax.jvp(theirs, (0.3, Y), (1.0, Y)))
    assert_same(jax.vmap(ours, (0, None))(X, Y), jax.vmap(theirs, (0, None))(X, Y))


def test_lanes_vmap_gradient_of_unbounded_loop_raises_as_jax_does():
    with pytest.raises(ValueError, match="Reverse-mode differentiation"):
        jax.grad(lambda x: jnp.sum(lanes.vmap(root)(x)[0]))(X)


def test_lanes_vmap_keeps_rules_of_custom_derivatives():
    @jax.custom_jvp
    def doubled(x):
        return 2 * x

    doubled.defjvp(lambda x, t: (2 * x[0], 5 * t[0]))
    got = jax.grad(lambda x: jnp.sum(lanes.vmap(doubled)(x)))(X)
    assert_same(got, jnp.full(5, 5.0))


# Functions that cannot be compiled


def test_unsupported_function_equals_jax_vmap_and_gives_reason():
    def factor(x):
        return jnp.linalg.cholesky(jnp.outer(x, x) + jnp.eye(x.size))

    function = lanes.vmap(factor)
    assert_same(function(-ROWS), jax.vmap(factor)(-ROWS))
    use = use_of(function, ROWS)
    assert use == ("xla", "the primitive cholesky", 5)
    use = use_of(lanes.jit(factor), X)
    assert use == ("xla", "the primitive cholesky", None)


def test_large_arrays_equal_jax_and_give_reason():
    matrix = jnp.ones((200, 200))
    function = lanes.jit(lambda x: x @ x + x)
    assert_same(function(matrix), matrix @ matrix + matrix)
    use = use_of(function, matrix)
    assert use.engine == "xla"
    assert "its arrays are so large" in use.reason


@pytest.mark.parametrize("engine", ["xla", "kernels"])
def test_chosen_engine_is_the_reason(engine, monkeypatch):
    monkeypatch.setenv("NHJAX_ENGINE", engine)
    assert use_of(lanes.vmap(root), X) == ("xla", "chosen", 5)
    jax.clear_caches()
    assert_same(lanes.vmap(root)(X), jax.vmap(root)(X))
    jax.clear_caches()


def test_missing_llvmlite_is_the_reason(monkeypatch):
    monkeypatch.setattr(_engines, "is_available", lambda: False)
    use = use_of(lanes.vmap(root), X)
    assert use.engine == "xla"
    assert "llvmlite is not installed" in use.reason


def test_random_keys_equal_those_of_jax():
    keys = jax.random.split(jax.random.key(0), 3)
    assert_same(lanes.vmap(jax.random.normal)(keys), jax.vmap(jax.random.normal)(keys))
    assert use_of(lanes.vmap(jax.random.normal), keys).engine == "xla"


# Calls of Python


def test_print_after_a_loop_prints_and_loop_is_compiled(capfd):
    def loud(x):
        y = lax.while_loop(lambda y: y > 1, lambda y: y / 2, x)
        jax.debug.print("y = {}", y)
        return y + 1

    got = lanes.vmap(loud)(jnp.array([4.0, 3.0]))
    jax.effects_barrier()
    assert_same(got, jnp.array([2.0, 1.75]))
    assert sorted(capfd.readouterr().out.splitlines()) == ["y = 0.75", "y = 1.0"]
    use = use_of(lanes.vmap(loud), X)
    assert use.engine == "lanes"
    assert "a part that has effects or calls Python (debug_print)" in use.reason


def test_print_inside_a_loop_prints_and_gives_reason(capfd):
    def loud(x):
        def body(k, y):
            jax.debug.print("k = {}", k)
            return y * 2

        return lax.fori_loop(0, 2, body, x)

    assert_same(lanes.vmap(loud)(X), 4 * X)
    jax.effects_barrier()
    assert capfd.readouterr().out.count("k = 1") >= 1
    use = use_of(lanes.vmap(loud), X)
    assert use.engine == "xla"
    assert "all of it has effects or calls Python (" in use.reason


def test_ordered_prints_before_and_after_a_loop_stay_in_order(capfd):
    def loud(x):
        y = lax.while_loop(lambda y: y > 1, lambda y: y / 2, x)
        jax.debug.print("first {}", y, ordered=True)
        jax.debug.print("second {}", x, ordered=True)
        return y

    lanes.jit(loud)(3.0)
    jax.effects_barrier()
    assert capfd.readouterr().out.splitlines() == ["first 0.75", "second 3.0"]


def test_callback_of_operands_is_an_operand_of_the_compiled_part():
    def function(x):
        shape = jax.ShapeDtypeStruct((), x.dtype)
        a = jax.pure_callback(np.square, shape, x, vmap_method="expand_dims")
        return root(a + 1)

    def plain(x):
        return root(x**2 + 1)

    assert_same(lanes.vmap(function)(X), jax.vmap(plain)(X))
    assert use_of(lanes.vmap(function), X).engine == "lanes"


def checked(x, limit):
    x = eqx.error_if(x, x < 0, "x is negative")
    y, count = root(x, steps=jnp.asarray(50))
    return eqx.error_if(y, y > limit, "y is large"), count


def test_error_checks_that_hold_leave_the_loop_compiled():
    function = lanes.vmap(checked, (0, None))
    assert_same(function(X, 10.0), jax.vmap(checked, (0, None))(X, 10.0))
    use = use_of(function, X, 10.0)
    assert use.engine == "lanes"
    assert "calls Python (pure_callback)" in use.reason


@pytest.mark.parametrize(
    ("x", "limit", "message"),
    [(X - 1, 10.0, "x is negative"), (X, 1.0, "y is large")],
)
@pytest.mark.parametrize("transform", [eqx.filter_jit, lambda f: f])
def test_error_check_of_one_member_raises(x, limit, message, transform, capfd):
    with pytest.raises(Exception, match=message):
        jax.block_until_ready(transform(lanes.vmap(checked, (0, None)))(x, limit))
    capfd.readouterr()


def test_error_checks_have_gradients():
    def loss(vmap, x):
        def function(x):
            x = eqx.error_if(x, x < 0, "x is negative")
            y = power(x, Y)
            return eqx.error_if(y, y > 10, "y is large")

        return jnp.sum(vmap(function)(x))

    got = jax.grad(partial(loss, lanes.vmap))(X)
    assert_same(got, jax.grad(partial(loss, jax.vmap))(X))


# Mistakes


@pytest.mark.parametrize("transform", [lanes.vmap, lanes.jit])
def test_lanes_transform_of_something_else_than_a_function_raises(transform):
    with pytest.raises(TypeError, match="`fun` is 3, which is not a function"):
        transform(3)


@pytest.mark.parametrize("transform", [lanes.vmap, lanes.jit])
def test_lanes_function_that_returns_text_raises_with_its_place(transform):
    with pytest.raises(TypeError, match=r"'fast' as its result\['how'\]\[0\]"):
        transform(lambda x: {"how": ["fast"], "x": x})(X)


@pytest.mark.parametrize(
    ("args", "kwargs", "name"),
    [
        ((1.0, [{1, 2}]), {}, r"options\[0\]"),
        ((1.0,), {"options": {"k": {1, 2}}}, r"options\['k'\]"),
        (({1, 2}, None), {}, "x"),
    ],
)
def test_lanes_jit_of_argument_without_hash_raises_with_its_name(args, kwargs, name):
    with pytest.raises(TypeError, match=rf"The argument `{name}` contains {{1, 2}}"):
        lanes.jit(lambda x, options: x)(*args, **kwargs)


@pytest.mark.parametrize(
    ("args", "axes", "message"),
    [
        ((X, jnp.ones(4)), (0, 0), "axis 0 of argument rate of type"),
        ((X, X), (None, None), "at least one non-None value in in_axes"),
        ((X, X), (0, 2), "its rank should be at least 3"),
    ],
)
def test_lanes_vmap_of_axes_that_do_not_fit_raises_as_jax_does(args, axes, message):
    def function(x, rate):
        return x * rate

    for transform in (jax.vmap, lanes.vmap):
        with pytest.raises(ValueError, match=message):
            transform(function, axes)(*args)


def test_lanes_vmap_with_result_of_members_as_shared_raises_as_jax_does():
    for transform in (jax.vmap, lanes.vmap):
        with pytest.raises(ValueError, match="axis spec None but output was batched"):
            transform(lambda x: x, out_axes=None)(X)
