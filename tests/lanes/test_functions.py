"""Long programs are compiled once, as functions that kernels call."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from nhjax.lanes import llvm_ir
from support.lanes_run import run


def chain(x, y):
    """A program of more than 500 operations on numbers."""
    for k in range(150):
        x, y = x * y - jnp.sin(0.01 * k) * x, jnp.where(x > y, y + 0.1 * x, 0.3 * y)
    return x, y


@jax.jit
def compiled_once_chain(x, y):
    """The same program, which kernels call as a function."""
    return chain(x, y)


def at_three_places(function):
    def whole(x, shared):
        one = function(x, shared)
        other = function(one[1], 0.9 * shared)
        return *function(shared, shared), *other

    return whole


def module_of(function, *arguments, is_batched=(True, False), width=4):
    program = jax.make_jaxpr(function)(*arguments)
    return program, llvm_ir(program, is_batched, width)


def definitions_and_calls(text):
    return (
        len(re.findall(r"^define internal .* @program\.\d+\(", text, re.MULTILINE)),
        len(re.findall(r"= call .* @program\.\d+\(", text)),
    )


@pytest.mark.parametrize("width", [1, 4])
def test_long_program_at_several_places_becomes_one_function_a_width(width):
    _, text = module_of(at_three_places(compiled_once_chain), 0.5, 0.7, width=width)
    # The call whose operands all members share uses a scalar function.
    assert definitions_and_calls(text) == (2 if width > 1 else 1, 3)
    _, text = module_of(at_three_places(chain), 0.5, 0.7, width=width)
    assert definitions_and_calls(text) == (0, 0)


@pytest.mark.parametrize("width", [1, 4])
def test_called_program_equals_program_that_is_written_out(width):
    x, shared = np.linspace(0.2, 0.9, 7), np.array(0.7)
    found, wanted = (
        run(
            jax.make_jaxpr(at_three_places(f))(0.5, 0.7),
            [x, shared],
            [True, False],
            width,
        )
        for f in (compiled_once_chain, chain)
    )
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
        assert np.all(np.isfinite(one))


def test_program_that_appears_in_two_copies_becomes_one_function():
    def compiled_once_copy(x, y):
        return chain(x, y)

    def both(x, y):
        return compiled_once_chain(x, y), jax.jit(compiled_once_copy)(y, x)

    assert definitions_and_calls(module_of(both, 0.5, 0.7, width=1)[1]) == (1, 2)


def test_program_in_loop_is_written_out_unless_the_loop_contains_an_iteration():
    def counted(x, y):
        return lax.fori_loop(0, 100, lambda _, z: compiled_once_chain(*z), (x, y))

    def with_iteration(x, y):
        def step(_, z):
            x, y = compiled_once_chain(*z)
            return lax.while_loop(lambda z: z > 1, lambda z: 0.5 * z, x), y

        return lax.fori_loop(0, 100, step, (x, y))

    assert definitions_and_calls(module_of(counted, 0.5, 0.7)[1]) == (0, 0)
    assert definitions_and_calls(module_of(with_iteration, 0.5, 0.7)[1])[0] > 0


def test_constant_operands_that_save_little_share_the_general_function():
    def whole(x, y):
        return compiled_once_chain(x, 0.25), compiled_once_chain(x, y)

    program, text = module_of(whole, 0.5, 0.7, width=1)
    assert definitions_and_calls(text) == (1, 2)
    x, y = np.linspace(0.2, 0.9, 5), np.array(0.7)
    found = run(program, [x, y], [True, False], 1)
    wanted = jax.tree.leaves(jax.vmap(whole, (0, None))(x, y))
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_results_without_users_are_not_computed():
    _, text = module_of(lambda x, y: compiled_once_chain(x, y)[1], 0.5, 0.7, width=1)
    assert re.search(r"define internal double @program", text)


def test_program_with_loop_inside_is_written_out():
    @jax.jit
    def compiled_once_loop(x, y):
        x, y = chain(x, y)
        return lax.fori_loop(0, 1000, lambda _, z: 0.5 * z + y, x)

    _, text = module_of(compiled_once_loop, 0.5, 0.7)
    assert definitions_and_calls(text) == (0, 0)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("number", [2, 3, 4, 5, 7])
def test_function_of_numbers_returns_three_or_four_floats_in_memory(number, dtype):
    def floats(x):
        for k in range(150):
            x = [
                0.5 * a * b - 0.001 * k * b
                for a, b in zip(x, x[1:] + x[:1], strict=True)
            ]
        return x

    @jax.jit
    def compiled_once_floats(*x):
        return *floats([*x]), x[0] > 1

    def whole(x):
        *first, is_large = compiled_once_floats(*(x * (k + 1) for k in range(number)))
        return *compiled_once_floats(*first)[:number], is_large

    x = np.linspace(0.2, 0.9, 5).astype(dtype)
    program, text = module_of(whole, x[0], is_batched=(True,), width=1)
    (results,) = re.findall(r"^define internal \{ (.*) \} @program", text, re.MULTILINE)
    # Three or four results would be returned in x87 registers; five are not.
    expected = 5 if number in (3, 4) else number
    assert len(re.findall("double|float", results)) == expected
    assert results.count("i1") == 1
    found = run(program, [x], [True], 1)
    for one, other in zip(found, jax.vmap(whole)(x), strict=True):
        np.testing.assert_allclose(
            one, other, rtol=1e-4 if dtype == "float32" else 1e-12
        )
