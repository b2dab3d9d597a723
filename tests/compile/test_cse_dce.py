"""Programs lose repeated and unused operations, and compute the same."""

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from nhjax.lanes import cse_dce


X = np.linspace(-1.0, 2.0, 5)


def program_of(function, *args):
    return jax.make_jaxpr(function)(*(args or (X,)))


def operations(program):
    return [equation.primitive.name for equation in program.eqns]


def results(program, *args):
    return jax.extend.core.jaxpr_as_fun(program)(*(args or (X,)))


def test_operations_that_are_repeated_are_removed():
    def function(x):
        return jnp.sin(2 * x) + jnp.cos(jnp.sin(2 * x)), jnp.sin(2 * x)

    program = program_of(function)
    short = cse_dce(program)
    assert sorted(operations(short)) == ["add", "cos", "mul", "sin"]
    for one, other in zip(results(short), results(program), strict=True):
        np.testing.assert_array_equal(one, other)


def test_unused_operations_of_jaxpr_are_removed():
    def function(x):
        jnp.exp(jnp.cos(x))
        return jnp.sin(x)

    assert operations(cse_dce(program_of(function))) == ["sin"]


def test_results_that_are_operands_or_constants_are_kept():
    def function(x):
        return x, jnp.sin(x), 1.0, jnp.sin(x)

    short = cse_dce(program_of(function))
    assert operations(short) == ["sin"]
    same, one, constant, other = results(short)
    np.testing.assert_array_equal(same, X)
    np.testing.assert_array_equal(one, np.asarray(other))
    assert constant == 1.0


@pytest.mark.parametrize(
    "function",
    [
        lambda x: (x * 0.0, x * -0.0),
        lambda x: (x < 1, x < 2),
        lambda x: (jnp.sum(x, axis=0), jnp.max(x, axis=0)),
        lambda x: (x.astype("float32"), x.astype("int32")),
        lambda x: (x - 1, 1 - x),
        lambda x: (jnp.take(x, 7, fill_value=0.0), jnp.take(x, 7, fill_value=-0.0)),
    ],
)
def test_operations_that_differ_are_kept(function):
    program = program_of(function)
    short = cse_dce(program)
    assert operations(short) == operations(program)
    for one, other in zip(results(short), results(program), strict=True):
        np.testing.assert_array_equal(np.signbit(one), np.signbit(other))
        np.testing.assert_array_equal(one, other)


def _scan(x):
    step = lambda c, y: (jnp.sin(c) + jnp.sin(c) * y, jnp.cos(c))  # noqa: E731
    return lax.scan(step, 0.5, x)


def _while(x):
    return lax.while_loop(
        lambda c: c[0] < 3, lambda c: (c[0] + c[1], c[1]), (x[0], 1.5)
    )


def _cond(x):
    return lax.cond(x[0] < 0, lambda x: jnp.sin(x) + jnp.sin(x), jnp.cos, x)


def _jitted(x):
    return jax.jit(lambda x: jnp.sin(x) * jnp.sin(x))(x)


def _remat(x):
    return jax.checkpoint(lambda x: jnp.sin(x) * jnp.sin(x))(x)


def _solve(x):
    solve = lambda _, b: b / (4 + 0 * jnp.sin(1.0) * jnp.sin(1.0))  # noqa: E731
    return lax.custom_linear_solve(lambda y: 4 * y, x, solve, solve)


@jax.custom_jvp
def _with_rule(x):
    return jnp.sin(x) * jnp.sin(x)


@_with_rule.defjvp
def _rule(primals, tangents):
    return _with_rule(*primals), 3 * tangents[0]


INNER = [_scan, _while, _cond, _jitted, _remat, _solve, _with_rule]


@pytest.mark.parametrize("function", INNER)
def test_inner_jaxprs_are_simplified_too(function):
    program = program_of(function)
    short = cse_dce(program)
    for one, other in zip(results(short), results(program), strict=True):
        np.testing.assert_array_equal(one, other)
    text = str(short)
    assert text.count("sin") < str(program).count("sin") or "sin" not in text


@pytest.mark.parametrize("function", [f for f in INNER if f is not _while])
def test_simplified_jaxprs_have_the_same_derivatives(function):
    program = program_of(function)

    def cost(program):
        return lambda x: sum(jnp.sum(y) for y in results(program, x))

    for of in (jax.grad, lambda f: jax.jacfwd(f)):
        expected = of(cost(program))(X)
        np.testing.assert_array_equal(of(cost(cse_dce(program)))(X), expected)


def test_operations_with_effects_are_kept(capfd):
    def function(x):
        jax.debug.print("seen {}", x[0])
        jax.debug.print("seen {}", x[0])
        return x

    results(cse_dce(program_of(function)))
    jax.effects_barrier()
    assert capfd.readouterr().out.count("seen -1.0") == 2


def test_operations_under_other_settings_of_jax_are_kept():
    def function(key):
        with jax.threefry_partitionable(False):
            one = jax.random.bits(key, (2,))
        with jax.threefry_partitionable(True):
            return one, jax.random.bits(key, (2,))

    key = jax.random.PRNGKey(0)
    program = program_of(function, key)
    one, other = results(cse_dce(program), key)
    for got, expected in zip((one, other), results(program, key), strict=True):
        np.testing.assert_array_equal(got, expected)
    assert np.any(one != other)


def test_unnamed_result_does_not_replace_a_named_one():
    def function(x):
        first, _ = lax.split(x, (2, 3))
        _, second = lax.split(x, (2, 3))
        return jnp.sum(first) * second

    program = program_of(function)
    splits = [e for e in program.eqns if e.primitive.name == "split"]
    variables = [list(e.outvars) for e in splits]
    for place, outvars in zip((1, 0), variables, strict=True):
        outvars[place] = jax.extend.core.DropVar(outvars[place].aval)
    named = dict(zip(map(id, splits), variables, strict=True))
    equations = [e.replace(outvars=named.get(id(e), e.outvars)) for e in program.eqns]
    short = cse_dce(program.replace(jaxpr=program.jaxpr.replace(eqns=equations)))
    np.testing.assert_array_equal(results(short)[0], function(X))
    operands = [v for e in short.eqns for v in e.invars]
    assert not any(isinstance(v, jax.extend.core.DropVar) for v in operands)


def test_named_results_come_from_one_operation():
    def function(x):
        first, rest = lax.split(x, (2, 3))
        start, second = lax.split(x, (2, 3))
        return jnp.sum(first * start) * (rest + second)

    program = program_of(function)
    assert operations(program).count("split") == 2
    assert operations(cse_dce(program)).count("split") == 1
    np.testing.assert_array_equal(results(cse_dce(program))[0], function(X))


def test_jaxpr_shared_by_many_calls_stays_shared():
    function = lambda x: jnp.sin(x) * jnp.sin(x)  # noqa: E731
    for _ in range(14):
        inner = jax.jit(function)
        function = lambda x, inner=inner: inner(x) + inner(x + 1)  # noqa: E731
    short = cse_dce(program_of(function))
    depth, programs = 0, [short]
    while programs:
        inner = [
            e.params["jaxpr"] for p in programs for e in p.eqns if "jaxpr" in e.params
        ]
        programs = list({id(p): p for p in inner}.values())
        assert len(programs) <= 1
        depth += 1
    assert depth == 15
