"""A loop that continues another one, and the constants with which that one started."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nhjax._compile import as_cpu_kernel, started_like
from nhjax.lanes import llvm_ir


# Two programs agree bit for bit only in optimised kernels, as users have them.
pytestmark = pytest.mark.usefixtures("optimised_kernels")


def first_carry(x):
    """A vector, a matrix with zeros that stay, and a counter that starts as zero."""
    return x, with_two_entries(x[0], x[1]), jnp.zeros(())


def with_two_entries(first, second):
    zero = jnp.zeros(())
    rows = [first, zero, zero], [zero, zero, second], [zero] * 3
    return jnp.stack([jnp.stack(row) for row in rows])


def advance(_, carry):
    x, matrix, count = carry
    x = x + 0.1 * jnp.sum(matrix * x[None], axis=1) + 0.01 * count
    return x, with_two_entries(jnp.sin(x[0]), x[2]), count + 1


def whole(x, length):
    return jax.lax.fori_loop(0, length, advance, first_carry(x))


def rest(x, carry, length, *, is_told=True):
    if is_told:
        carry = started_like(first_carry(x), carry)
    return jax.lax.fori_loop(0, length, advance, carry)


X = jnp.array([0.7, -1.1, 0.4])


@pytest.mark.parametrize("engine", ["lanes", "kernels", "xla"])
def test_loop_in_two_parts_equals_whole_loop(monkeypatch, engine):
    monkeypatch.setenv("NHJAX_ENGINE", engine)
    expected = jax.jit(lambda x: as_cpu_kernel(whole, x, 25))(X)
    carry = jax.jit(lambda x: as_cpu_kernel(whole, x, 12))(X)
    got = jax.jit(lambda x, carry: as_cpu_kernel(rest, x, carry, 13))(X, carry)
    assert float(got[2]) == 25
    compare = partial(np.testing.assert_allclose, rtol=1e-15)
    if engine == "lanes":
        compare = np.testing.assert_array_equal
    jax.tree.map(compare, got, expected)


def test_told_loop_is_as_short_as_the_whole_loop():
    def size(function, *args):
        program = jax.make_jaxpr(function)(*args)
        return llvm_ir(program, (False,) * len(program.in_avals), 1).count(" fmul ")

    carry = whole(X, 2)
    one, told, not_told = (
        size(lambda x: whole(x, 20), X),
        size(lambda x, carry: rest(x, carry, 20), X, carry),
        size(lambda x, carry: rest(x, carry, 20, is_told=False), X, carry),
    )
    assert told == one < not_told
